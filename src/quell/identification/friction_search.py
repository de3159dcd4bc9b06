"""Friction in the search: the signs of the speed, and the least error of the simulated model.

With v, the signs of the speed, known the model is linear in F, and the search is that for any other
input. But v depends on θ: a model with more friction stops earlier. So the search ends with the
output of the simulated model, which takes v from its own speed (``structure``): its error is
minimised by Levenberg and Marquardt's method, with derivatives ψ by differences whose steps change
the output by a share of its error. The covariance is that of ``output_error`` with these ψ: those
for known v say nothing of what the moments of reversal tell, and are wrong where a plant sticks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from quell.identification.delays import with_delay
from quell.identification.model import (
    Structure,
    free_run,
    nonzero_lengths,
    output_gradient,
)
from quell.identification.output_error import (
    ParameterEstimate,
    covariance_of,
    gauss_newton,
    refine,
)
from quell.types import Matrix, Vector

# Part of a sample that is none: chosen by hand.
_HARDLY_A_PART = 0.02
# Half width of the mean slope that stands for the measured speed until there is a model [samples]:
# chosen by hand, the sign of the model's own speed replaces it.
_HALF_WIDTH = 10
# Most passes until the signs of friction settle, and the share of them that may still change:
# chosen by hand; not tuned further.
_PASSES, _SETTLED = 12, 5e-4
# Mean signs of a sample that differ by less are the same: chosen by hand.
_SAME = 1e-3
# The last steps: relative gain at which they end, and most simulations besides those for the
# derivatives: chosen by hand, not tuned.
_GAIN, _MOST_RUNS = 1e-8, 60
# Steps of the derivatives: share of the error by which the output changes, and the least error
# relative to y, above rounding; error of a model that is not finite, relative to y: chosen by hand.
_STEP, _EXACT, _FAR = 0.03, 1e-6, 1e3
# Steps of the refinement for known signs.
_FEW_STEPS = 2
# Range of ω_a²/ω_r² and most trials for the driven side. The ratio is J₁'s share of both inertias;
# a driven side of less than a tenth of them is rare. The number of trials is chosen by hand.
_SHARES, _TRIALS = (0.1, 1.0), 10


def measured_sign(structure: Structure, y: Vector) -> Vector:
    """Return minus the sign of the speed: the mean slope of y over ten samples each way.

    In order 1 the speed is y itself.
    """
    if structure.order == 1:
        return -np.sign(y)
    found, half_width = [], _HALF_WIDTH
    for place in structure.records(y.size):
        part = y[place]
        index = np.arange(part.size)
        ahead, behind = index + half_width, index - half_width
        after, before = np.minimum(ahead, part.size - 1), np.maximum(behind, 0)
        found.append(-np.sign(part[after] - part[before]))
    return np.concatenate(found)


def least_simulated(
    structure: Structure, estimate: ParameterEstimate, v: Matrix, y: Vector
) -> tuple[ParameterEstimate, Matrix]:
    """Return the parameters of the least simulated error near an estimate, and the inputs."""
    best = (np.inf, estimate, v)
    for _ in range(_PASSES):
        predicted, own = free_run(structure, estimate.theta, v, own_friction=True)
        error = float(np.mean((y - predicted) ** 2))
        best = min(best, (error, estimate, own), key=lambda one: one[0])
        if np.mean(np.any(np.abs(own - v) > _SAME, axis=1)) <= _SETTLED:
            break
        v = own
        estimate = refine(structure, estimate.theta, v, y, _FEW_STEPS)
    # An earlier pass may have been better than the last one.
    _, estimate, v = best
    return _refined(structure, estimate, v, y)


def simulated_delay(
    structure: Structure,
    theta: Vector,
    u: Vector,
    v: Matrix,
    y: Vector,
    searched: tuple[float, float],
    delay: float,
) -> float:
    """Return the delay of the least simulated error near a model [samples].

    The delay is one more parameter; a part of a sample that is hardly one is none.
    """
    size = _sizes(structure, theta, v)
    if size is None:
        return delay
    y_hat = free_run(structure, theta, v, own_friction=True)[0]
    size = np.append(size, float(np.linalg.norm(np.diff(y_hat))) or 1.0)

    def late(x: Vector) -> float:
        return float(np.clip(delay + x[-1] / size[-1], *searched))

    def error(x: Vector) -> Vector:
        inputs = with_delay(structure, v, u, late(x))
        return _error(structure, theta + x[:-1] / size[:-1], inputs, y)

    found = late(_least(error, size.size, y).x)
    return round(found) if abs(found - round(found)) < _HARDLY_A_PART else found


def _refined(
    structure: Structure, estimate: ParameterEstimate, v: Matrix, y: Vector
) -> tuple[ParameterEstimate, Matrix]:
    """Return the parameters of the least simulated error near an estimate, and the inputs."""
    start, size = estimate.theta, _sizes(structure, estimate.theta, v)
    if size is None:
        return estimate, v

    def error(x: Vector) -> Vector:
        return _error(structure, start + x / size, v, y)

    found = _least(error, start.size, y)
    theta, left = start + found.x / size, error(found.x)
    inputs = free_run(structure, theta, v, own_friction=True)[1]
    psi = -_slopes(error, found.x, y, central=True)
    cov = covariance_of(structure, psi, left) / np.outer(size, size)
    return ParameterEstimate(theta, cov, float(np.mean(left**2)), bool(found.success)), inputs


def _sizes(structure: Structure, theta: Vector, v: Matrix) -> Vector | None:
    """Return the effect of each parameter on the output for known signs; None if not finite."""
    with np.errstate(all="ignore"):
        size = nonzero_lengths(output_gradient(structure, theta, v)[1])
    return size if np.all(np.isfinite(size)) else None


def _least(error: Callable[[Vector], Vector], count: int, y: Vector) -> Any:
    """Return scipy's result of Levenberg and Marquardt's method from x = 0 (count,)."""
    from scipy.optimize import least_squares

    def slopes(x: Vector) -> Matrix:
        return _slopes(error, x, y)

    zero = np.zeros(count)
    return least_squares(error, zero, slopes, method="lm", ftol=_GAIN, max_nfev=_MOST_RUNS)


def _slopes(
    error: Callable[[Vector], Vector], x: Vector, y: Vector, central: bool = False
) -> Matrix:
    """Return the derivatives of the error (N, size), by differences."""
    here = error(x)
    h = _STEP * max(float(np.linalg.norm(here)), _EXACT * float(np.linalg.norm(y)))
    found = np.empty((y.size, x.size))
    for i, step in enumerate(h * np.eye(x.size)):
        below = error(x - step) if central else here
        found[:, i] = (error(x + step) - below) / (2.0 * h if central else h)
    return found


def _error(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> Vector:
    """Return the error of the simulated model (N,); where it is not finite, a large one."""
    with np.errstate(all="ignore"):
        predicted = free_run(structure, theta, v, own_friction=True)[0]
        error = y - predicted
        usable = bool(np.all(np.isfinite(error))) and math.isfinite(float(error @ error))
    return error if usable else np.full(y.size, _FAR * float(np.max(np.abs(y)) or 1.0))


def add_driven_friction(
    structure: Structure, estimate: ParameterEstimate, v: Matrix, y: Vector
) -> tuple[Structure, ParameterEstimate, Matrix]:
    """Add friction on the driven side if there is a resonance; return model and inputs."""
    from scipy.optimize import minimize_scalar

    v = free_run(structure, estimate.theta, v, own_friction=True)[1]
    estimate = refine(structure, estimate.theta, v, y, _FEW_STEPS)
    omega = _resonance(structure.denominator(estimate.theta))
    if omega == 0.0:
        return structure, estimate, v
    # A coefficient is added before those of friction on the measured side; it takes over the value
    # of their first one.
    at = structure.places[-1]
    start = np.insert(estimate.theta, at, estimate.theta[at])
    start[at + 1 : at + 2 + structure.degrees[-1]] = 0.0
    wider = structure._replace(degrees=(*structure.degrees[:-1], 0, structure.degrees[-1]))
    v = np.column_stack([v, v[:, -1]])
    tried: list[tuple[float, Structure, Vector]] = []

    def error(share: float) -> float:
        candidate = wider._replace(friction=(1.0 / (share * omega**2), 0.0))
        theta, predicted = min(tried, key=lambda one: one[0])[2] if tried else start, 0.0
        for _ in range(2):
            own = free_run(candidate, theta, v, own_friction=True)[1]
            predicted, theta = gauss_newton(candidate, theta, own, y)
        tried.append((predicted, candidate, theta))
        return predicted

    options = {"xatol": 1e-2, "maxiter": _TRIALS}
    minimize_scalar(error, bounds=_SHARES, method="bounded", options=options)
    _, wider, theta = min(tried, key=lambda one: one[0])
    v = free_run(wider, theta, v, own_friction=True)[1]
    return wider, refine(wider, theta, v, y, _FEW_STEPS), v


def _resonance(a: Vector) -> float:
    """Return |p| of the least damped pair of poles [1/sample]; 0.0 if there is no stable pair."""
    poles = np.roots(np.append(1.0, a[::-1]))
    pairs = poles[(poles.imag > 0.0) & (poles.real <= 0.0)]
    return float(np.abs(pairs[np.argmin(-pairs.real / np.abs(pairs))])) if pairs.size else 0.0
