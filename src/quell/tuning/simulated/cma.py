"""Covariance matrix adaptation (CMA-ES) as a sampler of Optuna, without a state of its own.

Hansen, *The CMA Evolution Strategy: A Tutorial* (arXiv 1604.00772), as implemented by the package
``cmaes``. Optuna's own ``CmaEsSampler`` stores pickled objects among the trials and loads them;
this one repeats the finished generations from their parameters and values, which takes
milliseconds. So a search continues from its journal alone, and nothing is unpickled.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from quell.optional import import_extra
from quell.tuning.simulated.space import SearchRange, Space
from quell.types import Vector

# First standard deviation in units of the ranges: the tutorial recommends about 0.3 of a range in
# which the optimum is expected to lie anywhere; ranges here are wide, around a start.
_SIGMA = 0.2
_LARGEST = 1e300  # in place of infinity


class Generations:
    """Generations of CMA-ES over a space, from trials that are finished.

    Parameters
    ----------
    space
        the ranges; each is a coordinate from 0 to 1.
    start
        values of the first generation's mean; by default the middle of the ranges.
    """

    def __init__(self, space: Space, start: Mapping[str, float] | None = None) -> None:
        self.space = space
        self.start = np.full(len(space), 0.5) if start is None else self._coordinates(start)
        self._cma = import_extra("cmaes", "tuning", "the sampler cma").CMA

    def after(self, study: Any) -> Any:
        """Return the strategy after the finished trials of a study, in the order of their numbers.

        A trial that was given up has no value to compare: it comes last in its generation.
        """
        told = []
        for trial in study.get_trials(deepcopy=False):
            if trial.state.is_finished() and set(self.space) <= set(trial.params):
                value = float(trial.value) if trial.state.name == "COMPLETE" else math.inf
                # The strategy compares values only, so any number that keeps their order serves.
                told.append((self._coordinates(trial.params), min(value, _LARGEST)))
        bounds = np.tile([0.0, 1.0], (len(self.space), 1))
        strategy = self._cma(mean=self.start.copy(), sigma=_SIGMA, bounds=bounds, seed=0)
        size = strategy.population_size
        for first in range(0, len(told) - size + 1, size):
            strategy.tell(told[first : first + size])
        return strategy

    def suggested(self, strategy: Any, seed: int) -> dict[str, float]:
        """Return the values of a new trial."""
        strategy.reseed_rng(seed)
        # A point may be beyond an end of a range by rounding.
        point = np.clip(strategy.ask(), 0.0, 1.0)
        pairs = zip(self.space.items(), point.tolist(), strict=True)
        return {name: value_at(each, share) for (name, each), share in pairs}

    def _coordinates(self, values: Mapping[str, float]) -> Vector:
        return np.array([share_of(each, values[name]) for name, each in self.space.items()])


def value_at(each: SearchRange, share: float) -> float:
    """Return the value at a share of a range, rounded to a whole number if it must be one."""
    if each.is_logarithmic:
        value = math.exp(math.log(each.low) + share * math.log(each.high / each.low))
    else:
        value = each.low + share * (each.high - each.low)
    value = float(round(value)) if each.whole else value
    return min(max(value, each.low), each.high)


def share_of(each: SearchRange, value: float) -> float:
    """Return the share of a range at which a value lies."""
    if each.is_logarithmic:
        return math.log(value / each.low) / math.log(each.high / each.low)
    return (value - each.low) / (each.high - each.low)
