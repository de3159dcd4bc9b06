"""A cascade of extended state observers: less noise for the same disturbance rejection.

Łakomy & Madonski, *ISA Transactions* 109, 2021 (arXiv 2004.01483). The first level is slow and the only one that sees y; each further one
is faster, is told what those before it have found of f, and follows the output of the level before instead of y::

    ξ_1' = A ξ_1 + B (b0 u + f_L) + l_1 (y − ξ_1,1)
    ξ_i' = A ξ_i + B (b0 u + f_L + Σ_{j<i} ξ_j,N) + l_i (ξ_{i−1},1 − ξ_i,1)          i = 2 … p
    x̂ = (ξ_p,1 … ξ_p,n),     Δf̂ = Σ_j ξ_j,N

with bandwidths ``omega_1 < omega_2 = α omega_1 < … < omega_p``. Noise reaches the fast levels through the slow ones only. Here each level
is sampled exactly, with zero-order hold on u, f_L and the f of the levels before, and corrects as the current form does::

    ξ_i⁻ = Φ ξ_i + Γ_u u + Γ_f (f_L + Σ_{j<i} ξ_j,N),      ξ_i = ξ_i⁻ + L_i (ξ_{i−1},1 − ξ_i⁻,1),      ξ_0,1 = y

so that the poles of level i lie at ``exp(−omega_i dt)``: what one level tells the next does not come back.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from quell.observers.base import begin, observe, predict_state
from quell.types import Matrix, Vector


class CascadeModel(NamedTuple):
    """Parameters of p levels with N = n + 1 states each; the running state has the first level's first."""

    transition: Matrix
    """Φ (N, N)."""
    input: Vector
    """Γ_u (N,)."""
    feed: Vector
    """Γ_f (N,)."""
    gains: Matrix
    """L_i (p, N)."""

    @property
    def states(self) -> int:
        """Length of the running state."""
        return int(self.gains.size)


@observe.register(CascadeModel)
def _observe(
    model: CascadeModel, z: Vector, seen: Vector, y: float, u: float, f_learned: float
) -> None:
    levels, size = model.gains.shape
    target, told, found = y, f_learned, 0.0
    for level in range(levels):
        state = z[level * size : (level + 1) * size]
        f_before = state[size - 1]
        predict_state(model, state, seen, u, told)
        error = target - seen[0]
        for i in range(size):
            state[i] = seen[i] + model.gains[level, i] * error
        target = state[0]
        told += f_before
        found += state[size - 1]
        if level == levels - 1:
            for i in range(size):
                seen[i] = state[i]
    seen[size - 1] = found


@begin.register(CascadeModel)
def _begin(model: CascadeModel, z: Vector, seen: Vector, y: float) -> None:
    size = seen.size
    for i in range(z.size):
        z[i] = y if i % size == 0 else 0.0
    for i in range(size):
        seen[i] = 0.0
    seen[0] = y


def cascade_model(levels: Sequence[Any]) -> CascadeModel:
    """Return the cascade of these ``EsoModel``, which differ in their gain only; the first one sees y."""
    first = levels[0]
    return CascadeModel(
        first.transition, first.input, first.feed, np.array([level.gain for level in levels])
    )
