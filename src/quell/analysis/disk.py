"""Structured singular values of sensitivities, and the disk margins of several channels.

Every channel i of a loop has a factor of its own (Seiler, Packard & Gahinet, "An introduction to
disk margins", *IEEE Control Systems* 40, 2020, arXiv 2003.04771)::

    f_i = (1 + (1 − σ)/2 δ_i)/(1 − (1 + σ)/2 δ_i),    |δ_i| < α,    σ the skew

which is 1 for δ_i = 0, and may change at every frequency, in gain and phase at once, differently in
each channel. With ``M = S + (σ − 1)/2 I`` the loop is lost for the smallest α at which ``det(I − M
diag(δ)) = 0`` at some frequency, which is ``1/max μ(M)``; μ is the structured singular value for
independent complex numbers. With σ = 0, ``M = (S − T)/2``.

**Bounds on μ.** With a diagonal matrix D > 0, ``μ(M) ≤ min_D σ̄(D M D⁻¹)``; for up to three channels
it is equal (Doyle, *IEE Proceedings D* 129, 1982), and for more it is hardly ever much larger. It
does not depend on the units of the channels. Without D it is the bound for a change that mixes
channels, of which nothing is known but its size: ``σ̄(M)``. From below, ``μ ≥ ρ(M Q)`` for
every diagonal Q of numbers of size 1: each is a δ = Q/λ that puts a pole on the unit circle.

The best D is found by the method of analytic centres (Boyd & El Ghaoui, *Linear Algebra and its
Applications* 188, 1993): with P = D², ``β² P − Mᴴ P M > 0`` is a convex set of diagonal P, which is
shrunk by lowering β. Whatever the accuracy of D, the bound is one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from quell.analysis.margins import Complex
from quell.types import Vector

# Rounds of balancing rows and columns, each of which divides the error by three or more.
_BALANCING = 12
# Largest ratio of two entries of D, above all ratios of units: a channel that does not act back on
# another one is scaled away. Beyond balanced rows and columns the squares of D differ by less.
_LARGEST_RATIO, _LEAST_SHARE = 1e20, 1e-8
# Relative distance of the bound from its minimum at which the search ends, and what a step keeps of
# that distance.
_GAP, _KEPT = 1e-8, 0.1
# Points of the grid whose surroundings are searched: so many of the highest, no lower than this
# share of the highest. The grid itself is fine enough for a few parts in a thousand.
_CANDIDATES, _CLOSE = 12, 0.99
# Relative error of the frequency that is found; that of the value is its square.
_FREQUENCY = 1e-6
# Starts of the search for the worst phases: from the best D, and random ones with a fixed seed.
_STARTS = 6


class DiskMargin(NamedTuple):
    """Disk margin of several channels that change at the same time, and what shows that it is one.

    For a single channel it is the disk margin of ``Margins``.
    """

    alpha: float
    """The largest α with a stable loop for all ``|δ_i| < α``; zero for an unstable loop."""
    omega: float
    """Frequency at which α is decided [rad/s]; NaN for an unstable loop."""
    unstructured: float
    """α for a change that mixes the channels, ``1/max σ̄(M)``; never larger than ``alpha``."""
    unstructured_omega: float
    lost_at: float
    """An α at which the loop is lost, with ``factors``; equal to ``alpha`` where that is exact."""
    factors: tuple[complex, ...]
    """Factors of the channels at ``omega``, of size ``lost_at``, that put a pole on the circle."""
    skew: float = 0.0

    @property
    def gain(self) -> tuple[float, float]:
        """Factors within which the gains of all channels may vary at the same time."""
        return disk_gain(self.alpha, self.skew)

    @property
    def phase(self) -> float:
        """Phase by which all channels may vary at the same time, without gain [degrees]."""
        return disk_phase(self.alpha, self.skew)


def disk_gain(alpha: float, skew: float = 0.0) -> tuple[float, float]:
    """Return the least and the largest gain in the disk of factors."""
    near, far = alpha * (1.0 - skew), alpha * (1.0 + skew)
    low = max((2.0 - near) / (2.0 + far), 0.0)
    return low, (2.0 + near) / (2.0 - far) if far < 2.0 else math.inf


def disk_phase(alpha: float, skew: float = 0.0) -> float:
    """Return the phase in the disk of factors at the gain 1 [degrees]."""
    # |δ| of the factor e^(jφ): δ = (f − 1)/((1 − σ)/2 + (1 + σ)/2 f); it grows with φ up to π.
    if abs(alpha * skew) >= 2.0:
        return 180.0
    # |f − 1| = 2 sin(φ/2), and the denominator is cos(φ/2) + j σ sin(φ/2) in size.
    return math.degrees(2.0 * math.atan(alpha / math.sqrt(4.0 - (alpha * skew) ** 2)))


def balanced(M: Complex) -> tuple[Complex, Vector]:
    """Return ``D M D⁻¹`` for matrices (k, c, c) with rows as large as columns, and D (k, c)."""
    c = M.shape[-1]
    size = np.abs(M) ** 2 * (1.0 - np.eye(c))
    floor = 1e-30 * np.max(np.abs(M), axis=(1, 2)) ** 2 + 1e-300
    log = np.zeros(M.shape[:2])
    for _ in range(_BALANCING):
        for i in range(c):
            row, column = size[:, i].sum(axis=1) + floor, size[:, :, i].sum(axis=1) + floor
            factor = np.sqrt(column / row)  # of the squares
            size[:, i] *= factor[:, None]
            size[:, :, i] /= factor[:, None]
            log[:, i] += 0.5 * np.log(factor)
    log -= np.mean(log, axis=1, keepdims=True)
    D = np.exp(np.clip(log, -0.5 * math.log(_LARGEST_RATIO), 0.5 * math.log(_LARGEST_RATIO)))
    return M * D[:, :, None] / D[:, None, :], D


def best_scales(M: Complex) -> tuple[float, Vector]:
    """Return the least ``σ̄(D M D⁻¹)`` of a matrix (c, c), and D (c,), with a product of one."""
    c = M.shape[0]
    start, D = balanced(M[None])
    X = start[0]
    best = float(np.linalg.norm(X, 2))
    if c == 1 or best == 0.0:
        return best, D[0]
    p, p_best = np.full(c, 1.0 / c), np.full(c, 1.0 / c)
    beta = best**2 * (1.0 + _KEPT)
    for _ in range(200):
        p = _centre(X, beta, p)
        root = np.sqrt(p)
        now = float(np.linalg.norm(root[:, None] * X / root, 2)) ** 2
        if now < best**2:
            best, p_best = math.sqrt(now), p
        if beta - now <= _GAP * beta or np.min(p) < _LEAST_SHARE:
            break
        beta = now + _KEPT * (beta - now)
    found = D[0] * np.sqrt(p_best)
    return best, found / math.exp(float(np.mean(np.log(found))))


def _centre(X: Complex, beta: float, p: Vector) -> Vector:
    """Return the analytic centre of ``beta P − Xᴴ P X > 0``, P > 0, tr P = 1; p is inside."""
    c = p.size
    parts = np.array([-np.outer(row.conj(), row) for row in X])
    parts[np.arange(c), np.arange(c), np.arange(c)] += beta
    # Directions that keep the sum of p.
    keep = np.linalg.qr(np.column_stack([np.ones(c), np.eye(c)[:, : c - 1]]))[0][:, 1:]

    def value(p: Vector) -> float:
        if np.min(p) <= 0.0:
            return math.inf
        eigenvalues = np.linalg.eigvalsh(np.tensordot(p, parts, 1))
        if eigenvalues[0] <= 0.0:
            return math.inf
        return -float(np.sum(np.log(eigenvalues)) + np.sum(np.log(p)))

    now = value(p)
    for _ in range(30):
        inverse = np.linalg.inv(np.tensordot(p, parts, 1))
        shaped = inverse @ parts
        slope = -np.real(np.trace(shaped, axis1=1, axis2=2)) - 1.0 / p
        bend = np.real(np.einsum("iab,jba->ij", shaped, shaped)) + np.diag(1.0 / p**2)
        step = -keep @ np.linalg.solve(keep.T @ bend @ keep, keep.T @ slope)
        decrement = float(-slope @ step)
        length = 1.0
        while length > 1e-9 and not value(p + length * step) <= now - 0.1 * length * decrement:
            length *= 0.5
        if length <= 1e-9:
            break
        p = p + length * step
        now = value(p)
        if decrement < 1e-6:
            break
    return p


def worst_change(M: Complex) -> tuple[float, Complex]:
    """Return the smallest α that was found to make ``I − M diag(δ)`` singular, and δ (c,)."""
    from scipy.optimize import minimize

    c = M.shape[0]
    X, _ = balanced(M[None])
    left, _, right = np.linalg.svd(X[0])
    starts = [np.angle(right[0].conj()) - np.angle(left[:, 0])]
    rng = np.random.default_rng(0)
    starts += [rng.uniform(-math.pi, math.pi, c) for _ in range(_STARTS if c > 1 else 0)]

    def spectrum(phase: Vector) -> complex:
        found = np.linalg.eigvals(X[0] * np.exp(1j * phase))
        return complex(found[np.argmax(np.abs(found))])

    def negative(phase: Vector) -> float:
        return -math.log(max(abs(spectrum(phase)), 1e-300))

    found = [minimize(negative, start, method="BFGS", tol=1e-10).x for start in starts]
    phase = min(found, key=negative)
    value = spectrum(phase)
    if value == 0.0:
        return math.inf, np.full(c, np.inf + 0j)
    delta: Complex = np.exp(1j * phase) / value
    return 1.0 / abs(value), delta


def factors_of(delta: Complex, skew: float) -> tuple[complex, ...]:
    """Return the factors of the channels for δ (c,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        f = (1.0 + 0.5 * (1.0 - skew) * delta) / (1.0 - 0.5 * (1.0 + skew) * delta)
    return tuple(complex(x) for x in f)


def largest_scaled(
    matrices: Callable[[Vector], Complex], omega: Vector, values: Complex
) -> tuple[float, float]:
    """Return the largest ``min_D σ̄(D M D⁻¹)`` over the frequencies, and where it is.

    Parameters
    ----------
    matrices
        function that returns M (k, c, c) at frequencies (k,).
    omega
        grid of frequencies (k,) [rad/s].
    values
        M (k, c, c) at the grid.
    """
    from scipy.optimize import minimize_scalar

    cheap = np.linalg.norm(balanced(values)[0], 2, axis=(1, 2))
    exact = np.full(omega.size, -math.inf)
    # The cheap bound is above the exact one: below the best exact one, points need no search.
    for i in np.argsort(-cheap, kind="stable"):
        if cheap[i] <= np.max(exact):
            break
        exact[i] = best_scales(values[i])[0]
    best = int(np.argmax(exact))
    found = [(float(exact[best]), float(omega[best]))]

    def negative(x: float) -> float:
        return -best_scales(matrices(np.array([math.exp(x)]))[0])[0]

    refined: list[int] = []
    for i in np.argsort(-exact, kind="stable")[:_CANDIDATES]:
        if exact[i] < _CLOSE * exact[best] or any(abs(i - j) < 3 for j in refined):
            continue
        refined.append(int(i))
        ends = omega[max(i - 1, 0)], omega[min(i + 1, omega.size - 1)]
        near = minimize_scalar(
            negative, bounds=np.log(ends), method="bounded", options={"xatol": _FREQUENCY}
        )
        found.append((-float(near.fun), math.exp(near.x)))
    return max(found)


def singular(values: Complex) -> Vector:
    """Return the largest singular values (k,) of matrices (k, p, m)."""
    return np.linalg.norm(values, 2, axis=(1, 2))
