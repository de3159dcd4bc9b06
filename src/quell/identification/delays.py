"""The search for the delay of u: in whole samples, then with a part of one.

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
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from quell.identification.model import (
    Structure,
    output,
)
from quell.identification.output_error import (
    ALL,
    ParameterEstimate,
    Samples,
    descend,
    likelihood_ratio,
)
from quell.identification.starts import (
    Start,
    best_start,
    filtered_estimates,
    from_any_start,
    refined,
    with_poles,
)
from quell.types import Matrix, Vector

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
# Probability of a part of a sample by chance.
_BY_CHANCE = 1e-3
ROUNDING = 1e-18
"""Mean square error relative to that of y which counts as none."""

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
    fitted: Samples = ALL,
) -> tuple[float, ParameterEstimate]:
    """Return the delay of least output error near ``delay``, and the model at it."""
    known = {delay: estimate}
    while step:
        for other in (delay + step, delay - step):
            if delays[0] <= other <= delays[1] and other not in known:
                inputs = with_delay(structure, v, u, other)
                known[other] = descend(structure, known[delay].theta, inputs, y, _STEPS, fitted)
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
    ratio = likelihood_ratio(errors, ROUNDING * float(y @ y))
    return (late, model) if ratio > chi2.isf(_BY_CHANCE, 1) else (delay, estimate)
