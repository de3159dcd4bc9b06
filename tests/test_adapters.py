"""Learners that are Python objects: what they gain and what is kept of them."""

from __future__ import annotations

import copy
import dataclasses
import gc
import math
import pickle
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.learners.python_model import INSTANCES, finite_number
from quell.types import Status

from .cases import cases
from .contracts.python_models import (
    CHAIN,
    HARD_SPRING,
    OBSERVER,
    SHORT,
    Counter,
    LeastMeanSquares,
    has,
    law,
    python_learners,
    torch_mlp,
)

pytestmark = pytest.mark.compiled

PythonModel = ql.learners.PythonModel
LEARNERS = python_learners()
LINEAR = ("PythonModel", "SGDRegressor")
"""What linear models learn is judged by their coefficients."""


def driven(plant: Any, learner: Any, end: float) -> ql.Trajectory:
    """Run a loop with a sinusoid as reference, as Python."""
    noise = ql.signals.BandLimitedNoise(1e-10, 0.01)
    scenario = ql.Scenario(ql.signals.Sinusoid(omega=1.5), duration=end, noise=noise)
    return ql.simulate(plant, law(learner), scenario, interpret=True)


ideal = cache(lambda end: driven(CHAIN, None, end)["y"])


def deviation(run: ql.Trajectory, start: float, end: float) -> float:
    """RMS deviation of y from the ideal loop, from start to end [s]."""
    return float(np.sqrt(np.mean((run["y"] - ideal(end))[run.window(start, end)] ** 2)))


@cache
def plain_deviation() -> float:
    """That of the plain ESO, which repeats itself from the first periods on."""
    return deviation(driven(HARD_SPRING, None, 20.0), 10.0, 20.0)


@pytest.mark.trial
@pytest.mark.parametrize("name", [name for name in LEARNERS if name not in LINEAR])
def test_a_python_model_learns_a_hard_spring(name: str) -> None:
    """It takes two thirds of what the plain ESO leaves of a spring and drag it was told nothing of."""
    run = driven(HARD_SPRING, LEARNERS[name], 30.0)
    assert Status.LEARNER_FAILED not in run.status
    assert deviation(run, 20.0, 30.0) < plain_deviation() / 3.0


@pytest.mark.trial
@pytest.mark.parametrize(
    ("library", "form"),
    [("none", "current"), ("none", "predictor"), ("sklearn", "current"), ("river", "current")],
)
def test_what_a_linear_model_learns_has_no_lag_bias(library: str, form: str) -> None:
    """A load −6 x_1 − x_2 is found to 2 %; pairing f̂ with the x̂ of the same moment misses the second by more than its whole size."""
    if library != "none" and not has({"sklearn": "sklearn", "river": "river"}[library]):
        pytest.skip(f"{library} is not installed")
    plant = ql.plants.LinearPlant([[0.0, 1.0], [-6.0, -1.0]], [0.0, 1.0], [1.0, 0.0])
    scale = np.array([1.0, 2.0, 10.0, 8.0])
    make: dict[str, Any] = {
        "none": lambda: (PythonModel(LeastMeanSquares(), scale=scale), lambda m: m.theta)
    }
    if library == "sklearn":
        from sklearn.linear_model import SGDRegressor

        estimator = SGDRegressor(learning_rate="constant", eta0=0.1, alpha=0.0, fit_intercept=False)
        make["sklearn"] = lambda: (
            ql.learners.SklearnModel(estimator, scale=scale),
            lambda m: m.coef_,
        )
    if library == "river":
        from river import linear_model, optim

        regression = linear_model.LinearRegression(optimizer=optim.SGD(0.05), intercept_lr=0.0)
        make["river"] = lambda: (
            ql.learners.RiverModel(regression, scale=scale),
            lambda m: [m.weights[0], m.weights[1]],
        )
    learner, read = make[library]()
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=15.0, dt=1e-2, form=form)
    scenario = ql.Scenario(
        reference=ql.signals.Sinusoid(omega=1.0) + ql.signals.Sinusoid(0.3, omega=1.7),
        duration=50.0,
    )
    run = ql.simulate(
        plant, ql.ADRC(observer, omega_c=4.0, learner=learner), scenario, interpret=True
    )
    theta = np.array(read(learner.trained(run.final_state.learner))) * scale[3] / scale[:2]
    np.testing.assert_allclose(theta, [-6.0, -1.0], rtol=0.02, atol=0.05)

    if library != "none":
        return
    shorter = dataclasses.replace(scenario, duration=30.0)
    seen = ql.simulate(plant, ql.ADRC(observer, omega_c=4.0), shorter, interpret=True)
    late = seen.window(10.0, 30.0)
    naive = np.linalg.lstsq(seen["x_hat"][late], seen["f_hat"][late], rcond=None)[0]
    assert abs(naive[1] + 1.0) > 1.0


def test_the_model_is_called_once_a_period_with_all_pairs_since() -> None:
    """The first call has one pair, each other a period's."""
    for period in (1, 7):
        learner = PythonModel(Counter(), period=period, scale=np.ones(4))  # which does not grow
        scenario = ql.Scenario(reference=ql.signals.Sinusoid(), duration=3.0)
        run = ql.simulate(CHAIN, law(learner), scenario, interpret=True)
        batches = learner.trained(run.final_state.learner).batches
        assert set(batches[1:]) == {period}
        assert batches[0] == 1
        design = learner.design(OBSERVER, 4.0)
        assert len(batches) == math.ceil(
            (len(run) - 2 - design.online.inputs.startup - design.online.delay) / period
        )
        assert len(np.unique(run["f_learned"])) <= len(batches) + 1


@pytest.mark.trial
@pytest.mark.parametrize("name", LEARNERS)
def test_the_loop_of_ones_own_is_the_simulated_loop(name: str) -> None:
    """``controller.step`` gives what ``simulate`` gives."""
    run = ql.simulate(
        CHAIN, law(LEARNERS[name]), ql.Scenario(reference=ql.signals.Sinusoid(), duration=2.0)
    )
    controller = law(LEARNERS[name])
    u = [controller.step(r, y) for r, y in zip(run["r"], run["y_measured"], strict=True)]
    # The two entry points are compiled apart, and may fuse otherwise.
    np.testing.assert_allclose(u, run["u"], rtol=1e-6, atol=1e-9)


@pytest.mark.trial
def test_a_model_within_its_budget_does_as_without() -> None:
    """The same numbers, when the loop waits long enough."""
    waited = ql.simulate(CHAIN, law(PythonModel(LeastMeanSquares(), budget=30.0)), SHORT)
    called = ql.simulate(CHAIN, law(PythonModel(LeastMeanSquares())), SHORT)
    assert Status.LEARNER_LATE not in waited.status
    np.testing.assert_array_equal(waited.log, called.log)


@pytest.mark.skipif(not has("torch"), reason="torch is not installed")
@pytest.mark.parametrize("kind", ["SGD", "Adam"])
def test_an_optimiser_of_torch_is_copied_with_its_module(kind: str) -> None:
    """The copy learns, the original does not: an optimiser given as an object belongs to the copy's parameters too."""
    import torch

    module = torch_mlp()
    before = copy.deepcopy(module.state_dict())
    learner = ql.learners.TorchModel(
        module, getattr(torch.optim, kind)(module.parameters(), lr=0.01), steps=2
    )
    run = ql.simulate(CHAIN, law(learner), SHORT)
    after = learner.trained(run.final_state.learner).state_dict()
    assert all(torch.equal(before[key], value) for key, value in module.state_dict().items())
    assert any(not torch.equal(before[key], value) for key, value in after.items())


@pytest.mark.trial
@pytest.mark.parametrize("name", LEARNERS)
def test_same_seed_same_bits(name: str) -> None:
    """Also in two threads at once, and after another run of the same controller."""
    controller = law(LEARNERS[name])
    first = ql.simulate(CHAIN, controller, SHORT)
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda _: ql.simulate(CHAIN, controller, SHORT), range(2)))
    for run in both:
        np.testing.assert_array_equal(run.log, first.log)


@pytest.mark.trial
@cases("name", LEARNERS)
def test_a_saved_state_goes_on_without_a_trace(name: str, rng: np.random.Generator) -> None:
    """Into another controller, twice from the same state; and so do copies and what was pickled."""
    one, other = law(LEARNERS[name]), law(LEARNERS[name])
    y = np.cumsum(rng.normal(size=500)) * 0.01
    for k in range(300):
        one.step(0.5, y[k])
    saved = one.state
    copies = [copy.copy(one), copy.deepcopy(one)]
    if name != "Equinox MLP":  # optax is made of functions within functions, which pickle refuses
        copies.append(pickle.loads(pickle.dumps(one)))
    expected = [one.step(0.5, y[k]) for k in range(300, 500)]
    for _ in range(2):
        other.state = saved
        assert [other.step(0.5, y[k]) for k in range(300, 500)] == expected
    for controller in copies:
        assert [controller.step(0.5, y[k]) for k in range(300, 500)] == expected
    one.reset()
    fresh = law(LEARNERS[name])
    assert [one.step(0.5, y[k]) for k in range(200)] == [fresh.step(0.5, y[k]) for k in range(200)]


@pytest.mark.trial
def test_a_state_that_does_not_fit_changes_nothing() -> None:
    """A number where the model should be is refused."""
    controller = law(PythonModel(LeastMeanSquares()))
    for k in range(300):
        controller.step(0.5, 0.01 * k)
    before = controller.state
    with pytest.raises(
        ValueError, match="state of LeastMeanSquares: must be what controller.state gave"
    ):
        controller.state = {
            **{name: 0.0 * array for name, array in before.items() if array.dtype != object},
            "learner.model": 3.0,
        }
    for name, array in controller.state.items():
        if array.dtype != object:
            np.testing.assert_array_equal(array, before[name])


@pytest.mark.trial
def test_the_model_passed_in_is_not_changed() -> None:
    """Nor does changing it later change the learner."""
    model = Counter()
    learner = PythonModel(model)
    first = ql.simulate(CHAIN, law(learner), SHORT)
    assert model.theta.size == 0
    assert model.batches == []
    model.rate = 1e9
    np.testing.assert_array_equal(ql.simulate(CHAIN, law(learner), SHORT).log, first.log)


@pytest.mark.trial
@pytest.mark.parametrize("budget", [None, 30.0])
def test_nothing_is_left_behind(budget: float | None) -> None:
    """With the last state goes its copy of the model, and its thread."""
    gc.collect()
    before, threads = set(INSTANCES), threading.active_count()
    controller = law(PythonModel(LeastMeanSquares(), budget=budget))
    run = ql.simulate(CHAIN, controller, SHORT)
    for k in range(300):
        controller.step(0.5, 0.01 * k)
    assert len(set(INSTANCES) - before) == 2
    del controller, run
    gc.collect()
    assert set(INSTANCES) <= before
    deadline = time.monotonic() + 10.0
    while threading.active_count() > threads and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() <= threads


@cases("value", [1.5, np.float32(1.5), np.array([1.5]), np.array([[1.5]]), np.array(1.5)])
def test_one_number_may_come_in_any_form(value: Any) -> None:
    """As libraries return it."""
    assert finite_number(value) == 1.5
