"""Output-error refinement: the parameters whose simulated output comes nearest to the measured one.

With e = y − ŷ(θ) and ψ the gradient of ŷ (``structure``), a step of Levenberg and Marquardt (Ljung 1999, sec. 10.2) solves::

    (Σ ψ ψᵀ + μ diag(Σ ψ ψᵀ)) δθ = Σ ψ e

with μ lowered after a step that helped and raised after one that did not. It is done by QR of the gradient with columns of length 1, not of
its squares. The estimate is the maximum of likelihood where e is white and normal; where e is coloured it is still consistent with u open
loop (Ljung 1999, th. 8.3), but the textbook covariance is not. So that is taken from the scores ψ e themselves, summed over blocks
that are longer than e remembers (the sandwich of Huber and White; Liang & Zeger, *Biometrika* 73, 1986)::

    cov θ = H⁻¹ (Σ_blocks s sᵀ) H⁻¹,     H = Σ ψ ψᵀ,  s = Σ_{k in block} ψ_k e_k
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quell.identification.start import cost
from quell.identification.structure import Structure, gradient
from quell.types import Matrix, Vector

_STEPS = 30
_ENOUGH = 1e-7
_GIVE_UP = 1e8


class Refined(NamedTuple):
    """What the search came to."""

    theta: Vector
    covariance: Matrix
    """(size, size)."""
    cost: float
    """mean square of the output error [y-unit²]."""
    converged: bool


def refined(structure: Structure, theta: Vector, v: Matrix, y: Vector, steps: int = _STEPS) -> Refined:
    """Return the parameters of least output error near ``theta``, for the inputs ``v`` (N, inputs) and the output ``y`` (N,)."""
    best, damping, converged = cost(structure, theta, v, y), 1e-4, False
    size, triangle, right, score = _linearised(structure, theta, v, y)
    for _ in range(steps):
        step = _step(triangle, right, damping) / size
        value = cost(structure, theta + step, v, y)
        if value < best:
            converged = best - value <= _ENOUGH * best
            best, theta, damping = value, theta + step, 0.1 * damping
            size, triangle, right, score = _linearised(structure, theta, v, y)
        else:
            # What a full step would gain is lost in rounding, or no step gains anything.
            converged = float(np.sum(_projection(triangle, right) ** 2)) <= _ENOUGH * best * y.size
            damping *= 10.0
        if converged or damping > _GIVE_UP:
            break
    return Refined(theta, _covariance(triangle, score) / np.outer(size, size), best, converged or damping > _GIVE_UP)


def _linearised(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> tuple[Vector, Matrix, Vector, Matrix]:
    """Return the lengths of the gradient's columns, R and Qᵀe of its QR with columns of length 1, and the scores' sums over blocks."""
    predicted, psi = gradient(structure, theta, v)
    size = np.linalg.norm(psi, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    psi = psi / size
    error = y - predicted
    triangle = np.linalg.qr(np.column_stack([psi, error]), mode="r")
    edges = np.linspace(0, y.size, min(max(4 * theta.size, 60), y.size), endpoint=False).astype(int)
    return size, triangle[:-1, :-1], triangle[:-1, -1], np.add.reduceat(psi * error[:, None], edges, axis=0)


def _step(triangle: Matrix, right: Vector, damping: float) -> Vector:
    n = right.size
    stacked = np.vstack([triangle, math.sqrt(damping) * np.eye(n)])
    return np.linalg.lstsq(stacked, np.append(right, np.zeros(n)), rcond=None)[0]


def _projection(triangle: Matrix, right: Vector) -> Vector:
    """Return the part of e that lies in the gradient's range."""
    u, s, _ = np.linalg.svd(triangle)
    return (u.T @ right)[s > 1e-12 * s[0]]


def _covariance(triangle: Matrix, score: Matrix) -> Matrix:
    inverse = np.linalg.pinv(triangle, rcond=1e-13)
    half = inverse @ inverse.T @ score.T
    return half @ half.T
