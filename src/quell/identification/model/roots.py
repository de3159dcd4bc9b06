"""Poles, zeros and gain with their deviations.

Those of poles and zeros are of first order: ``δp = −Σ p^i δa_i / A'(p)``.

The gain ``K = b_0/a_q`` is a ratio, whose distribution is far from normal where a_q, a slow pole,
is uncertain. Its 95 % interval has all K for which ``b_0 − K a_q`` is within 1.96 standard
deviations of zero (Fieller, *J. Royal Statistical Society B* 16, 1954)::

    K² (a² − z² V_aa) − 2 K (a b − z² V_ab) + b² − z² V_bb ≤ 0,      z = 1.96

It may be open to one side: then a_q may be zero, the plant an integrator. A fast pole that the
record does not show makes a_q and b_0 uncertain, both by the same factor; so both are divided first
by the coefficient of A, or one, that leaves the smallest relative deviation of b_0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.types import Matrix, Vector

# Deviations within which a normal number lies with 95 %.
WITHIN_95 = 1.96


class Root(NamedTuple):
    """A pole or a zero; of a conjugate pair both are listed."""

    value: complex  #: [rad/s]
    real_std: float  #: standard deviation of the real part [rad/s]; 0 for a root that was set
    imag_std: float  #: standard deviation of the imaginary part [rad/s]

    @property
    def omega(self) -> float:
        """Distance from s = 0 [rad/s]."""
        return abs(self.value)

    @property
    def deviation(self) -> float:
        """Standard deviation of the distance to the true root [rad/s]."""
        return math.hypot(self.real_std, self.imag_std)

    @property
    def damping(self) -> float:
        """Damping ratio; 1 for real roots in the left half plane, NaN at s = 0."""
        return -self.value.real / abs(self.value) if self.value else math.nan


def _root(a: Vector, covariance: Matrix, value: complex) -> Root:
    """Return a root of ``p^n + a_{n−1} p^(n−1) + … + a_0`` with its deviations."""
    real, imag = (math.sqrt(max(part, 0.0)) for part in root_covariance(a, covariance, value))
    return Root(complex(value), real, imag if complex(value).imag else 0.0)


def gain_interval(a: Vector, b: float, covariance: Matrix) -> tuple[float, float]:
    """Return the 95 % interval of ``b/a_0``; infinite ends if a_0 may be zero.

    ``a`` (n,) are the coefficients of the poles that are not set to s = 0, ascending, and
    ``covariance`` is that of a and b. Without any a it is the interval of b. An interval that has
    zero in it and is open has both ends infinite.
    """
    n = a.size
    if not np.all(np.isfinite(covariance)):
        return -math.inf, math.inf
    if n == 0:
        half = WITHIN_95 * math.sqrt(max(float(covariance[n, n]), 0.0))
        return b - half, b + half
    candidates = []
    for i in range(n):
        # i = 0 divides by one, the others by a_i: α = a_0/s, β = b/s.
        s, of_s = (1.0, np.zeros(n + 1)) if i == 0 else (float(a[i]), np.eye(n + 1)[i])
        if s == 0.0:
            continue
        alpha, beta = float(a[0]) / s, float(b) / s
        slopes = np.array([np.eye(n + 1)[0], np.eye(n + 1)[n]])
        slopes = (slopes - np.outer([alpha, beta], of_s)) / s
        part = slopes @ covariance @ slopes.T
        candidates.append((float(part[1, 1]) / beta**2 if beta else math.inf, alpha, beta, part))
    _, alpha, beta, part = min(candidates, key=lambda one: one[0])
    return _fieller(alpha, beta, part)


def _fieller(a: float, b: float, covariance: Matrix) -> tuple[float, float]:
    """Return the interval of b/a that has the estimate in it."""
    z2 = WITHIN_95**2
    of_a, of_b, both = float(covariance[0, 0]), float(covariance[1, 1]), float(covariance[0, 1])
    square, linear, constant = a * a - z2 * of_a, a * b - z2 * both, b * b - z2 * of_b
    # linear² − square · constant, without the terms that cancel
    spread = a * a * of_b + b * b * of_a - 2.0 * a * b * both
    root = z2 * spread + z2 * z2 * (both * both - of_a * of_b)
    if square > 0.0:
        half = math.sqrt(max(root, 0.0))
        return (linear - half) / square, (linear + half) / square
    if root <= 0.0 or square == 0.0:
        return -math.inf, math.inf
    half = math.sqrt(root)
    ends = sorted([(linear - half) / square, (linear + half) / square])
    if constant <= 0.0:  # zero is in it
        return -math.inf, math.inf
    return (-math.inf, ends[0]) if a * b < 0.0 else (ends[1], math.inf)


def poles_of(a: Vector, covariance: Matrix, integrators: int) -> tuple[Root, ...]:
    """Return the poles, slow ones first; a_i is zero for i < ``integrators``."""
    free = a[integrators:]
    part = covariance[: free.size, : free.size]
    found = [_root(free, part, value) for value in np.roots(np.append(1.0, free[::-1])).tolist()]
    known = [Root(0j, 0.0, 0.0)] * integrators
    return tuple(sorted([*known, *found], key=lambda root: (root.omega, -root.value.imag)))


def zeros_of(b: Vector, covariance: Matrix) -> tuple[Root, ...]:
    """Return the roots of the numerator b, in ascending powers."""
    if b.size < 2:
        return ()
    monic = b[:-1] / b[-1]
    slope = np.column_stack([np.eye(monic.size), -monic]) / b[-1]
    part = slope @ covariance @ slope.T
    return tuple(_root(monic, part, value) for value in np.roots(b[::-1]).tolist())


def squared_distance_from_zero(
    a: Vector, covariance: Matrix, roots: NDArray[np.complex128]
) -> float:
    """Return the squared distance of one or two roots from s = 0, in standard deviations."""
    slopes = np.array([_slope(a, root) for root in roots])
    if roots.size == 1:
        coefficients, slopes = -roots, -slopes
    else:
        coefficients = np.array([roots[0] * roots[1], -roots[0] - roots[1]])
        slopes = np.array([roots[1] * slopes[0] + roots[0] * slopes[1], -slopes[0] - slopes[1]])
    part = slopes.real @ covariance @ slopes.real.T
    size = np.sqrt(np.maximum(np.diag(part), 1e-300))
    away = coefficients.real / size
    return float(away @ np.linalg.pinv(part / np.outer(size, size), hermitian=True) @ away)


def root_covariance(a: Vector, covariance: Matrix, root: complex) -> tuple[float, float]:
    """Return the variances of real and imaginary part of a root, from the covariance of a."""
    slope = _slope(a, root)
    return float(slope.real @ covariance @ slope.real), float(slope.imag @ covariance @ slope.imag)


def _slope(a: Vector, root: complex) -> NDArray[np.complex128]:
    """Return the derivatives of a root by a."""
    powers = root ** np.arange(a.size)
    return np.asarray(-powers / np.polyval(np.polyder(np.append(1.0, a[::-1])), root))
