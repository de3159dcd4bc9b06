"""What every controller does, whatever it is made of."""

from __future__ import annotations

import copy
import inspect
import math
import pickle
from typing import Any

import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys

import quell as ql
from quell import controllers as room
from quell.analysis.linearise import linear_law
from quell.controllers import baselines as baseline_room
from quell.controllers.base import bumpless_transfer
from quell.controllers.law import known_now
from quell.controllers.schedule import control_as_observed
from quell.controllers.stateful import named_arrays
from quell.observers.forms import acting_control, expected_measurement
from quell.tuning.optimiser.loops import law_of
from tests.cases import cases

from .test_contracts import CHAIN, SCENARIO, check_run

DT = 0.01
ESO = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=DT)
LIMITS = {"u_min": -2.0, "u_max": 3.0, "rate_limit": 60.0}

PID = baseline_room.PID(4.0, 2.0, 1.0, tf=0.05, dt=DT, **LIMITS)
CONTROLLERS: dict[str, Any] = {
    "ADRC": ql.ADRC(ESO, 1.5, **LIMITS),
    "ADRC, Han's law": ql.ADRC(
        ESO, 1.5, feedback=room.NonlinearFeedback((0.75, 1.25), 0.05), **LIMITS
    ),
    "LinearController": room.LinearController.from_transfer_function(
        [2.0, 3.0], [1.0, 0.0], dt=DT, **LIMITS
    ),
    "PID": PID,
    "NotchPID": baseline_room.NotchPID(baseline_room.Notch.at(9.0), 2.0, 1.0, dt=DT, **LIMITS),
    "PPI": baseline_room.PPI(
        2.0,
        1.5,
        0.8,
        tf=0.05,
        notches=[baseline_room.Notch.at(9.0)],
        inertia=0.5,
        viscous=0.1,
        dt=DT,
        **LIMITS,
    ),
    "LQG": baseline_room.LQG(CHAIN, 3.0, 12.0, DT, **LIMITS),
    "AdaptiveNotch": baseline_room.AdaptiveNotch(
        CHAIN, 3.0, 12.0, DT, count=2, band=(0.5, 5.0), listening=2.0, frequencies=(2.0,), **LIMITS
    ),
    "ResonanceRatio": baseline_room.ResonanceRatio(omega_o=5.0, dt=DT, **LIMITS),
    "Prefiltered": room.Prefiltered(PID, baseline_room.ZVD(3.0, 0.1)),
    "Prefiltered, Han's": room.Prefiltered(
        ql.ADRC(ESO, 1.5, feedforward=True, **LIMITS), room.TrackingDifferentiator(2.0)
    ),
    "Prefiltered feedforward": room.Prefiltered(
        ql.ADRC(ESO, 1.5, feedforward=True, **LIMITS), room.ReferenceModel(3.0)
    ),
    "Prefiltered feedforward by a model": room.Prefiltered(
        ql.ADRC(ESO, 1.5, feedforward=ql.Feedforward((0.3, 0.1, 0.7), 0.2, 0.5, -0.1), **LIMITS),
        room.ReferenceModel(3.0, order=3),
    ),
    "Prefiltered, moves": room.Prefiltered(
        ql.ADRC(ESO, 1.5, feedforward=True, **LIMITS), room.ProfileGenerator(0.5, 2.0, 5.0)
    ),
    "ADRC with a safe set": ql.ADRC(
        ESO, 1.5, safe_set=ql.SafeSet(-0.9, 0.9, -3.0, 3.0, alpha=4.0, f_rate=0.1), **LIMITS
    ),
    "ADRC with held": ql.ADRC(ESO, 1.5, held=ql.HeldPlant(), **LIMITS),
    "ADRC with a schedule": ql.ADRC(
        ESO,
        1.5,
        schedule=ql.Schedule(
            (-0.5, 0.0, 0.7), "reference", (0.7, 1.5, 3.0), (1.0, 1.5, 3.0), (9, 12, 20)
        ),
        **LIMITS,
    ),
    "ADRC with a schedule, a learner and a guard": ql.ADRC(
        ESO,
        1.5,
        learner=ql.learners.Kalman(u=True),
        guard=ql.Guard(),
        schedule=ql.Schedule((-0.5, 0.7), "y", (0.7, 3.0)),
        **LIMITS,
    ),
    "ADRC with a schedule, a safe set and held": ql.ADRC(
        ESO,
        1.5,
        safe_set=ql.SafeSet(-0.9, 0.9, -3.0, 3.0, alpha=4.0, f_rate=0.1),
        held=ql.HeldPlant(),
        schedule=ql.Schedule((-0.5, 0.7), "reference", (0.7, 3.0)),
        **LIMITS,
    ),
    "Prefiltered ADRC with a schedule over two signals": room.Prefiltered(
        ql.ADRC(
            ESO,
            1.5,
            schedule=ql.Schedule(
                ((-0.2, 0.4), (-1.0, 0.0, 1.0)), ("y", "speed"), ((0.7, 1.5, 3.0), (1.0, 1.5, 2.0))
            ),
            **LIMITS,
        ),
        baseline_room.ZV(3.0),
    ),
    "ADRC with a schedule from online b0": ql.ADRC(
        ESO, 1.5, schedule=ql.OnlineGain(0.7, 3.0, bandwidth=30.0), **LIMITS
    ),
    "Compensator": ql.Compensator(ESO, **LIMITS),
    "Compensator with a schedule": ql.Compensator(
        ESO, schedule=ql.Schedule((-0.5, 0.7), "y", (0.7, 2.0), omega_o=(9.0, 20.0)), **LIMITS
    ),
    "Compensated": room.Compensated(PID, ql.Compensator(ESO, **LIMITS)),
    "Prefiltered ADRC": room.Prefiltered(ql.ADRC(ESO, 1.5, **LIMITS), baseline_room.ZV(3.0)),
}
PLANTS = {"ResonanceRatio": ql.plants.two_mass_spring()}
# With a record of things not finite on both inputs, but for the first sample.
REFERENCE = np.where(np.arange(400) % 31 == 7, np.nan, np.sin(0.03 * np.arange(400)))
MEASURED = np.where(np.arange(400) % 17 == 5, np.inf, 0.3 * np.cos(0.05 * np.arange(400)))


def test_every_controller_has_an_example() -> None:
    """Nothing public escapes the contracts: the controllers' classes found in the rooms are those of the examples, all of them."""
    public = [getattr(module, name) for module in (room, baseline_room) for name in module.__all__]
    found = {
        thing.__name__
        for thing in public
        if inspect.isclass(thing)
        and hasattr(thing, "initial_state")
        and not getattr(thing, "_is_protocol", False)
    }
    every = {**CONTROLLERS, **SEVERAL}
    assert found == {type(example).__name__ for example in every.values()}


def _axis(learner: Any = None) -> ql.ADRC:
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=12.0, dt=DT)
    return ql.ADRC(observer, 1.5, learner=learner, guard=learner and ql.Guard())


_COUPLED = (np.kron(np.eye(2), [[0, 1], [0, -0.5]]), np.kron([[1, 0.3], [0.2, 1]], [[0], [1]]))
_POSITIONS = np.eye(4)[[0, 2]]
_OBSERVER = ql.ESO.state_space(*_COUPLED, _POSITIONS, _COUPLED[1], DT, omega_o=8.0)
# Controllers with several control signals.
SEVERAL: dict[str, Any] = {
    "Axes": ql.Axes([_axis(), _axis(ql.learners.Harmonic())], [[1, 0.3], [0.2, 1]], u_max=2.0),
    "StateFeedback": room.StateFeedback(
        _OBSERVER, room.state_feedback(*_COUPLED, 1.5, DT), u_min=-2.0, u_max=2.0
    ),
}


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.parametrize("name", SEVERAL)
def test_several_signals_step_as_they_are_simulated(name: str) -> None:
    """Compiled ``step`` with what was measured gives the u of an interpreted run but for rounding."""
    plant = ql.plants.LinearPlant(*_COUPLED, _POSITIONS)
    noise = ql.signals.BandLimitedNoise(power=1e-6 * DT, sample_time=DT)
    scenario = ql.Scenario((1.0, ql.signals.Sinusoid(0.5, 2.0)), 2.0, noise=noise)
    run = ql.simulate(plant, SEVERAL[name], scenario, interpret=True)
    one = copy.deepcopy(SEVERAL[name])
    u = [one.step(r, y) for r, y in zip(run["r"], run["y_measured"], strict=True)]
    np.testing.assert_allclose(u, run["u"], rtol=1e-9, atol=1e-9)
    for label, array in named_arrays(run.final_state).items():
        if "given" not in label:  # what Python handed over
            np.testing.assert_allclose(one.state[label], array, rtol=1e-8, atol=1e-8, err_msg=label)


# A controller that is stepped is not told of a start from rest.
WITHOUT_REST = ql.Scenario(SCENARIO.reference, 2.0, noise=SCENARIO.noise)


@pytest.mark.trial
@pytest.mark.compiled
def test_a_loop_runs_the_same_again_and_interpreted() -> None:
    """Same seed, same output; no second compilation; interpreted = compiled; ``step`` gives the same u and state.

    Of all controllers the next test compiles ``step``: the same functions without the loop.
    """
    check_run(CHAIN, CONTROLLERS["ADRC"], SCENARIO)
    run = ql.simulate(CHAIN, CONTROLLERS["ADRC"], WITHOUT_REST)
    controller = copy.deepcopy(CONTROLLERS["ADRC"])
    u = [controller.step(r, y) for r, y in zip(run["r"], run["y_measured"], strict=True)]
    np.testing.assert_allclose(u, run["u"], rtol=0.0, atol=1e-12)
    for label, array in named_arrays(run.final_state).items():
        np.testing.assert_allclose(
            controller.state[label], array, rtol=1e-9, atol=1e-12, err_msg=label
        )


# An ADRC behind a prefilter is among them twice without this one, and its filter behind a PID.
IN_LOOPS = [name for name in CONTROLLERS if name != "Prefiltered ADRC"]


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.parametrize("name", IN_LOOPS)
def test_a_step_at_a_time_is_the_simulated_run_and_interpreted(name: str) -> None:
    """Compiled ``step`` with what was measured gives the u of an interpreted run but for rounding, and its state; again, the same bits."""
    run = ql.simulate(
        PLANTS.get(name, CHAIN),
        CONTROLLERS[name],
        WITHOUT_REST,
        interpret=True,
    )
    one, other = (copy.deepcopy(CONTROLLERS[name]) for _ in range(2))
    shown = list(zip(run["r"], run["y_measured"], strict=True))
    u = [one.step(r, y) for r, y in shown]
    assert [other.step(r, y) for r, y in shown] == u
    # Fused multiply-add rounds otherwise.
    np.testing.assert_allclose(u, run["u"], rtol=1e-9, atol=1e-9)
    for label, array in named_arrays(run.final_state).items():
        np.testing.assert_allclose(one.state[label], array, rtol=1e-9, atol=1e-9, err_msg=label)


# Those that are no linear law with limits.
NOT_LINEAR = {
    name
    for name in CONTROLLERS
    if name.startswith("Prefiltered") or "Han" in name or "schedule" in name
}


@cases("name", CONTROLLERS)
def test_the_closed_form_of_a_law_is_the_measured_one(name: str) -> None:
    """The responses of u to pulses of r, y and u agree; what is not linear, or changes, is refused."""
    controller = CONTROLLERS[name]
    if name in NOT_LINEAR:
        with pytest.raises(ValueError, match="must be linear"):
            law_of(controller)
        return
    derived, measured = (_pulses(law) for law in (law_of(controller), linear_law(controller)))
    np.testing.assert_allclose(derived, measured, rtol=0.0, atol=1e-9 * np.max(np.abs(measured)))


def _pulses(law: Any) -> Any:
    """Return D and C Aᵏ B of a law for r, y and u, fifty terms (51, 3)."""
    B = np.column_stack([law.B_r, law.B_y, law.B_u])
    terms = [np.array([law.D_r, law.D_y, 0.0])]
    for _ in range(50):
        terms.append(law.C @ B)
        B = law.A @ B
    return np.array(terms)


def awaited(controller: Any, y: float) -> float:
    """Return the next measurement as its observer expects it; the last one, ``y``, where it has no observer."""
    law = getattr(controller, "compensator", getattr(controller, "controller", controller))
    if not isinstance(law, ql.Compensator):
        return y
    design, state, u = law.parameters, law._state, law._state.loop[0].u
    observed = control_as_observed(design.schedule, state.schedule, u)
    known = known_now(design, state, acting_control(design.eso, state.z, u))
    return expected_measurement(design.eso, state.z, observed, known)


@pytest.mark.trial
@cases("name", CONTROLLERS)
def test_a_bad_sample_is_held_and_limits_hold(name: str) -> None:
    """As if the last good ones had come again, or what an observer expects; u always a number within its limits."""
    one, other = (copy.deepcopy(CONTROLLERS[name]) for _ in range(2))
    r, y, before = 0.0, 0.0, 0.0
    for bad_r, bad_y in zip(REFERENCE, MEASURED, strict=True):
        r, y = (
            bad_r if math.isfinite(bad_r) else r,
            bad_y if math.isfinite(bad_y) else awaited(other, y),
        )
        u = one.step(bad_r, bad_y)
        assert -2.0 <= u <= 3.0
        assert abs(u - before) <= 60.0 * DT + 1e-12
        assert other.step(r, y) == pytest.approx(u, rel=1e-9, abs=1e-9)
        before = u


@pytest.mark.trial
@cases("name", CONTROLLERS)
def test_a_controller_that_is_told_of_limits_is_one_that_has_them(name: str) -> None:
    """Told sample after sample what narrower limits behind it leave of u, it does what it does with those limits of its own."""
    told, own = (copy.deepcopy(CONTROLLERS[name]) for _ in range(2))
    _narrow(own, -0.5, 0.4)
    lie = 0
    for k in range(400):
        y = 0.3 * math.cos(0.05 * k)
        u = told.step(math.sin(0.03 * k), y)
        told.applied(min(max(u, -0.5), 0.4))
        lie += not -0.5 <= u <= 0.4
        assert min(max(u, -0.5), 0.4) == pytest.approx(
            own.step(math.sin(0.03 * k), y), rel=1e-9, abs=1e-9
        )
    assert lie > 10


def _narrow(controller: Any, low: float, high: float) -> None:
    """Give a controller, or the one behind its prefilter, other limits."""
    inner = controller.controller if isinstance(controller, room.Prefiltered) else controller
    inner = getattr(controller, "compensator", inner)
    inner._limits = controller.limits._replace(low=low, high=high)
    inner._initialise()
    if inner is not controller:
        controller._initialise()


@pytest.mark.trial
@cases("name", CONTROLLERS)
def test_a_controller_takes_over_without_a_bump(name: str) -> None:
    """It watched a plant that rests where u = 0 holds it, with its reference there; what it then applies itself begins at zero."""
    controller = copy.deepcopy(CONTROLLERS[name])
    for _ in range(500):
        controller.step(0.7, 0.7)
        controller.applied(0.0)
    bumpless_transfer(controller.parameters, controller._state)
    assert controller.step(0.7, 0.7) == pytest.approx(0.0, abs=0.02)


@cases("name", CONTROLLERS)
def test_a_controller_waits_for_its_first_measurement(name: str) -> None:
    """Nothing moves, and then it is as if nothing had been."""
    one, other = (copy.deepcopy(CONTROLLERS[name]) for _ in range(2))
    assert [one.step(1.0, math.nan) for _ in range(3)] == [0.0] * 3
    assert [one.step(1.0, y) for y in (0.5, 0.4)] == [other.step(1.0, y) for y in (0.5, 0.4)]


@pytest.mark.trial
@cases("name", CONTROLLERS)
def test_a_controller_goes_on_without_a_trace(name: str) -> None:
    """Saved and restored by named arrays, copied, or sent: the same bits from there on; reset, it begins anew."""
    one, other = (copy.deepcopy(CONTROLLERS[name]) for _ in range(2))
    first = [one.step(0.5, 0.01 * k) for k in range(100)]
    other.state = one.state
    others = (other, copy.deepcopy(one), pickle.loads(pickle.dumps(one)))
    expected = [one.step(0.5, 1.0 - 0.01 * k) for k in range(100)]
    attributes = {label for label in vars(CONTROLLERS[name]) if not label.startswith("_")}
    for copied in others:
        assert {label for label in vars(copied) if not label.startswith("_")} == attributes
        assert [copied.step(0.5, 1.0 - 0.01 * k) for k in range(100)] == expected
    one.reset()
    assert [one.step(0.5, 0.01 * k) for k in range(100)] == first
    with pytest.raises(ValueError, match="state has"):
        one.state = {}


@pytest.mark.trial
@pytest.mark.compiled
@cases("name", CONTROLLERS)
def test_a_step_allocates_nothing(name: str) -> None:
    """Once compiled, a thousand steps ask Numba's runtime for no memory; preparing is no step."""
    controller = copy.deepcopy(CONTROLLERS[name])
    before = controller.state
    controller.prepare()
    for label, array in controller.state.items():
        np.testing.assert_array_equal(array, before[label])
    _nrt_python.memsys_enable_stats()
    allocated = rtsys.get_allocation_stats().alloc
    for k in range(1000):
        controller.step(0.5, 0.001 * k)
    assert rtsys.get_allocation_stats().alloc == allocated
