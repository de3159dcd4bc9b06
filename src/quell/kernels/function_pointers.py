"""User-defined functions that kernels call by address.

A user's function is compiled by Numba on its own, and parameters have its address: so one driver is
compiled for all such functions and cached on disk. ``call`` and ``evaluate`` jump to an address
from compiled code, and use ``ctypes`` from Python. Keep a reference to the compiled function as
long as its address is in use; addresses are not valid in another process.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from llvmlite import ir
from numba.core import types as nb_types
from numba.extending import intrinsic, overload

POINTER = nb_types.CPointer(nb_types.float64)


class Origin(NamedTuple):
    """Origin of the function at an address."""

    function: Callable[..., Any]
    c_function: str | None  # name of the same function in C, if the user has one
    # Where its own parameters begin in the array of numbers that is passed, and how many there are;
    # None if no such array is passed.
    numbers: tuple[int, int] | None = None


_origins: dict[int, Origin] = {}


def set_origin(
    address: int,
    function: Callable[..., Any],
    c_function: str | None = None,
    numbers: tuple[int, int] | None = None,
) -> None:
    """Note what the function at an address was made of, for its translation to C."""
    _origins[address] = Origin(function, c_function, numbers)


def origin_of(address: Any) -> Origin | None:
    """Return what the function at an address was made of; None for any other number."""
    return _origins.get(address) if isinstance(address, int) else None


def call(address: int, *arguments: Any) -> None:
    """Call the function at ``address``.

    Integers are passed as int64, other numbers as float64, arrays by pointer.
    """
    _call_by_ctypes(None, address, arguments)


def evaluate(address: int, *arguments: Any) -> float:
    """Call the function at ``address`` as ``call`` does and return its result, a float64."""
    return float(_call_by_ctypes(ctypes.c_double, address, arguments))


def _call_by_ctypes(result_type: Any, address: int, arguments: tuple[Any, ...]) -> Any:
    types: list[Any] = []
    values = []
    for argument in arguments:
        is_array = isinstance(argument, np.ndarray)
        number = ctypes.c_int64 if isinstance(argument, int | np.integer) else ctypes.c_double
        types.append(ctypes.c_void_p if is_array else number)
        values.append(argument.ctypes.data if is_array else argument)
    return ctypes.CFUNCTYPE(result_type, *types)(address)(*values)


def _jump(address: Any, arguments: Any, result_type: Any) -> Any:
    """Return signature and code generator of a call of an address."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        target, packed = values
        passed = []
        for i, kind in enumerate(arguments):
            value = builder.extract_value(packed, i)
            if isinstance(kind, nb_types.Array):
                value = context.make_array(kind)(context, builder, value).data
            passed.append(value)
        result = ir.VoidType() if result_type is nb_types.none else ir.DoubleType()
        function_type = ir.FunctionType(result, [value.type for value in passed])
        called = builder.call(builder.inttoptr(target, function_type.as_pointer()), passed)
        return context.get_dummy_value() if result_type is nb_types.none else called

    return result_type(address, arguments), generate


@intrinsic
def _jump_to_procedure(typing_context: Any, address: Any, arguments: Any) -> Any:
    return _jump(address, arguments, nb_types.none)


@intrinsic
def _jump_to_function(typing_context: Any, address: Any, arguments: Any) -> Any:
    return _jump(address, arguments, nb_types.float64)


@overload(call, strict=False)
def _compiled_call(address: Any, *arguments: Any) -> Any:
    return lambda address, *arguments: _jump_to_procedure(address, arguments)


@overload(evaluate, strict=False)
def _compiled_evaluate(address: Any, *arguments: Any) -> Any:
    return lambda address, *arguments: _jump_to_function(address, arguments)


class NotCompilableError(Exception):
    """Numba can't compile a user's function; the message gives the reason in one line."""


def jit_user_function(function: Callable[..., Any]) -> Any:
    """Return a user's function for calls from a function that is passed to ``compile_cfunc``.

    Bound methods and callable objects raise a ``NotCompilableError``.
    """
    try:
        # Division by zero gives inf, as in numpy: an exception can't leave compiled code from here.
        return numba.njit(getattr(function, "py_func", function), error_model="numpy")
    except TypeError as error:
        raise NotCompilableError(str(error)) from error


def compile_cfunc(signature: Any, function: Callable[..., Any]) -> Any:
    """Return a function with an ``address``; raise a ``NotCompilableError`` if Numba can't."""
    try:
        return numba.cfunc(signature)(function)
    except Exception as error:  # compilation can raise anything
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise NotCompilableError(" ".join(lines[:2])) from error
