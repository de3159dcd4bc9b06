"""The variables of an FMU that a loop reads and writes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from quell import checks
from quell.warn import warn

_REAL = ("Real", "Float32", "Float64")
_WHOLE = ("Integer", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")
_SETTABLE = ("parameter", "structuralParameter", "input")


class Port(NamedTuple):
    """A variable with the functions of FMPy that get and set its type."""

    name: str
    reference: int
    type: str  # part of FMPy's names: getFloat64, setFloat64


class Ports(NamedTuple):
    """Variables that a loop reads and writes at each sample."""

    inputs: tuple[Port, ...]  # u, and then the disturbances
    outputs: tuple[Port, ...]  # y, and then the further states


class Start(NamedTuple):
    """A start value, of a type that FMPy sets."""

    port: Port
    value: Any
    structural: bool  # only to be set in configuration mode


class Variables:
    """The variables of an FMU, of FMI 2.0 if ``old``, by name; errors begin with ``where``."""

    def __init__(self, description: Any, where: str, old: bool) -> None:
        self._where = where
        self._old = old
        self._by_name = {variable.name: variable for variable in description.modelVariables}

    def ports(self, u: str | None, y: str | None, w: Sequence[str], states: Sequence[str]) -> Ports:
        """Return the variables of a loop; see ``FMU`` for the defaults.

        Raises
        ------
        ValueError
            for names that the FMU has not, or not with this purpose.
        """
        disturbances = [self._input(f"w[{i}]", name) for i, name in enumerate(w)]
        others = [name for name in self._named("input") if name not in w]
        first = self._input("u", self._only("u", u, others))
        inputs = (first, *disturbances)
        if len({port.reference for port in inputs}) < len(inputs):
            raise ValueError(f"{self._where}: u and w name one variable twice")
        output = self._output("y", self._only("y", y, self._named("output")))
        more = [self._output(f"states[{i}]", name) for i, name in enumerate(states)]
        return Ports(inputs, (output, *more))

    def starts(self, values: Mapping[str, Any]) -> tuple[Start, ...]:
        """Return start values, of the types of their variables.

        Raises
        ------
        ValueError
            for names that the FMU has not, variables that can't be set, and values of other types.
        """
        return tuple(self._start(name, value) for name, value in values.items())

    def _named(self, causality: str) -> list[str]:
        """Return the names of the numbers with a causality."""
        kinds = _REAL if causality == "input" else (*_REAL, *_WHOLE)
        return [
            name
            for name, variable in self._by_name.items()
            if variable.causality == causality and variable.type in kinds and not variable.shape
        ]

    def _only(self, argument: str, name: str | None, candidates: list[str]) -> str:
        """Return the name that was given, the only candidate, or the one called as the argument."""
        if name is not None:
            return name
        if len(candidates) == 1:
            return candidates[0]
        if argument in candidates:
            return argument
        what = "input" if argument == "u" else "output"
        known = f"has {', '.join(candidates)}" if candidates else f"has no {what} that is a number"
        raise ValueError(f"{self._where}: {argument} is not given, and the FMU {known}: name one")

    def _variable(self, argument: str, name: Any) -> Any:
        if not isinstance(name, str) or name not in self._by_name:
            rule = checks.nearest(str(name), [*self._by_name]) if self._by_name else "it has none"
            raise ValueError(f"{self._where}: {argument} = {name!r}: no variable of it; {rule}")
        variable = self._by_name[name]
        if variable.shape:
            raise ValueError(f"{self._where}: {argument} = {name!r}: must be one number, no array")
        return variable

    def _input(self, argument: str, name: Any) -> Port:
        variable = self._variable(argument, name)
        if variable.causality != "input" or variable.type not in _REAL:
            raise ValueError(
                f"{self._where}: {argument} = {name!r}: is {variable.causality} of type "
                f"{variable.type}; must be an input that is a real number"
            )
        return self._port(variable)

    def _output(self, argument: str, name: Any) -> Port:
        variable = self._variable(argument, name)
        if variable.type not in (*_REAL, *_WHOLE):
            raise ValueError(
                f"{self._where}: {argument} = {name!r}: is of type {variable.type}; must be a "
                "number"
            )
        return self._port(variable)

    def _port(self, variable: Any) -> Port:
        kind = variable.type
        if kind == "Enumeration":
            kind = "Integer" if self._old else "Int64"
        return Port(variable.name, variable.valueReference, kind)

    def _start(self, name: str, value: Any) -> Start:
        argument = f"start[{name!r}]"
        variable = self._variable("start", name)
        settable = variable.causality in _SETTABLE or variable.initial in ("exact", "approx")
        if variable.variability == "constant" or not settable:
            raise ValueError(
                f"{self._where}: {argument}: is {variable.variability} {variable.causality}; must "
                "be a parameter, an input, or a variable with a start value"
            )
        structural = variable.causality == "structuralParameter"
        port = self._port(variable)
        return Start(port, self._value(argument, variable.type, value), structural)

    def _value(self, argument: str, kind: str, value: Any) -> Any:
        if kind in _REAL:
            return checks.finite(argument, value)
        if kind in (*_WHOLE, "Enumeration"):
            return checks.whole(argument, value, *_range(kind))
        if kind == "Boolean":
            return checks.flag(argument, value)
        if kind != "String":
            raise ValueError(f"{self._where}: {argument}: is of type {kind}, which can't be set")
        if not isinstance(value, str):
            raise ValueError(f"{argument} = {value!r}: must be a text")
        return value


def _range(kind: str) -> tuple[int, int]:
    """Return the least and the largest number of a type such as ``UInt8``."""
    digits = kind.removeprefix("U").removeprefix("Int")
    bits = int(digits) if digits.isdigit() else 32  # Integer of FMI 2, Enumeration
    return (0, 2**bits - 1) if kind.startswith("U") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def warn_of_step(description: Any, dt: float, substeps: int, where: str) -> None:
    """Warn if ``dt/substeps`` [s] is no multiple of the internal step of an FMU of FMI 3.0."""
    fixed = getattr(description.coSimulation, "fixedInternalStepSize", None)
    try:
        internal = float(fixed or 0.0)
    except ValueError:
        internal = 0.0
    if not internal > 0.0:
        return
    ratio = dt / substeps / internal
    if round(ratio) < 1 or not math.isclose(ratio, round(ratio), rel_tol=1e-9):
        warn(
            f"{where}: dt/substeps = {dt / substeps!r} s is no multiple of the FMU's internal step "
            f"of {internal!r} s: its outputs are then those of an earlier time"
        )
