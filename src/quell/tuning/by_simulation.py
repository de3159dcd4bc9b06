"""Tuning of a structure by simulation, around a start such as the optimum of the linear loop."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.base import Controller
from quell.tuning.simulated import Problem, Range, Search, search
from quell.tuning.structures.base import Structure

# Ranges around the start: a factor either way. Chosen by hand.
_WIDE = 10.0
# Share of a range's ends by which a value may be beyond them through rounding.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Build:
    """Builds the controllers of a structure, within its rules; ``search`` calls it."""

    structure: Structure
    limits: Mapping[str, Any] = field(default_factory=dict)

    def vector(self, values: Mapping[str, float]) -> Any:
        """Return the values in the order of the structure's parameters (p,)."""
        return np.array([values[parameter.name] for parameter in self.structure.parameters])

    def __call__(self, values: Mapping[str, float]) -> Controller:
        """Return the controller; raise a ``ValueError`` for values against the rules."""
        row = self.vector(values)
        if np.any(self.structure.rules(row[None, :]) < 0.0):
            raise ValueError(f"values {dict(values)!r}: are against the rules of the structure")
        return self.structure.controller(row, **self.limits)


def tune_structure(
    build: Build,
    problem: Problem,
    start: Mapping[str, float],
    *,
    factor: float = _WIDE,
    **options: Any,
) -> Search:
    """Search a structure's parameters around a start.

    Parameters
    ----------
    build
        the structure, and limits of u.
    problem
        what is minimised.
    start
        values of all parameters.
    factor
        the ranges go from a value over ``factor`` to the value times it, within the structure's
        bounds.
    **options
        as for ``search``.
    """
    if checks.finite("factor", factor) <= 1.0:
        raise ValueError(f"factor = {factor!r}: must be above 1")
    space = _around(build.structure, start, factor)
    return search(build, space, problem, starts=[start], **options)


def _around(structure: Structure, values: Mapping[str, float], factor: float) -> dict[str, Range]:
    """Return the ranges around values, within the structure's bounds."""
    found = {}
    for name, _, low, high in structure.parameters:
        value, low, high = (float(x) for x in (values.get(name, math.nan), low, high))
        if not (1.0 - _ROUNDING) * low <= value <= (1.0 + _ROUNDING) * high:
            raise ValueError(f"start: {name} = {value!r}: must lie within {low:g} … {high:g}")
        ends = max(low, value / factor), min(high, value * factor)
        found[name] = Range(min(ends[0], value), max(ends[1], value))
    return found
