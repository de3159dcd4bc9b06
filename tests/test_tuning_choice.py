"""What tune chooses, refuses and judges: the simplest structure, noise, references, limits of u, reports."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse
from quell.plants.linear import LinearPlant
from quell.tuning import Constraints, report
from quell.tuning.acceptance import Loop, axis_of, judge, time_constant
from quell.tuning.by_simulation import Build, LinearBounds, _around, _later
from quell.tuning.designs import (
    Task,
    _order,
    range_of_u,
    simplest,
    with_noise_bound,
    without_damping,
)
from quell.tuning.optimiser.loops import load_step
from quell.tuning.optimiser.requirements import Active, Pole
from quell.tuning.optimiser.search import limits
from quell.tuning.plants import as_list, given_plants, model_of, plant_set, with_known_noise
from quell.tuning.report import Design, impossible
from quell.tuning.tune import _by_model, _check_feedforward, _check_u_max, _inputs, _of_axis
from quell.tuning.written import Written

from .cases import cases

DT = 0.05
LAG = ([2.0], [1.0, 1.0])
AXIS = ([4.0], [1.0, 0.5, 0.0])


@cache
def tuned() -> ql.Tuned:
    """Return a lag with a PI controller."""
    return ql.tune(([1.0], [1.0, 1.0]), DT, structure="pi", compare=(), written=False,
                   objective="load", constraints=Constraints(m_ks=3.0))  # fmt: skip


def design(name: str, objective: float, **more: Any) -> Design:
    """Return a design with another name and objective."""
    return replace(tuned().design, name=name, objective=objective, **more)


# ---- which structure


def test_the_simplest_design_is_within_five_percent_of_the_best() -> None:
    """Of gains, which are to be large, and of areas, which are to be small."""
    gains = {"pi": design("pi", 1.0), "pid": design("pid", 1.9), "poles": design("poles", 1.99)}
    assert simplest(gains, "load").name == "pid"
    assert simplest(gains | {"poles": design("poles", 2.0)}, "load").name == "poles"
    areas = {"pi": design("pi", 2.0), "pid": design("pid", 1.04), "poles": design("poles", 1.0)}
    assert simplest(areas, "load-iae").name == "pid"
    assert simplest(areas | {"pi": design("pi", 1.04)}, "load-iae").name == "pi"


def test_a_design_that_keeps_the_damping_comes_before_all_that_do_not() -> None:
    """Unless none keeps it; without any controller it is one that says why."""
    ringing = design("pi", 9.0, undamped=True)
    calm = design("poles", 1.0)
    assert simplest({"pi": ringing, "poles": calm}, "load").name == "poles"
    assert simplest({"pi": ringing}, "load").name == "pi"
    none = impossible("pi", "why")
    assert simplest({"pi": none}, "load") is none
    assert simplest({"pi": none, "poles": calm}, "load") is calm


def test_structures_are_tuned_behind_those_that_they_start_at() -> None:
    """Poles of their own behind PI, PID and bandwidths; no PI controllers for high orders."""
    task = tuned().task
    assert _order(["poles"], task) == ["pi", "pid", "bandwidths", "poles"]
    assert _order(["pid", "pi"], task) == ["pi", "pid"]
    assert _order(["model-based-poles"], task) == ["model-based", "model-based-poles"]
    high = replace(task, order=4)
    assert _order(["poles"], high) == ["bandwidths", "poles"]
    assert _order(["poles", "pi"], high) == ["pi", "bandwidths", "poles"]


# ---- noise


def task(plant: Any, constraints: Constraints, limits: Any = None, dt: float = DT) -> Task:
    """Return a task for the load."""
    given = given_plants(plant, dt)
    plants = plant_set(given, dt)
    model = model_of(given, plants, constraints)
    inputs = load_step(plants)
    return Task(plants, model, constraints, "load", inputs, 1.0, None, limits or {})


def test_noise_of_y_and_limits_of_u_bound_the_deviation_of_u() -> None:
    """2 % of half the range, and a text; a share of one's own, and what is without effect."""
    bounds = Constraints(noise_std=0.01, noise_share=0.05)
    found, how = with_noise_bound(task(LAG, bounds, {"u_min": -1.0, "u_max": 3.0}))
    assert found.constraints.u_std == pytest.approx(0.05 * 2.0)
    assert found.constraints.noise_share == 0.02
    assert how == "std(u): 5 % of half the range of u, 2, for noise of 0.01 in y"
    with pytest.raises(ValueError, match="give u_min and u_max, too, or u_std"):
        with_noise_bound(task(LAG, bounds, {"u_min": -1.0}))
    with pytest.raises(ValueError, match="m_ks = 3: bounds what noise does to u"):
        with_noise_bound(task(LAG, replace(bounds, m_ks=3.0)))
    for given in (Constraints(m_ks=3.0), Constraints(noise_over_pi=None)):
        same = task(LAG, given)
        assert with_noise_bound(same) == (same, "")
    std = task(LAG, Constraints(u_std=0.1, noise_std=0.01))
    assert with_noise_bound(std) == (std, "")
    assert without_damping(same).constraints.damping is None
    assert without_damping(same).model.constraints.damping is None


def test_a_bound_of_noise_that_is_not_known_is_ten_times_that_of_a_pi_controller() -> None:
    """And says that it is a guess."""
    found, how = with_noise_bound(task(LAG, Constraints()))
    more, told = with_noise_bound(task(LAG, Constraints()), 1e6)
    assert more.constraints.m_ks == 1e6
    assert "so a guess: M_ks: that of the controller in use, 1e+06; give the limits" in told
    assert with_noise_bound(task(LAG, Constraints(m_ks=3.0)), 1e6)[1] == ""
    pi = ql.tune(LAG, DT, structure="pi-unfiltered", compare=(), written=False, objective="load",
                 constraints=Constraints(noise_over_pi=None))  # fmt: skip
    size = pi.design.measures["M_ks"]
    assert found.constraints.m_ks == pytest.approx(10.0 * size, rel=1e-4)
    assert how.startswith(
        "NOT known what noise does to u, so a guess: M_ks: 10 times that of the optimal PI "
        f"controller, {size:.3g}"[:-1]
    )


def test_the_noise_of_a_plant_is_known_by_its_encoder() -> None:
    """Between finite limits, unless something bounds it; noise of a scenario beside it."""
    seen = ql.plants.encoded(LinearPlant.of(LAG), 100, turn=1.0)
    none = Constraints()
    assert with_known_noise(none, seen, (-1.0, 1.0)).resolution == pytest.approx(0.01)
    assert with_known_noise(none, seen, (-1.0, math.inf)) is none
    assert with_known_noise(none, LinearPlant.of(LAG), (-1.0, 1.0)).noise == 0.0
    late = ql.plants.delayed(seen, 0.1, DT)
    assert with_known_noise(none, late, (-1.0, 1.0)).resolution == pytest.approx(0.01)
    both = with_known_noise(none, seen, (-1.0, 1.0), 0.02)
    assert (both.resolution, both.noise_std) == (pytest.approx(0.01), 0.02)
    assert both.noise == pytest.approx(math.hypot(0.02, 0.01 / math.sqrt(12.0)))
    for given in (
        Constraints(m_ks=2.0),
        Constraints(noise_over_pi=None),
        Constraints(noise_std=0.1),
    ):
        assert with_known_noise(given, seen, (-1.0, 1.0)) is given


def test_the_range_of_u_is_infinite_where_it_has_no_limit() -> None:
    """None is none, too."""
    assert range_of_u({}) == (-math.inf, math.inf)
    assert range_of_u({"u_min": -1.0, "u_max": None, "rate_limit": 3.0}) == (-1.0, math.inf)
    with pytest.raises(ValueError, match="u_min"):
        range_of_u({"u_min": 2.0, "u_max": 1.0})


# ---- plants


def test_one_plant_a_list_and_a_batch_are_lists_of_plants() -> None:
    """A tuple is one plant; a list of numbers is none."""
    assert as_list(LAG) == [LAG]
    assert as_list([LAG, AXIS]) == [LAG, AXIS]
    linear = LinearPlant.of(LAG)
    assert as_list(linear) == [linear]
    assert as_list([linear, linear]) == [linear, linear]
    numbers = [[1.0], [1.0, 1.0]]
    assert as_list(numbers) == [numbers]


@cases(
    ("plants", "options", "message"),
    [
        (([1.0, 0.0], [1.0, 2.0, 1.0]), {}, r"plant\[0\] has a zero at s = 0"),
        (
            [LAG, ([-2.0], [1.0, 1.0])],
            {},
            r"plant\[1\] has the other sign of the gain than plant\[0\]",
        ),
        (
            LAG,
            {"b_range": (1.2, 0.8)},
            "b_range = .*: must be two positive factors of b, low and high",
        ),
        (LAG, {"b_range": (0.0, 1.2)}, "b_range"),
    ],
)
def test_plants_that_no_controller_serves_are_named(
    plants: Any, options: Any, message: str
) -> None:
    """Integral action without effect, gains of both signs, factors in the wrong order."""
    with pytest.raises(ValueError, match=message):
        given_plants(plants, DT, **options)


def test_the_sign_of_the_gain_is_that_at_rest() -> None:
    """A zero in the right half plane turns it; factors of b make a set, the nominal one first."""
    assert given_plants(LAG, DT).sign == 1.0
    assert given_plants(([-1.0, 1.0], [1.0, 2.0, 1.0]), DT).sign == 1.0
    assert given_plants(([1.0, -1.0], [1.0, 2.0, 1.0]), DT).sign == -1.0
    given = given_plants(LAG, DT, b_range=(0.5, 3.0), delay=0.1)
    plants = plant_set(given, DT)
    assert plants.factors.tolist() == [1.0, 0.5, 3.0]
    assert given.delays.tolist() == [0.1]
    assert plant_set(given, DT, np.array([2.0])).factors.tolist() == [2.0]
    model = model_of(given, plants, Constraints())
    assert (model.sign, model.degree, model.b, model.delay) == (1.0, 1, 2.0, 0.1)
    P = plants.responses(model.omega * np.array([0.8, 1.25]))[0]
    assert model.gain == pytest.approx(float(np.sqrt(np.prod(np.abs(P)))))


# ---- references


def test_inputs_are_a_load_or_a_reference_with_its_feedforward() -> None:
    """Until a duration; a step of a reference for an axis has u_ff only where it moves."""
    plants = plant_set(given_plants(AXIS, DT), DT)
    load = _inputs("load", None, 3.0, 0.5, plants, None)
    assert (load.r.size, load.d[0], load.load, load.u_ff) == (60, 0.5, 0.5, None)
    assert not np.any(load.r)
    step = _inputs("tracking", ql.signals.Step(2.0, 1.0), 3.0, 1.0, plants, None)
    assert step.r.tolist() == [0.0] * 20 + [2.0] * 40
    assert not np.any(step.d)
    assert _inputs("tracking", 0.7, 3.0, 1.0, plants, None).r.tolist() == [0.7] * 60
    rigid = ql.Feedforward.rigid(0.25, viscous=0.125)
    ramp = ql.signals.Ramp(2.0)
    forward = _inputs("tracking", ramp, 3.0, 1.0, plants, rigid)
    assert forward.u_ff is not None
    np.testing.assert_allclose(
        forward.u_ff[5:], 0.25, atol=1e-9
    )  # viscous 0.125 times a speed of 2
    name, signal = forward.of_loop()[0]
    assert name == "n"
    np.testing.assert_allclose(signal, -forward.r)
    assert [each for each, _ in step.of_loop()] == ["r", "d"]
    for given, duration, message in (
        (None, 3.0, "objective = 'tracking' needs a signal to follow"),
        (ql.signals.Step(2.0, 9.0), 3.0, "is 0 for all of the 3 s that it is followed"),
        (0.7, 0.0, "duration = 0.0"),
    ):
        with pytest.raises(ValueError, match=message):
            _inputs("tracking", given, duration, 1.0, plants, None)
    with pytest.raises(ValueError, match="load = 0.0"):
        _inputs("load", None, None, 0.0, plants, None)
    with pytest.raises(ValueError, match=r"must be a signal of quell\.signals, whose derivatives"):
        _inputs("tracking", lambda t: np.ones(t.size), 3.0, 1.0, plants, rigid)


def test_a_bound_of_u_that_rest_itself_exceeds_is_not_possible() -> None:
    """A lag of gain 2 needs 0.5 for r = 1, and holds a load by as much."""
    plants = plant_set(given_plants(LAG, DT), DT)
    load = _inputs("load", None, 20.0, 0.5, plants, None)
    _check_u_max(0.6, load, plants)
    _check_u_max(None, load, plants)
    with pytest.raises(
        ValueError, match="u_max = 0.4: NOT possible .* step load = 0.5.*must be 0.5 there"
    ):
        _check_u_max(0.4, load, plants)
    step = _inputs("tracking", 1.0, 20.0, 1.0, plants, None)
    _check_u_max(0.51, step, plants)
    with pytest.raises(
        ValueError, match="the reference, which ends at 1, and at rest .* must be 0.5"
    ):
        _check_u_max(0.49, step, plants)


def test_a_feedforward_is_that_of_the_plant_with_the_delay_of_u() -> None:
    """Wanted, given, or none; an axis has one without asking, a lag has none."""
    linear = LinearPlant.of(AXIS)
    found = _by_model(True, linear, 0.1)
    assert found is not None
    assert found.coefficients == pytest.approx((0.0, 0.125, 0.25))
    assert found.delay == 0.1
    assert _by_model(None, linear, 0.1) is None
    assert _by_model(False, linear, 0.1) is None
    given = ql.Feedforward.rigid(2.0)
    assert _by_model(given, linear, 0.1) is given
    assert not _by_model(True, linear, 0.0).delay  # type: ignore[union-attr]
    own = _of_axis(given_plants(AXIS, DT, delay=0.1, actuator_lag=0.02), True, False)
    assert own is not None
    assert own.coefficients[1:3] == pytest.approx((0.125, 0.25))
    assert own.delay == pytest.approx(0.12)
    assert _of_axis(given_plants(LAG, DT), True, False) is None
    two_masses = ([2.0, 0.1, 50.0], [2.0, 0.3, 150.0, 0.0, 0.0])
    flat = _of_axis(given_plants(two_masses, DT), True, True)
    assert flat is not None
    assert flat.coefficients == pytest.approx((0.0, 0.0, 3.0, 0.006, 0.04))
    assert flat.numerator == pytest.approx((1.0, 0.002, 0.04))
    assert flat.derivatives == 4
    slow_zero = ([1.0, 1.0], [1.0, 0.2, 90.0, 0.0, 0.0])  # y would run far ahead of r
    rigid = _of_axis(given_plants(slow_zero, DT), True, True)
    assert rigid is not None
    assert (len(rigid.coefficients), rigid.numerator, rigid.derivatives) == (3, (1.0,), 3)
    with pytest.raises(
        ValueError, match="feedforward: pi, pid has none; give a structure that has"
    ):
        _check_feedforward(["pi", "pid"], True)
    _check_feedforward(["pi", "poles"], True)
    _check_feedforward(["p-pi-notch"], given)
    wrong = replace(ql.Feedforward.rigid(2.0, coulomb=0.1), coefficients=(1.0, 0.0, 2.0))
    with pytest.raises(ValueError, match=r"coulomb, coefficients\[0\] would have no effect"):
        _check_feedforward(["p-pi-notch"], wrong)


# ---- reports


def test_costs_are_told_against_pi_pid_and_the_best_of_all() -> None:
    """How many times, and which is better."""
    designs = {name: design(name, x) for name, x in (("pi", 2.0), ("pid", 1.0), ("poles", 0.8))}
    lines = report.costs(designs["poles"], designs, "load-iae")
    assert lines == [
        "poles has 0.4 times the ∫|y| (less is better) of the optimal PI controller under the same "
        "constraints",
        "poles has 0.8 times the ∫|y| (less is better) of the optimal PID controller under the same "
        "constraints",
        "poles is the best of those tried; next: pid has 1.25 times the ∫|y| (less is better) of it",
    ]
    assert report.costs(designs["pi"], designs, "load-iae")[-1] == (
        "pi has 2.5 times the ∫|y| (less is better) of poles, the best of those tried"
    )
    gains = report.costs(designs["pi"], designs, "load")
    assert gains[-1].startswith(
        "pi is the best of those tried; next: pid has 0.5 times the k_i (more"
    )
    assert report.relative(designs["pi"], designs["pid"], "load") == 2.0
    assert report.relative(designs["pi"], designs["pid"], "load-iae") == 0.5
    same = design("a", math.inf)
    assert report.relative(same, same, "load") == 1.0
    assert report.relative(designs["pi"], design("zero", 0.0), "load") == math.inf


def test_rows_have_the_figures_of_each_design_and_reasons() -> None:
    """Objective, the other figure, peaks, the delay margin; dashes without a controller."""
    one = tuned().design
    m = one.measures
    none = impossible("pid", "no controller")
    headings, (first, second) = report.rows({"pi": one, "pid": none}, "load")
    assert headings == ["structure", "k_i", "IAE", "M_s", "M_t", "M_ks", "delay margin"]
    assert first[:3] == ["pi", f"{one.objective:.4g}", f"{m['iae']:.3g}"]
    assert first[3:6] == [f"{m['M_s']:.3f}", f"{m['M_t']:.3f}", f"{m['M_ks']:.4g}"]
    assert first[7] == ""
    assert first[6].endswith(" ms")
    assert second == ["pid", *["–"] * 6, "no controller"]
    headings, (other,) = report.rows({"pi": one}, "load-iae")
    assert (headings[2], other[2]) == ("k_i", f"{one.k_i:.3g}")
    assert (report.quantity("load"), report.quantity("tracking")) == ("k_i", "RMS of r − y")
    assert report.quantity("mine") == "mine"


def test_rows_of_axes_have_their_objective_over_that_alone_and_no_empty_column() -> None:
    """Of what was measured only."""
    one = replace(tuned().design, measures={"M_s": 1.5, "alone": 0.5 * tuned().design.objective})
    headings, (row,) = report.rows({"x": one}, "load-iae")
    assert headings == ["structure", "∫|y|", "k_i", "M_s", "over that alone"]
    assert row[3:] == ["1.500", "2.000", ""]


def test_active_constraints_have_their_frequency_and_plant() -> None:
    """The plant where there are several; a NaN is no frequency."""
    at = Active("M_s", 1.6, 1.6, 12.345, 2)
    assert report.active_text(at, 3) == "M_s = 1.6 (limit 1.6) at 12.3 rad/s of plant 2"
    assert report.active_text(at, 1) == "M_s = 1.6 (limit 1.6) at 12.3 rad/s"
    assert report.active_text(at._replace(omega=math.nan), 3) == "M_s = 1.6 (limit 1.6)"
    lines = report.tradeoff_lines([("M_s", 1.44, 0.12345)], "load")
    assert lines == ["M_s 1.44: k_i 0.1235"]


def test_damping_is_said_of_the_loop_and_of_the_modes_of_the_plant() -> None:
    """With NOT where nothing bounds it and it rings, and where the bound is not kept."""
    poles = (Pole(-0.3 + 0.954j, 0, 0.4, False), Pole(-0.1 + 5.0j, 0, 0.01, True))
    both = design("pi", 1.0, least_damped=poles)
    line = "least damped pole of the loop: damping 0.3 at 1 rad/s; mode of the plant: damping 0.02 at 5 rad/s"
    assert report.damping_line(both, 0.4) == line
    assert report.damping_line(design("pi", 1.0, least_damped=()), 0.4) == (
        "no pole of the loop oscillates, but for those of a dead time"
    )
    measures = {**tuned().design.measures, "damping": 0.3}
    ringing = replace(both, measures=measures)
    assert report.damping_line(ringing, None) == (
        f"NOT damped: {line}: no plant has it; bound it by Constraints(damping=)"
    )
    assert report.damping_line(ringing, 0.2) == line
    assert report.damping_line(replace(both, undamped=True), 0.4).startswith(
        f"NOT damped: {line}: with the bound of damping no controller was found; take another"
    )


# ---- limits of u


def loop(
    written: Written, limits: tuple[float, float], plant: Any = LAG, shaped: bool = True
) -> Loop:
    """Return what is known of a loop."""
    given = given_plants(plant, DT)
    plants = plant_set(given, DT)
    model = model_of(given, plants, Constraints())
    return Loop(written, LinearPlant.of(plant), model, plants, limits, 0.0, shaped)


def test_a_loop_is_judged_in_its_file() -> None:
    """A step of 0.4 within ±1, and loads that u can't hold; without limits a prefilter is offered."""
    controller = ql.baselines.PID(kp=2.0, ki=2.5, dt=DT, u_min=-1.0, u_max=1.0)
    scenario = ql.Scenario(ql.signals.Step(0.4, 0.5), 5.0, (0.0,))
    written = Written(LinearPlant.of(LAG), scenario, DT)
    analysis = analyse(LAG, ql.baselines.PID(kp=2.0, ki=2.5, dt=DT))
    found = judge(loop(written, (-1.0, 1.0)), controller, analysis)
    assert found.failures == ()
    assert found.step is not None
    assert (found.step.size, found.step.at) == (0.4, 0.5)
    assert found.step.overshoot <= 0.05
    assert len(found.overloads) == 2
    assert all(each.passes for each in found.overloads)
    # u rests at 0.2, so 0.8 are left.
    assert found.overloads[0].load == pytest.approx(-1.4 * 0.8, rel=0.02)
    tau = time_constant(analysis, loop(written, (-1.0, 1.0)).plants)
    assert tau == pytest.approx(1.0 / analysis.margins.phase_omega)
    assert found.overloads[0].duration == pytest.approx(5.0 * tau)


def test_without_limits_of_u_a_prefilter_is_offered_for_a_step_that_overshoots() -> None:
    """It is not in the controller; with it the step overshoots by a twentieth."""
    controller = ql.baselines.PID(kp=0.5, ki=2.0, dt=DT)
    written = Written(LinearPlant.of(LAG), ql.Scenario(ql.signals.Step(1.0, 0.5), 8.0, (0.0,)), DT)
    analysis = analyse(LAG, controller)
    found = judge(loop(written, (-math.inf, math.inf)), controller, analysis)
    assert found.controller is controller
    assert found.prefilter is None
    assert found.step is not None
    assert found.step.overshoot > 0.2
    assert found.offered is not None
    assert found.offered_step is not None
    assert found.offered_step.overshoot == pytest.approx(0.05, abs=5e-3)
    assert found.overloads == ()
    assert '; with a prefilter ([prefilter] kind = "reference-model", omega = ' in str(found)


def test_an_axis_is_a_plant_that_rests_anywhere() -> None:
    """Its inertia and viscous friction, beside the gain at the bandwidth."""
    one = loop(Written(LinearPlant.of(AXIS), None, DT), (-1.0, 1.0), AXIS)
    found = axis_of(one.linear, 0.2, one.plants)
    assert found is not None
    assert (found.viscous, found.inertia) == (pytest.approx(0.125), pytest.approx(0.25))
    lag = loop(Written(LinearPlant.of(LAG), None, DT), (-1.0, 1.0))
    assert axis_of(lag.linear, 0.2, lag.plants) is None


# ---- tuning by simulation


def test_ranges_around_a_start_lie_within_the_bounds_of_the_structure() -> None:
    """From a value over the factor to the value times it; a start outside is named."""
    structure = tuned().design.solution.structure  # type: ignore[union-attr]
    low, high = (dict(zip(("K", "T_i", "T_f"), each, strict=True)) for each in limits(structure))
    values = {"K": 2.0, "T_i": 0.5, "T_f": low["T_f"] * 1.5}
    found = _around(structure, values, 4.0)
    assert (found["K"].low, found["K"].high) == (0.5, 8.0)
    assert (found["T_i"].low, found["T_i"].high) == (0.125, 2.0)
    assert found["T_f"].low == low["T_f"]
    assert found["T_f"].high == pytest.approx(min(6.0 * low["T_f"], high["T_f"]))
    with pytest.raises(ValueError, match="start: T_f = .*: must lie within"):
        _around(structure, {**values, "T_f": 0.5 * low["T_f"]}, 4.0)
    with pytest.raises(ValueError, match="start: T_i = nan"):
        _around(structure, {"K": 2.0, "T_f": values["T_f"]}, 4.0)
    made = Build(structure, {"u_max": 2.0})(values)
    assert (made.kp, made.ki) == (2.0, 4.0)
    assert made.step(100.0, 0.0) == 2.0


def test_bounds_of_linear_loops_are_a_logarithm() -> None:
    """Zero at the bound, infinite for an unstable loop, log 2 at half the bound."""
    own = tuned()
    exact = LinearBounds(own.plants, Constraints(m_ks=3.0))(own.controller)
    assert exact == pytest.approx(-1e-3, abs=2e-3)
    half = LinearBounds(own.plants, Constraints(m_ks=1.5))(own.controller)
    assert half == pytest.approx(math.log(2.0) - 1e-3, abs=2e-3)
    wild = ql.baselines.PID(kp=200.0, ki=5.0, dt=DT)
    assert LinearBounds(own.plants, Constraints(m_ks=3.0))(wild) == math.inf


def test_fresh_plants_have_seeds_of_their_own() -> None:
    """Of one scenario another seed; of several as many as there are plants, each another one."""
    one, two = ql.Scenario(1.0, 2.0, seed=3), ql.Scenario(1.0, 2.0, seed=10)
    later = _later(one, 5)
    assert later.seed > 3
    several = _later([one, two], 3)
    fresh = later.seed - 3
    assert [each.seed for each in several] == [3 + fresh, 10 + fresh + 1, 3 + fresh + 2]
