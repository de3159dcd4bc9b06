"""Translation of Python expressions and calls to C.

The program as the parts of the translator know it.

Translation of Python expressions: the values of names, and operators on them.

Translation of calls: built-in functions, <math.h>, generic functions and kernels.
"""

from __future__ import annotations

import ast
import inspect
import math
import operator
from collections.abc import Callable
from math import prod
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from quell.export.translate.structs import Findings, Structs
from quell.export.translate.text import (
    AND,
    ATOM,
    BIT_AND,
    BIT_OR,
    BIT_XOR,
    EQUAL,
    LESS,
    NOTHING,
    OR,
    PRODUCT,
    SHIFT,
    SUM,
    TERNARY,
    UNARY,
    Array,
    Kind,
    Literals,
    Number,
    Several,
    Struct,
    TranslationError,
    Value,
    identifier,
    join,
    join_numbers,
)
from quell.kernels import functions, user_functions
from quell.kernels.dispatch import call_specialised, interpreted, is_finite
from quell.kernels.sized import clear
from quell.kernels.user_functions import origin_of

# ---- The program as the parts of the translator know it ----


class Translation(Protocol):
    """A program while it is written; ``program.py`` has it."""

    findings: Findings
    literals: Literals
    structs: Structs
    calls: Any  # a ``Calls``
    helpers: set[str]
    results: dict[str, Struct]
    externals: dict[str, str]  # declarations of functions that the user has in C

    def function(
        self,
        python: Callable[..., Any],
        arguments: list[Value],
        declaration: Callable[..., Any] | None = None,
        hints: tuple[str, ...] = (),
        into_array: bool = False,
    ) -> Any:
        """Return the C function of a Python function for arguments like these.

        If it implements a generic function, that is the ``declaration``. With ``into_array``, the
        last of them is an array for the numbers that it returns.
        """

    def has_function(self, name: str) -> bool:
        """Return whether a function has this name."""

    def named_constant(self, name: str, value: Any, module: str) -> str:
        """Return the C name of a constant of a module."""

    def pointer(self, kind: Kind, name: str, const: bool) -> str:
        """Return the declaration of a variable that points to an array or a struct."""

    def parameter(self, kind: Kind, name: str, const: bool) -> str:
        """Return the declaration of a parameter that is an array or a struct."""


# ---- Translation of Python expressions ----

_ARITHMETIC: dict[type, tuple[str, int, Callable[[Any, Any], Any]]] = {
    ast.Add: ("+", SUM, operator.add),
    ast.Sub: ("-", SUM, operator.sub),
    ast.Mult: ("*", PRODUCT, operator.mul),
    ast.Div: ("/", PRODUCT, operator.truediv),
    ast.BitAnd: ("&", BIT_AND, operator.and_),
    ast.BitOr: ("|", BIT_OR, operator.or_),
    ast.BitXor: ("^", BIT_XOR, operator.xor),
    ast.LShift: ("<<", SHIFT, operator.lshift),
    ast.RShift: (">>", SHIFT, operator.rshift),
}
_BITS = (BIT_AND, BIT_OR, BIT_XOR, SHIFT)
_COMPARISONS: dict[type, tuple[str, int, Callable[[Any, Any], bool]]] = {
    ast.Lt: ("<", LESS, operator.lt),
    ast.LtE: ("<=", LESS, operator.le),
    ast.Gt: (">", LESS, operator.gt),
    ast.GtE: (">=", LESS, operator.ge),
    ast.Eq: ("==", EQUAL, operator.eq),
    ast.NotEq: ("!=", EQUAL, operator.ne),
}


class Expressions:
    """The expressions of one function; ``names`` are its parameters and local variables."""

    def __init__(
        self, program: Translation, globals_: dict[str, Any], where: str, module: str
    ) -> None:
        self.program = program
        self.literals = program.literals
        self.globals = globals_
        self.where = where
        self.module = module
        self.names: dict[str, Value] = {}
        self.written: set[str] = set()  # parameters through which something is written
        self.pending: list[str] = []  # calls before the statement whose results are known

    def fail(self, node: ast.AST, why: str) -> TranslationError:
        """Return an error about a node."""
        return TranslationError(f"{self.where}: {ast.unparse(node)}: {why}")

    def translate(self, node: ast.expr) -> Value:
        """Return the value of an expression."""
        method = getattr(self, f"_{type(node).__name__.lower()}", None)
        if method is None:
            raise self.fail(node, f"the translation to C has no {type(node).__name__}")
        return method(node)

    def constant(self, value: Any) -> Value:
        """Return a number that is known now."""
        kind = (
            Number.BOOL
            if isinstance(value, bool)
            else Number.INT
            if isinstance(value, int)
            else Number.REAL
        )
        code = self.literals.write(value)
        return Value(kind, code, UNARY if code.startswith("-") else ATOM, value)

    def real(self, value: Value) -> Value:
        """Return a number as a real number."""
        if value.kind is Number.REAL:
            return value
        if not value.is_number:
            raise TranslationError(f"{self.where}: {value.code} is not a number")
        if value.is_constant:
            return self.constant(float(value.constant))
        code = f"({self.literals.real}){value.at(UNARY)}"
        return Value(Number.REAL, code, UNARY, calls=value.calls)

    def as_kind(self, value: Value, kind: Number) -> Value:
        """Return a number as one of a kind that can hold it."""
        return self.real(value) if kind is Number.REAL else value

    def _constant(self, node: ast.Constant) -> Value:
        if isinstance(node.value, bool | int | float):
            return self.constant(node.value)
        raise self.fail(node, "only numbers can be translated")

    def _name(self, node: ast.Name) -> Value:
        found = self.names.get(node.id)
        if found is not None:
            return found
        if node.id in self.globals:
            return self._global(node, self.globals[node.id])
        raise self.fail(node, "has no value here")

    def _global(self, node: ast.Name, value: Any) -> Value:
        if isinstance(value, np.bool_ | np.number):
            value = value.item()
        if isinstance(value, bool):
            return self.constant(value)
        if isinstance(value, int | float):
            number = int(value) if isinstance(value, int) else float(value)
            if isinstance(number, float) and not math.isfinite(number):
                return self.constant(number)
            name = self.program.named_constant(node.id, number, self.module)
            kind = Number.INT if isinstance(number, int) else Number.REAL
            return Value(kind, name, constant=number)
        if isinstance(value, tuple) and value and all(isinstance(v, int | float) for v in value):
            numbers = tuple(map(float, value))
            name = self.program.named_constant(node.id, numbers, self.module)
            return Value(Array((len(numbers),), Number.REAL), name)
        is_array = isinstance(value, np.ndarray) and value.size and value.ndim in (1, 2)
        if is_array and value.dtype.kind in "fiub":
            name = self.program.named_constant(node.id, _as_tuples(value), self.module)
            return Value(Array(value.shape, Number.REAL), name)
        what = "numbers, and arrays of them with one or two dimensions, can be constants"
        raise self.fail(node, f"is {type(value).__name__}; only {what}")

    def _attribute(self, node: ast.Attribute) -> Value:
        if isinstance(node.value, ast.Name) and node.value.id not in self.names:
            owner = self.globals.get(node.value.id)
            if isinstance(owner, ModuleType | type):
                value = getattr(owner, node.attr)
                return self.constant(int(value) if isinstance(value, int) else float(value))
        base = self.translate(node.value)
        if isinstance(base.kind, Array):
            if node.attr == "size":
                return self.constant(base.kind.size)
            if node.attr == "shape":
                items = tuple(self.constant(length) for length in base.kind.shape)
                return Value(Several(tuple(item.kind for item in items)), items=items)
        if isinstance(base.kind, Struct):
            found = self.program.structs.field(base, node.attr)
            if found is not None:
                return found
        raise self.fail(node, "has no such field")

    def _subscript(self, node: ast.Subscript) -> Value:
        base = self.translate(node.value)
        if isinstance(base.kind, Several):
            return base.items[self.translate(node.slice).constant]
        if isinstance(base.kind, Struct):
            if base.kind.python is tuple:
                return self.program.structs.entry(base, self.translate(node.slice).constant)
            if self.translate(node.slice).constant == 0:  # the only record of an array
                return base
            raise self.fail(node, "a record has only the index 0")
        if not isinstance(base.kind, Array):
            raise self.fail(node, "is not an array")
        if not base.code:
            raise self.fail(node, "an array annotated with Scratch needs a name first")
        if isinstance(node.slice, ast.Slice):
            return self._slice(node, base, node.slice)
        indices = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        shape, code = base.kind.shape, base.at(ATOM)
        calls = False
        for at, length in zip(indices, shape, strict=False):
            index = self.translate(at)
            if index.kind is Number.REAL:
                raise self.fail(node, "an index must be an integer")
            if index.is_constant and index.constant < 0:
                index = self.constant(index.constant + length)
            code += f"[{index.code}]"
            calls = calls or index.calls
        rest = shape[len(indices) :]
        kind = Array(rest, base.kind.element) if rest else base.kind.element
        return Value(kind, code, ATOM, root=base.root, mutable=base.mutable, calls=calls)

    def _slice(self, node: ast.Subscript, base: Value, part: ast.Slice) -> Value:
        if part.step is not None:
            raise self.fail(node, "a slice must be without a step")
        size = base.kind.shape[0]
        lower = self.constant(0) if part.lower is None else self.translate(part.lower)
        upper = self.constant(size) if part.upper is None else self.translate(part.upper)
        length = self._length(node, part, lower, upper, size)
        code = base.code if lower.constant == 0 else f"&{base.at(ATOM)}[{lower.code}]"
        level = base.level if lower.constant == 0 else UNARY
        kind = Array((length, *base.kind.shape[1:]), base.kind.element)
        return Value(kind, code, level, root=base.root, mutable=base.mutable)

    def _length(
        self, node: ast.Subscript, part: ast.Slice, lower: Value, upper: Value, size: int
    ) -> int:
        """Return the length of a slice, which must not depend on variables."""
        if lower.is_constant and upper.is_constant:
            low, high, _ = slice(lower.constant, upper.constant).indices(size)
            return max(high - low, 0)
        # The difference of two bounds such as (i + 1) * n and i * n is the same for any i.
        bounds = [part.lower or ast.Constant(0), part.upper or ast.Constant(size)]
        expression = ast.Expression(ast.Tuple(bounds, ast.Load()))
        code = compile(ast.fix_missing_locations(expression), "<slice>", "eval")
        lengths, rule = set(), "the length of a slice must be known"
        for trial in (3, 17, 101):
            known = {
                name: value.constant if value.is_constant else trial
                for name, value in self.names.items()
            }
            try:
                low, high = eval(code, {"__builtins__": {}}, known)
            except Exception:  # a bound is more than names, numbers and operators
                raise self.fail(node, rule) from None
            lengths.add(high - low)
        if len(lengths) != 1:
            raise self.fail(node, rule)
        return int(lengths.pop())

    def _unaryop(self, node: ast.UnaryOp) -> Value:
        inner = self.translate(node.operand)
        if isinstance(node.op, ast.Not):
            if inner.is_constant:
                return self.constant(not inner.constant)
            return Value(Number.BOOL, f"!{inner.at(UNARY)}", UNARY, calls=inner.calls)
        if isinstance(node.op, ast.USub):
            code = f"-{inner.at(ATOM)}"
            constant = -inner.constant if inner.is_constant else inner.constant
            return Value(inner.kind, code, UNARY, constant, calls=inner.calls)
        raise self.fail(node, "only 'not' and '-' can be translated")

    def _binop(self, node: ast.BinOp) -> Value:
        return self.operation(node, node.op, self.translate(node.left), self.translate(node.right))

    def operation(self, node: ast.AST, sign: ast.operator, one: Value, other: Value) -> Value:
        """Return an arithmetic operation on two numbers."""
        if not (one.is_number and other.is_number):
            raise self.fail(node, "arithmetic is for numbers")
        if isinstance(sign, ast.Pow | ast.Mod | ast.FloorDiv):
            return self.program.calls.special_operation(self, sign, one, other)
        if type(sign) not in _ARITHMETIC:
            raise self.fail(node, "this operator can not be translated")
        text, level, function = _ARITHMETIC[type(sign)]
        # Before all kernels are read, a number that one of them changes still counts as zero.
        is_defined = text != "/" or other.constant != 0
        if one.is_constant and other.is_constant and is_defined:
            return self.constant(function(one.constant, other.constant))
        if (plain := self._neutral(text, one, other)) is not None:
            return plain
        kind = join_numbers(one, other, self.where)
        if text == "/" or kind is Number.REAL:
            one, other, kind = self.real(one), self.real(other), Number.REAL
        elif kind is Number.BOOL and level not in _BITS:
            kind = Number.INT
        # Operands of bit operations are in parentheses unless they are plain: compilers warn.
        left, right = (UNARY, UNARY) if level in _BITS else (level, level + 1)
        code = f"{one.at(left)} {text} {other.at(right)}"
        return Value(kind, code, level, calls=one.calls or other.calls)

    def _neutral(self, sign: str, one: Value, other: Value) -> Value | None:
        """Return the value of an operation with a zero or a one, if that is known.

        A product with the constant zero is zero: all signals are finite.
        """
        zeros = [value.is_constant and value.constant == 0 for value in (one, other)]
        if any(zeros) and not (one.calls or other.calls):
            real = Number.REAL in (one.kind, other.kind)
            if sign == "*" or (sign == "/" and zeros[0]):
                return self.constant(0.0 if real else 0)
            rest = other if zeros[0] else one
            if sign == "+" or (sign == "-" and zeros[1]):
                return self.real(rest) if real else rest
        return None

    def _compare(self, node: ast.Compare) -> Value:
        values = [self.translate(part) for part in (node.left, *node.comparators)]
        if any(value.calls for value in values[1:-1]):
            raise self.fail(node, "a call in the middle of a chained comparison")
        found = self.constant(True)
        for sign, one, other in zip(node.ops, values[:-1], values[1:], strict=True):
            text, level, function = _COMPARISONS[type(sign)]
            if one.is_constant and other.is_constant:
                part = self.constant(function(one.constant, other.constant))
            else:
                flag = self._flag(text, one, other)
                if flag is not None:
                    found = self._and(found, flag)
                    continue
                if join(one.kind, other.kind, self.where) is Number.REAL:
                    one, other = self._as_integers(one, other)
                code = f"{one.at(level + 1)} {text} {other.at(level + 1)}"
                part = Value(Number.BOOL, code, level, calls=one.calls or other.calls)
            found = self._and(found, part)
        return found

    def _flag(self, sign: str, one: Value, other: Value) -> Value | None:
        """Return the comparison of a truth value with 0 or 1 as the truth value, or not it."""
        if one.kind is not Number.BOOL or other.constant not in (0, 1) or sign not in ("==", "!="):
            return None
        if (sign == "==") == bool(other.constant):
            return one
        return Value(Number.BOOL, f"!{one.at(UNARY)}", UNARY, calls=one.calls)

    def _as_integers(self, one: Value, other: Value) -> tuple[Value, Value]:
        """Return two numbers of one kind: integers if one is, and the other is a whole constant."""
        pair = (one, other)
        for i in (0, 1):
            constant = pair[i].constant
            is_whole = isinstance(constant, float) and constant.is_integer()
            if pair[1 - i].kind is Number.INT and is_whole and abs(constant) < 2**15:
                number = self.constant(int(constant))
                return (number, other) if i == 0 else (one, number)
        return self.real(one), self.real(other)

    def _and(self, one: Value, other: Value) -> Value:
        if one.is_constant:
            return other if one.constant else self.constant(False)
        if other.is_constant and (other.constant or not one.calls):
            return one if other.constant else self.constant(False)
        code = f"{one.at(AND)} && {other.at(AND + 1)}"
        return Value(Number.BOOL, code, AND, calls=one.calls or other.calls)

    def _or(self, one: Value, other: Value) -> Value:
        if one.is_constant:
            return self.constant(True) if one.constant else other
        if other.is_constant and (not other.constant or not one.calls):
            return self.constant(True) if other.constant else one
        # Compilers warn about && without parentheses in ||.
        left = one.code if one.level == OR else one.at(BIT_OR)
        code = f"{left} || {other.at(BIT_OR)}"
        return Value(Number.BOOL, code, OR, calls=one.calls or other.calls)

    def _boolop(self, node: ast.BoolOp) -> Value:
        is_and = isinstance(node.op, ast.And)
        found = self.translate(node.values[0])
        for part in node.values[1:]:
            if found.is_constant and bool(found.constant) is not is_and:
                return found  # what follows is not evaluated
            following = self._conditional(part)
            found = self._and(found, following) if is_and else self._or(found, following)
        return found

    def _conditional(self, node: ast.expr) -> Value:
        """Return the value of an expression that is not always evaluated."""
        before = len(self.pending)
        found = self.translate(node)
        if len(self.pending) > before:
            raise self.fail(node, "call this function in a statement of its own")
        return found

    def _ifexp(self, node: ast.IfExp) -> Value:
        test = self.translate(node.test)
        if test.is_constant:
            return self.translate(node.body if test.constant else node.orelse)
        one, other = self._conditional(node.body), self._conditional(node.orelse)
        if one.is_constant and other.is_constant and _same(one.constant, other.constant):
            return one
        kind = join_numbers(one, other, self.where)
        one, other = self.as_kind(one, kind), self.as_kind(other, kind)
        is_flag = one.is_constant and other.is_constant and (one.constant, other.constant) == (1, 0)
        whole = test if is_flag and test.kind is Number.BOOL else None
        code = f"{test.at(TERNARY + 1)} ? {one.at(TERNARY + 1)} : {other.at(TERNARY)}"
        calls = test.calls or one.calls or other.calls
        return Value(kind, code, TERNARY, calls=calls, whole=whole)

    def _tuple(self, node: ast.Tuple) -> Value:
        items = tuple(self.translate(part) for part in node.elts)
        calls = any(item.calls for item in items)
        return Value(Several(tuple(item.kind for item in items)), items=items, calls=calls)

    def _call(self, node: ast.Call) -> Value:
        return self.call(node)

    def call(self, node: ast.Call, names: tuple[str, ...] = ()) -> Value:
        """Return the value of a call; ``names`` are those of the numbers of a tuple."""
        if node.keywords:
            raise self.fail(node, "arguments must be given by position")
        if isinstance(node.func, ast.Name) and self.globals.get(node.func.id) is call_specialised:
            node = ast.copy_location(ast.Call(node.args[0], node.args[1:], []), node)
        arguments = [self.translate(part) for part in node.args]
        if isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Name):
            module = self.globals.get(node.func.value.id)
            if module is math or module is np:
                whole = module is math
                return self.program.calls.math_call(self, node.func.attr, arguments, whole)
        if isinstance(node.func, ast.Name):
            name = node.func.id
            function = self.globals.get(name)
            if function is None:
                return self.program.calls.builtin(self, node, name, arguments)
            return self.program.calls.function(self, node, function, arguments, names)
        raise self.fail(node, "this call can not be translated")


def _as_tuples(array: Any) -> tuple[Any, ...]:
    """Return an array of one or two dimensions as tuples of real numbers."""
    if array.ndim > 1:
        return tuple(map(_as_tuples, array))
    return tuple(map(float, array))


def _same(one: Any, other: Any) -> bool:
    return type(one) is type(other) and (one == other or (one != one and other != other))


# ---- Translation of calls ----

# Functions of <math.h> with the name that they have in Python.
_SAME_NAME = (
    "sqrt sin cos tan tanh exp log log2 ceil floor copysign atan atan2 asin acos sinh cosh fabs "
    "hypot expm1 log1p"
)
_NUMPY = {"abs": "fabs", "absolute": "fabs", "arctan": "atan", "arctan2": "atan2"}
_INTEGERS = frozenset({"ceil", "floor"})  # they return integers in Python


def implementation_of(function: Any, head: Value) -> Callable[..., Any] | None:
    """Return the implementation of a generic function for its first argument; None without one."""
    cls = head.kind.python if isinstance(head.kind, Struct) else None
    found: Callable[..., Any] | None = function.implementations.get(cls)
    return found or function.implementations.get(object)


class Calls:
    """The calls of a program."""

    def __init__(self, program: Translation) -> None:
        self.program = program

    def helper(self, name: str) -> str:
        """Return the name of a helper function in C, which the program then contains."""
        self.program.helpers.add(name)
        return name

    def builtin(
        self, body: Expressions, node: ast.Call, name: str, arguments: list[Value]
    ) -> Value:
        """Return a call of a built-in function."""
        if name in ("min", "max"):
            found = arguments[0]
            for other in arguments[1:]:
                found = self._extreme(body, name, found, other)
            return found
        one = arguments[0]
        if name == "float":
            return body.real(one)
        if name == "bool":
            if one.kind is Number.BOOL or one.is_constant:
                return one if one.kind is Number.BOOL else body.constant(bool(one.constant))
            zero = body.as_kind(body.constant(0), one.kind)
            return Value(Number.BOOL, f"{one.at(SUM)} != {zero.code}", EQUAL, calls=one.calls)
        if name == "int":
            if one.kind is not Number.REAL:
                return Value(Number.INT, one.code, one.level, one.constant, calls=one.calls)
            if one.is_constant:
                return body.constant(int(one.constant))
            return self._call(Number.INT, self.helper("truncated"), one)
        if name == "abs":
            if one.is_constant:
                return body.constant(abs(one.constant))
            if one.kind is Number.REAL:
                return self._call(Number.REAL, self.program.literals.math_function("fabs"), one)
            return self._call(Number.INT, self.helper("absolute"), one)
        if name == "len" and isinstance(one.kind, Array):
            return body.constant(one.kind.shape[0])
        raise body.fail(node, f"{name}() can not be translated")

    def _extreme(self, body: Expressions, name: str, one: Value, other: Value) -> Value:
        if one.is_constant and other.is_constant:
            return body.constant({"min": min, "max": max}[name](one.constant, other.constant))
        kind = join_numbers(one, other, body.where)
        one, other = body.as_kind(one, kind), body.as_kind(other, kind)
        helper = f"{name}imum" + ("" if kind is Number.REAL else "_int")
        return self._call(kind, self.helper(helper), one, other)

    @staticmethod
    def _call(kind: Number, name: str, *arguments: Value) -> Value:
        code = ", ".join(argument.code for argument in arguments)
        return Value(kind, f"{name}({code})", ATOM, calls=any(a.calls for a in arguments))

    def math_call(
        self, body: Expressions, name: str, arguments: list[Value], whole: bool = True
    ) -> Value:
        """Return a call of a function of Python's ``math``, or of NumPy's of the same name.

        ``ceil`` and ``floor`` return whole numbers in Python, which NumPy's do not.
        """
        name = _NUMPY.get(name, name)
        if name not in _SAME_NAME.split():
            raise TranslationError(f"{body.where}: math.{name} can not be translated")
        if all(argument.is_constant for argument in arguments):
            return body.constant(getattr(math, name)(*(a.constant for a in arguments)))
        reals = [body.real(argument) for argument in arguments]
        found = self._call(Number.REAL, self.program.literals.math_function(name), *reals)
        if whole and name in _INTEGERS:
            return self._call(Number.INT, self.helper("truncated"), found)
        return found

    def special_operation(
        self, body: Expressions, sign: ast.operator, one: Value, other: Value
    ) -> Value:
        """Return a power, a remainder or a quotient that is rounded down."""
        if one.is_constant and other.is_constant:
            values = one.constant, other.constant
            if isinstance(sign, ast.Pow):
                return body.constant(values[0] ** values[1])
            whole = isinstance(sign, ast.FloorDiv)
            return body.constant(values[0] // values[1] if whole else values[0] % values[1])
        if isinstance(sign, ast.Pow):
            name = self.program.literals.math_function("pow")
            return self._call(Number.REAL, name, body.real(one), body.real(other))
        kind = join_numbers(one, other, body.where)
        one, other = body.as_kind(one, kind), body.as_kind(other, kind)
        base = "remainder" if isinstance(sign, ast.Mod) else "quotient"
        ending = "real" if kind is Number.REAL else "int"
        return self._call(kind, self.helper(f"{base}_{ending}"), one, other)

    def function(
        self,
        body: Expressions,
        node: ast.Call,
        function: Any,
        arguments: list[Value],
        names: tuple[str, ...],
    ) -> Value:
        """Return a call of a kernel, or of the implementation of a generic function."""
        if function is clear:
            return self._clear(body, arguments[0])
        if function is is_finite:
            if arguments[0].is_constant:
                return body.constant(math.isfinite(arguments[0].constant))
            return self._is_finite(body.real(arguments[0]))
        if function in (user_functions.call, user_functions.evaluate):
            returns = function is user_functions.evaluate
            return self._user_function(body, node, arguments, returns)
        if function is functions.is_single:
            return body.constant(self.program.literals.single)
        if function is functions.single:
            return body.real(arguments[0])
        if getattr(function, "__module__", "") == functions.__name__:
            return self.math_call(body, function.__name__, arguments)
        implementation, declaration = self._resolve(body, node, function, arguments)
        found = self.program.function(implementation, arguments, declaration, names)
        return found.call(body, arguments)

    def _is_finite(self, value: Value) -> Value:
        """Return the test whether a real number is finite.

        Of a variable it compares the variable itself: a program that analyses the C code then knows
        its range where the test holds, which it can't conclude from the result of a function. Not
        all of them conclude from an order that a number is one: ``x == x`` says it.
        """
        x = value.code
        if not x.isidentifier():
            return self._call(Number.BOOL, self.helper("is_finite"), value)
        largest = "FLT_MAX" if self.program.literals.single else "DBL_MAX"
        code = f"{x} == {x} && {x} >= -{largest} && {x} <= {largest}"
        return Value(Number.BOOL, code, AND)

    def _clear(self, body: Expressions, record: Value) -> Value:
        """Return the call that sets all numbers of a record to zero."""
        structs = self.program.structs
        for field in structs.layouts[record.kind.name].members:
            place = structs.field(record, field)
            if place is not None and place.is_constant and place.constant != 0:
                structs.vary((record.kind.name, field), Number.BOOL)
        if not structs.fields_of(record.kind):
            return Value(NOTHING)
        body.written.add(record.root)
        size = f"sizeof *{record.code}" if record.pointer else f"sizeof {record.code}"
        return Value(NOTHING, f"(void)memset({record.address}, 0, {size})", calls=True)

    def _resolve(
        self, body: Expressions, node: ast.Call, function: Any, arguments: list[Value]
    ) -> tuple[Callable[..., Any], Callable[..., Any] | None]:
        if hasattr(function, "implementations"):
            implementation = implementation_of(function, arguments[0])
            if implementation is None:
                raise body.fail(node, f"has no implementation for {arguments[0].kind}")
            return implementation, function
        if hasattr(function, "unrolled"):
            return function.unrolled(self.program.structs.count(arguments[0])), function
        plain = interpreted(function)
        if not inspect.isfunction(plain):
            raise body.fail(node, f"{plain!r} is no function that can be translated")
        return plain, None

    def _user_function(
        self, body: Expressions, node: ast.Call, arguments: list[Value], returns: bool
    ) -> Value:
        """Return a call of a user's function, which its address stands for.

        If it ``returns`` nothing, its last argument is the array for the numbers in its tuple.
        """
        origin = origin_of(arguments[0].constant)
        if origin is None:
            raise body.fail(node, "calls a function by its address")
        given = arguments[1:]
        if origin.numbers is not None:
            given = _with_numbers(given, origin.numbers, returns, self.program.literals.real)
        if origin.c_function is not None:
            return self._c_function(body, origin.c_function, given)
        origin.check_unchanged()
        if returns:
            found = self.program.function(origin.function, given)
        else:
            found = self.program.function(origin.function, given, into_array=True)
        return found.call(body, given)

    def _c_function(self, body: Expressions, name: str, given: list[Value]) -> Value:
        """Return a call of a function that the user has in C."""
        if identifier(name) != name:
            raise TranslationError(
                f"c_function = {name!r}: is a keyword or macro in C or C++; rename it"
            )
        body.written.add(given[-1].root)
        kinds = [self._c_parameter(value, value is given[-1]) for value in given]
        self.program.externals[name] = f"void {name}({', '.join(kinds)});"
        return Value(NOTHING, f"{name}({', '.join(value.code for value in given)})", calls=True)

    def _c_parameter(self, value: Value, written: bool) -> str:
        real = self.program.literals.real
        if isinstance(value.kind, Array):
            return f"{'' if written else 'const '}{real} *"
        return real


def _with_numbers(
    given: list[Value], numbers: tuple[int, user_functions.Shapes], returns: bool, real: str
) -> list[Value]:
    """Return arguments with the function's own parameters in place of the array of all of them.

    The array is the last argument, or the last but one of a function that ``returns`` nothing. A
    vector is a part of it, and a matrix such a part that is read as rows.
    """
    first, shapes = numbers
    at = len(given) - (1 if returns else 2)
    array = given[at]
    own = []
    for shape in shapes:
        element = f"{array.at(ATOM)}[{first}]"
        kind = Array(shape, array.kind.element) if shape else array.kind.element
        code = f"&{element}" if shape else element
        if len(shape) > 1:
            code = f"(const {real} (*)[{shape[1]}]){code}"
        level = UNARY if shape else ATOM
        own.append(Value(kind, code, level, root=array.root, mutable=array.mutable))
        first += prod(shape)
    return [*given[:at], *own, *given[at + 1 :]]
