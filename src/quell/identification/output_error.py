"""Output-error refinement: the parameters whose simulated output is nearest to the measured one.

For given poles the output is linear in all other parameters. So only the coefficients a of A are
searched for, and the others are solved for at each of them (variable projection: Golub & Pereyra,
*SIAM J. Numerical Analysis* 10, 1973). With the columns Φ of the linear parameters, the derivatives
ψ by a, the error e = y − ŷ and the projection ``P = I − Φ Φ⁺``, a step of Levenberg and Marquardt
(Ljung 1999, sec. 10.2) solves (Kaufman, *BIT* 15, 1975)::

    (ψᵀ P ψ + μ diag(ψᵀ ψ)) δa = ψᵀ P e

and lowers μ after a step that reduces the error, or raises it. Both equations are solved by the QR
decomposition of ``[Φ ψ e]``, by blocks of rows (Demmel et al., *SIAM J. Scientific Computing* 34,
2012), without squaring the condition number. The search has converged if the step with μ = 0
predicts a relative gain below a limit: a small gain of a damped step shows nothing.

For white and normal e the result is the maximum-likelihood estimate. For coloured e it is still
consistent if u is open loop (Ljung 1999, th. 8.3), but the usual covariance is wrong. Here e is
taken as an autoregressive process ``e = w/C(q)`` of the order that Schwarz's criterion chooses, and
with ψ for all parameters (Ljung 1999, eq. (9.42))::

    cov θ = H⁻¹ M H⁻¹,     H = Σ ψ ψᵀ,     M = Σ_k Σ_l ψ_k R_e(k − l) ψ_lᵀ = σ_w² Σ φ φᵀ

where φ is ψ filtered by 1/C backwards in time. This holds when all information is in a few samples,
as in the record of one step. Where e is larger at some times than at others, sums of ψ e over
blocks that are longer than its correlation show it (the sandwich of Huber and White; Liang & Zeger,
*Biometrika* 73, 1986)::

    M' = Σ_blocks s sᵀ,     s = Σ_{k in block} ψ_k e_k

These say nothing where one block has all information. So the deviations are those of M, increased
to those of M' for the parameters for which these are larger; correlations are those of M.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from quell.identification.model import (
    Structure,
    correlation,
    linear_columns,
    nonzero_lengths,
    output_gradient,
)
from quell.types import Matrix, Vector

# Convergence: relative gain that the step without damping predicts, chosen by hand: the standard
# deviations of a record of N samples are worth 1/N.
_CONVERGED = 1e-7
# First μ, least μ after a failed step, μ at which the search ends: chosen by hand, not tuned. The
# factor of 10 for each step is Marquardt's.
_MU, _LEAST_MU, _MOST_MU = 1e-3, 1e-8, 1e8
# Relative singular value that counts as zero: some 50 units of rounding.
_RANK = 1e-14
# Relative singular value of the gradient from which on a direction is shown by the record: some
# hundred units of rounding. What is not shown has a large deviation, not none.
_LEAST_SHOWN = 1e-13
# Relative mean square that counts as zero: rounding in long simulations adds up to errors of 1e-12.
_ROUNDING = 1e-24
# Least number of blocks for the covariance: longer ones hold more correlation, fewer make the
# covariance uncertain; chosen by hand.
_BLOCKS = 60
# Most coefficients of the model of the noise, and least number of samples for each: chosen by hand.
_MOST_COLOUR, _PER_COLOUR = 20, 20
# Rows of a block of the QR decomposition: it stays in the processor's cache; by measurement.
_ROWS = 700


Samples: TypeAlias = NDArray[np.bool_] | slice
"""The samples of a record that count: all, or those where y stands at no limit."""
ALL: Samples = slice(None)


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
    found = descend(structure, theta, v, y, steps)
    return found._replace(covariance=covariance(structure, found.theta, v, y))


def descend(
    structure: Structure, theta: Vector, v: Matrix, y: Vector, steps: int, fitted: Samples = ALL
) -> ParameterEstimate:
    """Return what ``refine`` does, without the covariance; only ``fitted`` samples count."""
    free, mu, count = structure.free, _MU, y[fitted].size
    best, theta = projected(structure, theta, v, y, fitted)
    # Without noise the error falls to its own rounding, where a step may not reduce it further.
    rounding = _ROUNDING * float(np.mean(y**2))
    converged = best <= rounding or (free == 0 and math.isfinite(best))
    near = _linearise(structure, theta, v, y, fitted)
    for _ in range(steps if free else 0):
        if near is None or best <= rounding:
            break
        converged = near.gain <= _CONVERGED * max(near.error, best * count)
        if converged or mu > _MOST_MU:
            break
        trial = theta.copy()
        trial[:free] += _damped(near.inner, near.right, mu) / near.size[:free]
        value, trial = projected(structure, trial, v, y, fitted)
        if value < best:
            best, theta, mu = value, trial, 0.1 * mu
            near = _linearise(structure, theta, v, y, fitted)
        else:
            mu = max(10.0 * mu, _LEAST_MU)
    none = np.full((theta.size, theta.size), np.inf)
    return ParameterEstimate(
        theta, none, best, (converged or best <= rounding) and near is not None
    )


def projected(
    structure: Structure, theta: Vector, v: Matrix, y: Vector, fitted: Samples = ALL
) -> tuple[float, Vector]:
    """Return the least mean square error for the poles of ``theta``, and θ with this error."""
    if not np.all(np.isfinite(theta[: structure.free])):
        return math.inf, theta
    with np.errstate(all="ignore"):
        columns, y = linear_columns(structure, structure.denominator(theta), v)[fitted], y[fitted]
        size = nonzero_lengths(columns)
        if not np.all(np.isfinite(size)):
            return math.inf, theta
        R = _triangle(np.column_stack([columns / size, y]))
        linear, error = _least_squares(R[:, :-1], R[:, -1])
    found = np.append(theta[: structure.free], linear / size)
    value = error / y.size
    return (value, found) if math.isfinite(value) else (math.inf, theta)


def covariance(
    structure: Structure, theta: Vector, v: Matrix, y: Vector, fitted: Samples = ALL
) -> Matrix:
    """Return the covariance of θ at an optimum, infinite for a model whose output is not finite.

    Only the samples that are ``fitted`` count.
    """
    found = _error_and_gradient(structure, theta, v, y, fitted)
    if found is None:
        return np.full((theta.size, theta.size), np.inf)
    error, psi, size = found
    return covariance_of(structure, psi, error) / np.outer(size, size)


def covariance_of(structure: Structure, psi: Matrix, error: Vector) -> Matrix:
    """Return the covariance of θ from the gradient (N, size) and the error at an optimum."""
    # With ψ = U S Vᵀ, H⁻¹ = V S⁻² Vᵀ; without squares, as a few samples may have all information.
    _, S, Vt = np.linalg.svd(_triangle(psi))
    half = Vt.T / np.maximum(S, _LEAST_SHOWN * S[0])
    filtered, variance = _coloured(structure, psi, error)
    shown = filtered @ half
    cov = variance * half @ (shown.T @ shown) @ half.T
    scores = block_sums(psi @ half, error, min(max(4 * psi.shape[1], _BLOCKS), error.size))
    by_blocks = np.sum((half @ scores.T) ** 2, axis=1)
    own = np.diag(cov)
    wider = np.sqrt(np.maximum(by_blocks / np.where(own > 0.0, own, 1.0), 1.0))
    return cov * np.outer(wider, wider)


def _coloured(structure: Structure, psi: Matrix, error: Vector) -> tuple[Matrix, float]:
    """Return φ (N, size), and the variance of w, of a model of the noise ``e = w/C(q)``."""
    from scipy.signal import lfilter

    c, variance = noise_model(error)
    variance *= error.size / max(error.size - structure.size, 1)
    if c.size == 1:
        return psi, variance
    parts = [
        lfilter([1.0], c, psi[place][::-1], axis=0)[::-1] for place in structure.records(error.size)
    ]
    return np.concatenate(parts), variance


def noise_model(error: Vector) -> tuple[Vector, float]:
    """Return ``C = (1, c_1, …)`` of ``e = w/C(q)``, and the variance of w.

    The coefficients solve the Yule-Walker equations by Levinson's recursion (Stoica & Moses,
    *Spectral Analysis of Signals*, 2005, sec. 3.5.1), so that 1/C is stable; the order has the
    least ``N log σ_w² + p log N`` (Schwarz, *Annals of Statistics* 6, 1978).
    """
    most = min(_MOST_COLOUR, error.size // _PER_COLOUR)
    power = float(np.mean(error**2))
    if most < 1 or not power > 0.0:
        return np.ones(1), power
    r = correlation(error, error, most)[most:]
    c, variance = np.ones(1), power
    best, chosen = error.size * math.log(power), (c, variance)
    for order in range(1, most + 1):
        reflection = -float(c @ r[order:0:-1]) / variance
        c = np.append(c, 0.0) + reflection * np.append(c, 0.0)[::-1]
        variance *= 1.0 - reflection**2
        if not variance > _RANK * power:
            break
        criterion = error.size * math.log(variance) + order * math.log(error.size)
        if criterion < best:
            best, chosen = criterion, (c, variance)
    return chosen


def likelihood_ratio(errors: tuple[Vector, Vector], least: float) -> float:
    """Return ``N log(Σ w²/Σ w_0²)`` of the errors of a smaller and of a larger model.

    Both are whitened by the model of the noise of the larger one's error, and ``least`` is added to
    both sums. It is χ² if the smaller model is true (Ljung 1999, sec. 16.4).
    """
    from scipy.signal import lfilter

    c, _ = noise_model(errors[1])
    powers = [float(np.sum(lfilter(c, [1.0], error) ** 2)) + least for error in errors]
    return errors[0].size * float(np.log(powers[0] / powers[1]))


def gauss_newton(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> tuple[float, Vector]:
    """Return the mean square error that a Gauss-Newton step predicts, and θ after it."""
    found = _error_and_gradient(structure, theta, v, y)
    if found is None:
        return math.inf, theta
    error, psi, size = found
    R = _triangle(np.column_stack([psi, error]))
    step, left = _least_squares(R[:, :-1], R[:, -1])
    return left / y.size, theta + step / size


def block_sums(columns: Matrix, error: Vector, blocks: int) -> Matrix:
    """Return the sums of ``columns`` times ``error`` over blocks (blocks, columns)."""
    edges = np.linspace(0, error.size, blocks + 1).astype(int)
    return np.array([error[i:j] @ columns[i:j] for i, j in pairwise(edges)])


class _Linearisation(NamedTuple):
    """The output error near a θ, with the columns of the gradient scaled to length 1."""

    size: Vector  # lengths of the columns
    inner: Matrix  # the triangle of P ψ, its columns scaled as ψ
    right: Vector  # P e in the same coordinates
    gain: float  # reduction of Σ e² that the step without damping predicts
    error: float  # Σ e²


def _linearise(
    structure: Structure, theta: Vector, v: Matrix, y: Vector, fitted: Samples
) -> _Linearisation | None:
    """Return the linearisation, None for a model whose output is not finite."""
    free, found = structure.free, _error_and_gradient(structure, theta, v, y, fitted)
    if found is None:
        return None
    error, psi, size = found
    with np.errstate(all="ignore"):
        power = float(error @ error)
    if not math.isfinite(power):
        return None
    # The linear columns first: the rest of the triangle is then free of them.
    R = _triangle(np.column_stack([psi[:, free:], psi[:, :free], error]))
    at = theta.size - free
    inner, right = R[at:-1, at:-1], R[at:-1, -1]
    _, left = _least_squares(inner, right)
    return _Linearisation(size, inner, right, max(float(right @ right) - left, 0.0), power)


def _error_and_gradient(
    structure: Structure, theta: Vector, v: Matrix, y: Vector, fitted: Samples = ALL
) -> tuple[Vector, Matrix, Vector] | None:
    """Return error, gradient with columns of length 1, and the lengths; None if not all finite."""
    with np.errstate(all="ignore"):
        predicted, psi = output_gradient(structure, theta, v)
        psi = psi[fitted]
        size = nonzero_lengths(psi)
        error = (y - predicted)[fitted]
    if not (np.all(np.isfinite(size)) and np.all(np.isfinite(error))):
        return None
    psi /= size
    return error, psi, size


def _damped(inner: Matrix, right: Vector, mu: float) -> Vector:
    """Return the step of Levenberg and Marquardt for columns of length 1."""
    count = right.size
    left = np.vstack([inner, math.sqrt(mu) * np.eye(count)])
    return np.asarray(np.linalg.lstsq(left, np.append(right, np.zeros(count)), rcond=None)[0])


def _least_squares(columns: Matrix, target: Vector) -> tuple[Vector, float]:
    """Return the least-squares solution, and the sum of the squared error that is left."""
    found: Vector = np.linalg.lstsq(columns, target, rcond=math.sqrt(_RANK))[0].astype(np.float64)
    error = target - columns @ found
    return found, float(error @ error)


def _triangle(columns: Matrix) -> Matrix:
    """Return the triangle R of a QR decomposition (columns, columns), by blocks of rows."""
    count = columns.shape[1]
    blocks = columns.shape[0] // max(_ROWS, 4 * count)
    if blocks > 1:
        parts = [np.linalg.qr(part, mode="r") for part in np.array_split(columns, blocks)]
        columns = np.vstack(parts)
    return np.asarray(np.linalg.qr(columns, mode="r"), dtype=np.float64)
