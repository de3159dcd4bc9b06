"""The search for the delay of u, in whole samples.

A model with a wrong delay has other poles, so the error of one model at several delays says little,
and it has a local minimum for each period of a resonance. Therefore a model is estimated at every
delay of the range (or at evenly spread ones of a long range) from a part of the record, and the
best delays are searched in full. From the best of these, small steps lead to the nearest minimum.
"""

from __future__ import annotations

import numpy as np

from quell.identification.model.structure import Structure
from quell.identification.search.best_start import Start, best_start
from quell.identification.search.initial_estimate import filtered_estimates, refined
from quell.identification.search.output_error import descend
from quell.types import Matrix, Vector

# Most delays that are estimated, number of samples for it, and number of delays that are searched
# in full. Chosen by hand: the first two limit the time, and a second minimum is sometimes better.
_SCANNED, _SAMPLES, _SEARCHED = 25, 4000, 2
# Steps of the refinement at the neighbours, where a good start is known: chosen by hand.
_STEPS = 12


def delayed(u: Vector, delay: int) -> Vector:
    """Return ``u`` later by ``delay`` samples; before the record it has its first value."""
    return u if delay == 0 else np.concatenate([np.full(delay, u[0]), u[:-delay]])


def with_delay(v: Matrix, u: Vector, delay: int) -> Matrix:
    """Return the inputs ``v`` with ``u`` later by ``delay`` samples as the first."""
    return np.column_stack([delayed(u, delay), v[:, 1:]])


def start_with_delay(
    structure: Structure, u: Vector, v: Matrix, y: Vector, delays: tuple[int, int]
) -> tuple[int, Start]:
    """Return the delay of least output error in the range ``delays``, and the model at it."""
    if delays[0] == delays[1]:
        return delays[0], best_start(structure, with_delay(v, u, delays[0]), y)
    stride = -(-(delays[1] - delays[0] + 1) // _SCANNED)
    costs: dict[int, float] = {}
    part = slice(0, _SAMPLES)
    for delay in range(delays[0], delays[1] + 1, stride):
        inputs = with_delay(v, u, delay)[part]
        costs[delay] = refined(
            structure, filtered_estimates(structure, inputs, y[part])[0], inputs, y[part]
        )[0]
    minima = [
        delay
        for delay in costs
        if costs[delay] <= min(costs.get(delay - stride, np.inf), costs.get(delay + stride, np.inf))
    ]
    found = {
        delay: best_start(structure, with_delay(v, u, delay), y)
        for delay in sorted(minima, key=lambda one: costs[one])[:_SEARCHED]
    }
    delay = min(found, key=lambda one: found[one].estimate.cost)
    return nearest_delay(structure, found[delay], u, v, y, delays, delay, stride)


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
                inputs = with_delay(v, u, other)
                known[other] = descend(structure, known[delay].theta, inputs, y, _STEPS)
        best = min(known, key=lambda one: known[one].cost)
        delay, step = (best, step) if best != delay else (delay, step // 2)
    return delay, start._replace(estimate=known[delay])
