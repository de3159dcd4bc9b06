"""Algorithm 1 of the paper: batch gradient descent on the observer's own estimates, literally.

Three buffers of size n hold the newest features ``I = (x̂_1 … x̂_N, u, 1)``, residuals ``ΔF = Δf̂`` and outputs ``F_L = h_θ(I)``. Until
they are full the learner is silent. Then each sample pops the oldest datum, pushes the newest, takes one step down the gradient of

    J(θ) = ½ Σ_i (h_θ(I_i) − f̂_i)²,        f̂_i = F_L,i + ΔF_i          (eq. (cost))

and labels the whole batch anew, ``F_L = h_θ(I)`` (line 18). Because of that last line, the gradient taken at the next sample is

    ∇J = Σ_i (h_θ(I_i) − F_L,i − ΔF_i) I_i = −Σ_i Δf̂_i I_i

whatever θ is: a sliding sum, O(p) a sample for any n. The buffer F_L is then needed only to be looked at (``outputs``). A sliding sum
drifts in floating point; beside it a second sum is built of the data pushed since the ring last came round, which replaces it
each time the ring is through, so that no rounding error is older than 2n samples and no sample costs more than another.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.features import Features
from quell.kernels.dispatch import is_finite
from quell.learners.base import adapt, coefficients, commit, predict, restart
from quell.learners.gradient.scaled_features import (
    FeatureGradientDesign,
    feature_gradient_design,
    feature_gradient_memory,
)
from quell.observers.eso import ESO
from quell.types import Matrix, Vector


class BatchGradientDesign(NamedTuple):
    """Parameters of Algorithm 1."""

    rate: float
    """α, a sample."""
    batch: int
    """n."""
    order: int
    """Order of the plant; there are two features more."""


class BatchGradientMemory(NamedTuple):
    """State of Algorithm 1, with p = order + 2 features."""

    theta: Vector
    """(p,)."""
    features: Matrix
    """I (n, p), a ring."""
    residuals: Vector
    """ΔF (n,), a ring."""
    total: Vector
    """Σ Δf̂ I over the ring (p,)."""
    fresh: Vector
    """The same over what was pushed since the ring last came round (p,)."""
    place: Vector
    """(2,): where the next datum goes; whether the ring has been full."""


@adapt.register(BatchGradientDesign)
def _adapt(
    learner: BatchGradientDesign,
    memory: BatchGradientMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    at = min(max(int(memory.place[0]), 0), learner.batch - 1)
    size = learner.order + 2
    residual = seen[learner.order]
    oldest = memory.residuals[at]
    for i in range(size):
        feature = seen[i] if i < learner.order else (u_before if i == learner.order else 1.0)
        gained = residual * feature
        memory.total[i] += gained - oldest * memory.features[at, i]
        memory.fresh[i] += gained
        memory.features[at, i] = feature
    memory.residuals[at] = residual
    at += 1
    if at == learner.batch:
        at = 0
        memory.place[1] = 1.0
        for i in range(size):
            memory.total[i] = memory.fresh[i]
            memory.fresh[i] = 0.0
    memory.place[0] = at
    if memory.place[1] > 0.0:
        for i in range(size):
            memory.theta[i] += learner.rate * memory.total[i]


@predict.register(BatchGradientDesign)
def _predict(
    learner: BatchGradientDesign, memory: BatchGradientMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    output = memory.theta[learner.order] * u_before + memory.theta[learner.order + 1]
    for i in range(learner.order):
        output += memory.theta[i] * seen[i]
    return output, 0.0


@commit.register(BatchGradientDesign)
def _commit(
    learner: BatchGradientDesign,
    memory: BatchGradientMemory,
    seen: Vector,
    u: float,
    f_learned: float,
) -> None:
    pass


@restart.register(BatchGradientDesign)
def _restart(learner: BatchGradientDesign, memory: BatchGradientMemory) -> None:
    finite = True
    for i in range(memory.theta.size):
        finite = finite and is_finite(memory.theta[i]) and is_finite(memory.total[i])
    if not finite:
        for i in range(memory.theta.size):
            memory.theta[i] = memory.total[i] = memory.fresh[i] = 0.0
        for k in range(memory.residuals.size):
            memory.residuals[k] = 0.0
        memory.place[0] = memory.place[1] = 0.0


@coefficients.register(BatchGradientDesign)
def _coefficients(learner: BatchGradientDesign, memory: BatchGradientMemory, theta: Vector) -> None:
    for i in range(theta.size):
        theta[i] = memory.theta[i]


def outputs(memory: BatchGradientMemory) -> Vector:
    """Return the buffer F_L (n,): the batch as labelled with the newest θ."""
    return np.asarray(memory.features @ memory.theta)


@dataclass(frozen=True)
class BatchGradient:
    """Algorithm 1 of the paper, with the features ``(x̂_1 … x̂_n, u, 1)`` and θ from zero.

    It is here to be measured. As printed it is fragile: the range of rates in which it is stable is small and shrinks when
    a disturbance comes (docs/theory); ``Kalman`` is the learner to use.

    Parameters
    ----------
    rate
        learning rate α, a sample. The cost is a sum over the batch, so the step grows with ``batch`` and, in time, with 1/dt.
    batch
        size n of the three buffers, in samples.
    features
        other features, which are then scaled to O(1), as is Δf̂ (``gradient_features.py``); the paper's, unscaled, by default.

    Raises
    ------
    ValueError
        for a negative rate, a batch below 1, or features that are none.
    """

    rate: float = 1e-6
    batch: int = 10
    features: Features | None = None

    def __post_init__(self) -> None:
        checks.non_negative("rate", self.rate)
        checks.whole("batch", self.batch, 1)
        if not isinstance(self.features, Features | None):
            raise ValueError(
                f"features = {self.features!r}: must be made of blocks from quell.features, or None"
            )

    def design(self, observer: ESO, omega_c: float) -> BatchGradientDesign | FeatureGradientDesign:
        """Return the parameters for ``observer``; the bandwidth ``omega_c`` [rad/s] matters only for the scaling of other features."""
        if self.features is not None:
            return feature_gradient_design(
                float(self.rate), self.batch, self.features, observer, omega_c
            )
        return BatchGradientDesign(float(self.rate), self.batch, observer.order)

    def memory(self, parameters: Any) -> Any:
        """Return empty buffers and θ = 0."""
        if isinstance(parameters, FeatureGradientDesign):
            return feature_gradient_memory(
                parameters, len(self.feature_names(parameters.scaling.floors.size - 2))
            )
        n, p = parameters.batch, parameters.order + 2
        return BatchGradientMemory(
            np.zeros(p), np.zeros((n, p)), np.zeros(n), np.zeros(p), np.zeros(p), np.zeros(2)
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1", …, "u", "bias")``, or the names of other features."""
        return (
            (*(f"x{i + 1}" for i in range(order)), "u", "bias")
            if self.features is None
            else self.features.names(order)
        )
