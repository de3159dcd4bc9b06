"""Translate functions in C, as ``c_reader`` reads them, to the body of a function block.

All functions that a step calls are written into one body, because Structured Text of PLCs differs
in what it allows as arguments of functions. Members of structs become variables of the function
block. Integers are ``DWORD`` where they are flags, and ``DINT`` where they count: which of both
follows from what is done with them. Operations keep the order that they have in C, so the results
have the same bits where the compiler of the PLC does not change it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from quell.export.reserved import is_taken_in_st
from quell.export.structured_text.c_reader import (
    NO_TEXT,
    Assign,
    Binary,
    Braces,
    Break,
    Call,
    Cast,
    CFile,
    Choice,
    Declare,
    Evaluate,
    Expr,
    For,
    Function,
    If,
    Index,
    Member,
    Name,
    Num,
    Return,
    Statement,
    Unary,
)
from quell.export.structured_text.places import (
    LARGEST,
    SCALE,
    SMALLEST,
    Array,
    Kind,
    Node,
    Place,
    Record,
    Variable,
    Whole,
    atom,
    count,
    flat,
    inside,
    real_text,
)
from quell.export.translate.text import TranslationError

# ---- The function that is written ----


@dataclass
class _Scope:
    """A function that is written."""

    function: str
    names: dict[str, Place]
    result: Place | None
    done: str = ""  # the variable that says that a return was reached, where one is in use
    loops: int = 0  # loops around the statement, within the function
    loops_at_done: int = 0


_MATHS = {"fabs": "ABS", "sqrt": "SQRT", "sin": "SIN", "cos": "COS", "tan": "TAN", "exp": "EXP",
          "log": "LN"}  # fmt: skip
_OPERATORS = {
    "*": ("*", 7), "/": ("/", 7), "%": ("MOD", 7), "+": ("+", 6), "-": ("-", 6),
    "<": ("<", 5), ">": (">", 5), "<=": ("<=", 5), ">=": (">=", 5), "==": ("=", 4),
    "!=": ("<>", 4), "&&": ("AND", 3), "&": ("AND", 3), "||": ("OR", 1), "|": ("OR", 1),
}  # fmt: skip
_INDENT = "    "


class Translator:
    """Writer of the body and the variables of a function block.

    Parameters
    ----------
    file
        the C code.
    single
        whether real numbers are ``REAL``.
    taken
        names that variables may not have.
    """

    def __init__(self, file: CFile, single: bool, taken: tuple[str, ...]) -> None:
        self.file, self.single = file, single
        self.real = "REAL" if single else "LREAL"
        self.variables: dict[str, list[Variable]] = {
            "constant": [],
            "parameter": [],
            "state": [],
            "local": [],
        }
        self.first: list[Callable[[], str]] = []  # statements of the first call
        self._taken = {name.lower() for name in taken}
        self._lines: list[tuple[int, Callable[[], str]]] = []
        self._depth = 0
        self._locals: dict[tuple[str, str], Place] = {}
        self._constants: dict[str, Place] = {}
        self._extremes: dict[float, Node] = {}
        self._conditional = 0
        self._scopes: list[_Scope] = []

    # ---- Text ----

    def emit(self, text: str | Callable[[], str]) -> None:
        """Add a line of the body."""
        line = text if callable(text) else lambda: text
        self._lines.append((self._depth, line))

    def captured(self, work: Callable[[], Any]) -> tuple[Any, list[tuple[int, Callable[[], str]]]]:
        """Return what ``work`` returns, and the lines that it adds, which are taken away."""
        kept, self._lines = self._lines, []
        try:
            found = work()
            return found, self._lines
        finally:
            self._lines = kept

    def text(self) -> str:
        """Return the body."""
        return "".join(f"{_INDENT * depth}{line()}\n" for depth, line in self._lines)

    def _branch(self, head: str | Callable[[], str], work: Callable[[], Any]) -> None:
        """Write a line, and what belongs below it."""
        self.emit(head)
        self.indented(work)

    def indented(self, work: Callable[[], Any], depth: int = 1) -> None:
        """Write what ``work`` writes, further to the right."""
        self._depth += depth
        before = len(self._lines)
        work()
        if len(self._lines) == before:
            # Some compilers take no empty statement.
            nothing = self._local_scalar("", "nothing", "bool")
            self.emit(f"{nothing.text()} := FALSE;")
        self._depth -= depth

    def run(self, name: str, names: dict[str, Place], statements: tuple[Statement, ...]) -> None:
        """Write statements of a function with these names."""
        self._scopes.append(_Scope(name, names, None))
        self.block(statements)
        self._scopes.pop()

    # ---- Variables ----

    def name(self, wished: str) -> str:
        """Return a name that no variable has."""
        plain = re.sub(r"_+", "_", wished).strip("_") or "x"
        plain = f"v_{plain}" if is_taken_in_st(plain) or plain[0].isdigit() else plain
        found, number = plain, 2
        while found.lower() in self._taken:
            found, number = f"{plain}_{number}", number + 1
        self._taken.add(found.lower())
        return found

    def kind(self, kind: str) -> Kind:
        """Return the kind of a type in C."""
        if kind in ("double", "float"):
            return "real"
        if kind == "bool":
            return "bool"
        if kind in ("int", "int32_t"):
            return Whole()
        raise TranslationError(f"type {kind} of C: {NO_TEXT}")

    def kind_name(self, kind: Kind) -> str:
        """Return the type of a kind in Structured Text."""
        if isinstance(kind, Whole):
            return kind.name
        return {"real": self.real, "bool": "BOOL"}[kind]

    def variable(self, wished: str, kind: Kind, section: str, shape: tuple[int, ...] = ()) -> Place:
        """Add a variable; return it."""
        name = self.name(wished)
        self.variables[section].append(Variable(name, kind, shape))
        if shape:
            return Array(name, kind, shape)
        return atom(name, kind)._replace(is_fixed=section in ("constant", "parameter"))

    def _local(self, key: tuple[str, str], make: Callable[[], Place]) -> Place:
        """Return the local variable of a function; one for all calls, which do not overlap.

        Calls of a function that is one expression do overlap: each has a key of its own.
        """
        if key not in self._locals:
            self._locals[key] = make()
        return self._locals[key]

    def member(self, record: Record, name: str) -> Place:
        """Return a member of a struct."""
        if name in record.members:
            return record.members[name]
        declared = self.file.structs[record.struct]
        at = next(i for i, each in enumerate(declared) if each.name == name)
        wished = f"{record.prefix}_{name}" if record.prefix else name
        values = record.values.values[at] if record.values is not None else None
        of = declared[at]
        if of.is_pointer:
            raise TranslationError(f"pointer {name} in a struct: {NO_TEXT}")
        if of.kind in self.file.structs:
            if of.shape:
                raise TranslationError(f"array {name} of structs: {NO_TEXT}")
            inner = values if isinstance(values, Braces) else None
            place: Place = Record(of.kind, wished, record.section, inner)
        else:
            shape = tuple(int(each) for each in of.shape)
            place = self.variable(wished, self.kind(of.kind), record.section, shape)
            if values is not None:
                self._set_initial(self.variables[record.section][-1], values)
        record.members[name] = place
        return place

    def _set_initial(self, variable: Variable, values: Expr) -> None:
        """Set the initial values of a variable; in the first call those that are no literals."""
        if not variable.shape:
            node = self.evaluate(values)
            if isinstance(node, Node):
                self._set_scalar(variable, node)
            return
        numbers = list(flat(values))
        nodes = [self._node(each) for each in numbers]
        places = list(np.ndindex(*variable.shape))
        for place, node in zip(places, nodes, strict=True):
            if node.is_atom:  # an extreme number
                index = ", ".join(map(str, place))
                self.first.append(partial(str, f"{variable.name}[{index}] := {node.text()};"))
        variable.value = lambda: (
            "[" + ", ".join("0.0" if each.is_atom else each.text() for each in nodes) + "]"
        )

    def _set_scalar(self, variable: Variable, node: Node) -> None:
        if isinstance(variable.kind, Whole) and isinstance(node.kind, Whole):
            variable.kind.unify(node.kind)
        if node.is_atom:
            self.first.append(lambda: f"{variable.name} := {node.text()};")
        else:
            variable.value = node.text

    def extreme(self, value: float) -> Node:
        """Return a real number as a literal, or a variable where it is extreme."""
        if math.isinf(value):
            value = math.copysign(float(np.finfo(np.float32 if self.single else float).max), value)
        size = abs(value)
        if self.single or size == 0.0 or SMALLEST <= size <= LARGEST:
            text = real_text(value)
            return Node("real", lambda: text, 8 if value < 0.0 else 9, is_fixed=True)
        if value not in self._extremes:
            variable = self.name("extreme")
            self.variables["state"].append(Variable(variable, "real"))
            times = 0
            while not SMALLEST <= size <= LARGEST:
                size, times = size / SCALE if size > 1.0 else size * SCALE, times + 1
            start, factor = real_text(math.copysign(size, value)), SCALE
            if abs(value) < 1.0:
                factor = 1.0 / SCALE
            scale = real_text(factor)
            shown = real_text(value)
            lines = [f"{variable} := {start}; (* becomes {shown} *)"]
            lines += [f"{variable} := {variable} * {scale};"] * times
            self.first[0:0] = [partial(str, line) for line in lines]
            self._extremes[value] = atom(variable, "real")._replace(is_fixed=True)
        return self._extremes[value]

    # ---- Functions ----

    def call(
        self, function: Function, arguments: list[Place], result: Place | None = None
    ) -> Place | None:
        """Write the body of a function with these arguments; return its result."""
        is_pure = all(each.is_const or not (each.is_pointer or each.shape)
                      for each in function.parameters)  # fmt: skip
        if self._conditional and not is_pure:
            raise TranslationError(
                f"{function.name} is called under a condition within an expression: {NO_TEXT}"
            )
        if any(scope.function == function.name for scope in self._scopes):
            raise TranslationError(f"{function.name} calls itself: {NO_TEXT}")
        changed = set(_assigned(function.body))
        names: dict[str, Place] = {}
        for parameter, given in zip(function.parameters, arguments, strict=True):
            if not isinstance(given, Node):
                names[parameter.name] = given
                continue
            may_stand = given.is_fixed or (given.is_atom and is_pure)
            if may_stand and parameter.name not in changed:
                names[parameter.name] = given
                continue
            key = (function.name, parameter.name)
            if _is_expression(function):
                # Its text is used after this call, perhaps after another call of it.
                key = (f"{function.name} {len(self._locals)}", parameter.name)
            place = self._local_scalar(*key, parameter.kind)
            self.assign(place, given)
            names[parameter.name] = place
        only = function.body[0] if _is_expression(function) else None
        if isinstance(only, Return) and result is None:
            value = only.value
            if value is None:
                return None
            self._scopes.append(_Scope(function.name, names, None))
            try:
                return self.evaluate(value)
            finally:
                self._scopes.pop()
        if result is None and function.kind != "void":
            result = self._result(function)
        scope = _Scope(function.name, names, result)
        self._scopes.append(scope)
        conditional, self._conditional = self._conditional, 0
        try:
            self.block(function.body)
        finally:
            self._scopes.pop()
            self._conditional = conditional
        return result

    def _result(self, function: Function) -> Place:
        if function.kind in self.file.structs:
            return Record(function.kind, f"{function.name}_result", "local")
        return self.variable(f"{function.name}_result", self.kind(function.kind), "local")

    def _local_scalar(self, function: str, name: str, kind: str) -> Node:
        place = self._local((function, name),
                            lambda: self.variable(name, self.kind(kind), "local"))  # fmt: skip
        if not isinstance(place, Node):
            raise AssertionError
        return place

    # ---- Statements ----

    def block(self, statements: tuple[Statement, ...]) -> None:
        """Write statements; what follows a return is written into the branches without it."""
        for i, each in enumerate(statements):
            rest = statements[i + 1 :]
            if isinstance(each, Return):
                self._give(each.value)
                return
            if not (isinstance(each, If | For) and _has_return((each,))):
                self.statement(each)
                continue
            if isinstance(each, If) and _always_returns(each.yes) and not _has_return(each.no):
                self._if(If(each.condition, each.yes, (*each.no, *rest)))
                return
            if isinstance(each, If) and _always_returns(each.yes) and _always_returns(each.no):
                self._if(each)
                return
            self._with_flag(each, rest)
            return

    def _with_flag(self, statement: If | For, rest: tuple[Statement, ...]) -> None:
        """Write a statement that may return, and what follows where it does not."""
        scope = self._scopes[-1]
        before = scope.done, scope.loops_at_done
        outer = scope.done
        if not scope.done:
            done = self._local_scalar(scope.function, "done", "bool")
            scope.done, scope.loops_at_done = done.text(), scope.loops
            self.emit(f"{scope.done} := FALSE;")
        self.statement(statement)
        if rest:
            self._branch(f"IF NOT {scope.done} THEN", lambda: self.block(rest))
            self.emit("END_IF;")
        if not outer:
            scope.done, scope.loops_at_done = before

    def _give(self, value: Expr | None) -> None:
        """Write a return."""
        scope = self._scopes[-1]
        if value is not None and scope.result is not None:
            self._set(scope.result, value)
        if scope.done:
            self.emit(f"{scope.done} := TRUE;")
        if scope.loops > 1 + scope.loops_at_done:
            raise TranslationError(f"a return within two loops: {NO_TEXT}")
        if scope.loops > scope.loops_at_done:
            self.emit("EXIT;")

    def statement(self, each: Statement) -> None:
        """Write a statement."""
        if isinstance(each, Declare):
            self._declare(each)
        elif isinstance(each, Assign):
            self._change(each)
        elif isinstance(each, Evaluate):
            self._effect(each.value)
        elif isinstance(each, If):
            self._if(each)
        elif isinstance(each, For):
            self._for(each)
        elif isinstance(each, Break):
            self.emit("EXIT;")
        else:
            self._give(each.value)

    def _declare(self, each: Declare) -> None:
        scope, of = self._scopes[-1], each.variable
        if of.is_pointer:
            if each.value is None:
                raise AssertionError
            scope.names[of.name] = self.evaluate(each.value)
            return
        if of.kind in self.file.structs:
            key = (scope.function, of.name)
            scope.names[of.name] = self._local(key, lambda: Record(of.kind, of.name, "local"))
        elif of.shape:
            shape = tuple(int(n) for n in of.shape)
            scope.names[of.name] = self._local((scope.function, of.name),
                lambda: self.variable(of.name, self.kind(of.kind), "state", shape))  # fmt: skip
        else:
            scope.names[of.name] = self._local_scalar(scope.function, of.name, of.kind)
        if each.value is not None:
            self._set(scope.names[of.name], each.value)

    def _set(self, place: Place, value: Expr) -> None:
        """Write ``place := value``."""
        if isinstance(place, Node) and isinstance(value, Choice):
            condition = self._node(value.condition)
            yes, no = value.yes, value.no
            self._branch(lambda: f"IF {condition.text()} THEN", lambda: self._set(place, yes))
            self._branch("ELSE", lambda: self._set(place, no))
            self.emit("END_IF;")
            return
        if isinstance(value, Call) and self.file.has(value.name):
            function = self.file.function(value.name)
            given = [self.evaluate(each) for each in value.arguments]
            found = self.call(function, given, None if _is_expression(function) else place)
            if found is not place and found is not None:
                self._copy(place, found)
            return
        if isinstance(value, Braces):
            self._fill(place, value)
            return
        self._copy(place, self.evaluate(value))

    def _fill(self, place: Place, value: Braces) -> None:
        if isinstance(place, Record):
            members = self.file.structs[place.struct]
            for member, each in zip(members, value.values, strict=True):
                self._set(self.member(place, member.name), each)
            return
        if not isinstance(place, Array):
            raise TranslationError(f"braces for a number: {NO_TEXT}")
        given = list(flat(value))
        zero = Num("0.0") if place.kind == "real" else Num("0")
        for k, index in enumerate(np.ndindex(*place.shape)):
            number = given[k] if k < len(given) else zero
            self._set(self._at(place, [count(i) for i in index]), number)

    def _copy(self, place: Place, value: Place) -> None:
        if isinstance(place, Node) and isinstance(value, Node):
            self.assign(place, value)
        elif isinstance(place, Record) and isinstance(value, Record):
            for member in self.file.structs[place.struct]:
                self._copy(self.member(place, member.name), self.member(value, member.name))
        else:
            raise TranslationError(f"an array is copied: {NO_TEXT}")

    def assign(self, place: Node, value: Node) -> None:
        """Write ``place := value;``."""
        self._same_kind(place, value)
        self.emit(lambda: f"{place.text()} := {value.text()};")

    def _same_kind(self, one: Node, two: Node) -> None:
        if isinstance(one.kind, Whole) and isinstance(two.kind, Whole):
            one.kind.unify(two.kind)
        elif one.kind == "real" and isinstance(two.kind, Whole) and not two.is_atom:
            two.kind.use("REAL")  # the integer 0 where a real number begins
        elif one.kind != two.kind:
            raise TranslationError(f"a value of another type is assigned: {NO_TEXT}")

    def _change(self, each: Assign) -> None:
        place = self.evaluate(each.target)
        if each.operator == "=":
            self._set(place, each.value)
            return
        if not isinstance(place, Node):
            raise TranslationError(f"{each.operator} of an array: {NO_TEXT}")
        self.assign(place, self._binary(each.operator[0], place, self._node(each.value)))

    def _effect(self, value: Expr) -> None:
        if isinstance(value, Cast):
            value = value.operand
        if not isinstance(value, Call):
            raise TranslationError(f"an expression without effect: {NO_TEXT}")
        if value.name == "memset":
            self._clear(self.evaluate(value.arguments[0]))
        elif value.name == "memcpy":
            self._copy_array(*(self.evaluate(each) for each in value.arguments[:2]))
        else:
            function = self.file.function(value.name)
            self.call(function, [self.evaluate(each) for each in value.arguments])

    def _clear(self, place: Place) -> None:
        if isinstance(place, Record):
            for member in self.file.structs[place.struct]:
                if not member.is_pointer:
                    self._clear(self.member(place, member.name))
        elif isinstance(place, Array):
            for index in np.ndindex(*place.shape):
                self._clear(self._at(place, [count(i) for i in index]))
        elif place.kind == "bool":
            self.emit(lambda: f"{place.text()} := FALSE;")
        else:
            self.assign(place, self._node(Num("0.0" if place.kind == "real" else "0")))

    def _copy_array(self, target: Place, source: Place) -> None:
        if not (isinstance(target, Array) and isinstance(source, Array)):
            self._copy(target, source)
            return
        for index in np.ndindex(*target.shape):
            places = [count(i) for i in index]
            self._copy(self._at(target, places), self._at(source, places))

    def _if(self, each: If) -> None:
        condition = self._node(each.condition)
        self._branch(lambda: f"IF {condition.text()} THEN", lambda: self.block(each.yes))
        no = each.no
        while len(no) == 1 and isinstance(no[0], If) and not _has_return(no):
            if not self._elsif(no[0]):
                break
            no = no[0].no
        if no:
            self._branch("ELSE", lambda: self.block(no))
        self.emit("END_IF;")

    def _elsif(self, each: If) -> bool:
        """Write a further condition; return false if statements have to stand before it."""
        condition, lines = self.captured(lambda: self._node(each.condition))
        if lines:
            return False
        self._branch(lambda: f"ELSIF {condition.text()} THEN", lambda: self.block(each.yes))
        return True

    def _for(self, each: For) -> None:
        scope = self._scopes[-1]
        if each.name in _assigned(each.body):
            raise TranslationError(f"a loop changes its own count: {NO_TEXT}")
        variable = self._local_scalar(scope.function, each.name, "int")
        scope.names[each.name] = variable
        first, end = self._node(each.first), self._node(each.end)
        for number in (variable, first, end):
            if isinstance(number.kind, Whole):
                number.kind.use("DINT")
        # Some compilers make no pass from 0 to 0, so FOR is for two passes and more.
        passes = _passes(each)
        scope.loops += 1
        if passes == 1:
            self.assign(variable, first)
            self.block(each.body)
        elif passes is not None:
            last = int(first.text()) + (passes - 1) * each.step
            by = "" if each.step == 1 else f" BY {each.step}"
            head = f"FOR {variable.text()} := {first.text()} TO {last}{by} DO"
            self._branch(head, lambda: self.block(each.body))
            self.emit("END_FOR;")
        else:
            step = count(abs(each.step))
            more = self._binary(each.comparison, variable, end)
            following = self._binary("+" if each.step > 0 else "-", variable, step)
            self.assign(variable, first)
            self._branch(lambda: f"WHILE {more.text()} DO", lambda: self.block(each.body))
            self.indented(lambda: self.assign(variable, following))
            self.emit("END_WHILE;")
        scope.loops -= 1

    # ---- Expressions ----

    def _node(self, value: Expr) -> Node:
        found = self.evaluate(value)
        if not isinstance(found, Node):
            raise TranslationError(f"an array or a struct as a number: {NO_TEXT}")
        return found

    def evaluate(self, value: Expr) -> Place:
        """Return an expression, or the place that it names."""
        if isinstance(value, Num):
            return self._number(value.text)
        if isinstance(value, Name):
            return self._named(value.name)
        if isinstance(value, Member):
            owner = self.evaluate(value.owner)
            if not isinstance(owner, Record):
                raise AssertionError
            return self.member(owner, value.name)
        if isinstance(value, Index):
            array, index = self.evaluate(value.array), self._node(value.at)
            if not isinstance(array, Array):
                raise TranslationError(f"an index of what is no array: {NO_TEXT}")
            return self._at(array, [index])
        if isinstance(value, Unary):
            return self._unary(value)
        if isinstance(value, Binary):
            left = self.evaluate(value.left)
            if isinstance(left, Array) and value.operator == "+":
                return self._moved(left, self._node(value.right))
            if not isinstance(left, Node):
                raise TranslationError(f"arithmetic with a pointer: {NO_TEXT}")
            if value.operator in ("&&", "||"):
                return self._binary(value.operator, left, self._under_condition(value.right))
            return self._binary(value.operator, left, self._node(value.right))
        if isinstance(value, Choice):
            condition = self._node(value.condition)
            yes, no = self._under_condition(value.yes), self._under_condition(value.no)
            self._same_kind(yes, no)
            return Node(yes.kind, lambda: f"SEL({condition.text()}, {no.text()}, {yes.text()})")
        if isinstance(value, Cast):
            return self._cast(value)
        if isinstance(value, Call):
            return self._call(value)
        raise TranslationError(f"braces in an expression: {NO_TEXT}")

    def _under_condition(self, value: Expr) -> Node:
        self._conditional += 1
        try:
            return self._node(value)
        finally:
            self._conditional -= 1

    def _number(self, text: str) -> Node:
        if re.fullmatch(r"(0x[0-9a-fA-F]+|[1-9]\d*|0)U?L*", text):
            digits, kind = text.rstrip("UL"), Whole()
            number = int(digits, 16 if digits.startswith("0x") else 10)

            def shown() -> str:
                forms = {"DWORD": f"DWORD#16#{number:X}", "REAL": f"{number}.0"}
                return forms.get(kind.name, str(number))

            return Node(kind, shown, is_fixed=True)
        if not re.fullmatch(r"(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?[fF]?", text) or text.isdigit():
            raise TranslationError(f"number {text} of C: {NO_TEXT}")  # octal numbers, for instance
        return self.extreme(float(text.rstrip("fF")))

    def _named(self, name: str) -> Place:
        for known in (self._scopes[-1].names if self._scopes else {}, self._constants):
            if name in known:
                return known[name]
        if name in ("true", "false"):
            return Node("bool", name.upper, is_fixed=True)
        if name in ("DBL_MAX", "FLT_MAX", "INFINITY"):
            return self.extreme(math.inf)
        if name not in self.file.constants:
            raise TranslationError(f"name {name} of C: {NO_TEXT}")
        declared, value = self.file.constants[name]
        shape = tuple(int(each) for each in declared.shape)
        if not shape and declared.kind in ("double", "float"):
            number = self._node(value)
            if number.is_atom:
                self._constants[name] = number
                return number
        place = self.variable(name, self.kind(declared.kind), "constant", shape)
        self._set_initial(self.variables["constant"][-1], value)
        self._constants[name] = place
        return place

    def _at(self, array: Array, index: list[Node]) -> Place:
        for each in index:
            if isinstance(each.kind, Whole):
                each.kind.use("DINT")
        first = index[0] if array.offset is None else self._binary("+", array.offset, index[0])
        leading = (*array.leading, first, *index[1:])
        shape = array.shape[len(index) :]
        if shape:
            return Array(array.name, array.kind, shape, leading)
        text = array.name
        return Node(array.kind, lambda: f"{text}[{', '.join(n.text() for n in leading)}]", 9, True)

    def _moved(self, array: Array, offset: Node) -> Array:
        """Return an array from a place on."""
        if isinstance(offset.kind, Whole):
            offset.kind.use("DINT")
        if len(array.shape) != 1:
            raise TranslationError(f"a part of a matrix by a pointer: {NO_TEXT}")
        whole = offset if array.offset is None else self._binary("+", array.offset, offset)
        return array._replace(offset=whole)

    def _unary(self, value: Unary) -> Place:
        if value.operator == "&":
            if isinstance(value.operand, Index):
                array = self.evaluate(value.operand.array)
                if isinstance(array, Array):
                    return self._moved(array, self._node(value.operand.at))
            return self.evaluate(value.operand)
        extremes = [Name(each) for each in ("INFINITY", "DBL_MAX", "FLT_MAX")]
        if value.operator == "-" and value.operand in extremes:
            return self.extreme(-math.inf)
        operand = self._node(value.operand)
        if value.operator == "!":
            return Node("bool", lambda: f"NOT {inside(operand, 8)}", 8)
        if value.operator != "-":
            raise TranslationError(f"a pointer that is followed: {NO_TEXT}")
        if (
            operand.kind == "real"
            and operand.is_fixed
            and re.fullmatch(r"[\d.E+-]+", operand.text())
        ):
            return self.extreme(-float(operand.text()))
        if isinstance(operand.kind, Whole):
            operand.kind.use("DINT")
        return Node(operand.kind, lambda: f"-{inside(operand, 9)}", 8)

    def _binary(self, operator: str, left: Node, right: Node) -> Node:
        shown, level = _OPERATORS[operator]
        kind: Kind = left.kind
        if isinstance(left.kind, Whole) and isinstance(right.kind, Whole):
            left.kind.unify(right.kind)
            if operator in ("&", "|"):
                left.kind.use("DWORD")
            elif operator not in ("==", "!="):
                left.kind.use("DINT")
        elif left.kind != right.kind:
            raise TranslationError(f"an operation of two types: {NO_TEXT}")
        if level in (4, 5) or operator in ("&&", "||"):
            kind = "bool"
        # Comparisons of comparisons, and a - (b - c), keep their parentheses.
        return Node(
            kind,
            lambda: f"{inside(left, level + (level in (4, 5)))} {shown} {inside(right, level + 1)}",
            level,
        )

    def _cast(self, value: Cast) -> Node:
        operand = self._node(value.operand)
        if value.kind in ("double", "float") and operand.kind == "real":
            return operand
        if value.kind in ("double", "float") and isinstance(operand.kind, Whole):
            operand.kind.use("DINT")
            return Node("real", lambda: f"DINT_TO_{self.real}({operand.text()})")
        raise TranslationError(f"conversion to {value.kind}: {NO_TEXT}")

    def _call(self, value: Call) -> Place:
        plain = value.name.removesuffix("f")
        known = next((each for each in (value.name, plain) if each in _MATHS), None)
        if known is not None and not self.file.has(value.name):
            (argument,) = (self._node(each) for each in value.arguments)
            return Node("real", lambda: f"{_MATHS[known]}({argument.text()})")
        if value.name in ("pow", "powf"):
            base, power = (self._node(each) for each in value.arguments)
            return Node("real", lambda: f"EXPT({base.text()}, {power.text()})")
        function = self.file.function(value.name)
        found = self.call(function, [self.evaluate(each) for each in value.arguments])
        if found is None:
            raise AssertionError
        return found


# ---- Parts of trees and texts ----


def _passes(each: For) -> int | None:
    """Return how many passes a loop makes; None where that is not known, or there may be none."""
    if not (isinstance(each.first, Num) and isinstance(each.end, Num)) or _has_break(each.body):
        return None
    first, end = int(each.first.text), int(each.end.text)
    stop = end + {"<": 0, "<=": 1, ">": 0, ">=": -1}[each.comparison]
    return len(range(first, stop, each.step)) or None


def _has_break(statements: tuple[Statement, ...]) -> bool:
    """Return whether a loop around the statements may end early."""
    return any(
        isinstance(each, Break | Return)
        or (isinstance(each, If) and (_has_break(each.yes) or _has_break(each.no)))
        for each in statements
    )


def _is_expression(function: Function) -> bool:
    """Return whether a function is one expression."""
    return len(function.body) == 1 and isinstance(function.body[0], Return)


def _has_return(statements: tuple[Statement, ...]) -> bool:
    """Return whether a return may be reached."""
    return any(
        isinstance(each, Return)
        or (isinstance(each, If) and (_has_return(each.yes) or _has_return(each.no)))
        or (isinstance(each, For) and _has_return(each.body))
        for each in statements
    )


def _always_returns(statements: tuple[Statement, ...]) -> bool:
    """Return whether a return is reached in any case."""
    return any(
        isinstance(each, Return)
        or (isinstance(each, If) and _always_returns(each.yes) and _always_returns(each.no))
        for each in statements
    )


def _assigned(statements: tuple[Statement, ...]) -> Iterator[str]:
    """Yield the names of variables that statements assign to."""
    for each in statements:
        if isinstance(each, Assign) and isinstance(each.target, Name):
            yield each.target.name
        elif isinstance(each, If):
            yield from _assigned(each.yes)
            yield from _assigned(each.no)
        elif isinstance(each, For):
            yield from _assigned(each.body)
