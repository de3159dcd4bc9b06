"""Parameters that a search has come to: what they cost and exceed, and whether loops are stable.

The controller's response on the grid is found once for all of it.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from quell.analysis.frequency_response import Complex
from quell.tuning.optimiser.damping import (
    Followed,
    Pole,
    beside_poles,
    closed_loop_poles,
    counted,
)
from quell.tuning.optimiser.loops import Peak
from quell.tuning.optimiser.problem import Problem
from quell.tuning.optimiser.requirements import Points, all_peaks, points_of, sizes
from quell.tuning.structures.base import Structure
from quell.types import Matrix, Vector

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
        return bool(np.all(self._problem.plants.unstable_loops(self._response, poles, count) < 0.5))

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
