"""Instrumental variables from an external signal in a closed loop.

In a closed loop u reacts to everything that disturbs y, and a fit takes this correlation for the
plant. An external signal r, the reference, is not correlated with the disturbances: the part of u
and y that follows r alone is free of them. The equation of ``initial_estimate``, divided by the
model's own A, ``target = R θ + ε``, is projected onto signals Z made of r alone::

    R̂ = Z (ZᵀZ)⁻¹ Zᵀ R,       θ = (R̂ᵀ R)⁻¹ R̂ᵀ target,
    cov θ = (R̂ᵀR)⁻¹ (Σ_blocks s sᵀ) (R̂ᵀR)⁻ᵀ,   s = Σ R̂ ε

and again with the resulting A, until θ no longer changes. This is two-stage least squares, the
simplest of the refined instrumental variables for closed loops (Gilson, Garnier, Young & Van den
Hof, *Closed-loop identification*, in Garnier & Wang 2008, ch. 5; Ljung 1999, sec. 7.6 and 13.5). Z
are r and its Laguerre filters at two rates, and the same of 1/A r: the better they span the loop's
response, the smaller the variance. The estimate has no bias with any Z.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from quell.identification.model.sampling import chain, sampled, states
from quell.identification.model.structure import (
    Structure,
    cost,
    lengths,
    linear_columns,
    nonzero_lengths,
)
from quell.identification.search.initial_estimate import equation, stable
from quell.identification.search.output_error import ParameterEstimate, block_sums
from quell.types import Matrix, Vector

# Most rounds, and the relative change of θ that ends them: chosen by hand; not tuned further.
_ROUNDS, _CONVERGED = 30, 1e-4
# Laguerre filters at each rate, rates relative to the fastest pole: by hand; none causes a bias.
_LAGUERRE, _LAGUERRE_RATES = 8, (1.0, 0.2)
# Least number of blocks for the covariance, as in ``output_error``.
_BLOCKS = 60
# Relative singular value that counts as zero: above rounding, for nearly dependent signals.
_RANK = 1e-12


def instrumental_variables(
    structure: Structure, theta: Vector, v: Matrix, y: Vector, r: Vector
) -> ParameterEstimate:
    """Return the parameters by instrumental variables from ``r`` (N,), starting at ``theta``."""
    converged = False
    for _ in range(_ROUNDS):
        # A filter has to be stable; the plant in its loop need not be.
        a = structure.denominator(stable(structure, theta))
        known = linear_columns(structure, a, v)
        target, regressors = equation(structure, a, known, y)
        # Regressors that depend on neither u nor y are their own instruments.
        of_u = slice(structure.free, structure.free + structure.degrees[0] + 1)
        own = np.delete(regressors, np.r_[: structure.free, of_u], axis=1)
        Z = np.column_stack([_instruments(a, r), own])
        Z = Z / nonzero_lengths(Z)
        size = lengths(regressors)
        scaled = regressors / nonzero_lengths(regressors)
        projected = Z @ np.linalg.lstsq(Z.T @ Z, Z.T @ scaled, rcond=_RANK)[0]
        left = projected.T @ scaled
        after = np.linalg.lstsq(left, projected.T @ target, rcond=_RANK)[0] / size
        if not np.all(np.isfinite(after)):
            break
        change = np.max(np.abs((after - theta) * size)) / np.max(np.abs(theta * size))
        theta = after
        if change < _CONVERGED:
            converged = True
            break
    scores = block_sums(projected, target - regressors @ theta, max(_BLOCKS, 4 * theta.size))
    U, S, Vt = np.linalg.svd(left)
    # What the reference does not show has a large deviation, not none.
    half = Vt.T / np.maximum(S, _RANK * S[0]) @ U.T @ scores.T
    covariance = half @ half.T / np.outer(size, size)
    return ParameterEstimate(theta, covariance, cost(structure, theta, v, y), converged)


def _instruments(a: Vector, r: Vector) -> Matrix:
    """Return signals made of ``r`` alone that span the possible responses of a loop around 1/A."""
    poles = np.abs(np.roots(np.append(1.0, a[::-1])))
    fast = float(np.clip(np.max(poles), 1e-4, 1.0))
    bank = chain(a, r)
    cases = product((factor * fast for factor in _LAGUERRE_RATES), (r, bank[:, -1]))
    laguerre = [_laguerre(rate, signal) for rate, signal in cases]
    return np.column_stack([r, bank, *laguerre])


def _laguerre(rate: float, signal: Vector) -> Matrix:
    """Return ``√(2 λ) (p − λ)^(k−1)/(p + λ)^k`` times the signal, k = 1 … K (N, K)."""
    A = -rate * np.eye(_LAGUERRE) - 2.0 * rate * np.tril(np.ones((_LAGUERRE, _LAGUERRE)), -1)
    B = np.full((_LAGUERRE, 1), np.sqrt(2.0 * rate))
    return states(sampled(A, B, straight=True), signal[:, None])
