"""C structs for NamedTuples and records, their initialisers and initial values."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quell.export.translate.findings import Findings
from quell.export.translate.literals import Literals
from quell.export.translate.naming import identifier, snake_case, unique
from quell.export.translate.source import ascii_text, field_comments
from quell.export.translate.values import (
    Array,
    Kind,
    Number,
    Struct,
    TranslationError,
    Value,
    is_empty,
)
from quell.kernels.function_pointers import origin_of
from quell.kernels.scalars import Scalars
from quell.kernels.sized import constant_fields, scratch_fields

# Name of the union of arrays that lie in the same memory.
_SHARED = "shared"


@dataclass
class Layout:
    """The members of a C struct."""

    struct: Struct
    doc: str
    members: dict[str, Kind] = field(default_factory=dict)  # what exists in C
    constants: dict[str, Any] = field(default_factory=dict)
    absent: dict[str, Kind] = field(default_factory=dict)  # empty arrays and structs
    shared: tuple[str, ...] = ()  # members in the same memory
    scratch: dict[str, Kind] = field(default_factory=dict)  # arrays that are local variables


class Structs:
    """All structs of a program.

    A number in a record of the state that is only ever set to its initial value is a constant, and
    does not exist in C; one that is only ever 0 or 1 is a ``bool``, one that only gets integers an
    ``int``. That is assumed until something else is assigned; then ``findings`` gets the number
    with the kind that it needs, and the program has to be translated again.

    Parameters
    ----------
    prefix
        begins the names of structs.
    literals
        writer of numbers.
    findings
        of earlier translations.
    """

    def __init__(self, prefix: str, literals: Literals, findings: Findings) -> None:
        self.prefix = prefix
        self.literals = literals
        self.findings = findings
        self._initial: dict[tuple[str, str], Any] = {}
        self.layouts: dict[str, Layout] = {}  # by name, in the order of their definitions
        self._by_signature: dict[Any, Struct] = {}
        self._names = {f"{prefix}_{word}" for word in ("state", "parameters", "estimate", "flag")}

    def of(self, value: Any, name: str = "") -> Kind:
        """Return the kind of a parameter or a part of a state.

        ``name`` is where it is, for messages, and the end of the C name of the outermost struct.
        """
        if isinstance(value, np.ndarray):
            if issubclass(value.dtype.type, np.void):
                return self._record(value)
            return Array(value.shape, _element(value, name))
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            return self._named_tuple(value, name)
        if isinstance(value, bool | np.bool_):
            return Number.BOOL
        if isinstance(value, int | np.integer):
            return Number.INT
        if isinstance(value, float | np.floating):
            return Number.REAL
        raise TranslationError(
            f"{name} is {type(value).__name__}: C has only numbers and arrays of them"
        )

    def _record(self, array: Any) -> Struct:
        kind = array.dtype.type
        found = self._by_signature.get(kind)
        if found is None:
            found = self._by_signature[kind] = self._new(kind, snake_case(kind.__name__), False)
            names = [name for base in kind.__mro__ for name in vars(base).get("__annotations__", {})
                     if issubclass(base, Scalars) and base is not Scalars]  # fmt: skip
            layout = self.layouts[found.name]
            for member in names:
                whole = array.dtype[member].kind in "iu"
                layout.members[member] = Number.INT if whole else Number.REAL
        for member in self.layouts[found.name].members:
            number = array[0][member].item()
            if self._initial.setdefault((found.name, member), number) != number:
                self.vary((found.name, member), whole_kind(number))
        return found

    def _named_tuple(self, value: Any, name: str) -> Struct:
        cls: Any = type(value)
        functions = [part for part in cls._fields if origin_of(getattr(value, part)) is not None]
        constant = (*constant_fields(cls), *functions)
        kinds = {
            part: self.of(entry, f"{name}.{part}" if name else part)
            for part, entry in zip(value._fields, value, strict=True)
            if part not in constant
        }
        shared = _shared_fields(value)
        constants = {part: getattr(value, part) for part in constant}
        signature = (cls, tuple(kinds.items()), tuple(constants.items()), shared)
        found = self._by_signature.get(signature)
        if found is None:
            found_parts = {part: kind for part, kind in kinds.items() if not is_empty(Value(kind))}
            scratch = {
                part: kind for part, kind in found_parts.items() if part in scratch_fields(cls)
            }
            members = {part: kind for part, kind in found_parts.items() if part not in scratch}
            base = snake_case(cls.__name__).removesuffix("_design")
            found = self._new(cls, base, not members)
            self._by_signature[signature] = found
            layout = self.layouts[found.name]
            layout.members, layout.constants, layout.shared = members, constants, shared
            layout.scratch = scratch
            layout.absent = {part: kind for part, kind in kinds.items() if part not in found_parts}
        return found

    def _new(self, kind: type, base: str, empty: bool) -> Struct:
        struct = Struct(unique(f"{self.prefix}_{base}", self._names), kind, empty)
        doc = ascii_text((kind.__doc__ or "").strip().split("\n\n")[0])
        self.layouts[struct.name] = Layout(struct, doc)
        return struct

    def field(self, owner: Value, name: str) -> Value | None:
        """Return a field of a struct; None if there is none of this name."""
        layout = self.layouts[owner.kind.name]
        if name in layout.constants:
            constant = layout.constants[name]
            number = Number.BOOL if isinstance(constant, bool) else Number.INT
            return Value(number, self.literals.write(constant), constant=constant)
        if name in layout.scratch:  # without code: the variable that is set to it is the array
            return Value(layout.scratch[name], root=owner.root, mutable=True)
        kind = layout.members.get(name, layout.absent.get(name))
        if kind is None:
            return None
        path = f"{_SHARED}." if name in layout.shared else ""
        member = (owner.kind.name, name)
        if owner.mutable and member in self._initial and member not in self.findings.numbers:
            initial = self._initial[member]
            return Value(kind, self.literals.write(initial), constant=initial, member=member)
        code = f"{owner.code}{'->' if owner.pointer else '.'}{path}{identifier(name)}"
        kind = self.findings.numbers.get(member, kind)
        chosen = member if member in self.findings.numbers else None
        return Value(
            kind, code, root=owner.root, mutable=owner.mutable, pointer=False, member=chosen
        )

    def vary(self, member: tuple[str, str], kind: Number) -> None:
        """Note that a number of the state gets another value, of a kind."""
        initial = whole_kind(self._initial[member])
        known = self.findings.numbers.get(member, Number.BOOL)
        needed = max(initial, kind, known, key=lambda number: number.value)
        self.findings.add_number(member, needed)

    def fields_of(self, struct: Struct) -> list[str]:
        """Return the names of the fields of a record that change."""
        name = struct.name
        return [
            each for each in self.layouts[name].members if (name, each) in self.findings.numbers
        ]

    def keep_used(self, code: str) -> None:
        """Remove the fields that do not occur in the code, and structs that become empty."""
        used = set(re.findall(r"(?:->|\.)(\w+)", code))
        for name, layout in self.layouts.items():
            kept = {}
            for part, kind in layout.members.items():
                member = (name, part)
                constant = member in self._initial and member not in self.findings.numbers
                empty = isinstance(kind, Struct) and not self.layouts[kind.name].members
                if identifier(part) in used and not constant and not empty:
                    kept[part] = self.findings.numbers.get(member, kind)
            if issubclass(layout.struct.python, Scalars):
                # Flags come last, so that they share words.
                kept = dict(sorted(kept.items(), key=lambda item: item[1] is Number.BOOL))
            layout.members = kept

    def rename(self, struct: Struct, name: str) -> Struct:
        """Rename the last struct that was made, and return it."""
        layout = self.layouts.pop(struct.name)
        layout.struct = Struct(name, struct.python, struct.empty)
        self.layouts[name] = layout
        for signature, found in self._by_signature.items():
            if found == struct:
                self._by_signature[signature] = layout.struct
        return layout.struct

    def definition(self, struct: Struct, first: str = "") -> list[str]:
        """Return the lines that define a struct; ``first`` is a member before all others."""
        layout = self.layouts[struct.name]
        comments = field_comments(struct.python)
        doc = " ".join(layout.doc.replace("``", "").split())
        lines = [f"/* {doc} */", "typedef struct {"]
        lines += [f"    {first}"] if first else []
        for name, kind in layout.members.items():
            if name == (layout.shared or ("",))[0]:
                both = [self._member(part, layout.members[part], comments, 8)
                        for part in layout.shared]  # fmt: skip
                lines += ["    union {", *both, f"    }} {_SHARED};"]
            elif name not in layout.shared:
                lines.append(self._member(name, kind, comments, 4))
        return [*lines, f"}} {struct.name};"]

    def _member(self, name: str, kind: Kind, comments: dict[str, str], indent: int) -> str:
        text = comments.get(name, "").replace("``", "").removeprefix("(1,)").strip()
        comment = f" /* {text} */" if text else ""
        return f"{' ' * indent}{self.declaration(kind, identifier(name))};{comment}"

    def declaration(self, kind: Kind, name: str) -> str:
        """Return the declaration of a variable that holds a value of this kind."""
        if isinstance(kind, Array):
            shape = "".join(f"[{length}]" for length in kind.shape)
            return f"{self.number(kind.element)} {name}{shape}"
        if isinstance(kind, Struct):
            return f"{kind.name} {name}"
        return f"{self.number(kind)} {name}"

    def number(self, kind: Any) -> str:
        """Return the C type of a number."""
        return {Number.BOOL: "bool", Number.INT: "int", Number.REAL: self.literals.real}[kind]

    def initialiser(self, kind: Kind, value: Any, indent: int, comment: str = "") -> list[str]:
        """Return the lines of a constant with the numbers of ``value``, without the name."""
        pad, end = " " * indent, f" /* {comment} */" if comment else ""
        if isinstance(kind, Struct):
            layout = self.layouts[kind.name]
            lines = [f"{pad}{{{end}"]
            for name, member in layout.members.items():
                lines += self.initialiser(member, getattr(value, name), indent + 4, name)
                lines[-1] += ","
            return _comma_before_comment([*lines, f"{pad}}}"])
        if isinstance(kind, Array):
            return _comma_before_comment([f"{pad}{self._braced(value)}{end}"])
        return [f"{pad}{self.literals.write(value)}{end}"]

    def _braced(self, array: Any) -> str:
        return "{" + ", ".join(
            self._braced(entry) if isinstance(entry, np.ndarray) else self.literals.write(entry)
            for entry in array
        ) + "}"  # fmt: skip


def whole_kind(value: float) -> Number:
    """Return the kind that a number needs: of a truth value, an integer, or a real number."""
    if value in (0.0, 1.0):
        return Number.BOOL
    return Number.INT if float(value).is_integer() and abs(value) < 2**15 else Number.REAL


def _comma_before_comment(lines: list[str]) -> list[str]:
    found = []
    for line in lines:
        if line.endswith("*/,"):
            code, comment = line[:-1].split(" /* ", 1)
            line = f"{code}, /* {comment}"
        found.append(line)
    return found


def _element(array: Any, name: str) -> Number:
    if array.dtype.kind == "f":
        return Number.REAL
    if array.dtype.kind in "iu":
        return Number.INT
    if array.dtype.kind == "b":
        return Number.BOOL
    raise TranslationError(f"{name} is an array of {array.dtype}: C has only arrays of numbers")


def arrays_of(value: Any) -> Iterator[Any]:
    """Yield the arrays in nested NamedTuples, in order."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple):
        for entry in value:
            yield from arrays_of(entry)


def _shared_fields(value: Any) -> tuple[str, ...]:
    """Return the names of a NamedTuple and of an array that holds all its numbers, if any."""
    for name, part in zip(value._fields, value, strict=True):
        parts = (
            [array for array in arrays_of(part) if array.size] if isinstance(part, tuple) else []
        )
        size = sum(array.size for array in parts)
        for other, flat in zip(value._fields, value, strict=True):
            fits = parts and isinstance(flat, np.ndarray) and flat.size == size
            if fits and all(np.shares_memory(array, flat) for array in parts):
                return name, other
    return ()
