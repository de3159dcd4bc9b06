"""The search for the delay of u, in whole samples.

A model with a wrong delay has other poles, so the error of one model at several delays says little,
and it has a local minimum for each period of a resonance. Therefore a model is estimated at every
delay of the range (at evenly spread ones of a long range, then at all between the best of them)
from the part of the record in which u moves most. At each delay it is the better of two: an
estimate of its own, and the model of the delay before, refined by a few steps. The best delays and
the shortest one are searched in full, and from the best of these, small steps lead to the nearest
minimum.

Where the best delay is the longest one of a range that may grow, the range is doubled, until the
delay is inside it or the record is too short.
"""

from __future__ import annotations

import numpy as np

from quell.identification.model.structure import Structure
from quell.identification.search.best_start import Start, best_start, from_any_start
from quell.identification.search.initial_estimate import filtered_estimates, refined
from quell.identification.search.output_error import descend
from quell.types import Matrix, Vector

# Most delays that are estimated, number of samples for it, and number of delays that are searched
# in full besides the shortest. Chosen by hand: the first two limit the time, and a second minimum
# is sometimes better.
_SCANNED, _SAMPLES, _SEARCHED = 25, 4000, 2
# Steps of the refinement at the neighbours, where a good start is known, and of a model that goes
# on to the next delay: chosen by hand.
_STEPS, _FEW_STEPS = 12, 3
# Longest delay, as a share of the samples: the rest has to show the plant.
MOST_SHARE = 0.25


def delayed(u: Vector, delay: int) -> Vector:
    """Return ``u`` later by ``delay`` samples; before the record it has its first value."""
    return u if delay == 0 else np.concatenate([np.full(delay, u[0]), u[:-delay]])


def with_delay(structure: Structure, v: Matrix, u: Vector, delay: int) -> Matrix:
    """Return the inputs ``v`` with ``u`` later by ``delay`` samples as the first."""
    parts = [delayed(u[place], delay) for place in structure.records(u.size)]
    return np.column_stack([np.concatenate(parts), v[:, 1:]])


def start_with_delay(
    structure: Structure, u: Vector, v: Matrix, y: Vector, delays: tuple[int, int], grows: bool
) -> tuple[tuple[int, int], int, Start]:
    """Return the range that was searched, the delay of least output error, and the model at it.

    ``delays`` is the range at first; it is extended if it ``grows``.
    """
    if delays[0] == delays[1]:
        return delays, delays[0], best_start(structure, with_delay(structure, v, u, delays[0]), y)
    most = int(MOST_SHARE * min(place.stop - place.start for place in structure.records(y.size)))
    while True:
        delay, start = _in_range(structure, u, v, y, delays)
        if not grows or delay < delays[1] or delays[1] >= most:
            return delays, delay, start
        delays = max(delay - 1, delays[0]), min(2 * delays[1], most)


def _in_range(
    structure: Structure, u: Vector, v: Matrix, y: Vector, delays: tuple[int, int]
) -> tuple[int, Start]:
    """Return the delay of least output error in a range, and the model at it."""
    part = _moving_part(structure, u)
    single, of_part = from_any_start(structure, v[part])
    stride = -(-(delays[1] - delays[0] + 1) // _SCANNED)
    costs = _costs(single, u[part], of_part, y[part], range(delays[0], delays[1] + 1, stride))
    minima = [
        delay
        for delay in costs
        if costs[delay] <= min(costs.get(delay - stride, np.inf), costs.get(delay + stride, np.inf))
    ]
    searched = dict.fromkeys(sorted(minima, key=lambda one: costs[one])[:_SEARCHED])
    searched |= dict.fromkeys(delays[:1])
    near = {
        delay: nearest_delay(
            structure,
            best_start(structure, with_delay(structure, v, u, delay), y),
            u,
            v,
            y,
            delays,
            delay,
            stride,
        )
        for delay in searched
    }
    return min(near.values(), key=lambda one: one[1].estimate.cost)


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
    before: Vector | None = None
    for delay in delays:
        inputs = with_delay(structure, v, u, delay)
        cost, theta = refined(structure, filtered_estimates(structure, inputs, y)[0], inputs, y)
        if before is not None:
            near = descend(structure, before, inputs, y, _FEW_STEPS)
            if near.cost < cost:
                cost, theta = near.cost, near.theta
        costs[delay], before = cost, theta
    return costs


def nearest_delay(
    structure: Structure,
    start: Start,
    u: Vector,
    v: Matrix,
    y: Vector,
    delays: tuple[int, int],
    delay: int,
    step: int = 1,
) -> tuple[int, Start]:
    """Return the delay of least output error near ``delay``, and the model at it."""
    known = {delay: start.estimate}
    while step:
        for other in (delay + step, delay - step):
            if delays[0] <= other <= delays[1] and other not in known:
                inputs = with_delay(structure, v, u, other)
                known[other] = descend(structure, known[delay].theta, inputs, y, _STEPS)
        best = min(known, key=lambda one: known[one].cost)
        delay, step = (best, step) if best != delay else (delay, step // 2)
    return delay, start._replace(estimate=known[delay])
