"""The variables of an exported FMU, with their value references."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

INPUT, OUTPUT, LOCAL, FIXED, TUNABLE = "input", "output", "local", "fixed", "tunable"


class Variable(NamedTuple):
    """A variable; its value reference is its place in the list of all."""

    name: str
    role: str
    description: str
    start: float = 0.0  # of inputs and parameters
    unit: str = ""
    held: bool = False  # whether it is constant between samples
    whole: bool = False  # whether it is an integer

    @property
    def constant(self) -> str:
        """Name of the C constant for its place: ``AT_X_HAT_1`` for ``x_hat[1]``."""
        return "AT_" + re.sub(r"\W+", "_", self.name).strip("_").upper()


TIME = Variable("time", "independent", "time", unit="s")


def ordered(variables: Iterable[Variable]) -> tuple[Variable, ...]:
    """Return the time and the variables, integers last."""
    given = (TIME, *variables)
    return tuple(sorted(given, key=lambda variable: variable.whole))


def several(
    name: str,
    count: int,
    role: str,
    description: str,
    starts: Sequence[float] = (),
    held: bool = False,
) -> list[Variable]:
    """Return ``count`` variables ``name[1]``, ``name[2]`` …; "{i}" in the description counts."""
    return [
        Variable(
            f"{name}[{i + 1}]",
            role,
            description.format(i=i + 1),
            starts[i] if starts else 0.0,
            held=held,
        )
        for i in range(count)
    ]


def number(value: float) -> str:
    """Return a number for XML: INF and NaN are those of XML Schema."""
    if math.isfinite(value):
        return repr(float(value))
    return "NaN" if math.isnan(value) else "INF" if value > 0 else "-INF"
