"""The base class of the learners that are linear in θ; ``kernels.py`` describes the method."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell import checks
from quell.features import Features
from quell.features.base import write
from quell.learners.feature_learner import FeatureLearner
from quell.learners.lag import lag_memory, lag_of
from quell.learners.noise_gate import noise_gate_memory
from quell.learners.regression.kernels import LinearDesign, LinearLoop, LinearMemory
from quell.observers.eso import ESO
from quell.types import Matrix


class Linear(FeatureLearner):
    """Base class of linear learners; a subclass defines the rule that finds θ.

    Parameters
    ----------
    gain_interval
        limits of the effective gain ``(b0 + θ_u)/b0`` if ``Input()`` is a feature.

    The other parameters are described in the base class ``FeatureLearner``.
    """

    def __init__(
        self,
        features: Features | None,
        frequency: float | None,
        scale: Any,
        gain_interval: tuple[float, float],
        bias_bandwidth: float | None,
    ) -> None:
        super().__init__(features, frequency, scale, bias_bandwidth)
        self.gain_interval = checks.around_one("gain_interval", gain_interval)

    def rule(self, observer: ESO, omega_c: float, features: int) -> Any:
        """Return the parameters of the rule (a NamedTuple)."""
        raise NotImplementedError

    def rule_memory(self, rule: Any, features: int) -> Any:
        """Return the initial state of the rule (an array or a NamedTuple of arrays)."""
        raise NotImplementedError

    def design(self, observer: ESO, omega_c: float) -> LinearDesign:
        """Return the parameters for an observer and the controller's bandwidth [rad/s]."""
        order, inputs = observer.order, self._inputs(observer, omega_c)
        p = len(self.features.names(order))
        slopes = sorted(observer.b0 * (share - 1.0) for share in self.gain_interval)
        return LinearDesign(
            inputs=inputs,
            lag=lag_of(observer),
            rule=self.rule(observer, omega_c, p),
            constant=self.features.constant(order),
            with_u=self.features.has_input,
            slope_low=slopes[0],
            slope_high=slopes[1],
            depends=_dependence(inputs.features, order, p),
        )

    def memory(self, parameters: LinearDesign) -> LinearMemory:
        """Return the state before anything is learned."""
        n = parameters.inputs.order
        p = len(self.features.names(n))
        return LinearMemory(
            theta=np.zeros(p),
            scale=self._initial_scale(parameters.inputs),
            sizes=self._initial_sizes(parameters.inputs),
            old_scale=np.zeros(n + 2),
            scaled=np.zeros(n),
            features=np.zeros(p),
            units=np.ones(p),
            chain=lag_memory(parameters.lag, p),
            filtered=np.zeros(p),
            loop=LinearLoop.zeros(),
            gate=noise_gate_memory(n),
            rule=self.rule_memory(parameters.rule, p),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return the names of the features."""
        return self.features.names(order)


def _dependence(features: Any, n: int, p: int) -> Matrix:
    """Return which features depend on which state and on u (p, n + 1); test ten random points."""
    rng, depends = np.random.default_rng(0), np.zeros((p, n + 1))
    one, other = np.zeros(p), np.zeros(p)
    for point in rng.uniform(-1.0, 1.0, (10, n + 1)):
        write(features, point[:n], float(point[n]), one)
        for j in range(n + 1):
            moved = point.copy()
            moved[j] = rng.uniform(-1.0, 1.0)
            write(features, moved[:n], float(moved[n]), other)
            depends[:, j] = np.maximum(depends[:, j], one != other)
    return depends
