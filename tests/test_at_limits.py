"""Axes and single loops at the limits of their actuators; which model of a record is tuned for."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock, patch

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy import stats

import quell as ql
from quell.analysis import analyse
from quell.analysis.loop import LoopAnalysis
from quell.controllers.prefilters import Prefiltered, ReferenceModel
from quell.plants.linear import LinearPlant
from quell.tuning import Constraints, Interaction, acceptance, axes_at_limits, reference
from quell.tuning import plants as tuning_plants
from quell.tuning.acceptance import Loop, judge
from quell.tuning.axes import _made
from quell.tuning.optimiser.coupled import Found, Measured, Plant
from quell.tuning.plants import RecordModel, given_plants, model_of, plant_set, record_model
from quell.tuning.reference import Shaped, needs_none
from quell.tuning.written import Written

from .cases import cases

DT = 0.05
B0 = np.array([[1.0, 0.0], [0.3, 0.5]])
LAG = LinearPlant.of(([2.0], [1.0, 1.0]))


def machine() -> ql.plants.LinearPlant:
    """Return two lags that are coupled through their inputs."""
    return ql.plants.LinearPlant(-np.eye(2), B0, np.eye(2), np.array([[1.0, 0.0], [0.0, 2.0]]))


def axes(**limits: Any) -> ql.Axes:
    """Return axes of order 1 that know B0."""
    observer = ql.ESO.model_free(order=1, b0=1.0, omega_o=4.0, dt=DT)
    parts = {"x": ql.ADRC(observer, 2.0), "y": ql.ADRC(observer, 3.0)}
    return ql.Axes(parts, B0=B0, **limits)


# ---- axes


def test_loads_of_axes_are_held_by_the_u_that_leaves_y_at_zero() -> None:
    """B u = −E w for lags; what none of the actuators holds counts as zero."""
    held = axes_at_limits.held_loads(machine(), axes(), None)
    np.testing.assert_allclose(held, -np.linalg.solve(B0, np.diag([1.0, 2.0])), atol=1e-9)
    fewer = ql.plants.LinearPlant(-np.eye(2), np.array([[1.0], [0.0]]), np.eye(2), np.eye(2))
    with patch.object(axes_at_limits, "linear_part_of", lambda *_: (fewer, None)):
        held = axes_at_limits.held_loads(None, axes(), None)
    np.testing.assert_allclose(held, [[-1.0, 0.0]], atol=1e-9)


def test_steps_of_axes_use_two_fifths_of_the_room_of_an_actuator() -> None:
    """ω_c of the step in the first sample, or what holds it; 1 without limits."""
    a = math.exp(-DT)
    plant = Plant(a * np.eye(2), (1.0 - a) * B0, np.eye(2), np.linalg.inv(B0))
    found = axes_at_limits.step_sizes(plant, axes(u_min=[-1.0, -3.0], u_max=[1.0, 2.0]), 0.5, None)
    first = np.abs(np.linalg.inv(B0)) * [2.0, 3.0]
    held = np.abs(np.linalg.inv(B0))
    expected = np.min(0.4 * np.array([[1.0], [2.0]]) / np.maximum(first, held).clip(1e-300), axis=0)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    free = axes_at_limits.step_sizes(plant, axes(), 0.5, None)
    assert free.tolist() == [1.0, 1.0]
    one = axes_at_limits.step_sizes(
        plant, axes(u_min=[-math.inf, -1.0], u_max=[math.inf, 1.0]), 0.5, None
    )
    assert one[1] == pytest.approx(0.4 / first[1, 1])


def test_the_slowest_axis_has_the_time_constant_of_them_all() -> None:
    """Where its |S| first reaches 1/√2."""
    loop = analyse(machine(), axes())
    tau = axes_at_limits.time_constant(loop)
    omega = loop.omega[1:]
    S = np.abs(np.einsum("kii->ki", loop.response("S_o", omega)))
    first = [omega[np.flatnonzero(S[:, k] >= math.sqrt(0.5))[0]] for k in (0, 1)]
    assert tau == pytest.approx(1.0 / min(first))
    single = analyse(([1.0], [1.0, 1.0]), ql.ADRC(ql.ESO.model_free(1, 1.0, 4.0, DT), 2.0))
    at = np.abs(single.response("S", np.array([0.9 / tau, 1.02 / tau])))
    assert at[0] < math.sqrt(0.5) < at[1]


def test_a_file_of_axes_begins_at_rest_at_its_point() -> None:
    """Nothing happens in it; with a delay the states of u follow."""
    file = axes_at_limits.file_at(machine(), axes(), None)
    assert file.scenario.x0 is None
    assert file.dt == DT
    late = ql.plants.delayed_inputs(machine(), 2 * DT, DT)
    there = axes_at_limits.file_at(late, axes(), ([0.4, -0.2], [0.0, 0.0]))
    assert there.scenario.x0.tolist() == [0.4, -0.2] + [0.0] * (late.order - 2)
    assert there.scenario.reference == pytest.approx([0.4, -0.2])


def test_axes_become_slower_as_long_as_they_are_not_much_worse() -> None:
    """Both bandwidths or ω_c alone, by 0.85, 0.7 and 0.55; those of a worse rank are left out."""
    found = Found(np.array([[2.0, 4.0]]), Measured(0.0, np.array([1.0]), np.array([[0.1]]), True))

    def measured(values: np.ndarray) -> Measured:
        cost = float(2.0 * 4.0 / np.prod(values))
        slack = -0.1 if values[0, 1] == 4.0 * 0.7 else 0.1
        return Measured(0.0, np.array([cost]), np.array([[slack]]), True)

    slower = [*axes_at_limits.slower(found, SimpleNamespace(measured=measured))]  # type: ignore[arg-type]
    factors = [(each.values / found.values)[0].tolist() for each in slower]
    most = acceptance.WORSE
    expected = [[f, g] for f in (0.85, 0.7, 0.55) for g in (f, 1.0) if 1.0 / (f * g) <= most]
    np.testing.assert_allclose(factors, [each for each in expected if each != [0.7, 0.7]])
    assert axes_at_limits.least_gains([analyse(machine(), axes())]) == []


def test_the_sensitivities_of_axes_are_drawn_with_their_bound() -> None:
    """Those of the nominal plant by name, of others in grey; the largest singular value below."""
    loop = analyse(machine(), axes())
    result: Any = SimpleNamespace(loops=[loop, loop], names=("x", "y"))
    first, second = Interaction.plot(result, 1.7, list(Figure().subplots(2)))
    omega = loop.omega[1:]
    S = np.abs(np.einsum("kii->ki", loop.response("S_o", omega)))
    for k, line in enumerate(first.lines[2:4]):
        np.testing.assert_allclose(np.array(line.get_data()), [omega, S[:, k]])
    assert [line.get_label() for line in first.lines[2:]] == ["|S| of x", "|S| of y", "bound"]
    assert first.lines[0].get_color() == "0.8"
    assert float(first.lines[4].get_ydata()[0]) == 1.7
    np.testing.assert_allclose(
        second.lines[1].get_ydata(), loop.singular_values("S_o", omega)[:, 0]
    )
    assert second.lines[1].get_label() == "max σ(S)"
    assert second.get_xlabel() == "frequency [rad/s]"
    none: Any = SimpleNamespace(loops=[loop], names=("x", "y"))
    assert len(Interaction.plot(none, None, list(Figure().subplots(2)))[0].lines) == 2


def test_axes_are_judged_each_by_its_step_and_after_overloads() -> None:
    """Without events of its own the scenario gets a step for each axis, by two digits."""
    file = axes_at_limits.file_at(machine(), axes(), None)
    limited = axes(u_min=[-1.0, -1.0], u_max=[1.0, 1.0])
    held = np.zeros((2, 2))
    sizes, no_prefilter = np.array([0.1234, 0.2]), Mock(return_value=None)
    found = acceptance.judge_axes(file, limited, 0.1, held, sizes, no_prefilter)
    no_prefilter.assert_not_called()
    assert [each.name for each in found.others] == ["x", "y"]
    assert [each.step.size for each in found.others] == [0.12, 0.2]
    assert found.failures == ()
    assert found.overloads == ()
    assert (found.step, found.move, found.prefilter) == (None, None, None)
    for each in found.others:
        assert each.step.settling < 10.0
        assert each.step.overshoot < 0.05
        assert each.overloads == ()
        assert each.step.settlings is None
    noise = ql.signals.BandLimitedNoise(1e-8 * DT, DT)
    noisy = replace(file, scenario=replace(file.scenario, noise=noise))
    found = acceptance.judge_axes(noisy, limited, 0.1, held, sizes, no_prefilter)
    for each in found.others:
        assert each.step.settlings[0] <= each.step.settling <= each.step.settlings[1]


def test_axes_with_other_bandwidths_are_as_if_they_were_made_with_them() -> None:
    """Also what learners see of all axes; those that are given stay as they are."""

    def with_learners(*bandwidths: tuple[float, float]) -> ql.Axes:
        parts = [ql.ADRC(ql.ESO.model_free(1, 1.0, o, DT), c) for c, o in bandwidths]
        learners = [ql.learners.RLS(ql.features.AllAxes(ql.features.State())) for _ in parts]
        return ql.Axes(parts, B0=B0, learner=learners)

    values = np.array([[1.5, 7.0], [2.5, 5.0]])
    given, fresh = with_learners((2.0, 4.0), (3.0, 4.0)), with_learners((1.5, 7.0), (2.5, 5.0))
    made = _made(given, values)
    for mine, theirs, before in zip(made.axes, fresh.axes, given.axes, strict=True):
        assert (mine.omega_c, mine.observer.omega_o) == (theirs.omega_c, theirs.observer.omega_o)
        assert repr(mine.parameters.learner) == repr(theirs.parameters.learner)
        assert before.observer.omega_o == 4.0
        view = mine.learner.view
        assert [each.omega_o for each in view.observers] == [7.0, 5.0]


# ---- one loop


def loop_of(limits: Any = (-1.0, 1.0), shaped: bool = True, **scenario: Any) -> Loop:
    """Return the loop of a lag of gain 2 in a file."""
    plant = ([2.0], [1.0, 1.0])
    given = given_plants(plant, DT)
    plants = plant_set(given, DT)
    parts = {"reference": ql.signals.Step(at=0.5, height=0.5), "duration": 6.0, **scenario}
    file = Written(LAG, ql.Scenario(**parts), DT)
    return Loop(file, LAG, model_of(given, plants, Constraints()), plants, limits, 0.0, shaped)


def pi(kp: float = 1.0, ki: float = 1.0, **limits: float) -> Any:
    """Return a PI controller."""
    return ql.baselines.PID(kp=kp, ki=ki, dt=DT, **limits)


def of(controller: Any) -> LoopAnalysis:
    """Return its loop with the lag."""
    return analyse(([2.0], [1.0, 1.0]), controller)


def test_a_calm_step_is_judged_as_it_is() -> None:
    """No prefilter where it overshoots by 5 % at most; the time constant is that of the crossover."""
    controller = pi(u_min=-1.0, u_max=1.0)
    loop = loop_of(shaped=False)
    found = judge(loop, controller, of(controller))
    assert found.controller is controller
    assert (found.prefilter, found.offered, found.larger) == (None, None, None)
    assert found.step == loop.written.figures(controller, loop.written.run(controller))
    assert found.failures == ()
    assert [load.duration for load in found.overloads] == pytest.approx(
        [5.0 / of(controller).margins.phase_omega, 20.0 / of(controller).margins.phase_omega]
    )
    assert found.several == ""
    tau = acceptance.time_constant(of(controller), loop.plants)
    assert tau == pytest.approx(1.0 / of(controller).margins.phase_omega)
    slow = pi(1e-3, 1e-9)
    assert acceptance.time_constant(of(slow), loop.plants) == pytest.approx(
        1.0 / (of(slow).margins.phase_omega if of(slow).margins.phase_omega > 0.0
               and math.isfinite(of(slow).margins.phase_omega) else loop.plants.crossover)
    )  # fmt: skip


def test_a_step_that_overshoots_gets_a_reference_model_with_limits_and_an_offer_without() -> None:
    """In the file it stands before the controller; the offer is a line alone."""
    quick = pi(4.0, 20.0, u_min=-1.0, u_max=1.0)
    with patch.object(Written, "overloads", lambda *_: []):
        found = judge(loop_of(shaped=True, duration=3.0), quick, of(quick))
    assert isinstance(found.prefilter, ReferenceModel)
    assert isinstance(found.controller, Prefiltered)
    assert found.step is not None
    assert found.step.overshoot <= 0.05
    free = pi(4.0, 20.0)
    offer = judge(loop_of((-math.inf, math.inf), duration=3.0), free, of(free))
    assert offer.prefilter is None
    assert offer.controller is free
    assert isinstance(offer.offered, ReferenceModel)
    assert offer.offered_step is not None
    assert offer.offered_step.overshoot <= 0.05 + 1e-6
    assert offer.step is not None
    assert offer.step.overshoot > 0.05
    with patch.object(Written, "overloads", lambda *_: []):
        plain = judge(loop_of(shaped=False, duration=3.0), quick, of(quick))
    assert (plain.prefilter, plain.offered) == (None, None)


def test_a_process_that_overshoots_little_needs_no_prefilter() -> None:
    """Neither for its step nor for nearly the largest one; else u may stand at its limits."""
    calm, quick = (pi(1.0, ki, u_min=-1.0, u_max=1.0) for ki in (1.0, 20.0))
    loop = loop_of(duration=3.0)
    assert acceptance.quick_without(loop, calm, of(calm))
    assert not acceptance.quick_without(loop, quick, of(quick))
    assert not acceptance.quick_without(loop._replace(limits=(-1.0, math.inf)), calm, of(calm))
    assert not acceptance.quick_without(loop_of(reference=0.0), calm, of(calm))
    over = SimpleNamespace(overshoot=0.06, settling=1.0)
    well = SimpleNamespace(overshoot=0.05, settling=1.0)
    for steps, most, found in (
        ([over], 0.1, False),
        ([well], 0.1, True),
        ([well, over], 1.8, False),
        ([well, well], 1.8, True),
        ([SimpleNamespace(overshoot=0.0, settling=math.nan)], 0.1, False),
    ):
        with patch.object(reference, "worst_step", Mock(side_effect=steps)) as looked:
            assert needs_none(loop.written, calm, most, 0.1) == found
            assert looked.call_count == len(steps)
    for limits, within in (((-1.0, 1.0), False), ((-1.0, math.inf), True)):
        model = Mock(return_value=Shaped(None, None))
        with (
            patch.object(reference, "reference_model_for", model),
            patch.object(reference, "bounded_rate", lambda *_: (None, None)),
            patch.object(Written, "overloads", lambda *_: []),
        ):
            judge(loop._replace(limits=limits), quick, of(quick))
        assert model.call_args.kwargs == {"within": within}


def test_a_file_without_a_step_gets_one_that_uses_two_fifths_of_the_room() -> None:
    """0.4 of what u has, over what holds a step of 1; 1 without limits."""
    controller, wide = pi(u_min=-1.0, u_max=1.0), pi(u_min=-1.0, u_max=3.0)
    above = loop_of((-1.0, 3.0), False, reference=0.0)._replace(rest=0.5)
    free = loop_of((-math.inf, math.inf), False, reference=0.0)
    with (
        patch.object(Written, "overloads", lambda *_: []),
        patch.object(acceptance, "_LOOKED", 20.0),
    ):
        for loop, own, size in (
            (loop_of(shaped=False, reference=0.0), controller, 0.8),
            (above, wide, 1.2),
            (free, pi(), 1.0),
        ):
            found = judge(loop, own, of(own))
            assert found.step is not None
            assert found.step.size == pytest.approx(size)
            assert found.step.at == pytest.approx(10 * DT)


def test_an_axis_with_limits_gets_a_profile_generator() -> None:
    """For the heaviest of its plants, with the room that is left; a process does not."""
    asked = []

    def profile(
        written: Any, controller: Any, axis: Any, tau: float, room: float, period: float
    ) -> Shaped:
        asked.append((axis, tau, room, period))
        return Shaped(None, None)

    plant = ([4.0], [1.0, 0.5, 0.0])
    given = given_plants(plant, DT)
    plants = plant_set(given, DT)
    linear = LinearPlant.of(plant)
    file = Written(linear, ql.Scenario(ql.signals.Step(at=0.5, height=0.1), 2.0), DT)
    loop = Loop(
        file, linear, model_of(given, plants, Constraints()), plants, (-1.0, 2.0), 0.5, True
    )
    controller = ql.ADRC(ql.ESO.model_free(2, 4.0, 8.0, DT), 2.0, u_min=-1.0, u_max=2.0)
    analysis = analyse(plant, ql.ADRC(ql.ESO.model_free(2, 4.0, 8.0, DT), 2.0))
    with (
        patch.object(reference, "profile_for", profile),
        patch.object(Written, "overloads", lambda *_: []),
    ):
        judge(loop, controller, analysis)
        ((axis, tau, room, period),) = asked
        assert (axis.viscous, axis.inertia) == pytest.approx((0.125, 0.25))
        assert tau == pytest.approx(1.0 / analysis.margins.phase_omega)
        assert (room, period) == (1.5, 0.0)
        judge(loop._replace(shaped=False), controller, analysis)
        judge(loop._replace(limits=(-1.0, math.inf)), controller, analysis)
        lag = pi(u_min=-1.0, u_max=1.0)
        judge(loop_of(), lag, of(lag))
        assert len(asked) == 1


# ---- which model of a record


def model(order: int, fit: float = 90.0, fault: str = "", friction: Any = None, **more: Any) -> Any:
    """Return what stands for an identified model."""
    parts = {
        "faults": (fault,) if fault else (),
        "undecided": (),
        "fails": False,
        "converged": True,
        "rubs": friction is not None,
        "poles": (),
        "delay": 0.0,  # no lag of a larger model is in it
    }
    return SimpleNamespace(den=np.ones(order + 1), friction=friction, fit=fit, **{**parts, **more})


OTHER = model(5)


def taken(
    models: dict[tuple[int, bool], Any], order: int = 4, **how: Any
) -> tuple[RecordModel, list[Any]]:
    """Return the model that is taken, and the calls of ``identify``."""
    calls: list[Any] = []

    def identify(u: Any, y: Any, dt: float, poles: int, zeros: int, **options: Any) -> Any:
        calls.append((poles, zeros, options["friction"], options["delay"]))
        assert (u, y, dt) == ("u", "y", 0.1)
        if (poles, options["friction"]) not in models:
            raise ValueError("no such model")
        return models[poles, options["friction"]]

    record = SimpleNamespace(u="u", y="y", dt=0.1, signals=None)
    with (
        patch.object(tuning_plants, "identify", identify),
        patch.object(tuning_plants, "not_told_apart", lambda first, delay, **_: [first, OTHER]),
        patch.object(tuning_plants, "fits_better", lambda held, one: one.fit > held.fit + 1.0),
    ):
        return record_model(record, order, **how), calls  # type: ignore[arg-type]


def test_a_model_that_holds_is_taken_with_those_that_are_not_told_apart() -> None:
    """Of the order that is asked for; zeros as they are given, a delay from zero on."""
    good = model(4)
    found, calls = taken({(4, False): good}, zeros=2, max_delay=0.5)
    assert (found.model, found.others, found.larger) == (good, (OTHER,), None)
    assert calls == [(4, 2, False, (0.0, 0.5))]
    _, calls = taken({(4, False): good}, zeros=4)
    assert calls == [(4, 4, False, None)]


def test_another_model_that_samples_cannot_damp_is_told_and_not_tuned_for() -> None:
    """So it does not refuse the controller of a model that holds."""

    def fast(one: Any) -> str:
        return "its pair" if one is OTHER else ""

    with patch.object(tuning_plants, "_beyond_control", fast):
        found, _ = taken({(4, False): model(4)})
        assert (found.others, found.fast) == ((), (OTHER,))
        good = SimpleNamespace(describe=lambda: "a", held_from=4, y=np.zeros(5))
        told = RecordModel(good, (), None, fast=(OTHER,)).lines  # type: ignore[arg-type]
    assert told[1:] == [f"{OTHER!r} is not tuned for: its pair"]


def test_the_simplest_model_that_holds_is_taken_until_a_larger_one_fits_better() -> None:
    """Orders from 1 on, with friction where that is open; a failing one is told as the larger."""
    bad = model(4, fault="a fault")
    one, two, three = model(1, 80.0), model(2, 90.0), model(3, 90.5)
    found, calls = taken(
        {(4, False): bad, (1, False): one, (2, False): two, (3, False): three}, zeros=2
    )
    assert (found.model, found.others, found.larger) == (two, (), bad)
    assert [call[:3] for call in calls] == [
        (4, 2, False), (1, 0, False), (1, 0, True), (2, 1, True), (2, 1, False), (3, 2, False),
    ]  # fmt: skip
    found, calls = taken({(4, True): bad, (1, True): one}, friction=True)
    assert [call[0] for call in calls] == [4, 1, 2, 3]
    assert all(call[2] for call in calls)
    assert found.model is one
    none, _ = taken({(4, False): bad, (1, False): model(1, fault="b")})
    assert (none.model, none.others, none.larger) == (bad, (OTHER,), None)


@cases("reason", ["fails", "converged", "undecided"])
def test_a_model_holds_if_it_has_no_fault_and_is_decided(reason: str) -> None:
    """Worse than the mean, not converged, or without a gain: each is a reason."""
    more = {
        "fails": {"fails": True},
        "converged": {"converged": False},
        "undecided": {"undecided": ("no gain",)},
    }
    found, _ = taken({(4, False): model(4, **more[reason]), (1, False): model(1)})
    assert found.model.den.size == 2
    assert (
        tuning_plants._why_not(found.larger)
        == {
            "fails": "it is worse than the mean of y on samples that were not fitted",
            "converged": "its search did not converge",
            "undecided": "no gain",
        }[reason]
    )


def test_friction_on_a_speed_must_be_better_than_a_model_without() -> None:
    """Alone it may hide an offset; on a position it may be taken alone, unless it may be none."""
    bad, rubbing = model(4, fault="a"), model(1, 95.0, friction=0.1)
    found, _ = taken({(4, False): bad, (1, True): rubbing})
    assert found.model is bad
    found, _ = taken({(4, False): bad, (1, False): model(1, 80.0), (1, True): rubbing})
    assert found.model is rubbing
    found, _ = taken({(4, False): bad, (1, False): model(1, 94.5), (1, True): rubbing})
    assert found.model.friction is None
    found, _ = taken({(4, False): bad, (2, True): model(2, 95.0, friction=0.1)})
    assert found.model.friction == 0.1
    none = model(2, 95.0, friction=0.1, rubs=False)
    plain = model(2, 95.0)
    found, _ = taken({(4, False): bad, (2, True): none, (2, False): plain})
    assert found.model is plain


@cache
def _report(held_out: float | None) -> list[str]:
    good = SimpleNamespace(
        describe=lambda: "a\nb", held_from=5, y=np.zeros(5), fits={"estimation": 88.0}
    )
    bad = SimpleNamespace(den=np.ones(5), fits={"estimation": 97.5}, faults=("it rings",), undecided=(),
                          fails=False, converged=True)  # fmt: skip
    return RecordModel(good, ("M",), held_out, bad).lines  # type: ignore[arg-type]


def test_the_report_says_what_is_not_held_out_and_what_a_larger_model_lacks() -> None:
    """And which models the record does not tell apart."""
    assert _report(None) == [
        "a",
        "b",
        "nothing is held out: at the end of the record u does not move, or at other frequencies "
        "than before",
        "order 4 has a fit of 97.5 instead of 88.0 % (estimation), but does not hold: it rings",
        "the record does not tell it from 'M', which is tuned for, too",
    ]
    assert len(_report(0.0)) == 4


def test_the_plants_of_a_model_are_the_ends_of_an_ellipsoid_in_each_direction() -> None:
    """Of each coefficient, the gain and the delay, at 95 % of all together; what is open is refused."""
    P = np.array([[0.04, 0.01], [0.01, 0.09]])
    late = np.array([0.002, 0.003, 4e-4])
    found: Any = SimpleNamespace(
        num=np.array([3.0]), den=np.array([1.0, 2.0]), integrators=0, delay=0.1, covariance=P,
        delay_covariance=late, undecided=(), plant=None,
    )  # fmt: skip
    other: Any = SimpleNamespace(num=np.array([5.0]), den=np.array([1.0, 4.0]), delay=0.7)
    plants, delays = tuning_plants.identified_plants(found, [other])
    whole = np.block([[P, late[:2, None]], [late[None, :2], late[2:, None]]])
    k = math.sqrt(stats.chi2.ppf(0.95, 3))
    theta = np.array([2.0, 3.0, 0.1])
    points = [theta]
    for c in (*np.eye(3), np.array([-3.0 / 4.0, 0.5, 0.0])):
        step = k * whole @ c / math.sqrt(c @ whole @ c)
        points += [theta + step, theta - step]
    assert len(plants) == len(delays) == 10
    for (num, den), delay, point in zip(plants, delays, points, strict=False):
        assert (float(den[1]), float(num[0]), delay) == pytest.approx(
            (point[0], point[1], max(point[2], 0.0))
        )
    assert (plants[-1], delays[-1]) == ((other.num, other.den), 0.7)
    for change, message in (
        ({"undecided": ("a", "b")}, "^found: a; b$"),
        (
            {"covariance": np.full((2, 2), np.nan)},
            "found: its deviations are not finite; identify with",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            tuning_plants.identified_plants(SimpleNamespace(**{**vars(found), **change}))  # type: ignore[arg-type]
