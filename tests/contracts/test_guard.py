"""A guarded learner does no harm behind any observer, on flexible axes with either encoder.

With the encoder at the motor the plant has zeros, and the loop fewer poles than the observer has states.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql
from quell.experiments.stress.adversaries import MULTIPLE, Adversary
from quell.guard import assess, limit, record_output
from quell.guard.kernels import F_L
from quell.learners.base import lag_memory, lag_of, lag_push
from quell.observers.design import FORMS
from quell.plants import delayed, n_mass
from tests.cases import cases

from .examples import EXTENDED

J_MOTOR, J_LOAD, STIFFNESS, FRICTION = 3.2e-4, 3.2e-4, 0.51, 1e-3  # zeros at the motor: 40 rad/s
TORQUE, LAGS = 0.05, 60.0
HEALTHY = 0.3  # modulus margin of a loop without learner
# omega_o [rad/s] and omega_o/omega_c: the first with a margin of 0.4 is taken, or the one with the largest.
BANDWIDTHS = ((300.0, 3.0), (300.0, 8.0), (250.0, 8.0), (120.0, 8.0), (20.0, 8.0))


class Plant(NamedTuple):
    """A flexible axis, with friction of the load on the ground, or without damping; torque in samples late."""

    sensor: str
    friction: float
    late: int

    def axis(self, friction: float, wrong: float = 1.0) -> Any:
        """Motor and load; ``wrong`` is the factor of the load's inertia."""
        at = 1 if self.sensor == "motor" else 2
        return n_mass([J_MOTOR, wrong * J_LOAD], [STIFFNESS], ground=[0.0, friction], sensor=at)


class Loop(NamedTuple):
    """What an observer is made of."""

    plant: Plant
    wrong: float  # factor of the model's load, or of b0 without model
    omega_o: float

    @property
    def dt(self) -> float:
        """Sample time."""
        return max(1e-3, 0.1 / self.omega_o)

    @property
    def delay(self) -> float:
        """Delay of the torque."""
        return self.plant.late * self.dt


PLANTS = {
    f"encoder at the {sensor}, {name}": Plant(sensor, friction, late)
    for sensor in ("motor", "load")
    for name, friction, late in (
        ("damped", FRICTION, 0),
        ("undamped", 0.0, 0),
        ("delayed", FRICTION, 1),
    )
}


def chain(make: Callable[..., ql.ESO], loop: Loop, **options: Any) -> ql.ESO:
    """An observer without model: of the rigid axis at the motor, of the chain at the load."""
    order, b0 = 2, loop.wrong / (J_MOTOR + J_LOAD)
    if loop.plant.sensor == "load":
        order, b0 = 4, loop.wrong * STIFFNESS / (J_MOTOR * J_LOAD)
    return make(order, b0, dt=loop.dt, delay=loop.delay, **options)


def model(loop: Loop, **options: Any) -> ql.ESO:
    """An observer of a model with damping, also of a plant without: it has zeros at the motor."""
    known = loop.plant.axis(FRICTION, loop.wrong)
    return ql.ESO.model_based(known, loop.omega_o, loop.dt, delay=loop.delay, **options)


def of_densities(loop: Loop) -> ql.ESO:
    """A Kalman observer of about that bandwidth."""
    power = 6 if loop.plant.sensor == "motor" else 10
    drift = 1e-10 * loop.dt * loop.omega_o**power
    return chain(ql.ESO.kalman, loop, noise_variance=1e-10, drift=drift)


OBSERVERS: dict[str, Callable[[Loop], ql.ESO]] = {
    "model_free": lambda loop: chain(ql.ESO.model_free, loop, omega_o=loop.omega_o),
    "cascade": lambda loop: chain(ql.ESO.cascade, loop, omega_o=loop.omega_o),
    "kalman": of_densities,
    "model_based": model,
    "model_based, E": lambda loop: model(loop, E=0),
    "model_based, keep_zeros": lambda loop: model(loop, keep_zeros=True),
    "model_based, half_gain": lambda loop: model(loop, half_gain=True),
    "model_based, poles": lambda loop: model(loop, poles=[(-0.8, 0.6), -1.0, -1.0, -1.0]),
    **{
        f"model_based, form={form}": lambda loop, form=form: model(loop, form=form)
        for form in FORMS[1:]
    },
}
# Pairs for which no bandwidth of the list gives a loop with that margin, whatever the model.
WITHOUT_LOOP = {
    *(("cascade", plant) for plant in PLANTS if "motor" in plant),
    ("kalman", "encoder at the motor, delayed"),
    ("model_based, keep_zeros", "encoder at the motor, undamped"),
}
# A disturbance at the load has zeros to y itself: such a channel is refused.
REFUSED = {("model_based, E", "load")}
PAIRS = [(o, p) for o in OBSERVERS for p in PLANTS if (o, PLANTS[p].sensor) not in REFUSED]


def test_every_observer_form_is_among_them() -> None:
    """All that make an ``ESO``, all forms and all options of a model, but the nonlinear one, which a guard refuses."""
    makers = {
        name
        for name, member in inspect.getmembers(ql.ESO, inspect.ismethod)
        if not name.startswith("_")
    }
    assert makers - {"nonlinear"} == {name.partition(",")[0] for name in OBSERVERS}
    options = set(inspect.signature(ql.ESO.model_based).parameters)
    options -= {
        "plant",
        "omega_o",
        "dt",
        "b0",
        "delay",
        "far",
        "disturbance_order",
        "frequencies",
    }  # numbers
    shown = {name.partition(", ")[2].partition("=")[0] for name in OBSERVERS} - {""}
    assert options == shown
    assert set(FORMS) == {"current", "predictor", "reduced"}
    nonlinear = ql.ESO.nonlinear(2, 1.0, 20.0, 1e-3, delta=0.1)
    with pytest.raises(ValueError, match="observer is nonlinear"):
        ql.Guard().design(nonlinear)


@cases("name", EXTENDED)
def test_a_guard_refuses_every_observer_with_more_extended_states(name: str) -> None:
    """And says why: a ramp of f_L moves nothing, and would have to leak away."""
    if "nonlinear" not in name:
        with pytest.raises(ValueError, match=r"a (ramp|parabola) of f_L moves nothing.*=1, or no"):
            ql.ADRC(EXTENDED[name], 1.0, learner=Adversary(MULTIPLE, size=1.0), guard=ql.Guard())


def healthy_loop(name: str, plant: Plant, wrong: float) -> tuple[Loop, ql.ADRC] | None:
    """A loop without learner, with a margin that the contract is about."""
    found, largest = None, HEALTHY
    for omega_o, ratio in BANDWIDTHS:
        loop = Loop(plant, wrong, omega_o)
        controller = ql.ADRC(OBSERVERS[name](loop), omega_o / ratio)
        margins = ql.analysis.analyse(plant.axis(plant.friction), controller, delay=loop.delay)
        margin = margins.margins.modulus if margins.stable else 0.0
        if margin > largest:
            found, largest = (loop, controller), margin
        if margin > 0.4:
            break
    return found


def rms(loop: Loop, controller: ql.ADRC) -> float:
    """RMS error of y from the start of a sinusoidal torque on the load on."""
    lag, plant = controller.observer.lag_time, loop.plant.axis(loop.plant.friction)
    t = loop.dt * np.arange(round(1.25 * LAGS * lag / loop.dt))
    torque = ql.signals.Sinusoid(TORQUE, 0.3 / lag, start=0.25 * LAGS * lag)
    noise = ql.signals.BandLimitedNoise(power=1e-11 * loop.dt, sample_time=loop.dt)
    scenario = ql.Scenario(0.0, float(t[-1]), (torque,), noise, seed=3)
    late = delayed(plant, loop.delay, loop.dt) if loop.delay else plant
    run = ql.simulate(late, controller, scenario)
    assert not run.diverged
    return float(np.sqrt(np.mean(run["y"][run.t >= 0.25 * LAGS * lag] ** 2)))


@pytest.mark.trial
@pytest.mark.parametrize(("name", "plant"), PAIRS)
def test_a_guarded_learner_does_no_harm(name: str, plant: str) -> None:
    """Its error is at most 1.02 times that without learner, whether the model is right or its load is 30 % off.

    Each pair has one of the three, by its place; another where that loop has no margin.
    """
    place = list(OBSERVERS).index(name) + list(PLANTS).index(plant)
    factors = [(0.7, 1.0, 1.3)[(place + i) % 3] for i in range(3)]
    loops = (healthy_loop(name, PLANTS[plant], wrong) for wrong in factors)
    found = next((pair for pair in loops if pair is not None), None)
    assert (found is None) == ((name, plant) in WITHOUT_LOOP)
    if found is None:
        return
    loop, plain = found
    # Kalman cannot be used with the reduced form.
    learner = Adversary(MULTIPLE, size=1.0) if "reduced" in name else ql.learners.Kalman()
    guarded = ql.ADRC(plain.observer, plain.omega_c, learner=learner, guard=ql.Guard())
    assert rms(loop, guarded) <= 1.02 * rms(loop, plain)


@pytest.mark.trial(cases="cascade")
@pytest.mark.parametrize(("name", "sensor"), {(o, PLANTS[p].sensor): 0 for o, p in PAIRS})
def test_without_authority_nothing_acts_after_ten_lags(name: str, sensor: str) -> None:
    """A learner that had full authority and pushed has none any more: f_L is f_L^F, to the bit, whatever it says."""
    rng = np.random.default_rng(4)
    observer = OBSERVERS[name](Loop(Plant(sensor, FRICTION, 0), 1.0, 120.0))
    guarded = ql.ADRC(observer, 15.0, learner=Adversary(MULTIPLE, size=1.0), guard=ql.Guard())
    design, memory = guarded.parameters.guard, ql.Guard().memory(guarded.parameters.guard)
    sample, lag = memory.sample[0], lag_of(observer)
    shadow, shown = lag_memory(lag, 1), 0.0
    ten_lags = round(10.0 * observer.lag_time / observer.dt)
    acted = 0
    for k in range(6 * ten_lags):
        trusted = k < 2 * ten_lags
        sample.credit, sample.typical_error = (1.0, 1.0) if trusted else (-1.0, 1.0)
        sample.peak = sample.outside = 1.0
        memory.averages[0].missed = memory.averages[0].gained = 1.0
        assess(design, memory, 0.0)
        f_learned, _, _ = limit(design, memory, 1.0, shown, rng.normal(), 0.0, 0.0)
        if not trusted and k > 3 * ten_lags + 2 * design.every:
            assert f_learned == memory.filtered[F_L]
        acted += f_learned != memory.filtered[F_L]
        record_output(design, memory, f_learned)
        shown = lag_push(lag, shadow, 0, f_learned)
    assert acted > ten_lags
