"""A translated Python expression: its kind, its C code, its value where that is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, TypeAlias

# Levels of precedence in C; a larger one binds more strongly.
TERNARY, OR, AND, BIT_OR, BIT_XOR, BIT_AND, EQUAL, LESS, SHIFT, SUM, PRODUCT, UNARY, ATOM = range(
    13
)


class TranslationError(ValueError):
    """A kernel uses something that has no counterpart in the C code."""


class Number(Enum):
    """The kind of a number, in the order of Python's promotion."""

    BOOL = 0
    INT = 1
    REAL = 2


class Unknown:
    """The constant of an expression whose value is not known before the program runs."""

    def __repr__(self) -> str:
        return "UNKNOWN"


UNKNOWN = Unknown()


@dataclass(frozen=True)
class Array:
    """An array with known shape, of one or two dimensions."""

    shape: tuple[int, ...]
    element: Number

    @property
    def size(self) -> int:
        """Number of elements."""
        size = 1
        for length in self.shape:
            size *= length
        return size


@dataclass(frozen=True)
class Struct:
    """A C struct; ``name`` is unique for its fields and the constants in it."""

    name: str
    python: type
    empty: bool


@dataclass(frozen=True)
class Several:
    """The values of a tuple, which are ``Value.items`` where they are known one by one."""

    kinds: tuple[Any, ...]


class Nothing:
    """The kind of a call that returns nothing."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Nothing)

    def __hash__(self) -> int:
        return 0


NOTHING = Nothing()

Kind: TypeAlias = Number | Array | Struct | Several | Nothing


@dataclass(frozen=True)
class Value:
    """A translated expression."""

    kind: Any
    code: str = ""
    level: int = ATOM
    constant: Any = UNKNOWN
    # For arrays and structs: the parameter of the function through which they are reached, and
    # whether they belong to the state.
    root: str = ""
    mutable: bool = False
    pointer: bool = True  # whether the code of a struct is a pointer to it
    items: tuple[Any, ...] = ()
    calls: bool = False  # whether a function is called
    member: tuple[str, str] | None = None  # struct and field of a number whose kind is assumed
    whole: Any = None  # for 1.0 or 0.0 by a condition: the condition

    @property
    def is_constant(self) -> bool:
        """Whether the value is known now."""
        return self.constant is not UNKNOWN

    @property
    def is_number(self) -> bool:
        """Whether it is a number."""
        return isinstance(self.kind, Number)

    @property
    def address(self) -> str:
        """The code of a pointer to a struct."""
        return self.code if self.pointer else f"&{self.code}"

    def at(self, level: int) -> str:
        """Return the code, in parentheses if it binds less strongly than ``level``."""
        return self.code if self.level >= level else f"({self.code})"

    def named(self, code: str) -> Value:
        """Return the value that a local variable ``code`` has after it was set to this one."""
        return replace(
            self, code=code, level=ATOM, constant=UNKNOWN, pointer=True, calls=False, member=None
        )


def is_empty(value: Value) -> bool:
    """Return whether nothing of the value exists in C."""
    kind = value.kind
    if isinstance(kind, Array):
        return kind.size == 0
    return isinstance(kind, Struct) and kind.empty


def join(one: Kind, other: Kind, what: str) -> Kind:
    """Return the kind that holds values of both kinds."""
    if one == other:
        return one
    if isinstance(one, Number) and isinstance(other, Number):
        return max(one, other, key=lambda number: number.value)
    raise TranslationError(f"{what} has values of different kinds: {one} and {other}")


def join_numbers(one: Value, other: Value, what: str) -> Number:
    """Return the kind that holds two numbers."""
    found = join(one.kind, other.kind, what)
    if isinstance(found, Number):
        return found
    raise TranslationError(f"{what}: {one.code or other.code} is not a number")
