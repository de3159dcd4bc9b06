"""Recursive least squares as a rule of linear learners; ``least_squares.py`` describes the method.

The variance of noise is ``R = τ/dt`` with the observer's lag τ = N/omega_o, because the noise in f̂
is correlated over that time; so the result does not depend on dt. R is larger where measurement
noise hides what is to be learned (``noise_gate.confidence``).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.features import Features
from quell.learners.least_squares import RlsRule, excess_share, least_squares_gain
from quell.learners.regression.kernels import reset_uncertainty, share_excess, update_theta
from quell.learners.regression.linear import Linear
from quell.learners.regression.relearning import (
    RelearningLoop,
    RelearningMemory,
    RelearningRule,
    relearning_rule,
)
from quell.learners.regression.selection import (
    EXCHANGE_LAGS,
    SelectionMemory,
    SelectionRule,
    selection_memory,
)
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# Default of memory_time in units of 1/omega_c; chosen by hand, not tuned further.
_MEMORY = 100.0


class RlsMemory(NamedTuple):
    """State besides θ."""

    covariance: Matrix  # P (p, p)
    gain: Vector  # work space for Pφ (p,)


@update_theta.register(RlsRule)
def _update_theta(
    rule: RlsRule,
    memory: RlsMemory,
    theta: Vector,
    features: Vector,
    error: float,
    confidence: float,
) -> None:
    covariance, gain = memory.covariance, memory.gain
    inverse = least_squares_gain(rule, covariance, gain, features, rule.noise / confidence)
    for i in range(theta.size):
        theta[i] += gain[i] * inverse * error


@reset_uncertainty.register(RlsRule)
def _reset_uncertainty(rule: RlsRule, memory: RlsMemory) -> None:
    for i in range(memory.covariance.shape[0]):
        for j in range(memory.covariance.shape[1]):
            memory.covariance[i, j] = rule.prior if i == j else 0.0


@share_excess.register(RlsRule)
def _share_excess(rule: RlsRule, memory: RlsMemory, theta: Vector, i: int, excess: float) -> None:
    if memory.covariance[i, i] > 0.0:
        for j in range(theta.size):
            theta[j] -= excess_share(memory.covariance, i, j) * excess


class RLS(Linear):
    """Recursive least squares on any features, with a memory of limited length.

    Parameters
    ----------
    memory_time
        T, the time after which a sample has the weight 1/e [s]; ``inf`` forgets nothing,
        ``100/omega_c`` by default.
    prior
        standard deviation of θ before anything is known; features and f are O(1).
    strongest
        number of features that are used at once, the strongest of all that are given; all by
        default. With many features it saves time and noise (``selection.py``); others have the
        coefficient zero.
    relearn
        ratio of the RMS error to its usual size from which the plant counts as changed: then θ is
        learned again as quickly as at the start (``relearning.py``), for example 4; by default
        never.

    The other parameters are described in the base classes ``Linear`` and ``FeatureLearner``.

    Raises
    ------
    ValueError
        for an argument out of range.

    References
    ----------
    Kulhavý & Kárný, *Tracking of slowly varying parameters by directional forgetting*, IFAC World
    Congress 1984; Ljung & Söderström, *Theory and Practice of Recursive Identification*, MIT Press
    1983.
    """

    def __init__(
        self,
        features: Features | None = None,
        *,
        memory_time: float | None = None,
        prior: float = 10.0,
        strongest: int | None = None,
        relearn: float | None = None,
        frequency: float | None = None,
        scale: Any = None,
        gain_interval: tuple[float, float] = (0.5, 2.0),
        bias_bandwidth: float | None = None,
    ) -> None:
        super().__init__(features, frequency, scale, gain_interval, bias_bandwidth)
        self.memory_time = checks.optional(checks.time_constant, "memory_time", memory_time)
        self.prior = checks.positive("prior", prior)
        self.strongest = checks.optional(checks.whole, "strongest", strongest, 1)
        self.relearn = checks.optional(checks.positive, "relearn", relearn)
        if self.relearn is not None and self.relearn <= 1.0:
            raise ValueError(f"relearn = {relearn!r}: must be greater than 1, the usual error")

    def rule(self, observer: ESO, omega_c: float, features: int) -> Any:
        """Return noise, forgetting and prior, and how features are selected and learned again."""
        dt, lag_time = observer.dt, observer.lag_time
        forget = -math.expm1(-dt / (self.memory_time or _MEMORY / omega_c))
        rule: Any = RlsRule(lag_time / dt, forget, self.prior**2)
        if self.strongest is not None and self.strongest < features:
            interval = round(EXCHANGE_LAGS * lag_time / dt)
            rule = SelectionRule(rule, min(omega_c * dt, 1.0), max(interval, 1))
        if self.relearn is None:
            return rule
        return relearning_rule(rule, self.relearn, dt, lag_time, omega_c)

    def rule_memory(
        self, rule: Any, features: int
    ) -> RlsMemory | SelectionMemory | RelearningMemory:
        """Return the prior covariance and work space."""
        if isinstance(rule, RelearningRule):
            inner = self.rule_memory(rule.inner, features)
            return RelearningMemory(inner, RelearningLoop.zeros())
        if isinstance(rule, SelectionRule):
            return selection_memory(rule, self.strongest or features, features)
        return RlsMemory(rule.prior * np.eye(features), np.zeros(features))
