"""Automatic scaling: inputs and targets of O(1) whatever the plant's units.

x̂_i is divided by a power of two that is no smaller than what x̂_i has reached, so that a scale changes seldom, and by a whole factor when
it does. It is never smaller than what the scale of x̂_1 lets expect of a motion at the frequency ω: ``ω^(i−1)/8`` of it. At rest, where
the higher derivatives are noise, noise is not blown up to O(1). The control signal and the total disturbance, which is what a learner has
to predict, have scales of their own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quell.kernels.dispatch import is_finite, kernel
from quell.observers.eso import ESO
from quell.types import Vector

_LEAST = 1e-100


class Scaling(NamedTuple):
    """Parameters, for a plant of order n."""

    floors: Vector
    """ω^(i−1)/8 for x_2 … x_n; 0 for x_1, u and f (n + 2,)."""
    fixed: bool
    """Whether the scales are given, not found."""


def scaling(observer: ESO, frequency: float, fixed: bool) -> Scaling:
    """Return the scaling for an observer and a frequency the plant has [rad/s]."""
    floors = frequency ** np.arange(observer.order) / 8.0
    floors[0] = 0.0
    return Scaling(np.append(floors, [0.0, 0.0]), fixed)


def initial_scale(scaling: Scaling) -> Vector:
    """Return the scales before the first sample (n + 2,)."""
    return np.full(scaling.floors.size, _LEAST)


@kernel
def update_scale(scaling: Scaling, scale: Vector, seen: Vector, u: float, f: float) -> None:
    """Let ``scale`` (n + 2,) grow to hold the state in ``seen`` (n + 1,), ``u`` and ``f``."""
    if scaling.fixed:
        return
    order = scale.size - 2
    for i in range(scale.size):
        size = abs(seen[i]) if i < order else (abs(u) if i == order else abs(f))
        size = max(size, scaling.floors[i] * scale[0], _LEAST)
        if size > scale[i] and is_finite(size):
            scale[i] = 2.0 ** math.ceil(math.log2(size))
