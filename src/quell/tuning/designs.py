"""Several structures tuned for one problem, each with the starts that others give it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from quell import checks
from quell.analysis.loop import LoopAnalysis
from quell.controllers.feedforward import Feedforward
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser import requirements
from quell.tuning.optimiser.loops import Inputs, PlantSet, SetResponses, law_of
from quell.tuning.optimiser.requirements import scores
from quell.tuning.optimiser.search import (
    FEW,
    Extra,
    Problem,
    Solution,
    best_solution,
    extras_of,
    merit,
    search,
    solution_at,
    starts,
)
from quell.tuning.report import Design, design_of, impossible, measured, relative
from quell.tuning.structures.adrc import AdrcStructure, equivalents
from quell.tuning.structures.base import Model, Structure
from quell.tuning.structures.baselines import FilteredPID
from quell.tuning.structures.registry import make_structure, orders_of
from quell.types import Matrix, Vector

# Rounds of a search that starts at the optimum for slightly other limits.
_NEARBY_ROUNDS = 6
# Shares of the limits with whose optima the search goes on where it found no controller that keeps
# to the limits: where M_ks alone counts, few starts are near those that do.
_OTHER_LIMITS = (0.85, 1.2, 2.0)
# Rounds of a search over time, from the optimum for the integral gain.
_ROUNDS = 15
# Shares of what an optimum has, as bounds with which the search starts again, the least excess of a
# peak over one that is shared, and the share of a limit from which on it is reached.
_TIGHTER, _LEAST_PEAK, _REACHED = (0.4, 0.15), 0.1, 0.995
# Plants of a set that its worst case over time is first taken from, how much worse another one must
# be to come in, and how often: chosen by hand.
_MEMBERS, _WORSE, _EXCHANGES = 2, 1.005, 4
# Factors by which contradicting limits are relaxed, and steps of the bisection between them.
_RELAXED, _BISECTIONS = (1.05, 1.2, 1.5, 2.0, 4.0, 10.0, 100.0, 1e3, 1e4, 1e5), 6
# With limits of responses over time, which are slow, to some 2 %.
_FEW_BISECTIONS = 3
# Starts of a search over time with several integrators: the ISE, which leads to them, has other
# valleys than the IAE. Chosen by hand.
_VALLEYS = 4
# Structures whose optima stand for starts of another one. They are always tuned before it, so that
# a result does not depend on what it is compared with.
_GIVES_STARTS: Mapping[str, tuple[str, ...]] = {
    "pid": ("pi",),
    "poles": ("pi", "pid", "bandwidths"),
    "delay-poles": ("pi", "pid", "bandwidths", "delay"),
    "model-based-poles": ("model-based",),
    "poles-2": ("bandwidths-2",),
    "poles-3": ("bandwidths-3",),
}
# A PI controller is of use as a reference for noise unless a PID controller with filter has so many
# times its integral gain; chosen by hand. Plants below this relative degree are not in doubt.
_OF_USE, _INERTIA = 10.0, 2
SIMPLEST = "simplest"
"""Name for the simplest structure whose objective is near the best one's."""
# A simpler structure may have an objective that is worse by this factor.
_NEAR_BEST = 1.05
# The structures, simple ones first: by what a user has to know, and by the number of parameters.
_FROM_SIMPLE = (
    *("pi-unfiltered", "pi", "pid", "bandwidths", "reduced", "half-gain", "half-gain-law"),
    *("p-pi-notch", "bandwidths-2", "bandwidths-3", "poles", "poles-2", "poles-3"),
    *("resonator", "resonator-2", "resonator-3", "delay", "delay-poles"),
    *("model-based", "model-based-2", "model-based-poles", "lqg", "adaptive-notch"),
)
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
    limits: Mapping[str, Any]  # of u, for all controllers
    feedforward: Feedforward | None = None

    def problem(self, members: Sequence[int] | None = None) -> Problem:
        """Return the problem of the optimiser; the objective is that of ``members`` of the set."""
        over = SetResponses(self.plants, self.inputs)
        for_cost = over if members is None else SetResponses(self.plants, self.inputs, members)
        spectrum = self.model.load if self.objective == requirements.OF_SPECTRUM else None
        cost = requirements.cost_of(self.objective, for_cost, self.quantile, spectrum)
        extras = extras_of(self.constraints, over)
        bounds, damping = requirements.bounds_of(self.constraints), self.constraints.damping
        return Problem(self.plants, bounds, extras, self.objective, cost, damping)

    def options(self, structure: Structure) -> dict[str, Any]:
        """Return limits and feedforward of the structure's controllers."""
        given = self.feedforward
        return {**self.limits, **({} if given is None else structure.feedforward(given))}


def range_of_u(limits: Mapping[str, Any]) -> tuple[float, float]:
    """Return u_min and u_max [u-unit], infinite where there is none."""
    known = {name: value for name, value in limits.items() if value is not None}
    ends = known.get("u_min", -math.inf), known.get("u_max", math.inf)
    return checks.interval("u_min", ends[0], "u_max", ends[1])


def with_noise_bound(task: Task, in_use: float | None = None) -> tuple[Task, str]:
    """Return the task with a bound for what noise does to u, and how it came.

    Where the noise of y and the limits of u are known, the standard deviation of u is bounded by a
    share of half their range. Else M_ks is bounded by a multiple of that of the optimal PI
    controller; where a PI controller is of no use, as for an inertia, by that of a PID controller
    with the usual filter, ``T_f = T_d/10``, if it is larger; or by ``in_use``, the M_ks of a
    controller that is in use, if that is the largest.
    """
    given = task.constraints
    if given.u_std is not None:
        return task, ""
    if given.noise:
        low, high = range_of_u(task.limits)
        if given.m_ks is not None:
            raise ValueError(
                f"m_ks = {given.m_ks:g}: bounds what noise does to u, so noise_std and resolution "
                "have no effect; leave m_ks out, or them"
            )
        if not math.isfinite(high - low):
            raise ValueError(
                "noise_std, resolution: noise may use a share of the range of u; give u_min and "
                "u_max, too, or u_std"
            )
        half = 0.5 * (high - low)
        how = (
            f"std(u): {100.0 * given.noise_share:g} % of half the range of u, {half:.4g}, for "
            f"noise of {given.noise:.3g} in y"
        )
        # u_std takes the place of the share, so that a result's constraints can be given again.
        share = Constraints.noise_share
        return _with(task, u_std=given.noise_share * half, noise_share=share), how
    if given.m_ks is not None or given.noise_over_pi is None:
        return task, ""
    ratio, by_gain = given.noise_over_pi, replace(task, objective="load")
    give = (
        "give the limits of u, and noise_std or resolution of y (--u-min, --u-max, --noise, "
        "--resolution), to have what noise may do to u"
    )
    pi = _reference(by_gain, FilteredPID(task.model, derivative=False, filtered=False))
    found = []
    if pi is not None:
        size = _m_ks(task, pi)
        how = f"M_ks: {ratio:g} times that of the optimal PI controller, {size:.4g}"
        found.append((ratio * size, how))
    if pi is None or task.model.degree >= _INERTIA:
        tied = FilteredPID(task.model, derivative=True, filtered=False, ratio=ratio)
        pid = _reference(by_gain, tied)
        if pid is not None and (pi is None or pid.cost <= pi.cost - math.log(_OF_USE)):
            how = f"M_ks: that of the optimal PID controller with T_f = T_d/{ratio:g}"
            found.append((_m_ks(task, pid), how))
    if in_use is not None:
        found.append((in_use, f"M_ks: that of the controller in use, {in_use:.4g}"))
    if not found:
        source = f"neither a PI controller nor a PID controller with T_f = T_d/{ratio:g}"
        return task, f"NOT bounded: M_ks: {source} meets the constraints, to guess it from; {give}"
    m_ks, how = max(found)
    kept = Constraints.noise_over_pi  # m_ks takes its place, as above
    how = f"NOT known what noise does to u, so a guess: {how}; {give}"
    return _with(task, m_ks=m_ks, noise_over_pi=kept), how


def _with(task: Task, **bounds: Any) -> Task:
    """Return the task with other bounds."""
    constraints = replace(task.constraints, **bounds)
    model = task.model._replace(constraints=constraints)
    return replace(task, constraints=constraints, model=model)


def without_damping(task: Task) -> Task:
    """Return the task without the bound of damping."""
    return _with(task, damping=None)


def _any_feasible(solutions: Sequence[Solution]) -> bool:
    return any(each.feasible for each in solutions)


def _reference(task: Task, structure: FilteredPID) -> Solution | None:
    """Return the controller of a reference with the largest integral gain, if there is any."""
    best = _best(task, structure, _known_starts(structure, {}))
    if best is not None and best.feasible and _is_stable(task.plants, best):
        return best
    if task.constraints.damping is None:
        return None
    return _reference(without_damping(task), structure)


def _m_ks(task: Task, solution: Solution) -> float:
    found = design_of("", task.problem(), solution, task.constraints, {})
    return float(found.measures["M_ks"])


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
            solved[name], kept = _solutions(name, task, known), task
            if task.constraints.damping is not None and not _any_feasible(solved[name]):
                ringing = _solutions(name, without_damping(task), known)
                if _any_feasible(ringing):
                    solved[name], kept = ringing, without_damping(task)
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
            shown = task.problem(_worst(task, best)) if _is_exchanged(task) else problem
            designs[name] = impossible(name, contradiction(shown, best, task.constraints))
        else:
            made = (kept.problem(), best, kept.constraints, kept.options(best.structure))
            found = design_of(best.structure.name, *made)
            designs[name] = replace(found, undamped=kept is not task)
    return {name: designs[name] for name in names}


def simplest(designs: Mapping[str, Design], objective: str) -> Design:
    """Return the simplest design whose objective is within 5 % of the best of all.

    One that keeps the bound of damping comes before all that do not. Without any controller it is
    one that says why.
    """
    usable = {name: each for name, each in designs.items() if each.controller is not None}
    if not usable:
        return next(iter(designs.values()))
    usable = {name: each for name, each in usable.items() if not each.undamped} or usable
    first = next(iter(usable.values()))
    best = max(usable.values(), key=lambda each: relative(each, first, objective))
    good = [k for k, each in usable.items() if relative(best, each, objective) <= _NEAR_BEST]
    return usable[min(good, key=_FROM_SIMPLE.index)]


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
    found = []
    for order in orders_of(name, task.model, task.order):
        structure = make_structure(name, task.model, order)
        if task.objective == "load" and structure.integrators > 1:
            raise ValueError(
                f"k_i is infinite with {structure.integrators} integrators: after a step of the "
                "load the integral of y is zero for any gains; use objective='load-iae'"
            )
        best = _best(task, structure, _known_starts(structure, solved))
        if best is not None and _is_stable(task.plants, best):
            found.append(best)
    return found


def _best(task: Task, structure: Structure, known: Matrix) -> Solution | None:
    """Return the best solution.

    What is about responses over time is slow: it comes in at optima for the integral gain, the best
    one of them and of ``known``.
    """
    problem = task.problem()
    quick = _with(task, u_max=None, rate_max=None)
    if task.objective not in requirements.WITHOUT_TIME:
        quick = replace(quick, objective="load")
    ends = _best_gains(quick, structure, known)
    is_slow = any(extra.over_time for extra in problem.extras)
    if not ends or (problem.objective in requirements.WITHOUT_TIME and not is_slow):
        return min(ends, key=_rank, default=None)
    rows, count = [*(end.values for end in ends), *known], 1
    if structure.integrators > 1:
        rows += [*starts(quick.problem(), structure, structure.shapes(), _VALLEYS)]
        count = _VALLEYS
    tried = [solution_at(problem, structure, row) for row in rows]
    first = sorted((each for each in tried if each is not None), key=merit)[:count]
    if not first:
        return None
    if not _is_exchanged(task):
        ends = [end for e in first if (end := search(problem, structure, e.values, _ROUNDS))]
        # A search may end worse than it began, and more freedom must not give less.
        return min([*ends, *first], key=_rank)
    return _near(task, structure, first[0], _ROUNDS) or first[0]


def _is_exchanged(task: Task) -> bool:
    """Return whether the objective is the worst case of more plants than a search has at once."""
    worst = task.objective not in requirements.WITHOUT_TIME and task.quantile == 1.0
    return worst and len(task.plants.plants) > _MEMBERS


def _worst(task: Task, solution: Solution) -> list[int]:
    """Return the plants with the worst objectives."""
    over = SetResponses(task.plants, task.inputs)
    each = scores(task.objective, solution.structure, solution.values, over)
    return np.argsort(-each)[:_MEMBERS].tolist()


def _near(task: Task, structure: Structure, start: Solution, rounds: int) -> Solution | None:
    """Return the optimum that is reached from a solution; None if all rounds end unstable.

    The worst case of a set is that of few plants: those that are the worst at the optima so far.
    """
    if not _is_exchanged(task):
        return search(task.problem(), structure, start.values, rounds)
    over, members, found = SetResponses(task.plants, task.inputs), list[int](), None
    best = start
    for _ in range(_EXCHANGES):
        each = scores(task.objective, structure, best.values, over)
        if members and float(np.max(each)) <= _WORSE * float(np.max(each[members])):
            break
        members = list(dict.fromkeys([*members, *np.argsort(-each)[:_MEMBERS].tolist()]))
        end = search(task.problem(members), structure, best.values, rounds)
        if end is None:
            break
        best = found = end
    if found is None:
        return None
    return replace(found, cost=float(task.problem().cost(structure, found.values[None, :])[0]))


def _best_gains(task: Task, structure: Structure, known: Matrix) -> list[Solution]:
    """Return optima for the integral gain; if in need, from optima of other limits."""
    problem = task.problem()
    best = best_solution(problem, structure, known)
    for share in _OTHER_LIMITS:
        if best is not None and best.feasible:
            break
        start = best_solution(relaxed(problem, share), structure, known)
        found = None if start is None else search(problem, structure, start.values, _ROUNDS)
        best = min((each for each in (best, found) if each is not None), key=_rank, default=None)
    if best is None or len(structure.parameters) <= FEW:
        return [] if best is None else [best]
    return [best, *_from_tighter(task, structure, best)]


def _from_tighter(task: Task, structure: Structure, best: Solution) -> list[Solution]:
    """Return optima that are reached from those of tighter bounds.

    The fewer bounds there are, the more valleys there are, and the search may end in one with a
    fast filter, say, that costs robustness, at less than what a further bound leads to. So where a
    bound is missing, or not reached, the search also goes by optima with that bound at shares of
    what the optimum has.
    """
    problem, start, ends = task.problem(), best.values, []
    for share in _TIGHTER:
        tight = _tightened(task, structure, best, share).problem()
        near = search(tight, structure, start, _NEARBY_ROUNDS, roughly=True)
        if near is None:
            break
        start = near.values
        found = search(problem, structure, start, _ROUNDS, roughly=True)
        ends += [] if found is None else [found]
    return ends


def _tightened(task: Task, structure: Structure, best: Solution, share: float) -> Task:
    """Return the task with bounds that the solution does not reach at a share of what it has."""
    given, bounds = task.constraints, dict[str, float]()
    C = structure.response(best.values[None, :], task.plants.omega)
    for name, kind in requirements.KINDS.items():
        size = float(requirements.worst_ratio((requirements.Bound(kind, 1.0),), task.plants, C)[0])
        limit = getattr(given, name)
        is_reached = limit is not None and size >= _REACHED * limit
        if is_reached or (name == "m_ks" and given.u_std is not None):
            continue
        bounds[name] = share * size
        if name != "m_ks":  # no loop has a peak of 1
            bounds[name] = 1.0 + share * max(size - 1.0, _LEAST_PEAK)
    return _with(task, **bounds)


def _is_stable(plants: PlantSet, solution: Solution) -> bool:
    """Return whether the poles of all closed loops are inside of the unit circle."""
    law = law_of(solution.controller)
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
    over_time = [extra for extra in problem.extras if extra.over_time]
    for _ in range(_FEW_BISECTIONS if over_time else _BISECTIONS):
        middle = (low * high) ** 0.5
        nearer = search(relaxed(problem, middle), structure, found.values, _NEARBY_ROUNDS)
        if nearer is not None and nearer.feasible:
            high, found = middle, nearer
        else:
            low = middle
    _, active, _ = measured(relaxed(problem, high), found, constraints)
    given = {bound.kind: bound.limit for bound in problem.bounds}
    given |= {extra.name: extra.limit for extra in problem.extras}
    given |= {} if problem.damping is None else {"damping": problem.damping}
    # Bounds of parameters, as |p| dt, are not relaxed.
    limits = {each.name: given.get(each.name, each.limit) for each in active}
    reached = ", ".join(f"{name} {limit:.4g}" for name, limit in limits.items())
    about = [
        f"; {each.name} bounds the response to the load or the reference, and the least that was "
        f"found is {high * each.limit:.3g}, with the other bounds relaxed as much: raise it, or "
        "give a smaller load or reference"
        for each in over_time
        if each.name in limits
    ]
    return (
        f"the constraints contradict each other for this structure: {reached or 'all'}; the least "
        f"excess that was found is {100.0 * (high - 1.0):.3g} % for each{''.join(about)}"
    )


def relaxed(problem: Problem, factor: float) -> Problem:
    """Return the problem with all limits larger by a factor."""
    bounds = tuple(requirements.Bound(kind, factor * limit) for kind, limit in problem.bounds)
    extras = tuple(
        extra._replace(limit=factor * extra.limit, ratio=partial(_share, extra, factor))
        for extra in problem.extras
    )
    damping = None if problem.damping is None else 1.0 - factor * (1.0 - problem.damping)
    damping = None if damping is None or damping <= 0.0 else damping
    return replace(problem, bounds=bounds, extras=extras, damping=damping)


def _share(extra: Extra, factor: float, structure: Structure, values: Matrix) -> Vector:
    return extra.ratio(structure, values) / factor


def tradeoff(task: Task, design: Design) -> list[tuple[str, float, float]]:
    """Return what the objective would be with each active limit 10 % lower and higher."""
    assert design.solution is not None
    found = []
    fields = {"M_s": "m_s", "M_t": "m_t", "M_ks": "m_ks", "delay margin": "delay_margin"}
    # ``damping`` is a field of the same name.
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
            result = _near(near, solution.structure, solution, _NEARBY_ROUNDS)
            if result is not None and result.feasible:
                size = float(np.exp(result.cost))
                value = 1.0 / size if task.objective == "load" else size
                found.append((active.name, limit, value))
    return found


# Bounds of M_ks around one that is a guess, in its units.
_OF_CURVE = (0.25, 0.5, 1.0, 2.0, 4.0)


def noise_curve(task: Task, design: Design) -> list[tuple[float, float]]:
    """Return M_ks and the objective of a structure for bounds of M_ks around that of the task.

    From the task's bound on each search starts at the one before.
    """
    assert design.solution is not None
    given = task.constraints.m_ks
    assert given is not None
    found = {}
    for side in (1, -1):
        solution = design.solution
        for factor in _OF_CURVE[len(_OF_CURVE) // 2 :]:
            limit = given * factor**side
            if factor > 1.0:
                near = _with(task, m_ks=limit)
                result = _near(near, solution.structure, solution, _NEARBY_ROUNDS)
                if result is not None and not result.feasible:
                    result = _near(near, solution.structure, result, _ROUNDS)
                if result is None or not result.feasible:
                    break
                solution = result
            size = float(np.exp(solution.cost))
            found[limit] = 1.0 / size if task.objective == "load" else size
    return sorted(found.items())
