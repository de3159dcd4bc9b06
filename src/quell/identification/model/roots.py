"""Poles and zeros with their standard deviations, to first order: ``δp = −Σ p^i δa_i / A'(p)``."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.types import Matrix, Vector


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
