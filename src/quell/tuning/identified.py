"""The set of plants that an identified model stands for: its deviations as plants of their own.

The coefficients θ of the model have a covariance P. With 95 % all of them together are in the
ellipsoid ``(θ' − θ)ᵀ P⁻¹ (θ' − θ) ≤ k²``, k² being the 95 % quantile of χ² with as many degrees of
freedom as there are coefficients. The set has the model itself, and the points of the ellipsoid
that are farthest in the direction of each coefficient and of the gain K::

    θ ± k P c/√(cᵀ P c),     c = e_i for each coefficient, and ∂K/∂θ

so that each coefficient and the gain have their whole joint interval in the set (Scheffé's
intervals: Seber & Lee, *Linear Regression Analysis*, 2nd ed. 2003, sec. 5.1.1). A delay that was
searched is one of the coefficients: a longer one goes with faster poles. Other models that the
record does not tell apart from it are plants of the set, too.
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
    theta = np.concatenate(
        [found.den[::-1][found.integrators : -1], found.num[::-1], [found.delay]]
    )
    size = theta.size - 1
    P = np.zeros((theta.size, theta.size))
    P[:size, :size], P[size], P[:, size] = found.covariance, *[found.delay_covariance] * 2
    if not np.all(np.isfinite(P)):
        raise ValueError("found: its deviations are not finite; identify with a lower order")
    directions = list(np.eye(theta.size))
    if free and theta[0] != 0.0:
        of_gain = np.zeros(theta.size)
        of_gain[free], of_gain[0] = 1.0 / theta[0], -theta[free] / theta[0] ** 2
        directions.append(of_gain)
    known = int(np.sum(np.diag(P) > 0.0))
    k = float(np.sqrt(chi2.ppf(_INSIDE, known))) if known else 0.0
    points = [theta]
    for c in directions:
        spread = float(np.sqrt(max(float(c @ P @ c), 0.0)))
        if spread > 0.0:
            step = k * (P @ c) / spread
            points += [_moved(theta, step, size), _moved(theta, -step, size)]
    plants = []
    for point in points:
        den = np.concatenate([[1.0], point[:free][::-1], np.zeros(found.integrators)])
        plants.append((point[free:size][::-1].copy(), den))
    delays = [max(float(point[size]), 0.0) for point in points]
    for other in others:
        plants.append((other.num, other.den))
        delays.append(other.delay)
    return plants, delays


def _moved(theta: Vector, step: Vector, size: int) -> Vector:
    """Return θ after a step, ``θ exp(step/θ)`` if else the sign of the highest b would change.

    Then a fast pole is uncertain, which changes all coefficients by the same factor.
    """
    point = theta + step
    if point[size - 1] * theta[size - 1] <= 0.0:
        known = theta[:size] != 0.0
        part = np.where(known, theta[:size], 1.0)
        point[:size] = np.where(known, part * np.exp(step[:size] / part), point[:size])
    return point
