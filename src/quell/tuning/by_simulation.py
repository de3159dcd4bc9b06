"""Tuning of a structure by simulation, around the optimum of the linear loop.

``tune`` finds the start, on the plants' linear parts; the search then varies the same parameters,
and keeps to the same constraints of the linear loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from quell import checks
from quell.analysis.linearise import linear_law
from quell.analysis.loop import LoopAnalysis, law_matrix
from quell.analysis.margins import Response
from quell.controllers.base import Controller
from quell.lti.models import System, is_linear_model
from quell.plants.linear import LinearPlant
from quell.plants.linearise import linear_model
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.optimiser.requirements import bounds_of, counted, worst_ratio
from quell.tuning.optimiser.search import Solution
from quell.tuning.plants import as_list
from quell.tuning.report import Design, design_of
from quell.tuning.simulated import Problem, Search, SearchRange, search
from quell.tuning.structures.base import Structure, named, vector
from quell.tuning.structures.registry import SEVERAL_INTEGRATORS
from quell.tuning.tuned import Tuned, Uncertain

# Ranges around the start: a factor either way. Chosen by hand.
_WIDE = 10.0
# Seed of the scenarios of fresh samples, after that of the others: more than any set has samples.
_FRESH = 1_000_000
# Share of a range's ends by which a value may be beyond them through rounding.
_ROUNDING = 1e-12
# Options of ``tune`` for plants that it draws.
_DRAWS = ("samples", "check_samples", "seed")
# Logarithm by which bounds of the linear loops may be exceeded: optima keep to them within 0.1 %.
_SLACK = 1e-3


@dataclass(frozen=True)
class Build:
    """Builds the controllers of a structure, within its rules; ``search`` calls it."""

    structure: Structure
    options: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, values: Mapping[str, float]) -> Controller:
        """Return the controller; raise a ``ValueError`` for values against the rules."""
        row = vector(self.structure, values)
        if np.any(self.structure.rules(row[None, :]) < 0.0):
            raise ValueError(f"values {dict(values)!r}: are against the rules of the structure")
        return self.structure.controller(row, **self.options)


def tune_structure(
    build: Build,
    problem: Problem,
    start: Mapping[str, float],
    *,
    factor: float = _WIDE,
    **options: Any,
) -> Search:
    """Search a structure's parameters around a start.

    Parameters
    ----------
    build
        the structure, and limits of u.
    problem
        what is minimised.
    start
        values of all parameters.
    factor
        the ranges go from a value over ``factor`` to the value times it, within the structure's
        bounds.
    **options
        as for ``search``.
    """
    if checks.finite("factor", factor) <= 1.0:
        raise ValueError(f"factor = {factor!r}: must be above 1")
    space = _around(build.structure, start, factor)
    return search(build, space, problem, starts=[start], **options)


def _around(
    structure: Structure, values: Mapping[str, float], factor: float
) -> dict[str, SearchRange]:
    """Return the ranges around values, within the structure's bounds."""
    found = {}
    for name, _, low, high in structure.parameters:
        value, low, high = (float(x) for x in (values.get(name, math.nan), low, high))
        if not (1.0 - _ROUNDING) * low <= value <= (1.0 + _ROUNDING) * high:
            raise ValueError(f"start: {name} = {value!r}: must lie within {low:g} … {high:g}")
        ends = max(low, value / factor), min(high, value * factor)
        found[name] = SearchRange(min(ends[0], value), max(ends[1], value))
    return found


class LinearBounds:
    """By how much a controller exceeds the bounds of the linear loops, as a logarithm.

    Parameters
    ----------
    plants
        the linear plants, sampled.
    constraints
        the bounds of M_s, M_t, M_ks and damping.
    """

    def __init__(self, plants: PlantSet, constraints: Constraints) -> None:
        self._plants, self._bounds = plants, bounds_of(constraints)
        self._damping = constraints.damping

    def __call__(self, controller: Controller) -> float:
        """Return zero or less if all bounds hold; infinity for an unstable loop."""
        law, plants = linear_law(controller), self._plants
        loops = [LoopAnalysis(plant, law, plants.dt) for plant in plants.scaled()]
        if not all(loop.stable for loop in loops):
            return math.inf
        input_y = law.B_y + law.B_u * law.D_y
        C_y = Response(System(law_matrix(law), input_y, -law.C, -law.D_y))
        ratio = float(worst_ratio(self._bounds, plants, C_y(plants.omega, plants.dt)[None, :])[0])
        if self._damping is not None:
            poles = counted(plants, [loop.s_poles for loop in loops], self._damping)
            ratio = max([ratio, *(pole.ratio for pole in poles)])
        # The start is within 0.1 % of its bounds, and so may be what follows.
        return math.log(ratio) - _SLACK


def tune_by_simulation(
    linear: Callable[..., Tuned],
    plant: Any,
    scenario: Any,
    objective: Any,
    options: Mapping[str, Any],
    how: Mapping[str, Any],
) -> Tuned:
    """Return the result of ``tune`` for the linear parts, tuned further by simulation.

    Parameters
    ----------
    linear
        ``tune``, without a scenario, as a function of the plant and ``how``.
    plant
        as for ``tune``, but with all that is not linear.
    scenario, objective
        as for ``Problem.of_runs``.
    options
        of ``tune_structure`` and ``search``.
    how
        other arguments of ``tune``.
    """
    if scenario is None:
        raise ValueError(
            f"objective = {objective!r}: must be load, load-iae or tracking; any other one is "
            "judged in a simulation, for which scenario must be given"
        )
    uncertain, count, seed = how.get("uncertain"), how.get("samples", 20), how.get("seed", 0)
    box = None if uncertain is None else Uncertain(plant, uncertain)
    parts = _linear_parts(plant, box)
    plants = as_list(plant) if box is None else box.plants(box.design_set(count, seed))
    plants = [LinearPlant.of(p) if is_linear_model(p) else p for p in plants]
    problem = Problem.of_runs(plants, scenario, objective)
    linear_objective = "load-iae" if how["structure"] in SEVERAL_INTEGRATORS else "load"
    # Of known plants only the search draws, which has its seed.
    kept = {name: value for name, value in how.items() if box is not None or name not in _DRAWS}
    found = linear(parts, **kept, objective=linear_objective)
    assert found.design.solution is not None  # ``tune`` returns no other design
    structure = found.design.solution.structure
    assert found.task is not None
    build = Build(structure, found.task.options(structure))
    bounds = LinearBounds(found.plants, found.constraints)
    progress = how.get("progress")
    report = None if progress is None else lambda share: progress("simulations", share)
    given = {"violation": bounds, "seed": seed, "progress": report, **options}
    start = named(build.structure, found.design.solution.values)
    trials = tune_structure(build, problem, start, **given)
    best = trials.best if len(trials.objectives) == 1 else trials.front[0]
    first = trials.objectives[0]
    design = _design(found, best.parameters, best.values[first])
    designs = {name: _judged(each, problem) for name, each in found.designs.items()}
    own = next(name for name, each in found.designs.items() if each is found.design)
    checked = None
    if box is not None:
        fresh = box.plants(box.fresh(how.get("check_samples", 400), seed))
        later = Problem.of_runs(fresh, _later(scenario, len(fresh)), objective)
        checked = later.check(build(best.parameters), best.values)
    law = linear_law(build(best.parameters))
    loop = LoopAnalysis(found.analysis.plant, law, found.plants.dt, found.analysis.b_over_b0)
    return replace(
        found,
        axes=(design,),
        designs=designs | {own: design},
        check=None,
        analysis=loop,
        objective=first,
        search=trials,
        simulated_check=checked,
    )


def _linear_parts(plant: Any, box: Uncertain | None) -> Any:
    """Return the linear parts of plants, or a function that makes them."""
    if box is not None:
        return lambda **values: linear_model(plant(**values))
    plants = as_list(plant)
    parts = [linear_model(each) for each in plants]
    return parts[0] if len(parts) == 1 else parts


def _later(scenario: Any, count: int) -> Any:
    """Return the scenario, or as many of several as there are plants, with seeds of their own."""
    if not checks.is_sequence(scenario):
        return replace(scenario, seed=scenario.seed + _FRESH)
    several = [scenario[i % len(scenario)] for i in range(count)]
    return [replace(each, seed=each.seed + _FRESH + i) for i, each in enumerate(several)]


def _design(found: Tuned, values: Mapping[str, float], objective: float) -> Design:
    solution, task = found.design.solution, found.task
    assert solution is not None
    assert task is not None
    row = vector(solution.structure, values)
    better = Solution(solution.structure, row, 0.0, 0.0)
    options = task.options(solution.structure)
    made = design_of(found.design.name, task.problem(), better, found.constraints, options)
    return replace(made, objective=objective)


def _judged(design: Design, problem: Problem) -> Design:
    """Return a linear optimum with what it reaches in the simulations."""
    if design.controller is None:
        return design
    return replace(design, objective=problem.values(problem.scores(design.controller))[0])
