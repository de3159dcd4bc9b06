"""The search for a model: start, refinement, friction, delay, poles at zero.

The search for the delay of u: in whole samples, then with a part of one.

A model with a wrong delay has other poles, so the error of one model at several delays says little,
and it has a local minimum for each period of a resonance. Therefore a model is estimated at every
delay of the range (at evenly spread ones of a long range, then at all between the best of them)
from the part of the record in which u moves most. The best delays and the shortest one, in which
such an estimate may fail, are searched in full, and small steps lead to the nearest minimum of
each.

Where the best delay is among the longest ones of a range that may grow, the range is doubled, until
it is not, or the record is too short.

A part φ of a sample is estimated last. A held u that is late by it is no held signal, but a plant
that is slow beside a sample sees no difference to ::

    Σ_i h_i u[k − i],  i = −1 … 2,     h_i = Π_{j≠i} (φ − j)/(i − j)

whose response differs from ``exp(−jω φ)`` by less than 0.003 up to ω = 0.6 rad per sample (Lagrange
interpolation; Laakso et al., *IEEE Signal Processing Magazine* 13, 1996). The part is kept where
the likelihood ratio shows it; else the delay is a whole number of samples.

Friction in the search: the signs of the speed, and the least error of the simulated model.

With v, the signs of the speed, known the model is linear in F, and the search is that for any other
input. But v depends on θ: a model with more friction stops earlier. So the search ends with the
output of the simulated model, which takes v from its own speed (``structure``): its error is
minimised by Levenberg and Marquardt's method, with derivatives ψ by differences whose steps change
the output by a share of its error. The covariance is that of ``output_error`` with these ψ: those
for known v say nothing of what the moments of reversal tell, and are wrong where a plant sticks.

The search for a model: start, refinement, signs of friction, delay of u, and poles at s = 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from quell.identification.model import (
    WITHIN_95,
    Structure,
    free_run,
    gain_interval,
    nonzero_lengths,
    output,
    output_gradient,
    squared_distance_from_zero,
)
from quell.identification.output_error import (
    ParameterEstimate,
    covariance,
    covariance_of,
    descend,
    gauss_newton,
    likelihood_ratio,
    noise_model,
    refine,
)
from quell.identification.starts import (
    SURE,
    AtRest,
    Start,
    best_start,
    filtered_estimates,
    from_any_start,
    from_rest,
    general,
    probability,
    refined,
    smaller,
    structure_at_rest,
    with_poles,
)
from quell.types import Matrix, Vector

# ---- The search for the delay of u, in whole samples ----

# Most delays that are estimated, number of samples for it, and number of delays that are searched
# in full besides the shortest. Chosen by hand: the first two limit the time, and a second minimum
# is sometimes better.
_SCANNED, _SAMPLES, _SEARCHED = 25, 4000, 2
# Mean square errors of estimates up to this factor of the least may become the least: by hand.
_NEARLY = 1.5
# Steps of the refinement at the neighbours, where a good start is known, and of a model that goes
# on to the next delay: chosen by hand.
_STEPS, _FEW_STEPS = 12, 3
# Samples between which a part of one is interpolated, and to what share of one it is searched.
_TAPS, _PART = (-1, 0, 1, 2), 1e-4
# Probability of a part of a sample by chance, and step of the derivative by the delay [samples].
_BY_CHANCE, _STEP_OF_DELAY = 1e-3, 0.05
# Part of a sample that is none, beside friction: chosen by hand.
_HARDLY_A_PART = 0.02
# Longest delay, as a share of the samples: the rest has to show the plant.
MOST_SHARE = 0.25


def delayed(u: Vector, delay: float) -> Vector:
    """Return ``u`` later by ``delay`` samples; before the record it has its first value.

    After it, for a part of a sample, it has its last one.
    """
    whole = math.floor(delay)
    part = delay - whole
    if part == 0.0:
        return u if whole == 0 else np.concatenate([np.full(whole, u[0]), u[:-whole]])
    long = np.concatenate([np.full(whole + 2, u[0]), u, u[-1:]])
    found = np.zeros(u.size)
    for i in _TAPS:
        weight = math.prod((part - j) / (i - j) for j in _TAPS if j != i)
        found += weight * long[2 - i : 2 - i + u.size]
    return found


def with_delay(structure: Structure, v: Matrix, u: Vector, delay: float) -> Matrix:
    """Return the inputs ``v`` with ``u`` later by ``delay`` samples as the first."""
    parts = [delayed(u[place], delay) for place in structure.records(u.size)]
    return np.column_stack([np.concatenate(parts), v[:, 1:]])


def start_with_delay(
    structure: Structure,
    u: Vector,
    v: Matrix,
    y: Vector,
    delays: tuple[float, float],
    grows: bool,
    report: Callable[[], None],
) -> tuple[tuple[float, float], float, Start]:
    """Return the range that was searched, the delay of least output error, and the model at it.

    ``delays`` is the range at first; it is extended if it ``grows``. ``report`` is called between
    the parts of the search.
    """
    if delays[0] == delays[1]:
        return delays, delays[0], best_start(structure, with_delay(structure, v, u, delays[0]), y)
    part = _moving_part(structure, u)
    single, of_part = from_any_start(structure, v[part])

    def costs(delays: range) -> dict[int, float]:
        report()
        return _costs(single, u[part], of_part, y[part], delays)

    low, first = (int(end) for end in delays)
    high, stride, found = _scanned(costs, (low, first), longest(structure, y, grows))
    near = []
    for delay in dict.fromkeys([*_minima(found, stride), low]):
        report()
        start = best_start(structure, with_delay(structure, v, u, delay), y)
        found_near = nearest_delay(structure, start.estimate, u, v, y, (low, high), delay, stride)
        near.append((found_near[0], start._replace(estimate=found_near[1])))
    return (low, high), *min(near, key=lambda one: one[1].estimate.cost)


def from_poles(
    structure: Structure,
    poles: Sequence[Vector],
    u: Vector,
    v: Matrix,
    y: Vector,
    delays: tuple[float, float],
    report: Callable[[], None],
) -> tuple[float, ParameterEstimate]:
    """Return the delay of least output error in a range, and the model at it, from given poles.

    ``poles`` are the coefficients a (n,) of polynomials. ``report`` is called at each delay.
    """
    if delays[0] == delays[1]:
        inputs = with_delay(structure, v, u, delays[0])
        tried = [descend(structure, with_poles(structure, a), inputs, y, _STEPS) for a in poles]
        return delays[0], min(tried, key=lambda one: one.cost)
    low, high = (int(end) for end in delays)
    stride = -(-(high - low + 1) // _SCANNED)
    starts = [with_poles(structure, a) for a in poles]
    costs: dict[int, float] = {}
    known: dict[int, ParameterEstimate] = {}
    before: list[Vector] = []
    for delay in range(low, high + 1, stride):
        report()
        inputs = with_delay(structure, v, u, delay)
        tried = [descend(structure, one, inputs, y, _FEW_STEPS) for one in (*starts, *before)]
        known[delay] = min(tried, key=lambda one: one.cost)
        costs[delay], before = known[delay].cost, [known[delay].theta]
    near = [
        nearest_delay(structure, known[delay], u, v, y, (low, high), delay, stride)
        for delay in _minima(costs, stride)
    ]
    return min(near, key=lambda one: one[1].cost)


def longest(structure: Structure, y: Vector, grows: bool) -> int:
    """Return the longest delay to which a range may grow; 0 if it may not."""
    shortest = min(place.stop - place.start for place in structure.records(y.size))
    return int(MOST_SHARE * shortest) if grows else 0


def _scanned(
    costs: Callable[[range], dict[int, float]], delays: tuple[int, int], most: int
) -> tuple[int, int, dict[int, float]]:
    """Return the longest delay, the step, and the errors over a range that may grow up to ``most``.

    It is doubled as long as the least error is in its last fifth.
    """
    low, high = delays
    stride = -(-(high - low + 1) // _SCANNED)
    found = costs(range(low, high + 1, stride))
    while min(found, key=lambda one: found[one]) > high - 0.2 * (high - low) and high < most:
        first, high = max(found) + stride, min(2 * high, most)
        found |= costs(range(first, high + 1, stride))
    return high, stride, found


def _minima(costs: dict[int, float], stride: int) -> list[int]:
    """Return the delays of the best local minima, the least error first."""
    least = min(costs.values())
    minima = [
        delay
        for delay in costs
        if costs[delay] <= min(costs.get(delay - stride, np.inf), costs.get(delay + stride, np.inf))
        and costs[delay] <= _NEARLY * least
    ]
    return sorted(minima, key=lambda one: costs[one])[:_SEARCHED] or [min(costs)]


def _moving_part(structure: Structure, u: Vector) -> slice:
    """Return the part of a record, ``_SAMPLES`` long at most, in which u moves most."""
    best = (-1.0, slice(0, 0))
    for place in structure.records(u.size):
        moved = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(u[place])))])
        for first in range(0, max(moved.size - _SAMPLES // 2, 1), _SAMPLES // 4):
            last = min(first + _SAMPLES, moved.size)
            # The response to what happens in the last half of it would be cut off.
            until = max(first + (last - first) // 2, first + 1)
            amount = float(moved[until - 1] - moved[first]) + 0.1 * float(
                moved[last - 1] - moved[first]
            )
            if amount > best[0] * (1.0 + 1e-9):
                best = amount, slice(place.start + first, place.start + last)
    return best[1]


def _costs(
    structure: Structure, u: Vector, v: Matrix, y: Vector, delays: range
) -> dict[int, float]:
    """Return the mean square error of an estimated model at each of the delays."""
    costs: dict[int, float] = {}
    for delay in delays:
        inputs = with_delay(structure, v, u, delay)
        theta = filtered_estimates(structure, inputs, y)[0]
        costs[delay] = refined(structure, theta, inputs, y)[0]
    return costs


def nearest_delay(
    structure: Structure,
    estimate: ParameterEstimate,
    u: Vector,
    v: Matrix,
    y: Vector,
    delays: tuple[float, float],
    delay: float,
    step: int = 1,
) -> tuple[float, ParameterEstimate]:
    """Return the delay of least output error near ``delay``, and the model at it."""
    known = {delay: estimate}
    while step:
        for other in (delay + step, delay - step):
            if delays[0] <= other <= delays[1] and other not in known:
                inputs = with_delay(structure, v, u, other)
                known[other] = descend(structure, known[delay].theta, inputs, y, _STEPS)
        best = min(known, key=lambda one: known[one].cost)
        delay, step = (best, step) if best != delay else (delay, step // 2)
    return delay, known[delay]


def with_part_of_sample(
    structure: Structure,
    estimate: ParameterEstimate,
    u: Vector,
    v: Matrix,
    y: Vector,
    delay: float,
    searched: tuple[float, float],
) -> tuple[float, ParameterEstimate]:
    """Return the delay with its part of a sample, and the model at it.

    The whole one, with the given model, if the record does not show the part.
    """
    from scipy.optimize import minimize_scalar
    from scipy.stats import chi2

    near = estimate

    def cost(late: float) -> float:
        nonlocal near
        found = descend(structure, near.theta, with_delay(structure, v, u, late), y, _STEPS)
        near = found if found.cost < near.cost else near
        return found.cost

    ends = max(delay - 1.0, searched[0]), min(delay + 1.0, searched[1])
    found = minimize_scalar(cost, bounds=ends, method="bounded", options={"xatol": _PART})
    late = float(found.x)
    inputs = with_delay(structure, v, u, late)
    model = descend(structure, near.theta, inputs, y, _STEPS)
    errors = (
        y - output(structure, estimate.theta, with_delay(structure, v, u, delay)),
        y - output(structure, model.theta, inputs),
    )
    if not all(np.all(np.isfinite(error)) for error in errors):
        return delay, estimate
    ratio = likelihood_ratio(errors, _ROUNDING * float(y @ y))
    return (late, model) if ratio > chi2.isf(_BY_CHANCE, 1) else (delay, estimate)


# ---- Friction in the search ----

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
_FEW_STEPS_FRICTION = 2
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
        estimate = refine(structure, estimate.theta, v, y, _FEW_STEPS_FRICTION)
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
    estimate = refine(structure, estimate.theta, v, y, _FEW_STEPS_FRICTION)
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
    return wider, refine(wider, theta, v, y, _FEW_STEPS_FRICTION), v


def _resonance(a: Vector) -> float:
    """Return |p| of the least damped pair of poles [1/sample]; 0.0 if there is no stable pair."""
    poles = np.roots(np.append(1.0, a[::-1]))
    pairs = poles[(poles.imag > 0.0) & (poles.real <= 0.0)]
    return float(np.abs(pairs[np.argmin(-pairs.real / np.abs(pairs))])) if pairs.size else 0.0


# ---- The search for a model ----

# Steps of the refinement on the way, and most of them at the end: chosen by hand, not tuned.
_FEW_STEPS_SEARCH, _STEPS_SEARCH = 2, 60
# Most rounds of the delay with friction: chosen by hand.
_ROUNDS = 4
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
# A gain whose interval is within ±2 % needs no assumption on the start, one within ±10 % only
# if it is sure: chosen by hand. A start at rest is likely from this probability on.
_CERTAIN, _USEFUL, _LIKELY = 0.02, 0.1, 0.5
# With more movements of u through its range than these the start matters little: chosen by hand.
_MOST_SWINGS = 10.0
# Probability with which a start at rest is refused by chance.
_SELDOM = 1e-3
# Delays on each side of the best that are looked at, steps of the refinement at each, and χ² of one
# degree of freedom at 95 %.
_MOST_DELAYS, _DELAY_STEPS, _WITHIN_95 = 10, 12, 3.84
# Variance of a delay whose nearest whole number of samples is known.
_WHOLE = 1.0 / 12.0


class Fit(NamedTuple):
    """A model fitted to the samples for the fit."""

    structure: Structure
    estimate: ParameterEstimate
    delay: float  # delay of u [samples]
    delays: tuple[float, float]  # its 95 % interval, if it was searched [samples]
    searched: tuple[float, float]  # range of delays in which it was searched [samples]
    delay_covariance: Vector  # of the delay with a and b, and its variance
    bias: bool
    rest: AtRest

    def inputs(self, u: Vector) -> Matrix:
        """Return the inputs (N, inputs) for ``u``; ``free_run`` fills in friction inputs.

        Another number of samples than that of the fit is one record, with the first one's force.
        """
        structure = self.structure
        if structure.samples and sum(structure.samples) != u.size:
            structure = structure.single()
        return _inputs(structure, u, self.delay, self.bias)

    def gain_interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the gain [y-unit/u-unit/sample^q]."""
        free, theta = self.structure.free, self.estimate.theta
        part = self.estimate.covariance[: free + 1, : free + 1]
        return gain_interval(theta[:free], float(theta[free]), part)


def _inputs(structure: Structure, u: Vector, delay: float, bias: bool) -> Matrix:
    """Return the inputs (N, inputs) for ``u``: late, constant forces, and zeros for friction."""
    v = np.zeros((u.size, len(structure.degrees)))
    v[:, 0] = with_delay(structure, v, u, delay)[:, 0]
    if bias:
        for i, place in enumerate(structure.records(u.size)):
            v[place, 1 + i] = 1.0
    return v


class Known(NamedTuple):
    """A model from which a search begins."""

    a: Vector  # coefficients of its denominator (n,), per sample
    searched: tuple[float, float]  # range of delays in which it was searched [samples]


class Wanted(NamedTuple):
    """The structure that is wanted of a model, and where its search begins."""

    order: int
    zeros: int
    integrators: int | None  # None: as many as the record shows
    delays: tuple[float, float]  # [samples]; a range is of whole ones
    grows: bool  # whether the range of delays is extended
    bias: bool
    friction: bool
    rest: bool | None  # None: if the record needs it, and does not contradict
    resolution: float  # step that y is rounded to, 0.0 if it is not rounded
    known: Known | None  # a larger model, from which the search begins
    report: Callable[[], None]  # called between parts of the search; may end it by an exception


def fit(u: Vector, y: Vector, samples: tuple[int, ...], wanted: Wanted) -> Fit:
    """Return the model of least output error; ``samples`` are those of each record, if several."""
    forces = max(len(samples), 1) if wanted.bias else 0
    direct = wanted.zeros == wanted.order
    rubbing = [max(wanted.order - 2, 0)] if wanted.friction else []
    degrees = (wanted.zeros - direct, *[0] * forces, *rubbing)
    signs = (0.0,) if wanted.friction else ()
    q = wanted.integrators or 0
    structure = Structure(wanted.order, q, degrees, signs, direct, samples=samples)
    if wanted.rest and wanted.bias:
        return _fit_at_rest(structure, u, y, wanted)
    found = _fitted(structure, u, y, wanted, wanted.known)
    excluded = wanted.rest is False or not wanted.bias or wanted.friction
    if excluded or _swings(structure, u) > _MOST_SWINGS or _relative_width(found) <= _CERTAIN:
        return found
    # Without need, only what is certain is assumed.
    needed = _relative_width(found) > _USEFUL
    least = _LIKELY if needed else SURE
    # Where the model from any start is far off, its poles may lead nowhere.
    for from_any in (found, None)[: 1 + needed]:
        at_rest = _fit_at_rest(structure, u, y, wanted, from_any)
        if at_rest.rest.probability >= least and not _contradicts(found, at_rest, u, y):
            return at_rest
    return found


def _swings(structure: Structure, u: Vector) -> float:
    """Return how often u moves through its whole range, the most of all records."""
    parts = [u[place] for place in structure.records(u.size)]
    return max(float(np.sum(np.abs(np.diff(part))) / (np.ptp(part) or 1.0)) for part in parts)


def _contradicts(found: Fit, at_rest: Fit, u: Vector, y: Vector) -> bool:
    """Return whether the model at rest fits worse than chance explains, by the likelihood ratio."""
    from scipy.stats import chi2

    at_rest_error, error = (
        y - output(one.structure, one.estimate.theta, one.inputs(u)) for one in (at_rest, found)
    )
    ratio = likelihood_ratio((at_rest_error, error), _ROUNDING * float(y @ y))
    return bool(not ratio <= chi2.isf(_SELDOM, found.structure.order))


def _fit_at_rest(
    structure: Structure, u: Vector, y: Vector, wanted: Wanted, from_any: Fit | None = None
) -> Fit:
    """Return the model of a start at rest, in the general form.

    The search begins at the poles of ``from_any``, a model from any start, if there is one.
    """
    known = wanted.known
    if from_any is not None:
        a = from_any.structure.denominator(from_any.estimate.theta)
        known = Known(a, from_any.searched)
    resting = structure_at_rest(structure)
    found = _fitted(resting, from_rest(structure, u), y, wanted, known)
    v = found.inputs(from_rest(structure, u))
    chance = probability(found.structure, found.estimate, v, y, wanted.resolution)
    free, estimate = general(found.structure, found.estimate, u)
    rest = AtRest(True, bool(wanted.rest), chance)
    return found._replace(structure=free, estimate=estimate, bias=True, rest=rest)


def _relative_width(found: Fit) -> float:
    """Return half the width of the gain's 95 % interval, relative to its middle."""
    low, high = found.gain_interval()
    return abs((high - low) / (high + low)) if np.isfinite(high - low) and high + low else np.inf


def _fitted(structure: Structure, u: Vector, y: Vector, wanted: Wanted, known: Known | None) -> Fit:
    """Return the model of one structure; at rest, ``u`` is without its first value."""
    friction, delays, bias = wanted.friction, wanted.delays, wanted.bias and not structure.at_rest
    v = _inputs(structure, u, delays[0], bias)
    if friction:
        v[:, -1] = measured_sign(structure, y)
    if known is None:
        searched, delay, start = start_with_delay(
            structure, u, v, y, delays, wanted.grows, wanted.report
        )
    else:
        searched, delay, start = _from_known(structure, known, u, v, y, wanted)
    if not np.isfinite(start.estimate.cost):
        none = "no model was found whose output is finite; lower the order, or scale u and y"
        raise ValueError(f"order = {wanted.order}, zeros = {wanted.zeros}: {none}")
    wanted.report()
    whole = with_delay(structure, v, u, delay)
    estimate = descend(structure, start.estimate.theta, whole, y, _STEPS_SEARCH)
    if searched[0] < searched[1] and not structure.direct:
        wanted.report()
        delay, estimate = with_part_of_sample(structure, estimate, u, v, y, delay, searched)
    v = with_delay(structure, v, u, delay)
    estimate = refine(structure, estimate.theta, v, y, _STEPS_SEARCH)
    if wanted.integrators is None:
        structure, estimate = _set_integrators(structure, estimate, v, y)
    if friction and wanted.order > 3:
        structure, estimate, v = add_driven_friction(structure, estimate, v, y)
        if wanted.integrators is None:
            structure, estimate = _set_integrators(structure, estimate, v, y)
    if friction:
        estimate, v = least_simulated(structure, estimate, v, y)
    else:
        estimate = refine(structure, estimate.theta, v, y, _STEPS_SEARCH)
    if friction and searched[0] < searched[1]:
        # With wrong signs of the speed another delay may have been the best.
        for _ in range(_ROUNDS):
            again = simulated_delay(structure, estimate.theta, u, v, y, searched, delay)
            if again == delay:
                break
            inputs = with_delay(structure, v, u, again)
            moved, inputs = least_simulated(structure, estimate, inputs, y)
            if moved.cost >= estimate.cost:
                break
            delay, estimate, v = again, moved, inputs
    estimate = estimate._replace(converged=estimate.converged and start.confirmed)
    estimate, certain, of_delay = _over_delays(structure, estimate, u, v, y, delay, searched)
    rest = AtRest(False, False, np.nan)
    return Fit(structure, estimate, delay, certain, searched, of_delay, bias, rest)


def _from_known(
    structure: Structure, known: Known, u: Vector, v: Matrix, y: Vector, wanted: Wanted
) -> tuple[tuple[float, float], float, Start]:
    """Return the range of delays, the best delay and the model at it, from a known model.

    Its poles, or those without each one of them, are the starts at all delays of its range; at the
    best delay all starts are tried.
    """
    searched = known.searched
    if not wanted.grows:
        searched = wanted.delays
    poles = [known.a] if known.a.size == structure.order else _without_one(known.a)
    delay, estimate = from_poles(structure, poles, u, v, y, searched, wanted.report)
    if wanted.grows and delay == searched[1] < longest(structure, y, True):
        return start_with_delay(structure, u, v, y, searched, True, wanted.report)
    if known.a.size == structure.order:
        return searched, delay, Start(estimate, math.isfinite(estimate.cost))
    start = best_start(structure, with_delay(structure, v, u, delay), y)
    again = nearest_delay(structure, start.estimate, u, v, y, searched, delay)
    delay, estimate = min((delay, estimate), again, key=lambda one: one[1].cost)
    return searched, delay, start._replace(estimate=estimate)


def _without_one(a: Vector) -> list[Vector]:
    """Return the coefficients without each real pole, or with a real one in place of each pair."""
    poles = np.roots(np.append(1.0, a[::-1]))
    found = []
    for i, pole in enumerate(poles):
        if pole.imag > 0.0:
            pair = (poles == pole) | (poles == pole.conjugate())
            rest = np.append(poles[~pair], -abs(pole))
        elif pole.imag == 0.0:
            rest = np.delete(poles, i)
        else:
            continue
        found.append(np.asarray(np.poly(rest).real[:0:-1], dtype=np.float64))
    return found


def _over_delays(
    structure: Structure,
    estimate: ParameterEstimate,
    u: Vector,
    v: Matrix,
    y: Vector,
    delay: float,
    searched: tuple[float, float],
) -> tuple[ParameterEstimate, tuple[float, float], Vector]:
    """Return the estimate with a covariance that has the delays in it, and their 95 % range.

    The last value is the covariance of the delay with a and b, and its variance, with 1/12 for a
    delay that is no whole number; both are zero if the delay was given. With the errors whitened
    by one model of the noise, ``ΔL = N log(Σ e²/Σ e_0²)`` is χ² with one degree of freedom; the
    models have the weights ``exp(−ΔL/2)`` of a mixture.
    """
    from scipy.signal import lfilter

    size = structure.free + structure.degrees[0] + 1
    if searched[0] == searched[1]:
        return estimate, (delay, delay), np.zeros(size + 1)
    if not float(delay).is_integer():
        return _with_part(structure, estimate, u, v, y, delay, size)
    error = y - output(structure, estimate.theta, v)
    c, power = noise_model(error)
    least = max(power, _ROUNDING * float(np.mean(y**2))) * y.size
    low = high = delay
    found = [(1.0, 0.0, estimate)]
    for step in (-1, 1):
        near, other = estimate, delay + step
        for _ in range(_MOST_DELAYS):
            if not searched[0] <= other <= searched[1]:
                break
            inputs = with_delay(structure, v, u, other)
            near = descend(structure, near.theta, inputs, y, _DELAY_STEPS)
            if not np.isfinite(near.cost):
                break
            white = lfilter(c, [1.0], y - output(structure, near.theta, inputs))
            change = y.size * float(np.log(max(white @ white, least) / least))
            if change > _WITHIN_95:
                break
            low, high = min(low, other), max(high, other)
            near = near._replace(covariance=covariance(structure, near.theta, inputs, y))
            found.append((float(np.exp(-0.5 * max(change, 0.0))), other - delay, near))
            other += step
    total = sum(weight for weight, _, _ in found)
    cov, of_delay = np.zeros_like(estimate.covariance), np.zeros(size + 1)
    of_delay[-1] = _WHOLE
    for weight, late, one in found:
        moved = one.theta - estimate.theta
        cov += weight / total * (one.covariance + np.outer(moved, moved))
        of_delay += weight / total * late * np.append(moved[:size], late)
    return estimate._replace(covariance=cov), (low - 0.5, high + 0.5), of_delay


def _with_part(
    structure: Structure,
    estimate: ParameterEstimate,
    u: Vector,
    v: Matrix,
    y: Vector,
    delay: float,
    size: int,
) -> tuple[ParameterEstimate, tuple[float, float], Vector]:
    """Return what ``_over_delays`` does, for a delay with a part of a sample.

    The delay is a parameter like any other; its derivative is a difference.
    """
    low, high = max(delay - _STEP_OF_DELAY, 0.0), delay + _STEP_OF_DELAY
    ends = [
        output(structure, estimate.theta, with_delay(structure, v, u, end)) for end in (low, high)
    ]
    predicted, psi = output_gradient(structure, estimate.theta, v)
    columns = np.column_stack([psi, (ends[1] - ends[0]) / (high - low)])
    length = nonzero_lengths(columns)
    cov = covariance_of(structure, columns / length, y - predicted) / np.outer(length, length)
    half = WITHIN_95 * math.sqrt(max(float(cov[-1, -1]), 0.0))
    of_delay = np.append(cov[-1, :size], cov[-1, -1])
    found = estimate._replace(covariance=cov[:-1, :-1])
    return found, (delay - half, delay + half), of_delay


# Steps of a refinement without fast poles, and how much larger its error may be: by hand.
_WITHOUT_FAST, _HARDLY = 12, 1.01


def without_fast_poles(found: Fit, u: Vector, y: Vector) -> Fit:
    """Return a model without the poles that samples do not show, or the model itself.

    Such a pole and the numerator are uncertain by the same factor, up to rounding, so what is
    certain, as the gain, is to be taken from the model without it. It is the model itself with
    friction or direct feedthrough, and where the error would be larger.
    """
    structure, a = found.structure, found.structure.denominator(found.estimate.theta)
    poles = np.roots(np.append(1.0, a[::-1]))
    slow = poles[np.abs(poles) <= math.pi]
    lower: Structure | None = structure
    for _ in range(poles.size - slow.size):
        lower = None if lower is None else smaller(lower)
    if lower is None or lower is structure or structure.friction or structure.direct:
        return found
    v = found.inputs(u)
    start = with_poles(lower, np.asarray(np.poly(slow).real[:0:-1], dtype=np.float64))
    near = refine(lower, start, v, y, _WITHOUT_FAST)
    if not near.cost <= _HARDLY * found.estimate.cost + _ROUNDING * float(np.mean(y**2)):
        return found
    over = _over_delays(lower, near, u, v, y, found.delay, found.searched)
    return found._replace(structure=lower, estimate=over[0], delays=over[1])


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
            steps = _FEW_STEPS_SEARCH if structure.friction else _STEPS_SEARCH
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
