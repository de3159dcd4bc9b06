"""Objectives, as logarithms to minimise, for many parameter vectors.

* ``load``: ``1/k_i``, the integral of y after a unit step of the load at the plant's input (IE;
  Åström & Hägglund, *Advanced PID Control*, ISA 2006, eq. 4.35). It is the same for all plants.
  With more than one integrator k_i is infinite, and the search for starts has the integral of y²
  (ISE) after that step in its place, ``1/π ∫ |P S/ω|² dω`` by Parseval's theorem.
* ``load-iae``: the integral of ``|y|`` after that step, from the exact response.
* ``tracking``: the RMS of ``r − y`` along a given reference.

Of several plants, the last two take the largest value, or a quantile of them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from quell.analysis.frequency_response import Complex
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.optimiser.time_responses import SetResponses
from quell.tuning.structures.base import Structure
from quell.types import Matrix, Vector

OBJECTIVES = ("load", "load-iae", "tracking")
"""Names of the objectives that the optimiser of linear loops knows."""

Cost = Callable[[Structure, Matrix], Vector]

# The logarithm of an objective that no stable loop has.
_WORST = 200.0


def load_cost(structure: Structure, values: Matrix, plants: PlantSet) -> Vector:
    """Return ``−log k_i`` (m,); with more integrators the logarithm of the root of the ISE."""
    if structure.integrators > 1:
        return _log_root_ise(plants, structure.response(values, plants.omega))
    with np.errstate(divide="ignore", invalid="ignore"):
        cost = -np.log(structure.integral_gain(values))
    return np.where(np.isfinite(cost), cost, _WORST)


def _log_root_ise(plants: PlantSet, C: Complex) -> Vector:
    worst, omega = np.zeros(C.shape[0]), plants.omega
    for P in plants.P:
        density = np.abs(P / (1.0 + P * C)) ** 2 / omega  # over log ω
        worst = np.maximum(worst, np.trapezoid(density, np.log(omega), axis=1) / np.pi)
    with np.errstate(divide="ignore", invalid="ignore"):
        cost: Vector = 0.5 * np.log(worst)
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
        return partial(load_cost, plants=over.plants)

    def cost(structure: Structure, values: Matrix) -> Vector:
        found = np.empty(values.shape[0])
        for i, row in enumerate(values):
            each = scores(objective, structure, row, over)
            value = float(np.quantile(each, quantile))
            found[i] = np.log(value) if 0.0 < value < np.inf else _WORST
        return found

    return cost
