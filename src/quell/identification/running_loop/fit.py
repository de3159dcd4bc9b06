"""Prediction-error fits of the plant behind a lag and a delay.

In a running loop u reacts to noise and loads. The *direct method* needs no knowledge of the
controller: the parameters minimise the error of the prediction one sample ahead (Ljung, *System
Identification*, 2nd ed. 1999, eq. (7.12))::

    min Σ e_k²,      e = y − ŷ(φ, β)

It is consistent in any loop, also with limits or a nonlinear controller, if u reaches y a sample
later at the earliest (it is held) and the model of the noise is true (Ljung 1999, th. 8.3 and sec.
13.4). The output error alone, a model without loads, is biased by them. For given φ the best β is
solved for; φ takes steps of Gauss and Newton, damped by Levenberg and Marquardt's method. In a loop
the errors of plant and noise model depend on each other, so the covariance is that of all
parameters together::

    cov = σ² (Σ ψ ψᵀ)⁻¹,     ψ = ∂ŷ/∂(φ, β)

if e is white, as for a true model of the noise. If it is not quite true, the covariance from sums
of ψ e over blocks of the record holds (``output_error``); the one in which b varies more is taken.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quell.identification.model.structure import nonzero_lengths
from quell.identification.running_loop.model import (
    Form,
    derivatives,
    growth,
    is_stable,
    limit_slopes,
    linear_columns,
    stabilised,
)
from quell.identification.search.output_error import block_sums
from quell.types import Matrix, Vector

# First, least and last μ, and the relative gain that a step without damping must predict: as in
# ``output_error``, chosen by hand. Steps are few, because a start is near.
_MU, _LEAST_MU, _MOST_MU, _CONVERGED, _STEPS = 1e-3, 1e-8, 1e8, 1e-7, 60
# Gain in AIC that ends the search, the number of steps in a row that may gain no more, and the gain
# with which it may end by them, or where rounding stops it: a parameter is then off by the root of
# it, 0.1 and 0.3 of its deviation.
_SETTLED, _SMALL_STEPS, _STALLED = 0.01, 3, 0.1
# Longest lag and delay, as a share of the record: chosen by hand.
_LONGEST = 0.25
# Blocks of the record for the covariance, as in ``output_error``.
_BLOCKS = 60
# Relative mean square that counts as zero: rounding of long simulations.
_ROUNDING = 1e-20
# Least error of the prediction that counts, relative to y: that of the derivatives by differences.
# A record without noise would be taken to determine everything otherwise.
_LEAST_ERROR = 1e-7
# Relative singular value that counts as zero, as in ``output_error``.
_RANK = 1e-12


class LoopFit(NamedTuple):
    """A model of the plant and its noise."""

    form: Form
    phi: Vector  # a, l, λ, τ, T in units of a sample
    beta: Vector  # b, initial state
    covariance: Matrix  # of phi and beta
    error: Vector  # e (N,)
    aic: float  # N log Σ e² + 2 (number of parameters)
    converged: bool


class _Point(NamedTuple):
    """A model with the best β for its φ."""

    phi: Vector
    beta: Vector
    error: Vector
    columns: Matrix
    power: float  # Σ e²


def power(form: Form, phi: Vector, u: Vector, y: Vector) -> float:
    """Return Σ e² with the best β for φ."""
    return _solved(form, phi, u, y).power


def fit(form: Form, phi: Vector, u: Vector, y: Vector) -> LoopFit:
    """Return the model of least prediction error near ``phi``."""
    at, converged = _descend(form, _solved(form, phi, u, y), u, y)
    if not math.isfinite(at.power):
        return _without_model(form, at)
    psi, size = _gradient(form, at, u, y)
    if not np.all(np.isfinite(psi)):
        return _without_model(form, at)
    first, count = at.beta.size, at.beta.size + form.size
    variance = at.power / max(at.error.size - count, 1)
    least = _LEAST_ERROR**2 * float(np.mean(y**2))
    variance = max(variance, least)
    known = _known_by_limits(form, at.phi) * math.sqrt(variance)
    psi[:, first:][:, np.isinf(known)] = 0.0
    rows = np.diag(np.concatenate([np.zeros(first), np.where(np.isinf(known), 0.0, known)]) / size)
    R: Matrix = np.asarray(np.linalg.qr(np.vstack([psi, rows]), mode="r"))
    inverse = _inverse(R)
    order = np.r_[first:count, :first]  # φ before β
    rows = inverse[order] / size[order, None]
    covariance = variance * rows @ rows.T
    half = rows @ (inverse.T @ block_sums(psi, at.error, min(_BLOCKS, at.error.size)).T)
    robust = half @ half.T
    if robust[form.size, form.size] > covariance[form.size, form.size]:
        covariance = robust
    aic = y.size * math.log(max(at.power, y.size * least)) + 2.0 * count
    aic += 2.0 * growth(form, at.phi, y.size)
    return LoopFit(form, at.phi, at.beta, covariance, at.error, aic, converged)


def is_exact(found: LoopFit, y: Vector) -> bool:
    """Return whether the error is less than counts."""
    return float(found.error @ found.error) <= _LEAST_ERROR**2 * float(y @ y)


def _inverse(R: Matrix) -> Matrix:
    """Return the inverse of a triangle; what the record does not determine has a large one.

    Only parameters that do not vary, those with zeros for a column, have none.
    """
    varies = np.any(R, axis=0)
    U, sizes, V = np.linalg.svd(R[:, varies], full_matrices=False)
    found = np.zeros((R.shape[1], R.shape[0]))
    found[varies] = (V.T / np.maximum(sizes, _RANK * sizes[0])) @ U.T
    return found


def _known_by_limits(form: Form, phi: Vector) -> Vector:
    """Return the inverse deviations (size,) that parameters at their limit, zero, have by it.

    λ does not vary. τ or T varies by as much as the other one has: what is known is their sum, and
    how it is divided counts in the deviation of b.
    """
    found = np.zeros(form.size)
    at_limit = np.arange(form.size)[form.non_negative]
    at_limit = at_limit[phi[at_limit] <= 0.0]
    total = form.lag_of(phi) + form.delay_of(phi)
    found[at_limit] = np.inf
    if total > 0.0:
        found[at_limit[at_limit >= form.times.start]] = 1.0 / total
    return found


def _without_model(form: Form, at: _Point) -> LoopFit:
    """Return what counts as no fit: no start has a prediction."""
    count = at.beta.size + form.size
    covariance = np.full((count, count), np.nan)
    return LoopFit(form, at.phi, at.beta, covariance, at.error, math.inf, False)


def _solved(form: Form, phi: Vector, u: Vector, y: Vector) -> _Point:
    """Return the model with the best β for φ; its power is infinite if it has none."""
    nothing = _Point(phi, np.zeros(1 + form.states), y, np.empty((0, 0)), math.inf)
    if not is_stable(form, phi, y.size):
        return nothing
    with np.errstate(all="ignore"):
        columns, of_y = linear_columns(form, phi, u, y)
        size, target = nonzero_lengths(columns), y - of_y
        if not (np.all(np.isfinite(size)) and math.isfinite(float(target @ target))):
            return nothing
        scaled = columns / size
        R: Matrix = np.asarray(np.linalg.qr(np.column_stack([scaled, target]), mode="r"))
        beta = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=_RANK)[0]
        error = target - scaled @ beta
    return _Point(phi, beta / size, error, columns, float(error @ error))


def _gradient(form: Form, at: _Point, u: Vector, y: Vector) -> tuple[Matrix, Vector]:
    """Return the columns ψ of β and φ (N, all), scaled to length 1, and their lengths."""
    with np.errstate(all="ignore"):  # the caller sees numbers that are not finite
        psi = np.hstack([at.columns, derivatives(form, at.phi, at.beta, u, y)])
        size = nonzero_lengths(psi)
        psi /= np.where(np.isfinite(size), size, np.nan)
    return psi, size


def _descend(form: Form, at: _Point, u: Vector, y: Vector) -> tuple[_Point, bool]:
    """Return the model of least prediction error near ``at``, and whether the search converged."""
    mu, floor, small = _MU, _ROUNDING * float(y @ y), 0
    for _ in range(_STEPS):
        if not math.isfinite(at.power):
            return at, False
        if at.power <= floor:
            return at, True
        psi, size = _gradient(form, at, u, y)
        if not np.all(np.isfinite(psi)):
            return at, False
        R: Matrix = np.asarray(np.linalg.qr(np.column_stack([psi, at.error]), mode="r"))
        if not np.all(np.isfinite(R)):
            return at, False
        first = at.beta.size
        inner, right = R[first:-1, first:-1], R[first:-1, -1]
        inner, step = _within_limits(form, at.phi, inner, right)
        inner, step = _along_limit(form, at.phi, inner, right, step, size[first:], y)
        gain = float(right @ right - np.sum((right - inner @ step) ** 2))
        least = at.power / at.error.size  # that much changes AIC by one
        if gain <= max(_CONVERGED * at.power, _SETTLED * least):
            return at, True
        moved, mu = _damped_step(form, at, inner, right, size[first:], mu, u, y)
        small = small + 1 if moved is None or at.power - moved.power <= _SETTLED * least else 0
        at = at if moved is None else moved
        if moved is None or small == _SMALL_STEPS:
            return at, gain <= _STALLED * least
    return at, False


def _within_limits(form: Form, phi: Vector, inner: Matrix, right: Vector) -> tuple[Matrix, Vector]:
    """Return the equations and their solution without λ, τ or T that would leave zero downwards."""
    step: Vector = np.linalg.lstsq(inner, right, rcond=_RANK)[0].astype(np.float64)
    stuck = np.zeros(step.size, dtype=bool)
    limited = form.non_negative
    stuck[limited] = (phi[limited] <= 0.0) & (step[limited] <= 0.0)
    if np.any(stuck):
        inner = np.where(stuck, 0.0, inner)
        step = np.linalg.lstsq(inner, right, rcond=_RANK)[0].astype(np.float64)
    return inner, step


def _along_limit(
    form: Form, phi: Vector, inner: Matrix, right: Vector, step: Vector, size: Vector, y: Vector
) -> tuple[Matrix, Vector]:
    """Return the equations and their solution without a predictor's pole that would leave |z| < 1.

    Loads that hardly move have such poles, and steps that lead out of the limit would all be
    refused.
    """
    slopes = limit_slopes(form, phi, y) / size
    slopes[:, ~np.any(inner, axis=0)] = 0.0  # those at their own limit
    slopes = slopes[np.all(np.isfinite(slopes), axis=1)]
    slopes = slopes[slopes @ step > 0.0]
    if slopes.size:
        away = np.linalg.qr(slopes.T)[0]
        inner = inner - (inner @ away) @ away.T
        step = np.linalg.lstsq(inner, right, rcond=_RANK)[0].astype(np.float64)
    return inner, step


def _damped_step(
    form: Form,
    at: _Point,
    inner: Matrix,
    right: Vector,
    size: Vector,
    mu: float,
    u: Vector,
    y: Vector,
) -> tuple[_Point | None, float]:
    """Return a better model by a damped step, None if there is none, and the next μ."""
    count = right.size
    while mu <= _MOST_MU:
        left = np.vstack([inner, math.sqrt(mu) * np.eye(count)])
        step = np.linalg.lstsq(left, np.append(right, np.zeros(count)), rcond=None)[0]
        phi = at.phi + step / size
        limited = form.non_negative
        phi[limited] = np.clip(phi[limited], 0.0, _LONGEST * y.size)
        trial = _solved(form, stabilised(form, phi, y.size), u, y)
        if trial.power < at.power:
            return trial, max(0.1 * mu, _LEAST_MU)
        mu = max(10.0 * mu, 1e-6)
    return None, mu
