"""The loop of a written file: rest, sizes of steps and loads, tables, figures of runs, prefilters."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.plants.linear import LinearPlant
from quell.quantities import UNKNOWN, Quantity, Signals
from quell.records.metrics import SETTLING_BAND
from quell.tuning import reference, tables
from quell.tuning.acceptance import Judged, _described, _slow, prefilter_table
from quell.tuning.reference import Axis
from quell.tuning.tables import Rest
from quell.tuning.written import (
    DRAWS,
    MoveFigures,
    Overload,
    StepFigures,
    Written,
    figures_table,
)

from .cases import cases

DT = 0.05
LAG = LinearPlant.of(([2.0], [1.0, 1.0]))  # a gain of 2 at rest
AXIS = LinearPlant.of(([4.0], [1.0, 0.5, 0.0]))
INF = math.inf


def pi(kp: float = 1.0, ki: float = 1.0, **limits: float) -> Any:
    """Return a PI controller."""
    return ql.baselines.PID(kp=kp, ki=ki, dt=DT, **limits)


def loop(
    *,
    reference: Any = 0.0,
    disturbances: Any = (),
    duration: float = 4.0,
    plant: Any = LAG,
    **more: Any,
) -> Written:
    """Return a written loop."""
    return Written(plant, ql.Scenario(reference, duration, disturbances, **more), DT)


# ---- rest


def test_what_holds_a_plant_at_rest_solves_its_equations() -> None:
    """A lag of gain 2 needs half of y, an axis nothing; a load at the input its own negative."""
    assert tables.held_step(LAG) == pytest.approx(0.5)
    assert tables.held_step(AXIS) == pytest.approx(0.0, abs=1e-12)
    assert tables.held_load(LAG) == pytest.approx(-1.0)
    assert tables.held_load(AXIS) == pytest.approx(-1.0)
    none = LinearPlant(LAG.A, LAG.B, LAG.C, np.zeros((1, 0)))
    assert tables.held_load(none) == 0.0
    half = LinearPlant(LAG.A, LAG.B, LAG.C, 0.5 * LAG.E)
    assert tables.held_load(half) == pytest.approx(-0.5)


def test_state_and_load_of_an_operating_point_hold_the_plant_there() -> None:
    """Of u = 0.3 and y = 0.8 a lag of gain 2 needs a load of 0.1; of y = 2 u none."""
    found = tables.rest_of_linear(LAG, Rest(0.3, 0.8))
    x, w = np.array(found.x0), np.array(found.w)
    np.testing.assert_allclose(LAG.A @ x + LAG.B[:, 0] * 0.3 + LAG.E @ w, 0.0, atol=1e-12)
    np.testing.assert_allclose(LAG.C @ x, 0.8)
    assert w[0] == pytest.approx(0.1)
    assert (found.u, found.y) == (0.3, 0.8)
    assert tables.rest_of_linear(LAG, Rest(0.3, 0.6)).w == (0.0,)


def test_an_operating_point_lies_within_the_limits_of_u() -> None:
    """Zero where it does, else their middle with y = P(0) u; an axis has none there."""
    assert tables.rest_within(LAG, None, (-1.0, 1.0)) is None
    assert tables.rest_within(LAG, None, (0.0, 1.0)) is None
    assert tables.rest_within(LAG, None, (0.4, 1.0)) == Rest(0.7, pytest.approx(1.4))
    given = Rest(0.4, 0.0)
    assert tables.rest_within(LAG, given, (0.4, 1.0)) is given
    with pytest.raises(ValueError, match=r"u at rest = 2: must lie within u_min = 0 and u_max = 1"):
        tables.rest_within(LAG, Rest(2.0, 0.0), (0.0, 1.0))
    for plant, limits in ((AXIS, (0.5, 1.0)), (LAG, (0.5, INF))):
        with pytest.raises(ValueError, match="give u and y at rest"):
            tables.rest_within(plant, None, limits)


def test_a_rest_is_given_as_u_and_y() -> None:
    """A linear plant has none of its own; one number is refused."""
    assert tables.rest_of_plant(LAG, DT) is None
    assert tables.checked_rest(None) is None
    assert tables.checked_rest((0.5, 2.0)) == Rest(0.5, 2.0)
    given = Rest(1.0, 2.0, (3.0,))
    assert tables.checked_rest(given) is given
    with pytest.raises(ValueError, match="rest"):
        tables.checked_rest((1.0,))


@cases(
    ("plant", "rest", "limits", "of_axis", "sizes"),
    [
        # 40 % of the room over what 1 needs: 0.5 of u for y, 1 for a load.
        (LAG, None, (-0.5, 0.5), 0.0, (0.4, 0.2)),
        (LAG, None, (-10.0, 10.0), 0.0, (1.0, 1.0)),
        (LAG, Rest(0.2, 0.4), (-0.5, 0.5), 0.0, (-0.56, 0.28)),
        # A heater at zero can only take loads that it adds to.
        (LAG, None, (0.0, 0.5), 0.0, (0.4, -0.2)),
        (AXIS, None, (-0.5, 0.5), 2.0, (0.1, 0.2)),
        (AXIS, None, (-0.5, 0.5), 0.0, (1.0, 0.2)),
    ],
)
def test_steps_and_loads_need_two_fifths_of_the_room_of_u(
    plant: Any, rest: Any, limits: Any, of_axis: float, sizes: Any
) -> None:
    """At rest, or on the way of an axis; 1 at most; negative where there is more room."""
    assert tables.held_sizes(plant, rest, limits, of_axis) == pytest.approx(sizes)


# ---- tables


def test_a_scenario_has_a_step_and_later_a_load() -> None:
    """At rest it begins half of the time later, with the constants that hold the plant."""
    found = tables.scenario_tables(8.0, 1, None)
    assert found["scenario"] == {
        "duration": 8.0,
        "reference": {"kind": "step"},
        "disturbances": [{"kind": "step", "at": 4.0}],
    }
    assert found["metrics"] == [{"start": 0.0, "stop": 4.0}, {"start": 4.0}]
    rest = Rest(0.3, 0.8, (0.8,), (0.1,))
    found = tables.scenario_tables(8.0, 2, rest, (0.4, -0.2))
    assert found["scenario"] == {
        "duration": 12.0,
        "reference": [0.8, {"kind": "step", "at": 4.0, "height": 0.4}],
        "x0": [0.8],
        "disturbances": [[0.1, {"kind": "step", "at": 8.0, "height": -0.2}], 0.0],
    }
    assert found["metrics"] == [{"start": 4.0, "stop": 8.0}, {"start": 8.0}]
    none = tables.scenario_tables(8.0, 0, None)
    assert "disturbances" not in none["scenario"]
    assert none["metrics"] == [{"start": 0.0}]
    scenario = tables.scenario_of(found["scenario"])
    t = np.array([0.0, 3.9, 4.1])
    assert scenario.reference(t).tolist() == pytest.approx([0.8, 0.8, 1.2])
    assert scenario.disturbances[0](np.array([7.9, 8.1])).tolist() == pytest.approx([0.1, -0.1])
    assert (scenario.duration, list(scenario.x0)) == (12.0, [0.8])


def test_windows_begin_where_signals_begin() -> None:
    """Zero, and each time within the duration once, in order."""
    scenario = {
        "duration": 10.0,
        "reference": [1.0, {"kind": "step", "at": 2.0}],
        "disturbances": [{"kind": "sinusoid", "start": 6.0}, {"kind": "step", "at": 2.0}, 0.5],
    }
    assert tables.windows_of(scenario) == [
        {"start": 0.0, "stop": 2.0},
        {"start": 2.0, "stop": 6.0},
        {"start": 6.0},
    ]
    late = {"duration": 2.0, "reference": {"kind": "step", "at": 2.0}}
    assert tables.windows_of(late) == [{"start": 0.0}]
    assert tables.windows_of({}) == [{"start": 0.0}]


def test_a_lag_and_a_delay_stand_around_the_plant_of_a_file() -> None:
    """Names go out, paths of a sweep and ranges in; a start gets a zero for each further state."""
    found = {
        "plant": {"kind": "lag", "signals": {"y": "x"}, "uncertain": {"gain": [1.0, 2.0]}},
        "scenario": {"x0": [0.5, 7.0]},
        "sweep": {"parameters": {"plant.gain": [1.0], "controller.kp": [2.0]}},
        "tune": {"schedule": {"parameter": "gain"}},
    }
    found = tables.late_tables(found, LAG, DT, 0.1, 0.3)
    assert found["plant"] == {
        "kind": "delayed",
        "delay": 0.1,
        "signals": {"y": "x"},
        "uncertain": {"plant.plant.gain": [1.0, 2.0]},
        "plant": {"kind": "lagged", "lag": 0.3, "plant": {"kind": "lag"}},
    }
    # The lag's state stands behind those of the plant, the delay's two behind that.
    assert found["scenario"]["x0"] == [0.5, 0.0, 0.0, 0.0, 7.0]
    parameters = {"plant.plant.plant.gain": [1.0], "controller.kp": [2.0]}
    assert found["sweep"]["parameters"] == parameters
    assert found["tune"]["schedule"] == {"parameter": "plant.plant.gain"}
    assert tables.late_tables(found, LAG, DT) == found
    points = {"points": [{"at": 1.0, "plant": {"gain": 2.0}}]}
    only = tables.late_tables({"plant": "lag", "tune": {"schedule": points}}, LAG, DT, 0.1)
    assert only["plant"] == {"kind": "delayed", "delay": 0.1, "plant": {"kind": "lag"}}
    assert only["tune"]["schedule"] == {"points": [{"at": 1.0, "plant": {"plant": {"gain": 2.0}}}]}
    names = {"plant": "lag", "tune": {"schedule": {"parameter": ["a", "b"]}}}
    found = tables.late_tables(names, LAG, DT, 0.1)
    assert found["tune"]["schedule"] == {"parameter": ["plant.a", "plant.b"]}
    table, more = tables.plant_table(LAG, 0.3, 0.1, DT)
    assert (table["kind"], table["plant"]["kind"], more) == ("delayed", "lagged", 3)
    assert tables.plant_table(LAG, 0.0, 0.0, DT)[1] == 0


# ---- figures


def test_a_step_is_looked_at_until_the_next_event() -> None:
    """Steps of r with their sizes; a load, a rest and the end bound them; the largest one counts."""
    r = ql.signals.Step(1.0, 0.5) + ql.signals.Step(-3.0, 1.5)
    shown = loop(reference=r, disturbances=(ql.signals.Step(1.0, 2.5),), rest_at=(3.0,))
    assert shown.steps == ((10, 30, 1.0), (30, 50, -3.0))
    assert shown.largest == (30, 50, -3.0)
    assert not shown.moves
    assert loop(reference=ql.signals.Sinusoid()).moves
    assert loop(reference=ql.signals.Sinusoid()).steps == ()
    # The first value is a step where y begins elsewhere.
    begins = loop(reference=1.0, x0=[0.25])
    y0 = 0.25 * float(LAG.C[0, 0])
    assert begins.steps == ((0, 81, pytest.approx(1.0 - y0)),)


def test_figures_of_a_step_are_those_of_its_response() -> None:
    """Overshoot, settling, time at a limit; by hand from y and u of the run."""
    shown = loop(reference=ql.signals.Step(1.0, 0.5), duration=8.0)
    controller = pi(1.5, 3.0, u_min=-0.9, u_max=0.9)
    run = shown.run(controller)
    found = shown.figures(controller, run)
    assert found is not None
    y, u = run["y"][10:], run["u"][10:]
    assert (found.size, found.at) == (1.0, 0.5)
    assert found.overshoot == pytest.approx(float(np.max(y)) - 1.0)
    assert found.band == SETTLING_BAND
    outside = np.flatnonzero(np.abs(y - 1.0) > SETTLING_BAND)
    assert found.settling == pytest.approx((outside[-1] + 1) * DT, abs=DT)
    assert found.limited == pytest.approx(float(np.sum(np.abs(u) >= 0.9)) * DT)
    assert found.limited > 0.0
    assert found.looked == pytest.approx(y.size * DT)
    assert shown.noise == 0.0
    assert loop().figures(controller, run) is None


def test_a_run_along_a_moving_reference_has_the_largest_error() -> None:
    """In all, and in its last tenth; infinite where y diverges."""
    shown = loop(reference=ql.signals.Sinusoid(omega=2.0))
    run = shown.run(pi())
    error = np.abs(run["r"] - run["y"])
    found = shown.along(run)
    assert found.largest == np.max(error)
    assert found.last == np.max(error[-8:])
    assert str(found).startswith(f"scenario: the largest |r − y| is {found.largest:.3g}, ")
    assert "in its last tenth" in str(found)
    assert str(MoveFigures(INF, INF)) == "NOT stable: y diverges in the scenario"


NOISE = ql.signals.BandLimitedNoise(0.02**2 * DT, DT)


def test_figures_have_their_range_over_draws_of_the_noise() -> None:
    """Of each draw, and of the mean response in a band that is wider and narrower by 3 σ."""
    shown = loop(reference=ql.signals.Step(1.0, 0.5), duration=12.0, noise=NOISE)
    controller = pi(1.5, 3.0)
    runs = shown.runs(controller)
    assert len(runs) == DRAWS
    np.testing.assert_array_equal(runs[0]["y"], shown.run(controller)["y"])
    step, move = shown.of_draws(controller, runs)
    assert (step is None, move) == (False, None)
    each = [shown.figures(controller, run) for run in runs]
    assert step[:7] == each[0][:7]
    overshoots = [one.overshoot for one in each]
    assert step.overshoots == (min(overshoots), max(overshoots))
    assert step.overshoots[1] - step.overshoots[0] > 0.005
    y = np.array([run["y"][10:] for run in runs])
    mean, sigma = np.mean(y, axis=0), math.sqrt(float(np.mean(np.var(y, axis=0, ddof=1))))

    def settled(band: float) -> float:
        return float((np.flatnonzero(np.abs(mean - 1.0) > band)[-1] + 1) * DT)

    times = [one.settling for one in each]
    times += [settled(step.band - 3.0 * sigma), settled(step.band + 3.0 * sigma)]
    assert step.settlings == pytest.approx((min(times), max(times)))
    assert step.settlings[1] > 1.03 * step.settlings[0]
    quiet = loop(reference=ql.signals.Step(1.0, 0.5))
    (alone,) = quiet.runs(controller)
    assert quiet.of_draws(controller, [alone])[0] == quiet.figures(controller, alone)
    assert "settlings" not in figures_table(quiet.figures(controller, alone))
    assert figures_table(step)["settlings"] == step.settlings


def test_the_error_along_a_move_and_the_time_after_an_overload_have_ranges() -> None:
    """The largest |r − y| of each draw; the time back from each draw; none without noise."""
    moving = loop(reference=ql.signals.Sinusoid(omega=2.0), noise=NOISE)
    runs = moving.runs(pi())
    step, move = moving.of_draws(pi(), runs)
    errors = [float(np.max(np.abs(run["r"] - run["y"]))) for run in runs]
    assert step is None
    assert move == moving.along(runs[0])._replace(largests=(min(errors), max(errors)))
    controller = pi(4.0, 4.0, u_min=-1.0, u_max=1.0)
    calm = loop(disturbances=(0.0,), duration=2.0, noise=NOISE)
    for load in calm.overloads(controller, None, 0.1, -1.0):
        assert load.backs[0] <= load.back <= load.backs[1]
        assert load.backs[0] < load.backs[1]
        assert load.to_json()["backs"] == load.backs
    quiet = loop(disturbances=(0.0,), duration=2.0).overloads(controller, None, 0.1, -1.0)
    assert all(load.backs is None and "backs" not in load.to_json() for load in quiet)


MM = Signals(Quantity("position", "mm"), Quantity("force", "N"))


@cases(
    ("figures", "text"),
    [
        (
            StepFigures(2.0, 0.5, 0.123, 1.5, 0.02, 4.0, 0.0),
            "step of the reference by 2 at 0.5 s: overshoots by 12.3 %, settles within 2 % in 1.5 s",
        ),
        (
            StepFigures(2.0, 0.5, 0.0, math.nan, 0.02, 4.0, 0.0),
            "NOT settled: step of the reference by 2 at 0.5 s: overshoots by 0.0 %; not within 2 % "
            "at the end of its 4 s",
        ),
        (
            StepFigures(2.0, 0.5, INF, math.nan, 0.02, 4.0, 0.0),
            "NOT stable: step of the reference by 2 at 0.5 s: y diverges",
        ),
        (
            StepFigures(2.0, 0.5, 0.0, 1.5, 0.05, 4.0, 0.0),
            "step of the reference by 2 at 0.5 s: overshoots by 0.0 %, settles within 5 % (with "
            "three deviations of the noise) in 1.5 s",
        ),
        (
            StepFigures(2.0, 0.5, 0.02, 1.5, 0.02, 4.0, 0.0, overshoots=(0.01, 0.03)),
            "step of the reference by 2 at 0.5 s: overshoots by 2.0 % (1 to 3 % over 5 draws of the "
            "noise), settles within 2 % in 1.5 s",
        ),
        (
            StepFigures(2.0, 0.5, 0.0, 1.5, 0.02, 4.0, 0.0, UNKNOWN, (0.0, 0.009), (1.4, 2.25)),
            "step of the reference by 2 at 0.5 s: overshoots by 0.0 %, settles within 2 % in 1.5 s "
            "(1.4 to 2.25 s over 5 draws of the noise)",
        ),
        (
            StepFigures(2.0, 0.5, 0.0, 1.5, 0.02, 4.0, 0.0, UNKNOWN, None, (1.49, 1.53)),
            "step of the reference by 2 at 0.5 s: overshoots by 0.0 %, settles within 2 % in 1.5 s",
        ),
        (
            StepFigures(2.0, 0.5, 0.0, 1.5, 0.02, 4.0, 0.0, UNKNOWN, None, (1.4, math.nan)),
            "NOT settled with each draw of the noise: step of the reference by 2 at 0.5 s: "
            "overshoots by 0.0 %, settles within 2 % in 1.5 s (1.4 s to never over 5 draws of the "
            "noise)",
        ),
        (
            MoveFigures(0.4, 0.1, MM, (0.38, 0.5)),
            "scenario: the largest |r − y| is 0.4 mm (0.38 to 0.5 mm over 5 draws of the noise), "
            "0.1 mm in its last tenth",
        ),
        (
            Overload(1.4, 2.0, 0.1, 3.0, 1.0, backs=(2.5, math.nan)),
            "1.4 for 2 s: back in 3 s (2.5 s to never over 5 draws of the noise)",
        ),
        (Overload(1.4, 2.0, 0.1, 3.0, 1.0), "1.4 for 2 s: back in 3 s"),
        (Overload(1.4, 2.0, 0.1, math.nan, 1.0), "1.4 for 2 s: back never"),
    ],
)
def test_figures_are_sentences(figures: Any, text: str) -> None:
    """With NOT where y does not settle or diverges."""
    assert str(figures) == text


def test_an_overload_passes_up_to_three_times_its_own_time() -> None:
    """Three times of overload and recovery without limits: 3 (2 + 1) s."""
    assert Overload(1.4, 2.0, 0.1, 9.0, 1.0).passes
    assert not Overload(1.4, 2.0, 0.1, 9.01, 1.0).passes
    assert not Overload(1.4, 2.0, 0.1, math.nan, 1.0).passes
    assert _slow(Overload(1.4, 2.0, 0.1, 9.5, 1.0)) == (
        "NOT soon back after an overload: a load of 1.4 for 2 s: back in 9.5 s, after one that u "
        "can hold in 1 s; bound the loop more (M_ks, M_s), or keep such loads away"
    )


def test_a_scenario_without_a_step_gets_one() -> None:
    """After some samples, from rest, looked at for a time; loads stay where they begin."""
    shown = loop(reference=0.5, disturbances=(ql.signals.Step(1.0, 2.0),), rest_at=(1.0,))
    found = shown.stepping(2.0, 3.0, 10)
    assert found.scenario.duration == pytest.approx(3.5)
    t = np.array([0.0, 0.45, 0.55])
    assert found.scenario.reference(t).tolist() == [0.5, 0.5, 2.5]
    assert found.largest == (10, 71, 2.0)
    (load,) = found.scenario.seeded_signals(1)[1]
    assert load(np.array([0.0, 3.0])).tolist() == [0.0, 0.0]
    assert shown.stepping(2.0, 0.1, 10).scenario.duration == pytest.approx(1.0)
    until = loop(reference=0.5, rest_at=(1.0, 3.0)).until_settled(2.0)
    assert (until.duration, tuple(np.ravel(until.rest_at))) == (2.0, (1.0,))
    assert loop(reference=0.5).until_settled(9.0).duration == 4.0


def test_a_loop_cycles_where_u_goes_from_limit_to_limit_at_the_end() -> None:
    """Both limits, a fifth of the last fifth; one limit alone is none."""
    shown, controller = loop(), pi(u_min=-1.0, u_max=1.0)

    class Run(dict[str, Any]):
        def __len__(self) -> int:
            return int(self["u"].size)

    def judged(last: list[float]) -> bool:
        u = np.concatenate([np.zeros(40), last])
        return shown.cycles(controller, Run(u=u))  # type: ignore[arg-type]

    assert judged([1.0, -1.0, 1.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert judged([1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0])
    assert not judged([1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert not judged([1.0] * 10)
    assert not judged([0.0] * 10)


def test_loads_beyond_the_room_of_u_last_five_and_twenty_time_constants() -> None:
    """1.4 times what u can hold; y is back soon, as the PI controller does not wind up."""
    shown = loop(reference=0.0, disturbances=(0.0,), duration=2.0)
    controller = pi(4.0, 4.0, u_min=-1.0, u_max=1.0)
    found = shown.overloads(controller, None, 0.1, tables.held_load(LAG))
    assert [each.duration for each in found] == pytest.approx([0.5, 2.0])
    assert [each.load for each in found] == pytest.approx([-1.4, -1.4])
    # u is at 1, so 0.4 of the load is left: y goes towards 2 · 0.4 with 1 − e^{−t}.
    assert found[1].peak == pytest.approx(0.8 * (1.0 - math.exp(-2.0)), rel=0.1)
    assert found[0].peak < found[1].peak
    assert all(each.passes for each in found)
    assert shown.overloads(pi(4.0, 4.0), None, 0.1, -1.0) == []


# ---- prefilters


def test_an_axis_has_inertia_and_viscous_friction_and_a_lag_has_none() -> None:
    """``y'' + 0.5 y' = 4 u``: u = 0.125 y' + 0.25 y''."""
    found = Axis.of(AXIS, 1.0)
    assert found is not None
    assert (found.viscous, found.inertia) == (pytest.approx(0.125), pytest.approx(0.25))
    assert Axis.of(LAG, 1.0) is None
    # Half of the time accelerating, 10 time constants.
    assert found.needs(0.1) == pytest.approx(0.25 / 1.0**2 + 0.125 / 1.0)
    assert found.needs(0.2) == pytest.approx(0.25 / 4.0 + 0.125 / 2.0)


def test_a_profile_asks_for_the_room_of_u_at_most() -> None:
    """It is c_1 v + c_2 a; without friction a is room/inertia, and v ten times what a move reaches."""
    free = Axis(0.0, 0.25).profile(2.0, 0.5, 0.1)
    assert free.a_max == pytest.approx(2.0)
    assert free.v_max == pytest.approx(10.0 * math.sqrt(2.0 * 2.0))
    assert free.j_max == pytest.approx(20.0)
    held = Axis(0.125, 0.25).profile(2.0, 0.5, 0.1)
    assert 0.125 * held.v_max + 0.25 * held.a_max == pytest.approx(0.5)
    assert held.j_max == pytest.approx(held.a_max / 0.1)
    assert 0.0 < held.v_max < 4.0
    # The quickest of 40 speeds of trapezoidal moves.
    times = []
    for v in 4.0 * (np.arange(40) + 0.5) / 40:
        a = (0.5 - 0.125 * v) / 0.25
        times.append(2.0 / v + v / a if v * v / a <= 2.0 else 2.0 * math.sqrt(2.0 / a))
    best = 4.0 * (int(np.argmin(times)) + 0.5) / 40
    assert held.v_max == pytest.approx(best)


def test_the_room_of_u_is_less_what_loads_need_half_of_it_at_most() -> None:
    """Of limits ±1 about 0.2 there are 0.8; a load of 0.3 while r steps takes 0.3, one of 5 half."""
    step, at = ql.signals.Step(1.0, 0.5), ql.signals.Step

    def room(load: Any) -> float:
        return reference.room_of_u(
            loop(reference=step, disturbances=(load,)), LAG, (-1.0, 1.0), 0.2
        )

    assert room(0.0) == pytest.approx(0.8)
    assert room(at(0.3, 0.0)) == pytest.approx(0.8)  # it acts before r steps, too
    moving = ql.signals.Sinusoid(amplitude=0.3, omega=5.0, start=0.5)
    assert room(moving) == pytest.approx(0.8 - 0.3, abs=0.01)
    big = ql.signals.Sinusoid(amplitude=5.0, omega=5.0, start=0.5)
    assert room(big) == pytest.approx(0.4)


def test_a_reference_model_makes_a_linear_step_overshoot_by_a_twentieth() -> None:
    """The fastest one: the response through it peaks at 1.05; a loop without overshoot has none."""
    from quell.tuning.plants import given_plants, plant_set

    plants = plant_set(given_plants(LAG, DT), DT)
    controller = pi(0.5, 2.0)
    model = reference.model_of_linear_step(plants, controller)
    assert model is not None
    assert model.order == 2
    a, lag = math.exp(-DT), math.exp(-model.omega * DT)
    r1 = r2 = y = 0.0
    found = []
    for _ in range(600):
        # r_f is the unit step through two equal lags, each a sample's value of its own.
        r1 = lag * r1 + (1.0 - lag) * 1.0
        r2 = lag * r2 + (1.0 - lag) * r1
        found.append(r2)
    fresh, shown = pi(0.5, 2.0), []
    for r in found:
        shown.append(y)
        y = a * y + 2.0 * (1.0 - a) * fresh.step(r, y)
    assert max(shown) == pytest.approx(1.05, abs=2e-3)
    assert reference.model_of_linear_step(plants, pi(0.5, 0.1)) is None


def test_a_reference_model_is_the_one_with_which_a_step_settles_soonest() -> None:
    """It overshoots by a twentieth at most; none of slower and faster ones settles sooner."""
    shown = loop(reference=ql.signals.Step(0.4, 0.2), duration=5.0)
    controller = pi(0.5, 2.0, u_min=-1.0, u_max=1.0)
    found = reference.reference_model_for(shown, controller, 6.0)
    assert found.prefilter is not None
    assert found.step is not None
    assert found.step.overshoot <= 0.05
    assert found.prefilter.order == 2
    assert 0.5 < found.prefilter.omega <= 6.0
    for factor in (0.7, 1.4):
        other = ql.controllers.ReferenceModel(factor * found.prefilter.omega, 2)
        step = reference._with(shown, controller, other, shown.steps[0][1])
        assert step.overshoot > 0.05 or not step.settling < found.step.settling - DT
    slow = pi(0.05, 0.05, u_min=-1.0, u_max=1.0)
    none = reference.reference_model_for(
        loop(reference=ql.signals.Step(0.4, 0.2), duration=1.0), slow, 6.0
    )
    assert none.prefilter is None


def test_a_process_at_its_limits_is_quicker_than_one_within_them() -> None:
    """Behind a reference model with which u may be at a limit; both overshoot by a twentieth."""
    shown = loop(reference=ql.signals.Step(1.4, 0.2), duration=5.0)
    controller = pi(2.0, 8.0, u_min=-1.0, u_max=1.0)
    within, free = (
        reference.reference_model_for(shown, controller, 6.0, within=each) for each in (True, False)
    )
    assert within.step is not None
    assert free.step is not None
    assert free.step.settling < within.step.settling
    assert free.step.limited > within.step.limited
    assert max(free.step.overshoot, within.step.overshoot) <= 0.05


def test_a_profile_generator_moves_an_axis_within_its_room() -> None:
    """The quickest one that overshoots little, with 15 % less of u as well, as friction brakes."""
    axis = Axis.of(AXIS, 10.0)
    assert axis is not None
    shown = loop(reference=ql.signals.Step(1.0, 0.2), duration=6.0, plant=AXIS)
    observer = ql.ESO.model_free(2, 4.0, 12.0, DT)
    controller = ql.ADRC(observer, 3.0, u_min=-1.0, u_max=1.0)
    found = reference.profile_for(shown, controller, axis, 0.4, 1.0)
    assert found.step is not None
    assert found.step.overshoot <= 0.05
    generator = found.prefilter
    # Friction takes a quarter of u at the top speed, and gives it while the axis brakes.
    assert axis.beyond(1.0, 1.0) == reference.BEYOND
    assert max(0.125 * generator.v_max, 0.25 * generator.a_max) <= 0.951
    assert 0.951 < 0.125 * generator.v_max + 0.25 * generator.a_max <= 1.7 * 0.951
    weaker = reference.with_less(controller)
    assert (weaker.limits[:2], controller.limits[:2]) == ((-0.85, 0.85), (-1.0, 1.0))
    last = shown.steps[0][1]
    assert reference._with(shown, weaker, generator, last).overshoot <= 0.05
    within = [(share, 1.0) for share in reference.SHARES]
    for other in reference._profiles(axis, 1.0, 1.0, [(4 * DT, 0.0), (0.4, 0.0)], within):
        assert reference._with(shown, controller, other, last).settling >= found.step.settling
    move = reference._duration(generator, 1.0)
    assert move > 2.0 * math.sqrt(1.0 / generator.a_max)
    assert found.step.settling >= 0.5 * move
    still = loop(reference=0.0, plant=AXIS)
    plain = reference.profile_for(still, controller, axis, 0.4, 1.0)
    assert plain.step is None
    assert 0.125 * plain.prefilter.v_max + 0.25 * plain.prefilter.a_max == pytest.approx(0.95)


def test_friction_brakes_where_it_takes_a_fifth_of_u_at_the_top_speed() -> None:
    """Speed and acceleration each need the room at most, and more of it together."""
    assert Axis(0.125, 0.25).beyond(1.0, 1.0) == reference.BEYOND
    assert Axis(0.125, 0.25).beyond(0.6, 1.0) == ()
    assert Axis(0.125, 0.25).beyond(0.7, 1.0) == reference.BEYOND
    assert Axis(0.0, 0.25).beyond(1.0, 1.0) == ()
    assert Axis(0.125, 0.0).beyond(1.0, 1.0) == ()
    assert Axis(0.125, 0.25).beyond(1.0, -0.1) == ()
    for beyond in reference.BEYOND:
        found = Axis(2.0, 0.25).profile(2.0, 0.5, 0.1, beyond)
        v, a = 2.0 * found.v_max, 0.25 * found.a_max
        assert max(v, a) <= 0.5
        assert 0.5 < v + a <= 0.5 * beyond
    plain = Axis(2.0, 0.25).profile(2.0, 0.5, 0.1)
    assert plain == Axis(2.0, 0.25).profile(2.0, 0.5, 0.1, 1.0)


def test_profiles_are_tried_from_the_quickest_on() -> None:
    """Three shares of the room, each with the ramps that are given."""
    axis, shares = Axis(0.125, 0.25), [(share, 1.0) for share in reference.SHARES]
    ramps = [(4 * DT, 0.0), (0.3, 0.1), (0.9, 0.0)]
    tried = [*reference._profiles(axis, 2.0, 0.5, ramps, shares)]
    times = [reference._duration(each, 2.0) for each in tried]
    assert times == sorted(times)
    assert len(tried) == 9
    found = sorted({round(each.a_max / each.j_max, 9) for each in tried})
    assert found == pytest.approx([4 * DT, 0.3, 0.9])
    rooms = sorted({round(0.125 * each.v_max + 0.25 * each.a_max, 9) for each in tried})
    assert rooms == pytest.approx([0.65 * 0.5, 0.8 * 0.5, 0.95 * 0.5])


def test_the_table_of_a_prefilter_has_its_numbers() -> None:
    """``reference-model`` and ``profile-generator``."""
    model = ql.controllers.ReferenceModel(3.0, 2)
    assert prefilter_table(model) == {"kind": "reference-model", "omega": 3.0, "order": 2}
    assert _described(model) == 'kind = "reference-model", omega = 3, order = 2'
    profile = ql.controllers.ProfileGenerator(1.0, 2.0, 3.0)
    assert prefilter_table(profile)["kind"] == "profile-generator"
    assert prefilter_table(profile)["a_max"] == 2.0
    assert "smoothing" not in prefilter_table(profile)
    assert prefilter_table(replace(profile, smoothing=0.5))["smoothing"] == 0.5
    step = StepFigures(1.0, 0.0, 0.03, 1.5, 0.02, 4.0, 0.0)
    lines = Judged(
        pi(), model, step, None, None, None, (Overload(1.4, 2.0, 0.1, 3.0, 1.0),), ("NOT so",)
    )
    assert str(lines).splitlines() == [
        "step of the reference by 1 at 0 s: overshoots by 3.0 %, settles within 2 % in 1.5 s, "
        'behind the [prefilter] kind = "reference-model", omega = 3, order = 2',
        "overload, a load of 1.4 times what u can hold: 1.4 for 2 s: back in 3 s",
        "NOT so",
    ]
    offered = Judged(pi(), None, step, None, model, step._replace(overshoot=0.05), (), ())
    assert str(offered).endswith(
        '; with a prefilter ([prefilter] kind = "reference-model", omega = 3, order = 2) it '
        "overshoots by 5.0 % and settles in 1.5 s"
    )
