"""The buffers of Algorithm 1 and its gradient step, O(p) a sample for any buffer size.

Three buffers of size n hold the newest features I, residuals ``ΔF = Δf̂`` and outputs
``F_L = h_θ(I)``. Once they are full, each sample replaces the oldest entry, takes one step down the
gradient of

    J(θ) = ½ Σ_i (h_θ(I_i) − f̂_i)²,        f̂_i = F_L,i + ΔF_i          (eq. (cost))

and relabels the whole batch, ``F_L = h_θ(I)`` (line 18). So the gradient at the next sample is

    ∇J = Σ_i (h_θ(I_i) − F_L,i − ΔF_i) I_i = −Σ_i Δf̂_i I_i

for any θ: a sliding sum, and F_L need not be stored (``outputs`` computes it). A sliding sum
drifts in floating point. So a second sum is built from the entries written since the ring last
wrapped around, and replaces the first when the ring wraps: no rounding error is older than 2n
samples, and every sample costs the same.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.sized import Buffer
from quell.types import Vector


class Buffers(NamedTuple):
    """State of Algorithm 1 with p features and buffers of size n."""

    theta: Vector  # (p,)
    features: Buffer  # I (n, p), a ring
    residuals: Buffer  # ΔF (n,), a ring
    total: Vector  # Σ Δf̂ I over the ring (p,)
    fresh: Vector  # the same over the entries written since the ring last wrapped around (p,)
    current: Vector  # work space for the newest features (p,)
    position: Vector  # (2,): row of the next entry; 1 once the ring has been full


def empty_buffers(n: int, p: int) -> Buffers:
    """Return empty buffers of size ``n`` and θ = 0 for ``p`` features."""
    rows = np.zeros((n, p)), np.zeros(n)
    return Buffers(np.zeros(p), *rows, np.zeros(p), np.zeros(p), np.zeros(p), np.zeros(2))


def outputs(memory: Buffers) -> Vector:
    """Return the buffer F_L (n,): the batch labelled with the newest θ."""
    return np.asarray(memory.features @ memory.theta)


@kernel
def take_step(memory: Buffers, residual: float, rate: float) -> None:
    """Put ``memory.current`` and ``residual`` into the buffers; if they are full, move θ."""
    position, size = memory.position, memory.residuals.size
    row = min(max(int(position[0]), 0), size - 1)
    oldest = memory.residuals[row]
    for i in range(memory.theta.size):
        gained = residual * memory.current[i]
        memory.total[i] += gained - oldest * memory.features[row, i]
        memory.fresh[i] += gained
        memory.features[row, i] = memory.current[i]
    memory.residuals[row] = residual
    row += 1
    if row == size:
        row = 0
        position[1] = 1.0
        for i in range(memory.theta.size):
            memory.total[i] = memory.fresh[i]
            memory.fresh[i] = 0.0
    position[0] = row
    if position[1] > 0.0:
        for i in range(memory.theta.size):
            memory.theta[i] += rate * memory.total[i]


@kernel
def clear_buffers(memory: Buffers) -> None:
    """Empty the buffers; keep θ."""
    for i in range(memory.theta.size):
        memory.total[i] = memory.fresh[i] = 0.0
        for k in range(memory.residuals.size):
            memory.features[k, i] = 0.0
    for k in range(memory.residuals.size):
        memory.residuals[k] = 0.0
    memory.position[0] = memory.position[1] = 0.0


@kernel
def restart_buffers(memory: Buffers) -> None:
    """Keep buffers and θ if θ and the sum are finite; else start from zero."""
    finite = True
    for i in range(memory.theta.size):
        finite = finite and is_finite(memory.theta[i]) and is_finite(memory.total[i])
    if not finite:
        forget_buffers(memory)


@kernel
def forget_buffers(memory: Buffers) -> None:
    """Start from zero."""
    for i in range(memory.theta.size):
        memory.theta[i] = 0.0
    clear_buffers(memory)
