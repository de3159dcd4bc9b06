"""Source of kernels, and C structs for their NamedTuples and records.

Results of a translation of a program, for the next one.

The translator assumes as much as possible to be constant. Where it finds the opposite, it notes
that here, and the program is translated again, until nothing new is found.

The source of kernels and of NamedTuples: syntax trees, docstrings and comments.
"""

from __future__ import annotations

import ast
import copy
import functools
import inspect
import io
import re
import sys
import textwrap
import tokenize
import unicodedata
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from quell.export.translate.text import (
    Array,
    Kind,
    Literals,
    Number,
    Struct,
    TranslationError,
    Value,
    identifier,
    is_empty,
    snake_case,
    unique,
    wrapped,
)
from quell.kernels.sized import Scalars, constant_fields, scratch_fields
from quell.kernels.user_functions import origin_of

# ---- Results of a translation of a program, for the next one ----


@dataclass
class Findings:
    """Numbers and parameters that are not constant.

    Attributes
    ----------
    numbers
        kind of each number in a record of the state that changes, by struct and field.
    parameters
        function and position of each parameter that gets different values.
    is_new
        whether something was found in this translation.
    """

    numbers: dict[tuple[str, str], Number] = field(default_factory=dict)
    parameters: set[Any] = field(default_factory=set)
    is_new: bool = False

    def add_number(self, member: tuple[str, str], kind: Number) -> None:
        """Note that a number changes, and its kind."""
        if self.numbers.get(member) is not kind:
            self.numbers[member] = kind
            self.is_new = True

    def add_parameter(self, key: Any) -> None:
        """Note that a parameter gets different values."""
        if key not in self.parameters:
            self.parameters.add(key)
            self.is_new = True


# ---- The source of kernels and of NamedTuples ----

# Signs in docstrings and comments, and what stands for them in C: compilers for small processors
# do not all read other than ASCII characters.
_SIGNS = {
    "−": "-", "–": "-", "…": "...", "·": "*", "×": "*", "≤": "<=", "≥": ">=", "≈": "~", "→": "->",
    "←": "<-", "∞": "inf", "√": "sqrt ", "Σ": "sum ", "∫": "integral ", "∂": "d", "±": "+-",
    "⁻": "-", "⁺": "+", "ᵀ": "'",
    "₀": "0", "½": "1/2", "’": "'", "“": '"', "”": '"', "∈": "in", "‖": "|", "ᵢ": "i",
    "Δ": "D", "Φ": "Phi", "Γ": "Gamma", "Λ": "Lambda", "Ω": "Omega", "µ": "u", "∇": "grad ",
}  # fmt: skip
_POWERS = dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-", strict=True))
_ACCENTS = {"\u0302": "_hat", "\u0303": "_tilde", "\u0304": "_bar", "\u0305": "_bar"}


def ascii_text(text: str) -> str:
    """Return a text in ASCII: Greek letters by name, accents of symbols as ``_hat``."""
    found = []
    text = re.sub("[⁰¹²³⁴⁵⁶⁷⁸⁹⁻]*[⁰¹²³⁴⁵⁶⁷⁸⁹]", _power, text)
    for sign in unicodedata.normalize("NFD", text):
        if sign.isascii():
            found.append(sign)
        elif sign in _SIGNS or sign in _ACCENTS:
            found.append(_SIGNS.get(sign) or _ACCENTS[sign])
        elif not unicodedata.combining(sign):
            name = unicodedata.name(sign, "?").lower()
            found.append(name.rsplit(" ", 1)[-1] if name.startswith("greek") else "?")
    return "".join(found)


def _power(found: re.Match[str]) -> str:
    return "^" + "".join(_POWERS[sign] for sign in found[0])


@dataclass
class Comments:
    """The comments of a piece of source by line."""

    before: dict[int, list[str]] = field(default_factory=dict)  # whole lines before a line
    behind: dict[int, str] = field(default_factory=dict)  # at the end of a line

    def of(self, node: ast.AST) -> tuple[list[str], str]:
        """Return the comments before a statement, and the one behind its first or last line."""
        first, last = getattr(node, "lineno", 0), getattr(node, "end_lineno", 0)
        if isinstance(node, ast.If | ast.For):
            last = first
        return self.before.get(first, []), self.behind.get(first, self.behind.get(last, ""))


def _comments(text: str) -> Comments:
    found, waiting = Comments(), []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        line = token.start[0]
        if token.type == tokenize.COMMENT:
            comment = ascii_text(token.string.lstrip("# "))
            if comment.startswith(("type:", "noqa", "fmt:")):
                continue
            if token.line.lstrip().startswith("#"):
                waiting.append(comment)
            else:
                found.behind[line] = re.sub(r"\s*# (noqa|type:).*", "", comment)
        elif waiting and token.type not in (tokenize.NL, tokenize.INDENT, tokenize.DEDENT):
            found.before[line] = waiting
            waiting = []
    return found


@dataclass(frozen=True)
class Source:
    """A Python function as the translator reads it."""

    tree: ast.FunctionDef
    comments: Comments
    doc: str  # without indentation, in ASCII
    module: str  # for example quell.guard.kernels
    name: str
    names: dict[str, Any]  # what global names stand for

    @functools.cached_property
    def occurring(self) -> frozenset[str]:
        """All names in the function."""
        return frozenset(part.id for part in ast.walk(self.tree) if isinstance(part, ast.Name))

    @functools.cached_property
    def stored(self) -> frozenset[str]:
        """The names that the function sets."""
        return frozenset(
            part.id
            for part in ast.walk(self.tree)
            if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store)
        )


@functools.cache
def read_function(function: Callable[..., Any]) -> Source:
    """Return the source of a function.

    Raises ``TranslationError`` if there is none, for example in an interactive session.
    """
    function = getattr(function, "py_func", function)
    name, module = function.__name__, function.__module__
    if name == "<lambda>":
        return _read_lambda(function)
    try:
        text = getattr(function, "source", "") or textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError):
        rule = "its source is not in a file; define it in a module"
        raise TranslationError(f"{module}.{name}: {rule}") from None
    tree = ast.parse(text).body[0]
    if not isinstance(tree, ast.FunctionDef):
        rule = "must be written as a function with def"
        raise TranslationError(f"{module}.{name}: {rule}")
    names = _names(function)
    doc = doc_of(function)
    return Source(tree, _comments(text), doc, module, name, names)


def doc_of(function: Any) -> str:
    """Return the docstring of a function, in ASCII."""
    return ascii_text(inspect.getdoc(function) or "")


def _names(function: Any) -> dict[str, Any]:
    return {**function.__globals__, **inspect.getclosurevars(function).nonlocals}


def _read_lambda(function: Any) -> Source:
    """Return a lambda as a function with a return statement."""
    where = f"the lambda in {function.__module__}"
    try:
        tree = ast.parse("".join(inspect.findsource(function)[0]))
    except (OSError, SyntaxError):
        tree = ast.Module([], [])
    code = function.__code__
    arguments = list(code.co_varnames[: code.co_argcount])
    found = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Lambda)
        and node.lineno == code.co_firstlineno
        and [argument.arg for argument in node.args.args] == arguments
    ]
    if len(found) != 1:
        raise TranslationError(f"{where} can't be found in its file; write it as a function")
    body: list[ast.stmt] = [ast.Return(found[0].body)]
    definition = ast.FunctionDef("user_function", found[0].args, body, [], None)
    ast.fix_missing_locations(definition)
    names = _names(function)
    return Source(definition, Comments(), "", function.__module__, "user_function", names)


def into_procedure(source: Source, dimensions: int = 1) -> Source:
    """Return a function that writes the numbers it returns to an array, its last argument.

    It returns a tuple of them, of tuples for an array of two dimensions; or an array that
    ``np.zeros`` or ``np.empty`` has made, and that it has filled.
    """
    tree = copy.deepcopy(source.tree)
    tree.args.args.append(ast.arg("out"))
    where = f"{source.module}.{source.name}"
    filled = _filled_array(tree)
    (_Filled(filled, dimensions) if filled else _Returns(where, dimensions)).visit(tree)
    return replace(source, tree=ast.fix_missing_locations(tree))


def _filled_array(tree: ast.FunctionDef) -> str | None:
    """Return the name of the array that a function makes once, fills and returns; else None."""
    returned = [node.value for node in ast.walk(tree) if isinstance(node, ast.Return)]
    names = {getattr(value, "id", None) for value in returned}
    name = names.pop() if len(names) == 1 else None
    sets = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign)
        and any(getattr(part, "id", None) == name for part in node.targets)
    ]
    is_made = len(sets) == 1 and sets[0] in tree.body and _is_array_maker(sets[0].value)
    return name if name is not None and is_made else None


def _is_array_maker(value: ast.expr) -> bool:
    return isinstance(value, ast.Call) and getattr(value.func, "attr", "") in ("zeros", "empty")


class _Filled(ast.NodeTransformer):
    """Replacement of an array that a function makes, fills and returns, by the array ``out``."""

    def __init__(self, name: str, dimensions: int) -> None:
        self.name, self.dimensions = name, dimensions

    def visit_Name(self, node: ast.Name) -> ast.Name:
        return ast.copy_location(ast.Name("out", node.ctx), node) if node.id == self.name else node

    def visit_Assign(self, node: ast.Assign) -> ast.AST:
        if any(getattr(part, "id", None) == self.name for part in node.targets):
            places = [f"place{i + 1}" for i in range(self.dimensions)]
            line = f"out[{', '.join(places)}] = 0.0"
            for i, place in reversed(list(enumerate(places))):
                line = f"for {place} in range(out.shape[{i}]):\n" + textwrap.indent(line, "    ")
            return ast.copy_location(ast.parse(line).body[0], node)
        return self.generic_visit(node)

    def visit_Return(self, node: ast.Return) -> ast.Return:
        return ast.copy_location(ast.Return(None), node)


class _Returns(ast.NodeTransformer):
    """Replacement of return statements by assignments to the array ``out``."""

    def __init__(self, where: str, dimensions: int) -> None:
        self.where, self.dimensions = where, dimensions

    def visit_Return(self, node: ast.Return) -> list[ast.stmt]:
        value = node.value
        is_array = isinstance(value, ast.Call) and getattr(value.func, "attr", "") == "array"
        if is_array and isinstance(value, ast.Call):
            value = value.args[0]
        lines: list[ast.stmt] = []
        for places, number in self._numbers(value, ()):
            index: ast.expr = ast.Constant(places[0])
            if len(places) > 1:
                index = ast.Tuple([ast.Constant(place) for place in places], ast.Load())
            place = ast.Subscript(ast.Name("out", ast.Load()), index, ast.Store())
            lines.append(ast.copy_location(ast.Assign([place], number), node))
        return [*lines, ast.copy_location(ast.Return(None), node)]

    def _numbers(
        self, value: ast.expr | None, at: tuple[int, ...]
    ) -> Iterator[tuple[tuple[int, ...], ast.expr]]:
        """Yield place and expression of each number in nested tuples."""
        if not isinstance(value, ast.Tuple | ast.List):
            what = "a tuple of numbers, written as one"
            if self.dimensions > 1:
                what = (
                    "a matrix written as nested tuples, as in return (a, b), (c, d), or an array "
                    "that np.zeros has made and that it fills number by number"
                )
            raise TranslationError(f"{self.where}: must return {what}")
        for i, part in enumerate(value.elts):
            if len(at) + 1 < self.dimensions:
                yield from self._numbers(part, (*at, i))
            else:
                yield (*at, i), part


@functools.cache
def field_comments(kind: type) -> dict[str, str]:
    """Return the comment of each field of a NamedTuple or record, where there is one."""
    try:
        text = textwrap.dedent(inspect.getsource(kind))
    except (OSError, TypeError):
        return {}
    comments, found = _comments(text), {}
    body = ast.parse(text).body[0]
    for node in getattr(body, "body", []):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            before, behind = comments.of(node)
            found[node.target.id] = behind or " ".join(before)
    return {name: comment for name, comment in found.items() if comment}


@functools.cache
def local_names(module: str) -> frozenset[str]:
    """Return the names of all parameters and variables in the functions of a module."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError):
        return frozenset()
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    nodes = [node for function in functions for node in ast.walk(function)]
    stored = {node.id for node in nodes if isinstance(node, ast.Name)
              and isinstance(node.ctx, ast.Store)}  # fmt: skip
    return frozenset(stored | {node.arg for node in nodes if isinstance(node, ast.arg)})


def module_doc(module: str) -> str:
    """Return the docstring of a module in ASCII."""
    return ascii_text(inspect.getdoc(sys.modules[module]) or "")


# ---- C structs for NamedTuples and records, their initialisers and initial values ----

# What a tuple without names of fields calls its entries in C, with their numbers.
_ENTRY = "entry"


def member_of(i: int) -> str:
    """Return the name of an entry of a tuple in C."""
    return f"{_ENTRY}{i + 1}"


def part_of(value: Any, name: str) -> Any:
    """Return a field of a NamedTuple, or an entry of another tuple by its name in C."""
    if hasattr(value, "_fields"):
        return getattr(value, name)
    return value[int(name.removeprefix(_ENTRY)) - 1]


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
        if isinstance(value, tuple):
            named = hasattr(value, "_fields")
            return self._named_tuple(value, name) if named else self._tuple(value, name)
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

    def _tuple(self, value: tuple[Any, ...], name: str) -> Struct:
        """Return the struct of a tuple, whose members are numbered."""
        kinds = {member_of(i): self.of(entry, f"{name}[{i}]") for i, entry in enumerate(value)}
        signature = (tuple, tuple(kinds.items()))
        found = self._by_signature.get(signature)
        if found is None:
            absent = {part: kind for part, kind in kinds.items() if is_empty(Value(kind))}
            found = self._new(tuple, name.rsplit(".", 1)[-1], len(absent) == len(kinds))
            self._by_signature[signature] = found
            layout = self.layouts[found.name]
            layout.doc, layout.absent = "One for each.", absent
            layout.members = {part: kind for part, kind in kinds.items() if part not in absent}
        return found

    def count(self, owner: Value) -> int:
        """Return the number of entries of a tuple."""
        layout = self.layouts[owner.kind.name]
        return len(layout.members) + len(layout.absent)

    def entry(self, owner: Value, i: int) -> Value:
        """Return an entry of a tuple."""
        found = self.field(owner, member_of(i))
        if found is None:
            raise AssertionError
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
                lines += self.initialiser(member, part_of(value, name), indent + 4, name)
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


# ---- C statements that set a state to its initial value, which is zero except for some arrays ----

# An array with at most so many values that are not zero is set by one statement for each.
_MOST_STATEMENTS = 4


def initial_lines(structs: Structs, owner: Value, state: Any, tables: list[str]) -> list[str]:
    """Return the statements for a state whose memory is zero.

    Arrays of many different numbers are copied from tables, whose definitions are appended to
    ``tables``.
    """
    lines: list[str] = []
    done: set[int] = set()
    for value, array in _arrays(structs, owner, state):
        address = array.__array_interface__["data"][0]
        if address not in done and np.any(array != 0):
            lines += _array_lines(structs, value, array, tables)
        done.add(address)
    return [line for each in lines for line in wrapped(each)]


def _arrays(structs: Structs, owner: Value, state: Any) -> Iterator[tuple[Value, Any]]:
    layout = structs.layouts[owner.kind.name]
    names = [name for name in layout.members if name not in layout.shared[1:]]
    for name in names:
        value, part = structs.field(owner, name), part_of(state, name)
        if value is None:
            raise AssertionError
        if isinstance(value.kind, Array):
            yield value, part
        elif isinstance(part, tuple):
            yield from _arrays(structs, value, part)
        elif isinstance(value.kind, Struct):  # a record
            for member in structs.layouts[value.kind.name].members:
                field = structs.field(value, member)
                if field is not None and not field.is_constant:
                    yield field, np.asarray(part[member])


def _array_lines(structs: Structs, value: Value, array: Any, tables: list[str]) -> list[str]:
    write, flat = structs.literals.write, array.ravel()
    if array.dtype.names is None and array.shape == (1,) and not isinstance(value.kind, Array):
        number = bool(flat[0]) if value.kind is Number.BOOL else flat[0]
        return [f"    {value.code} = {write(number)};"]
    if flat.size > _MOST_STATEMENTS and np.all(flat == flat[0]):
        return _loops(array.shape, value.code, write(flat[0]))
    if array.ndim == 2 and array.shape[0] == array.shape[1] > _MOST_STATEMENTS:
        diagonal = np.diag(array)
        if np.array_equal(array, np.diag(diagonal)) and np.all(diagonal == diagonal[0]):
            head = f"    for (int i = 0; i < {diagonal.size}; i++) {{"
            return [head, f"        {value.code}[i][i] = {write(diagonal[0])};", "    }"]
    if np.count_nonzero(flat) <= _MOST_STATEMENTS:
        places = [tuple(int(i) for i in place) for place in np.argwhere(array)]
        return [
            f"    {value.code}{''.join(f'[{i}]' for i in place)} = {write(array[place])};"
            for place in places
        ]
    name = f"initial_{len(tables) + 1}"
    numbers = ", ".join(map(write, flat))
    kind = structs.number(value.kind.element)
    tables.append(f"static const {kind} {name}[{flat.size}] = {{{numbers}}}; /* {value.code} */")
    return [f"    (void)memcpy({value.code}, {name}, sizeof {name});"]


def _loops(shape: tuple[int, ...], code: str, number: str) -> list[str]:
    lines, pad = [], "    "
    for name, length in zip("ij", shape, strict=False):
        lines.append(f"{pad}for (int {name} = 0; {name} < {length}; {name}++) {{")
        code, pad = f"{code}[{name}]", pad + "    "
    lines.append(f"{pad}{code} = {number};")
    for depth in range(len(shape), 0, -1):
        lines.append(f"{'    ' * depth}}}")
    return lines
