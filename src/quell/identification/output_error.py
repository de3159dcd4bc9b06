"""Output-error refinement: the parameters whose simulated output comes nearest to the measured one.

With e = y − ŷ(θ) and ψ the gradient of ŷ (``structure``), a step of Levenberg and Marquardt (Ljung 1999, sec. 10.2) solves::

    (Σ ψ ψᵀ + μ diag(Σ ψ ψᵀ)) δθ = Σ ψ e

with μ lowered after a step that helped and raised after one that did not. The estimate is the maximum of likelihood where e is white and
normal; where e is coloured it is still consistent with u open loop (Ljung 1999, th. 8.3), but the textbook covariance is not. So that is
taken from the scores ψ e themselves, summed over blocks that are longer than e remembers (the sandwich of Huber and White; Liang & Zeger,
*Biometrika* 73, 1986)::

    cov θ = H⁻¹ (Σ_blocks s sᵀ) H⁻¹,     H = Σ ψ ψᵀ,  s = Σ_{k in block} ψ_k e_k
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from quell.identification.initial_estimate import cost
from quell.identification.structure import Structure, gradient
from quell.types import Matrix, Vector

_ENOUGH = 1e-7
_GIVE_UP = 1e8
_RANK = 1e-14
_ROUNDING = 1e-24


class Refined(NamedTuple):
    """What the search came to."""

    theta: Vector
    covariance: Matrix
    """(size, size)."""
    cost: float
    """mean square of the output error [y-unit²]."""
    converged: bool


def refined(structure: Structure, theta: Vector, v: Matrix, y: Vector, steps: int) -> Refined:
    """Return the parameters of least output error near ``theta``, for the inputs ``v`` (N, inputs) and the output ``y`` (N,)."""
    best, damping = cost(structure, theta, v, y), 1e-4
    # Without noise the error goes down to its own rounding, and no step is sure to make it less.
    rounding = _ROUNDING * float(np.mean(y**2))
    converged = best <= rounding
    near = _linearised(structure, theta, v, y)
    for _ in range(steps):
        if converged or not near.finite:
            break
        step = np.linalg.solve(near.hessian + damping * np.eye(theta.size), near.right) / near.size
        value = cost(structure, theta + step, v, y)
        if value < best:
            converged = best - value <= _ENOUGH * best
            best, theta, damping = value, theta + step, 0.1 * damping
            near = _linearised(structure, theta, v, y)
        else:
            # What is left of e in the range of its gradient may be no more than rounding.
            converged = bool(
                near.right @ np.linalg.lstsq(near.hessian, near.right, rcond=_RANK)[0]
                <= _ENOUGH * best * y.size
            )
            damping = max(10.0 * damping, 1e-8)
        converged = converged or best <= rounding or damping > _GIVE_UP
    if not near.finite:
        return Refined(theta, np.full(near.hessian.shape, np.inf), best, False)
    half = np.linalg.pinv(near.hessian, rcond=_RANK, hermitian=True) @ near.scores.T
    return Refined(theta, half @ half.T / np.outer(near.size, near.size), best, converged)


def promised(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> tuple[float, Vector]:
    """Return the mean square of the output error that one step of Gauss and Newton promises, and the parameters after it."""
    near = _linearised(structure, theta, v, y)
    if not near.finite:
        return math.inf, theta
    step = np.linalg.lstsq(near.hessian, near.right, rcond=_RANK)[0]
    return max(near.error - float(near.right @ step), 0.0) / y.size, theta + step / near.size


class _Near(NamedTuple):
    """The output error near a θ, with columns of the gradient of length 1."""

    size: Vector
    """the columns' lengths."""
    hessian: Matrix
    right: Vector
    """Σ ψ e."""
    scores: Matrix
    """its sums over blocks."""
    error: float
    """Σ e²."""
    finite: bool
    """False of a model that runs away."""


def _linearised(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> _Near:
    with np.errstate(all="ignore"):
        predicted, psi = gradient(structure, theta, v)
        error = y - predicted
        hessian, power = psi.T @ psi, float(error @ error)
    finite = bool(np.all(np.isfinite(hessian))) and math.isfinite(power)
    if not finite:
        error, psi, hessian = np.zeros_like(error), np.zeros_like(psi), np.zeros_like(hessian)
    size = np.sqrt(np.diag(hessian))
    size = np.where(size > 0.0, size, 1.0)
    blocks = min(max(4 * theta.size, 60), y.size)
    edges = np.linspace(0, y.size, blocks + 1).astype(int)
    scores = np.array([error[i:j] @ psi[i:j] for i, j in pairwise(edges)]) / size
    return _Near(
        size, hessian / np.outer(size, size), np.sum(scores, axis=0), scores, power, finite
    )
