"""Normalised least mean squares: the cheapest rule, O(p) a sample.

    θ ← θ + rate dt · φ ε / (ρ + φ·φ)

with the error ε and the filtered features φ. Along φ the error decays as ``exp(−rate t)``, for
features of any size and for any dt; it decays more slowly where noise hides it
(``noise_gate.confidence``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.features import Features
from quell.learners.feature_learner import features_first
from quell.learners.regression.kernels import reset_uncertainty, update_theta
from quell.learners.regression.linear import Linear
from quell.observers.eso import ESO
from quell.types import Vector


class NlmsRule(NamedTuple):
    """Parameters."""

    gain: float  # rate · dt, at most 1
    floor: float  # ρ


@update_theta.register(NlmsRule)
def _update_theta(
    rule: NlmsRule, memory: Vector, theta: Vector, features: Vector, error: float, confidence: float
) -> None:
    power = rule.floor
    for i in range(theta.size):
        power += features[i] * features[i]
    step = rule.gain * confidence * error / power
    for i in range(theta.size):
        theta[i] += step * features[i]


@reset_uncertainty.register(NlmsRule)
def _reset_uncertainty(rule: NlmsRule, memory: Vector) -> None:
    pass


class NLMS(Linear):
    """Normalised least mean squares on any features.

    θ moves in proportion to the error and nothing else is remembered, so the learner follows
    drifting plants and is hard to mislead. Similar features take long to separate; ``RLS`` is
    better there.

    Parameters
    ----------
    features
        blocks of features; the state and a bias by default.
    rate
        rate at which an observed error decays [1/s]; ``omega_c`` of the controller by default.
    regularisation
        ρ: features smaller than its square root are learned from less. Features are O(1).

    The other parameters are described in the base classes ``Linear`` and ``FeatureLearner``.

    Raises
    ------
    ValueError
        for an argument out of range.

    References
    ----------
    Nagumo & Noda, *A learning method for system identification*, IEEE Trans. Automatic Control 12
    (1967); Haykin, *Adaptive Filter Theory*, chapter on normalised least mean squares.
    """

    def __init__(
        self,
        features: Features | None = None,
        rate: float | None = None,
        *,
        regularisation: float = 1e-2,
        frequency: float | None = None,
        scale: Any = None,
        gain_interval: tuple[float, float] = (0.5, 2.0),
        bias_bandwidth: float | None = None,
    ) -> None:
        features, rate = features_first(features, rate, None, "rate")
        super().__init__(features, frequency, scale, gain_interval, bias_bandwidth)
        self.rate = checks.optional(checks.positive, "rate", rate, "1/s")
        self.regularisation = checks.positive("regularisation", regularisation)

    def rule(self, observer: ESO, omega_c: float, features: int) -> NlmsRule:
        """Return step size and regularisation."""
        return NlmsRule(min((self.rate or omega_c) * observer.dt, 1.0), self.regularisation)

    def rule_memory(self, rule: NlmsRule, features: int) -> Vector:
        """Return an empty state; the learner holds θ."""
        return np.zeros(0)
