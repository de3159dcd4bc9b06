"""Learners made of models: pairs without lag bias, scaling, and the two black boxes."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql
from quell.features import Bias, State
from quell.learners.base import adapt, commit, lag_of, lag_push, predict, restart
from quell.learners.gaussian_process import GaussianProcessModel
from quell.learners.online import Network, infer, learn
from quell.learners.rls import RlsRule, least_squares_gain
from quell.types import Matrix, Vector

from .cases import cases

OBSERVER = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=2e-3)


class PlainRule(NamedTuple):
    """Least squares without forgetting."""

    rule: RlsRule
    features: int


class PlainMemory(NamedTuple):
    """State of it."""

    theta: Vector
    covariance: Matrix
    gain: Vector


class Plain:
    """A model of one's own: least squares."""

    def design(self, features: int, dt: float) -> PlainRule:
        """Return the parameters."""
        return PlainRule(RlsRule(1.0, 0.0, 1e6), features)

    def memory(self, parameters: PlainRule) -> PlainMemory:
        """Return the state."""
        return PlainMemory(
            np.zeros(parameters.features),
            1e6 * np.eye(parameters.features),
            np.zeros(parameters.features),
        )


@infer.register(PlainRule)
def _infer(model: PlainRule, memory: PlainMemory, features: Vector) -> float:
    output = 0.0
    for i in range(features.size):
        output += memory.theta[i] * features[i]
    return output


@learn.register(PlainRule)
def _learn(model: PlainRule, memory: PlainMemory, features: Vector, target: float) -> None:
    step = (target - infer(model, memory, features)) * least_squares_gain(
        model.rule, memory.covariance, memory.gain, features, 1.0
    )
    for i in range(features.size):
        memory.theta[i] += step * memory.gain[i]


def learned(delay: int | None) -> np.ndarray:
    """θ in the plant's units, from f = −3 x_1 − 0.4 x_2 + 0.5 as the observer shows it; ``delay`` overrides that of the pairs."""
    learner = ql.learners.Online(Plain(), State() + Bias(), scale=[2.0, 2.0, 1.0, 8.0])
    design = learner.design(OBSERVER, 2.0)
    if delay is not None:
        design = design._replace(delay=delay)
    memory = learner.memory(design)
    lag, chain, shown = lag_of(OBSERVER), np.zeros((1, 3)), 0.0
    for k in range(5_000):
        t = k * OBSERVER.dt
        seen = np.array(
            [
                math.sin(0.8 * t) + 0.5 * math.sin(1.5 * t),
                0.8 * math.cos(0.8 * t) + 0.75 * math.cos(1.5 * t),
                0.0,
            ]
        )
        adapt(design, memory, seen, seen[0] + 1e-9, 0.0, shown)
        commit(design, memory, seen, 0.0, 0.0)
        shown = lag_push(lag, chain, 0, -3.0 * seen[0] - 0.4 * seen[1] + 0.5)
    return memory.model.theta * memory.scale[-1] / np.array([memory.scale[0], memory.scale[1], 1.0])


@pytest.mark.parametrize("rest", [0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 100.0])
def test_noise_at_rest_changes_no_scale_and_so_no_prediction(rest: float) -> None:
    """It takes y, at rest at a round number, 5 % beyond: there a power of two would double."""
    learner = ql.learners.Online(Plain(), State() + Bias(), bias_bandwidth=0.0)
    design = learner.design(OBSERVER, 2.0)
    memory = learner.memory(design)
    memory.loop[0].samples = 1e6
    memory.model.theta[:] = [0.4, -0.3, 0.2]
    seen = np.array([rest, 0.5 * rest, 0.0])
    adapt(design, memory, seen, rest, 0.25, 0.1)
    scale, before = memory.scale.copy(), predict(design, memory, seen, 0.25)[0]
    adapt(design, memory, 1.05 * seen, 1.05 * rest, 0.25, 0.1)
    assert memory.scale.tolist() == scale.tolist()
    assert predict(design, memory, seen, 0.25)[0] == pytest.approx(before, abs=1e-9)


@pytest.mark.trial
def test_pairs_without_lag_teach_without_bias() -> None:
    """Delayed by the observer's group delay the features give the plant; paired with the newest features they do not."""
    np.testing.assert_allclose(learned(None), [-3.0, -0.4, 0.5], atol=0.1)
    assert np.max(np.abs(learned(0) - [-3.0, -0.4, 0.5])) > 0.3


def surface(x: np.ndarray) -> float:
    """A function with a fold, of O(1)."""
    return 0.5 * math.tanh(4.0 * x[1]) + 0.4 * x[0] ** 3 - 0.2


def fitted(model: Any, samples: int, rng: np.random.Generator) -> tuple[Any, Any, float]:
    """A model after so many noisy pairs, and the RMS error it is left with."""
    design = model.design(2, 1.0)
    memory = model.memory(design)
    for _ in range(samples):
        x = rng.uniform(-1.0, 1.0, 2)
        learn(design, memory, x, surface(x) + 0.02 * rng.normal())
    return (
        design,
        memory,
        math.sqrt(
            np.mean(
                [
                    (infer(design, memory, x) - surface(x)) ** 2
                    for x in rng.uniform(-0.9, 0.9, (500, 2))
                ]
            )
        ),
    )


@pytest.mark.trial
def test_a_network_fits_a_nonlinear_function(rng: np.random.Generator) -> None:
    """From a thousand pairs; its gradient is the derivative of what it infers."""
    design, memory, left = fitted(Network(8, 0, 1, math.inf, 0.05, 1e-3), 1000, rng)
    assert left < 0.04
    x = np.array([0.3, -0.2])
    learn(design._replace(rule=RlsRule(1e30, 0.0, 1.0)), memory, x, 0.0)
    for i in range(memory.theta.size):
        at, step = memory.theta[i], 1e-6
        memory.theta[i] = at + step
        above = infer(design, memory, x)
        memory.theta[i] = at - step
        below = infer(design, memory, x)
        memory.theta[i] = at
        assert memory.gradient[i] == pytest.approx((above - below) / (2.0 * step), abs=1e-7)


def test_noise_in_the_targets_counts_for_as_many_pairs_as_it_lasts() -> None:
    """``σ² max(τ/step, 1)``, with ``step`` the time between two pairs, which also counts for forgetting."""
    for every, dt, count in ((1, 0.1, 5.0), (2, 0.1, 2.5), (4, 0.1, 1.25), (9, 0.1, 1.0)):
        rule = Network(2, 0, every, 3.0, 0.2, 0.5).design(2, dt).rule
        process = GaussianProcessModel(5, 0.5, every, 3.0, 0.2, 0.5).design(2, dt)
        for found in (rule, process):
            assert found.noise == pytest.approx(0.04 * count, rel=1e-12)
            assert 1.0 - found.forget == pytest.approx(math.exp(-every * dt / 3.0), rel=1e-12)


def test_models_take_their_times_from_controller_and_observer() -> None:
    """They remember 100/omega_c or 1000/omega_c by default; noise lasts as long as the observer's lag."""
    for make, name, lags in (
        (ql.learners.MLP, "rule", 100.0),
        (ql.learners.GaussianProcess, "", 1000.0),
    ):
        for memory_time in (None, 7.0):
            learner = make(every=2, noise=0.2, memory_time=memory_time)
            found = learner.design(OBSERVER, 4.0).model
            found = getattr(found, name) if name else found
            rate = 2 * OBSERVER.dt / (memory_time or lags / 4.0)
            assert -math.log1p(-found.forget) == pytest.approx(rate, rel=1e-9)
            lasts = 3 / 20.0 / (2 * OBSERVER.dt)
            assert found.noise == pytest.approx(0.04 * lasts, rel=1e-12)


def test_a_network_says_nothing_before_it_has_learned() -> None:
    """And the seed decides about its first weights."""
    design = Network(8, 3, 1, 1.0, 0.1, 1.0).design(2, 1.0)
    one, other = (Network(8, seed, 1, 1.0, 0.1, 1.0) for seed in (3, 4))
    assert infer(design, one.memory(design), np.ones(2)) == 0.0
    assert np.any(one.memory(design).theta != other.memory(other.design(2, 1.0)).theta)


@pytest.mark.trial
def test_a_process_fits_a_nonlinear_function_on_its_budget(rng: np.random.Generator) -> None:
    """Far from its points it says nothing."""
    design, memory, left = fitted(GaussianProcessModel(30, 0.5, 1, math.inf, 0.05, 1e-3), 400, rng)
    assert left < 0.05
    assert memory.counters[0] == 30
    assert abs(infer(design, memory, np.array([50.0, 50.0]))) < 1e-12
    count = int(memory.counters[0])
    identity = memory.inverse[:count, :count] @ memory.kernel[:count, :count]
    np.testing.assert_allclose(identity, np.eye(count), atol=1e-6)
    assert np.min(np.linalg.eigvalsh(memory.covariance[:count, :count])) > -1e-9


def test_a_process_is_a_gaussian_process_while_its_budget_lasts(rng: np.random.Generator) -> None:
    """Against the closed form: k(x)ᵀ (K + σ² I)⁻¹ y."""
    model = GaussianProcessModel(30, 0.2, 1, math.inf, 0.1, 1.0)
    design = model.design(2, 1.0)
    memory = model.memory(design)
    grid = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 2), -1).reshape(-1, 2)
    targets = rng.normal(size=25)
    for x, target in zip(grid, targets, strict=True):
        learn(design, memory, x, target)

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.exp(-np.sum((a[:, None] - b[None]) ** 2, axis=2) / (2.0 * 0.2**2))

    points = rng.uniform(-1.0, 1.0, (20, 2))
    expected = kernel(points, grid) @ np.linalg.solve(
        kernel(grid, grid) + design.noise * np.eye(25), targets
    )
    np.testing.assert_allclose([infer(design, memory, x) for x in points], expected, atol=1e-9)


def test_a_process_follows_its_equations_when_points_are_added_and_removed(
    rng: np.random.Generator,
) -> None:
    """Van Vaerenbergh et al., eqs. (9)-(13), with matrices; the point is removed that costs least."""
    model = GaussianProcessModel(6, 0.6, 1, 30.0, 0.2, 1.0)
    design, keep, noise = model.design(2, 1.0), math.exp(-1.0 / 30.0), 0.04
    memory = model.memory(design)

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.exp(-np.sum((a[:, None] - b[None]) ** 2, axis=2) / (2.0 * 0.6**2))

    points, mean, cov, merged = np.zeros((0, 2)), np.zeros(0), np.zeros((0, 0)), 0
    for k in range(60):
        x, target = rng.uniform(-1.0, 1.0, 2), rng.normal()
        if k % 5 == 4:
            x = points[0] + 0.01
        learn(design, memory, x, target)
        K = kernel(points, points)
        mean, cov = math.sqrt(keep) * mean, keep * cov + (1.0 - keep) * K
        to_x = kernel(points, x[None])[:, 0]
        q = np.linalg.solve(K, to_x)
        novelty, h = 1.0 - to_x @ q, cov @ q
        variance, error = novelty + q @ h, target - q @ mean
        if novelty > 1e-2:
            points, mean = np.vstack([points, x]), np.append(mean, q @ mean)
            h = np.append(h, variance)
            cov = np.block([[cov, h[:-1, None]], [h[None]]])
        else:
            merged += 1
        mean, cov = mean + h * error / (variance + noise), cov - np.outer(h, h) / (variance + noise)
        if len(points) > 6:
            Q = np.linalg.inv(kernel(points, points))
            out = int(np.argmin((Q @ mean) ** 2 / np.diag(Q)))
            points, mean = np.delete(points, out, 0), np.delete(mean, out)
            cov = np.delete(np.delete(cov, out, 0), out, 1)
        assert memory.counters[0] == len(points)
        there = np.vstack([points, rng.uniform(-1.0, 1.0, (3, 2))])
        expected = kernel(there, points) @ np.linalg.solve(kernel(points, points), mean)
        np.testing.assert_allclose([infer(design, memory, x) for x in there], expected, atol=1e-7)
        count = len(points)
        order = [int(np.argmin(np.sum((memory.points[:count] - c) ** 2, axis=1))) for c in points]
        found = memory.covariance[:count, :count][np.ix_(order, order)]
        np.testing.assert_allclose(found, cov, atol=1e-7)
    assert merged > 5


def test_a_network_follows_the_equations_of_its_filter(rng: np.random.Generator) -> None:
    """The extended Kalman filter with directional forgetting; errors and weights are bounded."""
    model = Network(3, 1, 2, 9.0, 0.3, 4.0)
    design = model.design(2, 0.5)
    memory = model.memory(design)
    theta, P = memory.theta.copy(), 9.0 * np.eye(13)
    first = theta[:12].reshape(3, 4)
    assert not np.any(first[:, 0])
    # Each unit switches within the range of the features: c_j + W_j φ = 0 for a φ in [−1, 1]².
    assert np.all(np.abs(first[:, 1]) <= np.sum(np.abs(first[:, 2:]), axis=1))
    assert np.std(first[:, 2:]) == pytest.approx(3.0, rel=0.7)
    many = Network(400, 1, 2, 9.0, 0.3, 4.0)
    wide = many.memory(many.design(2, 0.5)).theta[:-1].reshape(400, 4)
    assert np.std(wide[:, 2:]) == pytest.approx(3.0, rel=0.1)
    assert np.std(wide[:, 1]) == pytest.approx(3.0 * math.sqrt(2.0 / 3.0), rel=0.1)
    assert abs(np.corrcoef(wide[:, 1], wide[:, 2] + wide[:, 3])[0, 1]) < 0.2
    R, keep, bounded = 0.09 * 4.0, math.exp(-1.0 / 9.0), 0
    for k in range(120):
        x, target = rng.uniform(-1.0, 1.0, 2), 3.0 * rng.normal() if k > 60 else rng.normal()
        learn(design, memory, x, target)
        if k % 2 == 1:  # every second pair
            v, c, W = theta[:12:4], theta[1:12:4], theta[:12].reshape(3, 4)[:, 2:]
            unit = np.tanh(c + W @ x)
            slope = v * (1.0 - unit**2)
            g = np.append(np.column_stack([unit, slope, slope[:, None] * x]).ravel(), 1.0)
            error = np.clip(target - theta[12] - v @ unit, -1.0, 1.0)
            gain = P @ g
            zeta = g @ gain / R
            theta = np.clip(theta + gain * error / (R * (1.0 + zeta)), -30.0, 30.0)
            bounded += abs(error) == 1.0
            factor = (keep - (1.0 - keep) / zeta) / (R * keep * (1.0 + zeta))
            P = P - factor * np.outer(gain, gain)
            assert np.trace(P) < 13 * 9.0
        np.testing.assert_allclose(memory.theta, theta, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(memory.covariance, P, rtol=1e-5, atol=1e-8)
    assert bounded > 10
    memory.theta[:] = 29.9
    for _ in range(4):
        learn(design, memory, np.ones(2), 1e9)
    assert np.max(np.abs(memory.theta)) <= 30.0
    before = memory.theta.copy()
    learn(design, memory, np.ones(2), math.nan)
    learn(design, memory, np.ones(2), math.nan)
    np.testing.assert_array_equal(memory.theta, before)


def test_rounding_of_the_inverse_makes_no_novelty_negative() -> None:
    """A point as known as can be: γ² is zero and no less, also where Q is a little too large."""
    model = GaussianProcessModel(5, 0.5, 1, math.inf, 0.1, 1.0)
    design = model.design(2, 1.0)
    memory, x = model.memory(design), np.array([0.2, -0.1])
    learn(design, memory, x, 1.0)
    memory.inverse[0, 0] = q = 1.01
    mean, variance = memory.mean[0], memory.covariance[0, 0]
    learn(design, memory, x, 2.0)
    gain = variance * q / (variance * q**2 + design.noise)
    assert memory.mean[0] == pytest.approx(mean + gain * (2.0 - q * mean), rel=1e-12)


def test_a_process_forgets_towards_its_prior() -> None:
    """``μ ← √λ μ`` and ``Σ ← λΣ + (1−λ)K`` with each pair, wherever it is."""
    model = GaussianProcessModel(5, 0.5, 1, 4.0, 0.1, 1.0)
    design = model.design(1, 0.5)
    keep = math.exp(-0.5 / 4.0)
    assert 1.0 - design.forget == pytest.approx(keep, rel=1e-12)
    memory = model.memory(design)
    learn(design, memory, np.array([0.0]), 1.0)
    learn(design, memory, np.array([0.4]), -1.0)
    mean, covariance, K = memory.mean[:2].copy(), memory.covariance[:2, :2].copy(), memory.kernel
    learn(design, memory, np.array([90.0]), 0.0)  # far away: it tells nothing of the others
    np.testing.assert_allclose(memory.mean[:2], math.sqrt(keep) * mean, rtol=1e-12)
    expected = keep * covariance + (1.0 - keep) * K[:2, :2]
    np.testing.assert_allclose(memory.covariance[:2, :2], expected, rtol=1e-12)


def test_a_process_with_a_budget_of_one_still_works(rng: np.random.Generator) -> None:
    """The smallest there is."""
    _, memory, _ = fitted(GaussianProcessModel(1, 0.5, 1, 100.0, 0.1, 1.0), 200, rng)
    assert memory.counters[0] == 1
    assert all(np.all(np.isfinite(array)) for array in memory)


@pytest.mark.parametrize(
    "learner", [ql.learners.MLP(every=5), ql.learners.GaussianProcess(every=5)]
)
def test_a_model_can_learn_from_every_so_many_th_sample(
    learner: Any, rng: np.random.Generator
) -> None:
    """And stays as it is in between."""
    design = learner.design(OBSERVER, 1.0)
    assert design.model.every == 5
    memory, changed, before = learner.memory(design), [], None
    for k in range(600):
        seen = rng.normal(size=3)
        adapt(design, memory, seen, seen[0] + 1e-6, 0.3, seen[0])
        commit(design, memory, seen, 0.3, 0.0)
        # The model's last array counts the pairs.
        learned = np.concatenate([array.ravel() for array in memory.model[:-1]])
        if before is not None and np.any(learned != before):
            changed.append(k)
        before = learned
    assert len(changed) > 10
    assert set(np.diff(changed)) == {5}


def test_what_a_model_learned_is_kept_unless_it_is_no_number(rng: np.random.Generator) -> None:
    """By ``restart``."""
    learner = ql.learners.MLP()
    design = learner.design(OBSERVER, 1.0)
    memory = learner.memory(design)
    memory.model.theta[0] = 0.25
    restart(design, memory)
    assert memory.model.theta[0] == 0.25
    assert predict(design, memory, np.ones(3), 0.0) == (0.0, 0.0)
    memory.model.theta[1] = math.nan
    restart(design, memory)
    np.testing.assert_array_equal(memory.flat, memory.initial)
    assert np.shares_memory(memory.model.theta, memory.flat)


@cases(
    ("make", "message"),
    [
        (lambda: ql.learners.Online(Plain), "model = .*: must have design"),
        (lambda: ql.learners.Online(3), "model = 3: must have design"),
        (lambda: ql.learners.Online(Plain(), "x1"), "features = 'x1': must be made of blocks"),
        (lambda: ql.learners.Online(Plain(), scale=[-1.0]), r"scale = \[-1.0\]: must be positive"),
        (
            lambda: ql.learners.Online(Plain(), bias_bandwidth=-1.0),
            "bias_bandwidth = -1.0: must be finite and not negative",
        ),
        (lambda: ql.learners.MLP(hidden=0), "hidden = 0: must be a whole number of at least 1"),
        (lambda: ql.learners.MLP(memory_time=0.0), "memory_time = 0.0: must be greater than zero"),
        (lambda: ql.learners.MLP(noise=0.0), "noise = 0.0: must be finite and greater than zero"),
        (lambda: ql.learners.MLP(every=0), "every = 0: must be a whole number of at least 1"),
        (lambda: ql.learners.MLP(seed=-1), "seed = -1: must be a whole number of at least 0"),
        (
            lambda: ql.learners.GaussianProcess(budget=0),
            "budget = 0: must be a whole number of at least 1",
        ),
        (
            lambda: ql.learners.GaussianProcess(length=0.0),
            "length = 0.0: must be finite and greater than zero",
        ),
        *(
            (lambda values=values: ql.learners.GaussianProcess(**values), f"{name} = {value}: must")
            for values in ({"every": 0}, {"memory_time": -1.0}, {"noise": 0.0})
            for name, value in values.items()
        ),
        (lambda: ql.learners.BatchGradient(features=3), "features = 3: must be made of blocks"),
    ],
)
def test_a_mistake_is_named(make: Any, message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    "learner",
    [ql.learners.MLP(), ql.learners.GaussianProcess(), ql.learners.Repetitive(1.0)],
    ids=lambda learner: type(learner).__name__,
)
def test_an_observer_too_slow_for_the_memory_of_a_learner_is_refused(learner: Any) -> None:
    """By the number of samples of its lag, before memory for them is asked for."""
    slow = ql.ESO.model_free(order=2, b0=1.0, omega_o=1e-9, dt=0.01)
    rule = r"its lag is 3e\+09 s, 3e\+11 samples of dt = 0.01 s: must be at most 100000 for "
    with pytest.raises(ValueError, match=rule + type(learner).__name__):
        ql.ADRC(slow, omega_c=1e-10, learner=learner)
    oven = ql.ESO.model_free(order=1, b0=0.01, omega_o=1e-3, dt=1.0)
    ql.ADRC(oven, omega_c=2e-4, learner=learner if learner.__class__ is not ql.learners.Repetitive
            else ql.learners.Repetitive(600.0))  # fmt: skip
