"""Automatic scaling: inputs and targets of O(1) whatever the plant's units.

The scale of x̂_i is the smallest power of two that is at least the largest ``|x̂_i|`` so far, so it
changes seldom and by a whole factor. It is at least ``ω^(i−1)/8`` of the scale of x̂_1, with a
frequency ω of the plant: at rest, where the higher derivatives are noise, noise is not scaled up to
O(1). The control signal and the total disturbance, which a learner has to predict, have their own
scales.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.functions import is_single, log2
from quell.kernels.sized import Flag
from quell.observers.eso import ESO
from quell.types import Vector

# Avoids division by zero and the logarithm of zero; far below any signal.
LEAST, LEAST_SINGLE = 1e-100, 1e-30
# Least scale of a derivative, as a share of the one in a motion of x_1 at the frequency ω. Chosen
# by hand; not tuned further.
_FLOOR = 1.0 / 8.0


class Scaling(NamedTuple):
    """Parameters, for a plant of order n."""

    floors: Vector  # least scales (n + 2,) over that of x_1: ω^(i−1)/8 for x_2 … x_n, else 0
    fixed: Flag  # whether the scales are given and do not change


def scaling(observer: ESO, frequency: float, fixed: bool) -> Scaling:
    """Return the scaling for an observer and a ``frequency`` of the plant [rad/s]."""
    floors = frequency ** np.arange(observer.order) * _FLOOR
    floors[0] = 0.0
    return Scaling(np.append(floors, [0.0, 0.0]), fixed)


def initial_scale(scaling: Scaling) -> Vector:
    """Return the scales before the first sample (n + 2,)."""
    return np.full(scaling.floors.size, LEAST)


@kernel
def least_scale(like: float) -> float:
    """Return the scale of what was always zero, in the precision of ``like``."""
    return LEAST_SINGLE if is_single(like) else LEAST


@kernel
def reset_scale(scaling: Scaling, scale: Vector) -> None:
    """Go back to the scales before the first sample, unless they are given."""
    if scaling.fixed:
        return
    for i in range(scale.size):
        scale[i] = least_scale(scale[i])


@kernel
def update_scale(scaling: Scaling, scale: Vector, estimate: Vector, u: float, f: float) -> None:
    """Increase ``scale`` (n + 2,) to cover the state in ``estimate`` (n + 1,), ``u`` and ``f``."""
    if scaling.fixed:
        return
    order = scale.size - 2
    for i in range(scale.size):
        size = abs(estimate[i]) if i < order else (abs(u) if i == order else abs(f))
        size = max(size, scaling.floors[i] * scale[0], least_scale(scale[i]))
        if size > scale[i] and is_finite(size):
            scale[i] = 2.0 ** math.ceil(log2(size))
