"""Tuned loops as they are written: what a report says is what the file does, at the limits of u."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.baselines import PID
from quell.controllers.prefilters import Prefiltered
from quell.controllers.shaping import ProfileGenerator
from quell.plants.linear import LaggedPlant
from quell.setup import load
from quell.setup.loading import tuning_task
from quell.tuning.acceptance import (
    Judged,
    Loop,
    accepted,
    conditionally_stable,
    judge,
    judge_axes,
    place_of,
    with_others,
)
from quell.tuning.axes_at_limits import held_loads
from quell.tuning.plants import given_plants, plant_set
from quell.tuning.reference import Axis, _profiles
from quell.tuning.tables import late_tables
from quell.tuning.written import StepFigures, Written

MOTOR = ([50.0], [1.0, 4.0, 0.0])
DT = 1e-3
SETUP = """dt = 0.001
[plant]
kind = "linear"
num = [50.0]
den = [1.0, 4.0, 0.0]
[controller]
u_min = -10.0
u_max = 10.0
[scenario]
duration = 0.8
reference = {{ kind = "step", height = 0.5, at = 0.1 }}
disturbances = [{{ kind = "step", height = 3.0, at = 0.5 }}]
noise = {{ kind = "noise", power = 1e-10, sample_time = 0.001 }}
[tune]
structure = "{structure}"
compare = []
{more}
"""


def tuned(path: Path, structure: str = "bandwidths", more: str = "") -> Any:
    """Return the result for the setup."""
    path.write_text(SETUP.format(structure=structure, more=more), encoding="utf-8")
    task = tuning_task(path)
    return ql.tune(task.plant, task.dt, **task.options)


@pytest.mark.trial
@pytest.mark.parametrize(
    ("structure", "more"),
    [("bandwidths", ""), ("pid", ""), ("p-pi-notch", ""), ("bandwidths", "actuator_lag = 0.004")],
)
def test_the_step_that_is_printed_is_that_of_the_file(
    tmp_path: Path, structure: str, more: str
) -> None:
    """The file is loaded and run: overshoot and settling time are those of the report, to rounding, with prefilter, limits, noise and the lag of the actuator."""
    found = tuned(tmp_path / "motor.toml", structure, more)
    found.save(tmp_path / "tuned.toml")
    setup = load(tmp_path / "tuned.toml")
    assert repr(setup.controller) == repr(found.controller)
    run = ql.simulate(setup.plant, setup.controller, setup.scenario)
    step = found.reference_step
    measures = run.metrics(0.1, 0.5, band=step.band)
    assert (step.size, step.at) == (0.5, pytest.approx(0.1))
    assert measures["overshoot"] == pytest.approx(step.overshoot, abs=1e-9)
    assert measures["settling_time"] == pytest.approx(step.settling, abs=1e-9)
    assert str(step) in found.toml()
    if more:
        assert setup.plant.order == 3
        assert "actuator_lag" not in setup.tune


@pytest.mark.trial
@pytest.mark.parametrize("structure", ["bandwidths", "pid"])
def test_a_step_of_an_axis_overshoots_little_at_the_limits(tmp_path: Path, structure: str) -> None:
    """By 5 % at most, without u at a limit for long; with feedforward within 1.3 times the fastest move, 2 √(h/(b u_max))."""
    found = tuned(tmp_path / "motor.toml", structure)
    step = found.reference_step
    assert step.overshoot <= 0.05
    assert step.limited <= 0.005
    assert not found.judged.failures
    if structure == "bandwidths":
        assert step.settling <= 1.3 * 2.0 * math.sqrt(0.5 / 500.0)


@pytest.mark.trial
def test_a_flexible_axis_moves_nearly_as_fast_as_a_rigid_one() -> None:
    """Encoder at the motor, a mode of 51 Hz, a step of 2.7 periods at full torque: within 1.3 times the fastest move; a thirtieth of it overshoots by 5 % at most, too."""
    motor, load, k, c = 5.5e-5, 1.15e-4, 3.8, 7e-4
    both = motor + load
    num = [load / (motor * load), c / (motor * load), k / (motor * load)]
    den = [1.0, c * both / (motor * load), k * both / (motor * load), 0.0, 0.0]
    size, dt = 5.3, 2.5e-4
    scenario = ql.Scenario(ql.signals.Step(size, 0.01), duration=0.4, disturbances=(0.0,))
    plant = ql.plants.delayed(ql.plants.LinearPlant.of((num, den)), dt, dt)
    found = ql.tune(
        (num, den),
        dt,
        delay=dt,
        structure="reduced",
        compare=(),
        constraints=ql.tuning.Constraints(noise_std=6e-5),
        written=Written(plant, scenario, dt),
        u_min=-1.31,
        u_max=1.31,
    )
    assert len(found.controller.controller.feedforward.numerator) == 3
    assert found.controller.prefilter.smoothing > 0.0
    step = found.reference_step
    assert step.settling <= 1.3 * 2.0 * math.sqrt(size * both / 1.31)
    assert step.overshoot <= 0.05
    assert not found.judged.failures
    small = Written(plant, replace(scenario, reference=ql.signals.Step(size / 30.0, 0.01)), dt)
    figures = small.figures(found.controller, small.run(found.controller))
    assert figures is not None
    assert figures.overshoot <= 0.05


@pytest.mark.trial
def test_the_noise_of_a_setup_bounds_the_loop(tmp_path: Path) -> None:
    """That of its scenario, 3.2e-4 in a sample, with the limits of u: nothing is guessed."""
    found = tuned(tmp_path / "motor.toml")
    assert found.constraints.noise == pytest.approx(math.sqrt(1e-10 / DT), rel=0.1)
    assert found.noise_bound.startswith("std(u): 2 % of half the range of u, 10")


@pytest.mark.trial
def test_where_no_noise_is_known_the_bound_is_called_a_guess() -> None:
    """By a line that begins with NOT and says what to give."""
    found = ql.tune(([1.0], [1.0, 1.0]), 0.05, structure="pi", compare=())
    assert found.noise_bound.startswith("NOT known what noise does to u, so a guess")


def written(scenario: ql.Scenario) -> Written:
    """Return the motor, 30 ms late, in a scenario."""
    plant = ql.plants.delayed(ql.plants.LinearPlant.of(MOTOR), 0.03, DT)
    return Written(plant, scenario, DT)


def cascade(gain: float) -> PID:
    """Return a controller of the motor, which is well damped with a gain of 1."""
    return PID(kp=1.0 * gain, ki=0.0, kd=0.15 * gain, tf=2e-3, dt=DT, u_min=-10.0, u_max=10.0)


def test_a_loop_that_cycles_between_the_limits_is_seen() -> None:
    """A gain with which the linear loop is unstable: u goes from limit to limit, and the step never settles; with a lower gain it does."""
    file = written(ql.Scenario(reference=ql.signals.Step(0.5, 0.01), duration=2.0))
    for gain, fails in ((1.0, False), (40.0, True)):
        controller = cascade(gain)
        run = file.run(controller)
        figures = file.figures(controller, run)
        assert figures is not None
        assert file.cycles(controller, run) is fails
        assert str(figures).startswith("NOT settled" if fails else "step of the reference by 0.5")


def test_the_largest_step_is_looked_at_up_to_the_next_event() -> None:
    """Of two steps and a load between them; a reference that moves has none."""
    steps = ql.signals.Step(0.2, 0.1) + ql.signals.Step(-0.6, 0.3)
    file = written(
        ql.Scenario(reference=steps, duration=0.9, disturbances=[ql.signals.Step(1.0, 0.5)])
    )
    assert file.largest == (300, 500, pytest.approx(-0.6))
    moving = written(ql.Scenario(reference=ql.signals.Sinusoid(1.0, 2.0), duration=0.2))
    assert moving.largest is None
    assert moving.stepping(0.3, 0.2, 10).largest == (10, 211, pytest.approx(0.3))


def test_the_band_grows_with_the_noise_and_says_so() -> None:
    """2 % and three standard deviations; a small one changes no digit."""
    figures = StepFigures(0.3, 0.5, 0.021, 0.093, 0.0201, 1.0, 0.0)
    text = (
        "step of the reference by 0.3 at 0.5 s: overshoots by 2.1 %, settles within 2 % in 0.093 s"
    )
    assert str(figures) == text
    assert "within 5 % (with three deviations of the noise)" in str(figures._replace(band=0.05))
    assert str(figures._replace(settling=math.nan)).startswith("NOT settled: step of the")
    assert str(figures._replace(overshoot=math.inf)).startswith("NOT stable: step of the")


@pytest.mark.parametrize("viscous", [0.0, 0.08])
def test_a_profile_keeps_to_the_room_for_u(viscous: float) -> None:
    """|c_1 v + c_2 a| along its move, also of one ten times as long, is what it may be at most."""
    axis = Axis(viscous, 0.02)
    profile = axis.profile(0.5, 8.0, 0.01)
    for size in (0.05, 0.5, 5.0):
        move = ql.signals.LimitedMove(size, profile.v_max, profile.a_max, profile.j_max)
        t, speed = np.linspace(0.0, move.duration, 2000), move.derivative()
        u = viscous * speed(t) + 0.02 * speed.derivative()(t)
        assert np.max(np.abs(u)) <= 8.0 * (1.0 + 1e-9)
    assert profile.a_max / profile.j_max == pytest.approx(0.01)


def test_an_overload_lasts_as_long_as_it_says() -> None:
    """An integrator runs away at what u lacks of the load; then it comes back as slowly as u lets it."""
    dt = 5e-3
    file = Written(
        ql.plants.LinearPlant.of(([1.0], [1.0, 0.0])), ql.Scenario(0.0, duration=1.0), dt
    )
    controller = PID(kp=10.0, dt=dt, u_min=-1.0, u_max=1.0)
    short, long = file.overloads(controller, None, 0.1, -1.0)
    assert (short.load, long.load) == (-1.4, -1.4)
    assert (short.duration, long.duration) == pytest.approx((0.5, 2.0))
    assert long.peak - short.peak == pytest.approx(0.4 * 1.5, rel=1e-3)
    # Until u leaves its limit at an error of 0.1 y comes back at a rate of 1, then with 1/kp.
    for each in (short, long):
        after = 0.1 * math.log(0.1 / (0.02 * each.peak))
        assert each.back == pytest.approx(each.peak - 0.1 + after, abs=2.0 * dt)
        assert each.passes


def test_profiles_ramp_the_acceleration_in_given_times() -> None:
    """Each with each share of the room; quick ones come first, with the time of their smoothing."""
    tried = [(0.004, 0.0), (0.03, 0.01), (0.09, 0.0)]
    found = list(_profiles(Axis(0.0, 0.02), 0.5, 8.0, tried, [(0.95, 1.0), (0.65, 1.0)]))
    ramps = {(round(each.a_max / each.j_max, 9), each.smoothing) for each in found}
    assert ramps == set(tried)
    moves = [ql.signals.LimitedMove(0.5, each.v_max, each.a_max, each.j_max) for each in found]
    times = [move.duration + each.smoothing for move, each in zip(moves, found, strict=True)]
    assert times == sorted(times)
    rigid = 2.0 * math.sqrt(0.5 * 0.02 / 8.0)
    assert rigid < times[0] < 1.1 * rigid


def test_a_lag_of_the_actuator_stands_before_the_delay_in_a_file() -> None:
    """Its state comes behind those of the plant; ranges and points keep their place."""
    plant = ql.plants.delayed(ql.plants.LinearPlant.of(MOTOR), 2e-3, DT)
    inner = {"kind": "linear", "num": [50.0], "den": [1.0, 4.0, 0.0], "uncertain": {"num": [1, 2]}}
    tables = {
        "plant": {"kind": "delayed", "delay": 2e-3, "plant": inner},
        "scenario": {"x0": [1.0, 2.0, 3.0, 4.0]},
    }
    found = late_tables(tables, plant, DT, 1e-3, 0.01)
    assert found["plant"]["kind"] == "delayed"
    assert found["plant"]["plant"]["kind"] == "lagged"
    assert found["scenario"]["x0"] == [1.0, 2.0, 0.0, 3.0, 4.0, 0.0]
    late = ql.plants.lagged(plant, 0.01)
    assert isinstance(late, type(plant))
    assert late.plant.A[2, 2] == pytest.approx(-100.0)


def test_a_plant_that_is_not_linear_gets_the_mean_of_the_lag() -> None:
    """Beside the exact lag of the same plant the error is of the second order in dt."""
    linear, scenario = ql.plants.LinearPlant.of(([1.0], [1.0, 1.0])), ql.Scenario(1.0, duration=0.5)
    errors = []
    for dt in (0.01, 0.005):
        controller = PID(kp=2.0, dt=dt)
        exact = ql.simulate(ql.plants.lagged(linear, 0.05), controller, scenario)["y"]
        mean = ql.simulate(LaggedPlant(linear, 0.05), controller, scenario)["y"]
        errors.append(float(np.max(np.abs(mean - exact))))
    assert errors[1] < 0.35 * errors[0] < 0.35 * 2e-3


def test_a_wrapper_has_the_numbers_of_its_controller() -> None:
    """As kp of a PID behind a profile generator; objects and methods stay inside."""
    shaped = Prefiltered(cascade(1.0), ProfileGenerator(1.0, 10.0, 100.0))
    assert shaped.kp == 1.0
    with pytest.raises(AttributeError, match="no attribute 'polynomials'"):
        _ = shaped.polynomials


@pytest.mark.trial
def test_a_design_that_fails_at_the_limits_gives_a_line_with_not() -> None:
    """A loop that is unstable as soon as u is limited, beside one that is accepted."""
    found = ql.tune(MOTOR, DT, structure="bandwidths", compare=(), u_min=-10.0, u_max=10.0)
    assert isinstance(found.loop, Loop)
    assert not found.judged.failures
    assert found.judged.overloads
    late = found.loop.written.plant, found.loop.written.scenario
    file = Written(ql.plants.delayed(late[0], 0.03, DT), late[1], DT)
    bad = judge(found.loop._replace(shaped=False, written=file), cascade(40.0), found.analysis)
    assert bad.failures[0].startswith("NOT settled")


def test_the_plants_of_a_set_are_looked_at_those_of_the_ends_first() -> None:
    """Gain and phase at the crossover, at most eight; each in the scenario of the file."""
    plants = [([50.0 * gain], [1.0, 4.0, 0.0]) for gain in (1.0, *np.linspace(0.5, 2.0, 30))]
    linear = [ql.plants.LinearPlant.of(each) for each in plants]
    of = plant_set(given_plants(plants, DT), DT)
    file = written(ql.Scenario(reference=ql.signals.Step(0.5, 0.01), duration=0.3))
    found = with_others(file, linear, [(0.0, 0.03)] * len(plants), of)
    parts = [each.linear for each in found.others if each.linear is not None]
    gains = [float((each.C @ each.A @ each.B)[0, 0]) for each in parts]
    assert len(gains) == 8
    assert {25.0, 100.0} <= {round(gain, 9) for gain in gains[:4]}
    assert all(each.plant.order == file.plant.order for each in found.others)
    alone = with_others(file, linear[:1], [(0.0, 0.0)], plant_set(given_plants(plants[:1], DT), DT))
    assert alone is file


def test_another_plant_starts_at_rest_where_that_of_the_file_does() -> None:
    """With the state and the u that hold y there under the scenario's load: nothing moves."""
    lag = ql.plants.LinearPlant.of(([2.0], [3.0, 1.0]))
    file = Written(
        lag, ql.Scenario(20.0, duration=0.5, x0=[20.0 / lag.C[0, 0]], disturbances=[-1.0]), 0.01
    )
    place = place_of(
        file, ql.plants.LinearPlant.of(([4.0], [3.0, 1.0])), (0.05, 0.03), "half", at=()
    )
    assert place.start == pytest.approx(20.0)
    x, waiting = place.scenario.x0[0], place.scenario.x0[1:]
    assert place.linear is not None
    assert place.linear.A[0, 0] * x + place.linear.B[0, 0] * (waiting[0] - 1.0) == pytest.approx(0)
    assert waiting == [waiting[0]] * (place.plant.order - 1)


@pytest.mark.trial
def test_a_plant_of_the_set_that_cycles_is_named() -> None:
    """The file's plant settles; one of four times its gain goes from limit to limit."""
    step = ql.Scenario(reference=ql.signals.Step(0.2, 0.01), duration=0.9)
    plant, more = ql.plants.LinearPlant.of(MOTOR), ql.plants.LinearPlant.of(([400.0], [1, 4, 0.0]))
    of = plant_set(given_plants([MOTOR, ([400.0], [1.0, 4.0, 0.0])], DT, delay=0.03), DT)
    file = with_others(written(step), [plant, more], [(0.0, 0.03)] * 2, of)
    loop = Loop(file, plant, None, of, (-10.0, 10.0), 0.0, False)
    controller = cascade(1.0)
    found = judge(loop, controller, ql.analysis.analyse(MOTOR, controller, delay=0.03))
    assert found.step is not None
    assert found.step.settling > 0.0
    (failure,) = found.failures
    assert failure.startswith("NOT settled")
    assert failure.endswith("(plant 2 of the set)")
    assert "with 1 other plants of the set of 2, linear: overshoots by" in str(found)


def test_the_first_design_that_passes_takes_the_place_of_one_that_fails() -> None:
    """And the text says which is left out; where none passes it stays."""
    rest = None, None, None, None, None, ()
    verdicts = {name: Judged(None, *rest, fails) for name, fails in (("a", ("NOT",)), ("b", ()))}  # type: ignore[arg-type]
    assert accepted("a", "b", verdicts.__getitem__, "a")[::2] == ("b", "a is left out: NOT")
    assert accepted("a", "a", verdicts.__getitem__, "a")[::2] == ("a", "")
    assert accepted("b", "a", verdicts.__getitem__, "b")[0] == "b"


def test_the_least_gain_is_that_of_all_loops() -> None:
    """Of loops that bear 0.2 and 0.3 of their gain it is 0.3; a loop that needs none has no line."""
    (line,) = conditionally_stable([(0.2, 4.0), (0.3, 5.0)])
    assert line == "conditionally stable: it bears 0.3 to 4 times its gain"
    assert conditionally_stable([(0.0, 4.0), (0.0, math.inf)]) == []


@pytest.mark.trial
def test_axes_that_do_not_notice_each_other_are_judged_as_single_loops() -> None:
    """Two different integrators: steps and overloads of each are those of a loop of its own, to rounding."""
    dt, gains, limits = 5e-3, (1.0, 3.0), (1.0, 2.0)
    single, scenarios = [], []
    for b, most, size in zip(gains, limits, (0.3, 0.8), strict=True):
        observer = ql.ESO.model_free(order=1, b0=b, omega_o=40.0, dt=dt)
        single.append(ql.ADRC(observer, 10.0, u_min=-most, u_max=most))
        scenarios.append(ql.Scenario(ql.signals.Step(size, 0.1), duration=3.0))
    free = [ql.ADRC(ql.ESO.model_free(1, 1.0, 40.0, dt), 10.0) for _ in gains]
    both = ql.Axes(free, B0=np.diag(gains), u_min=[-1.0, -2.0], u_max=[1.0, 2.0])
    plant = ql.plants.LinearPlant(np.zeros((2, 2)), np.diag(gains), np.eye(2))
    file = Written(
        plant,
        ql.Scenario([each.reference for each in scenarios], duration=3.0),
        dt,  # type: ignore[misc]
    )
    held = held_loads(plant, both, None)
    found = judge_axes(file, both, 0.1, held, np.ones(2), lambda *_: None)
    assert not found.failures
    for i, (b, own, scenario) in enumerate(zip(gains, single, scenarios, strict=True)):
        alone = Written(ql.plants.LinearPlant.of(([b], [1.0, 0.0])), scenario, dt)
        step = alone.figures(own, alone.run(own))
        theirs = found.others[i].step
        assert step is not None
        assert theirs is not None
        assert theirs.overshoot == pytest.approx(step.overshoot, abs=1e-9)
        assert theirs.settling == pytest.approx(step.settling)
        assert theirs.limited >= step.limited - 1e-9  # that of any actuator
        calm = alone.stepping(0.0, 1.0, 10)
        loads = calm.overloads(own, None, 0.1, -1.0)
        mine = [each for each in found.overloads if each.name == f"disturbance {i + 1}"]
        for each, other in zip(mine, loads, strict=True):
            assert each[:5] == pytest.approx(other[:5], rel=1e-6)


@pytest.mark.trial
def test_structures_that_feed_nothing_forward_are_compared_at_limits() -> None:
    """An axis has feedforward by default; where no structure of the list has any it has none."""
    found = ql.tune(MOTOR, DT, compare=("pid",), u_min=-10.0, u_max=10.0, b_range=(0.7, 1.4))
    assert found.design.name == "pid"
    assert found.judged.others
    assert "other plants of the set of 3, linear" in str(found.judged)
