"""Starts of the search: shapes of a structure, each with the best of many gains."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quell.analysis.frequency_response import Complex
from quell.tuning.optimiser.extras import MOST_SWING, load_swing
from quell.tuning.optimiser.objectives import load_cost
from quell.tuning.optimiser.problem import Problem, limits
from quell.tuning.optimiser.requirements import worst_ratio
from quell.tuning.structures.base import Structure
from quell.types import Matrix, Vector

# Gains that are tried for each shape, and the cost of exceeding a bound by a factor e, in units of
# the logarithm of the objective.
_GAINS, _EXCESS = 80, 10.0
# Gains around the one that comes with a shape: of a plant with a resonance or several integrators a
# range of a factor of two may be stable.
_OWN = np.array([0.5, 0.7, 1.0, 1.4, 2.0])


def starts(
    problem: Problem, structure: Structure, shapes: Matrix, count: int, spacing: float = 0.0
) -> Matrix:
    """Return at most ``count`` starts (k, p) with the shapes of ``shapes`` (j, p).

    Each shape is tried with gains that put the crossover at frequencies all over the grid. Half of
    the starts are the best that keep to all bounds; the others may exceed them, because the
    optimum is often near a faster shape. With a ``spacing`` in the logarithms of the parameters a
    shape is no start if one so near is better: the starts are in different valleys.
    """
    shapes = np.clip(shapes, *limits(structure))
    C = structure.response(shapes, problem.plants.omega)
    C = C * shapes[:, :1] ** -structure.gain_power
    unstable = structure.unstable_poles(shapes)
    # Of each shape the cost of the best gain that keeps to all bounds, and the merit of the best of
    # all, with the values.
    costs, merits = (np.full(len(shapes), np.inf) for _ in range(2))
    kept, beyond = shapes.copy(), shapes.copy()
    for i, (row, response, poles) in enumerate(zip(shapes, C, unstable, strict=True)):
        values, cost, ratio = _gains_of(problem, structure, row, response, poles)
        good = ratio <= 1.0
        if np.any(good):
            best = int(np.argmin(np.where(good, cost, np.inf)))
            costs[i], kept[i] = cost[best], values[best]
        merit = cost + _EXCESS * np.log(np.maximum(ratio, 1.0))
        if merit.size:
            best = int(np.argmin(merit))
            merits[i], beyond[i] = merit[best], values[best]
    chosen = list(kept[_best(costs, shapes, spacing)[: (count + 1) // 2]])
    for row in beyond[_best(merits, shapes, spacing)]:
        if len(chosen) < count and not any(np.array_equal(row, other) for other in chosen):
            chosen.append(row)
    return np.array(chosen).reshape(-1, shapes.shape[1])


def _best(costs: Vector, shapes: Matrix, spacing: float) -> NDArray[np.intp]:
    """Return the shapes with a cost, the least first, but those with a better one so near."""
    order = np.argsort(costs, kind="stable")
    order = order[np.isfinite(costs[order])]
    if spacing == 0.0:
        return order
    place = np.log(shapes[:, 1:])
    near = np.max(np.abs(place[:, None] - place[None, :]), axis=2) <= spacing
    least = np.min(np.where(near, costs[None, :], np.inf), axis=1)
    return order[costs[order] <= least[order]]


def _gains_of(
    problem: Problem, structure: Structure, row: Vector, response: Complex, poles: float
) -> tuple[Matrix, Vector, Vector]:
    """Return the values with gains for which all loops are stable, their cost and largest ratio.

    ``response`` (G,) is that of the shape with a gain of one, ``poles`` its unstable ones.
    """
    plants = problem.plants
    loop = np.max(np.abs(plants.P * response), axis=0)
    gains = 1.0 / loop[:: max(loop.size // _GAINS, 1)]
    gains = np.append(gains, row[0] ** structure.gain_power * _OWN)
    gains = gains[np.isfinite(gains) & (gains > 0.0)]
    low, high = limits(structure)
    first = gains**structure.gain_power
    gains = gains[(first >= low[0]) & (first <= high[0])]
    tried = gains[:, None] * response
    unstable = plants.unstable_loops(tried, np.full(gains.size, poles), structure.integrators)
    ratio = worst_ratio(problem.bounds, plants, tried)
    good = np.all(unstable < 0.5, axis=1) & np.isfinite(ratio)
    values = np.repeat(row[None, :], int(np.sum(good)), axis=0)
    values[:, 0] = gains[good] ** structure.gain_power
    cost = load_cost(structure, values, plants) if values.size else np.zeros(0)
    ratio = ratio[good]
    if structure.may_swing and values.size:
        swing = load_swing(plants, tried[good], structure.integral_gain(values))
        ratio = np.maximum(ratio, swing / MOST_SWING)
    return values, cost, ratio
