"""Sets of plants from ranges of parameters, and the check of a result on fresh samples."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from quell import checks
from quell.sweeping.shares import share_interval
from quell.sweeping.values import latin_hypercube
from quell.tuning.optimiser.damping import beside_poles, closed_loop_poles, counted
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.optimiser.problem import Problem, Solution
from quell.tuning.optimiser.requirements import all_peaks
from quell.types import Matrix, Vector

# With more parameters, the corners of their box are not all in the set.
_MOST_CORNERS = 4
# A constraint counts as kept on a fresh sample up to this share beyond its limit: a result keeps to
# its limits within 0.1 %.
_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Uncertain:
    """Ranges of a plant's parameters.

    Parameters
    ----------
    make
        returns a plant for values of the parameters, by name.
    ranges
        lowest and highest value of each parameter.
    """

    make: Any  # Callable[..., Any]; checked below
    ranges: Mapping[str, tuple[float, float]]

    def __post_init__(self) -> None:
        if not self.ranges:
            raise ValueError("uncertain = {}: must have at least one parameter")
        if not callable(self.make):
            rule = "with uncertain it must be a function that returns a plant for its parameters"
            raise ValueError(f"plant = {self.make!r:.80}: {rule}")
        try:
            inspect.signature(self.make).bind(**self.ranges)
        except TypeError as error:
            raise ValueError(f"uncertain: plant can't be called with these: {error}") from None
        for name, ends in self.ranges.items():
            low, high = checks.vector(f"uncertain.{name}", ends, 2).tolist()
            if not low < high:
                raise ValueError(
                    f"uncertain.{name} = {ends!r}: must be [low, high], low below high"
                )

    @property
    def ends(self) -> Matrix:
        """Lowest and highest values (parameters, 2)."""
        return np.array([tuple(map(float, pair)) for pair in self.ranges.values()])

    def plants(self, values: Matrix) -> list[Any]:
        """Return a plant for each row of values (k, parameters)."""
        names = list(self.ranges)
        return [self.make(**dict(zip(names, row, strict=True))) for row in values.tolist()]

    def design_set(self, count: int, seed: int) -> Matrix:
        """Return the values to design for: the middle, the corners, a Latin hypercube."""
        ends = self.ends
        low, high = ends[:, 0], ends[:, 1]
        rows = [0.5 * (low + high)]
        if low.size <= _MOST_CORNERS:
            rows += [np.array(corner) for corner in itertools.product(*ends)]
        rest = count - len(rows)
        if rest > 0:
            cube = latin_hypercube(np.random.default_rng(seed), rest, low.size)
            rows += list(low + cube * (high - low))
        return np.array(rows)

    def fresh(self, count: int, seed: int) -> Matrix:
        """Return uniform values that the design did not have."""
        ends = self.ends
        draws = np.random.default_rng([seed, 1]).random((count, ends.shape[0]))
        found: Matrix = ends[:, 0] + draws * (ends[:, 1] - ends[:, 0])
        return found


@dataclass(frozen=True)
class Check:
    """A result on fresh samples of the plant.

    Attributes
    ----------
    samples
        number of plants.
    unstable, violating
        how many loops are unstable, and how many are, or exceed a limit.
    interval
        95 % interval of the share that violates (Clopper & Pearson 1934).
    worst
        largest measures of the stable loops, ``M_s``, …
    worst_values
        the parameters of the plant with the largest excess.
    """

    samples: int
    unstable: int
    violating: int
    interval: tuple[float, float]
    worst: Mapping[str, float]
    worst_values: Mapping[str, float]

    def __str__(self) -> str:
        """Return the check as a sentence."""
        low, high = (100.0 * end for end in self.interval)
        worst = ", ".join(f"{name} {value:.4g}" for name, value in self.worst.items())
        return (
            f"{self.samples} fresh samples: {self.violating} exceed a limit, {self.unstable} of "
            f"them unstable; a share of {low:.2g} to {high:.2g} % (95 % interval). Largest: {worst}"
        )


def checked(
    problem: Problem, solution: Solution, plants: PlantSet, values: Matrix, names: list[str]
) -> Check:
    """Return how a solution does on fresh plants; ``values`` (k, parameters) belong to them."""
    structure, row = solution.structure, solution.values[None, :]

    def controller(omega: Vector) -> Any:
        return structure.response(row, omega)[0]

    poles = closed_loop_poles(plants, structure, solution.values)
    unstable = np.array([bool(np.any(s.real >= 0.0)) for s in poles])
    ratio = np.zeros(len(plants.plants))
    worst = {}
    beside = beside_poles(plants, poles)
    C = controller(plants.omega)
    peaks = all_peaks(problem.bounds, plants, controller, C, beside, 0.5)
    for number, (kind, limit) in enumerate(problem.bounds):
        own = np.zeros(ratio.size)
        for of_bound, peak in peaks:
            if of_bound == number:
                own[peak.plant] = max(own[peak.plant], peak.value)
        if not np.all(unstable):
            worst[kind] = float(np.max(own[~unstable])) * limit
        ratio = np.maximum(ratio, own)
    if problem.damping is not None:
        for pole in counted(plants, poles, problem.damping):
            ratio[pole.plant] = max(ratio[pole.plant], pole.ratio)
    ratio[unstable] = np.inf
    bad = ratio > 1.0 + _TOLERANCE
    at = int(np.argmax(ratio)) % values.shape[0]
    return Check(
        samples=ratio.size,
        unstable=int(np.sum(unstable)),
        violating=int(np.sum(bad)),
        interval=share_interval(int(np.sum(bad)), ratio.size),
        worst=worst,
        worst_values=dict(zip(names, values[at].tolist(), strict=True)),
    )
