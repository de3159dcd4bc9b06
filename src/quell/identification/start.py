"""Where the search starts: least squares on filtered signals, then refined instrumental variables.

Dividing ``A y = B u + …`` by any stable polynomial Λ of degree n gives what can be calculated from samples and is linear in θ::

    p^n/Λ y = −Σ a_i p^i/Λ y + Σ b_i p^i/Λ u + … + Σ d_i p^i/Λ δ

an ARX model in continuous time (Young, *Automatica* 17, 1981; Garnier & Wang, *Identification of Continuous-time Models from Sampled
Data*, 2008, ch. 1). With ``Λ = (p + λ)^n`` it is least squares, whose poles noise drags along. *Refined* it takes the last model's
own A for Λ, and its noise-free output ŷ in place of y among the instruments (SRIVC; Young & Jakeman, *Int. J. Control* 31, 1980): then
the instruments are the gradient of ŷ, and where it comes to rest θ is free of bias by noise. Starting it at several λ makes it find the
plant whatever its speed.
"""

from __future__ import annotations

import math

import numpy as np

from quell.identification.sampling import chain
from quell.identification.structure import Structure, gradient, linear_columns, output
from quell.types import Matrix, Vector

_RATES = 7
_ROUNDS = 8


def started(structure: Structure, v: Matrix, y: Vector) -> Vector:
    """Return parameters near those of least output error, for the inputs ``v`` (N, inputs) and the output ``y`` (N,)."""
    n = structure.order
    slowest = min(10.0 / y.size, 1e-2)
    tried = []
    for rate in np.geomspace(slowest, 0.5, _RATES).tolist():
        prefilter = np.array([math.comb(n, i) * rate ** (n - i) for i in range(n)])
        known = linear_columns(structure, prefilter, v)
        target, regressors = _equation(structure, prefilter, known, y)
        theta = stable(structure, _solve(regressors, target))
        tried.append((cost(structure, theta, v, y), theta))
    best, theta = min(tried, key=lambda pair: pair[0])
    for _ in range(_ROUNDS):
        refined = stable(structure, _refined(structure, theta, v, y))
        value = cost(structure, refined, v, y)
        if not value < best * (1.0 - 1e-3):
            break
        best, theta = value, refined
    return theta


def cost(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> float:
    """Return the mean square of the output error, infinite where it is no number."""
    with np.errstate(all="ignore"):
        value = float(np.mean((y - output(structure, theta, v)) ** 2)) if np.all(np.isfinite(theta)) else math.inf
    return value if math.isfinite(value) else math.inf


def stable(structure: Structure, theta: Vector) -> Vector:
    """Return θ with the unstable poles of A mirrored into the left half plane: a model that runs away can't be judged by its output."""
    free = theta[: structure.free]
    if structure.free == 0 or not np.all(np.isfinite(free)):
        return theta
    roots = np.roots(np.append(1.0, free[::-1]))
    if np.all(roots.real <= 0.0):
        return theta
    found = theta.copy()
    found[: structure.free] = np.poly(np.where(roots.real > 0.0, -roots.conj(), roots)).real[:0:-1]
    return found


def _equation(structure: Structure, prefilter: Vector, known: Matrix, y: Vector) -> tuple[Vector, Matrix]:
    """Return left and right side of the equation divided by Λ; y is taken as straight between samples."""
    filtered = chain(prefilter, y, straight=True)
    return y - filtered @ prefilter, np.hstack([-filtered[:, structure.integrators :], known])


def _refined(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> Vector:
    """Return θ after a round of refined instrumental variables."""
    with np.errstate(all="ignore"):
        _, instruments = gradient(structure, theta, v)
        target, regressors = _equation(structure, structure.denominator(theta), instruments[:, structure.free :], y)
        return _solve(regressors, target, instruments)


def _solve(regressors: Matrix, target: Vector, instruments: Matrix | None = None) -> Vector:
    """Solve ``Zᵀ R θ = Zᵀ target`` by the singular values of columns of length 1, so that what is not excited is left at zero."""
    size = np.linalg.norm(regressors, axis=0)
    size = np.where((size > 0.0) & np.isfinite(size), size, 1.0)
    scaled = regressors / size
    if not np.all(np.isfinite(scaled)):
        return np.full(size.size, np.nan)
    if instruments is None:
        triangle = np.linalg.qr(np.column_stack([scaled, target]), mode="r")
        left, right = triangle[:-1, :-1], triangle[:-1, -1]
    else:
        if not np.all(np.isfinite(instruments)):
            return np.full(size.size, np.nan)
        lengths = np.linalg.norm(instruments, axis=0)
        Z = instruments / np.where(lengths > 0.0, lengths, 1.0)
        left, right = Z.T @ scaled, Z.T @ target
    return np.linalg.lstsq(left, right, rcond=1e-13)[0] / size
