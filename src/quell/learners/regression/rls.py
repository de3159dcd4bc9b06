"""Recursive least squares with directional forgetting, O(p²) a sample.

With ``ζ = φ·Pφ/R`` and ``λ = exp(−dt/T)``, T being the memory time,

    θ ← θ + Pφ ε / (R (1 + ζ)),      P ← P − c Pφ (Pφ)ᵀ,      c = (λ − (1−λ)/ζ) / (R λ (1 + ζ))

Forgetting acts only along what is being seen: after a sample the uncertainty along φ is ``ζ/(λ(1 + ζ))``, and what φ does not touch stays
as it is. Plain exponential forgetting lets P grow without bound where nothing is excited, and a closed loop at work excites little. What
is left of the danger, a small φ that opens P by and by, is bounded: P grows no further once its trace is that of the prior.

The variance of noise is ``R = τ/dt`` with the observer's lag τ = N/omega_o, for as long the noise in f̂ is correlated; so nothing depends
on dt. Where measurement noise hides what is to be learned it is larger (``noise_gate.confidence``).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.features import Features
from quell.kernels.dispatch import kernel
from quell.learners.regression.kernels import reset_uncertainty, update_theta
from quell.learners.regression.linear import Linear
from quell.observers.eso import ESO
from quell.types import Matrix, Vector


class RlsRule(NamedTuple):
    """Parameters."""

    noise: float
    """R."""
    forget: float
    """1 − λ."""
    prior: float
    """Variance of θ before anything is known."""


class RlsMemory(NamedTuple):
    """State, beside θ."""

    covariance: Matrix
    """P (p, p)."""
    gain: Vector
    """Room for Pφ (p,)."""


@kernel
def least_squares_gain(
    rule: RlsRule, covariance: Matrix, gain: Vector, features: Vector, noise: float
) -> float:
    """Update P for a sample of the variance ``noise``; write Pφ into ``gain`` and return its factor, ``1/(R (1 + ζ))``."""
    size = gain.size
    spread = trace = length = 0.0
    for i in range(size):
        total = 0.0
        for j in range(size):
            total += covariance[i, j] * features[j]
        gain[i] = total
        spread += total * features[i]
        length += total * total
        trace += covariance[i, i]
    if not (
        0.0 < spread < 1e100
    ):  # nothing to learn from, or P is no covariance any more: rather learn nothing
        return 0.0
    inverse = 1.0 / (noise + spread)
    share = (1.0 - rule.forget - rule.forget * noise / spread) * inverse / (1.0 - rule.forget)
    if share < 0.0 and trace - share * length > rule.prior * size:
        share = 0.0
    for i in range(size):
        part = share * gain[i]
        for j in range(i + 1):
            value = covariance[i, j] - part * gain[j]
            covariance[i, j] = covariance[j, i] = value
    return inverse


@kernel
def reset_covariance(rule: RlsRule, covariance: Matrix) -> None:
    """Set P back to the prior."""
    for i in range(covariance.shape[0]):
        for j in range(covariance.shape[1]):
            covariance[i, j] = rule.prior if i == j else 0.0


@update_theta.register(RlsRule)
def _improve(
    rule: RlsRule, memory: RlsMemory, theta: Vector, features: Vector, error: float, sure: float
) -> None:
    covariance, gain = memory.covariance, memory.gain
    inverse = least_squares_gain(rule, covariance, gain, features, rule.noise / sure)
    for i in range(theta.size):
        theta[i] += gain[i] * inverse * error


@reset_uncertainty.register(RlsRule)
def _renew(rule: RlsRule, memory: RlsMemory) -> None:
    reset_covariance(rule, memory.covariance)


class RLS(Linear):
    """Recursive least squares on any features, with a memory of limited length.

    Parameters
    ----------
    features
        what f is taken to be linear in; the state and a constant by default.
    memory_time
        T, after which what was seen counts 1/e [s]; ``inf`` forgets nothing, ``100/omega_c`` by default.
    prior
        standard deviation of θ before anything is known; features and f are O(1).
    frequency
        a frequency the plant has [rad/s], for the automatic scaling; ``omega_c`` of the controller by default.
    scale
        what x_1 … x_n, u and f are divided by, (n + 2,), where it shall not be found automatically.
    gain_interval
        where the effective gain ``(b0 + θ_u)/b0`` is kept when ``Input()`` is a feature.
    bias_bandwidth
        how fast a bias follows what the features leave, λ [rad/s]; ``omega_o`` of the observer by default, 0 for none.

    Raises
    ------
    ValueError
        for arguments out of range.

    References
    ----------
    Kulhavý & Kárný, *Tracking of slowly varying parameters by directional forgetting*, IFAC World Congress 1984; Ljung & Söderström,
    *Theory and Practice of Recursive Identification*, MIT Press 1983.
    """

    def __init__(
        self,
        features: Features | None = None,
        *,
        memory_time: float | None = None,
        prior: float = 10.0,
        frequency: float | None = None,
        scale: Any = None,
        gain_interval: tuple[float, float] = (0.5, 2.0),
        bias_bandwidth: float | None = None,
    ) -> None:
        super().__init__(features, frequency, scale, gain_interval, bias_bandwidth)
        self.memory_time = (
            None if memory_time is None else checks.time_constant("memory_time", memory_time)
        )
        self.prior = checks.positive("prior", prior)

    def rule(self, observer: ESO, omega_c: float, features: int) -> RlsRule:
        """Return noise, forgetting and prior."""
        return rls_rule(observer, self.memory_time or 100.0 / omega_c, self.prior)

    def rule_memory(self, rule: RlsRule, features: int) -> RlsMemory:
        """Return the prior covariance."""
        return RlsMemory(rule.prior * np.eye(features), np.zeros(features))


def rls_rule(observer: ESO, memory_time: float, prior: float) -> RlsRule:
    """Return the rule for an observer, a memory time [s] and a standard deviation of θ."""
    return RlsRule(
        observer.lag_time / observer.dt, -math.expm1(-observer.dt / memory_time), prior**2
    )
