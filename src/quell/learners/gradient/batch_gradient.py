"""Algorithm 1 of the paper: batch gradient descent on the observer's own estimates.

This file has the paper's features ``I = (x̂_1 … x̂_n, u, 1)``; ``buffers.py`` describes the method.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.features import Features
from quell.features.base import checked_design
from quell.features.scaling import initial_scale, scaling
from quell.features.sizes import initial_sizes, unscaled_indices
from quell.kernels.sized import Flag, Size
from quell.learners.base import adapt, coefficients, commit, forget, predict, restart
from quell.learners.gradient.buffers import (
    Buffers,
    empty_buffers,
    forget_buffers,
    restart_buffers,
    take_step,
)
from quell.learners.gradient.scaled_features import ScaledDesign, ScaledLoop, ScaledMemory
from quell.learners.lag import startup_samples
from quell.observers.eso import ESO
from quell.types import Vector


class BatchDesign(NamedTuple):
    """Parameters of Algorithm 1."""

    rate: float  # α, per sample
    batch: int  # n
    order: Size  # order of the plant; the bias is the last feature
    with_u: Flag  # whether u is a feature


@adapt.register(BatchDesign)
def _adapt(
    learner: BatchDesign, memory: Buffers, seen: Vector, y: float, u_before: float, f_plain: float
) -> None:
    for i in range(learner.order):
        memory.current[i] = seen[i]
    if learner.with_u:
        memory.current[learner.order] = u_before
    memory.current[memory.theta.size - 1] = 1.0
    take_step(memory, seen[learner.order], learner.rate)


@predict.register(BatchDesign)
def _predict(
    learner: BatchDesign, memory: Buffers, seen: Vector, u_before: float
) -> tuple[float, float]:
    output = memory.theta[memory.theta.size - 1]
    if learner.with_u:
        output = memory.theta[learner.order] * u_before + output
    for i in range(learner.order):
        output += memory.theta[i] * seen[i]
    return output, 0.0


@commit.register(BatchDesign)
def _commit(
    learner: BatchDesign, memory: Buffers, seen: Vector, u: float, f_learned: float
) -> None:
    pass


@restart.register(BatchDesign)
def _restart(learner: BatchDesign, memory: Buffers) -> None:
    restart_buffers(memory)


@forget.register(BatchDesign)
def _forget(learner: BatchDesign, memory: Buffers) -> None:
    forget_buffers(memory)


@coefficients.register(BatchDesign)
def _coefficients(learner: BatchDesign, memory: Buffers, theta: Vector) -> None:
    for i in range(theta.size):
        theta[i] = memory.theta[i]


@dataclass(frozen=True)
class BatchGradient:
    """Algorithm 1 of the paper, with the features ``(x̂_1 … x̂_n, u, 1)`` and θ from zero.

    It is included for comparison. As printed it is fragile: it is stable in a small range of rates,
    which shrinks when a disturbance comes (docs/theory). Use ``Kalman`` instead.

    Parameters
    ----------
    features
        other features, which are scaled to O(1), as is Δf̂ (``scaled_features.py``); those of the
        paper, unscaled, by default.
    rate
        learning rate α, per sample. The cost is a sum over the batch, so the step grows with
        ``batch`` and, per unit of time, with 1/dt.
    batch
        size n of the three buffers, in samples.
    u
        whether u is one of the paper's features. Without it the algorithm does not learn the
        control law in place of the plant, and far larger rates are stable (docs/theory).

    Raises
    ------
    ValueError
        for a negative rate, a batch below 1, or something that is no block of features; for
        ``u = False`` beside ``features``, which say themselves what is used.
    """

    features: Features | None = None
    rate: float = 1e-6
    batch: int = 10
    u: bool = True

    def __post_init__(self) -> None:
        given: Any = self.features
        if not isinstance(given, Features | None):
            rule = "must be made of blocks, or None; give rate= and batch= by their names"
            raise ValueError(f"features = {self.features!r}: {rule}")
        checks.non_negative("rate", self.rate)
        checks.whole("batch", self.batch, 1)
        checks.flag("u", self.u)
        if self.features is not None and not self.u:
            raise ValueError("u = False: leave it out, as features say whether u is among them")

    def design(self, observer: ESO, omega_c: float) -> BatchDesign | ScaledDesign:
        """Return the parameters for an observer.

        The bandwidth ``omega_c`` [rad/s] is used only to scale features other than the paper's.
        """
        rate, order = float(self.rate), observer.order
        if self.features is None:
            return BatchDesign(rate, self.batch, order, self.u)
        return ScaledDesign(
            rate=rate,
            batch=self.batch,
            features=checked_design(self.features, order),
            unscaled=unscaled_indices(self.features, order),
            scaling=scaling(observer, omega_c, False),
            startup=startup_samples(observer),
        )

    def memory(self, parameters: Any) -> Buffers | ScaledMemory:
        """Return empty buffers and θ = 0."""
        if isinstance(parameters, BatchDesign):
            return empty_buffers(parameters.batch, parameters.order + 1 + parameters.with_u)
        scale = initial_scale(parameters.scaling)
        order = scale.size - 2
        p = len(self.feature_names(order))
        return ScaledMemory(
            buffers=empty_buffers(parameters.batch, p),
            loop=ScaledLoop.zeros(),
            scale=scale,
            sizes=initial_sizes(parameters.unscaled),
            scaled=np.zeros(order),
            units=np.ones(p),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1", …, "u", "bias")``, or the names of other features."""
        if self.features is None:
            return (*(f"x{i + 1}" for i in range(order)), *["u"] * self.u, "bias")
        return self.features.names(order)
