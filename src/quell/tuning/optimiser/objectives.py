"""Objectives, as logarithms to minimise, for many parameter vectors.

* ``load``: ``1/k_i``, the integral of y after a unit step of the load at the plant's input (IE;
  Åström & Hägglund, *Advanced PID Control*, ISA 2006, eq. 4.35). It is the same for all plants.
* ``load-iae``: the integral of ``|y|`` after that step, from the exact response.
* ``tracking``: the RMS of ``r − y`` along a given reference.

Of several plants, the last two take the largest value, or a quantile of them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from quell.tuning.optimiser.time_responses import SetResponses
from quell.tuning.structures.base import Structure
from quell.types import Matrix, Vector

OBJECTIVES = ("load", "load-iae", "tracking")
"""Names of the objectives that the optimiser of linear loops knows."""

Cost = Callable[[Structure, Matrix], Vector]

# The logarithm of an objective that no stable loop has.
_WORST = 200.0


def load_cost(structure: Structure, values: Matrix) -> Vector:
    """Return ``−log k_i`` (m,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        cost = -np.log(structure.integral_gain(values))
    return np.where(np.isfinite(cost), cost, _WORST)


def scores(objective: str, structure: Structure, values: Vector, over: SetResponses) -> Vector:
    """Return the objective of each plant (J,)."""
    found = over.of(structure, values)
    if objective == "tracking":
        return np.array([np.sqrt(np.mean((over.inputs.r - y) ** 2)) for y in found])
    return np.array([over.plants.dt * np.sum(np.abs(y)) for y in found])


def cost_of(objective: str, over: SetResponses, quantile: float) -> Cost:
    """Return the function from a structure and values (m, p) to costs (m,)."""
    if objective == "load":
        return load_cost

    def cost(structure: Structure, values: Matrix) -> Vector:
        found = np.empty(values.shape[0])
        for i, row in enumerate(values):
            each = scores(objective, structure, row, over)
            value = float(np.quantile(each, quantile))
            found[i] = np.log(value) if 0.0 < value < np.inf else _WORST
        return found

    return cost
