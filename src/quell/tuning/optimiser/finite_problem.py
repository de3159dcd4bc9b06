"""The problem of a round: cost and finitely many constraints, with their derivatives.

Derivatives are differences: the values of one more controller for each parameter. SLSQP asks for
them at those trials of its line search only that it takes: of a stiff problem a sixth. The first
trial of a line search is mostly taken, so the other controllers come along there; at later trials
they are left out until they are asked for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.analysis.frequency_response import Complex
from quell.tuning.optimiser.damping import Followed
from quell.tuning.optimiser.problem import Problem
from quell.tuning.optimiser.requirements import Points, slacks, slopes_of_slacks
from quell.tuning.structures.base import Structure
from quell.types import Matrix, Vector

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
        self,
        problem: Problem,
        structure: Structure,
        points: Points,
        followed: Followed,
        x: Vector,
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
