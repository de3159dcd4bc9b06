"""The set of plants that an identified model stands for: its deviations as plants of their own.

The coefficients θ of the model have a covariance P. The set has the model itself, and the points
``θ ± k √λ_i v_i`` on the axes of its ellipsoid, with λ_i and v_i the eigenvalues and eigenvectors
of P (the correlation matrix, so that units do not matter). These are the points of the unscented
transformation (Julier & Uhlmann, *Proc. IEEE* 92, 2004, sec. III) for the deviation k. A delay that
was found to the nearest sample may be half a sample longer, which is the worse side.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quell.identification.result import Identified
from quell.types import Vector

# Standard deviations of the points, so that each is on the edge of about 95 %.
_DEVIATIONS = 2.0


def identified_plants(
    found: Identified, late: float = 0.0
) -> tuple[list[tuple[Vector, Vector]], list[float]]:
    """Return the plants ``(num, den)`` that a model stands for, itself first, and their delays [s].

    Parameters
    ----------
    found
        result of ``identify``.
    late
        additional delay of all plants but the first [s]: half a sample if the delay was searched.

    Raises
    ------
    ValueError
        for direct feedthrough, or a gain whose sign the record does not tell.
    """
    _ = found.plant  # says why not, for direct feedthrough
    free = found.den.size - 1 - found.integrators
    theta = np.concatenate([found.den[::-1][found.integrators : -1], found.num[::-1]])
    spread = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    if not np.all(np.isfinite(spread)):
        raise ValueError("found: its deviations are not finite; identify with a lower order")

    def plant(values: Vector) -> tuple[Vector, Vector]:
        den = np.concatenate([[1.0], values[:free][::-1], np.zeros(found.integrators)])
        return values[free:][::-1].copy(), den

    scale = np.where(spread > 0.0, spread, 1.0)
    sizes, axes = np.linalg.eigh(found.covariance / np.outer(scale, scale))
    points: list[Any] = [theta]
    for size, axis in zip(np.sqrt(np.maximum(sizes, 0.0)), axes.T, strict=True):
        step = _DEVIATIONS * size * axis * scale
        points += [theta + step, theta - step] if np.any(step != 0.0) else []
    if any(point[-1] * theta[-1] <= 0.0 for point in points):
        raise ValueError(
            f"gain = {theta[-1]:.3g} ± {spread[-1]:.2g}: the record does not tell its sign; "
            "excite more, for a longer time, or lower the order"
        )
    delays = [found.delay] + [found.delay + late] * (len(points) - 1)
    return [plant(point) for point in points], delays
