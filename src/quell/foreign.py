"""Calling a function by its address, compiled and interpreted alike.

From compiled code it is a plain jump. Whatever can be put behind an address can be called so, without compiling the caller anew: what Numba
compiled with ``cfunc``, and Python itself by ``ctypes.CFUNCTYPE``, which takes the interpreter's lock on its own.

Arguments are a tuple of whole numbers (int64), numbers (float64) and contiguous arrays, which are passed by pointer.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types as nb_types
from numba.extending import intrinsic, overload


def call_address(address: int, arguments: tuple[Any, ...]) -> None:
    """Call the function at ``address``, which returns nothing."""
    _interpreted(None, address, arguments)


def number_from_address(address: int, arguments: tuple[Any, ...]) -> float:
    """Call the function at ``address``, which returns a float64."""
    return float(_interpreted(ctypes.c_double, address, arguments))


def _interpreted(returns: Any, address: int, arguments: tuple[Any, ...]) -> Any:
    kinds: list[Any] = []
    values: list[Any] = []
    for argument in arguments:
        if isinstance(argument, np.ndarray):
            kinds.append(ctypes.c_void_p)
            values.append(argument.ctypes.data)
        elif isinstance(argument, int | np.integer):
            kinds.append(ctypes.c_int64)
            values.append(int(argument))
        else:
            kinds.append(ctypes.c_double)
            values.append(float(argument))
    return _prototype(returns, *kinds)(address)(*values)


@functools.cache
def _prototype(returns: Any, *kinds: Any) -> Any:
    return ctypes.CFUNCTYPE(returns, *kinds)


def _jump(returns: Any) -> Any:
    """Return what generates the code of a call."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        target, packed = values
        passed = []
        for i, kind in enumerate(signature.args[1]):
            value = builder.extract_value(packed, i)
            passed.append(context.make_array(kind)(context, builder, value).data if isinstance(kind, nb_types.Array) else value)
        result = ir.VoidType() if returns is nb_types.none else ir.DoubleType()
        function = builder.inttoptr(target, ir.FunctionType(result, [value.type for value in passed]).as_pointer())
        called = builder.call(function, passed)
        return context.get_dummy_value() if returns is nb_types.none else called

    return generate


@intrinsic
def _jump_for_nothing(typing_context: Any, address: Any, arguments: Any) -> Any:
    return nb_types.none(address, arguments), _jump(nb_types.none)


@intrinsic
def _jump_for_a_number(typing_context: Any, address: Any, arguments: Any) -> Any:
    return nb_types.float64(address, arguments), _jump(nb_types.float64)


@overload(call_address, strict=False)
def _compiled_call(address: Any, arguments: Any) -> Any:
    return lambda address, arguments: _jump_for_nothing(address, arguments)


@overload(number_from_address, strict=False)
def _compiled_number(address: Any, arguments: Any) -> Any:
    return lambda address, arguments: _jump_for_a_number(address, arguments)
