"""Learners on scaled features against their equations, written with arrays, sample by sample."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.features import RBF, Bias, Input, State
from quell.features.base import unit, update_scale, write
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    forget,
    group_delay,
    lag_memory,
    lag_of,
    lag_push,
    noise_gate,
    noise_gate_memory,
    predict,
    relative_noise,
    restart,
    update_gate,
)
from quell.learners.online import infer, learn

DT, OMEGA_O, FREQUENCY, B0 = 5e-3, 21.0, 0.8, 1.5
OBSERVER = ql.ESO.model_free(order=2, b0=B0, omega_o=OMEGA_O, dt=DT)
LAG = 3 / OMEGA_O
STARTUP = round(2.0 * LAG / DT)


class Gate:
    """The equations of ``learners/base.py``."""

    def __init__(self, frequency: float = FREQUENCY) -> None:
        self.frequency = frequency
        noise = relative_noise(OBSERVER)
        self.f_noise = noise[2]
        self.least = 36.0 * noise / [1.0, 1.0, B0**2]
        self.mean, self.variance, self.noise = np.zeros(3), np.zeros(3), np.zeros(2)

    def update(self, x: np.ndarray, y: float, u: float) -> bool:
        """Take a sample; return whether x moves."""
        forget = -math.expm1(-DT / (10.0 * LAG))
        now = np.array([(y - x[0]) ** 2 + (1e-8 * y) ** 2, 1.0])
        self.noise += forget * (now - self.noise)
        away = np.append(x, u) - self.mean
        self.mean += forget * away
        self.variance += forget * (away**2 - self.variance)
        return bool(np.any(self.moving[:2]))

    @property
    def moving(self) -> np.ndarray:
        """Which signals move."""
        return self.variance * self.noise[1] > self.least * self.noise[0]

    def passed(self, x: np.ndarray, u: float) -> np.ndarray:
        """Return the signals, those at rest as means."""
        return np.where(self.moving, np.append(x, u), self.mean)

    def confidence(self, size: float) -> float:
        """Return ``F²/(F² + (3σ)²)``."""
        motion = (self.frequency**2 * size) ** 2 * self.noise[1]
        return float(motion / (motion + 9.0 * self.f_noise * self.noise[0]))


class Regression:
    """The equations of ``learners/regression``, with θ and the filters in the plant's units."""

    def __init__(self, learner: Any, bias_bandwidth: float = OMEGA_O) -> None:
        self.learner, self.design = learner, learner.design(OBSERVER, FREQUENCY)
        self.gate, self.lag = Gate(learner.frequency or FREQUENCY), lag_of(OBSERVER)
        self.p = len(learner.feature_names(2))
        self.scale = np.full(4, 1e-100) if learner.scale is None else learner.scale.copy()
        self.theta, self.filtered = np.zeros(self.p), np.zeros(self.p)  # in the plant's units
        self.chain = lag_memory(self.lag, self.p)
        self.bias, self.bias_gain = 0.0, min(bias_bandwidth * DT, 1.0)
        self.samples, self.learn_after, self.has_scale = 0, 0, False
        self.prior = getattr(learner, "prior", 10.0) ** 2
        self.P = self.prior * np.eye(self.p)

    @property
    def units(self) -> np.ndarray:
        """Return the factor of a feature when it is scaled."""
        out = np.zeros(self.p)
        unit(self.design.inputs.features, self.scale, out)
        return out

    def features(self, x: np.ndarray, u: float) -> np.ndarray:
        """Return the features in the plant's units."""
        out, passed = np.zeros(self.p), self.gate.passed(x, u) / self.scale[:3]
        write(self.design.inputs.features, passed[:2], float(passed[2]), out)
        return out / self.units

    def adapt(self, x: np.ndarray, y: float, u: float, f: float) -> None:
        """Take a sample."""
        moves = self.gate.update(x, y, u)
        if self.samples <= STARTUP:
            return
        before, old = self.scale.copy(), self.units
        update_scale(self.design.inputs.scaling, self.scale, np.append(x, 0.0), u, f, True)
        if not self.has_scale:
            self.has_scale, self.samples = True, 0
            return
        seen = 3 if self.learner.features.has_input else 2
        if np.any(self.scale[:seen] != before[:seen]):
            lost = (self.units == old) & self.nonlinear
            if np.any(self.scale[:2] != before[:2]) and np.any(lost):
                self.theta[lost] = self.filtered[lost] = self.chain[lost] = 0.0
                self.learn_after = self.samples + STARTUP
            self.P = self.prior * np.eye(self.p)
        error = f - self.theta @ self.filtered
        self.bias += self.bias_gain * (error - self.bias)
        share = self.gate.confidence(self.scale[0])
        if not moves or share < 0.1 or self.samples <= self.learn_after:
            return
        phi, error = self.filtered * self.units, error / self.scale[3]
        self.theta += self.step(phi, error, share) * self.units * self.scale[3]
        if self.learner.features.has_input:
            low, high = self.learner.gain_interval
            within = np.clip(self.theta[-1], B0 * (low - 1.0), B0 * (high - 1.0))
            if not isinstance(self.learner, ql.learners.NLMS):  # the nearest θ in the metric of 1/P
                excess = (self.theta[-1] - within) / self.units[-1]
                self.theta -= self.P[:, -1] / self.P[-1, -1] * excess * self.units
            self.theta[-1] = within

    def step(self, phi: np.ndarray, error: float, share: float) -> np.ndarray:
        """Return the change of the scaled θ."""
        learner = self.learner
        if isinstance(learner, ql.learners.NLMS):
            rate = learner.rate or FREQUENCY
            return rate * DT * share * error * phi / (learner.regularisation + phi @ phi)
        R, keep = LAG / DT / share, math.exp(-DT / (learner.memory_time or 100.0 / FREQUENCY))
        gain = self.P @ phi
        zeta = phi @ gain / R
        if zeta == 0.0:
            return np.zeros(self.p)
        factor = (keep - (1.0 - keep) / zeta) / (R * keep * (1.0 + zeta))
        if not (
            factor < 0.0 and np.trace(self.P - factor * np.outer(gain, gain)) > self.p * self.prior
        ):
            self.P = self.P - factor * np.outer(gain, gain)
        return gain * error / (R * (1.0 + zeta))

    @property
    def nonlinear(self) -> np.ndarray:
        """Which features become other functions when a scale grows."""
        return np.array(["rbf" in name.lower() for name in self.learner.feature_names(2)])

    def predict(self, x: np.ndarray, u: float) -> float:
        """Return f_L at u."""
        if not self.has_scale:
            return 0.0
        # u itself, not its mean, enters the law.
        values = self.features(x, u)
        if self.learner.features.has_input:
            values[-1] = u
        return float(self.theta @ values) + self.bias

    def commit(self, x: np.ndarray, u: float) -> None:
        """Store what was applied."""
        self.samples += 1
        if self.has_scale:
            for i, value in enumerate(self.features(x, u)):
                self.filtered[i] = lag_push(self.lag, self.chain, i, value)


def sample(k: int, rng: np.random.Generator) -> tuple[np.ndarray, float, float, float]:
    """Return x, y, u and f: rest, a motion, a larger one, and then much noise."""
    t, size = k * DT, 0.0 if k < 200 else 0.7 if k < 500 else 2.6
    x = size * np.array([math.sin(3.0 * t), 3.0 * math.cos(3.0 * t)])
    u = 0.3 if k < 350 else math.sin(5.0 * t) + 0.3
    noise = (1e-5 if k < 800 else 0.15) * rng.normal()
    f = -2.0 * x[0] + 0.3 * x[1] + 0.2 * u + 0.6 + 0.8 * math.tanh(3.0 * x[1]) + 5.0 * noise
    return x, x[0] + noise, u, f


LINEAR = {
    "RLS": ql.learners.RLS(State() + Bias() + Input()),
    "RLS, radial": ql.learners.RLS(State() + RBF(6) + Bias()),
    "NLMS": ql.learners.NLMS(features=State() + Bias() + Input(), bias_bandwidth=3.0),
    "NLMS, radial": ql.learners.NLMS(features=State() + RBF(6)),
    "RLS, given": ql.learners.RLS(
        State() + Input(),
        memory_time=2.0,
        prior=3.0,
        frequency=1.1,
        scale=[2.0, 8.0, 1.0, 16.0],
        gain_interval=(0.97, 1.05),
        bias_bandwidth=1e9,
    ),
    "NLMS, given": ql.learners.NLMS(
        State() + Input(), 5.0, regularisation=0.2, gain_interval=(0.8, 1.1)
    ),
}


@pytest.mark.parametrize("name", LINEAR)
def test_a_linear_learner_follows_its_equations(name: str, rng: np.random.Generator) -> None:
    """θ, bias and prediction through rest, a growing scale, a loss of confidence and a restart."""
    learner = LINEAR[name]
    reference = Regression(learner, learner.bias_bandwidth or OMEGA_O)
    design = learner.design(OBSERVER, FREQUENCY)
    memory, theta, learned = learner.memory(design), np.zeros(reference.p), []
    found, expected, thetas = [], [], []
    for k in range(1000):
        x, y, u, f = sample(k, rng)
        adapt(design, memory, np.append(x, f), y, u, f)
        reference.adapt(x, y, u, f)
        coefficients(design, memory, theta)
        if design.constant >= 0:
            theta[design.constant] -= memory.loop[0].bias
        learned.append(theta.copy())
        thetas.append(reference.theta.copy())
        constant, slope = predict(design, memory, np.append(x, f), u)
        found.append((memory.loop[0].bias, constant + slope * u))
        expected.append((reference.bias, reference.predict(x, u)))
        commit(design, memory, np.append(x, f), u, 0.0)
        reference.commit(x, u)
    np.testing.assert_allclose(learned, thetas, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8)
    change = np.max(np.abs(np.diff(learned, axis=0)), axis=1)
    assert np.max(change[:190]) < 1e-12, "at rest nothing is learned"
    assert np.max(change[-50:]) < 1e-12, "nor where noise hides f"
    assert np.max(change[440:480]) > 1e-6
    assert np.max(change[700:780]) > 1e-6
    forget(design, memory)
    fresh = learner.memory(design)
    for part in ("theta", "scale", "units", "chain", "filtered", "loop"):
        np.testing.assert_array_equal(getattr(memory, part), getattr(fresh, part))
    for array, empty in zip(memory.gate, fresh.gate, strict=True):
        np.testing.assert_array_equal(array, empty)
    if name.startswith("RLS"):
        np.testing.assert_array_equal(memory.rule.covariance, fresh.rule.covariance)


class Descent:
    """Algorithm 1 on scaled features: lists that are emptied when a scale grows."""

    def __init__(self, learner: ql.learners.BatchGradient, rate: float) -> None:
        self.design, self.rate = learner.design(OBSERVER, FREQUENCY), rate
        self.scale, self.samples, self.p = np.full(4, 1e-100), 0, len(learner.feature_names(2))
        self.theta = np.zeros(self.p)  # in the plant's units
        self.batch: list[tuple[np.ndarray, float]] = []

    def features(self, x: np.ndarray, u: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the scaled features and their units."""
        out, units = np.zeros(self.p), np.zeros(self.p)
        write(self.design.features, x / self.scale[:2], u / self.scale[2], out)
        unit(self.design.features, self.scale, units)
        return out, units

    def adapt(self, x: np.ndarray, u: float, f: float, f_plain: float) -> None:
        """Take a sample with the residual ``f``."""
        if self.samples <= STARTUP:
            return
        before = self.scale.copy()
        update_scale(self.design.scaling, self.scale, np.append(x, 0.0), u, f_plain, True)
        if np.any(self.scale != before):
            self.batch.clear()
        phi, units = self.features(x, u)
        self.batch = [*self.batch, (phi, f / self.scale[3])][-self.design.batch :]
        if len(self.batch) == self.design.batch:
            step = sum(residual * row for row, residual in self.batch)
            self.theta = self.theta + self.rate * step * units * self.scale[3]

    def predict(self, x: np.ndarray, u: float) -> float:
        """Return f_L."""
        phi, units = self.features(x, u)
        return float(self.theta @ (phi / units)) if self.scale[3] > 1e-99 else 0.0


def test_algorithm_1_on_scaled_features_follows_its_equations(rng: np.random.Generator) -> None:
    """With the plain estimate for the scale and the residual for the step; θ is in the plant's units."""
    learner = ql.learners.BatchGradient(State() + Bias() + Input(), 0.01, 5)
    reference, design = Descent(learner, 0.01), learner.design(OBSERVER, FREQUENCY)
    memory, theta = learner.memory(design), np.zeros(4)
    for k in range(400):
        x, y, u, f = sample(k + 350, rng)
        residual = f - 0.9 * reference.predict(x, u)
        adapt(design, memory, np.append(x, residual), y, u, f)
        reference.adapt(x, u, residual, f)
        coefficients(design, memory, theta)
        np.testing.assert_allclose(theta, reference.theta, rtol=1e-9, atol=1e-12)
        said = predict(design, memory, np.append(x, residual), u)
        assert said == (pytest.approx(reference.predict(x, u), rel=1e-9, abs=1e-12), 0.0)
        commit(design, memory, np.append(x, residual), u, 0.0)
        reference.samples += 1
    assert np.all(theta != 0.0)
    restart(design, memory)
    assert memory.loop[0].samples == 0.0
    adapt(design, memory, np.array([0.1, 0.2, 9.0]), 0.1, 0.3, 9.0)
    assert np.all(memory.buffers.theta * memory.units * memory.scale[3] == theta)
    forget(design, memory)
    for name in ("loop", "scale", "units"):
        np.testing.assert_array_equal(getattr(memory, name), getattr(learner.memory(design), name))
    assert not np.any(memory.buffers.theta)


def test_rounding_of_a_large_measurement_counts_as_its_noise() -> None:
    """1e-8 of y, also where the observer agrees with it exactly."""
    gate = noise_gate(OBSERVER, FREQUENCY)
    memory = noise_gate_memory(gate)
    update_gate(gate, memory, np.array([5e3, 0.0, 0.0]), 5e3, 0.0)
    assert memory.noise[0] == pytest.approx(gate.forget * 5e-5**2, rel=1e-12)


@pytest.mark.trial
@pytest.mark.parametrize("bias_bandwidth", [None, 0.0, 1e9])
def test_a_learner_around_a_model_follows_its_equations(
    bias_bandwidth: float | None, rng: np.random.Generator
) -> None:
    """Which pairs the model is shown, and when; its bias, and what it predicts."""
    learner = ql.learners.MLP(hidden=3, bias_bandwidth=bias_bandwidth)
    design = learner.design(OBSERVER, FREQUENCY)
    memory, delay = learner.memory(design), round(group_delay(OBSERVER))
    gate, model = Gate(), learner.model.memory(design.model)
    scale, bias, pairs, learned = np.full(4, 1e-100), 0.0, [], 0
    gain = min(DT * (OMEGA_O if bias_bandwidth is None else bias_bandwidth), 1.0)
    for k in range(900):
        x, y, u, f = sample(k + 100, rng)
        adapt(design, memory, np.append(x, f), y, u, f)
        moves = gate.update(x, y, u)
        if k > STARTUP:
            update_scale(design.inputs.scaling, scale, np.append(x, f), u, f, False)
        ready = k > STARTUP + delay + 1
        if ready:
            oldest = pairs[-delay - 1]
            bias += gain * (f - scale[3] * infer(design.model, model, oldest) - bias)
            if moves and gate.confidence(scale[0]) > 0.5:
                learn(design.model, model, oldest, f / scale[3])
                learned += 1
        np.testing.assert_allclose(
            *(np.concatenate(part, axis=None) for part in (memory.model, model)),
            rtol=1e-9,
            atol=1e-12,
        )
        now = gate.passed(x, u)[:2] / scale[:2]
        output = scale[3] * infer(design.model, model, now) + bias if ready else 0.0
        said = predict(design, memory, np.append(x, f), u)
        assert said == (pytest.approx(output, rel=1e-9, abs=1e-12), 0.0)
        commit(design, memory, np.append(x, f), u, 0.0)
        pairs.append(now)
    assert 300 < learned < 800
