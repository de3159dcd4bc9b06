"""Recursive least squares with directional forgetting, O(p²) a sample.

With ``ζ = φ·Pφ/R`` and ``λ = exp(−dt/T)`` for the memory time T,

    θ ← θ + Pφ ε / (R (1 + ζ)),      P ← P − c Pφ (Pφ)ᵀ,      c = (λ − (1−λ)/ζ) / (R λ (1 + ζ))

Only what is known along φ is forgotten: after a sample the uncertainty along φ is ``ζ/(λ(1 + ζ))``,
and orthogonal to φ it is unchanged. With exponential forgetting of everything, P grows without
bound along directions that are not excited, and a closed loop in normal operation excites few. A
small φ still increases P slowly, so P stops growing when its trace reaches that of the prior.
"""

from __future__ import annotations

from typing import NamedTuple

from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single
from quell.kernels.sums import add_symmetrically
from quell.types import Matrix, Vector

# A larger φ·Pφ could overflow in what follows; in single precision earlier.
_LARGEST_SPREAD, _LARGEST_SPREAD_SINGLE = 1e100, 1e15


class RlsRule(NamedTuple):
    """Parameters."""

    noise: float  # R
    forget: float  # 1 − λ
    prior: float  # variance of θ before anything is known


@kernel
def excess_share(covariance: Matrix, i: int, j: int) -> float:
    """Return how much θ_j must change with θ_i, which a limit moves by one: ``P_ij / P_ii``.

    The nearest θ in the metric of P⁻¹, for which the data are as likely as they can be: Simon &
    Chia, "Kalman filtering with state equality constraints", *IEEE Trans. Aerospace and Electronic
    Systems* 38, 2002, eq. (13). If θ_i alone were cut off, the error that this leaves would move
    the others in every sample.
    """
    return float(covariance[max(i, j), min(i, j)] / covariance[i, i])


@kernel
def reduce_row(covariance: Matrix, i: int, share: float, gain: Vector) -> None:
    """Subtract ``share · gain`` from row ``i`` of P; after all rows P is less by ``g (Pφ)ᵀ``.

    Rounding makes P asymmetric, and the asymmetric part does not shrink with the data. In single
    precision it would exceed what the data leave of P, so there only the lower triangle exists.
    """
    if is_single(share):
        for j in range(i + 1):
            add_symmetrically(covariance, i, j, -share * gain[j])
    else:
        for j in range(covariance.shape[0]):
            covariance[i, j] -= share * gain[j]


@kernel
def multiply_lower(covariance: Matrix, features: Vector, gain: Vector) -> None:
    """Write Pφ into ``gain`` for a P of which only the lower triangle exists."""
    for i in range(gain.size):
        total = 0.0
        for j in range(i):
            total += covariance[i, j] * features[j]
            gain[j] += covariance[i, j] * features[i]
        gain[i] = total + covariance[i, i] * features[i]


@kernel
def least_squares_gain(
    rule: RlsRule, covariance: Matrix, gain: Vector, features: Vector, noise: float
) -> float:
    """Update P for a sample with the variance R = ``noise``.

    Write Pφ into ``gain`` and return its factor ``1/(R (1 + ζ))`` in the update of θ.
    """
    size = gain.size
    spread = trace = length = 0.0
    for i in range(size):
        total = 0.0
        for j in range(size):
            total += covariance[i, j] * features[j]
        gain[i] = total
        spread += total * features[i]
        length += total * total
        trace += covariance[i, i]
    largest = _LARGEST_SPREAD_SINGLE if is_single(rule.prior) else _LARGEST_SPREAD
    if not 0.0 < spread < largest:  # φ is zero, or P is no covariance any more: learn nothing
        for i in range(size):
            gain[i] = 0.0  # zero times what is not finite would be NaN
        return 0.0
    inverse = 1.0 / (noise + spread)
    share = (1.0 - rule.forget - rule.forget * noise / spread) * inverse / (1.0 - rule.forget)
    if share < 0.0 and trace - share * length > rule.prior * size:
        share = 0.0
    for i in range(size):
        part = share * gain[i]
        for j in range(i + 1):
            value = covariance[i, j] - part * gain[j]
            covariance[i, j] = covariance[j, i] = value
    return inverse
