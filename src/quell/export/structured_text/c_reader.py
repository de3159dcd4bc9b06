"""Read the C that quell's translator writes: functions, constants and structs as trees.

The translator writes a small part of C99: assignments, if, for, return and break; struct members,
arrays and calls; no while, switch, goto or function pointers. What is not of this part ends the
reading with a ``TranslationError``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import NamedTuple

from quell.export.translate.text import TranslationError

NO_TEXT = "has no Structured Text here"
"""End of the messages for what is not translated."""

# ---- The trees ----


class Num(NamedTuple):
    """A literal, as it is written."""

    text: str


class Name(NamedTuple):
    """A name of a variable, a parameter or a constant."""

    name: str


class Member(NamedTuple):
    """``owner.name`` or ``owner->name``."""

    owner: Expr
    name: str


class Index(NamedTuple):
    """``array[index]``."""

    array: Expr
    at: Expr


class Call(NamedTuple):
    """A call of a function."""

    name: str
    arguments: tuple[Expr, ...]


class Unary(NamedTuple):
    """An operator before its operand: ``-``, ``!``, ``&`` or ``*``."""

    operator: str
    operand: Expr


class Binary(NamedTuple):
    """An operator between two operands."""

    operator: str
    left: Expr
    right: Expr


class Choice(NamedTuple):
    """``condition ? yes : no``."""

    condition: Expr
    yes: Expr
    no: Expr


class Cast(NamedTuple):
    """``(kind)operand``."""

    kind: str
    operand: Expr


class Braces(NamedTuple):
    """``{a, b}``: values of a struct or an array."""

    values: tuple[Expr, ...]


Expr = Num | Name | Member | Index | Call | Unary | Binary | Choice | Cast | Braces


class Variable(NamedTuple):
    """A declared variable, parameter or member: its kind, name, shape, and whether a pointer."""

    kind: str
    name: str
    shape: tuple[str, ...]
    is_pointer: bool
    is_const: bool


class Declare(NamedTuple):
    """A declaration, with its value."""

    variable: Variable
    value: Expr | None


class Assign(NamedTuple):
    """``target operator value``, with ``=``, ``+=`` and the like."""

    target: Expr
    operator: str
    value: Expr


class Evaluate(NamedTuple):
    """An expression as a statement."""

    value: Expr


class If(NamedTuple):
    """A condition with both branches."""

    condition: Expr
    yes: tuple[Statement, ...]
    no: tuple[Statement, ...]


class For(NamedTuple):
    """``for (int name = first; name comparison end; name += step)``."""

    name: str
    first: Expr
    comparison: str
    end: Expr
    step: int
    body: tuple[Statement, ...]


class Return(NamedTuple):
    """The end of a function."""

    value: Expr | None


class Break(NamedTuple):
    """The end of a loop."""


Statement = Declare | Assign | Evaluate | If | For | Return | Break


@dataclass(frozen=True)
class Function:
    """A function of the C file."""

    name: str
    kind: str
    parameters: tuple[Variable, ...]
    body: tuple[Statement, ...]
    doc: str  #: first sentence of the comment before it


@dataclass
class CFile:
    """What header and source declare; functions are read when they are asked for."""

    header: str
    source: str
    structs: dict[str, tuple[Variable, ...]] = field(default_factory=dict)
    constants: dict[str, tuple[Variable, Expr]] = field(default_factory=dict)
    _functions: dict[str, Function] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for text in (self.header, self.source):
            found = re.finditer(r"^typedef struct \{(.*?)\} (\w+);", text, re.M | re.S)
            for members, name in (each.groups() for each in found):
                self.structs[name] = _Parser(members).members()
        pattern = r"^static const (?!struct\b)\w+ \w+(?:\[\d+\])* =.*?;|^const \w+ \w+ =\n.*?\n\};"
        for each in re.finditer(pattern, self.source, re.M | re.S):
            (declared,) = _Parser(each[0]).declaration()
            if declared.value is None:
                raise AssertionError
            self.constants[declared.variable.name] = declared.variable, declared.value

    def has(self, name: str) -> bool:
        """Return whether the file defines a function."""
        return self._place(name) is not None

    def function(self, name: str) -> Function:
        """Return a function.

        Raises
        ------
        TranslationError
            if the file does not define it, or if something in it has no counterpart in the trees.
        """
        if name not in self._functions:
            place = self._place(name)
            if place is None:
                raise TranslationError(f"{name} is a function of C that {NO_TEXT}")
            doc, head, body = place.groups()
            kind, parameters = _Parser(head).head()
            statements = _Parser(body).statements()
            sentence = re.sub(r"\s*\n \*\s*", " ", (doc or "").removeprefix("/* "))
            sentence = re.split(r"(?<=\.)\s|\*/", sentence)[0].strip()
            self._functions[name] = Function(name, kind, parameters, statements, sentence)
        return self._functions[name]

    def _place(self, name: str) -> re.Match[str] | None:
        pattern = (
            r"(/\* (?:(?!\*/).)*\*/\n)?^((?:static )?(?:inline )?\w+ \*?"
            + re.escape(name)
            + r"\([^;{}]*\))\n\{\n(.*?)^\}$"
        )
        return re.search(pattern, self.source, re.M | re.S)


# ---- Reading ----

_TOKEN = re.compile(
    r"\s+|/\*.*?\*/|(?P<token>0x[0-9a-fA-F]+[UL]*(?![\w.])"
    r"|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?[fFUL]*(?![\w.])|[A-Za-z_]\w*"
    r"|->|\+\+|--|[-+*/|&]=|[=!<>]=|&&|\|\||[-+*/%=<>!&|?:;,.(){}\[\]])",
    re.S,
)
_LEVELS = ("||", "&&", "|", "&", "== !=", "< > <= >=", "+ -", "* / %")
_QUALIFIERS = ("const", "static", "inline", "restrict")
_REALS = ("double", "float")


class _Parser:
    """A parser of one text, by recursive descent."""

    def __init__(self, text: str) -> None:
        self.tokens: list[str] = []
        at = 0
        while at < len(text):
            found = _TOKEN.match(text, at)
            if found is None:
                raise TranslationError(f"C code {text[at : at + 20]!r}: {NO_TEXT}")
            if found["token"]:
                self.tokens.append(found["token"])
            at = found.end()
        self.at = 0

    # ---- Tokens ----

    def peek(self, ahead: int = 0) -> str:
        place = self.at + ahead
        return self.tokens[place] if place < len(self.tokens) else ""

    def next(self) -> str:
        self.at += 1
        return self.tokens[self.at - 1] if self.at <= len(self.tokens) else ""

    def take(self, token: str) -> bool:
        if self.peek() == token:
            self.at += 1
            return True
        return False

    def need(self, token: str) -> None:
        if not self.take(token):
            near = " ".join(self.tokens[max(self.at - 6, 0) : self.at + 6])
            raise TranslationError(f"C code {near!r}: {NO_TEXT}")

    # ---- Declarations ----

    def members(self) -> tuple[Variable, ...]:
        found: list[Variable] = []
        while self.peek():
            found += (each.variable for each in self.declaration())
        return tuple(found)

    def head(self) -> tuple[str, tuple[Variable, ...]]:
        kind = self.kind()[0]
        self.next()
        self.need("(")
        parameters = []
        while not self.take(")"):
            if self.peek() == "void" and self.peek(1) == ")":
                self.next()
                continue
            parameters.append(self.variable(*self.kind()))
            self.take(",")
        return kind, tuple(parameters)

    def kind(self) -> tuple[str, bool]:
        is_const = False
        while self.peek() in _QUALIFIERS:
            is_const = self.next() == "const" or is_const
        return self.next(), is_const

    def variable(self, kind: str, is_const: bool) -> Variable:
        is_pointer = self.take("*")
        while self.peek() in _QUALIFIERS:
            self.next()
        name, shape = self.next(), []
        while self.take("["):
            shape.append(self.next())
            self.need("]")
        return Variable(kind, name, tuple(shape), is_pointer, is_const)

    def declaration(self) -> list[Declare]:
        kind, is_const = self.kind()
        found = []
        while True:
            variable = self.variable(kind, is_const)
            found.append(Declare(variable, self.value() if self.take("=") else None))
            if not self.take(","):
                self.need(";")
                return found

    def value(self) -> Expr:
        if self.take("{"):
            values = []
            while not self.take("}"):
                values.append(self.value())
                self.take(",")
            return Braces(tuple(values))
        return self.expression()

    # ---- Statements ----

    def statements(self) -> tuple[Statement, ...]:
        found: list[Statement] = []
        while self.peek() and self.peek() != "}":
            found += self.statement()
        return tuple(found)

    def block(self) -> tuple[Statement, ...]:
        self.need("{")
        found = self.statements()
        self.need("}")
        return found

    def statement(self) -> list[Statement]:
        first = self.peek()
        if first == "if":
            return [self.condition()]
        if first == "for":
            return [self.loop()]
        if first == "return":
            self.next()
            value = None if self.peek() == ";" else self.expression()
            self.need(";")
            return [Return(value)]
        if first == "break":
            self.next()
            self.need(";")
            return [Break()]
        if first in ("while", "do", "switch", "goto", "continue"):
            raise TranslationError(f"C code with {first}: {NO_TEXT}")
        if self.declares():
            return list(self.declaration())
        return [self.simple()]

    def declares(self) -> bool:
        """Return whether a declaration begins here: a type, and a name or a pointer."""
        if self.peek() in _QUALIFIERS:
            return True
        named = re.fullmatch(r"[A-Za-z_]\w*", self.peek())
        follows = self.peek(2 if self.peek(1) == "*" else 1)
        return bool(named and re.fullmatch(r"[A-Za-z_]\w*", follows))

    def simple(self) -> Statement:
        target = self.expression()
        operator = self.next()
        if operator == ";":
            return Evaluate(target)
        if operator not in ("=", "+=", "-=", "*=", "/=", "|=", "&="):
            self.at -= 1
            self.need(";")
        value = self.expression()
        self.need(";")
        return Assign(target, operator, value)

    def condition(self) -> If:
        self.need("if")
        self.need("(")
        condition = self.expression()
        self.need(")")
        yes, no = self.block(), ()
        if self.take("else"):
            no = (self.condition(),) if self.peek() == "if" else self.block()  # type: ignore[assignment]
        return If(condition, yes, no)

    def loop(self) -> For:
        self.need("for")
        self.need("(")
        self.need("int")
        name = self.next()
        self.need("=")
        first = self.expression()
        self.need(";")
        self.need(name)
        comparison = self.next()
        end = self.expression()
        self.need(";")
        self.need(name)
        change = self.next()
        step = {"++": 1, "--": -1}.get(change, 0)
        if not step:
            step = int(self.next()) * {"+=": 1, "-=": -1}[change]
        self.need(")")
        return For(name, first, comparison, end, step, self.block())

    # ---- Expressions ----

    def expression(self) -> Expr:
        condition = self.binary(0)
        if not self.take("?"):
            return condition
        yes = self.expression()
        self.need(":")
        return Choice(condition, yes, self.expression())

    def binary(self, level: int) -> Expr:
        if level == len(_LEVELS):
            return self.unary()
        left = self.binary(level + 1)
        while self.peek() in _LEVELS[level].split():
            operator = self.next()
            left = Binary(operator, left, self.binary(level + 1))
        return left

    def unary(self) -> Expr:
        if self.peek() in ("-", "!", "&", "*"):
            return Unary(self.next(), self.unary())
        if self.peek() == "(" and self.peek(1) in (*_REALS, "int", "void") and self.peek(2) == ")":
            self.next()
            kind = self.next()
            self.next()
            return Cast(kind, self.unary())
        return self.postfix()

    def postfix(self) -> Expr:
        if self.take("("):
            found = self.expression()
            self.need(")")
        elif self.peek() == "sizeof":
            self.next()
            self.unary()
            return Num("0")
        else:
            token = self.next()
            if not re.match(r"[\w.]", token):
                self.at -= 1
                self.need("a value")
            found = Num(token) if re.match(r"[\d.]", token) else Name(token)
        while True:
            if self.take("["):
                found = Index(found, self.expression())
                self.need("]")
            elif self.peek() in (".", "->"):
                self.next()
                found = Member(found, self.next())
            elif isinstance(found, Name) and self.take("("):
                arguments = []
                while not self.take(")"):
                    arguments.append(self.expression())
                    self.take(",")
                found = Call(found.name, tuple(arguments))
            else:
                return found
