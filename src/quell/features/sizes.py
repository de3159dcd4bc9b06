"""Sizes of features that are functions of signals in the plant's units.

Nothing is known of their size beforehand. So each is divided by the smallest power of two that is
at least its largest absolute value so far, as signals are (``scaling.py``).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.features.base import Features, unit
from quell.features.scaling import LEAST, least_scale
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.functions import log2
from quell.types import Vector

Indices = NDArray[np.int64]


def unscaled_indices(features: Features, order: int) -> Indices:
    """Return the indices (k,) of the features whose size is unknown, for a plant of order n."""
    return np.flatnonzero(features.unscaled(order))


def initial_sizes(unscaled: Indices) -> Vector:
    """Return the sizes (k,) before the first sample."""
    return np.full(unscaled.size, LEAST)


@kernel
def reset_sizes(sizes: Vector) -> None:
    """Go back to the sizes before the first sample."""
    for k in range(sizes.size):
        sizes[k] = least_scale(sizes[k])


@kernel
def update_sizes(unscaled: Indices, sizes: Vector, values: Vector) -> bool:
    """Let ``sizes`` (k,) cover features with these unscaled ``values`` (p,); return if one grew."""
    grown = False
    for k in range(sizes.size):
        size = abs(values[unscaled[k]])
        if size > sizes[k] and is_finite(size):
            sizes[k] = 2.0 ** math.ceil(log2(size))
            grown = True
    return grown


@kernel
def scale_by_sizes(unscaled: Indices, sizes: Vector, values: Vector) -> None:
    """Divide features by their sizes.

    One that was always zero remains so until it has a size, and one that is not finite is zero:
    where a function of the user is not defined, it explains nothing.
    """
    for k in range(sizes.size):
        value = values[unscaled[k]]
        known = sizes[k] > least_scale(sizes[k]) and is_finite(value)
        values[unscaled[k]] = value / sizes[k] if known else 0.0


@kernel
def write_units(
    features: Any, unscaled: Indices, scale: Vector, sizes: Vector, out: Vector
) -> None:
    """Write the ``unit`` of features to ``out`` (p,), divided by their sizes."""
    unit(features, scale, out)
    for k in range(sizes.size):
        out[unscaled[k]] /= sizes[k]
