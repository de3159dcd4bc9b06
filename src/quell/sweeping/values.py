"""The values of a sweep's parameters: ranges, normal distributions, lists."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from quell import checks
from quell.types import Matrix, Vector


@runtime_checkable
class Distribution(Protocol):
    """A distribution to draw from: ``Range``, ``Normal``, or one of ``scipy.stats``."""

    def ppf(self, q: Vector) -> Vector:
        """Return the quantiles of the probabilities ``q``, the inverse of its distribution."""


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``: drawn, or ``steps`` of them at equal distances.

    Parameters
    ----------
    low, high
        least and largest value.
    steps
        number of values from ``low`` to ``high``, both included, that are combined with those of
        all other parameters; None to draw the values from a uniform distribution.
    log
        whether distances are equal, or the distribution is uniform, on a logarithmic scale.

    Raises
    ------
    ValueError
        if ``low`` is not less than ``high``, is not positive on a logarithmic scale, or there are
        fewer than two steps.
    """

    low: float
    high: float
    steps: int | None = None
    log: bool = False

    def __post_init__(self) -> None:
        checks.finite("low", self.low)
        checks.finite("high", self.high)
        checks.interval("low", self.low, "high", self.high)
        checks.optional(checks.whole, "steps", self.steps, 2)
        if checks.flag("log", self.log) and self.low <= 0.0:
            rule = "must be greater than zero on a logarithmic scale"
            raise ValueError(f"low = {self.low!r}: {rule}")

    def ppf(self, q: Vector) -> Vector:
        """Return the values at the shares ``q`` of the way from ``low`` to ``high``."""
        low, high = float(self.low), float(self.high)
        if self.log:
            return np.clip(low * (high / low) ** np.asarray(q), low, high)
        return np.clip(low + (high - low) * np.asarray(q), low, high)


@dataclass(frozen=True)
class Normal:
    """Numbers of a normal distribution.

    Parameters
    ----------
    mean, std
        mean and standard deviation.

    Raises
    ------
    ValueError
        if the mean is not finite, or the deviation is not positive.
    """

    mean: float
    std: float

    def __post_init__(self) -> None:
        checks.finite("mean", self.mean)
        checks.positive("std", self.std)

    def ppf(self, q: Vector) -> Vector:
        """Return the quantiles of the probabilities ``q``."""
        from scipy.special import ndtri

        return np.asarray(self.mean + self.std * ndtri(np.asarray(q)))


def latin_hypercube(rng: np.random.Generator, count: int, size: int) -> Matrix:
    """Return points (count, size) of the unit cube, one in each stratum of width 1/count.

    McKay, Beckman & Conover, *Technometrics* 21, 1979. That of ``scipy.stats`` does the same; its
    import takes 45 MB and a second, and its arguments depend on the version.
    """
    shares = rng.random((count, size))
    for column in shares.T:
        column += rng.permutation(count)
    return shares / count


def as_values(name: str, given: Any) -> Distribution | tuple[Any, ...]:
    """Return a distribution, or the tuple of all values of the parameter ``name``.

    A single value, such as a number, a text or a table, is the only one.
    """
    if isinstance(given, Range) and given.steps is not None:
        return tuple(given.ppf(np.linspace(0.0, 1.0, given.steps)).tolist())
    if isinstance(given, Distribution) and not isinstance(given, type):
        return given
    if isinstance(given, np.ndarray):
        given = given.tolist()
    values = tuple(given) if checks.is_sequence(given) else (given,)
    if not values:
        raise ValueError(f"parameters[{name!r}] is empty: must have at least one value")
    if all(map(_is_number, values)):
        return tuple(checks.finite(f"parameters[{name!r}]", value) and value for value in values)
    return values


def labels(values: Sequence[Any]) -> list[str] | None:
    """Return texts for values that are not all numbers, in tables and files; None for numbers."""
    if all(map(_is_number, values)):
        return None
    found = [_label(value) for value in values]
    return [
        text if found.count(text) == 1 else f"{text} ({found[:i].count(text) + 1})"
        for i, text in enumerate(found)
    ]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool | np.bool_)


def _label(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, str):
        return value
    if isinstance(value, bool | np.bool_):
        return str(bool(value)).lower()
    if isinstance(value, Mapping | list | tuple):
        try:
            return json.dumps(value)
        except (TypeError, ValueError):
            return type(value).__name__
    if isinstance(value, int | float | np.number):
        return f"{value:g}"
    return str(getattr(value, "__name__", None) or type(value).__name__)
