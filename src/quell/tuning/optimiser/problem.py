"""A problem of the optimiser, and its solution."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quell.controllers.base import Controller
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.optimiser.requirements import Bound
from quell.tuning.structures.base import Structure
from quell.types import Matrix, Vector

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
