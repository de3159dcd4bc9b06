"""Functions of numbers that keep single precision, and the question which precision a number has.

Kernels run in double and in single precision. Interpreted, ``np.float32`` stays what it is in
arithmetic with Python's numbers, but the functions of ``math`` return Python's, which are double.
Those below return ``np.float32`` for ``np.float32``, and what ``math`` returns for all else.

Single results are those of the C library's own functions (``sinf``, ``expf`` …), which compiled
and exported code call, too. Where they can't be found, the double result is rounded, which differs
from them in the last bit at most.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numba import types as nb_types
from numba.extending import overload

from quell.kernels.linking import KERNEL_OPTIONS, OPTIONS

_COMPILED: dict[str, Any] = {"strict": False, "jit_options": OPTIONS | KERNEL_OPTIONS}

single = cast("type[float]", np.float32)
"""The type of numbers in single precision, for conversion in kernels; typed as a float."""


def is_single(value: float) -> bool:
    """Return whether ``value`` is in single precision; known at compilation.

    Interpreted, literals are Python's numbers and count as double: ask about a number that comes
    from an array or a parameter.
    """
    return isinstance(value, single)


@overload(is_single, **_COMPILED)
def _is_single(value: Any) -> Any:
    if value == nb_types.float32:
        return lambda value: True
    return lambda value: False


def sqrt(value: float) -> float:
    """Return the square root, in the precision of ``value``."""
    return single(math.sqrt(value)) if isinstance(value, single) else math.sqrt(value)


def sin(value: float) -> float:
    """Return the sine, in the precision of ``value``."""
    return _single("sin", value) if isinstance(value, single) else math.sin(value)


def cos(value: float) -> float:
    """Return the cosine, in the precision of ``value``."""
    return _single("cos", value) if isinstance(value, single) else math.cos(value)


def tanh(value: float) -> float:
    """Return the hyperbolic tangent, in the precision of ``value``."""
    return _single("tanh", value) if isinstance(value, single) else math.tanh(value)


def exp(value: float) -> float:
    """Return e to the power ``value``, in its precision."""
    return _single("exp", value) if isinstance(value, single) else math.exp(value)


def log2(value: float) -> float:
    """Return the logarithm to base 2, in the precision of ``value``."""
    return _single("log2", value) if isinstance(value, single) else math.log2(value)


def copysign(size: float, sign: float) -> float:
    """Return ``size`` with the sign of ``sign``, in the precision of ``size``."""
    signed = math.copysign(size, sign)
    return single(signed) if isinstance(size, single) else signed


@overload(sqrt, **_COMPILED)
def _sqrt(value: Any) -> Any:
    return lambda value: math.sqrt(value)


@overload(sin, **_COMPILED)
def _sin(value: Any) -> Any:
    return lambda value: math.sin(value)


@overload(cos, **_COMPILED)
def _cos(value: Any) -> Any:
    return lambda value: math.cos(value)


@overload(tanh, **_COMPILED)
def _tanh(value: Any) -> Any:
    return lambda value: math.tanh(value)


@overload(exp, **_COMPILED)
def _exp(value: Any) -> Any:
    return lambda value: math.exp(value)


@overload(log2, **_COMPILED)
def _log2(value: Any) -> Any:
    return lambda value: math.log2(value)


@overload(copysign, **_COMPILED)
def _copysign(size: Any, sign: Any) -> Any:
    return lambda size, sign: math.copysign(size, sign)


_functions: dict[str, Callable[[float], float]] = {}


def _single(name: str, value: float) -> float:
    """Return the single result of a function; errors are those of the function in ``math``."""
    found = _functions.get(name)
    if found is None:
        found = _functions[name] = _of_c_library(name) or getattr(math, name)
    if not math.isfinite(value) or (name == "log2" and value <= 0.0):
        return single(getattr(math, name)(value))
    return single(found(value))


def _of_c_library(name: str) -> Any:
    """Return the C library's function for single precision; None if there is none."""
    try:
        function = getattr(ctypes.CDLL(None), f"{name}f")
    except (OSError, AttributeError, TypeError):
        return None
    function.restype, function.argtypes = ctypes.c_float, (ctypes.c_float,)
    return function
