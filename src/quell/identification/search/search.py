"""The search for a model: start, refinement, signs of friction, delay of u, and poles at s = 0."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.identification.model.roots import squared_distance_from_zero
from quell.identification.model.structure import Structure, free_run
from quell.identification.search.delay import delayed, nearest_delay, start_with_delay, with_delay
from quell.identification.search.output_error import ParameterEstimate, gauss_newton, refine
from quell.types import Matrix, Vector

# Half width of the mean slope that stands for the measured speed until there is a model [samples]:
# chosen by hand, the sign of the model's own speed replaces it.
_HALF_WIDTH = 10
# Most passes until the signs of friction settle, and the share of them that may still change:
# chosen by hand; not tuned further.
_PASSES, _SETTLED = 12, 5e-4
# Range of ω_a²/ω_r² and most trials for the driven side. The ratio is J₁'s share of both inertias;
# a driven side of less than a tenth of them is rare. The number of trials is chosen by hand.
_SHARES, _TRIALS = (0.1, 1.0), 10
# Steps of the refinement on the way, and most of them at the end: chosen by hand, not tuned.
_FEW_STEPS, _STEPS = 2, 60
# A pole is set to s = 0 within three standard deviations of it (99.7 %), or if its time constant is
# more than ten times the record (chosen by hand). For two poles, χ² with two degrees of freedom
# exceeds 11.8 as rarely.
_DEVIATIONS = 3.0
_PAIR = 11.8
_SLOWER = 10.0
# These tests are of first order, which fails for poles that are nearly equal. So one and two
# integrators may increase the mean square error by these factors at most, and take this share of
# the fit; or increase it to this share of the output's mean square. With friction the signs that
# are not settled decide the fit, and only the factors hold. Chosen by hand.
_MOST_COST, _FIT_SHARE = {1: 30.0, 2: 1.05}, 0.005
_ROUNDING = 1e-18


class Fit(NamedTuple):
    """A model fitted to the samples for the fit."""

    structure: Structure
    estimate: ParameterEstimate
    delay: int  # delay of u [samples]
    bias: bool

    def inputs(self, u: Vector) -> Matrix:
        """Return the inputs (N, inputs) for ``u``; ``free_run`` fills in friction inputs."""
        zero = np.zeros(u.size)
        return _columns(u, self.delay, self.bias, [zero] * len(self.structure.friction))


def _columns(u: Vector, delay: int, bias: bool, friction: list[Vector]) -> Matrix:
    return np.column_stack([delayed(u, delay), *([np.ones(u.size)] if bias else []), *friction])


def fit(
    u: Vector,
    y: Vector,
    order: int,
    zeros: int,
    integrators: int | None,
    delays: tuple[int, int],
    bias: bool,
    friction: bool,
) -> Fit:
    """Return the model of least output error; ``delays`` is their range to search [samples]."""
    direct = zeros == order
    degrees = (zeros - direct, *([0] if bias else []), *([max(order - 2, 0)] if friction else []))
    structure = Structure(order, integrators or 0, degrees, (0.0,) if friction else (), direct)
    v = _columns(u, delays[0], bias, [measured_sign(y, _HALF_WIDTH)] if friction else [])
    delay, start = start_with_delay(structure, u, v, y, delays)
    if not np.isfinite(start.estimate.cost):
        none = "no model was found whose output is finite; lower the order, or scale u and y"
        raise ValueError(f"order = {order}, zeros = {zeros}: {none}")
    v = with_delay(v, u, delay)
    estimate = refine(structure, start.estimate.theta, v, y, _STEPS)
    if integrators is None:
        structure, estimate = _set_integrators(structure, estimate, v, y)
    if friction and order > 3:
        structure, estimate, v = _add_driven_friction(structure, estimate, v, y)
        if integrators is None:
            structure, estimate = _set_integrators(structure, estimate, v, y)
    estimate, v = _settle_signs(structure, estimate, v, y)
    if friction and delays[0] < delays[1]:
        # With wrong signs of the speed another delay may have been the best.
        again, start = nearest_delay(
            structure, start._replace(estimate=estimate), u, v, y, delays, delay
        )
        if again != delay:
            delay, v = again, with_delay(v, u, again)
            estimate, v = _settle_signs(structure, start.estimate, v, y)
    converged = estimate.converged and start.confirmed
    estimate = estimate._replace(converged=converged)
    return Fit(structure, estimate, delay, bias)


def measured_sign(y: Vector, half_width: int) -> Vector:
    """Return minus the sign of the mean slope of ``y``, over ``half_width`` samples each way."""
    index = np.arange(y.size)
    ahead, behind = np.minimum(index + half_width, y.size - 1), np.maximum(index - half_width, 0)
    return -np.sign(y[ahead] - y[behind])


def _settle_signs(
    structure: Structure, estimate: ParameterEstimate, v: Matrix, y: Vector
) -> tuple[ParameterEstimate, Matrix]:
    """Return refined parameters, and inputs with friction from the model's own speeds."""
    best = (np.inf, estimate, v)
    for _ in range(_PASSES if structure.friction else 0):
        predicted, own = free_run(structure, estimate.theta, v, own_friction=True)
        error = float(np.mean((y - predicted) ** 2))
        best = min(best, (error, estimate, own), key=lambda one: one[0])
        if np.mean(np.any(own != v, axis=1)) <= _SETTLED:
            break
        v = own
        estimate = refine(structure, estimate.theta, v, y, _FEW_STEPS)
    # An earlier pass may have been better than the last one.
    _, estimate, v = best
    return refine(structure, estimate.theta, v, y, _STEPS), v


def _add_driven_friction(
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
    at = structure.free + sum(structure.degrees[:-1]) + len(structure.degrees) - 1
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


def _set_integrators(
    structure: Structure, estimate: ParameterEstimate, v: Matrix, y: Vector
) -> tuple[Structure, ParameterEstimate]:
    """Set one or two poles to s = 0 if they can't be distinguished from it; return the model."""
    if structure.integrators:
        return structure, estimate
    a, free, covariance = structure.denominator(estimate.theta), structure.free, estimate.covariance
    # An integrator and a zero that can't be distinguished from s = 0 would cancel.
    zero_std = np.sqrt(covariance[free, free])
    if structure.degrees[0] and abs(estimate.theta[free]) < _DEVIATIONS * zero_std:
        return structure, estimate
    poles = np.roots(np.append(1.0, a[::-1]))
    slow = poles[np.argsort(np.abs(poles))][:2].astype(complex)
    for count, limit in ((2, _PAIR), (1, _DEVIATIONS**2)):
        if count > slow.size or (count == 1 and abs(slow[0].imag) > 0.0):
            continue
        slower_than_record = abs(slow[count - 1]) * _SLOWER * y.size < 1.0
        part = covariance[: a.size, : a.size]
        if slower_than_record or squared_distance_from_zero(a, part, slow[:count]) < limit:
            fewer = structure._replace(integrators=count)
            steps = _FEW_STEPS if structure.friction else _STEPS
            without = refine(fewer, estimate.theta[count:], v, y, steps)
            if without.cost <= _most_cost(structure, count, estimate.cost, y):
                return fewer, without
    return structure, estimate


def _most_cost(structure: Structure, count: int, cost: float, y: Vector) -> float:
    """Return the mean square error that a model with ``count`` integrators may have."""
    most = _MOST_COST[count] * cost
    if not structure.friction:
        error, spread = float(np.sqrt(cost)), float(np.std(y))
        most = min(most, (error + _FIT_SHARE * max(spread - error, 0.0)) ** 2)
    return max(most, _ROUNDING * float(np.mean(y**2)))
