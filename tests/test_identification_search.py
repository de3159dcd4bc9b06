"""The search of ``identify``: no ordinary plant is missed, and the report contains no false statement."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal

import quell as ql
from quell.identification import Root, excitation, read_record
from quell.identification.delays import delayed
from quell.identification.identify import identify
from quell.identification.model import Structure, output, output_gradient
from quell.identification.output_error import descend, projected
from quell.identification.starts import reduced_models, stable
from quell.identification.validation import residuals

from .benchmark_module import benchmark
from .test_identification import answer

pytestmark = pytest.mark.compiled

RECORDS = Path(__file__).resolve().parents[2] / "shared" / "data"


def trial() -> Any:
    """Return the benchmark's module, which draws the cases."""
    return benchmark("identification_trial")


@pytest.mark.parametrize("samples", [2000, 4000])
def test_a_resonance_is_found_in_strong_noise(samples: int) -> None:
    """70 Hz, damping 0.05, u limited to 200 Hz, 610 samples a second, noise of 30 %: the fit is that of the truth."""
    dt, omega, rng = 1.0 / 610.0, 2.0 * np.pi * 70.0, np.random.default_rng(0)
    u = signal.lfilter(*signal.butter(6, 200.0 * 2.0 * dt), rng.standard_normal(samples))
    y = answer(([omega**2], [1.0, 0.1 * omega, omega**2]), u, dt)
    y = y + 0.3 * np.std(y) * rng.standard_normal(samples)
    found = ql.identify(u, y, dt, order=2)
    assert found.fits["estimation"] > 70.0
    assert found.converged
    assert found.poles[0].omega == pytest.approx(omega, rel=0.01)
    assert found.poles[0].damping == pytest.approx(0.05, rel=0.1)


@pytest.mark.trial
@pytest.mark.parametrize("seed", [48, 111, 10243])
def test_a_model_in_the_set_is_not_missed(seed: int) -> None:
    """Cases of the trial that were missed before: wrong delays, and two poles so equal that one was put at s = 0."""
    row = trial().judged(seed)
    assert not row["missed"], row
    assert not row["misleading"], row


@pytest.mark.trial
def test_a_larger_model_never_fits_worse() -> None:
    """A nonlinear plant, so that each order leaves something: with a pole and a zero more the fit does not fall."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.standard_normal(120), 5)
    y = answer(([1.0, 0.4, 30.0], [1.0, 1.2, 40.0, 20.0, 100.0]), np.tanh(2.0 * u), 0.05)
    y = np.tanh(y / np.std(y)) + 0.02 * rng.standard_normal(u.size)
    fits = [
        ql.identify(u, y, 0.05, order=n, zeros=n - 1, integrators=0, held_out=0.0).fits[
            "estimation"
        ]
        for n in (1, 2, 3)
    ]
    assert np.all(np.diff(fits) > -1e-3), fits


def test_the_poles_alone_are_searched_for() -> None:
    """At the true poles all other parameters follow; near them the search ends at the truth, at a wrong one it has not converged."""
    structure = Structure(3, 1, (1, 0), direct=False)
    theta = np.array([0.02, 0.3, 0.01, 0.2, 0.05, 0.4, -0.1, 1.0])
    u = np.repeat(np.sign(np.random.default_rng(1).standard_normal(100)), 8)
    v = np.column_stack([u, np.ones(u.size)])
    y = output(structure, theta, v)
    wrong = np.append(theta[:2], np.zeros(6))
    cost, found = projected(structure, wrong, v, y)
    assert cost < 1e-20
    np.testing.assert_allclose(found, theta, rtol=1e-6, atol=1e-8)
    start = np.append([0.05, 0.5], np.zeros(6))
    np.testing.assert_allclose(descend(structure, start, v, y, 60).theta, theta, atol=1e-6)
    assert not descend(structure, start, v, y, 1).converged


def test_unstable_poles_are_mirrored() -> None:
    """A pole at 0.2 becomes one at −0.2, a pair keeps its imaginary part, and integrators and stable poles stay."""
    structure = Structure(4, 1, (0,))
    theta = np.zeros(structure.size)
    theta[:3] = np.poly([0.2, 0.1 + 0.5j, 0.1 - 0.5j]).real[:0:-1]
    mirrored = np.poly([-0.2, -0.1 + 0.5j, -0.1 - 0.5j]).real[:0:-1]
    np.testing.assert_allclose(stable(structure, theta)[:3], mirrored, atol=1e-12)
    np.testing.assert_allclose(
        stable(structure, stable(structure, theta))[:3], mirrored, atol=1e-12
    )


def test_before_the_record_u_had_its_first_value() -> None:
    """A delay with u[0] ≠ 0 makes no step of its own at the start, and the delay is found."""
    assert delayed(np.array([3.0, 4.0, 5.0, 6.0]), 2).tolist() == [3.0, 3.0, 3.0, 4.0]
    u = 5.0 + excitation("prbs", (0.5, 30.0), 20.0, 0.02).u
    y = answer(([3.0], [1.0, 2.0]), np.append(np.full(2004, u[0]), u)[: u.size + 2000], 0.02)[2000:]
    found = ql.identify(u, y, 0.02, order=1, delay=(0.0, 0.2))
    assert found.delay == pytest.approx(0.08)
    assert found.fits["estimation"] > 99.999


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_direct_feedthrough_is_found(noise: float) -> None:
    """As many zeros as poles: exact without noise, within its own deviations with; it is no plant for an observer."""
    num, den, dt = [0.7, 4.0, 60.0], [1.0, 1.5, 40.0], 0.02
    rng = np.random.default_rng(4)
    u = np.repeat(rng.standard_normal(400), 3)
    rest = np.polysub(num, 0.7 * np.array(den))[1:]
    y = 0.7 * u + answer((rest, den), u, dt) + noise * rng.standard_normal(u.size)
    found = ql.identify(u, y, dt, order=2, zeros=2)
    assert found.converged
    if noise:
        free = np.append(found.den[:0:-1], found.num[::-1]) - np.append(den[:0:-1], num[::-1])
        assert np.all(np.abs(free) < 4.0 * np.sqrt(np.diag(found.covariance)))
        assert np.all(
            np.sqrt(np.diag(found.covariance)) < 0.1 * np.abs([40.0, 15.0, 60.0, 10.0, 7.0])
        )
    else:
        np.testing.assert_allclose(found.num, num, rtol=1e-6)
        np.testing.assert_allclose(found.den, den, rtol=1e-6)
    np.testing.assert_allclose(found.response(1e4) / found.num[0], 1.0, atol=0.01)
    with pytest.raises(ValueError, match="zeros = 2: the model has direct feedthrough"):
        _ = found.plant
    with pytest.raises(ValueError, match="with reference must be less than order = 2"):
        ql.identify(u, y, dt, order=2, zeros=2, reference=u)


def test_the_gradient_with_feedthrough_is_that_of_differences() -> None:
    """The derivatives by a do not contain what acts at once."""
    structure = Structure(2, 0, (1, 0), direct=True)
    theta = np.array([0.02, 0.3, 0.01, 0.2, 0.05, 0.8, 0.4, -0.1])
    v = np.column_stack([np.sign(np.sin(0.3 * np.arange(200.0))), np.ones(200)])
    y, psi = output_gradient(structure, theta, v)
    np.testing.assert_allclose(y, output(structure, theta, v), atol=1e-12)
    for i, step in enumerate(1e-6 * np.eye(theta.size)):
        slope = (output(structure, theta + step, v) - output(structure, theta - step, v)) / 2e-6
        np.testing.assert_allclose(psi[:, i], slope, atol=1e-5 * np.max(np.abs(slope)))


def test_one_large_correlation_with_past_u_is_no_independence() -> None:
    """An error that is u of five samples ago fails, of five samples ahead it passes: only past u counts."""
    u = np.random.default_rng(1).standard_normal(2000)
    late, early = np.roll(u, 5), np.roll(u, -5)
    tests = residuals(late, u, 50)
    assert np.max(np.abs(tests.cross_correlation)) > 0.9
    assert not tests.independent
    assert residuals(early, u, 50).independent
    assert not residuals(u, u, 50).independent


def test_the_test_of_independence_has_its_level() -> None:
    """Of 400 pairs of independent signals, one of them coloured, 1 % are taken for dependent, and not 3 %."""
    rng = np.random.default_rng(2)
    failed = 0
    for _ in range(400):
        e, u = rng.standard_normal((2, 800))
        u = signal.lfilter([1.0], [1.0, -0.8], u)
        failed += not residuals(e, u, 30).independent
    assert failed <= 12


def test_no_shortcoming_is_named_twice() -> None:
    """Two zeros near one pole cancel it once, and one of them the other pole."""
    u = excitation("prbs", (0.2, 40.0), 20.0, 0.02, seed=3).u
    found = ql.identify(u, answer(([3.0], [1.0, 2.0]), u, 0.02), 0.02, order=1)
    one, two = Root(-1.0 + 0j, 0.5, 0.0), Root(-1.1 + 0j, 0.5, 0.0)
    for poles, zeros, count in (
        ((one,), (one, two), 1),
        ((one, two), (one, two), 2),
        ((one,), (), 0),
    ):
        object.__setattr__(found, "poles", poles)
        object.__setattr__(found, "zeros", zeros)
        assert len(found.shortcomings) == count
        assert len(set(found.shortcomings)) == count


def test_a_record_without_a_model_is_refused_or_told() -> None:
    """An output that is only noise: a poor fit, no traceback."""
    rng = np.random.default_rng(6)
    found = ql.identify(
        rng.standard_normal(800), rng.standard_normal(800), 0.01, order=3, delay=0.0
    )
    assert found.fits["estimation"] < 10.0


def rows(name: str, columns: tuple[str, ...], dt: float | None = None) -> Any:
    """Return a real record, or skip."""
    if not (RECORDS / name).exists():
        pytest.skip(f"needs {RECORDS / name}, a public record that is not part of quell")
    return read_record(RECORDS / name, columns, dt)


@pytest.mark.trial
def test_a_flexible_robot_arm_is_fitted_better_by_a_larger_model() -> None:
    """DaiSy's record: from order 4/3 to 5/4 the fit does not fall."""
    record = rows("robot_arm.csv", ("u", "y"), 1.0)
    fits = [
        identify(record.u, record.y, record.dt, n, n - 1, held_out=0.0).fits["estimation"]
        for n in (4, 5)
    ]
    assert np.all(np.diff(fits) > -1e-3), fits


def test_models_of_high_order_are_reduced_to_the_poles() -> None:
    """Without noise one of the reduced models has the plant's poles, for a fast plant and for a slow one."""
    rng = np.random.default_rng(7)
    structure = Structure(2, 0, (0,))
    for scale, hold in ((1.0, 1), (0.05, 8)):
        p = scale * np.array([-0.1 + 0.6j, -0.1 - 0.6j])
        u = np.repeat(rng.standard_normal(2400 // hold), hold)
        y = trial().answer(p, np.zeros(0), u)
        a = np.poly(p).real[:0:-1]
        found = [theta[:2] for theta in reduced_models(structure, u[:, None], y)]
        assert min(float(np.max(np.abs(one / a - 1.0))) for one in found) < 0.05
    assert len(found) > 2
