"""The optimiser: several starts, sequential quadratic programming, exchange of frequencies.

The problem ``max k_i`` subject to bounds at *all* frequencies has infinitely many constraints. It
is solved as a sequence of problems with finitely many (exchange, Hettich & Kortanek, *SIAM Review*
35, 1993): the points of the grid with values near their bounds, and the peaks between them. Each is
solved by sequential quadratic programming (Kraft 1988, SciPy's SLSQP) in the logarithms of the
parameters, within a box around the present point. Stability is checked after each, by the argument
principle, and at the end by the closed loop's poles.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from quell.tuning.optimiser.finite_problem import FiniteProblem
from quell.tuning.optimiser.iterate import Iterate
from quell.tuning.optimiser.loops import Peak
from quell.tuning.optimiser.problem import Problem, Solution, limits
from quell.tuning.optimiser.starts import starts
from quell.tuning.structures.base import Structure
from quell.types import Matrix, Vector

# Points with a ratio above the first are in the problem, in later rounds those above the second.
_NEAR, _NEARER = 0.5, 0.85
_EARLY_ROUNDS = 2
# Half width of the box of a round in the logarithms, and how it shrinks after an unstable result.
_BOX, _SHRINK = 0.7, 0.3
_ITERATIONS = 20
# Starts, the rounds that each of them takes, those that go on, and their rounds at most. With more
# parameters than a few further ones go on while all end at the same cost: of a test plant the third
# start alone found an optimum that is a quarter better.
_STARTS, _FIRST_ROUNDS, _FINALISTS, _ROUNDS = 5, 3, 2, 25
# Starts of structures with many valleys, one in each, and starts beside the best of their ends. By
# trial on 40 stiff plants (benchmarks/model_based_starts.py).
_VALLEYS, _BESIDE = 8, 3
# Rounds go on while a bound is exceeded by more: a tenth of what is promised.
_VIOLATION = 1e-4
# What exceeding a limit by a share costs, in units of the logarithm of the objective: more than a
# larger limit gains, which is a factor of 1 to 5 in the test batch.
_EXCESS = 20.0
# Rounds end when the objective changes by less, and the quadratic programs at the tolerance. Optima
# are flat: a share of 1e-4 of the objective is 1 to 2 % of the parameters. With few parameters,
# which are worth to be known, the search goes on.
_SETTLED, _TOLERANCE = 1e-4, 1e-7
FEW, _SETTLED_OF_FEW, _TOLERANCE_OF_FEW = 3, 1e-7, 1e-12


def best_solution(
    problem: Problem, structure: Structure, more: Matrix | None = None
) -> Solution | None:
    """Return the best solution from several starts; None if no start is stable.

    All of them take some rounds, the best go on until they settle, the winner until its parameters
    do. ``more`` (k, p) are values to start from besides those of the structure. A bound of damping
    comes in where they have settled, because the poles of many loops are slow to find.
    """
    if more is None:
        more = np.zeros((0, len(structure.parameters)))
    best = min(_ends(replace(problem, damping=None), structure, more), key=_rank, default=None)
    if best is not None and problem.damping is not None:
        best = _damped(problem, structure, best, more)
    if best is None or not _is_precise(problem, structure):
        return best
    end = search(problem, structure, best.values, _ROUNDS)
    return best if end is None or (best.feasible and not end.feasible) else end


def _damped(problem: Problem, structure: Structure, best: Solution, more: Matrix) -> Solution:
    """Return the best solution with a bound of damping, from one without.

    Where that rings the search goes on from there, and from the best of ``more``.
    """
    now = solution_at(problem, structure, best.values)
    if now is not None and now.feasible:
        return now
    found = [each for row in more if (each := solution_at(problem, structure, row)) is not None]
    near = sorted(found, key=merit)[:1]
    ends = [search(problem, structure, each.values, _ROUNDS, True) for each in (best, *near)]
    kept = [each for each in (now, *ends) if each is not None]
    return min(kept, key=_rank, default=best)


def solution_at(problem: Problem, structure: Structure, values: Vector) -> Solution | None:
    """Return the solution that values (p,) are as they are; None if a loop is unstable."""
    here = Iterate(problem, structure, np.log(np.clip(values, *limits(structure))))
    if not here.stable:
        return None
    return Solution(structure, np.exp(here.x), here.cost, here.violation)


def _ends(problem: Problem, structure: Structure, more: Matrix) -> list[Solution]:
    """Return where the searches from the best starts end."""
    found = []
    first = starts(problem, structure, np.vstack([structure.shapes(), more]), _STARTS)
    grid, spacing = structure.grid()
    valleys = starts(problem, structure, grid, _VALLEYS, 1.01 * spacing)
    for start in (*first, *valleys):
        solution = search(problem, structure, start, _FIRST_ROUNDS, roughly=True)
        if solution is not None:
            found.append(solution)
    found.sort(key=merit)
    ends: list[Solution] = []
    few = len(structure.parameters) <= FEW
    for solution in found:
        if len(ends) >= _FINALISTS and (few or not _agree(ends)):
            break
        near = (np.max(np.abs(np.log(solution.values / end.values))) < 0.02 for end in ends)
        if not any(near):
            end = search(problem, structure, solution.values, _ROUNDS, roughly=True)
            ends.append(solution if end is None else end)
    best = min(ends, key=_rank, default=None)
    if best is not None:
        for start in starts(problem, structure, structure.beside(best.values), _BESIDE):
            end = search(problem, structure, start, _ROUNDS, roughly=True)
            ends += [] if end is None else [end]
    return ends


def _agree(ends: list[Solution]) -> bool:
    """Return whether the costs of all ends are the same."""
    costs = [end.cost for end in ends]
    return max(costs) - min(costs) < 10.0 * _SETTLED


def _is_precise(problem: Problem, structure: Structure) -> bool:
    """Return whether the search goes on until the parameters settle; it is quick for k_i."""
    return len(structure.parameters) <= FEW and problem.objective == "load"


def _rank(solution: Solution) -> tuple[float, float]:
    """Return the key by which results are ordered: those that keep to all limits first."""
    return 0.0 if solution.feasible else solution.violation, solution.cost


def merit(point: Solution | Iterate) -> float:
    """Return the cost of a point that may exceed limits; less is better."""
    return point.cost + _EXCESS * point.violation


def search(
    problem: Problem, structure: Structure, start: Vector, rounds: int, roughly: bool = False
) -> Solution | None:
    """Return the optimum that is reached from a start; None if all rounds end unstable.

    ``roughly`` ends when the objective settles, even if there are few parameters.
    """
    low, high = (np.log(limit) for limit in limits(structure))
    now, box = Iterate(problem, structure, np.clip(np.log(start), low, high)), _BOX
    best: Iterate | None = None
    extra_points: list[tuple[int, Peak]] = []
    last, few = math.inf, not roughly and _is_precise(problem, structure)
    settled = _SETTLED_OF_FEW if few else _SETTLED
    allowed = _SETTLED_OF_FEW if few else _VIOLATION
    for i in range(rounds):
        if best is None or merit(now) < merit(best):
            best = now
        if i == rounds - 1 or (now.violation <= allowed and abs(last - now.cost) < settled):
            break
        last = now.cost
        extra_points = (extra_points + now.peaks)[-400:]
        points = now.points(_NEAR if i < _EARLY_ROUNDS else _NEARER, extra_points)
        bounds = list(zip(np.maximum(low, now.x - box), np.minimum(high, now.x + box), strict=True))
        tolerance = _TOLERANCE_OF_FEW if few else _TOLERANCE
        near = FiniteProblem(problem, structure, points, now.followed, now.x)
        x = _quadratic_programming(near, now.x, bounds, tolerance)
        after = None if x is None else Iterate(problem, structure, x)
        if after is None or not after.stable:
            box *= _SHRINK
            if box < 1e-3:
                break
            continue
        now = after
    if best is None:
        return None
    return Solution(structure, np.exp(best.x), best.cost, best.violation)


def _quadratic_programming(
    near: FiniteProblem, x: Vector, bounds: list[Any], tolerance: float
) -> Vector | None:
    from scipy.optimize import minimize

    try:
        found = minimize(
            near.cost,
            x,
            jac=near.slope_of_cost,
            bounds=bounds,
            constraints={
                "type": "ineq",
                "fun": near.constraints,
                "jac": near.slopes_of_constraints,
            },
            method="SLSQP",
            options={"maxiter": _ITERATIONS, "ftol": tolerance},
        )
    except (np.linalg.LinAlgError, ValueError):
        return None
    if not np.all(np.isfinite(found.x)):
        return None
    return np.clip(found.x, [low for low, _ in bounds], [high for _, high in bounds])
