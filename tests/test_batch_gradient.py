"""Algorithm 1 against the algorithm as printed."""

from __future__ import annotations

import numpy as np
import pytest

import quell as ql
from quell.learners.base import adapt, coefficients, predict, restart
from quell.learners.batch_gradient import outputs
from quell.observers.eso import ESO

from .cases import cases


def literal_algorithm_1(seen: np.ndarray, u: np.ndarray, rate: float, batch: int) -> np.ndarray:
    """Algorithm 1 as printed: three lists, popped and pushed, the whole batch labelled anew; O(n) a sample."""
    inputs: list[np.ndarray] = []
    residuals: list[float] = []
    labels: list[float] = []
    theta = np.zeros(seen.shape[1] + 1)
    history = []
    for row, before in zip(seen, u, strict=True):
        feature = np.array([*row[:-1], before, 1.0])
        if len(inputs) == batch:
            inputs.pop(0)
            residuals.pop(0)
            labels.pop(0)
        inputs.append(feature)
        residuals.append(row[-1])
        labels.append(feature @ theta)
        if len(inputs) == batch:
            batch_inputs = np.array(inputs)
            targets = np.array(labels) + np.array(residuals)
            theta = theta - rate * batch_inputs.T @ (batch_inputs @ theta - targets)
            labels = list(batch_inputs @ theta)
        history.append(theta.copy())
    return np.array(history)


@cases("batch", [1, 2, 7, 50])
def test_algorithm_1_by_sliding_sums_is_algorithm_1_as_printed(
    batch: int, rng: np.random.Generator
) -> None:
    """The same θ at every sample, and the same third buffer at the end."""
    seen, u = rng.normal(size=(200, 4)), rng.normal(size=200)
    learner = ql.learners.BatchGradient(rate=1e-3, batch=batch).design(
        ESO.model_free(order=3, b0=1.0, omega_o=10.0, dt=1e-2), 1.0
    )
    memory = ql.learners.BatchGradient(rate=1e-3, batch=batch).memory(learner)
    expected = literal_algorithm_1(seen, u, 1e-3, batch)
    for row, before, theta in zip(seen, u, expected, strict=True):
        adapt(learner, memory, row, row[0], before, row[-1])
        np.testing.assert_allclose(memory.theta, theta, atol=1e-12)
    newest = np.column_stack([seen[-batch:, :3], u[-batch:], np.ones(batch)]) @ memory.theta
    np.testing.assert_allclose(np.sort(outputs(memory)), np.sort(newest), atol=1e-12)


def test_algorithm_1_is_silent_until_its_buffers_are_full(rng: np.random.Generator) -> None:
    """Warm-up as MF-ESO: no feedforward for the first n samples less one."""
    learner = ql.learners.BatchGradient(rate=1.0, batch=20)
    design = learner.design(ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=1e-2), 1.0)
    memory = learner.memory(design)
    for k in range(20):
        assert predict(design, memory, np.ones(3), 1.0) == (0.0, 0.0), k
        adapt(design, memory, rng.normal(size=3), 0.0, 0.1, 0.0)
    assert predict(design, memory, np.ones(3), 1.0) != (0.0, 0.0)


def test_algorithm_1_predicts_and_shows_theta_by_its_features() -> None:
    """``θ · (x̂_1 … x̂_n, u, 1)``, as a constant: it is not solved for u."""
    learner = ql.learners.BatchGradient()
    design = learner.design(ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=1e-2), 1.0)
    memory, theta = learner.memory(design), np.zeros(4)
    memory.theta[:] = 2.0, 3.0, 5.0, 7.0
    assert predict(design, memory, np.array([10.0, 0.1, 9.0]), -1.0) == (2e1 + 0.3 - 5.0 + 7.0, 0.0)
    coefficients(design, memory, theta)
    np.testing.assert_array_equal(theta, memory.theta)
    assert learner.feature_names(2) == ("x1", "x2", "u", "bias")


def test_without_u_the_other_features_learn_as_before(rng: np.random.Generator) -> None:
    """θ of x̂ and of the bias has the same bits, and u has no effect on the output."""
    found = []
    for u in (True, False):
        learner = ql.learners.BatchGradient(rate=1e-2, batch=3, u=u)
        design = learner.design(ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=1e-2), 1.0)
        memory = learner.memory(design)
        for row in np.random.default_rng(1).normal(size=(20, 3)):
            adapt(design, memory, row, row[0], 0.7, row[-1])
        found.append(memory.theta)
    np.testing.assert_array_equal(np.delete(found[0], 2), found[1])
    assert learner.feature_names(2) == ("x1", "x2", "bias")
    seen = rng.normal(size=3)
    assert predict(design, memory, seen, 3.0) == predict(design, memory, seen, -8.0)


def test_a_position_outside_of_the_buffers_does_no_harm(rng: np.random.Generator) -> None:
    """It can only come from a state that somebody has changed: the nearest row is written."""
    learner = ql.learners.BatchGradient(batch=4)
    design = learner.design(ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=1e-2), 1.0)
    for position, row in ((1e9, 3), (-1e9, 0)):
        memory = learner.memory(design)
        assert memory.position.shape == (2,)
        memory.position[0] = position
        adapt(design, memory, np.array([1.0, 2.0, 3.0]), 1.0, 0.5, 3.0)
        assert np.flatnonzero(memory.residuals).tolist() == [row]
        assert 0 <= memory.position[0] < 4


def test_the_sliding_sum_of_algorithm_1_does_not_drift(rng: np.random.Generator) -> None:
    """A datum 1e12 times larger than the rest leaves no trace once the ring has come round twice."""
    learner = ql.learners.BatchGradient(rate=0.0, batch=16)
    design = learner.design(ESO.model_free(order=1, b0=1.0, omega_o=10.0, dt=1e-2), 1.0)
    memory = learner.memory(design)
    adapt(design, memory, np.array([1e6, 1e6]), 0.0, 0.0, 1e6)
    for _ in range(40):
        adapt(design, memory, rng.normal(size=2), 0.0, 0.3, 0.0)
    np.testing.assert_allclose(memory.total, memory.residuals @ memory.features, rtol=1e-12)


def test_a_learner_that_left_the_range_of_numbers_begins_anew(rng: np.random.Generator) -> None:
    """Restarting keeps what was learned and is in the buffers, but not where it is no number."""
    learner = ql.learners.BatchGradient(batch=4)
    design = learner.design(ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=1e-2), 1.0)
    memory = learner.memory(design)
    for lost in ("theta", "total"):
        for _ in range(6):
            adapt(design, memory, rng.normal(size=3), 0.0, 0.3, rng.normal())
        before = [array.copy() for array in memory]
        restart(design, memory)
        for array, kept in zip(memory, before, strict=True):
            np.testing.assert_array_equal(array, kept)
        getattr(memory, lost)[1] = np.inf
        memory.features[2, 1] = np.inf
        restart(design, memory)
        for name, fresh in learner.memory(design)._asdict().items():
            if name != "current":  # work space
                np.testing.assert_array_equal(getattr(memory, name), fresh)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: ql.learners.BatchGradient(rate=-1e-3),
            "rate = -0.001: must be finite and not negative",
        ),
        (
            lambda: ql.learners.BatchGradient(batch=0),
            "batch = 0: must be a whole number of at least 1",
        ),
        (
            lambda: ql.learners.BatchGradient(features=ql.features.Bias(), u=False),
            "u = False: leave it out, as features say whether u is among them",
        ),
    ],
)
def test_a_mistake_is_named(make: object, message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]
