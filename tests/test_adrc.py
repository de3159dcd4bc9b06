"""The controller: law, limits, bad samples, saved states."""

from __future__ import annotations

import copy
import math
import pickle
from pathlib import Path

import numpy as np
import pytest

import quell as ql
from quell.controllers.law import law_gains
from quell.observers.eso import ESO
from quell.plants.base import advance, measure

from .cases import cases

OBSERVER = ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=0.01)


def by_hand(controller: ql.ADRC, plant: object, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Close a loop of one's own around ``step``; return y and u."""
    model, x, scratch = (
        plant.sampled(controller.dt),
        np.zeros(plant.order),
        np.zeros(6 * plant.order),
    )
    ys, us = np.zeros(r.size), np.zeros(r.size)
    for k in range(r.size):
        ys[k] = measure(model, x)
        us[k] = controller.step(r[k], ys[k])
        advance(model, x, scratch, 0.0, us[k], np.zeros(plant.disturbances))
    return ys, us


def test_the_law_puts_all_poles_of_the_ideal_loop_at_minus_omega_c() -> None:
    """``s^n + k_n s^(n−1) + … + k_1 = (s + omega_c)^n``."""
    for n in range(1, 9):
        np.testing.assert_allclose([*law_gains(n, 3.0), 1.0][::-1], np.poly([-3.0] * n), rtol=1e-4)


@pytest.mark.trial
def test_a_known_plant_answers_a_step_as_the_ideal_loop_does() -> None:
    """With MB-ESO, ``y = 1 − e^(−ω t)(1 + ω t)`` for a plant of order 2, as the sample time goes to zero."""
    plant = ql.plants.LinearPlant([[0.0, 1.0], [-3.0, -0.4]], [0.0, 2.0], [1.0, 0.0])
    errors = []
    for dt in (2e-3, 1e-3):
        controller = ql.ADRC(ESO.model_based(plant, omega_o=50.0, dt=dt), omega_c=3.0)
        run = ql.simulate(plant, controller, ql.Scenario(reference=1.0, duration=4.0))
        errors.append(np.max(np.abs(run["y"] - (1.0 - np.exp(-3.0 * run.t) * (1.0 + 3.0 * run.t)))))
    assert errors[0] < 5e-3
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize(
    "learner",
    [
        None,
        ql.learners.Kalman(),
        ql.learners.BatchGradient(rate=1e-5),
    ],
)
def test_a_loop_of_ones_own_is_the_simulated_loop(learner: object) -> None:
    """``step`` sample by sample gives the trajectory of ``simulate``, to the rounding of the plant's own arithmetic."""
    plant = ql.plants.LinearPlant([[0.0, 1.0], [-3.0, -0.4]], [0.0, 2.0], [1.0, 0.0])
    controller = ql.ADRC(
        OBSERVER, omega_c=3.0, learner=learner, u_min=-1.5, u_max=2.0, rate_limit=20.0
    )
    run = ql.simulate(
        plant, controller, ql.Scenario(reference=ql.signals.Sinusoid(omega=2.0), duration=5.0)
    )
    y, u = by_hand(controller, plant, run["r"])
    np.testing.assert_allclose(y, run["y"], atol=1e-11)
    np.testing.assert_allclose(u, run["u"], atol=1e-11)
    assert controller.read(run.final_state).u == pytest.approx(controller.estimate.u)


def test_the_control_signal_respects_magnitude_and_rate() -> None:
    """At every sample; the status says which limit holds."""
    controller = ql.ADRC(OBSERVER, omega_c=1.0, u_min=-0.5, u_max=1.0, rate_limit=3.0)
    plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 2.0], [1.0, 0.0])
    run = ql.simulate(
        plant, controller, ql.Scenario(reference=ql.signals.Step(at=1.0, height=3.0), duration=15.0)
    )
    assert run["u"].min() >= -0.5
    assert run["u"].max() <= 1.0
    assert np.max(np.abs(np.diff(run["u"]))) <= 3.0 * 0.01 + 1e-12
    seen = np.bitwise_or.reduce(run["status"].astype(int))
    assert seen == ql.Status.SATURATED | ql.Status.RATE_LIMITED
    assert run["y"][-1] == pytest.approx(3.0, abs=0.02)


@pytest.mark.trial
def test_saturation_does_not_wind_up_the_observer() -> None:
    """It is told the applied u: after 50 s against a wall of a limit, f is still estimated right, and release is immediate."""
    plant = ql.plants.LinearPlant([[0.0, 1.0], [-1.0, -1.0]], [0.0, 2.0], [1.0, 0.0])
    controller = ql.ADRC(OBSERVER, omega_c=3.0, u_min=-0.4, u_max=0.4)
    scenario = ql.Scenario(
        reference=ql.signals.Constant(5.0).until(50.0, then=ql.signals.Constant(0.3)), duration=60.0
    )
    run = ql.simulate(plant, controller, scenario)
    at_limit = run.window(40.0, 50.0)
    np.testing.assert_allclose(run["u"][at_limit], 0.4)
    np.testing.assert_allclose(run["f_hat"][at_limit], -run["y"][at_limit], atol=1e-3)
    assert run["u"][run.window(50.0, 50.1).start] < 0.4
    assert run["y"][-1] == pytest.approx(0.3, abs=1e-3)


def test_a_plant_with_half_or_twice_the_nominal_gain_still_settles() -> None:
    """b0 off by a factor of two either way: the total disturbance takes it up."""
    for b in (1.0, 4.0):
        plant = ql.plants.LinearPlant([[0.0, 1.0], [-1.0, -1.0]], [0.0, b], [1.0, 0.0])
        run = ql.simulate(
            plant, ql.ADRC(OBSERVER, omega_c=3.0), ql.Scenario(reference=1.0, duration=20.0)
        )
        assert run["y"][-1] == pytest.approx(1.0, abs=1e-4)


def test_a_negative_gain_and_a_plant_of_order_one_are_served() -> None:
    """Neither sign nor order is special."""
    plant = ql.plants.LinearPlant([[-2.0]], [-3.0], [1.0])
    controller = ql.ADRC(
        ESO.model_free(order=1, b0=-3.0, omega_o=20.0, dt=0.01),
        omega_c=2.0,
        learner=ql.learners.Kalman(),
    )
    run = ql.simulate(
        plant,
        controller,
        ql.Scenario(reference=1.0, duration=10.0, disturbances=(ql.signals.Step(at=5.0),)),
    )
    assert run["y"][run.window(4.9, 5.0)][-1] == pytest.approx(1.0, abs=1e-3)
    assert run["y"][-1] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_bad_measurement_is_held_and_never_reaches_the_output(bad: float) -> None:
    """As if the one that the observer expects had come; status and later samples show it."""
    one, other = (ql.ADRC(OBSERVER, omega_c=3.0) for _ in range(2))
    u = 0.0
    for y in (0.1, 0.2):
        one.step(1.0, y)
        u = other.step(1.0, y)
    model = OBSERVER.model
    awaited = float((model.transition @ other.state["z"] + model.input * u)[0])
    assert one.step(1.0, bad) == pytest.approx(other.step(1.0, awaited), rel=1e-12)
    assert one.estimate.status == ql.Status.MEASUREMENT_HELD
    assert one.step(1.0, 0.3) == pytest.approx(other.step(1.0, 0.3), rel=1e-12)
    assert one.estimate.status == ql.Status.OK


@pytest.mark.parametrize("delay", [0.0, 0.03])
def test_samples_that_are_lost_while_the_plant_moves_are_no_blow(delay: float) -> None:
    """Three in a row, in the middle of a step that is answered as the observer's model has it: nothing is to be seen of them in y or u."""
    plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 2.0], [1.0, 0.0])
    if delay:
        plant = ql.plants.delayed(plant, delay, 0.01)
    runs = []
    for lost in ((), (40, 41, 42)):
        controller = ql.ADRC(
            ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=0.01, delay=delay), omega_c=3.0
        )
        model, x, scratch = plant.sampled(0.01), np.zeros(plant.order), np.zeros(6 * plant.order)
        run = []
        for k in range(200):
            y = measure(model, x)
            u = controller.step(1.0, math.nan if k in lost else y)
            advance(model, x, scratch, 0.01 * k, u, np.zeros(plant.disturbances))
            run.append((y, u))
        runs.append(run)
    assert max(y for y, _ in runs[0]) > 0.9
    np.testing.assert_allclose(runs[1], runs[0], atol=1e-9)


def test_a_bad_reference_is_held_too() -> None:
    """The last good one holds."""
    one, other = (ql.ADRC(OBSERVER, omega_c=3.0) for _ in range(2))
    one.step(1.0, 0.0)
    other.step(1.0, 0.0)
    assert one.step(math.nan, 0.1) == other.step(1.0, 0.1)
    assert one.estimate.status == ql.Status.REFERENCE_HELD


def test_without_a_reference_the_plant_stays_where_it_is() -> None:
    """Until the first good one comes."""
    controller = ql.ADRC(OBSERVER, omega_c=3.0)
    assert controller.step(math.nan, 5.0) == 0.0
    assert controller.estimate.status == ql.Status.REFERENCE_HELD
    assert controller.step(6.0, 5.0) > 0.0
    sleeping = ql.ADRC(OBSERVER, omega_c=3.0)
    sleeping.step(1.0, math.nan)
    assert sleeping.step(math.nan, 0.0) > 0.0


@pytest.mark.parametrize("used", [False, True])
def test_a_controller_can_be_copied_and_sent_to_another_process(used: bool) -> None:
    """With its running state, which is then its own."""
    controller = ql.ADRC(OBSERVER, omega_c=3.0, learner=ql.learners.Kalman())
    if used:
        for k in range(50):
            controller.step(1.0, 0.01 * k)
    for other in (
        copy.copy(controller),
        copy.deepcopy(controller),
        pickle.loads(pickle.dumps(controller)),
    ):
        mine = controller.state
        assert other.step(1.0, 0.7) == ql.ADRC.step(copy.deepcopy(controller), 1.0, 0.7)
        for name, array in controller.state.items():
            np.testing.assert_array_equal(array, mine[name])
        other.reset()
        assert other.estimate.u == 0.0


def test_the_observer_waits_for_its_first_good_measurement() -> None:
    """A sensor that wakes up late does not make a jump from zero, whatever the reference."""
    controller = ql.ADRC(OBSERVER, omega_c=3.0, u_min=-5.0, u_max=5.0)
    assert controller.step(100.0, math.nan) == 0.0
    controller.step(7.0, 7.0)
    np.testing.assert_allclose(controller.estimate.x, [7.0, 0.0])


def test_no_learner_however_mad_gets_a_bad_number_to_the_output() -> None:
    """Where the wish is no number the last control signal holds, the status says so, and the loop begins anew."""
    controller = ql.ADRC(
        OBSERVER,
        omega_c=3.0,
        learner=ql.learners.BatchGradient(rate=1e300, batch=1),
        u_min=-1.0,
        u_max=1.0,
    )
    statuses = set()
    for k in range(400):
        u = controller.step(1.0, math.sin(0.1 * k))
        assert math.isfinite(u)
        assert abs(u) <= 1.0
        statuses.add(controller.estimate.status)
    assert any(ql.Status.OVERFLOWED in status for status in statuses)


@pytest.mark.parametrize(
    "learner", [None, ql.learners.Kalman(u=True), ql.learners.BatchGradient(rate=1e-4, batch=7)]
)
def test_a_saved_state_goes_on_without_a_trace(
    learner: object, tmp_path: Path, rng: np.random.Generator
) -> None:
    """Through a file without pickle, into another controller: the same bits from there on."""
    one, other = (ql.ADRC(OBSERVER, omega_c=3.0, learner=learner) for _ in range(2))
    y = np.cumsum(rng.normal(size=200)) * 0.01
    for k in range(100):
        one.step(0.5, y[k])
    np.savez(tmp_path / "state.npz", **one.state)
    with np.load(tmp_path / "state.npz", allow_pickle=False) as saved:
        other.state = saved
    for k in range(100, 200):
        assert one.step(0.5, y[k]) == other.step(0.5, y[k])


def test_reset_goes_back_to_the_beginning() -> None:
    """A controller that was reset is a new one."""
    controller = ql.ADRC(OBSERVER, omega_c=3.0, learner=ql.learners.Kalman())
    first = [controller.step(1.0, 0.1 * k) for k in range(100)]
    controller.reset()
    assert [controller.step(1.0, 0.1 * k) for k in range(100)] == first


def test_preparing_does_not_count_as_a_sample() -> None:
    """It compiles, and changes nothing."""
    controller = ql.ADRC(OBSERVER, omega_c=3.0)
    before = controller.state
    controller.prepare()
    for name, array in controller.state.items():
        np.testing.assert_array_equal(array, before[name])


def test_the_estimate_says_what_is_known() -> None:
    """State, shares of f, θ by the name of its feature, u."""
    controller = ql.ADRC(OBSERVER, omega_c=3.0, learner=ql.learners.Kalman(u=True))
    u = controller.step(1.0, 0.5)
    known = controller.estimate
    assert known.u == u
    assert known.f == known.f_learned + known.f_residual
    assert list(known.theta) == ["x1", "x2", "bias", "u"]
    np.testing.assert_allclose(known.x, [0.5, 0.0])


@cases(
    ("make", "message"),
    [
        (
            lambda: ql.ADRC(OBSERVER, omega_c=-1.0),
            "omega_c = -1.0: must be finite and greater than zero",
        ),
        (
            lambda: ql.ADRC(OBSERVER, omega_c=1.0, u_min=1.0, u_max=1.0),
            "u_min = 1.0, u_max = 1.0: u_min must be less than u_max",
        ),
        (
            lambda: ql.ADRC(OBSERVER, omega_c=1.0, u_min=math.nan),
            "u_min = nan, u_max = inf: u_min must be less than u_max",
        ),
        (
            lambda: ql.ADRC(OBSERVER, omega_c=1.0, rate_limit=0.0),
            "rate_limit = 0.0: must be greater than zero",
        ),
        (lambda: ql.ADRC("eso", omega_c=1.0), "observer = 'eso': must be an ESO"),
        (
            lambda: ql.ADRC(OBSERVER, omega_c=1.0, learner=ql.learners.Kalman),
            "learner = .*: must be a learner, for example",
        ),
        (
            lambda: ql.ADRC(OBSERVER, omega_c=1e300),
            "omega_c = 1e[+]300 rad/s: its power 2 must be finite",
        ),
        (
            lambda: setattr(
                ql.ADRC(OBSERVER, omega_c=1.0),
                "state",
                ql.ADRC(OBSERVER, omega_c=1.0).state | {"z": "x"},
            ),
            r"state\['z'\]: must be an array of numbers",
        ),
        (
            lambda: setattr(ql.ADRC(OBSERVER, omega_c=1.0), "state", {}),
            r"state has \[\]: must have",
        ),
        (
            lambda: setattr(
                ql.ADRC(OBSERVER, omega_c=1.0),
                "state",
                ql.ADRC(OBSERVER, omega_c=1.0).state | {"z": np.zeros(9)},
            ),
            r"state\['z'\] has shape \(9,\): must have \(3,\)",
        ),
    ],
)
def test_a_mistake_is_named(make: object, message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


def test_a_measurement_that_is_no_number_is_refused_before_anything_changes() -> None:
    """``step`` takes numbers."""
    controller = ql.ADRC(OBSERVER, omega_c=1.0)
    controller.step(1.0, 0.0)
    before = controller.state
    for bad in (None, [0.1], 1j):
        with pytest.raises(TypeError):
            controller.step(1.0, bad)  # type: ignore[arg-type]
    for name, array in controller.state.items():
        np.testing.assert_array_equal(array, before[name])
