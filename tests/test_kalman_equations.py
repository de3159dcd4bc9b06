"""The Kalman learner against its equations in matrix form, sample by sample."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    forget,
    lag_memory,
    lag_of,
    lag_push,
    predict,
    relative_noise,
)

OBSERVER = ql.ESO.model_free(order=2, b0=2.0, omega_o=21.0, dt=5e-3)
DT, TAU = 5e-3, 3 / 21.0
LEARNERS = {
    "all features": ql.learners.Harmonic(count=2, u=True, state_bandwidth=(0.3, 0.7)),
    "no bias": ql.learners.Kalman(
        bias=False, u=True, state_bandwidth=0.5, prior=3.0, frequency=2.0, gain_interval=(0.8, 1.3)
    ),
    "bias and u": ql.learners.Kalman(state=False, u=True, bias_bandwidth=50.0),
    "slow pair": ql.learners.Harmonic(bias_bandwidth=5.0),
    "pair without bias": ql.learners.Harmonic(
        bias=False, omegas=(2.5,), limits=(2.3, 2.7), pair_bandwidth=9.0
    ),
}


class Reference:
    """The equations of ``learners/kalman.py`` and ``oscillators.py``, with matrices."""

    def __init__(self, learner: ql.learners.Kalman, omega_c: float) -> None:
        frequency = omega_c if learner.frequency is None else learner.frequency
        n, pairs = 2 * learner.state, 2 * getattr(learner, "count", 0)
        bias, u = int(learner.bias), int(learner.u)
        self.learner, self.n, self.pairs, self.p = learner, n, pairs, n + bias + pairs + u
        self.gated = np.array([True] * n + [False] * (bias + pairs) + [True] * u)
        scale = np.array([1.0, 1.0 / frequency])
        noise = relative_noise(OBSERVER)
        self.scale = np.concatenate([scale[:n], [1.0] * (bias + pairs), [2.0] * u])
        limits = 36.0 * noise * np.append(scale, 1.0) ** 2
        self.limits = np.concatenate([limits[:n], [0.0] * (bias + pairs), limits[2:] * u])[: self.p]
        fast = 21.0 if learner.bias_bandwidth is None else learner.bias_bandwidth
        slow = np.resize(learner.state_bandwidth, 2)[:n]
        pair = getattr(learner, "pair_bandwidth", None) or 2.5 * fast
        self.walk = np.concatenate([slow, [fast] * bias, [pair] * pairs, [0.0] * u])
        prior = [learner.prior * frequency**2] * n + [0.0] * (bias + pairs) + [1.0] * u
        self.P, self.theta = np.diag(np.square(prior)), np.zeros(self.p)
        self.fastest, self.f_noise = max(fast, 21.0), noise[2]
        self.mean, self.variance = np.zeros(self.p), np.zeros(self.p)
        self.weighted, self.weight, self.samples = np.zeros(2), 0.0, 0
        start = getattr(learner, "omegas", None) or omega_c * 0.3 ** np.arange(pairs // 2)
        self.omega = np.array(start)
        self.limits_of_omega = getattr(learner, "limits", None) or (0.02 * omega_c, 0.5 * 21.0)
        self.psi = np.zeros(pairs // 2)
        self.chain = lag_memory(lag_of(OBSERVER), self.p)
        self.filtered = np.zeros(self.p)

    def features(self, x: np.ndarray, u: float) -> np.ndarray:
        """Return φ, scaled."""
        wave = np.column_stack([np.sin(self.psi), np.cos(self.psi)]).ravel()
        parts = [x[: self.n], [1.0] * self.learner.bias, wave, [u] * self.learner.u]
        return self.scale * np.concatenate(parts)

    def adapt(self, y: float, x1: float, f: float) -> None:
        """Take a sample."""
        forget = -math.expm1(-DT / (10.0 * TAU))
        error = f - self.theta @ self.filtered
        squares = np.array([(y - x1) ** 2 + (1e-8 * y) ** 2, error**2 + (0.1 * f) ** 2])
        self.weighted += forget * (squares - self.weighted)
        self.weight += forget * (1.0 - self.weight)
        self.samples += 1
        noise, unexplained = self.weighted / self.weight
        R = TAU * (unexplained + self.f_noise * noise)
        away = np.where(self.gated, self.filtered - self.mean, 0.0)
        self.mean += forget * away
        self.variance += forget * (away**2 - self.variance) * self.gated
        moving = self.gated & (self.variance > self.limits * noise)
        centre = self.mean if self.learner.bias else 0.0
        phi = np.where(self.gated, (self.filtered - centre) / math.sqrt(R), self.filtered)
        phi = np.where(self.gated & ~moving, 0.0, phi)
        if self.samples * DT <= 2.0 * TAU:
            return
        spread = phi @ self.P @ phi
        gain = self.P @ phi / max(spread + 1.0 / DT, spread / (self.fastest * DT))
        self.P = self.P - np.outer(gain, self.P @ phi)
        size = np.where(moving, np.maximum(self.variance, 1e-300), 1.0)
        Q = np.where(self.gated, np.where(moving, R / size, 0.0), 1.0) * self.walk**2
        self.P += DT * np.diag(Q)
        step = gain * error / np.where(self.gated, math.sqrt(R), 1.0)
        if self.learner.u:
            low, high = self.learner.gain_interval
            step[-1] = np.clip(self.theta[-1] + step[-1], low - 1.0, high - 1.0) - self.theta[-1]
        self.theta = self.theta + step
        if self.learner.bias:
            self.theta[self.n] -= np.sum((step * self.mean)[self.gated])
        first = self.n + self.learner.bias
        for j in range(self.pairs // 2):
            s, c = self.theta[first + 2 * j : first + 2 * j + 2]
            turn_s, turn_c = (gain * error)[first + 2 * j : first + 2 * j + 2]
            angle = (s * turn_c - c * turn_s) / (s**2 + c**2 + 60.0 * self.weighted[1])
            turned = self.omega[j] * (1.0 + 0.4 * angle)
            self.omega[j] = np.clip(turned, *self.limits_of_omega)

    def commit(self, x: np.ndarray, u: float) -> None:
        """Store what was applied."""
        lag = lag_of(OBSERVER)
        values = self.features(x, u)
        self.filtered = np.array([lag_push(lag, self.chain, i, v) for i, v in enumerate(values)])
        self.psi = (self.psi + self.omega * DT) % (2.0 * math.pi)


# How near to its equations a learner is, relatively and absolutely.
LIMITS = {
    "prediction": (1e-6, 1e-8),
    "theta": (1e-6, 1e-8),
    "covariance": (1e-5, 1e-10),
    "mean": (1e-9, 1e-12),
    "variance": (1e-9, 1e-15),
    "omega": (1e-9, 0.0),
    "phase": (1e-7, 1e-9),
}
OTHERWISE = {"covariance": "P", "phase": "psi"}


@pytest.mark.parametrize("kind", LEARNERS)
def test_the_kalman_learner_follows_its_equations(kind: str, rng: np.random.Generator) -> None:
    """θ, P, means and frequencies, with features that stand still for a while, and a load."""
    learner = LEARNERS[kind]
    design, reference = learner.design(OBSERVER, 3.0), Reference(learner, 3.0)
    memory = learner.memory(design)
    scale = math.sqrt(np.max(reference.P) + 1.0)
    found: dict[str, list[Any]] = {name: [] for name in LIMITS}
    wanted: dict[str, list[Any]] = {name: [] for name in LIMITS}
    for k in range(700):
        t = k * DT
        still = 300 <= k < 500
        x = (
            np.array([0.7, 0.1])
            if still
            else np.array([math.sin(3.0 * t), 3.0 * math.cos(2.0 * t)])
        )
        u = math.sin(5.0 * t) if k > 350 else -0.4
        noise = 1e-4 * rng.normal()
        f = -2.0 * x[0] + 0.4 * x[1] + 0.9 * u + 0.6 + math.sin(2.2 * t) + 100.0 * noise
        seen = np.array([x[0], x[1], f])
        adapt(design, memory, seen, x[0] + noise, u, f)
        reference.adapt(x[0] + noise, x[0], f)
        expected = reference.features(x, u)
        constant, slope = predict(design, memory, seen, u)
        found["prediction"].append(constant + slope * u)
        wanted["prediction"].append(reference.theta @ expected)
        commit(design, memory, seen, u, 0.0)
        reference.commit(x, u)
        for name in list(LIMITS)[1:]:
            found[name].append(getattr(memory, name).copy())
            wanted[name].append(np.copy(getattr(reference, OTHERWISE.get(name, name))))
    for name, (relative, absolute) in LIMITS.items():
        absolute *= scale if name == "covariance" else 1.0
        np.testing.assert_allclose(found[name], wanted[name], relative, absolute, err_msg=name)
    assert np.all(memory.theta != 0.0)
    shown = np.zeros(reference.p)
    coefficients(design, memory, shown)
    np.testing.assert_allclose(shown, reference.theta * reference.scale, rtol=1e-6, atol=1e-8)
    forget(design, memory)
    for array, fresh in zip(memory, learner.memory(design), strict=True):
        np.testing.assert_array_equal(array, fresh)
