"""The optimiser: starts, sequential quadratic programming, exchange of frequencies.

The optimiser: several starts, sequential quadratic programming, exchange of frequencies.

The problem ``max k_i`` subject to bounds at *all* frequencies has infinitely many constraints. It
is solved as a sequence of problems with finitely many (exchange, Hettich & Kortanek, *SIAM Review*
35, 1993): the points of the grid with values near their bounds, and the peaks between them. Each is
solved by sequential quadratic programming (Kraft 1988, SciPy's SLSQP) in the logarithms of the
parameters, within a box around the present point. Stability is checked after each, by the argument
principle, and at the end by the closed loop's poles.

The problem of a round: cost and finitely many constraints, with their derivatives.

Derivatives are differences: the values of one more controller for each parameter. SLSQP asks for
them at those trials of its line search only that it takes: of a stiff problem a sixth. The first
trial of a line search is mostly taken, so the other controllers come along there; at later trials
they are left out until they are asked for.

Parameters that a search has come to: what they cost and exceed, and whether loops are stable.

The controller's response on the grid is found once for all of it.

Starts of the search: shapes of a structure, each with the best of many gains.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.analysis.margins import Complex
from quell.controllers.base import Controller
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser.loops import Peak, PlantSet, SetResponses
from quell.tuning.optimiser.requirements import (
    Bound,
    Followed,
    Points,
    Pole,
    all_peaks,
    beside_poles,
    closed_loop_poles,
    counted,
    points_of,
    sizes,
    slacks,
    slopes_of_slacks,
    worst_ratio,
)
from quell.tuning.structures.base import Structure
from quell.types import Matrix, Vector

# ---- A problem of the optimiser, and its solution ----

# A result is good if no bound is exceeded by more: half of what is promised.
_GOOD = 5e-4


class Extra(NamedTuple):
    """A constraint that is no bound of a frequency response."""

    name: str
    limit: float
    ratio: Callable[[Structure, Matrix], Vector]  # values (m, p) → value over limit (m,)
    over_time: bool = False  # whether responses over time are computed for it


@dataclass(frozen=True)
class Problem:
    """The problem of the optimiser: plants, bounds, objective."""

    plants: PlantSet
    bounds: tuple[Bound, ...]
    extras: tuple[Extra, ...]
    objective: str  # its name
    cost: Callable[[Structure, Matrix], Vector]  # values (m, p) → cost (m,), its logarithm
    damping: float | None = None  # least damping of the closed loop's poles


@dataclass(frozen=True, eq=False)
class Solution:
    """The best values of a structure."""

    structure: Structure
    values: Vector
    cost: float
    violation: float  # the largest ratio to a bound, less one

    @property
    def controller(self) -> Controller:
        """The linear controller, without limits of u and feedforward."""
        return self.structure.controller(self.values)

    @property
    def feasible(self) -> bool:
        """Whether all constraints hold."""
        return self.violation <= _GOOD


def limits(structure: Structure) -> tuple[Vector, Vector]:
    """Return the lower and the upper bounds (p,) of a structure's parameters."""
    low = np.array([parameter.low for parameter in structure.parameters])
    return low, np.array([parameter.high for parameter in structure.parameters])


# ---- Constraints that are no bounds of a frequency response ----

# Largest load response over frequency, in units of that at low ones, of structures whose integral
# gain has no largest value: optimal PID controllers and free poles have up to 2.1 on twenty plants.
MOST_SWING = 2.0
# It is found on each fourth point of the grid, 6 per decade: its peaks are wide.
_SWING_STEP = 4
# Steps by which a crossover is refined, by the secant rule, from 24 points per decade on.
_SECANTS = 4


def extras_of(constraints: Constraints, over: SetResponses) -> tuple[Extra, ...]:
    """Return the constraints that ``constraints`` has besides bounds over frequency."""
    plants = over.plants
    found = []
    if constraints.u_std is not None:
        gain = constraints.u_std / constraints.noise

        def noise(structure: Structure, values: Matrix) -> Vector:
            return noise_gain(plants, structure.response(values, plants.omega)) / gain

        found.append(Extra("u_std", constraints.u_std, noise))
    if constraints.delay_margin is not None:
        least = constraints.delay_margin

        def delay(structure: Structure, values: Matrix) -> Vector:
            return least / delay_margin(plants, structure, values)

        found.append(Extra("delay margin", least, delay))
    for name, limit in (("u_max", constraints.u_max), ("rate_max", constraints.rate_max)):
        if limit is not None:
            found.append(_limit_of_u(name, limit, over))

    def swing(structure: Structure, values: Matrix) -> Vector:
        if not structure.may_swing:
            return np.zeros(values.shape[0])
        C = structure.response(values, plants.omega[::_SWING_STEP])
        return load_swing(plants, C, structure.integral_gain(values), _SWING_STEP) / MOST_SWING

    return (*found, Extra("k_i |P S/ω|", MOST_SWING, swing))


def load_swing(plants: PlantSet, C: Complex, k_i: Vector, step: int = 1) -> Vector:
    """Return the largest ``k_i |P S/(jω)|`` (m,) over plants and frequencies.

    C (m, k) is on the grid, or on each of its points number 0, ``step``, …

    ``P S/(jω)`` is the spectrum of y after a unit step of the load. At low frequencies it is the
    integral of y, 1/k_i, and nowhere more than that of ``|y|``. A controller with a second pole
    near z = 1 has any k_i, with y swinging so that its integral vanishes: there this is large.
    """
    worst = np.zeros(C.shape[0])
    for P in plants.P[:, ::step]:
        with np.errstate(divide="ignore", invalid="ignore"):
            size = np.abs(P / (1.0 + P * C)) / plants.omega[::step]
        worst = np.maximum(worst, np.max(size, axis=1))
    return worst * k_i


def noise_gain(plants: PlantSet, C: Complex) -> Vector:
    """Return the largest RMS of u (m,) over plants, for white noise of RMS 1 in y.

    ``(dt/π) ∫ |C S|² dω`` up to half the sampling rate, with a cubic spline in log ω through the
    grid; C (m, G).
    """
    weights = plants.dt / math.pi * plants.omega * plants.spline_weights
    worst = np.zeros(C.shape[0])
    for P in plants.P:
        worst = np.maximum(worst, np.abs(C / (1.0 + P * C)) ** 2 @ weights)
    return np.sqrt(worst)


def delay_margin(plants: PlantSet, structure: Structure, values: Matrix) -> Vector:
    """Return the least delay margin (m,) over plants [s], as ``analysis.margins`` defines it."""
    C = structure.response(values, plants.omega)
    x = np.log(plants.omega)
    found = np.full(values.shape[0], np.inf)
    for i, row in enumerate(values):
        for j in range(len(plants.plants)):
            size = np.log(np.abs(plants.P[j] * C[i]))
            at = np.flatnonzero(np.signbit(size[:-1]) != np.signbit(size[1:]))
            if at.size == 0:
                continue
            low, high, g_low, g_high = x[at], x[at + 1], size[at], size[at + 1]
            for _ in range(_SECANTS):
                middle = low + (high - low) * g_low / (g_low - g_high)
                L = _loop(plants, structure, row, j, np.exp(middle))
                g = np.log(np.abs(L))
                left = np.signbit(g) == np.signbit(g_low)
                low, g_low = np.where(left, middle, low), np.where(left, g, g_low)
                high, g_high = np.where(left, high, middle), np.where(left, g_high, g)
            lead = np.pi + np.angle(L)
            found[i] = min(found[i], float(np.min(lead / np.exp(middle))))
    return found


def _loop(plants: PlantSet, structure: Structure, row: Vector, j: int, omega: Vector) -> Complex:
    return plants.responses(omega)[j] * structure.response(row[None, :], omega)[0]


def _limit_of_u(name: str, limit: float, over: SetResponses) -> Extra:
    def ratio(structure: Structure, values: Matrix) -> Vector:
        found = np.empty(values.shape[0])
        for i, row in enumerate(values):
            largest = 0.0
            for u in over.of(structure, row, "u"):
                if name == "rate_max":
                    u = np.diff(u, prepend=0.0) / (over.plants.dt * over.inputs.distance)
                largest = max(largest, float(np.max(np.abs(u))))
            found[i] = min(largest / limit, 1e6)
        return found

    return Extra(name, limit, ratio, over_time=True)


# ---- The problem of a round ----

# Step of the differences in the logarithms: between the rounding error of C_y, some 1e-12, and its
# curvature.
_DIFFERENCE = 1e-6


class _Values(NamedTuple):
    """Values of m controllers."""

    C: Complex  # at the points' frequencies (m, ω)
    extras: Matrix  # slack of the constraints that are no bounds over frequency (m, e)
    rules: Matrix  # (m, r)
    damping: Matrix  # slack of the poles that are followed (m, d)
    cost: Vector  # (m,)

    def with_more(self, others: _Values) -> _Values:
        """Return the values of these controllers and of others."""
        return _Values._make(map(np.concatenate, zip(self, others, strict=True)))


class FiniteProblem:
    """Cost and constraints at points, as functions of the logarithms x (p,) of the parameters."""

    def __init__(
        self, problem: Problem, structure: Structure, points: Points, followed: Followed, x: Vector
    ) -> None:
        self._problem, self._structure, self._points = problem, structure, points
        self._followed = followed
        # No step, then one along each parameter.
        self._steps = _DIFFERENCE * np.eye(x.size + 1, x.size, -1)
        self._x, self._values = x.tobytes(), self._values_at(x + self._steps)
        self._slopes: tuple[Vector, Matrix] | None = None

    def cost(self, x: Vector) -> float:
        """Return the cost."""
        return float(self._at(x).cost[0])

    def constraints(self, x: Vector) -> Vector:
        """Return the constraints (k,), which must not be negative."""
        found = self._at(x)
        rest = found.extras[0], found.rules[0], found.damping[0]
        return np.concatenate([slacks(self._points, found.C[0]), *rest])

    def slope_of_cost(self, x: Vector) -> Vector:
        """Return the derivatives of the cost (p,)."""
        return self._slopes_at(x)[0]

    def slopes_of_constraints(self, x: Vector) -> Matrix:
        """Return the derivatives of the constraints (k, p)."""
        return self._slopes_at(x)[1]

    def _at(self, x: Vector) -> _Values:
        """Return the values at x, which are asked for in turn, and at some steps from there."""
        if x.tobytes() != self._x:
            is_first = self._slopes is not None
            # Not a single row: it would have other rounding, by a routine of BLAS of its own.
            steps = self._steps if is_first else self._steps[:2]
            self._x, self._values, self._slopes = x.tobytes(), self._values_at(x + steps), None
        return self._values

    def _slopes_at(self, x: Vector) -> tuple[Vector, Matrix]:
        found = self._at(x)
        if self._slopes is None:
            left = self._steps[len(found.cost) :]
            if left.size:
                found = self._values = found.with_more(self._values_at(x + left))
            C, extras, rules, damping, cost = ((each[1:] - each[0]) / _DIFFERENCE for each in found)
            bounds = slopes_of_slacks(self._points, found.C[0], C)
            self._slopes = cost, np.vstack([bounds, extras.T, rules.T, damping.T])
        return self._slopes

    def _values_at(self, x: Matrix) -> _Values:
        values, structure = np.exp(x), self._structure
        ratios = [extra.ratio(structure, values) for extra in self._problem.extras]
        return _Values(
            structure.response(values, self._points.omega),
            1.0 - np.reshape(ratios, (len(ratios), len(values))).T,
            structure.rules(values),
            self._followed.slacks(structure, values),
            self._problem.cost(structure, values),
        )


# ---- Parameters that a search has come to ----

# Peaks above this ratio to their bound are refined.
_PEAK = 0.93


class Iterate:
    """The parameters with the logarithms x (p,)."""

    def __init__(self, problem: Problem, structure: Structure, x: Vector) -> None:
        self._problem, self._structure, self.x = problem, structure, x
        self._values = np.exp(x)[None, :]

    @cached_property
    def _response(self) -> Complex:
        """The controller on the grid (1, G)."""
        return self._structure.response(self._values, self._problem.plants.omega)

    @cached_property
    def _sizes(self) -> list[Matrix]:
        """|S|, |T| or |C S| (J, G) for each bound."""
        P, C = self._problem.plants.P, self._response[0]
        return [sizes(kind, P, C) for kind, _ in self._problem.bounds]

    @cached_property
    def _poles(self) -> list[Complex]:
        """All poles of the loop with each plant, where the search needs them; else none."""
        problem = self._problem
        if problem.damping is None and not problem.plants.resonant:
            return []
        return closed_loop_poles(problem.plants, self._structure, self._values[0])

    @cached_property
    def counted(self) -> list[Pole]:
        """The poles whose damping is bounded."""
        if self._problem.damping is None:
            return []
        return counted(self._problem.plants, self._poles, self._problem.damping)

    @property
    def followed(self) -> Followed:
        """The poles near their bound or beyond it, as functions of the parameters."""
        return Followed(self._problem.plants, self.counted)

    @cached_property
    def peaks(self) -> list[tuple[int, Peak]]:
        """The refined peaks near or above their bounds, each with the number of its bound."""

        def controller(omega: Vector) -> Complex:
            return self._structure.response(self._values, omega)[0]

        plants = self._problem.plants
        beside = beside_poles(plants, self._poles)
        C = self._response[0]
        return all_peaks(self._problem.bounds, plants, controller, C, beside, _PEAK)

    @cached_property
    def stable(self) -> bool:
        """Whether the loops with all plants are stable."""
        if self._poles:
            return all(bool(np.all(s.real < 0.0)) for s in self._poles)
        poles, count = self._structure.unstable_poles(self._values), self._structure.integrators
        found = self._problem.plants.unstable_loops(
            self._response, poles, count, self._structure.on_circle(self._values)
        )
        return bool(np.all(found < 0.5))

    @cached_property
    def cost(self) -> float:
        """The cost."""
        return float(self._problem.cost(self._structure, self._values)[0])

    @cached_property
    def violation(self) -> float:
        """The largest ratio to a limit, less one; zero if all are kept to."""
        ratios = [peak.value for _, peak in self.peaks]
        extras = self._problem.extras
        ratios += [float(each.ratio(self._structure, self._values)[0]) for each in extras]
        ratios += (1.0 - self._structure.rules(self._values)[0]).tolist()
        ratios += [pole.ratio for pole in self.counted]
        return max(max([ratio - 1.0 for ratio in ratios], default=0.0), 0.0)

    def points(self, least: float, more: list[tuple[int, Peak]]) -> Points:
        """Return the points of the grid with ratios above ``least``, and ``more`` ones."""
        plants = self._problem.plants
        kinds, members, places = [], [], []
        for number, (bound, size) in enumerate(zip(self._problem.bounds, self._sizes, strict=True)):
            j, i = np.nonzero(size > least * bound.limit)
            kinds.append(np.full(j.size, number))
            members.append(j)
            places.append(plants.omega[i])
        kinds.append(np.array([number for number, _ in more], dtype=int))
        members.append(np.array([peak.plant for _, peak in more], dtype=int))
        places.append(np.array([peak.omega for _, peak in more]))
        kind, member = np.concatenate(kinds), np.concatenate(members)
        omega, at = np.unique(np.concatenate(places), return_inverse=True)
        if omega.size == 0:  # far from all bounds
            omega, at = plants.omega[:1], np.zeros(1, dtype=int)
            kind, member = np.zeros(1, dtype=int), np.zeros(1, dtype=int)
        P = plants.responses_of(omega[at], member)
        return points_of(self._problem.bounds, kind, P, at, omega)


# ---- Starts of the search ----

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
    count = np.full(gains.size, poles)
    on_circle = np.repeat(structure.on_circle(row[None, :]), gains.size, axis=0)
    good = plants.stable_rows(tried, count, structure.integrators, on_circle)
    ratio = worst_ratio(problem.bounds, plants, tried[good])
    good, ratio = good[np.isfinite(ratio)], ratio[np.isfinite(ratio)]
    values = np.repeat(row[None, :], good.size, axis=0)
    values[:, 0] = gains[good] ** structure.gain_power
    cost = problem.cost(structure, values) if values.size else np.zeros(0)
    if structure.may_swing and values.size:
        swing = load_swing(plants, tried[good], structure.integral_gain(values))
        ratio = np.maximum(ratio, swing / MOST_SWING)
    return values, cost, ratio


# ---- The optimiser ----

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
_EXCESS_SEARCH = 20.0
# Rounds end when the objective changes by less, and the quadratic programs at the tolerance. Optima
# are flat: a share of 1e-4 of the objective is 1 to 2 % of the parameters. With few parameters,
# which are worth to be known, the search goes on.
_SETTLED, _TOLERANCE = 1e-4, 1e-7
# With limits of responses over time, which are slow, a search that exceeds a limit by more than
# this share, and whose merit changes by less, ends, too: no step leads to what keeps it.
_FAR, _STALLED = 1e-2, 1e-2
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
    return point.cost + _EXCESS_SEARCH * point.violation


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
    slow = any(extra.over_time for extra in problem.extras)
    last = last_merit = math.inf
    few = not roughly and _is_precise(problem, structure)
    settled = _SETTLED_OF_FEW if few else _SETTLED
    allowed = _SETTLED_OF_FEW if few else _VIOLATION
    for i in range(rounds):
        if best is None or merit(now) < merit(best):
            best = now
        if i == rounds - 1 or (now.violation <= allowed and abs(last - now.cost) < settled):
            break
        if slow and now.violation > _FAR and abs(last_merit - merit(now)) < _STALLED:
            break
        last, last_merit = now.cost, merit(now)
        extra_points = (extra_points + now.peaks)[-400:]
        points = now.points(_NEAR if i < _EARLY_ROUNDS else _NEARER, extra_points)
        bounds = list(zip(np.maximum(low, now.x - box), np.minimum(high, now.x + box), strict=True))
        tolerance = _TOLERANCE_OF_FEW if few else _TOLERANCE
        near = FiniteProblem(problem, structure, points, now.followed, now.x)
        x = _quadratic_programming(near, now.x, bounds, tolerance)
        after = None if x is None else Iterate(problem, structure, x)
        if after is None or not after.stable:
            box *= _SHRINK
            last_merit = math.inf  # the same point again, in a smaller box
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
