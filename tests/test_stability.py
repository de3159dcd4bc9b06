"""Stability of exported loops: exact laws, enclosures, sets of plants, bounds of rounding."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis.linearise import linear_law
from quell.controllers import in_single_precision
from quell.export import exact_law, stability
from quell.plants import LinearPlant, delayed


def adrc(order: int = 1, b0: float = 2.0, dt: float = 0.01, **options: Any) -> ql.ADRC:
    """Return an ADRC with omega_c = 4 rad/s."""
    return ql.ADRC(ql.ESO.model_free(order, b0, 20.0, dt), omega_c=4.0, **options)


def proportional(gain: float, dt: float = 0.01) -> Any:
    """Return u = gain · (r − y)."""
    return ql.baselines.PID(kp=gain, ki=0.0, dt=dt)


def integrator(gain: float) -> LinearPlant:
    """Return the plant gain/s."""
    return LinearPlant.of(([gain], [1.0, 0.0]))


def test_the_numbers_of_a_linear_law_are_those_of_its_code_exactly() -> None:
    """The matrices of a PID as rationals are its floats, in single precision those rounded."""
    pid = ql.baselines.PID(kp=3.0, ki=0.7, kd=0.2, tf=0.05, dt=0.01)
    law, exact = pid.law, exact_law(pid)
    whole = law.A + np.outer(law.B_u, law.C)  # without limits the applied u is the law's own
    assert np.array([[float(each) for each in row] for row in exact.A]) == pytest.approx(whole)
    assert [Fraction(float(each)) for each in law.C] == exact.C[0].tolist()
    assert exact.D[0].tolist() == [Fraction(law.D_r), Fraction(law.D_y)]
    single = exact_law(pid, "single")
    assert single.D[0, 0] == Fraction(float(np.float32(law.D_r)))
    assert {each.denominator.bit_count() for row in exact.A for each in row} == {1}


@pytest.mark.parametrize("form", ["current", "predictor", "reduced"])
def test_the_exact_law_of_an_adrc_is_the_measured_one_to_rounding(form: str) -> None:
    """Unit vectors of rationals and of floats give the same response to y."""
    loop = ql.ADRC(ql.ESO.model_free(2, 3.0, 30.0, 0.01, form=form), omega_c=5.0)
    exact, law = exact_law(loop), linear_law(loop)
    x, other = np.zeros(len(exact.A), dtype=object), np.zeros(law.C.size)
    for y in (1.0, -0.5, 0.25, 0.0, 0.0, 0.0):
        u = (exact.C @ x + exact.D @ [Fraction(0), Fraction(y)])[0]
        plain = law.C @ other + law.D_y * y
        assert float(u) == pytest.approx(plain, rel=1e-9, abs=1e-9)
        x = exact.A @ x + exact.B[:, 1] * Fraction(y)
        other = law.A @ other + law.B_y * y + law.B_u * plain


def test_a_plant_that_the_observer_assumes_leaves_the_poles_of_law_and_observer() -> None:
    """Separation: an integrator with the right b0 has z = 1 − ω_c dt, inside of the enclosure."""
    found = stability(adrc(), integrator(2.0))
    low, high = found.radius
    assert high - low < 1e-12
    assert low == pytest.approx(1.0 - 4.0 * 0.01, abs=1e-12)
    assert found.stable
    assert found.lines[0].startswith("Stable: the loop with linear plant in double precision")


def test_a_set_of_plants_is_stable_up_to_the_limit_of_its_gain_and_no_further() -> None:
    """Of z = 1 − κ·1.6 the limit is κ = 1.25."""
    loop, plant = proportional(80.0), integrator(2.0)
    inside, outside = (stability(loop, plant, spread=each) for each in (0.249, 0.251))
    assert inside.stable
    assert "Stable with all plants within 24.9 %" in inside.lines[1]
    assert outside.stable is False
    assert "gain × 1.251" in outside.where
    assert outside.largest == pytest.approx(1.251 * 1.6 - 1.0, abs=1e-12)
    assert outside.lines[1].startswith("NOT stable within 25.1 %")


def test_a_delay_with_a_part_of_a_sample_has_the_roots_of_its_polynomial() -> None:
    """K b dt = k and 1.5 samples late: z³ − z² + k (z + 1)/2 = 0."""
    found = stability(proportional(20.0), delayed(integrator(2.0), 0.015, 0.01))
    roots = np.roots([1.0, -1.0, 0.2, 0.2])
    assert found.radius[0] == pytest.approx(np.max(np.abs(roots)), abs=1e-12)


def test_members_drawn_from_a_set_that_is_stable_are_stable() -> None:
    """Forty plants of ADRC of order 2 with two uncertain poles, seed 5, and the limit is near."""
    plant = LinearPlant.of(([3.0], [1.0, 5.0, 6.0]))
    loop = ql.ADRC(ql.ESO.model_free(2, 3.0, 40.0, 5e-3), omega_c=8.0)
    assert stability(loop, plant, spread=0.5).stable
    rng = np.random.default_rng(5)
    law, radii = exact_law(loop), []
    A, B, C, D = (np.array([[float(x) for x in row] for row in part]) for part in law[:4])
    for _ in range(40):
        c, a1, a0 = rng.choice([0.5, 1.5, rng.uniform(0.5, 1.5)], 3) * [3.0, 5.0, 6.0]
        phi, gamma, H, _ = LinearPlant.of(([c], [1.0, a1, a0])).sampled_matrices(5e-3)
        M = np.block([[phi + gamma @ D[:, 1:] @ H, gamma @ C], [B[:, 1:] @ H, A]])
        radii.append(np.max(np.abs(np.linalg.eigvals(M))))
    assert max(radii) < 1.0


@pytest.mark.parametrize("precision", ["double", "single"])
def test_rounding_stays_within_its_bound_which_is_not_far(precision: str) -> None:
    """A run of the kernel beside the law in extended precision; the bound is below 3000 times."""
    loop, plant = adrc(2, 3.0), LinearPlant.of(([3.0], [1.0, 0.5, 0.0]))
    bound = stability(loop, plant, precision=precision).rounding[0]
    law = exact_law(loop, precision)
    A, B, C, D = (np.array([[np.longdouble(x.numerator) / np.longdouble(x.denominator) for x in row]
                            for row in part]) for part in law[:4])  # fmt: skip
    phi, gamma, H, _ = (np.asarray(part, np.longdouble) for part in plant.sampled_matrices(0.01))
    kernel = in_single_precision(loop) if precision == "single" else loop
    x, other, xi = np.zeros((2, 1), np.longdouble), np.zeros((2, 1), np.longdouble), A[:, :1] * 0
    kernel.step(0.0, 0.0)
    worst = 0.0
    for k in range(400):
        r = 1.0 if k < 200 else -1.0
        u = np.longdouble(kernel.step(r, float((H @ x)[0, 0])))
        given = np.array([[r], [(H @ other)[0, 0]]], np.longdouble)
        exact = C @ xi + D @ given
        xi = A @ xi + B @ given
        x, other = phi @ x + gamma * u, phi @ other + gamma @ exact
        worst = max(worst, float(abs(u - exact[0, 0])))
    assert bound / 3000.0 < worst < bound


def test_an_unstable_loop_is_not_stable_and_has_no_bound_of_rounding() -> None:
    """With the wrong sign of b0 the radius is above one for certain."""
    found = stability(adrc(b0=-2.0), integrator(2.0), spread=0.1)
    assert found.radius[0] > 1.0
    assert found.stable is False
    assert found.rounding == ()
    assert len(found.lines) == 1
    assert found.lines[0].startswith("NOT stable: the loop with linear plant")


def test_a_learner_is_left_out_and_the_sentence_says_so() -> None:
    """The radius is that of the controller without learner."""
    taught = adrc(learner=ql.learners.Kalman(), guard=ql.Guard())
    found, plain = (stability(each, integrator(2.0)) for each in (taught, adrc()))
    assert found.radius == plain.radius
    assert "and without the learner" in found.lines[0]
    assert "learner" not in plain.lines[0]


def test_axes_that_do_not_touch_have_the_larger_radius_of_both() -> None:
    """Two joints with B0 = diag(2, 5): the slower one decides, and each u has a bound."""
    joints = [ql.ADRC(ql.ESO.model_free(1, 1.0, 20.0, 0.01), omega_c=each) for each in (2.0, 4.0)]
    both = ql.Axes(joints, B0=np.diag([2.0, 5.0]))
    plant = LinearPlant(np.zeros((2, 2)), np.diag([2.0, 5.0]), np.eye(2))
    found = stability(both, plant)
    assert found.radius[0] == pytest.approx(1.0 - 2.0 * 0.01, abs=1e-12)
    assert len(found.rounding) == 2
    assert all(0.0 < each < 1e-10 for each in found.rounding)
    with pytest.raises(ValueError, match=r"spread = 0\.1: is for plants with one input"):
        stability(both, plant, spread=0.1)


def test_what_has_no_linear_law_or_does_not_fit_is_named() -> None:
    """Han's law, a schedule, a nonlinear plant, another number of signals, another dt, a spread."""
    han = adrc(2, feedback=ql.controllers.NonlinearFeedback(alpha=(0.5, 0.5), delta=0.1))
    for bent in (han, adrc(2, held=ql.HeldPlant())):
        with pytest.raises(ValueError, match="its law is not linear"):
            exact_law(bent)
    single = in_single_precision(adrc())
    pairs = zip(exact_law(single, "single"), exact_law(adrc(), "single"), strict=True)
    assert all(np.array_equal(one, other) for one, other in pairs)
    with pytest.raises(ValueError, match="precision = 'double': this controller calculates in"):
        exact_law(single)
    with pytest.raises(ValueError, match="must be a controller, for example"):
        exact_law("adrc")
    table = ql.controllers.Schedule(points=[0.0, 1.0], b0=[1.0, 2.0])
    with pytest.raises(ValueError, match="follow a schedule"):
        exact_law(adrc(b0=1.0, schedule=table))
    pendulum = ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], u - math.sin(x[0])), order=2)
    with pytest.raises(ValueError, match="must be linear, perhaps behind"):
        stability(adrc(), pendulum)
    two = LinearPlant(np.zeros((2, 2)), np.eye(2), np.eye(2))
    with pytest.raises(ValueError, match="has 2 inputs and 2 outputs, the controller 1 and 1"):
        stability(adrc(), two)
    with pytest.raises(ValueError, match="its delay is for dt = 0.02 s"):
        stability(adrc(), delayed(integrator(2.0), 0.04, 0.02))
    with pytest.raises(ValueError, match="spread = 1.0: must be below 1"):
        stability(adrc(), integrator(2.0), spread=1.0)


@pytest.mark.trial
def test_a_report_of_a_proof_has_the_loop(tmp_path: Path) -> None:
    """What is certain of the loop stands in REPORT.md; a spread needs a proof and a plant."""
    done = ql.export.c(adrc(), tmp_path / "c", proof=True, plant=integrator(2.0), spread=0.2)
    text = (tmp_path / "c" / "proof" / "REPORT.md").read_text(encoding="utf-8")
    assert done.stability is not None
    assert "## The loop" in text
    for line in done.stability.lines:
        assert f"- {line}." in text
    with pytest.raises(ValueError, match="goes with proof=True and a plant"):
        ql.export.c(adrc(), tmp_path / "other", spread=0.2)
    pendulum = ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], u), order=2)
    ql.export.c(adrc(), tmp_path / "more", proof=True, plant=pendulum)
    text = (tmp_path / "more" / "proof" / "REPORT.md").read_text(encoding="utf-8")
    assert "NOT judged: whether the loop is stable" in text
