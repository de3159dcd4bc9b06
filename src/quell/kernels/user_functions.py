"""User-defined functions that kernels call by address.

A user's function is compiled by Numba on its own, and parameters have its address: so one driver is
compiled for all such functions and cached on disk. ``call`` and ``evaluate`` jump to an address
from compiled code, and use ``ctypes`` from Python. Keep a reference to the compiled function as
long as its address is in use; addresses are not valid in another process.

Trial of user-defined functions, interpreted, so that mistakes are reported before compilation.

Each error names the user's class and the rule. Classes of this package are not tried.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types as nb_types
from numba.extending import intrinsic, overload

from quell.kernels.dispatch import Generic, set_display_name
from quell.kernels.numba_internals import ir
from quell.kernels.sized import Scalars
from quell.types import Vector

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


UNKNOWN = object()  # the result of a function that fails for the numbers of the trial


def is_user_defined(thing: Any) -> bool:
    """Return whether the class of ``thing`` is from outside of this package."""
    return not type(thing).__module__.startswith("quell.")


def attempt(what: str, rule: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result of ``function``; its errors become a ``ValueError`` with the ``rule``."""
    try:
        with np.errstate(all="ignore"):
            return function(*arguments)
    except Exception as error:
        raise ValueError(f"{what} fails with {type(error).__name__}: {error}; {rule}") from error


def attempt_kernel(what: str, rule: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Do the same as ``attempt``, but return ``UNKNOWN`` after an arithmetic error.

    A division by zero, for example, is no error in compiled code: it gives inf or NaN.
    """
    try:
        return attempt(what, rule, function, *arguments)
    except ValueError as error:
        if isinstance(error.__cause__, ArithmeticError) or "math domain" in str(error.__cause__):
            return UNKNOWN
        raise


def check_registered(name: str, parameters: Any, *functions: Generic[Any, Any]) -> None:
    """Raise a ``ValueError`` if a function is not registered for the ``parameters`` of ``name``."""
    cls = type(parameters)
    set_display_name(cls, name)
    missing = [f.__name__ for f in functions if not {cls, object} & f.implementations.keys()]
    if missing:
        rules = ", ".join(f"@{function}.register({cls.__name__})" for function in missing)
        raise ValueError(
            f"{name}: nothing is registered for {', '.join(missing)} and its parameters "
            f"{cls.__name__}; write it under {rules}"
        )


def check_named_tuple(what: str, value: Any, of: str) -> None:
    """Raise a ``ValueError`` if ``value`` is not a NamedTuple; ``of`` describes its fields."""
    if not (isinstance(value, tuple) and hasattr(value, "_fields")):
        raise ValueError(f"{what} returns {type(value).__name__}: must return a NamedTuple of {of}")


def check_arrays(what: str, memory: Any, nested: bool) -> None:
    """Raise a ``ValueError`` if a field of a NamedTuple is not an array of numbers.

    If ``nested``, arrays must be of floats, or of one record of floats (``Scalars``), and
    NamedTuples of such arrays are allowed too: a memory may contain that of a part of this package.
    """
    check_named_tuple(what, memory, "arrays")
    for name, value in zip(memory._fields, memory, strict=True):
        if nested and isinstance(value, tuple):
            check_arrays(f"{what}.{name}", value, nested)
            continue
        is_array = isinstance(value, np.ndarray)
        if nested and is_array and _is_record_of_floats(value.dtype):
            continue
        if not is_array or value.dtype.kind not in ("f" if nested else "fiub"):
            kind = f"array of {value.dtype}" if is_array else type(value).__name__
            raise ValueError(
                f"{what} has {name}, {kind}: all of its fields must be arrays of float64, "
                "one number in an array (1,)"
            )


def _is_record_of_floats(dtype: np.dtype[Any]) -> bool:
    """Return whether it is the type of a ``Scalars`` whose fields are all floats."""
    fields = dtype.names or ()
    return issubclass(dtype.type, Scalars) and all(dtype[name] == np.float64 for name in fields)


def check_number(what: str, value: Any) -> None:
    """Raise a ``ValueError`` if ``value``, which ``what`` returned, is not one number."""
    if not isinstance(value, int | float | np.integer | np.floating):
        sized = isinstance(value, np.ndarray | tuple | list)
        shape = f" of shape {np.shape(value)}" if sized else ""
        raise ValueError(f"{what} returns {type(value).__name__}{shape}: must return one number")


def sample_values(size: int, start: float = 1.0) -> Vector:
    """Return some numbers in [−1, 1] (size,)."""
    return np.sin(start + np.arange(size))
