"""Translated values and the text of C code: blocks, layout, numbers, names.

A translated Python expression: its kind, its C code, its value where that is known.

The statements of a C function as a tree, and the placement of its declarations.

A variable is declared where it is first set, in the innermost block that contains all its uses.
What is set but never used is removed.

The text of C code: indentation, comments and line breaks.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, TypeAlias

import numpy as np

from quell.export.reserved import is_taken_by_function, is_taken_in_c, objection

# ---- A translated Python expression ----

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


# ---- The statements of a C function as a tree, and the placement of its declarations ----

_WORD = re.compile(r"(?<![\w.])(?<!->)[A-Za-z_]\w*")


@dataclass
class Line:
    """A statement, or the assignment ``target = code``."""

    code: str
    target: str = ""
    comments: list[str] = field(default_factory=list)
    behind: str = ""
    calls: bool = False  # whether a function is called
    updates: bool = False  # whether the target is read, too: ``target += code``
    declares: str = ""  # the declaration of the target, if it is declared here
    returns_several: bool = False  # whether the code is the list of numbers to be returned


@dataclass
class Branch:
    """If and else."""

    test: str
    body: Block
    orelse: Block
    comments: list[str] = field(default_factory=list)
    behind: str = ""


@dataclass
class Loop:
    """A loop over a range."""

    header: str
    variable: str
    body: Block
    comments: list[str] = field(default_factory=list)
    behind: str = ""


Item = Line | Branch | Loop
Block = list[Item]


def words(code: str) -> set[str]:
    """Return the names in a piece of code that are not fields of structs."""
    return set(_WORD.findall(code))


def _parts(item: Branch | Loop) -> tuple[str, list[Block]]:
    """Return the code at the head of a branch or loop, and the blocks in it."""
    if isinstance(item, Branch):
        return item.test, [item.body, item.orelse]
    return item.header, [item.body]


def lines_of(block: Block) -> Iterator[Line]:
    """Yield all lines of a block and of the blocks in it."""
    for item in block:
        if isinstance(item, Line):
            yield item
        else:
            for part in _parts(item)[1]:
                yield from lines_of(part)


def _read_names(block: Block) -> set[str]:
    found: set[str] = set()
    for item in block:
        head, inner = (item.code, []) if isinstance(item, Line) else _parts(item)
        found |= words(head).union(*map(_read_names, inner))
    return found


def names_in_block(block: Block) -> set[str]:
    """Return all names that a block uses or sets."""
    return _read_names(block) | {line.target for line in lines_of(block) if line.target}


def remove_unused(block: Block, local: set[str]) -> Block:
    """Return a block without assignments to local names that are never read."""
    while True:
        unused = local - _read_names(block)
        smaller = _without(block, unused)
        if _count(smaller) == _count(block):
            return smaller
        block = smaller


def _count(block: Block) -> int:
    return sum(1 for _ in lines_of(block)) + sum(not isinstance(item, Line) for item in block)


def _without(block: Block, unused: set[str]) -> Block:
    kept: Block = []
    for item in block:
        if isinstance(item, Line):
            if item.target not in unused:
                kept.append(item)
            elif item.calls:
                code = f"(void){item.code}" if _is_call(item.code) else f"(void)({item.code})"
                kept.append(Line(code, comments=item.comments, behind=item.behind, calls=True))
        elif isinstance(item, Branch):
            body, orelse = _without(item.body, unused), _without(item.orelse, unused)
            if body or orelse or _has_call(item.test):
                kept.append(Branch(item.test, body, orelse, item.comments, item.behind))
        else:
            body = _without(item.body, unused)
            if body:
                kept.append(Loop(item.header, item.variable, body, item.comments, item.behind))
    return kept


def _is_call(code: str) -> bool:
    """Return whether a piece of code is one call and nothing else."""
    depth, name = 0, re.match(r"\w+(?=\()", code)
    if name is None:
        return False
    for i in range(name.end(), len(code)):
        depth += (code[i] == "(") - (code[i] == ")")
        if depth == 0:
            return i == len(code) - 1
    return False


def _has_call(code: str) -> bool:
    return bool(re.search(r"\w\(", code))


def place_declarations(block: Block, local: set[str], declare: Callable[[str, bool], str]) -> None:
    """Declare the local names of a function where they belong; change the block.

    ``declare(name, constant)`` returns the declaration without value.
    """
    counts: dict[str, int] = {}
    for line in lines_of(block):
        if line.target:
            counts[line.target] = counts.get(line.target, 0) + (2 if line.updates else 1)
    _place(block, local & names_in_block(block), counts, declare)


def _place(
    block: Block, local: set[str], counts: dict[str, int], declare: Callable[[str, bool], str]
) -> None:
    for name in sorted(local):
        places = [i for i, item in enumerate(block) if name in names_in_block([item])]
        if not places:
            continue
        first = block[places[0]]
        if len(places) == 1 and not isinstance(first, Line) and _is_inside(first, name):
            for part in _parts(first)[1]:
                _place(part, {name}, counts, declare)
            continue
        if isinstance(first, Line) and _sets(first, name):
            first.declares = declare(name, counts.get(name, 0) == 1)
        else:
            block.insert(places[0], Line("0", name, declares=declare(name, False)))


def _sets(line: Line, name: str) -> bool:
    return line.target == name and not line.updates and name not in words(line.code)


def _sets_first(block: Block, name: str) -> bool:
    """Return whether a block sets a variable before it reads it, whatever happens."""
    for i, item in enumerate(block):
        if name not in names_in_block([item]):
            continue
        if isinstance(item, Line):
            return _sets(item, name)
        return name not in names_in_block(block[i + 1 :]) and _is_inside(item, name)
    return False


def _is_inside(item: Branch | Loop, name: str) -> bool:
    """Return whether each block of a branch or loop that has a variable sets it first."""
    head, inner = _parts(item)
    used = [part for part in inner if name in names_in_block(part)]
    return name not in words(head) and all(_sets_first(part, name) for part in used)


# ---- The text of C code ----

_WIDTH = 100


def comment_block(text: str, indent: int = 0) -> list[str]:
    """Return a text as a comment: paragraphs are filled, indented lines stay as they are."""
    pad = " " * indent
    text = text.replace("*/", "* /").replace("/*", "/ *").replace("``", "").replace("::\n", ":\n")
    lines = [line for part in _paragraphs(text) for line in _filled(part, _WIDTH - indent - 6)]
    if len(lines) == 1:
        return [f"{pad}/* {lines[0]} */"]
    body = [f"{pad} * {line}".rstrip() for line in lines[1:]]
    return [f"{pad}/* {lines[0]}", *body[:-1], f"{body[-1]} */"]


def _paragraphs(text: str) -> list[str]:
    """Return a text with each paragraph in one line."""
    parts: list[str] = []
    for line in text.splitlines():
        in_list = bool(parts) and parts[-1][:2] in ("* ", "- ") and line[:2] == "  "
        starts = not parts or not line or line[0] in " *-123456789" or parts[-1][:1] in ("", " ")
        if starts and not in_list:
            parts.append(line)
        else:
            parts[-1] += f" {line.lstrip()}"
    return parts


def _filled(part: str, width: int) -> list[str]:
    if part[:1] == " ":
        return [part]
    indent = "  " if part[:2] in ("* ", "- ") else ""
    return textwrap.wrap(part, width, subsequent_indent=indent) or [""]


def wrapped(line: str) -> list[str]:
    """Return a line of code in lines of at most 100 signs, broken where it nests least."""
    if len(line) <= _WIDTH or line.lstrip().startswith(("/*", "*")):
        return [line]
    code, mark, comment = line.partition(" /* ")
    if mark and len(code) <= _WIDTH:
        pad = re.match(r" *", code)
        return [*comment_block(comment.removesuffix(" */"), len(pad[0]) if pad else 0), code]
    return _broken(line, len(line) - len(line.lstrip()) + 4)


def _broken(line: str, indent: int) -> list[str]:
    """Return a line in parts, all but the first with the same indentation."""
    parts: list[str] = []
    while len(line) > _WIDTH and (place := _break(line)) is not None:
        parts.append(line[:place].rstrip())
        line = " " * indent + line[place:].lstrip()
    return [*parts, line]


def _break(line: str) -> int | None:
    """Return where to break a line: after a comma or before an operator, with least nesting."""
    best, place, depth = None, None, 0
    start = len(line) - len(line.lstrip()) + 8
    for i, sign in enumerate(line[:_WIDTH]):
        if sign in "([{":
            depth += 1
        elif sign in ")]}":
            depth -= 1
        if i < start:
            continue
        after = line[i : i + 4]
        comma = line[i - 1] == "," and sign == " "
        operator = sign == " " and re.match(r" (\|\||&&|\?|:|[-+*/]|==|<=?|>=?) ", after + " ")
        if comma or operator:
            rank = (depth, not (comma or "&&" in after or "||" in after))
            if best is None or rank <= best:
                best, place = rank, i
    return place


def block_lines(block: Block, result: str, indent: int = 4) -> list[str]:
    """Return the lines of a block; ``result`` is the struct that the function returns, if any."""
    lines: list[str] = []
    for item in block:
        pad = " " * indent
        for comment in item.comments and [" ".join(item.comments)]:
            lines += comment_block(comment, indent)
        behind = f" /* {item.behind} */" if item.behind else ""
        if isinstance(item, Line):
            text = item.code
            if item.returns_several:
                lines += wrapped(f"{pad}const {result} returned = {{{text}}};{behind}")
                text, behind = "return returned", ""
            elif item.target:
                name = item.declares or item.target
                text = item.code if item.updates else f"{name} = {item.code}" if item.code else name
            lines += wrapped(f"{pad}{text};{behind}")
        elif isinstance(item, Branch):
            lines += _branch(item, result, indent, behind)
        else:
            lines += wrapped(f"{pad}{item.header} {{{behind}")
            lines += [*block_lines(item.body, result, indent + 4), f"{pad}}}"]
    return lines


def _branch(item: Branch, result: str, indent: int, behind: str) -> list[str]:
    pad, lines = " " * indent, []
    opening = f"{pad}if ({item.test}) {{{behind}"
    chained = False
    while True:
        lines += wrapped(opening)
        lines += block_lines(item.body, result, indent + 4)
        rest = item.orelse
        if not rest:
            # A chain of tests ends with else (MISRA C:2012, rule 15.7).
            last = [f"{pad}}} else {{", f"{pad}    /* Nothing in any other case. */"]
            return [*lines, *(last if chained else []), f"{pad}}}"]
        if len(rest) == 1 and isinstance(rest[0], Branch):
            item = rest[0]
            for comment in item.comments and [" ".join(item.comments)]:
                lines += comment_block(comment, indent + 4)
            opening, chained = f"{pad}}} else if ({item.test}) {{", True
            continue
        return [*lines, f"{pad}}} else {{", *block_lines(rest, result, indent + 4), f"{pad}}}"]


# ---- Numbers as C writes them ----


class Literals:
    """Writer of numbers in double or in single precision.

    Parameters
    ----------
    single
        whether real numbers are ``float``, not ``double``.
    """

    def __init__(self, single: bool) -> None:
        self.single = single
        self.real = "float" if single else "double"

    def write_real(self, value: Any) -> str:
        """Return a real number; Raises ``TranslationError`` if it is out of range."""
        number = float(value)
        if math.isnan(number):
            return "NAN"
        if math.isinf(number):
            return "INFINITY" if number > 0.0 else "-INFINITY"
        if not self.single:
            return repr(number)
        with np.errstate(over="ignore", under="ignore"):
            rounded = np.float32(number)
        if not np.isfinite(rounded) or (rounded == 0.0) != (number == 0.0):
            raise TranslationError(f"{number!r} is out of the range of single precision")
        text = str(rounded)
        return f"{text}f" if any(sign in text for sign in ".e") else f"{text}.0f"

    def write(self, value: Any) -> str:
        """Return any number."""
        if isinstance(value, bool | np.bool_):
            return "true" if value else "false"
        if isinstance(value, int | np.integer):
            return str(int(value))
        return self.write_real(value)

    def math_function(self, name: str) -> str:
        """Return the name of a function of <math.h>."""
        return f"{name}f" if self.single else name


# ---- Names in C for names in Python ----

# External names of more characters are no problem for today's linkers; files are.
_LONGEST = 63


def checked_name(name: str, *targets: str) -> str:
    """Return the name of a controller or model, which begins all its public names in C.

    ``targets`` are those of ``reserved.objection`` besides C.

    Raises
    ------
    TranslationError
        if it is no identifier, or a name that a target has for itself.
    """
    if not (isinstance(name, str) and re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name)):
        rule = "must be a C identifier: a letter, and then letters, digits and _"
        raise TranslationError(f"name = {name!r}: {rule}")
    if len(name) > _LONGEST:
        raise TranslationError(f"name = {name!r}: must have {_LONGEST} characters at most")
    for target in ("C", *targets):
        if found := objection(name, target):
            raise TranslationError(found)
    return name


def identifier(name: str) -> str:
    """Return a name that C allows for a variable, a field or a parameter."""
    return f"{name}_" if is_taken_in_c(name) else name


def function_name(name: str) -> str:
    """Return a name that C allows for a function of this program."""
    name = name.lstrip("_")
    return f"{name}_" if is_taken_by_function(name) else name


def snake_case(name: str) -> str:
    """Return ``GuardMemory`` as ``guard_memory``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.lstrip("_")).lower()


def unique(name: str, taken: set[str]) -> str:
    """Return ``name``, with a number if it is taken, and add it to ``taken``."""
    found, number = name, 2
    while found in taken:
        found, number = f"{name}_{number}", number + 1
    taken.add(found)
    return found
