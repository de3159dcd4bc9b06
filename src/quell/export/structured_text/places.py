"""Names, types and values of Structured Text, while C code is translated to it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from quell.export.structured_text.c_reader import NO_TEXT, Braces, Expr
from quell.export.translate.text import TranslationError

# ---- Values and places ----


class Whole:
    """The type of an integer: flags (``DWORD``) or a count (``DINT``), known when all is read."""

    def __init__(self) -> None:
        self._same: Whole | None = None
        self._kind = ""

    def _root(self) -> Whole:
        return self if self._same is None else self._same._root()

    def unify(self, other: Whole) -> None:
        """Make both the same type."""
        one, two = self._root(), other._root()
        if one is not two:
            if one._kind and two._kind and one._kind != two._kind:
                raise TranslationError(f"an integer for flags and for counts: {NO_TEXT}")
            two._kind = two._kind or one._kind
            one._same = two

    def use(self, kind: str) -> None:
        """Say what it is used for: ``DWORD`` or ``DINT``."""
        known = Whole()
        known._kind = kind
        self.unify(known)

    @property
    def name(self) -> str:
        """The type in Structured Text."""
        return self._root()._kind or "DINT"


Kind = str | Whole  # "real", "bool", or an integer


class Node(NamedTuple):
    """An expression: its kind, its text, and how tightly it binds.

    It may be one variable (``is_atom``), or what never changes during a call (``is_fixed``).
    """

    kind: Kind
    text: Callable[[], str]
    level: int = 9
    is_atom: bool = False
    is_fixed: bool = False


class Array(NamedTuple):
    """An array, or a part of it behind leading indices and an offset of the next one."""

    name: str
    kind: Kind
    shape: tuple[int, ...]
    leading: tuple[Node, ...] = ()
    offset: Node | None = None


@dataclass
class Record:
    """A struct, whose members become variables when they are first used."""

    struct: str
    prefix: str
    section: str
    values: Braces | None = None  # initial ones
    members: dict[str, Place] = field(default_factory=dict)


Place = Node | Array | Record


@dataclass
class Variable:
    """A variable of the function block."""

    name: str
    kind: Kind
    shape: tuple[int, ...] = ()
    value: Callable[[], str] | None = None


# ---- Text ----

# Some compilers take no literal of LREAL that REAL has no room for.
SMALLEST, LARGEST = 1.2e-38, 3.4e38
SCALE = 2.0**100


def atom(name: str, kind: Kind) -> Node:
    """Return a variable as an expression."""
    return Node(kind, lambda: name, 9, True)


def count(number: int) -> Node:
    """Return a number that counts."""
    kind = Whole()
    kind.use("DINT")
    return Node(kind, lambda: str(number))


def inside(node: Node, level: int) -> str:
    """Return the text of an operand; in parentheses where it binds less tightly."""
    text = node.text()
    return text if node.level >= level and not (text.startswith("-") and level > 5) else f"({text})"


def real_text(value: float) -> str:
    """Return a real number as a literal with a point."""
    mantissa, _, exponent = repr(float(value)).partition("e")
    mantissa = mantissa if "." in mantissa else f"{mantissa}.0"
    return f"{mantissa}E{int(exponent)}" if exponent else mantissa


def flat(value: Expr) -> Iterator[Expr]:
    """Yield the values within nested braces."""
    if isinstance(value, Braces):
        for each in value.values:
            yield from flat(each)
    else:
        yield value
