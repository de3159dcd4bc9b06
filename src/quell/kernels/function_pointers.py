"""Functions of the user's own, called by address.

A user's function is compiled by Numba on its own, and parameters hold its address: one driver is
compiled for all such functions, and kept on disk. ``call`` and ``evaluate`` jump to an address from
compiled code, and do the same by ``ctypes`` from Python. Whoever holds an address must keep the
compiled function as long; addresses mean nothing in another process.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import types as nb_types
from numba.extending import intrinsic, overload

POINTER = nb_types.CPointer(nb_types.float64)


def call(address: int, *arguments: Any) -> None:
    """Call the function at ``address`` with whole numbers (int64), numbers (float64), and arrays by pointer.

    From compiled code this is a plain jump.
    """
    _through_ctypes(None, address, arguments)


def evaluate(address: int, *arguments: Any) -> float:
    """Do what ``call`` does with a function that returns a number, and return that."""
    return float(_through_ctypes(ctypes.c_double, address, arguments))


def _through_ctypes(returns: Any, address: int, arguments: tuple[Any, ...]) -> Any:
    kinds = [_kind(argument) for argument in arguments]
    passed = [
        argument.ctypes.data if isinstance(argument, np.ndarray) else argument
        for argument in arguments
    ]
    return ctypes.CFUNCTYPE(returns, *kinds)(address)(*passed)


def _kind(argument: Any) -> Any:
    if isinstance(argument, np.ndarray):
        return ctypes.c_void_p
    return ctypes.c_int64 if isinstance(argument, int | np.integer) else ctypes.c_double


def _jump(address: Any, arguments: Any, returns: Any) -> Any:
    """Return signature and code generator of a jump to an address."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        target, packed = values
        passed = []
        for i, kind in enumerate(arguments):
            value = builder.extract_value(packed, i)
            passed.append(
                context.make_array(kind)(context, builder, value).data
                if isinstance(kind, nb_types.Array)
                else value
            )
        result = ir.VoidType() if returns is nb_types.none else ir.DoubleType()
        function = builder.inttoptr(
            target, ir.FunctionType(result, [value.type for value in passed]).as_pointer()
        )
        called = builder.call(function, passed)
        return context.get_dummy_value() if returns is nb_types.none else called

    return returns(address, arguments), generate


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
    """Numba can't compile a user's function; the message says why, in a line."""


def jit_user_function(function: Callable[..., Any]) -> Any:
    """Return a user's function for use inside of one given to ``compile_cfunc``.

    Raises
    ------
    NotCompilableError
        where it is no plain function: a bound method, a callable object.
    """
    try:
        # Division by zero gives inf, as in numpy: an exception could not leave compiled code from
        # here.
        return numba.njit(getattr(function, "py_func", function), error_model="numpy")
    except TypeError as error:
        raise NotCompilableError(str(error)) from error


def compile_cfunc(signature: Any, function: Callable[..., Any]) -> Any:
    """Return a compiled function with an ``address``.

    Raises
    ------
    NotCompilableError
        where Numba can't compile it.
    """
    try:
        return numba.cfunc(signature)(function)
    except Exception as error:  # whatever Numba makes of it
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise NotCompilableError(" ".join(lines[:2])) from error
