"""The local variables of a function in C.

A variable that has the same known value wherever it is set does not exist in C. That is assumed of
every variable; where it proves wrong, ``Assumptions`` keeps that, and the function is translated
again. The same holds for the kind of a number: an integer that is real elsewhere is real.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from quell.export.translate.blocks import Block, Line
from quell.export.translate.expressions import Expressions
from quell.export.translate.naming import identifier
from quell.export.translate.source import Source
from quell.export.translate.values import (
    Number,
    Several,
    Struct,
    TranslationError,
    Value,
    is_empty,
    join,
    join_numbers,
)


class WrongAssumptionError(Exception):
    """An assumption about a local variable was wrong: the body must be translated again."""


@dataclass
class Assumptions:
    """Local variables that are not as assumed."""

    varying: set[str] = field(default_factory=set)  # variables that are not always the same
    kinds: dict[str, Number] = field(default_factory=dict)  # of numbers with several kinds

    def fail_as_varying(self, name: str) -> None:
        """Note that a variable is not always the same, and end this translation."""
        self.varying.add(name)
        raise WrongAssumptionError

    def fail_as(self, name: str, kind: Number) -> None:
        """Note the kind of a number, and end this translation."""
        self.kinds[name] = kind
        raise WrongAssumptionError


class Variables:
    """The variables of one function; ``expressions`` has the values of their names."""

    def __init__(
        self,
        expressions: Expressions,
        source: Source,
        arguments: dict[str, Value],
        assumptions: Assumptions,
    ) -> None:
        self.expressions, self.assumptions = expressions, assumptions
        self.program = expressions.program
        self.names = expressions.names
        self.names.update(arguments)
        self.local: dict[str, Value] = {}  # what the variables that exist in C were set to first
        self._parameters = set(arguments)
        self._taken = set(source.occurring)

    def fresh(self, name: str) -> str:
        """Return a name that no variable of the function has, for another one."""
        found, number = name, 2
        while found in self._taken or found in self.names:
            found, number = f"{name}{number}", number + 1
        self._taken.add(found)
        return found

    def set(self, name: str, value: Value, block: Block) -> None:
        """Set a variable, by a line in ``block`` if it exists in C."""
        if self._is_always_same(name, value) or is_empty(value):
            self.names[name] = value
        elif value.is_number:
            self._set_number(name, value, block)
        else:
            self._set_reference(name, value, block)

    def _is_always_same(self, name: str, value: Value) -> bool:
        """Return whether a variable has had this known value only, as far as is known."""
        before = self.names.get(name)
        if name not in self.assumptions.varying and value.is_constant and name not in self.local:
            if before is not None and not (before.is_constant and same_constant(before, value)):
                self.assumptions.fail_as_varying(name)
            return True
        if before is not None and before.is_constant and name not in self.assumptions.varying:
            self.assumptions.fail_as_varying(name)
        return False

    def _c_name(self, name: str) -> str:
        """Return the C name of a variable, which must not be that of a function."""
        variable = identifier(name)
        return f"{variable}_" if self.program.has_function(variable) else variable

    def _set_number(self, name: str, value: Value, block: Block) -> None:
        kind = self.assumptions.kinds.get(name, value.kind)
        known = self.local.get(name, self.names.get(name))
        before = kind if known is None else known.kind
        joined = join_numbers(Value(join(before, kind, name)), value, name)
        if joined is not kind or (name in self.local and joined is not before):
            self.assumptions.fail_as(name, joined)
        value, variable = self.expressions.as_kind(value, joined), self._c_name(name)
        if value.code == variable:  # x = x
            return
        if name not in self._parameters:
            self.local[name] = replace(value, kind=joined)
        self.names[name] = Value(joined, variable)
        block.append(Line(value.code, variable, calls=value.calls))

    def _set_reference(self, name: str, value: Value, block: Block) -> None:
        """Set a variable to an array, a struct or the result of a call."""
        where = f"{self.expressions.where}: {name}"
        if isinstance(value.kind, Several):
            raise TranslationError(f"{where}: a tuple must be unpacked")
        before = self.local.get(name)
        if before is not None and before.kind != value.kind:
            raise TranslationError(f"{where} refers to different arrays")
        is_result = value.code.split("(")[0] in self.program.results and value.calls
        self.local[name], variable = value, self._c_name(name)
        self.names[name] = replace(value.named(variable), pointer=not is_result)
        code = value.address if isinstance(value.kind, Struct) and not is_result else value.code
        block.append(Line(code, variable, calls=value.calls))


def same_constant(one: Value, other: Value) -> bool:
    """Return whether two known values are the same, not-a-number included."""
    return same_number(one.constant, other.constant)


def same_number(one: Any, other: Any) -> bool:
    """Return whether two numbers are of one type and equal, or both not a number."""
    return type(one) is type(other) and (one == other or (one != one and other != other))
