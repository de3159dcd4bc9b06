"""A cascade of extended state observers: less noise for the same disturbance rejection.

Łakomy & Madonski, *ISA Transactions* 109, 2021 (arXiv 2004.01483). The first level is slow and the
only one that reads y. Each further level is faster, uses the estimates of f of all levels before
it, and follows the output of the level before instead of y::

    ξ_1' = A ξ_1 + B (b0 u + f_L) + l_1 (y − ξ_1,1)
    ξ_i' = A ξ_i + B (b0 u + f_L + Σ_{j<i} ξ_j,n+1) + l_i (ξ_{i−1},1 − ξ_i,1)        i = 2 … p
    x̂ = (ξ_p,1 … ξ_p,n),     Δf̂ = Σ_j ξ_j,n+1

with bandwidths ``omega_1 < omega_2 = α omega_1 < … < omega_p``. Noise reaches the fast levels only
through the slow ones. Here each level is sampled exactly, with zero-order hold on u, f_L and the f
of the levels before, and corrects as the current form does::

    ξ_i⁻ = Φ ξ_i + Γ_u u + Γ_f (f_L + Σ_{j<i} ξ_j,n+1)
    ξ_i  = ξ_i⁻ + L_i (ξ_{i−1},1 − ξ_i⁻,1),      ξ_0,1 = y

With m extended states ``ξ_i,n+1`` is f, and f', … follow; f of the levels before is held over a
sample as f is in each level's own model, so nothing else changes. The poles of level i lie at
``exp(−omega_i dt)``, because no level feeds back to one before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.kernels.dispatch import kernel
from quell.kernels.sized import Size
from quell.observers.base import begin, observe, predict_state
from quell.observers.linear import EsoModel
from quell.types import Matrix, Vector


class CascadeModel(NamedTuple):
    """Parameters of p levels with N = n + m states each; the state of the first level is first."""

    transition: Matrix  # Φ (N, N)
    input: Vector  # Γ_u (N,)
    feed: Vector  # Γ_f (N,)
    gains: Matrix  # L_i (p, N)
    at_f: Size  # n, the place of f in a level's state

    @property
    def states(self) -> int:
        """Length of the running state."""
        return int(self.gains.size)


@kernel
def add_levels(z: Vector, estimate: Vector, at_f: int, levels: int, stride: int) -> None:
    """Set f and its derivatives in ``estimate`` to their sums over the levels in ``z``."""
    for i in range(at_f, estimate.size):
        total = 0.0
        for level in range(levels):
            total += z[level * stride + i]
        estimate[i] = total


@observe.register(CascadeModel)
def _observe(
    model: CascadeModel, z: Vector, estimate: Vector, y: float, u: float, f_learned: float
) -> None:
    levels, size = model.gains.shape
    target, f_known = y, f_learned
    for level in range(levels):
        state = z[level * size : (level + 1) * size]
        f_before = state[model.at_f]
        predict_state(model, state, estimate, u, f_known)
        error = target - estimate[0]
        for i in range(size):
            state[i] = estimate[i] + model.gains[level, i] * error
        target = state[0]
        f_known += f_before
    for i in range(model.at_f):
        estimate[i] = z[(levels - 1) * size + i]
    add_levels(z, estimate, model.at_f, levels, size)


@begin.register(CascadeModel)
def _begin(model: CascadeModel, z: Vector, estimate: Vector, y: float) -> None:
    size = estimate.size
    for i in range(z.size):
        z[i] = y if i % size == 0 else 0.0
    for i in range(size):
        estimate[i] = 0.0
    estimate[0] = y


def level_bandwidths(omega_o: float, levels: int, ratio: float) -> list[float]:
    """Return the bandwidths ``omega_1 … omega_p = omega_o`` of the levels [rad/s]."""
    p, ratio = checks.whole("levels", levels, 1, 8), checks.positive("ratio", ratio)
    if ratio <= 1.0:
        raise ValueError(f"ratio = {ratio!r}: must be above 1, so that each level is faster")
    return [omega_o / ratio ** (p - 1 - i) for i in range(p)]


def cascade_model(levels: Sequence[EsoModel], order: int) -> CascadeModel:
    """Return the cascade of ``levels``, which differ only in their gain; the first one reads y."""
    first = levels[0]
    gains = np.array([level.gain for level in levels])
    return CascadeModel(first.transition, first.input, first.feed, gains, order)
