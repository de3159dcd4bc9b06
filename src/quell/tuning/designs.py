"""Several structures tuned for one problem, each with the starts that others give it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from quell.analysis.loop import LoopAnalysis
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser.extras import extras_of
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.optimiser.objectives import cost_of, load_cost
from quell.tuning.optimiser.problem import Extra, Problem, Solution
from quell.tuning.optimiser.requirements import Bound, bounds_of
from quell.tuning.optimiser.search import best_solution, search
from quell.tuning.optimiser.time_responses import Inputs, SetResponses, law_of
from quell.tuning.result.design import Design, design_of, impossible, measured
from quell.tuning.structures.adrc import AdrcStructure
from quell.tuning.structures.base import Model, Structure
from quell.tuning.structures.equivalent import equivalents
from quell.tuning.structures.pid import FilteredPID
from quell.tuning.structures.registry import make_structure, orders_of
from quell.types import Matrix, Vector

# Rounds of a search that starts at the optimum for slightly other limits.
_NEARBY_ROUNDS = 6
# Shares of the limits with whose optima the search goes on where it found no controller that keeps
# to the limits: where M_ks alone counts, few starts are near those that do.
_OTHER_LIMITS = (0.85, 1.2, 2.0)
# Rounds of a search over time, from the optimum for the integral gain.
_ROUNDS = 15
# Factors by which contradicting limits are relaxed, and steps of the bisection between them.
_RELAXED, _BISECTIONS = (1.05, 1.2, 1.5, 2.0, 4.0, 10.0, 100.0, 1e3, 1e4, 1e5), 6
# Structures whose optima stand for starts of another one. They are always tuned before it, so that
# a result does not depend on what it is compared with.
_GIVES_STARTS: Mapping[str, tuple[str, ...]] = {
    "pid": ("pi",),
    "freed": ("pi", "pid", "bandwidths"),
    "delay-freed": ("pi", "pid", "bandwidths", "delay"),
    "model-based-freed": ("model-based",),
}
# Largest order of an ADRC that has an equivalent PI or PID controller.
_LIKE_PID = 2


@dataclass(frozen=True)
class Task:
    """The problem that all structures are tuned for."""

    plants: PlantSet
    model: Model
    constraints: Constraints
    objective: str
    inputs: Inputs
    quantile: float
    order: int | None
    u: Mapping[str, Any]  # limits of the controllers, and their feedforward if there is one

    def problem(self) -> Problem:
        """Return the problem of the optimiser."""
        over = SetResponses(self.plants, self.inputs)
        cost = cost_of(self.objective, over, self.quantile)
        extras = extras_of(self.constraints, over)
        return Problem(self.plants, bounds_of(self.constraints), extras, self.objective, cost)


def with_noise_bound(task: Task) -> tuple[Task, str]:
    """Return the task with M_ks bounded by a multiple of the optimal PI's, and how it came."""
    given = task.constraints
    if given.noise_over_pi is None or given.m_ks is not None or given.u_std is not None:
        return task, ""
    found = _solutions("pi-unfiltered", task, {})
    usable = [solution for solution in found if solution.feasible]
    if not usable:
        return task, "no bound of M_ks: no PI controller meets the other constraints"
    pi = min(usable, key=lambda solution: solution.cost)
    reference = design_of("pi", task.problem(), pi, given, {}).measures["M_ks"]
    bounded = replace(given, m_ks=given.noise_over_pi * reference)
    model = task.model._replace(constraints=bounded)
    how = f"M_ks: {given.noise_over_pi:g} times that of the optimal PI controller, {reference:.4g}"
    return replace(task, constraints=bounded, model=model), how


def tuned_designs(
    names: Sequence[str], task: Task, progress: Callable[[str, float], None]
) -> dict[str, Design]:
    """Return a design for each name of a structure, in that order."""
    problem = task.problem()
    order = _order(names, task)
    solved: dict[str, list[Solution]] = {}
    designs = {}
    for i, name in enumerate(order):
        progress(name, i / len(order))
        known = {key: solved[key] for key in _GIVES_STARTS.get(name, ()) if key in solved}
        try:
            solved[name] = _solutions(name, task, known)
        except ValueError as error:
            designs[name] = impossible(name, str(error))
            continue
        if name not in names:
            continue
        best = min(solved[name], key=_rank, default=None)
        if best is None:
            which = "the plant" if len(task.plants.plants) == 1 else "all plants"
            reason = f"no controller of this structure was found that stabilises {which}"
            designs[name] = impossible(name, reason)
        elif not best.feasible:
            designs[name] = impossible(name, contradiction(problem, best, task.constraints))
        else:
            made = (problem, best, task.constraints, task.u)
            designs[name] = design_of(best.structure.name, *made)
    return {name: designs[name] for name in names}


def _order(names: Sequence[str], task: Task) -> list[str]:
    """Return the structures to tune: each behind those that it starts at."""
    found: list[str] = []
    for name in names:
        found += [*_order(_GIVES_STARTS.get(name, ()), task), name]
    if task.order is not None and task.order > _LIKE_PID:
        found = [name for name in found if name in names or name not in ("pi", "pid")]
    return list(dict.fromkeys(found))


def _rank(solution: Solution) -> tuple[bool, float, float]:
    return not solution.feasible, 0.0 if solution.feasible else solution.violation, solution.cost


def _solutions(name: str, task: Task, solved: Mapping[str, Sequence[Solution]]) -> list[Solution]:
    """Return the best solution for each order of a structure that has any."""
    problem, found = task.problem(), []
    for order in orders_of(name, task.model, task.order):
        structure = make_structure(name, task.model, order)
        best = _best(problem, structure, _known_starts(structure, solved))
        if best is not None and _is_stable(task.plants, best):
            found.append(best)
    return found


def _best(problem: Problem, structure: Structure, known: Matrix) -> Solution | None:
    """Return the best solution.

    What is about responses over time is slow: it comes in at the optimum for the integral gain.
    """
    slow = [extra for extra in problem.extras if extra.over_time]
    if problem.objective == "load" and not slow:
        return _best_gain(problem, structure, known)
    quick = tuple(extra for extra in problem.extras if not extra.over_time)
    by_gain = replace(problem, objective="load", cost=load_cost, extras=quick)
    first = _best_gain(by_gain, structure, known)
    return None if first is None else search(problem, structure, first.values, _ROUNDS)


def _best_gain(problem: Problem, structure: Structure, known: Matrix) -> Solution | None:
    """Return the best solution for the integral gain; if in need, from optima of other limits."""
    best = best_solution(problem, structure, known)
    for share in _OTHER_LIMITS:
        if best is not None and best.feasible:
            break
        start = best_solution(relaxed(problem, share), structure, known)
        found = None if start is None else search(problem, structure, start.values, _ROUNDS)
        best = min((each for each in (best, found) if each is not None), key=_rank, default=None)
    return best


def _is_stable(plants: PlantSet, solution: Solution) -> bool:
    """Return whether the poles of all closed loops are inside of the unit circle."""
    law = law_of(solution.structure.controller(solution.values))
    return all(LoopAnalysis(plant, law, plants.dt).stable for plant in plants.scaled())


def _known_starts(structure: Structure, solved: Mapping[str, Sequence[Solution]]) -> Matrix:
    """Return values (k, p) that other structures' optima stand for in this one."""
    rows: list[Any] = []
    for solution in (each for group in solved.values() for each in group):
        other, values = solution.structure, solution.values
        if not isinstance(structure, AdrcStructure):
            if isinstance(other, FilteredPID) and isinstance(structure, FilteredPID):
                row = structure.from_other(other, values)
                rows += [] if row is None else [row]
        elif isinstance(other, FilteredPID):
            rows += list(equivalents(other, values, structure))
        elif isinstance(other, AdrcStructure):
            row = structure.from_other(other, values)
            rows += [] if row is None else [row]
    return np.array(rows).reshape(-1, len(structure.parameters))


def contradiction(problem: Problem, solution: Solution, constraints: Constraints) -> str:
    """Return which constraints contradict each other for a structure, and by how much.

    All limits are relaxed by the same factor, the smallest with which there is a controller; those
    that it then reaches are the ones that contradict.
    """
    structure = solution.structure
    low, high, found = 1.0, None, None
    for factor in _RELAXED:
        found = search(relaxed(problem, factor), structure, solution.values, _NEARBY_ROUNDS)
        if found is not None and found.feasible:
            high = factor
            break
        low = factor
    if high is None or found is None:
        return (
            "the constraints contradict each other for this structure: no controller was found "
            f"even with all limits relaxed by a factor of {_RELAXED[-1]:g}"
        )
    for _ in range(_BISECTIONS):
        middle = (low * high) ** 0.5
        nearer = search(relaxed(problem, middle), structure, found.values, _NEARBY_ROUNDS)
        if nearer is not None and nearer.feasible:
            high, found = middle, nearer
        else:
            low = middle
    _, active = measured(relaxed(problem, high), found, constraints)
    given = {bound.kind: bound.limit for bound in problem.bounds}
    given |= {extra.name: extra.limit for extra in problem.extras}
    # Bounds of parameters, as |p| dt, are not relaxed.
    limits = {each.name: given.get(each.name, each.limit) for each in active}
    reached = ", ".join(f"{name} {limit:.4g}" for name, limit in limits.items())
    return (
        f"the constraints contradict each other for this structure: {reached or 'all'}; the least "
        f"excess that was found is {100.0 * (high - 1.0):.3g} % for each"
    )


def relaxed(problem: Problem, factor: float) -> Problem:
    """Return the problem with all limits larger by a factor."""
    bounds = tuple(Bound(kind, factor * limit) for kind, limit in problem.bounds)
    extras = tuple(
        extra._replace(limit=factor * extra.limit, ratio=partial(_share, extra, factor))
        for extra in problem.extras
    )
    return replace(problem, bounds=bounds, extras=extras)


def _share(extra: Extra, factor: float, structure: Structure, values: Matrix) -> Vector:
    return extra.ratio(structure, values) / factor


def tradeoff(task: Task, design: Design) -> list[tuple[str, float, float]]:
    """Return what the objective would be with each active limit 10 % lower and higher."""
    assert design.solution is not None
    found = []
    fields = {"M_s": "m_s", "M_t": "m_t", "M_ks": "m_ks", "delay margin": "delay_margin"}
    for active in design.active:
        field = fields.get(active.name, active.name)
        if getattr(task.constraints, field, None) is None:
            continue
        for factor in (0.9, 1.1):
            limit = factor * active.limit
            if field in ("m_s", "m_t") and limit <= 1.0:
                continue
            near = replace(task, constraints=replace(task.constraints, **{field: limit}))
            solution = design.solution
            result = search(near.problem(), solution.structure, solution.values, _NEARBY_ROUNDS)
            if result is not None and result.feasible:
                size = float(np.exp(result.cost))
                value = 1.0 / size if task.objective == "load" else size
                found.append((active.name, limit, value))
    return found
