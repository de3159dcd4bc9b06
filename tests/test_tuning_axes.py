"""The bandwidths of coupled axes: bounds hold for the whole loop, and what cannot be met is told."""

from __future__ import annotations

import copy
import itertools
import json
import math
import tomllib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import MultivariableLoop, analyse
from quell.lti.models import System, zero_order_hold
from quell.setup import SetupError, load, made
from quell.tuning import Constraints, Tuned
from quell.tuning.axes import _exact, _given_gain, _made, _nominal, diagonal_entry
from quell.tuning.interaction import Interaction
from quell.tuning.optimiser.coupled import (
    CoupledLoops,
    Law,
    Limits,
    Measured,
    Plant,
    integral_gain,
    starts,
)
from quell.tuning.optimiser.loops import area_of_step, pulse_in_blocks
from quell.tuning.written import Written

from .benchmark_module import benchmark
from .cases import cases
from .commands import Shown
from .setups import GANTRY
from .test_coupling import tanks

M = np.array([[1.2e-3, 3.5e-4], [3.5e-4, 2e-4]])  # [kg m²]
DT = 1e-3


def machine(mass: Any = M, delay: float = 2 * DT) -> Any:
    """Return two coupled axes behind a delay."""
    A = np.kron(np.eye(2), [[0.0, 1.0], [0.0, 0.0]])
    B = np.kron(np.linalg.inv(mass), [[0.0], [1.0]])
    plant = ql.plants.LinearPlant(A, B, np.eye(4)[[0, 2]])
    return ql.plants.delayed_inputs(plant, delay, DT)


def axes(mass: Any = M, **parts: Any) -> ql.Axes:
    """Return axes that are not tuned."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=DT)
    return ql.Axes({name: ql.ADRC(observer, 8.0, **parts) for name in ("x", "y")}, M=mass)


@cache
def tuned(own: bool = False) -> Tuned:
    """Return tuned axes; ``own``: B0 is that of two single loops."""
    return ql.tune(machine(), controller=axes(np.diag(np.diag(M)) if own else M))


def interaction(found: Tuned) -> Interaction:
    """Return how the axes of a result act on each other."""
    assert isinstance(found.details, Interaction)
    return found.details


def changed(**parts: Any) -> Tuned:
    """Return the result with an interaction of other parts."""
    return replace(tuned(), details=replace(interaction(tuned()), **parts))


def channels(loop: MultivariableLoop) -> tuple[float, float]:
    """Return the largest |S| and |T| of all channels on a grid of our own."""
    omega = np.geomspace(1e-2, math.pi / DT, 20_000)
    S = [np.einsum("kii->ki", loop.response(name, omega)) for name in ("S_o", "S_i")]
    return max(np.max(np.abs(s)) for s in S), max(np.max(np.abs(1.0 - s)) for s in S)


@pytest.mark.trial
@pytest.mark.parametrize("own", [False, True])
def test_the_bounds_hold_for_the_coupled_loop(own: bool) -> None:
    """M_s and M_t of each channel with the others closed, and the disk margins of all at once, by ``analyse``."""
    found = tuned(own)
    loop = analyse(machine(), found.controller)
    m_s, m_t = channels(loop)
    least = min(loop.disk_margin(at).alpha for at in ("inputs", "outputs"))
    assert found.met
    assert m_s <= 1.602
    assert m_t <= 1.602
    assert least >= 0.998 * interaction(found).disk
    assert interaction(found).disk == pytest.approx(1.0 / math.sqrt(1.6**2 - 0.25))
    # Something is at its limit, or the axes would be faster.
    m_ks = [
        each.measures["M_ks"] / (found.alone[each.name].constraints.m_ks or math.inf)
        for each in found.axes
    ]
    assert max(m_s / 1.6, m_t / 1.6, interaction(found).disk / least, *m_ks) > 0.98


@pytest.mark.trial
def test_with_the_right_b0_the_coupling_costs_nothing_and_without_it_does() -> None:
    """Behind B0 the axes are two chains of integrators, and each is as good as alone."""
    for each in tuned().axes:
        assert each.objective == pytest.approx(each.measures["alone"], rel=0.02)
    costs = [math.prod(each.objective for each in tuned(own).axes) for own in (False, True)]
    assert costs[1] > 1.5 * costs[0]
    assert "decoupled by this B0" in tuned().summary()
    assert (
        "NOT decoupled by this B0: behind it a gain changes by a factor of 2.04"
        in tuned(True).summary()
    )


@pytest.mark.trial
def test_the_bandwidths_are_no_worse_than_those_of_a_grid() -> None:
    """Of equal bandwidths of both axes, which are the best here by symmetry: none within the bounds is better by 2 %."""
    found = tuned()
    limit = max(float(each.constraints.m_ks or 0.0) for each in found.alone.values())
    best = math.inf
    for omega_c in np.geomspace(2.0, 500.0, 16):
        for omega_o in np.geomspace(2.0, 500.0, 16):
            trial = axes()
            observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=float(omega_o), dt=DT)
            plain = ql.ADRC(observer, float(omega_c))
            trial = ql.Axes([plain, plain], M=M)
            loop = ql.analysis.analyse(([1.0], [1.0, 0.0, 0.0]), plain, delay=2 * DT)
            if not loop.stable or 1.0 / loop.margins.modulus > 1.6:
                continue
            omega = loop.omega
            T, CS = (np.max(np.abs(loop.response(name, omega))) for name in ("T", "CS"))
            if T > 1.6 or limit < CS:
                continue
            poles = analyse(machine(), trial).poles
            s = np.array([np.log(p.z) / DT for p in poles if abs(p.z) > 1e-3])
            s = s[(s.imag > 1e-6 * np.abs(s)) & (s.imag < math.pi / (4 * DT))]
            if np.min(-s.real / np.abs(s), initial=1.0) < 0.4:
                continue
            best = min(best, ql.tuning.schedules.load_iae(loop))
    assert found.axes[0].objective <= 1.02 * best


@pytest.mark.trial
def test_b0_that_is_off_is_designed_for_and_checked() -> None:
    """Drawn errors keep the bounds, the loop is slower than with the exact B0, and no line asks for B0_off."""
    found = ql.tune(machine(), controller=axes(), B0_off=0.03, check_samples=50)
    assert found.met
    assert found.check is not None
    assert (found.check.samples, found.check.violating, found.check.unstable) == (50, 0, 0)
    assert all(
        each.objective > theirs.objective
        for each, theirs in zip(found.axes, tuned().axes, strict=True)
    )
    assert found.count == 17
    assert "50 drawn errors of B0: 0 exceed" in found.summary()
    assert "NOT known for another B0" in tuned().summary()
    assert "NOT known for another B0" not in found.summary()


@pytest.mark.trial
def test_axes_with_limits_are_judged_in_their_file() -> None:
    """Steps of the scenario that the actuators can't follow are named with their overshoot; without limits nothing is added."""
    assert tuned().judged is None
    limited = copy.copy(axes())
    limited.set_limits(u_min=-3.0, u_max=3.0)
    r = [ql.signals.Step(0.5, 0.1), ql.signals.Step(0.5, 0.5)]
    file = Written(machine(), ql.Scenario(r, duration=1.0), DT)
    found = ql.tune(machine(), controller=limited, written=file)
    assert found.judged is not None
    run = ql.simulate(machine(), found.controller, file.scenario)
    for i, each in enumerate(found.judged.others):
        y, (first, end) = run["y"][:, i], ((100, 500), (500, 1001))[i]
        own = max(float(np.max((y[first:end] - y[first]) / (0.5 - y[first]))) - 1.0, 0.0)
        assert each.step is not None
        assert each.step.overshoot == pytest.approx(own, abs=1e-9)
    assert found.judged.failures[0].startswith("NOT")
    assert all(line in found.summary() for line in found.judged.failures)
    assert "conditionally stable: it bears" in found.summary()


@pytest.mark.trial
def test_what_cannot_be_met_is_told_with_what_to_do() -> None:
    """A B0 with the wrong sign of a coupling that all but inverts the machine."""
    strong = np.array([[1.0, 0.97], [0.97, 1.0]]) * 1e-3
    found = ql.tune(
        machine(strong), controller=axes(np.array([[1.0, -0.9], [-0.9, 1.0]]) * 1e-3), disk=1.2
    )
    assert not found.met
    assert interaction(found).excess > 1e-3
    line = next(each for each in found.verdicts() if each.startswith("NOT met"))
    assert "give the B0 of the machine" in line


def of_tanks(B0: Any) -> ql.Axes:
    """Return axes of two tanks that are not tuned."""
    level = ql.ADRC(ql.ESO.model_free(order=1, b0=1.0, omega_o=0.1, dt=1.0), omega_c=0.02)
    return ql.Axes({"h1": level, "h2": level}, B0=B0)


@pytest.mark.trial
def test_a_zero_in_the_right_half_plane_is_named_and_the_given_b0_not_asked_for_again() -> None:
    """Tanks with their exact B0: no bandwidths are stable, and the inputs to pair are told."""
    plant = tanks((0.43, 0.34))
    found = ql.tune(plant, controller=of_tanks(plant.C @ plant.B))
    assert not found.met
    assert interaction(found).given.is_of_plant
    assert interaction(found).given.is_turned
    told = found.summary()
    assert "no bandwidths are stable with this B0" in told
    assert "a zero in the right half plane, at 0.0208" in told
    assert "pair by the gains at rest, h1 with input 2, h2 with input 1" in told
    assert "NOT decoupled by this B0, which is that of the plant" in told
    for done in ("give the B0", "use B0"):
        assert done not in told
    zeros = found.to_json()["coupled"]["given_B0"]["zeros"]
    assert zeros == [[pytest.approx(0.0208, abs=1e-4), 0.0]]


@pytest.mark.trial
def test_the_pairs_that_are_proposed_meet_the_bounds() -> None:
    """The same tanks with the other inputs; the B0 of the plant, which is worse, is not asked for."""
    plant = tanks((0.43, 0.34))
    rest = -plant.C @ np.linalg.solve(plant.A, plant.B) / np.array([[62.0], [90.0]])
    found = ql.tune(plant, controller=of_tanks(rest * [[0.0, 1.0], [1.0, 0.0]]))
    assert found.met
    assert interaction(found).given.pairing is None
    assert "give the B0" not in found.summary()
    assert "a zero in the right half plane" in found.summary()


def test_a_b0_is_compared_with_that_of_the_plant() -> None:
    """To about 1 %, each row to a factor, also below the lags of actuators; another one is asked for only where it helps."""

    def judged(plant: Any, given: ql.Axes) -> tuple[bool, bool | None]:
        nominal = _nominal(plant, given, [None])[0]
        found = _given_gain(plant, given, None, nominal, 20.0, 20.0)
        assert not found.is_turned
        assert found.zeros == ()
        return found.is_of_plant, found.is_other_better

    B0 = np.linalg.inv(M)
    assert judged(machine(), axes()) == (True, False)
    for scale in (B0 * [[3.0], [1.0]], B0 * [[1.0, 1.01], [1.0, 1.0]]):
        assert judged(machine(), axes(np.linalg.inv(scale))) == (True, False)
    for wrong in (np.diag(np.diag(M)), np.linalg.inv(B0 * [[1.0, 1.05], [1.0, 1.0]])):
        assert judged(machine(), axes(wrong)) == (False, True)
    # Lags of 0.3 and 1 ms: the gains far above them are not B0, those below are.
    A, B = np.zeros((6, 6)), np.zeros((6, 2))
    A[0, 1] = A[2, 3] = 1.0
    A[[1, 3], 4:] = B0
    A[4, 4], A[5, 5] = -1 / 3e-4, -1 / 1e-3
    B[4, 0], B[5, 1] = 1 / 3e-4, 1 / 1e-3
    lagging = ql.plants.LinearPlant(A, B, np.eye(6)[[0, 2]])
    assert judged(lagging, axes()) == (True, False)
    assert judged(lagging, axes(np.diag(np.diag(M)))) == (False, None)


@pytest.mark.trial
def test_learners_and_limits_stay_and_are_not_in_the_bounds() -> None:
    """The axes keep their learner and guard; the margin with them is told beside the others."""
    given = axes(learner=ql.learners.Kalman(), guard=ql.Guard())
    found = ql.tune(machine(), controller=given)
    for before, after in zip(given.axes, found.controller.axes, strict=True):
        assert type(after.learner) is type(before.learner)
        assert before.omega_c == 8.0
        assert after.omega_c != 8.0
    assert "with the learners at rest the disk margin is" in found.summary()


@cases(
    ("how", "message"),
    [
        ({"B0_off": 1.0}, "B0_off = 1.0: must be a share from 0 to below 1"),
        ({"B0_off": -0.1}, "B0_off = -0.1"),
        ({"disk": 2.0}, "disk = 2.0: must be below 2"),
        ({"objective": "tracking"}, "objective = 'tracking'"),
        ({"constraints": Constraints(u_max=3.0)}, "u_max is not bounded for axes"),
        ({"operating_points": [[0.0] * 4]}, "a linear one is the same at all points"),
        ({"operating_points": []}, r"operating_points = \[\]"),
        ({"check_samples": 0, "B0_off": 0.02}, "check_samples"),
        ({"seed": -1}, "seed = -1"),
        ({"constraints": 3}, "constraints = 3: must be quell.tuning.Constraints"),
        ({"operating_points": 5}, "operating_points = 5: must be a list of operating points"),
        ({"operating_points": "here"}, "operating_points = 'here': must be a list"),
    ],
)
def test_bad_arguments_are_named(how: dict[str, Any], message: str) -> None:
    """By argument, value and rule."""
    with pytest.raises(ValueError, match=message):
        ql.tune(machine(), controller=axes(), **how)


def test_an_axis_that_cannot_be_tuned_is_named() -> None:
    """A B0 of the wrong sign, a law that is not linear, a plant of another size."""
    with pytest.raises(ValueError, match="axis x alone: v moves it the wrong way"):
        ql.tune(machine(), controller=axes(-M))
    with pytest.raises(ValueError, match="axis x: feedback is not linear"):
        ql.tune(
            machine(), controller=axes(feedback=ql.controllers.NonlinearFeedback((0.5, 0.5), 0.1))
        )
    with pytest.raises(ValueError, match="the controller has 2 axes"):
        ql.tune(([[0.0]], [[1.0]], [[1.0]]), controller=axes())
    with pytest.raises(ValueError, match="must be quell.Axes; for one axis give dt and structure"):
        ql.tune(machine(), controller=axes().axes[0])


def test_axes_that_have_no_bandwidths_of_their_own_are_refused() -> None:
    """Compensators have no law, and axes that share a learner one lag filter; the error says what to do."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=DT)
    with pytest.raises(ValueError, match="axes: NOT tuned, they are compensators"):
        ql.tune(machine(), controller=ql.Axes([ql.Compensator(observer)] * 2, M=M))
    shared = ql.Axes([ql.ADRC(observer, 8.0)] * 2, M=M, learner=of_all())
    with pytest.raises(ValueError, match="learner: NOT tuned with one for all axes"):
        ql.tune(machine(), controller=shared)


def of_all() -> Any:
    """Return a learner that sees the states of all axes."""
    return ql.learners.RLS(ql.features.AllAxes(ql.features.State()))


@pytest.mark.trial
def test_learners_of_all_axes_are_designed_for_the_tuned_bandwidths_and_told() -> None:
    """Parameters are those of axes that are made with these bandwidths; the margins don't have what they learn."""
    values = np.array([[20.0, 300.0], [30.0, 150.0]])
    one = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=DT), 8.0)
    made = _made(ql.Axes([one, one], M=M, learner=[of_all(), of_all()]), values)
    fresh = ql.Axes(
        [
            ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=omega_o, dt=DT), omega_c)
            for omega_c, omega_o in values.tolist()
        ],
        M=M,
        learner=[of_all(), of_all()],
    )
    for mine, theirs in zip(made.axes, fresh.axes, strict=True):
        assert repr(mine.parameters.learner) == repr(theirs.parameters.learner)
        assert mine.learner.view.observers[0].omega_o == 300.0
    told = "NOT in any margin: what learners learn from the states of other axes"
    assert told in replace(tuned(), machine=made).summary()
    assert told not in tuned().summary()


@pytest.mark.trial
def test_what_the_margin_with_learners_does_not_have_is_told() -> None:
    """Remarks of that loop on learners; those on other operating points are told in other words."""
    loop = copy.copy(interaction(tuned()).loops[0])
    loop.remark = "NOT in these margins: how MLP of x adapts\nNOT judged at other points"
    lines = changed(with_learners=loop).verdicts()
    assert "NOT in these margins: how MLP of x adapts" in lines
    assert not any("other points" in line for line in lines)


def test_the_diagonal_entry_has_no_poles_of_the_other_axes() -> None:
    """Of a coupled plant in unlike units, the response is that of the state space."""
    A = np.array([[0, 1, 0, 0], [-40.0, -2, 3, 0], [0, 0, 0, 1], [0, 0, -9e4, -30.0]])
    b, c = np.array([0.0, 500.0, 0.0, 1.0]), np.array([1.0, 0, 0, 0])
    num, den = diagonal_entry(A, b, c)
    s = 3.0j
    expected = c @ np.linalg.solve(s * np.eye(4) - A, b)
    assert np.polyval(num, s) / np.polyval(den, s) == pytest.approx(expected, rel=1e-6)
    alone, chain = diagonal_entry(
        np.kron(np.eye(2), [[0, 1.0], [0, 0]]), np.eye(4)[1], np.eye(4)[0]
    )
    assert alone.tolist() == [1.0]
    assert chain.tolist() == [1.0, 0.0, 0.0]


# ---- In files and from the command line ----


def gantry(**changes: Any) -> dict[str, Any]:
    """Return the tables of a gantry with other ones."""
    data = copy.deepcopy(tomllib.loads(GANTRY))
    data["plant"] = {"kind": "delayed-inputs", "delay": 0.002, "plant": data["plant"]}
    return data | changes


@pytest.mark.trial
def test_the_command_tunes_all_axes_of_a_setup(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """Its file runs, and has what the results say; options of the command come before those of [tune]."""
    from quell.tuning.report import toml_text

    (tmp_path / "gantry.toml").write_text(toml_text(gantry(tune={"m_s": 1.8})))
    options = ("--m-s", "1.5", "--out", "tuned.toml", "--json", "tuned.json", "--no-figures")
    shown = quell("tune", "gantry.toml", *options)
    assert shown.code == 0, shown.err
    results = json.loads((tmp_path / "tuned.json").read_text())
    assert results["constraints"]["m_s"] == 1.5
    assert results["met"]
    out = tmp_path / "tuned.toml"
    again = load(out)
    for axis, result in zip(again.controller.axes, results["axes"], strict=True):
        assert (axis.omega_c, axis.observer.omega_o) == tuple(result["values"].values())
    assert max(each["measures"]["M_s"] for each in results["axes"]) <= 1.503
    assert again.scenario is not None


def test_the_command_refuses_what_is_for_one_axis(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """Options without effect, and keys that [tune] of axes does not have."""
    from quell.tuning.report import toml_text

    (tmp_path / "gantry.toml").write_text(toml_text(gantry()))
    for option in (("--structure", "pid"), ("--trials", "3"), ("--delay", "0.1")):
        shown = quell("tune", "gantry.toml", *option, "--no-figures")
        assert shown.code == 2
        assert option[0][2:] in shown.err
        assert "for one axis" in shown.err
    shown = quell("tune", "gantry.toml", "--u-max", "3", "--no-figures")
    assert shown.code == 2
    assert "is for one axis, not for several" in shown.err
    with pytest.raises(SetupError, match="a.toml: tune.structure: unknown"):
        made("a.toml", gantry(tune={"structure": "pid"}))


@pytest.mark.trial
def test_a_drawn_machine_keeps_its_bounds() -> None:
    """The benchmark's own measures, for one machine with a B0 that is off."""
    trial = benchmark("tune_axes")
    drawn = trial.drawn(1)
    found = trial.tuned(drawn)
    worst = trial.ratios(analyse(drawn.plant, found.controller), found)
    assert found.met
    assert max(worst.values()) <= 1.002


@cases("bandwidths", [(5.0, 50.0), (0.5, 5.0), (0.05, 5.0), (0.05, 0.5), (1e-3, 1e-3)])
def test_the_cost_of_a_slow_loop_with_fast_samples_is_its_whole_response(
    bandwidths: tuple[float, float],
) -> None:
    """Of 1/s without overshoot the integral of ``|y|`` is that of y, 1/k_i, however slow the loop is."""
    plain = ql.ADRC(ql.ESO.model_free(order=1, b0=1.0, omega_o=50.0, dt=1e-4), 5.0)
    one = Plant(np.eye(2), 1e-4 * np.eye(2), np.eye(2), np.eye(2))
    limits = Limits(2.0, 2.0, None, 0.5, None)
    loops = CoupledLoops([one], [plain, plain], limits, 1e-4, 0, np.ones(2), "load-iae")
    k_i = integral_gain(Law(plain).at(*bandwidths), 1e-4)
    costs = loops.measured(np.array([bandwidths, (5.0, 50.0)])).costs
    assert costs[0] == pytest.approx(1.0 / k_i, rel=1e-6)
    assert costs[1] == pytest.approx(0.008398, rel=1e-3)


def test_distances_that_double_change_no_sum_of_an_oscillation() -> None:
    """Of two slow oscillations with the damping of 0.2 and 0.02 it is the sum of all samples, to 1e-4."""
    for damping in (0.2, 0.02):
        A = np.array([[0.0, 1.0], [-1.0, -2.0 * damping]])
        A, (B,) = zero_order_hold(A, [np.array([[0.0], [1.0]])], 1e-4)
        system = System(A - np.eye(2), B[:, 0], np.array([0.0, 1.0]), 0.0)  # y' of a step
        y = np.cumsum(pulse_in_blocks(system, 1_000_000))
        assert area_of_step(system, 1_000_000) == pytest.approx(np.sum(np.abs(y)), rel=1e-4)


@pytest.mark.trial
def test_a_bound_of_damping_is_judged_as_the_others_are() -> None:
    """Its value is that of the poles of ``analyse``, its ratio decides, and the line with NOT names it alone."""
    values = np.array([[30.0, 60.0], [60.0, 40.0]])
    observers = [ql.ESO.model_free(order=2, b0=1.0, omega_o=each, dt=DT) for each in values[:, 1]]
    given = ql.Axes(
        [ql.ADRC(one, each) for one, each in zip(observers, values[:, 0], strict=True)], M=M
    )
    limits = Limits(5.0, 5.0, None, 0.1, 0.99)
    plants = _nominal(machine(), given, [None])
    loops = CoupledLoops(plants, given.axes, limits, DT, 2, np.ones(2), "load-iae")
    found = {each.name.split()[0]: each for each in _exact(loops, [0], given, values)}
    s = np.array(
        [np.log(complex(p.z)) / DT for p in analyse(machine(), given).poles if abs(p.z) > 1e-3]
    )
    s = s[(s.imag > 1e-6 * np.abs(s)) & (s.imag < math.pi / (4 * DT))]
    assert found["damping"].value == pytest.approx(np.min(-s.real / np.abs(s)), rel=1e-6)
    assert found["damping"].ratio > 2.0
    assert found["M_s"].ratio < 1.0
    assert found["disk"].ratio < 1.0
    told = changed(reached=tuple(found.values())).verdicts()
    line = next(each for each in told if each.startswith("NOT met"))
    assert f"damping of the poles is {found['damping'].value:.4g}, at least 0.99" in line
    assert "M_s" not in line


@pytest.mark.trial
def test_a_result_without_enough_damping_does_not_meet_its_bounds() -> None:
    """Though its M_s is kept, or all but kept."""
    B0 = np.array([[1.0, 0.4], [0.4, 1.0]])
    plant = ql.plants.LinearPlant(np.zeros((2, 2)), B0, np.eye(2))
    one = ql.ADRC(ql.ESO.model_free(order=1, b0=1.0, omega_o=60.0, dt=DT), 8.0)
    bounds = Constraints(m_s=3.0, m_t=3.0, damping=0.9999)
    late = ql.plants.delayed_inputs(plant, 2 * DT, DT)
    found = ql.tune(late, controller=ql.Axes([one, one], B0=B0), constraints=bounds, B0_off=0.2)
    assert not found.met
    assert "damping of the poles is" in found.summary()
    assert found.to_json()["bounds"][-1]["name"] == "damping of the poles"


def test_a_search_starts_in_as_many_valleys_as_are_wanted() -> None:
    """The best of each come first, and no two of them are neighbours on the grid."""

    class Valleys:
        def measured(self, values: np.ndarray) -> Measured:
            place = math.log10(values[0, 0])
            cost = min(abs(place + 2.4), abs(place - 1.2) + 0.1)
            return Measured(cost, np.array([cost]), np.zeros((1, 1)), True)

    loops: Any = Valleys()
    values, low, high = np.ones((1, 2)), np.full(2, 1e-9), np.full(2, 1e9)
    found = starts(loops, values, low, high, 1000)  # all that there are
    assert [each.rank for each in found] == sorted(each.rank for each in found)
    apart = [np.log(one.values / two.values) for one, two in itertools.combinations(found, 2)]
    assert min(np.max(np.abs(each)) for each in apart) > math.log(10.0**0.4)  # no neighbours
    assert found[0].measured.cost == pytest.approx(0.0, abs=1e-12)
    for count in (1, 2, 7):
        some = starts(loops, values, low, high, count)
        assert [each.rank for each in some] == [each.rank for each in found[:count]]
