"""The ranges in which a search varies parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from quell import checks


@dataclass(frozen=True)
class SearchRange:
    """The range of one parameter.

    Parameters
    ----------
    low, high
        its ends, which are allowed values.
    log
        whether the search moves in its logarithm; by default for a range above zero.
    whole
        whether only whole numbers are allowed.

    Raises
    ------
    ValueError
        for ends that are not finite or not in order, or a logarithm of numbers that are not above
        zero.
    """

    low: float
    high: float
    log: bool | None = None
    whole: bool = False

    def __post_init__(self) -> None:
        low, high = checks.finite("low", self.low), checks.finite("high", self.high)
        if not low < high:
            raise ValueError(f"low = {low!r}, high = {high!r}: low must be below high")
        if self.log and low <= 0.0:
            raise ValueError(f"low = {low!r}: must be above zero in a logarithmic range")
        if self.whole and (int(low) != low or int(high) != high):
            raise ValueError(f"low = {low!r}, high = {high!r}: must be whole numbers")

    @property
    def is_logarithmic(self) -> bool:
        """Whether the search moves in the logarithm."""
        return self.low > 0.0 if self.log is None else self.log

    def suggested(self, trial: Any, name: str) -> float:
        """Return the value that a trial of Optuna suggests for the parameter ``name``."""
        if self.whole:
            low, high = int(self.low), int(self.high)
            return float(trial.suggest_int(name, low, high, log=self.is_logarithmic))
        return float(trial.suggest_float(name, self.low, self.high, log=self.is_logarithmic))


Space = Mapping[str, SearchRange]
"""The ranges of all parameters, by name."""


def checked_space(space: Any) -> Space:
    """Return ``space`` if it maps names to ranges and is not empty."""
    if not isinstance(space, Mapping) or not space:
        raise ValueError(
            f"space = {space!r}: must be a dictionary of at least one SearchRange, by name"
        )
    for name, value in space.items():
        if not isinstance(value, SearchRange):
            raise ValueError(f"space[{name!r}] = {value!r}: must be a SearchRange(low, high)")
    return space


def checked_start(space: Space, start: Mapping[str, float]) -> dict[str, float]:
    """Return a start of the search, if it has a value within the range of each parameter."""
    if set(start) != set(space):
        names = ", ".join(space)
        raise ValueError(f"starts has {sorted(start)}: each start must have a value for {names}")
    for name, value in start.items():
        low, high = space[name].low, space[name].high
        if not low <= checks.finite(f"starts: {name}", value) <= high:
            raise ValueError(f"starts: {name} = {value!r}: must lie within {low:g} … {high:g}")
    return {name: float(start[name]) for name in space}
