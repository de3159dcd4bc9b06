"""Guarded loops: a hostile learner does no harm, an honest one is heard, and bad samples change neither."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import quell as ql
from quell.experiments import two_mass_spring
from quell.experiments.stress.adversaries import (
    CONSTANT,
    DELAYED,
    EXPONENTIAL,
    FEATURES,
    INF,
    MINUS_U,
    MULTIPLE,
    NAN,
    PLAIN,
    WHITE,
    Adversary,
    Turncoat,
)
from quell.experiments.stress.study import Loop
from quell.learners.base import lag_of, lag_push
from quell.types import Status
from tests.guarded_samples import bounds

LOOP = Loop(m1=0.8, m2=1.3, k=1.4, gain_error=1.2, dt=5e-3, omega=0.5, amplitude=1.0, seed=4)
PLANT = ql.plants.two_mass_spring()
OBSERVER = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=5e-3)
HOSTILE = {
    "opposite sign": Adversary(MULTIPLE, -3.0),
    "over-prediction": Adversary(MULTIPLE, 1.5),
    "gross over-prediction": Adversary(PLAIN, 10.0),
    "white noise": Adversary(WHITE, 100.0),
    "a constant": Adversary(CONSTANT, 50.0),
    "an exponential": Adversary(EXPONENTIAL, 0.01, time=3.0),
    "a delay": Adversary(DELAYED, 1.0, delay=100),
    "minus u": Adversary(MINUS_U, 1.0),
    "a feature of its own": Adversary(FEATURES, weights=(-5.0, 0.0, 0.0, 10.0)),
    "NaN": Adversary(NAN, 1.0, time=5.0),
    "Inf": Adversary(INF, 1.0, time=5.0),
    "a turncoat": Turncoat(ql.learners.Kalman(), 95.0, -3.0),
}
"""Those whose loops are compiled here anyway; ``.ci/run`` has Algorithm 1."""


def law(learner: object, guard: ql.Guard | None = None) -> ql.ADRC:
    """The two-mass loop with a learner."""
    return ql.ADRC(OBSERVER, omega_c=1.0, learner=learner, guard=guard)


def error(run: ql.Trajectory) -> float:
    """RMS of y − 1 under load."""
    part = run.window(90.0, 150.1)
    return float(np.sqrt(np.mean((run["y"][part] - 1.0) ** 2)))


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_learner_does_no_harm(name: str) -> None:
    """The loop is about as good as MF-ESO under load, whatever the learner says."""
    every = round(0.02 / LOOP.dt)
    plain = ql.simulate(LOOP.plant, LOOP.controller(), LOOP.scenario, record_every=every)
    run = ql.simulate(
        LOOP.plant, LOOP.controller(HOSTILE[name], ql.Guard()), LOOP.scenario, record_every=every
    )
    assert not run.diverged
    assert error(run) <= 1.1 * error(plain)


@pytest.mark.trial
@pytest.mark.compiled
def test_an_honest_learner_is_heard() -> None:
    """It has full authority once it has proved itself, and nothing is lost to having no guard."""
    every = round(0.02 / LOOP.dt)
    plain, free, guarded = (
        ql.simulate(LOOP.plant, LOOP.controller(learner, guard), LOOP.scenario, record_every=every)
        for learner, guard in (
            (None, None),
            (ql.learners.Harmonic(), None),
            (ql.learners.Harmonic(), ql.Guard()),
        )
    )
    assert guarded["authority"][0] == 0.0
    assert guarded["authority"][guarded.window(140.0, 150.0)].min() > 0.99
    assert error(guarded) < 0.3 * error(plain)
    assert error(guarded) < 2.0 * error(free) + 0.01 * error(plain)


@pytest.mark.trial
def test_a_learner_without_authority_leaves_the_loop_as_it_is_without() -> None:
    """Not about: to the bit."""
    scenario = dataclasses.replace(LOOP.scenario, duration=10.0)
    silenced = ql.simulate(
        LOOP.plant, LOOP.controller(Adversary(MULTIPLE, -1.0), ql.Guard()), scenario
    )
    plain = ql.simulate(LOOP.plant, LOOP.controller(), scenario)
    assert np.all(silenced["authority"] == 0.0)
    np.testing.assert_array_equal(silenced["u"], plain["u"])


@pytest.mark.trial
def test_the_bound_holds_for_the_u_of_the_sample() -> None:
    """With u as a feature the correction that the observer receives is within its bounds, too."""
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=1e-2)
    controller = ql.ADRC(
        observer, omega_c=1.0, learner=ql.learners.Kalman(u=True), guard=ql.Guard()
    )
    shadow, shown, largest = np.zeros((1, 5)), 0.0, 0.0
    lag, spring, position, speed = lag_of(observer), 1.4, np.zeros(2), np.zeros(2)
    design = controller.parameters.guard
    for k in range(3_000):
        u = controller.step(math.sin(0.01 * k), position[1])
        f_learned = controller.estimate.f_learned
        correction = f_learned - shown
        # The guard records this correction in the next sample, when the applied u is known.
        guard = controller._state.guard
        least, most = bounds(design, guard)
        rounding = 1e-9 * (1.0 + abs(f_learned))
        assert least - rounding <= correction <= most + rounding, k
        largest = max(largest, abs(correction))
        shown = lag_push(lag, shadow, 0, f_learned)
        force = spring * (position[0] - position[1])
        speed += 1e-2 * np.array([u - force, force]) / [0.8, 1.3]
        position += 1e-2 * speed
    assert largest > 0.0, "nothing was permitted: the test says nothing"


@pytest.mark.trial
def test_status_and_reason_say_what_happened() -> None:
    """On the estimate, in the record and in its picture."""
    controller = law(Adversary(NAN, 1.0, time=2.0), ql.Guard())
    flags, reasons = Status.OK, set()
    for k in range(1000):
        controller.step(math.sin(0.005 * k), 0.5 * math.sin(0.005 * k - 0.4))
        flags |= controller.estimate.status
        reasons.add(controller.estimate.reason)
    assert Status.LEARNER_CUT in flags
    assert "started anew" in flags.message
    assert {ql.Reason.NOT_FINITE, ql.Reason.UNPROVEN} <= reasons
    assert all(reason.message.endswith(".") for reason in ql.Reason)
    assert controller.estimate.error_plain > 0.0
    assert math.isfinite(controller.estimate.error_learned)
    run = ql.simulate(PLANT, controller, ql.Scenario(ql.signals.Sinusoid(), 5.0))
    assert Status.LEARNER_CUT in run.status
    assert {"authority", "error_plain", "error_learned", "reason"} <= set(run.names)
    assert run.to_xarray()["error_plain"].attrs["units"] == "m/s⁴"
    axes = run.plot()
    assert len(axes) == 5
    assert "not finite" in axes[3].get_legend_handles_labels()[1]


def test_without_a_guard_nothing_is_said_of_it() -> None:
    """A learner has all authority then."""
    run = ql.simulate(PLANT, law(ql.learners.Kalman()), ql.Scenario(1.0, 1.0))
    assert "authority" not in run.names
    assert law(ql.learners.Kalman()).estimate.authority == 1.0


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_the_unit_of_y_does_not_matter_to_the_guard(unit: float) -> None:
    """In micrometres or megametres the same authority is given."""
    found = []
    for size in (1.0, unit):
        plant = ql.plants.two_mass_spring(c2=size)
        observer = ql.ESO.model_free(order=4, b0=size, omega_o=10.0, dt=5e-3)
        controller = ql.ADRC(observer, 1.0, learner=ql.learners.Kalman(), guard=ql.Guard())
        scenario = ql.Scenario(
            size * ql.signals.Sinusoid(),
            40.0,
            noise=ql.signals.BandLimitedNoise(1e-12 * size**2, 0.01),
        )
        found.append(ql.simulate(plant, controller, scenario, limit=1e9)["authority"])
    np.testing.assert_allclose(found[0], found[1], atol=1e-3)
    assert found[0][-1] == 1.0


def test_a_guard_without_a_learner_is_reported() -> None:
    """It has nothing to guard: the same loop, and a warning."""
    scenario = ql.Scenario(1.0, 5.0)
    with pytest.warns(ql.DesignWarning, match=r"guard = Guard\(.*no effect without a learner"):
        guarded = law(None, ql.Guard())
    plain, same = (ql.simulate(PLANT, loop, scenario) for loop in (law(None), guarded))
    np.testing.assert_array_equal(plain["u"], same["u"])


@pytest.mark.trial
@pytest.mark.parametrize(
    ("bad", "learner"),
    [(1.7e308, ql.learners.Kalman()), (1e160, ql.learners.Harmonic(state=False))],
)
def test_a_measurement_beyond_all_numbers_is_got_over(bad: float, learner: object) -> None:
    """After it the guarded loop goes on as the one without a guard does."""
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=1e-2)
    controllers = [
        ql.ADRC(observer, 1.0, learner=learner, guard=guard, u_min=-20.0, u_max=20.0)
        for guard in (None, ql.Guard())
    ]
    for k in range(1300):
        y = bad if k == 150 else 0.3 * math.sin(0.008 * k)
        for controller in controllers:
            assert math.isfinite(controller.step(0.0, y))
            if k > 1150:
                assert Status.OVERFLOWED not in controller.estimate.status, k
    guarded = controllers[1].estimate
    assert math.isfinite(guarded.error_plain)
    assert math.isfinite(guarded.error_learned)
    for array in controllers[1].state.values():
        assert np.all(np.isfinite(array))


@pytest.mark.trial
@pytest.mark.compiled
def test_a_bad_measurement_does_not_open_the_bounds() -> None:
    """A learner that turns after one sample that was off by a kilometre does little more harm than MF-ESO suffers itself."""
    errors = []
    for learner in (None, Turncoat(ql.learners.Kalman(), 50.0, 10.0)):
        controller = ql.ADRC(
            OBSERVER,
            1.0,
            learner=learner,
            guard=ql.Guard() if learner else None,
            u_min=-20.0,
            u_max=20.0,
        )
        glitch = ql.signals.Step(1000.0, at=45.0) - ql.signals.Step(1000.0, at=45.005)
        run = ql.simulate(
            PLANT,
            controller,
            ql.Scenario(ql.signals.Sinusoid(), 120.0, noise=glitch),
            record_every=4,
        )
        errors.append(np.max(np.abs(run["y"][run.window(60.0, 120.0)])))
    assert errors[1] < 3.0 * errors[0] + 1.0, errors


@pytest.mark.trial
@pytest.mark.compiled
def test_a_black_box_comes_to_rest_as_soon_with_guard_as_without() -> None:
    """The step of the paper's study, where y rests at 1 and its noise crosses the largest value so far."""
    study = two_mass_spring.Settings(seed=1)
    scenario = dataclasses.replace(two_mass_spring.scenario(study), duration=150.0)
    observer = two_mass_spring.controller(study).observer
    times = []
    for guard in (None, ql.Guard()):
        learner = ql.learners.GaussianProcess(budget=20)
        controller = ql.ADRC(observer, 1.0, learner=learner, guard=guard)
        run = ql.simulate(PLANT, controller, scenario, record_every=10)
        times.append(run.metrics(110.0, 150.0, target=1.0, band=0.002)["settling_time"])
    assert times[1] < 1.05 * times[0], times
