"""Parts of the tuning of axes and of single loops: decoupled machines, what is said, structures, bounds."""

from __future__ import annotations

import itertools
import json
import math
import tomllib
from dataclasses import replace
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse
from quell.analysis.loop import LoopAnalysis, duration
from quell.analysis.matrices import high_gains
from quell.analysis.multivariable import sampled_matrices
from quell.tuning import Check, Constraints, Reached, Tuned
from quell.tuning.axes import (
    _are_rows_of,
    _checked_bounds,
    _disk_of,
    _off_by,
    _tightened,
    _with_errors,
    diagonal_entry,
)
from quell.tuning.interaction import GivenB0, excess
from quell.tuning.optimiser import coupled, requirements
from quell.tuning.optimiser.coupled import CoupledLoops, Found, Law, Limits, Measured, Plant, closed
from quell.tuning.optimiser.loops import law_of, load_step, response, samples_of
from quell.tuning.optimiser.requirements import (
    Bound,
    Pole,
    counted_of,
    modes_of,
    sizes,
    worst_ratio,
)
from quell.tuning.plants import given_plants, model_of, plant_set
from quell.tuning.structures.registry import make_structure

from .cases import cases

DT = 0.05
B0 = np.array([[1.0, 0.0], [0.3, 0.5]])


def machine() -> ql.plants.LinearPlant:
    """Return two lags that are coupled through their inputs."""
    return ql.plants.LinearPlant(-np.eye(2), B0, np.eye(2))


def axes(**more: Any) -> ql.Axes:
    """Return axes of order 1 that know B0."""
    observer = ql.ESO.model_free(order=1, b0=1.0, omega_o=4.0, dt=DT)
    return ql.Axes({name: ql.ADRC(observer, 2.0) for name in ("x", "y")}, B0=B0, **more)


@cache
def tuned() -> Tuned:
    """Return them tuned, by a short search, for entries of B0 that are off by 20 %."""
    short: dict[str, Any] = {"_FACTORS": (1.0,), "_ROUNDS": 2, "_ITERATIONS": 3}
    how: dict[str, Any] = {"constraints": Constraints(m_ks=3.0), "objective": "load"}
    setup = {
        "dt": DT,
        "axis": [
            {
                "name": name,
                "observer": {"kind": "model-free", "order": 1, "omega_o": 4.0},
                "controller": law,
            }
            for name, law in (("x", {"omega_c": 2.0}), ("y", "adrc"))
        ],
    }
    with patch.multiple(coupled, **short):
        return ql.tune(
            machine(), controller=axes(), B0_off=0.2, check_samples=6, setup=setup, **how
        )


def changed(**parts: Any) -> Tuned:
    """Return the result with other parts of its interaction; margins are those of its own."""
    own = tuned().details
    found = replace(own, **parts)
    vars(found).update(disk_margins=own.disk_margins, m_s=own.m_s)
    return replace(tuned(), details=found)


# ---- axes


@pytest.mark.trial
def test_decoupled_axes_are_tuned_as_each_alone_less_the_errors_of_b0() -> None:
    """Both the same; a lag of each costs as a single one, a bit more for 20 %; bounds hold."""
    found = tuned()
    assert found.met
    between = found.details
    assert between.excess <= 2e-3
    assert (between.points, between.plants, between.B0_off) == (1, 1 + 2**3, 0.2)
    x, y = found.axes
    assert (x.name, y.name) == ("x", "y")
    assert x.measures["alone"] == pytest.approx(y.measures["alone"], rel=1e-3)
    single = ql.tune(([1.0], [1.0, 1.0]), DT, structure="bandwidths", order=1, compare=(),
                     constraints=Constraints(m_ks=3.0), objective="load", written=False)  # fmt: skip
    # With b0 = 1, which is the gain of the axis, there is less freedom.
    assert 1.0 < single.design.k_i / x.measures["alone"] < 3.0
    assert found.alone["x"].design.k_i == pytest.approx(single.design.k_i, rel=1e-4)
    for each in found.axes:
        assert 1.0 <= each.measures["alone"] / each.objective < 1.2
        assert each.objective == each.k_i
        assert each.measures["M_ks"] <= 3.0 * 1.003
        assert each.values["omega_o"] <= 0.5 / DT * (1.0 + 1e-9)
    # A loop of one axis with its nominal plant, by ``analyse``.
    one = ql.ADRC(ql.ESO.model_free(1, 1.0, x.values["omega_o"], DT), x.values["omega_c"])
    loop = analyse(([1.0], [1.0, 1.0]), one)
    assert 1.0 / loop.margins.modulus <= x.measures["M_s"] * 1.001
    assert between.loops[0].stable
    assert min(between.disk_margins) >= between.disk
    assert found.controller.axes[0].omega_c == pytest.approx(x.values["omega_c"])
    assert found.controller.axes[1].observer.omega_o == pytest.approx(y.values["omega_o"])
    assert between.left is not None
    assert between.left.factor == pytest.approx(1.0, abs=1e-6)
    assert between.given.is_of_plant
    assert found.check is not None
    assert (found.check.samples, found.check.unstable, found.check.violating) == (6, 0, 0)


def test_the_report_of_axes_has_rows_bounds_and_files() -> None:
    """Lines for each axis; a setup file with the bandwidths; JSON."""
    found = tuned()
    lines = found.summary().splitlines()
    assert lines[0] == f"constraints: {found.constraints} of each channel, all others closed"
    x = found.axes[0]
    m, between = x.measures, found.details
    assert lines[1] == (
        f"x: k_i {x.objective:.4g}, M_s {m['M_s']:.3f}, M_t {m['M_t']:.3f}, M_ks {m['M_ks']:.4g}, "
        f"delay margin {duration(m['delay_margin'])}, over that alone {x.k_i / m['alone']:.3f}"
    )
    assert lines[3].startswith("active: ")
    assert lines[4].startswith(f"disk margin {between.disk_margins[0]:.3f} of all inputs, ")
    assert any(line.startswith("decoupled by this B0: behind it a gain changes") for line in lines)
    assert any(line.startswith("6 drawn errors of B0: 0 exceed a limit, 0 of") for line in lines)
    assert repr(found) == "Tuned 2 axes:\n" + found.summary()
    tables = tomllib.loads(found.toml())
    for table, axis in zip(tables["axis"], found.axes, strict=True):
        assert table["observer"]["omega_o"] == axis.values["omega_o"]
        assert table["controller"]["omega_c"] == axis.values["omega_c"]
    assert tables["axis"][1]["controller"]["kind"] == "adrc"
    shown = json.loads(json.dumps(found.to_json(), default=float))
    assert [each["values"] for each in shown["axes"]] == [each.values for each in found.axes]
    assert shown["check"]["violating"] == 0
    assert shown["coupled"]["behind_B0"] == pytest.approx(1.0)
    assert shown["met"] is True
    with pytest.raises(ValueError, match="there is no setup to complete"):
        replace(found, setup={}).toml()


def test_what_is_not_known_of_axes_is_said() -> None:
    """No B0_off, bounds that are not met, limits of u, a B0 that is not that of the plant."""

    def told(**parts: Any) -> str:
        """Return the line on bounds that are not met."""
        (line,) = [each for each in changed(**parts).verdicts() if each.startswith("NOT met")]
        return line

    assert any(
        each.startswith("NOT known for another B0 than this one")
        for each in changed(B0_off=0.0).verdicts()
    )
    bad = Reached("M_s of x", 2.0, 1.6, 1.25)
    fine = Reached("M_t of x", 1.0, 1.6, 0.625)
    missed = {"reached": (bad, fine)}
    assert told(**missed, B0_off=0.0) == (
        "NOT met with the best bandwidths that were found: M_s of x is 2, at most 1.6 is asked for; "
        "give looser bounds, less delay or faster samples"
    )
    assert "B0 has to be known better than to 20 %, or the bounds be looser" in told(**missed)
    given = GivenB0(False, True, False, (), None)
    mixed = told(**missed, given=given, left=None)
    assert "the axes are coupled through this B0: give the B0 of the machine" in mixed
    unknown = told(**missed, left=None, given=given._replace(is_other_better=None))
    assert "give the B0 of the machine, if this is not it" in unknown
    dynamic = told(**missed, left=None, given=given._replace(is_other_better=False))
    assert "a constant B0 does not undo it" in dynamic
    turned = told(**missed, left=None, given=GivenB0(True, False, True, (), (1, 0)))
    assert "determinant of the wrong sign. To be tried: pair by the gains at rest, x with input 2, y with input 1" in turned  # fmt: skip
    assert turned.endswith(", or choose other inputs or outputs")
    zeros = told(**missed, left=None, given=GivenB0(True, False, False, (0.5 + 0j,), None))
    assert zeros.endswith("To be tried: choose other inputs or outputs, or give looser bounds")


def test_bounds_and_checks_of_axes_are_sentences() -> None:
    """At most, at least, and one without a value."""
    assert str(Reached("M_s of x", 1.65, 1.6, 1.03)) == "M_s of x is 1.65, at most 1.6 is asked for"
    disk = Reached("disk margin of all inputs", 0.5, 0.6, 1.2, True)
    assert str(disk) == "disk margin of all inputs is 0.5, at least 0.6 is asked for"
    assert (
        str(Reached("the loop is not stable", math.nan, 1.0, math.inf)) == "the loop is not stable"
    )
    check = Check(200, 1, 3, (0.003, 0.043), of="drawn errors of B0")
    assert str(check) == (
        "200 drawn errors of B0: 3 exceed a limit, 1 of them unstable; a share of 0.3 to 4.3 % "
        "(95 % interval)"
    )
    assert excess([Reached("a", 1.0, 1.0, 0.9), Reached("b", 1.0, 1.0, 1.2)]) == pytest.approx(0.2)
    assert excess([Reached("a", 1.0, 1.0, 0.9)]) == 0.0


def test_a_disk_margin_follows_from_m_s_and_m_t() -> None:
    """Of a disk through the points with |S| = M_s and |T| = M_t: 1/√((M_s² + M_t²)/2 − 1/4)."""
    both = Constraints(m_s=1.6, m_t=1.4)
    assert _disk_of(both) == pytest.approx(1.0 / math.sqrt(0.5 * (1.6**2 + 1.4**2) - 0.25))
    assert _disk_of(Constraints(m_s=1.6, m_t=None)) == pytest.approx(
        1.0 / math.sqrt(0.5 * (1.6**2 + 2.6**2) - 0.25)
    )
    assert _disk_of(Constraints(m_s=None, m_t=1.4)) == pytest.approx(
        1.0 / math.sqrt(0.5 * (1.4**2 + 2.4**2) - 0.25)
    )
    with pytest.raises(ValueError, match="constraints: u_max is not bounded for axes"):
        _checked_bounds(Constraints(u_max=1.0))


@cases(
    ("options", "message"),
    [
        ({"dt": DT}, "dt = 0.05: has no effect: with a controller"),
        ({"structure": "pi"}, "structure = 'pi': has no effect: with a controller"),
        ({"u_max": 1.0}, "u_max = 1.0: has no effect: with a controller"),
        ({"b_range": (0.8, 1.2)}, r"b_range = \(0.8, 1.2\): has no effect"),
    ],
)
def test_options_of_one_axis_are_refused_with_a_controller_and_the_reverse(
    options: Any, message: str
) -> None:
    """Before anything is tuned; the error names the option."""
    with pytest.raises(ValueError, match=message):
        ql.tune(machine(), controller=axes(), **options)
    for name, value in (("disk", 0.5), ("B0_off", 0.1), ("operating_points", [[0.0]])):
        with pytest.raises(ValueError, match=f"{name} = .*: has no effect: without controller="):
            ql.tune(([1.0], [1.0, 1.0]), DT, **{name: value})


def test_bounds_are_tightened_by_a_share() -> None:
    """Peaks and noise down, the disk margin up, 1 − ζ down; none below 1.001."""
    found = _tightened(Limits(1.6, None, (2.0, 4.0), 0.5, 0.4), 1.1)
    assert found.m_s == pytest.approx(1.6 / 1.1)
    assert found.m_t is None
    assert found.m_ks == pytest.approx((2.0 / 1.1, 4.0 / 1.1))
    assert found.disk == pytest.approx(0.55)
    assert found.damping == pytest.approx(1.0 - 0.6 / 1.1)
    low = _tightened(Limits(1.01, 1.05, None, 0.5, None), 1.1)
    assert (low.m_s, low.m_t, low.m_ks, low.damping) == (1.001, 1.001, None, None)


def test_errors_of_b0_are_all_signs_of_its_entries() -> None:
    """Eight of three entries; B changes by B R times the error; zeros of B0 stay."""
    nominal = Plant(np.eye(2), B0.copy(), np.eye(2), np.linalg.inv(B0))
    plants = _with_errors(nominal, 0.2, 0)
    assert len(plants) == 8
    seen = {tuple(np.round(plant.B[B0 != 0.0] / B0[B0 != 0.0], 12)) for plant in plants}
    assert seen == set(itertools.product((0.8, 1.2), repeat=3))
    assert all(plant.B[0, 1] == pytest.approx(0.0, abs=1e-15) for plant in plants)
    assert _with_errors(nominal, 0.0, 0) == []
    one = _off_by(nominal, B0, np.array([0.1, 0.0, -0.1]))
    np.testing.assert_allclose(one.B, B0 * [[1.1, 0.0], [1.0, 0.9]], atol=1e-15)


def test_the_entry_of_one_axis_has_no_poles_of_the_others() -> None:
    """1/(s (s + 2)) of a machine with two axes; 3/(s + 4) with a zero where it has one."""
    A = np.array([[0.0, 1.0, 0, 0], [0.0, -2.0, 0, 0], [0, 0, 0, 1.0], [0, 0, -9.0, -1.0]])
    b, c = np.array([0.0, 1.0, 0.0, 0.7]), np.array([1.0, 0.0, 0.0, 0.0])
    num, den = diagonal_entry(A, b, c)
    np.testing.assert_allclose(num, [1.0], atol=1e-9)
    np.testing.assert_allclose(den, [1.0, 2.0, 0.0], atol=1e-9)
    num, den = diagonal_entry(np.diag([-4.0, -1.0]), np.array([1.0, 1.0]), np.array([3.0, 1.0]))
    # 3/(s + 4) + 1/(s + 1) = (4 s + 7)/((s + 4)(s + 1))
    np.testing.assert_allclose(num, [4.0, 7.0], atol=1e-9)
    np.testing.assert_allclose(den, [1.0, 5.0, 4.0], atol=1e-9)
    with pytest.raises(ValueError, match="its v does not move its y"):
        diagonal_entry(np.diag([-4.0, -1.0]), np.array([1.0, 0.0]), np.array([0.0, 1.0]))


def test_gains_far_above_all_dynamics_are_those_of_the_first_derivative() -> None:
    """C B, or C A B where that is zero; rows of B0 in proportion are those of the plant."""
    A = np.array([[0.0, 1.0, 0.0], [0.0, -3.0, 0.0], [0.0, 0.0, -1.0]])
    B, C = np.array([[0.0, 0.0], [2.0, 0.5], [0.3, 4.0]]), np.eye(3)[[0, 2]]
    gains, degrees = high_gains(A, B, C)
    assert gains.tolist() == [[2.0, 0.5], [0.3, 4.0]]
    assert degrees == [2, 1]
    assert _are_rows_of(np.diag([2.0, 5.0]) @ B0, B0)
    assert _are_rows_of(B0 * 1.004, B0)
    wrong = B0.copy()
    wrong[1, 0] += 0.1
    assert not _are_rows_of(wrong, B0)


# ---- loops of axes


def loops(objective: str = "load-iae", **limits: Any) -> CoupledLoops:
    """Return the loops of the machine, sampled, with two plants."""
    a = math.exp(-DT)
    one = Plant(a * np.eye(2), (1.0 - a) * B0, np.eye(2), np.linalg.inv(B0))
    given = {"m_s": 1.6, "m_t": 1.6, "m_ks": (3.0, 3.0), "disk": 0.6, "damping": 0.4}
    parts: Any = [axes().axes[0], axes().axes[1]]
    plants = [one, one._replace(B=1.2 * one.B)]
    return CoupledLoops(plants, parts, Limits(**{**given, **limits}), DT, 0, np.ones(2), objective)


def test_measures_of_decoupled_loops_are_those_of_single_ones() -> None:
    """Slacks are −log of the ratios of |S|, |T|, |C S| and the disk margin of one lag to their bounds."""
    values = np.array([[2.0, 3.0], [2.5, 4.0]])
    many = loops()
    found = many.measured(values)
    assert found.stable
    assert found.slacks.shape == (2, 4 * 2 + 2 + 2 + 1)
    for i, (omega_c, omega_o) in enumerate(values.tolist()):
        one = ql.ADRC(ql.ESO.model_free(1, 1.0, omega_o, DT), omega_c)
        loop = analyse(([1.0], [1.0, 1.0]), one)
        m_s, m_ks = 1.0 / loop.margins.modulus, loop.noise_to_control_peak
        m_t = float(np.max(np.abs(loop.response("T", loop.omega))))
        assert found.slacks[0, i] == pytest.approx(-math.log(m_s / 1.6), abs=2e-3)
        assert found.slacks[0, 2 + i] == pytest.approx(-math.log(m_t / 1.6), abs=2e-3)
        assert found.slacks[0, 8 + i] == pytest.approx(-math.log(m_ks / 3.0), abs=2e-3)
        y = loop.closed_loop("d", "y")
        A, x, area = np.eye(y.N.shape[0]) + y.N, np.zeros(y.B.size), 0.0
        for _ in range(800):
            area += DT * abs(float(y.C @ x))
            x = A @ x + y.B
        assert found.costs[i] == pytest.approx(area, rel=1e-4)
        law = many.laws[i].at(omega_c, omega_o)
        assert coupled.integral_gain(law, DT) == pytest.approx(law_k_i(omega_c, omega_o), rel=1e-9)
    assert found.cost == pytest.approx(float(np.mean(np.log(found.costs))))
    quick = loops("load").measured(values)
    np.testing.assert_allclose(
        quick.costs, [1 / law_k_i(*row) for row in values.tolist()], rtol=1e-9
    )
    wild = loops().measured(np.array([[40.0, 400.0], [2.5, 4.0]]))
    assert not wild.stable
    assert wild.violation == math.inf
    lost = loops().measured(np.array([[90.0, 900.0], [2.5, 4.0]]))
    assert not lost.stable
    assert lost.costs.tolist() == [100.0, 100.0]  # a hundred times that of each alone
    assert lost.cost == pytest.approx(math.log(100.0))


def law_k_i(omega_c: float, omega_o: float) -> float:
    """Return k_i of an ADRC of order 1 with b0 = 1: the limit of (z − 1)/dt C(z)."""
    one = ql.ADRC(ql.ESO.model_free(1, 1.0, omega_o, DT), omega_c)
    loop = analyse(([1.0], [1.0, 1.0]), one)
    omega = np.array([1e-6])
    return float((loop.response("C_y", omega)[0] * np.expm1(1j * omega[0] * DT) / DT).real)


def test_the_grid_of_coupled_loops_is_fine_beside_a_resonance() -> None:
    """Of a machine with a pair of poles at 20 rad/s: points within a thousandth of it, up to π/dt."""
    dt = 0.01
    A = np.array([[0.0, 1.0, 0.0], [-400.0, -0.4, 0.0], [0.0, 0.0, -1.0]])
    plant = ql.plants.LinearPlant(A, [[0.0, 0.0], [400.0, 0.0], [0.0, 1.0]], np.eye(3)[[0, 2]])
    matrices = sampled_matrices(plant, dt)
    observer = ql.ESO.model_free(order=1, b0=1.0, omega_o=4.0, dt=dt)
    parts = [ql.ADRC(observer, 2.0)] * 2
    one = CoupledLoops([Plant(*matrices, np.eye(2))], parts, Limits(1.6, 1.6, None, 0.6, None), dt, 0,
                       np.ones(2), "load")  # fmt: skip
    assert np.min(np.abs(one.omega / 20.0 - 1.0)) < 1e-3
    assert one.omega[-1] == pytest.approx(math.pi / dt, rel=1e-5)
    assert np.all(np.diff(one.omega) > 0.0)
    near = np.abs(one.omega / 20.0 - 1.0) < 0.15
    far = np.abs(one.omega / 5.0 - 1.0) < 0.15
    assert np.sum(near) > 2 * np.sum(far)
    G = one._G[0, np.argmin(np.abs(one.omega - 1.0))]
    s = 1j * one.omega[np.argmin(np.abs(one.omega - 1.0))]
    assert abs(G[0, 0]) == pytest.approx(abs(400.0 / (s**2 + 0.4 * s + 400.0)), rel=1e-3)
    assert abs(G[0, 1]) < 1e-12


def test_a_closed_loop_of_axes_has_the_poles_of_both() -> None:
    """Of decoupled axes those of each single loop."""
    many = loops()
    laws = [law.at(2.0, 3.0) for law in many.laws]
    poles = np.sort_complex(np.linalg.eigvals(closed(many.plants[0], laws)) + 1.0)
    loop = analyse(([1.0], [1.0, 1.0]), ql.ADRC(ql.ESO.model_free(1, 1.0, 3.0, DT), 2.0))
    single = np.asarray(loop.poles)
    for pole in single[np.abs(single) > 1e-6]:
        assert np.sum(np.abs(poles - pole) < 1e-6) >= 2
    assert loops(damping=None).least_damped(np.array([[2.0, 3.0]] * 2), 0) is None
    law = Law(axes().axes[0])
    assert law.at(2.0, 3.0) is law.at(2.0, 3.0)
    assert law.controller(2.0, 3.0).omega_c == 2.0


def test_a_scaled_norm_is_the_least_over_diagonal_scalings() -> None:
    """Of two rows in closed form: no scaling of a grid has a smaller largest singular value."""
    rng = np.random.default_rng(3)
    M = rng.standard_normal((2, 2, 2, 2)) + 1j * rng.standard_normal((2, 2, 2, 2))
    found = coupled._scaled_norm(M)
    for j, k in itertools.product(range(2), range(2)):
        norms = []
        for d in np.geomspace(0.05, 20.0, 301):
            D = np.diag([d, 1.0])
            norms.append(np.linalg.norm(D @ M[j, k] @ np.linalg.inv(D), 2))
        assert found[j, k] == pytest.approx(min(norms), rel=1e-3)


def test_results_that_keep_to_limits_come_first() -> None:
    """By cost; the others by what they exceed."""

    def at(cost: float, slack: float, stable: bool = True) -> Found:
        return Found(np.ones((1, 2)), Measured(cost, np.ones(1), np.array([[slack]]), stable))

    good, better, bad, worse, lost = (
        at(1.0, 0.1),
        at(0.5, 0.0),
        at(0.1, -0.1),
        at(0.1, -0.2),
        at(0.0, 0.0, False),
    )
    assert sorted([worse, lost, bad, good, better], key=lambda each: each.rank) == [
        better, good, bad, worse, lost,
    ]  # fmt: skip
    assert bad.measured.violation == pytest.approx(math.expm1(0.1))
    assert bad.merit == pytest.approx(0.1 + 20.0 * math.expm1(0.1))
    assert good.measured.violation == 0.0


# ---- requirements


def test_a_pole_counts_below_the_frequency_of_its_dead_time() -> None:
    """Im s < π/((dead + 2) dt), in the upper half plane, and not real."""
    s = np.array([-1.0 + 3j, -1.0 - 3j, -2.0 + 0j, -1.0 + 20j])
    none = (np.zeros(0, dtype=complex), 0)
    found = counted_of(s, none, 0, 0.4, DT)
    assert [pole.s for pole in found] == [-1.0 + 3j, -1.0 + 20j]
    late = counted_of(s, none, 4, 0.4, DT)
    assert [pole.s for pole in late] == [-1.0 + 3j]
    (pole,) = late
    assert pole.damping == pytest.approx(1.0 / math.hypot(1.0, 3.0))
    assert pole.ratio == pytest.approx((1.0 - pole.damping) / 0.6)
    assert (pole.least, pole.own, pole.plant) == (0.4, False, 0)
    mode = (np.array([-0.2 + 3.2j]), 1)
    near = counted_of(s[:1], mode, 4, 0.4, DT)
    assert near[0].own
    assert near[0].least == pytest.approx(0.5 * 0.2 / math.hypot(0.2, 3.2))
    far = counted_of(s[:1], (np.array([-0.2 + 7.0j]), 1), 4, 0.4, DT)
    assert not far[0].own
    assert Pole(-4.0 + 3j, 0, 0.4, False).damping == pytest.approx(0.8)


def test_modes_of_a_plant_are_its_weakly_damped_poles_and_zeros() -> None:
    """Of (s² + 0.04 s + 4)/(s (s + 1) (s² + 0.1 s + 9)): the zero at 2 and the pole at 3 rad/s."""
    num = [1.0, 0.04, 4.0]
    den = np.polymul([1.0, 1.0, 0.0], [1.0, 0.1, 9.0])
    plants = plant_set(given_plants((num, den), DT), DT)
    (plant,) = plants.plants
    given = (plant.N, plant.B[:, None], plant.C[None, :])
    modes, count = modes_of(given, plants.s_poles(plant), 0.4, DT)
    assert count == 1
    assert abs(modes[0]) == pytest.approx(3.0, rel=1e-3)
    assert sorted(abs(modes))[0] == pytest.approx(2.0, rel=1e-2)
    assert modes_of(given, plants.s_poles(plant), 0.01, DT)[1] == 0


def test_sizes_of_a_loop_are_its_sensitivities() -> None:
    """|S| + |T| with S + T = 1, |C S| = |T/P|; the worst ratio is the largest on the grid."""
    P, C = np.array([0.5 - 1.0j, 2.0 + 0.1j]), np.array([1.0 - 2.0j, 0.3 + 0.4j])
    S = 1.0 / (1.0 + P * C)
    np.testing.assert_allclose(sizes("M_s", P, C), np.abs(S))
    np.testing.assert_allclose(sizes("M_t", P, C), np.abs(1.0 - S))
    np.testing.assert_allclose(sizes("M_ks", P, C), np.abs((1.0 - S) / P))
    plants = plant_set(given_plants([([1.0], [1.0, 1.0]), ([2.0], [1.0, 1.0])], DT), DT)
    gains = np.array([0.5, 3.0])[:, None] * np.ones((1, plants.omega.size))
    bounds = (Bound("M_s", 1.5), Bound("M_t", 1.2), Bound("M_ks", 2.0))
    found = worst_ratio(bounds, plants, gains.astype(complex))
    for i in (0, 1):
        ratios = [float(np.max(sizes(kind, plants.P, gains[i]))) / limit for kind, limit in bounds]
        assert found[i] == pytest.approx(max(ratios))


def test_the_square_of_the_error_of_two_integrators_is_parseval_s() -> None:
    """1/π ∫ |P S/ω|² dω is Σ y² dt after a unit load, of an ADRC with two integrators."""
    plant = ([1.0], [1.0, 1.0])
    given = given_plants(plant, DT)
    plants = plant_set(given, DT)
    structure = make_structure("bandwidths-2", model_of(given, plants, Constraints()), 1)
    values = np.array([[1.0, 2.0, 4.0]])
    cost = requirements.load_cost(structure, values, plants)
    y = response(
        plants.scaled()[0], law_of(structure.controller(values[0])), load_step(plants, 1.0, 60.0)
    )
    assert math.exp(2.0 * float(cost[0])) == pytest.approx(DT * float(y @ y), rel=0.01)


def test_samples_of_a_reference_are_bounded() -> None:
    """At least ten, at most two million."""
    assert samples_of(1.0, 0.1) == 10
    assert samples_of(5.0, 0.1) == 50
    assert samples_of(0.2, 0.1) == 10
    with pytest.raises(ValueError, match=r"duration = 300000 s has 3000000 samples of dt = 0.1 s"):
        samples_of(3e5, 0.1)


def test_a_delay_of_the_observer_and_cascades_have_their_law() -> None:
    """C_y by ``law_of`` is that of ``analyse``, for delays, cascades and compensated controllers."""
    plant, omega = ([1.0], [1.0, 1.0, 0.5]), np.array([0.1, 1.0, 8.0])
    delayed = ql.ADRC(ql.ESO.model_free(2, 2.0, 10.0, DT, delay=2 * DT), 2.0)
    cascade = ql.ADRC(ql.ESO.cascade(2, 2.0, 8.0, DT), 2.0)
    pid = ql.baselines.PID(kp=1.0, ki=0.5, dt=DT)
    both = ql.controllers.Compensated(pid, ql.Compensator(ql.ESO.model_free(2, 2.0, 8.0, DT)))
    (sampled,) = plant_set(given_plants(plant, DT), DT).scaled()
    for controller in (delayed, cascade, both):
        shown = analyse(plant, controller)
        found = LoopAnalysis(sampled, law_of(controller), DT)
        np.testing.assert_allclose(
            found.response("L", omega), shown.response("L", omega), rtol=1e-9
        )
        np.testing.assert_allclose(
            found.response("CS", omega), shown.response("CS", omega), rtol=1e-9
        )
    learning = ql.ADRC(ql.ESO.model_free(1, 2.0, 10.0, DT), 2.0, learner=ql.learners.RLS(features=ql.features.Polynomial(2)))  # fmt: skip
    with pytest.raises(ValueError, match="must be linear"):
        law_of(learning)


# ---- structures


def structure_of(name: str, plant: Any, order: int = 0, dt: float = 0.01) -> Any:
    """Return a structure for a plant."""
    given = given_plants(plant, dt)
    plants = plant_set(given, dt)
    return make_structure(name, model_of(given, plants, Constraints()), order)


RESONANT = ([400.0], np.polymul([1.0, 0.0], np.polymul([1.0, 1.0], [1.0, 0.8, 400.0])))


def test_a_cascade_has_a_notch_for_a_resonance() -> None:
    """Depth at its place is what is asked for; C is that of the controller; k_i is K_p K_v/T_n."""
    structure = structure_of("p-pi-notch", RESONANT)
    assert [each.name for each in structure.parameters] == [
        "K_p", "K_v", "T_n", "T_f", "f_n1", "depth_n1", "width_n1",
    ]  # fmt: skip
    values = np.array([[0.5, 2.0, 1.5, 0.03, 20.0 / math.tau, 0.1, 0.5]])
    omega = np.array([0.1, 5.0, 20.0, 60.0])
    found = structure.response(values, omega)[0]
    loop = analyse(RESONANT, structure.controller(values[0]))
    np.testing.assert_allclose(found, loop.response("C_y", omega), rtol=1e-8)
    open_notch = values.copy()
    open_notch[0, 5] = 1.0 - 1e-12
    without = structure.response(open_notch, omega)[0]
    assert abs(found[2] / without[2]) == pytest.approx(0.1, rel=1e-3)
    assert structure.integral_gain(values)[0] == pytest.approx(0.5 * 2.0 / 1.5)
    assert structure.unstable_poles(values).tolist() == [0.0]
    assert structure.rules(values).shape == (1, 0)
    table = structure.tables(values[0])["controller"]
    assert (table["kind"], table["kp"], table["kv"], table["tn"], table["tf"]) == (
        "p-pi",
        0.5,
        2.0,
        1.5,
        0.03,
    )
    assert table["notches"] == [{"omega": pytest.approx(20.0), "depth": 0.1, "width": 0.5}]
    assert structure.controller(values[0]).name == "P-PI + notch"
    shapes, (grid, spacing) = structure.shapes(), structure.grid()
    assert shapes.shape[1] == grid.shape[1] == 7
    assert np.all(np.abs(shapes[:, 4] - 20.0 / math.tau) < 0.1)
    assert len(grid) >= len(shapes)
    assert spacing == 0.0
    assert structure.beside(values[0]).shape == (0, 7)
    plain = structure_of("p-pi-notch", ([1.0], [1.0, 1.0, 0.0]))
    assert len(plain.parameters) == 4
    assert plain.grid()[0].shape == (0, 4)
    assert plain.controller(values[0][:4]).name == "P-PI"
    feed = plain.feedforward(ql.Feedforward.rigid(2.0, viscous=0.5))
    assert feed == {"inertia": pytest.approx(2.0), "viscous": pytest.approx(0.5)}


def test_poles_of_an_adrc_are_pairs_by_frequency_and_damping() -> None:
    """And back: ω², 2 ζ ω; one real pole of an odd number is by itself."""
    structure = structure_of("poles", ([1.0], [1.0, 0.3, 0.0]), 2)
    values = np.array([[1.5, 3.0, 0.7, 8.0, 0.5, 6.0]])
    law, observer = structure.poles(values)
    np.testing.assert_allclose(np.poly(law[0]).real, [1.0, 2 * 0.7 * 3.0, 9.0])
    np.testing.assert_allclose(np.poly(observer[0]).real, np.polymul([1.0, 8.0, 64.0], [1.0, 6.0]))
    again = structure.rows_of(1.5, law[0], observer[0])
    np.testing.assert_allclose(again, values[0])
    plain = structure_of("bandwidths", ([1.0], [1.0, 0.3, 0.0]), 2)
    from_free = plain.from_other(structure, values[0])
    assert from_free is not None
    np.testing.assert_allclose(from_free, [1.5, 3.0, (8.0 * 8.0 * 6.0) ** (1 / 3)])
    other = structure.from_other(plain, np.array([1.5, 3.0, 7.0]))
    assert other is not None
    np.testing.assert_allclose(structure.poles(other[None, :])[0][0], [-3.0, -3.0], rtol=1e-6)
    assert structure.from_other(structure, values[0]) is None
    assert (
        structure.from_other(structure_of("bandwidths", ([1.0], [1.0, 1.0]), 1), values[0]) is None
    )


def test_starts_with_a_model_lie_beside_its_resonance_and_beside_an_infinite_gain() -> None:
    """The observer's pair at 20 rad/s; beside the bandwidth where k_i changes its sign it is large."""
    based = structure_of("model-based", ([1.0], [1.0, 0.3, 0.0]))
    values = np.array([based.model.b, 4.0, 9.0])
    rows = based.beside(values)
    for row in rows:
        assert 1.0 / based.integral_gain(row[None, :])[0] >= 0.0
    grid, spacing = based.grid()
    assert grid.shape == (81, 3)
    each = np.unique(grid[:, 1])
    assert spacing == pytest.approx(float(np.log(each[1] / each[0])))
    assert np.all(grid[:, 0] == based.model.b)
    free = structure_of("model-based-poles", RESONANT)
    around, none = free.grid()
    assert none == 0.0
    sizes_of = np.abs(free.poles(around)[1])
    assert np.all(np.min(np.abs(sizes_of - 20.0), axis=1) < 0.5)


@pytest.mark.filterwarnings("ignore::quell.types.DesignWarning")
def test_unstable_poles_of_a_controller_are_counted_with_and_without_delay() -> None:
    """By the poles of the controller itself, from y to u."""
    for name, order, values in (
        ("bandwidths", 2, [[1.0, 2.0, 6.0], [1.0, 40.0, 0.5]]),
        ("delay", 1, [[1.0, 2.0, 6.0], [1.0, 30.0, 8.0]]),
    ):
        dt = 0.01
        given = given_plants(([1.0], [1.0, 1.0]), dt, delay=4 * dt if name == "delay" else 0.0)
        plants = plant_set(given, dt)
        structure = make_structure(name, model_of(given, plants, Constraints()), order)
        for row in np.array(values):
            law = law_of(structure.controller(row))
            inner = law.A + np.outer(law.B_u, law.C)
            outside = int(np.sum(np.abs(np.linalg.eigvals(inner)) > 1.0 + 1e-6))
            assert structure.unstable_poles(row[None, :])[0] == outside, (name, row)


@cases(
    ("name", "order", "units"),
    [
        ("pi", 0, ["u-unit/y-unit", "s", "s"]),
        ("pid", 0, ["u-unit/y-unit", "s", "s", "s"]),
        ("bandwidths", 2, [None, "rad/s", "rad/s"]),
        ("poles", 2, [None, "rad/s", "", "rad/s", "", "rad/s"]),
        ("half-gain", 2, [None, "rad/s", "rad/s"]),
        ("p-pi-notch", 0, ["u-unit/(y-unit/s)", "1/s", "s", "s"]),
    ],
)
def test_parameters_of_a_structure_have_ranges_around_the_crossover(
    name: str, order: int, units: Any
) -> None:
    """No pole is faster than 0.5/dt; a thousandth of the crossover is in; starts lie inside."""
    structure = structure_of(name, ([1.0], [1.0, 0.3, 0.0]), order)
    omega, fastest = structure.model.omega, 0.5 / 0.01
    for parameter, unit in zip(structure.parameters, units, strict=True):
        assert 0.0 < parameter.low < parameter.high, parameter
        assert unit is None or parameter.unit == unit
        if parameter.unit == "rad/s":
            assert parameter.high == pytest.approx(fastest)
            assert parameter.low == pytest.approx(1e-3 * omega)
        if parameter.name == "T_f":
            root = math.sqrt(2.0) if name == "pid" else 1.0  # of the second-order filter
            assert parameter.low == pytest.approx(root / fastest)
    low, high = (
        np.array([getattr(each, end) for each in structure.parameters]) for end in ("low", "high")
    )
    for row in structure.shapes():
        assert np.all((row >= low * (1.0 - 1e-9)) & (row <= high * (1.0 + 1e-9))), row
    assert len({tuple(row) for row in structure.shapes().tolist()}) > 3
