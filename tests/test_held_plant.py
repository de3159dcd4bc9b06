"""A plant that a brake or an end stop holds, and its release: with a signal, detected, and in C."""

from __future__ import annotations

import ctypes
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql
from quell.controllers import in_single_precision
from quell.controllers.base import control, hold_integrators, set_applied_control
from quell.controllers.compensator import Compensator
from quell.export import c_source
from quell.export.library.vectors import Action, Player
from quell.observers.eso import ESO

from .in_c import InC, needs_gcc

# A servo of 2e-4 kg m² with an encoder of 20 bits, 3.5 N m and dt = 0.5 ms.
DT, B0, COUNT = 0.5e-3, 5000.0, math.tau / 2**20
OBSERVER = ESO.model_free(order=2, b0=B0, omega_o=300.0, dt=DT)
LIMITS = {"u_min": -3.5, "u_max": 3.5}
NOTHING, SIGNAL, BY_HAND = "nothing", "signal", "by hand"


def adrc(held: Any = None, **more: Any) -> ql.ADRC:
    """Return the servo's controller."""
    return ql.ADRC(OBSERVER, 60.0, held=held, **(LIMITS | more))


def run(
    controller: Any,
    how: str = NOTHING,
    hold: tuple[float, float] = (0.1, 2.1),
    step: float = 1.0,
    seconds: float = 2.6,
    load: Any = 0.0,
    counts: bool = True,
    b: float = B0,
) -> tuple[Any, Any, Any]:
    """Return y, u and status of a step at 0.1 s of a servo that is held meanwhile."""
    size = round(seconds / DT)
    x, speed = 0.0, 0.0
    y, u, status = np.zeros(size), np.zeros(size), np.zeros(size, int)
    design, state = controller.parameters, controller._state
    force = np.broadcast_to(load, size)
    for k in range(size):
        held = hold[0] <= k * DT < hold[1] - 1e-9
        measured = COUNT * math.floor(x / COUNT + 0.5) if counts else x
        r = step if k * DT >= 0.1 else 0.0
        if how == SIGNAL:
            controller.set_held(held)
        if how == BY_HAND and held:
            controller.track(r, measured, 0.0)
            u[k] = 0.0
        else:
            if how == BY_HAND and k and hold[0] <= (k - 1) * DT < hold[1] - 1e-9:
                controller.hand_over()
            u[k] = control(design, state, r, measured)
        status[k] = int(state.loop[0].status)
        acceleration = b * u[k] + force[k]
        if held:
            speed = 0.0
        else:
            x += DT * speed + 0.5 * DT * DT * acceleration
            speed += DT * acceleration
        y[k] = x
    return y, u, status


def overshoot(y: Any, step: float = 1.0) -> float:
    """Return the overshoot in percent."""
    return 100.0 * max(float(np.max(y)) / step - 1.0, 0.0)


@pytest.mark.trial
def test_a_hold_of_two_seconds_makes_no_overshoot_with_nothing_set_by_hand() -> None:
    """At most 0.5 %, as with the signal and by hand; without detection u is at its limit and y overshoots by more than half."""
    found = {
        "nothing": overshoot(run(adrc())[0]),
        "detected": overshoot(run(adrc(ql.HeldPlant()))[0]),
        "signal": overshoot(run(adrc(), SIGNAL)[0]),
        "by hand": overshoot(run(adrc(), BY_HAND)[0]),
    }
    assert found["nothing"] > 50.0
    assert max(found[name] for name in ("detected", "signal", "by hand")) < 0.5


@pytest.mark.trial
@pytest.mark.parametrize("hold", [(0.12, 0.3), (0.14, 2.2), (0.0, 1.0)])
def test_a_hold_in_mid_move_or_from_the_start_is_detected_too(hold: tuple[float, float]) -> None:
    """Of 0.18 s, of 2 s, and one that began before the first sample."""
    assert overshoot(run(adrc(), hold=hold)[0]) > 20.0
    y, _, status = run(adrc(ql.HeldPlant()), hold=hold)
    assert overshoot(y) < 0.5
    assert abs(y[-1] - 1.0) < 1e-4
    assert np.any(status & ql.Status.HELD)


@pytest.mark.trial
@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_a_wrong_b0_costs_what_it_costs_without_a_hold(gain: float) -> None:
    """With half and twice the gain, compared with a step without a hold."""
    free = overshoot(run(adrc(), hold=(9.0, 9.0), b=gain * B0)[0])
    held = overshoot(run(adrc(ql.HeldPlant()), b=gain * B0)[0])
    assert held < free + 1.0


@pytest.mark.trial
def test_a_compensator_detects_as_an_adrc_does() -> None:
    """Under a controller that holds the position with a plain P-D law of its own."""
    u_0 = 60.0**2 / B0

    def play(held: Any) -> float:
        compensator = Compensator(OBSERVER, held=held, **LIMITS)
        design, state, x, v, top = compensator.parameters, compensator._state, 0.0, 0.0, 0.0
        for k in range(5200):
            wish = u_0 * (1.0 - x) - 120.0 * v / B0 if k >= 200 else 0.0
            u = control(design, state, wish, x)
            if 100 <= k < 4100:
                continue
            x, v = x + DT * v + 0.5 * DT * DT * B0 * u, v + DT * B0 * u
            top = max(top, x)
        return overshoot(np.array([top]))

    assert play(None) > 20.0
    assert play(ql.HeldPlant()) < 0.5


def test_the_signal_keeps_the_load_and_the_learned() -> None:
    """Under a load that the observer knows: at the release f̂ is that load, not −b0 u; u stays far from its limit."""
    controller = adrc(learner=ql.learners.Kalman())
    _, u, status = run(controller, SIGNAL, (0.3, 0.8), load=-4000.0, seconds=0.8)
    assert controller.estimate.f == pytest.approx(-4000.0, rel=0.02)
    assert abs(u[-1] - 0.8) < 0.02
    assert status[-1] & ql.Status.HELD
    assert "brake" in ql.Status.HELD.message


@pytest.mark.trial
def test_a_load_that_is_compensated_changes_nothing() -> None:
    """A load ramp regulated to standstill may look held; the run is the same as without detection, to the last bit."""
    load = 3000.0 * np.sin(2.0 * np.pi * 0.5 * DT * np.arange(6000))
    plain, detecting = (
        run(adrc(held), hold=(9.0, 9.0), seconds=3.0, load=load) for held in (None, ql.HeldPlant())
    )
    np.testing.assert_array_equal(plain[1], detecting[1])


@pytest.mark.trial
def test_an_axis_that_sticks_breaks_loose_as_without_detection() -> None:
    """EMPS's dry friction, moves and rests: the error is the same within 1 %."""
    plant = ql.plants.dc_motor(
        resistance=1.0, torque_constant=0.37, inertia=1.0, viscous=2.0, coulomb=0.2146
    )
    observer = ESO.model_free(order=2, b0=0.37, omega_o=100.0, dt=2e-3)
    reference = ql.signals.SmoothMove(0.1, 1.0) + ql.signals.SmoothMove(-0.1, 1.0, start=2.0)
    errors = []
    for held in (None, ql.HeldPlant()):
        controller = ql.ADRC(observer, 20.0, u_min=-10.0, u_max=10.0, held=held)
        result = ql.simulate(plant, controller, ql.Scenario(reference, 4.0))
        errors.append(float(np.sqrt(np.mean((result["r"] - result["y"]) ** 2))))
    assert errors[1] == pytest.approx(errors[0], rel=0.01)


@pytest.mark.trial
def test_a_load_instead_of_a_brake_is_not_taken_for_one() -> None:
    """A load of −b0 u that goes on after y began to move: f̂ is not set back, and the flag ends."""
    controller = adrc(ql.HeldPlant())
    design, state, y = controller.parameters, controller._state, 0.0
    for k in range(4000):
        control(design, state, 1.0, y)
        if k == 2000:
            assert controller.estimate.status & ql.Status.HELD
        if k > 2000:
            y += 3.0 * COUNT  # a creep: all but a trace of u is compensated
    assert not controller.estimate.status & ql.Status.HELD
    assert controller.estimate.f == pytest.approx(-B0 * 3.5, rel=0.05)


@pytest.mark.trial
def test_missing_measurements_do_not_end_a_hold() -> None:
    """With every tenth one missing the release still makes no overshoot."""
    controller = adrc(ql.HeldPlant())
    design, state, x, v, top = controller.parameters, controller._state, 0.0, 0.0, 0.0
    for k in range(5200):
        u = control(design, state, float(k >= 200), math.nan if k % 10 == 5 else x)
        if 100 <= k < 4100:
            continue
        x, v = x + DT * v + 0.5 * DT * DT * B0 * u, v + DT * B0 * u
        top = max(top, x)
    assert top < 1.005


@pytest.mark.trial
@pytest.mark.parametrize(
    "observer",
    [
        ESO.cascade(2, B0, 300.0, DT),
        ESO.nonlinear(2, B0, 300.0, DT, delta=0.05),
        ESO.model_free(order=2, b0=B0, omega_o=300.0, dt=DT, disturbance_order=2),
        ESO.model_free(order=2, b0=B0, omega_o=300.0, dt=DT, form="predictor"),
        ESO.model_free(order=2, b0=B0, omega_o=300.0, dt=DT, delay=2 * DT),
        ESO.model_based(([0.0, 5.0], B0), 300.0, DT),
    ],
    ids=["cascade", "nonlinear", "f'", "predictor", "delay", "model"],
)
def test_every_form_of_the_observer_takes_part(observer: ESO) -> None:
    """A cascade, a nonlinear one, f', predictor form, a delay of u, a model: the hold costs less than 1 % of the step.

    With f' the wind-up throws y back instead of over its goal.
    """
    plain, detecting = (
        overshoot(run(ql.ADRC(observer, 40.0, held=held, **LIMITS))[0])
        for held in (None, ql.HeldPlant())
    )
    signal = overshoot(run(ql.ADRC(observer, 40.0, **LIMITS), SIGNAL)[0])
    free = overshoot(run(ql.ADRC(observer, 40.0, **LIMITS), hold=(9.0, 9.0))[0])
    assert plain > 20.0 or observer.disturbance_order == 2
    assert detecting < free + 1.0
    assert signal < free + 1.0


@pytest.mark.trial
def test_a_safe_set_knows_of_the_release() -> None:
    """Its own observer is at rest with the signal, so the band holds from the first sample on."""
    safe = ql.SafeSet(y_max=1.02, alpha=60.0, f_rate=100.0, noise=COUNT)
    for held, how in ((None, SIGNAL), (ql.HeldPlant(), NOTHING)):
        y, _, _ = run(adrc(held, safe_set=safe), how)
        assert np.max(y) <= 1.02


def test_what_is_no_detection_and_a_plant_with_zeros_are_refused() -> None:
    """The errors name the argument and what to do."""
    with pytest.raises(ValueError, match=r"held = True: must be a quell.HeldPlant"):
        adrc(True)
    with pytest.raises(ValueError, match="noise"):
        ql.HeldPlant(noise=-1.0)
    with pytest.raises(ValueError, match="held"):
        adrc().set_held(2.5)
    zeros = ESO.model_based(([3.0, 2.0], np.poly([-1.0, -0.3, -0.5])), 20.0, 0.01, keep_zeros=True)
    with pytest.raises(ValueError, match="held: the plant has zeros"):
        ql.ADRC(zeros, 2.0, held=ql.HeldPlant())
    with pytest.raises(ValueError, match="set_held: the plant has zeros"):
        ql.ADRC(zeros, 2.0).set_held(True)


def test_wrappers_hand_the_signal_on() -> None:
    """Prefiltered, compensated and single-precision controllers set the flag."""
    pid = ql.baselines.PID(kp=0.5, ki=1.0, kd=0.01, tf=0.005, dt=DT)
    for controller in (
        ql.controllers.Prefiltered(adrc(), ql.controllers.ReferenceModel(60.0)),
        ql.Compensated(pid, Compensator(OBSERVER, **LIMITS)),
        ql.controllers.in_single_precision(adrc()),
    ):
        for held in (True, False):
            controller.set_held(held)
            for _ in range(3):
                control(controller.parameters, controller._state, 1.0, 0.0)
            assert bool(controller.status & ql.Status.HELD) == held


class _Own(NamedTuple):
    """A controller of a user that knows of no brake, and the u that it was told."""

    told: Any


@set_applied_control.register(_Own)
def _take(design: _Own, state: Any, u: float) -> None:
    design.told.append(u)


def test_a_controller_of_a_user_is_told_the_u_of_before() -> None:
    """So that its own anti-windup bounds what it integrates meanwhile."""
    own = _Own([])
    hold_integrators(own, None, 0.75)
    assert own.told == [0.75]


SERVO = {
    "pid": ql.baselines.PID(kp=0.05, ki=0.3, kd=0.004, tf=2e-3, dt=DT),
    "p-pi": ql.baselines.PPI(kv=30.0, kp=0.012, tn=0.05, dt=DT),
    "two integrators": ql.controllers.LinearController.from_transfer_function(
        0.012 * np.poly([-8.0] * 3),
        np.polymul([1.0, 0.0, 0.0], np.poly([-600.0] * 2) / 600.0**2),
        DT,
    ),
}


def _released(kind: str, samples: int, wrap: Any) -> Any:
    """Return y of a servo of 2e-4 kg m² after a brake of so many samples, with an error of 1 rad."""
    observer = ESO.model_free(order=2, b0=1.0 / 2e-4, omega_o=300.0, dt=DT)
    law = wrap(ql.Compensated(SERVO[kind], Compensator(observer, u_min=-2.0, u_max=2.0)))
    y = v = 0.0
    found = []
    for k in range(samples + 2000):
        law.set_held(k < samples)
        u = control(law.parameters, law._state, 1.0 if k >= 20 else 0.0, y)
        if k >= samples:
            y, v = y + DT * v + 0.5 * DT**2 * u / 2e-4, v + DT * u / 2e-4
            found.append(y)
    return np.array(found)


@pytest.mark.trial
@pytest.mark.parametrize("wrap", [lambda law: law, in_single_precision], ids=["double", "single"])
@pytest.mark.parametrize("kind", SERVO)
def test_a_controller_under_a_compensator_does_not_wind_up(kind: str, wrap: Any) -> None:
    """After 2 s at a brake the release overshoots no more than without it."""
    free, held = _released(kind, 0, wrap), _released(kind, 4000, wrap)
    assert 1.0 < np.max(held) <= np.max(free) < 1.6
    if kind != "two integrators":  # of which u is told, as at a limit
        assert np.max(np.abs(held[:-20] - free[20:])) < 0.02


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("kind", ["adrc", "pid", "two integrators"])
def test_exported_detection_is_the_same_bit_for_bit(
    tmp_path: Path, precision: str, kind: str
) -> None:
    """Held and released four times in different ways, with noise, missing measurements and the signal."""
    observer = ESO.model_free(order=2, b0=50.0, omega_o=100.0, dt=2e-3)
    given: Any = ql.ADRC(observer, 20.0, held=ql.HeldPlant(), **LIMITS)
    if kind != "adrc":
        laws = {
            "pid": ql.baselines.PID(kp=8.0, ki=20.0, kd=0.5, tf=0.01, dt=2e-3),
            "two integrators": ql.controllers.LinearController.from_transfer_function(
                [0.5, 8.0, 20.0], [0.01, 1.0, 0.0, 0.0], dt=2e-3
            ),
        }
        given = ql.Compensated(laws[kind], Compensator(observer, held=ql.HeldPlant(), **LIMITS))
    if precision == "single":
        given = ql.controllers.in_single_precision(given)
    code, player = InC(c_source(given, "servo"), tmp_path), Player(given)
    set_held = code.library.servo_set_held
    set_held.restype = None
    random, x, v, released = np.random.default_rng(2), 0.0, 0.0, 0
    for k in range(2400):
        held = k % 600 < 300
        y = float(np.float32(x + 1e-5 * random.standard_normal()))
        if k % 97 == 5:
            y = math.nan
        action = Action.STEP
        if k in (1800, 2100):
            action = Action.HELD if k == 1800 else Action.RELEASED
            set_held(code.state, ctypes.c_bool(k == 1800))
        r = float(1 + k // 600)
        u = float(player.play(action, r, y)[0])
        assert code.run("step", r, y) == u
        before, v = v, 0.0 if held else v + 2e-3 * 50.0 * u
        x += 0.0 if held else 1e-3 * (before + v)
        flags = [bool(row.status & ql.Status.HELD) for row in player.rows[-2:]]
        released += flags == [True, False]
    assert released >= (4 if kind == "adrc" else 1)
