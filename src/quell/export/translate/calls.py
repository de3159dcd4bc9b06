"""Translation of calls: built-in functions, <math.h>, generic functions and kernels."""

from __future__ import annotations

import ast
import inspect
import math
from collections.abc import Callable
from typing import Any

from quell.export.translate.expressions import Expressions
from quell.export.translate.interfaces import Translation
from quell.export.translate.naming import identifier
from quell.export.translate.values import (
    AND,
    ATOM,
    EQUAL,
    NOTHING,
    SUM,
    Array,
    Number,
    Struct,
    TranslationError,
    Value,
    join_numbers,
)
from quell.kernels import function_pointers, functions
from quell.kernels.dispatch import interpreted, is_finite
from quell.kernels.function_pointers import origin_of
from quell.kernels.scalars import clear

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
        if function in (function_pointers.call, function_pointers.evaluate):
            returns = function is function_pointers.evaluate
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
            given = _with_numbers(given, origin.numbers, returns)
        if origin.c_function is not None:
            return self._c_function(body, origin.c_function, given)
        if returns:
            found = self.program.function(origin.function, given)
        else:
            found = self.program.function(origin.function, given, into_array=True)
        return found.call(body, given)

    def _c_function(self, body: Expressions, name: str, given: list[Value]) -> Value:
        """Return a call of a function that the user has in C."""
        if identifier(name) != name:
            raise TranslationError(f"c_function = {name!r}: is a keyword of C or C++")
        body.written.add(given[-1].root)
        kinds = [self._c_parameter(value, value is given[-1]) for value in given]
        self.program.externals[name] = f"void {name}({', '.join(kinds)});"
        return Value(NOTHING, f"{name}({', '.join(value.code for value in given)})", calls=True)

    def _c_parameter(self, value: Value, written: bool) -> str:
        real = self.program.literals.real
        if isinstance(value.kind, Array):
            return f"{'' if written else 'const '}{real} *"
        return real


def _with_numbers(given: list[Value], numbers: tuple[int, int], returns: bool) -> list[Value]:
    """Return arguments with the function's own parameters in place of the array of all of them.

    The array is the last argument, or the last but one of a function that ``returns`` nothing.
    """
    first, count = numbers
    at = len(given) - (1 if returns else 2)
    array = given[at]
    kind = array.kind.element
    own = [
        Value(kind, f"{array.at(ATOM)}[{i}]", ATOM, root=array.root, mutable=array.mutable)
        for i in range(first, first + count)
    ]
    return [*given[:at], *own, *given[at + 1 :]]
