"""The set of plants that an identified model stands for: its deviations as plants of their own.

The coefficients θ of the model have a covariance P. With 95 % all of them together are in the
ellipsoid ``(θ' − θ)ᵀ P⁻¹ (θ' − θ) ≤ k²``, k² being the 95 % quantile of χ² with as many degrees of
freedom as there are coefficients. The set has the model itself, and the points of the ellipsoid that
are farthest in the direction of each coefficient and of the gain K::

    θ ± k P c/√(cᵀ P c),     c = e_i for each coefficient, and ∂K/∂θ

so that each coefficient and the gain have their whole joint interval in the set (Scheffé's
intervals: Seber & Lee, *Linear Regression Analysis*, 2nd ed. 2003, sec. 5.1.1). The model is there
with the shortest delay of its interval, too; all points have the longest one, which is the worse
side. Other models that the record does not tell apart from it are plants of the set, too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quell.identification.result import Identified
from quell.types import Vector

# Probability of the ellipsoid.
_INSIDE = 0.95


def identified_plants(
    found: Identified, others: Sequence[Identified] = ()
) -> tuple[list[tuple[Vector, Vector]], list[float]]:
    """Return the plants ``(num, den)`` that a model stands for, itself first, and their delays [s].

    Parameters
    ----------
    found
        result of ``identify``.
    others
        further models of the record, as ``not_told_apart`` returns them behind the first.

    Raises
    ------
    ValueError
        for direct feedthrough, or what the record does not decide of sign and size of the gain, the
        start at rest and the delay.
    """
    from scipy.stats import chi2

    _ = found.plant  # says why not, for direct feedthrough
    if found.undecided:
        raise ValueError(f"found: {'; '.join(found.undecided)}")
    free = found.den.size - 1 - found.integrators
    theta = np.concatenate([found.den[::-1][found.integrators : -1], found.num[::-1]])
    P = found.covariance
    if not np.all(np.isfinite(P)):
        raise ValueError("found: its deviations are not finite; identify with a lower order")

    def plant(values: Vector) -> tuple[Vector, Vector]:
        den = np.concatenate([[1.0], values[:free][::-1], np.zeros(found.integrators)])
        return values[free:][::-1].copy(), den

    k = float(np.sqrt(chi2.ppf(_INSIDE, theta.size)))
    directions = list(np.eye(theta.size))
    if free and theta[0] != 0.0:
        of_gain = np.zeros(theta.size)
        of_gain[free], of_gain[0] = 1.0 / theta[0], -theta[free] / theta[0] ** 2
        directions.append(of_gain)
    points = [theta]
    for c in directions:
        spread = float(np.sqrt(max(c @ P @ c, 0.0)))
        step = k * (P @ c) / spread if spread > 0.0 else np.zeros(theta.size)
        points += [theta + step, theta - step] if np.any(step != 0.0) else []
    if any(point[-1] * theta[-1] <= 0.0 for point in points):
        spread = float(np.sqrt(P[-1, -1]))
        raise ValueError(
            f"gain = {theta[-1]:.3g} ± {spread:.2g}: the record does not tell its sign; "
            "excite more, for a longer time, or lower the order"
        )
    plants = [plant(point) for point in points]
    shortest, longest = found.delay_interval
    delays = [found.delay] + [longest] * (len(points) - 1)
    if shortest < found.delay:
        plants, delays = [*plants, plants[0]], [*delays, shortest]
    for other in others:
        plants.append((other.num, other.den))
        delays.append(other.delay)
    return plants, delays
