"""Output-error refinement: the parameters whose simulated output is nearest to the measured one.

With e = y − ŷ(θ) and the gradient ψ of ŷ (``structure``), a step of Levenberg and Marquardt (Ljung
1999, sec. 10.2) solves::

    (Σ ψ ψᵀ + μ diag(Σ ψ ψᵀ)) δθ = Σ ψ e

and lowers μ after a step that reduces the error, or raises it. For white and normal e this is the
maximum-likelihood estimate. For coloured e it is still consistent if u is open loop (Ljung 1999,
th. 8.3), but the usual covariance is wrong. So the covariance is computed from sums of ψ e over
blocks that are longer than the correlation of e (the sandwich of Huber and White; Liang & Zeger,
*Biometrika* 73, 1986)::

    cov θ = H⁻¹ (Σ_blocks s sᵀ) H⁻¹,     H = Σ ψ ψᵀ,  s = Σ_{k in block} ψ_k e_k
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from quell.identification.structure import Structure, cost, gradient
from quell.types import Matrix, Vector

# Convergence: relative gain of a step, chosen by hand; not tuned further.
_CONVERGED = 1e-7
# First μ, least μ after a failed step, μ at which the search ends: chosen by hand, not tuned. The
# factor of 10 for each step is Marquardt's.
_MU, _LEAST_MU, _MOST_MU = 1e-4, 1e-8, 1e8
# Relative singular value of H that counts as zero: some 50 units of rounding.
_RANK = 1e-14
# Relative mean square that counts as zero: rounding in long simulations adds up to errors of 1e-12.
_ROUNDING = 1e-24
# Least number of blocks: longer ones hold more correlation, fewer make the covariance uncertain;
# chosen by hand.
_BLOCKS = 60


class ParameterEstimate(NamedTuple):
    """The result of a search."""

    theta: Vector
    covariance: Matrix  # (size, size)
    cost: float  # mean square of the output error [y-unit²]
    converged: bool


def refine(
    structure: Structure, theta: Vector, v: Matrix, y: Vector, steps: int
) -> ParameterEstimate:
    """Return θ of least output error near ``theta``, for inputs ``v`` and output ``y``."""
    best, mu = cost(structure, theta, v, y), _MU
    # Without noise the error falls to its own rounding, where a step may not reduce it further.
    rounding = _ROUNDING * float(np.mean(y**2))
    converged = best <= rounding
    near = _linearise(structure, theta, v, y)
    for _ in range(steps):
        if converged or not near.finite:
            break
        step = np.linalg.solve(near.hessian + mu * np.eye(theta.size), near.right) / near.size
        value = cost(structure, theta + step, v, y)
        if value < best:
            converged = best - value <= _CONVERGED * best
            best, theta, mu = value, theta + step, 0.1 * mu
            near = _linearise(structure, theta, v, y)
        else:
            # The part of e in the range of its gradient may be no more than rounding.
            gain = near.right @ np.linalg.lstsq(near.hessian, near.right, rcond=_RANK)[0]
            converged = bool(gain <= _CONVERGED * best * y.size)
            mu = max(10.0 * mu, _LEAST_MU)
        converged = converged or best <= rounding or mu > _MOST_MU
    if not near.finite:
        return ParameterEstimate(theta, np.full(near.hessian.shape, np.inf), best, False)
    half = np.linalg.pinv(near.hessian, rcond=_RANK, hermitian=True) @ near.scores.T
    covariance = half @ half.T / np.outer(near.size, near.size)
    return ParameterEstimate(theta, covariance, best, converged)


def gauss_newton(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> tuple[float, Vector]:
    """Return the mean square error that a Gauss-Newton step predicts, and θ after it."""
    near = _linearise(structure, theta, v, y)
    if not near.finite:
        return math.inf, theta
    step = np.linalg.lstsq(near.hessian, near.right, rcond=_RANK)[0]
    return max(near.error - float(near.right @ step), 0.0) / y.size, theta + step / near.size


def block_sums(columns: Matrix, error: Vector, blocks: int) -> Matrix:
    """Return the sums of ``columns`` times ``error`` over blocks (blocks, columns)."""
    edges = np.linspace(0, error.size, blocks + 1).astype(int)
    return np.array([error[i:j] @ columns[i:j] for i, j in pairwise(edges)])


class _Linearisation(NamedTuple):
    """The output error near a θ, with the columns of the gradient scaled to length 1."""

    size: Vector  # lengths of the columns
    hessian: Matrix
    right: Vector  # Σ ψ e
    scores: Matrix  # its sums over blocks
    error: float  # Σ e²
    finite: bool  # false for a model whose output is not finite


def _linearise(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> _Linearisation:
    with np.errstate(all="ignore"):
        predicted, psi = gradient(structure, theta, v)
        error = y - predicted
        hessian, power = psi.T @ psi, float(error @ error)
    finite = bool(np.all(np.isfinite(hessian))) and math.isfinite(power)
    if not finite:
        error, psi, hessian = np.zeros_like(error), np.zeros_like(psi), np.zeros_like(hessian)
    size = np.sqrt(np.diag(hessian))
    size = np.where(size > 0.0, size, 1.0)
    scores = block_sums(psi, error, min(max(4 * theta.size, _BLOCKS), y.size)) / size
    scaled = hessian / np.outer(size, size)
    return _Linearisation(size, scaled, np.sum(scores, axis=0), scores, power, finite)
