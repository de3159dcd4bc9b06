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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.tuning.optimiser.problem import Problem, Solution, limits
from quell.tuning.optimiser.requirements import (
    Points,
    all_peaks,
    sizes,
    slack_and_slope,
)
from quell.tuning.optimiser.starts import starts
from quell.tuning.structures.base import Structure
from quell.types import Matrix, Vector

# Step of the differences in the logarithms: between the rounding error of C_y, some 1e-12, and its
# curvature.
_DIFFERENCE = 1e-6
# Points with a ratio above the first are in the problem, in later rounds those above the second;
# peaks above the third are refined.
_NEAR, _NEARER, _PEAK = 0.5, 0.85, 0.93
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
_FEW, _SETTLED_OF_FEW, _TOLERANCE_OF_FEW = 3, 1e-7, 1e-12


def best_solution(
    problem: Problem, structure: Structure, more: Matrix | None = None
) -> Solution | None:
    """Return the best solution from several starts; None if no start is stable.

    All of them take some rounds, the best go on until they settle, the winner until its parameters
    do. ``more`` (k, p) are values to start from besides those of the structure.
    """
    if more is None:
        more = np.zeros((0, len(structure.parameters)))
    found = []
    first = starts(problem, structure, np.vstack([structure.shapes(), more]), _STARTS)
    grid, spacing = structure.grid()
    valleys = starts(problem, structure, grid, _VALLEYS, 1.01 * spacing)
    for start in (*first, *valleys):
        solution = search(problem, structure, start, _FIRST_ROUNDS, roughly=True)
        if solution is not None:
            found.append(solution)
    found.sort(key=lambda solution: _merit(solution.cost, solution.violation))
    ends: list[Solution] = []
    few = len(structure.parameters) <= _FEW
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
        best = min(ends, key=_rank)
    if best is None or not _is_precise(problem, structure):
        return best
    end = search(problem, structure, best.values, _ROUNDS)
    return best if end is None or (best.feasible and not end.feasible) else end


def _agree(ends: list[Solution]) -> bool:
    """Return whether the costs of all ends are the same."""
    costs = [end.cost for end in ends]
    return max(costs) - min(costs) < 10.0 * _SETTLED


def _is_precise(problem: Problem, structure: Structure) -> bool:
    """Return whether the search goes on until the parameters settle; it is quick for k_i."""
    return len(structure.parameters) <= _FEW and problem.objective == "load"


def _rank(solution: Solution) -> tuple[float, float]:
    """Return the key by which results are ordered: those that keep to all limits first."""
    return 0.0 if solution.feasible else solution.violation, solution.cost


def _merit(cost: float, violation: float) -> float:
    """Return the cost of a point that may exceed limits; less is better."""
    return cost + _EXCESS * violation


def search(
    problem: Problem, structure: Structure, start: Vector, rounds: int, roughly: bool = False
) -> Solution | None:
    """Return the optimum that is reached from a start; None if all rounds end unstable.

    ``roughly`` ends when the objective settles, even if there are few parameters.
    """
    low, high = (np.log(limit) for limit in limits(structure))
    x, box = np.clip(np.log(start), low, high), _BOX
    best: tuple[float, float, Vector] | None = None
    extra_points: list[tuple[int, int, float]] = []
    last, few = math.inf, not roughly and _is_precise(problem, structure)
    settled = _SETTLED_OF_FEW if few else _SETTLED
    allowed = _SETTLED_OF_FEW if few else _VIOLATION
    for i in range(rounds):
        cost, violation, refined = _judged(problem, structure, x)
        if best is None or _merit(cost, violation) < _merit(*best[:2]):
            best = (cost, violation, x)
        if i == rounds - 1 or (violation <= allowed and abs(last - cost) < settled):
            break
        last = cost
        extra_points = (extra_points + refined)[-400:]
        near = _NEAR if i < _EARLY_ROUNDS else _NEARER
        points = _points(problem, structure, x, extra_points, near)
        bounds = list(zip(np.maximum(low, x - box), np.minimum(high, x + box), strict=True))
        tolerance = _TOLERANCE_OF_FEW if few else _TOLERANCE
        after = _quadratic_programming(problem, structure, x, points, bounds, tolerance)
        if after is None or not _stable(problem, structure, after):
            box *= _SHRINK
            if box < 1e-3:
                break
            continue
        x = after
    if best is None:
        return None
    cost, violation, x = best
    return Solution(structure, np.exp(x), cost, violation)


def _judged(
    problem: Problem, structure: Structure, x: Vector
) -> tuple[float, float, list[tuple[int, int, float]]]:
    """Return cost, violation, and the refined peaks (bound, plant, frequency)."""
    values = np.exp(x)[None, :]
    C = structure.response(values, problem.plants.omega)[0]

    def controller(omega: Vector) -> NDArray[np.complex128]:
        return structure.response(values, omega)[0]

    found = all_peaks(problem.bounds, problem.plants, controller, C, _PEAK)
    ratios = [peak.value for _, peak in found]
    ratios += [float(extra.ratio(structure, values)[0]) for extra in problem.extras]
    ratios += (1.0 - structure.rules(values)[0]).tolist()
    violation = max([ratio - 1.0 for ratio in ratios], default=0.0)
    cost = float(problem.cost(structure, values)[0])
    return cost, max(violation, 0.0), [(i, peak.plant, peak.omega) for i, peak in found]


def _stable(problem: Problem, structure: Structure, x: Vector) -> bool:
    values = np.exp(x)[None, :]
    C = structure.response(values, problem.plants.omega)
    unstable = problem.plants.unstable_loops(C, structure.unstable_poles(values))
    return bool(np.all(unstable < 0.5))


def _points(
    problem: Problem,
    structure: Structure,
    x: Vector,
    refined: list[tuple[int, int, float]],
    least: float,
) -> Points:
    """Return the points of the grid near their bounds, and the refined peaks."""
    plants = problem.plants
    C = structure.response(np.exp(x)[None, :], plants.omega)[0]
    kinds, members, places = [], [], []
    for number, (response, limit) in enumerate(problem.bounds):
        near = sizes(response, plants.P, C) > least * limit
        j, i = np.nonzero(near)
        kinds.append(np.full(j.size, number))
        members.append(j)
        places.append(plants.omega[i])
    kinds.append(np.array([i for i, _, _ in refined], dtype=int))
    members.append(np.array([j for _, j, _ in refined], dtype=int))
    places.append(np.array([omega for _, _, omega in refined]))
    kind, member = np.concatenate(kinds), np.concatenate(members)
    omega, at = np.unique(np.concatenate(places), return_inverse=True)
    if omega.size == 0:  # far from all bounds
        omega, at = plants.omega[:1], np.zeros(1, dtype=int)
        kind, member = np.zeros(1, dtype=int), np.zeros(1, dtype=int)
    P = plants.responses_of(omega[at], member)
    return Points(kind.astype(np.intp), P, at.astype(np.intp), omega)


def _quadratic_programming(
    problem: Problem,
    structure: Structure,
    x: Vector,
    points: Points,
    bounds: list[Any],
    tolerance: float,
) -> Vector | None:
    from scipy.optimize import minimize

    size = x.size
    steps = np.vstack([np.zeros(size), _DIFFERENCE * np.eye(size)])
    memo: dict[bytes, Any] = {}

    def at(x: Vector) -> Any:
        key = x.tobytes()
        if key not in memo:
            memo.clear()
            values = np.exp(x + steps)
            C = structure.response(values, points.omega)
            g, slope = slack_and_slope(problem.bounds, points, C[0], (C[1:] - C[0]) / _DIFFERENCE)
            parts, slopes = [g], [slope]
            for extra in problem.extras:
                ratio = 1.0 - extra.ratio(structure, values)
                parts.append(ratio[:1])
                slopes.append(((ratio[1:] - ratio[0]) / _DIFFERENCE)[None, :])
            rules = structure.rules(values)
            parts.append(rules[0])
            slopes.append((rules[1:] - rules[0]).T / _DIFFERENCE)
            cost = problem.cost(structure, values)
            memo[key] = (
                cost[0],
                (cost[1:] - cost[0]) / _DIFFERENCE,
                np.concatenate(parts),
                np.vstack(slopes),
            )
        return memo[key]

    try:
        found = minimize(
            lambda x: at(x)[0],
            x,
            jac=lambda x: at(x)[1],
            bounds=bounds,
            constraints={"type": "ineq", "fun": lambda x: at(x)[2], "jac": lambda x: at(x)[3]},
            method="SLSQP",
            options={
                "maxiter": _ITERATIONS,
                "ftol": tolerance,
            },
        )
    except (np.linalg.LinAlgError, ValueError):
        return None
    if not np.all(np.isfinite(found.x)):
        return None
    return np.clip(found.x, [low for low, _ in bounds], [high for _, high in bounds])
