"""Normalised least mean squares: the cheapest rule, O(p) a sample.

    θ ← θ + rate dt · φ ε / (ρ + φ·φ)

where ε is the error and φ the filtered features. Along φ the error decays as ``exp(−rate t)``, whatever the features' size and dt; slower
where noise hides it (``noise_gate.confidence``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.features import Features
from quell.learners.regression.kernels import reset_uncertainty, update_theta
from quell.learners.regression.linear import Linear
from quell.observers.eso import ESO
from quell.types import Vector


class NlmsRule(NamedTuple):
    """Parameters."""

    gain: float
    """rate · dt, at most 1."""
    floor: float
    """ρ."""


class NlmsMemory(NamedTuple):
    """State: none but θ."""

    nothing: Vector
    """(0,)."""


@update_theta.register(NlmsRule)
def _improve(
    rule: NlmsRule, memory: NlmsMemory, theta: Vector, features: Vector, error: float, sure: float
) -> None:
    power = rule.floor
    for i in range(theta.size):
        power += features[i] * features[i]
    step = rule.gain * sure * error / power
    for i in range(theta.size):
        theta[i] += step * features[i]


@reset_uncertainty.register(NlmsRule)
def _renew(rule: NlmsRule, memory: NlmsMemory) -> None:
    pass


class NLMS(Linear):
    """Normalised least mean squares on any features.

    It learns in proportion to the error and remembers nothing else, so it follows what drifts and is hard to mislead; where features are
    alike it takes long to tell them apart, for which ``RLS`` is better.

    Parameters
    ----------
    rate
        how fast an error decays where it is seen [1/s]; ``omega_c`` of the controller by default.
    features
        what f is taken to be linear in; the state and a constant by default.
    regularisation
        ρ: features smaller than its root teach less. Features are O(1).
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
    Nagumo & Noda, *A learning method for system identification*, IEEE Trans. Automatic Control 12 (1967); Haykin, *Adaptive Filter Theory*,
    chapter on normalised least mean squares.
    """

    def __init__(
        self,
        rate: float | None = None,
        features: Features | None = None,
        *,
        regularisation: float = 1e-2,
        frequency: float | None = None,
        scale: Any = None,
        gain_interval: tuple[float, float] = (0.5, 2.0),
        bias_bandwidth: float | None = None,
    ) -> None:
        super().__init__(features, frequency, scale, gain_interval, bias_bandwidth)
        self.rate = None if rate is None else checks.positive("rate", rate, "1/s")
        self.regularisation = checks.positive("regularisation", regularisation)

    def rule(self, observer: ESO, omega_c: float, features: int) -> NlmsRule:
        """Return step size and regularisation."""
        return NlmsRule(min((self.rate or omega_c) * observer.dt, 1.0), self.regularisation)

    def rule_memory(self, rule: NlmsRule, features: int) -> NlmsMemory:
        """Return nothing."""
        return NlmsMemory(np.zeros(0))
