"""What the learners that are linear in what they learn have in common (``regression.py``): features, scaling, gain and bias."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell import checks
from quell.features import Bias, Features, State
from quell.features.base import checked_design, write
from quell.features.scaling import scaling
from quell.learners.lag import lag_memory, lag_of, startup_samples
from quell.learners.noise_gate import noise_gate, noise_gate_memory
from quell.learners.regression.kernels import LinearDesign, LinearMemory
from quell.observers.eso import ESO
from quell.types import Matrix


class Linear:
    """What the learners with a rule have in common; not one itself.

    Parameters
    ----------
    features
        what f is taken to be linear in.
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
        for arguments that fit nothing.
    """

    def __init__(
        self,
        features: Features | None,
        frequency: float | None,
        scale: Any,
        gain_interval: tuple[float, float],
        bias_bandwidth: float | None,
    ) -> None:
        self.features = State() + Bias() if features is None else features
        if not isinstance(self.features, Features):
            raise ValueError(
                f"features = {features!r}: must be made of blocks from quell.features, for example State() + Bias()"
            )
        self.frequency = (
            None if frequency is None else checks.positive("frequency", frequency, "rad/s")
        )
        self.scale = None if scale is None else checks.positive_vector("scale", scale)
        self.bias_bandwidth = (
            None
            if bias_bandwidth is None
            else checks.non_negative("bias_bandwidth", bias_bandwidth, "rad/s")
        )
        self.gain_interval = checks.around_one("gain_interval", gain_interval)

    def rule(self, observer: ESO, omega_c: float, features: int) -> Any:
        """Return the rule's parameters."""
        raise NotImplementedError

    def rule_memory(self, rule: Any, features: int) -> Any:
        """Return the rule's state before anything was learned."""
        raise NotImplementedError

    def design(self, observer: ESO, omega_c: float) -> LinearDesign:
        """Return the parameters for ``observer`` and a controller of bandwidth ``omega_c`` [rad/s]."""
        n = observer.order
        if self.scale is not None:
            checks.vector("scale", self.scale, n + 2)
        features, p, constant = (
            checked_design(self.features, n),
            len(self.features.names(n)),
            self.features.constant(n),
        )
        slopes = sorted(observer.b0 * (share - 1.0) for share in self.gain_interval)
        return LinearDesign(
            features=features,
            scaling=scaling(observer, self.frequency or omega_c, self.scale is not None),
            gate=noise_gate(observer, self.frequency or omega_c),
            lag=lag_of(observer),
            rule=self.rule(observer, omega_c, p),
            constant=constant,
            with_u=self.features.has_input,
            slope_low=slopes[0],
            slope_high=slopes[1],
            depends=_dependence(features, n, p),
            follow=min(
                (observer.omega_o if self.bias_bandwidth is None else self.bias_bandwidth)
                * observer.dt,
                1.0,
            ),
            watch=startup_samples(observer),
        )

    def memory(self, parameters: LinearDesign) -> LinearMemory:
        """Return a state with nothing learned."""
        n, p = (
            parameters.scaling.floors.size - 2,
            len(self.features.names(parameters.scaling.floors.size - 2)),
        )
        return LinearMemory(
            theta=np.zeros(p),
            scale=np.full(n + 2, 1e-100) if self.scale is None else self.scale.copy(),
            former=np.zeros(n + 2),
            shown=np.zeros(n),
            now=np.zeros(p),
            units=np.ones(p),
            chain=lag_memory(parameters.lag, p),
            filtered=np.zeros(p),
            place=np.zeros(4),
            gate=noise_gate_memory(n),
            rule=self.rule_memory(parameters.rule, p),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return the features' names."""
        return self.features.names(order)


def _dependence(features: Any, n: int, p: int) -> Matrix:
    """Return which feature depends on which state, and on u, as seen at random points (p, n + 1)."""
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
