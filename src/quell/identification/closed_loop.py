"""Instrumental variables from what was sent into a closed loop from outside.

In a closed loop u answers to all that disturbs y, and a fit takes what it finds correlated for the plant. What was sent in from outside,
r, is correlated with nothing else: the part of u and y that answers to r alone is free of disturbances. With the equation of ``start``,
divided by the model's own A, ``target = R θ + ε``, the regressors R are projected onto signals made of r alone, Z::

    R̂ = Z (ZᵀZ)⁻¹ Zᵀ R,       θ = (R̂ᵀ R)⁻¹ R̂ᵀ target,      cov θ = (R̂ᵀR)⁻¹ (Σ_blocks s sᵀ) (R̂ᵀR)⁻ᵀ,   s = Σ R̂ ε

and again with the A that this gives, until it rests: two-stage least squares, the simplest of the refined instrumental variables for closed
loops (Gilson, Garnier, Young & Van den Hof, *Closed-loop identification*, in Garnier & Wang 2008, ch. 5; Ljung 1999, sec. 7.6 and 13.5). Z
are r and its Laguerre filters, at two rates, and the same of 1/A r: the better they span the loop's answer, the smaller the variance; free
of bias it is with any.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from quell.identification.initial_estimate import cost, equation, stable
from quell.identification.output_error import Refined
from quell.identification.sampling import chain, sampled, states
from quell.identification.structure import Structure, linear_columns
from quell.types import Matrix, Vector

_ROUNDS = 30
_ENOUGH = 1e-4
_LAGUERRE = 8
_BLOCKS = 60


def instrumental(structure: Structure, theta: Vector, v: Matrix, y: Vector, r: Vector) -> Refined:
    """Return the parameters by instrumental variables from ``r`` (N,), begun at ``theta``, for the inputs ``v`` and the output ``y``."""
    converged = False
    for _ in range(_ROUNDS):
        # A filter has to be stable; the plant, in its loop, need not be.
        a = structure.denominator(stable(structure, theta))
        known = linear_columns(structure, a, v)
        target, regressors = equation(structure, a, known, y)
        # What answers to neither u nor y is its own instrument.
        ours = slice(structure.free, structure.free + structure.degrees[0] + 1)
        own = np.delete(regressors, np.r_[: structure.free, ours], axis=1)
        Z = _normalised(np.column_stack([_answers(a, r), own]))
        size = np.sqrt(np.einsum("ki,ki->i", regressors, regressors))
        scaled = regressors / np.where(size > 0.0, size, 1.0)
        projected = Z @ np.linalg.lstsq(Z.T @ Z, Z.T @ scaled, rcond=1e-12)[0]
        left = projected.T @ scaled
        after = np.linalg.lstsq(left, projected.T @ target, rcond=1e-12)[0] / size
        if not np.all(np.isfinite(after)):
            break
        moved, theta = (
            float(np.max(np.abs((after - theta) * size)) / np.max(np.abs(theta * size))),
            after,
        )
        if moved < _ENOUGH:
            converged = True
            break
    left_over = target - regressors @ theta
    edges = np.linspace(0, y.size, max(_BLOCKS, 4 * theta.size) + 1).astype(int)
    scores = np.array([left_over[i:j] @ projected[i:j] for i, j in pairwise(edges)])
    half = np.linalg.pinv(left, rcond=1e-12) @ scores.T
    return Refined(
        theta, half @ half.T / np.outer(size, size), cost(structure, theta, v, y), converged
    )


def _answers(a: Vector, r: Vector) -> Matrix:
    """Return signals made of ``r`` alone that span how a loop around 1/A may answer to it."""
    poles = np.abs(np.roots(np.append(1.0, a[::-1])))
    fast = float(np.clip(np.max(poles), 1e-4, 1.0))
    bank = chain(a, r)
    laguerre = [
        _laguerre(rate, signal) for rate in (fast, 0.2 * fast) for signal in (r, bank[:, -1])
    ]
    return np.column_stack([r, bank, *laguerre])


def _laguerre(rate: float, signal: Vector) -> Matrix:
    """Return ``√(2 λ) (p − λ)^(k−1)/(p + λ)^k`` times the signal, k = 1 … K (N, K)."""
    A = -rate * np.eye(_LAGUERRE) - 2.0 * rate * np.tril(np.ones((_LAGUERRE, _LAGUERRE)), -1)
    return states(
        sampled(A, np.full((_LAGUERRE, 1), np.sqrt(2.0 * rate)), straight=True), signal[:, None]
    )


def _normalised(columns: Matrix) -> Matrix:
    size = np.sqrt(np.einsum("ki,ki->i", columns, columns))
    scaled: Matrix = columns / np.where(size > 0.0, size, 1.0)
    return scaled
