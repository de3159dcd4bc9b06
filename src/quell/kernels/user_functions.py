"""User-defined functions that kernels call by address.

A user's function is compiled by Numba on its own, and parameters have its address: so one driver is
compiled for all such functions and cached on disk. ``call`` and ``evaluate`` jump to an address
from compiled code, and use ``ctypes`` from Python. Keep a reference to the compiled function as
long as its address is in use; addresses are not valid in another process.

Numbers and arrays that a user's function takes by name are data, not code: one array holds all of
them, and compiled code reads it by a pointer. Other numbers of the same shapes compile nothing.

What it takes from outside without a name, globals and variables of enclosing functions, becomes a
constant of its code. Code is kept for a function together with these values (``frozen``), so that
changed values make other code.

Trial of user-defined functions, interpreted, so that mistakes are reported before compilation.

Each error names the user's class and the rule. Classes of this package are not tried.
"""

from __future__ import annotations

import ctypes
import inspect
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from math import prod
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types as nb_types
from numba.extending import intrinsic, overload

from quell import checks
from quell.kernels.dispatch import Generic, set_display_name
from quell.kernels.frozen import Frozen, frozen, outdated_helper
from quell.kernels.numba_internals import ir
from quell.kernels.sized import Scalars
from quell.types import Vector

POINTER = nb_types.CPointer(nb_types.float64)
Shapes = tuple[tuple[int, ...], ...]
"""Shapes of parameters in their order; that of a number is empty."""


class Origin(NamedTuple):
    """Origin of the function at an address."""

    function: Callable[..., Any]
    c_function: str | None  # name of the same function in C, if the user has one
    # Where its own parameters begin in the array of numbers that is passed, and their shapes; None
    # if no such array is passed.
    numbers: tuple[int, Shapes] | None = None
    frozen: Frozen | None = None  # what its code has from outside

    def check_unchanged(self) -> None:
        """Raise a ``ValueError`` if the function is not any more what its code was made of."""
        if self.frozen is not None and frozen(self.function) != self.frozen:
            raise ValueError(
                f"{self.function.__name__}: its globals or the variables around it have changed "
                "since it was compiled: make the parts that use it again, or pass them as arguments"
            )


_origins: dict[int, Origin] = {}


def set_origin(
    address: int,
    function: Callable[..., Any],
    c_function: str | None = None,
    numbers: tuple[int, Shapes] | None = None,
) -> None:
    """Note what the function at an address was made of, for its translation to C."""
    _origins[address] = Origin(function, c_function, numbers, frozen(function))


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

    Bound methods and callable objects raise a ``NotCompilableError``, and functions that call one
    of ``register_jitable`` whose globals have changed: Numba compiles that only once.
    """
    if (helper := outdated_helper(function)) is not None:
        raise NotCompilableError(
            f"{helper.__name__} has been compiled with other values of its globals or of the "
            "variables around it: define it again, or pass them as arguments"
        )
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


# ---- Parameters of a user's function, which are data of its compiled code ----

# Sets of shapes whose reader is kept. Chosen by hand: more than the functions of a study.
_KEPT = 64


def named_parameters(function: Callable[..., Any], first: int) -> dict[str, Any]:
    """Return the parameters of a function after its ``first`` ones, and their defaults."""
    try:
        takes = [*inspect.signature(function).parameters.values()][first:]
    except (TypeError, ValueError):
        return {}
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return {each.name: each.default for each in takes if each.kind not in variable}


def checked_value(name: str, value: Any) -> Any:
    """Return the value of a parameter: a number, or an array with one or two dimensions.

    Raises
    ------
    ValueError
        for anything else, for an array without entries, and for what is not finite.
    """
    if np.ndim(value) == 0 if isinstance(value, np.ndarray) else not checks.is_sequence(value):
        return checks.finite(name, value)
    array = checks.numbers(name, value)
    if array.ndim not in (1, 2) or array.size == 0:
        raise ValueError(
            f"{name} has shape {array.shape}: must be a number, or an array with one or two "
            "dimensions and at least one entry"
        )
    array.flags.writeable = False
    return array


def separated(name: str, function: Any, first: int) -> tuple[Callable[..., Any], dict[str, Any]]:
    """Return a function that ``functools.partial`` may have bound, and its values in their order.

    ``name`` is that of the argument, and ``first`` the number of arguments that are no parameters.

    Raises
    ------
    ValueError
        for values that are bound without a name, a name that the function does not take, and a
        parameter without a value.
    """
    if not isinstance(function, partial):
        return function, {}
    plain, given = function.func, function.keywords
    if function.args:
        raise ValueError(f"{name}: partial(…) binds {len(function.args)} values without a name: "
                         "give all by name")  # fmt: skip
    known, found = named_parameters(plain, first), {}
    for each in given:
        if each not in known:
            hint = checks.nearest(each, [*known]) if known else "it takes none"
            raise ValueError(f"{name}: partial(…) binds {each}, which is no parameter; {hint}")
    for each, default in known.items():
        value = given.get(each, default)
        if value is inspect.Parameter.empty:
            raise ValueError(f"{name}: parameter {each} has no value: bind it by partial(…)")
        found[each] = checked_value(f"{name}: {each}", value)
    return plain, found


def shapes_of(values: Mapping[str, Any]) -> Shapes:
    """Return the shapes of parameters, in their order."""
    return tuple(np.shape(value) for value in values.values())


def count_of(shapes: Shapes) -> int:
    """Return how many numbers parameters of these shapes have."""
    return sum(map(prod, shapes))


def as_array(*values: Mapping[str, Any]) -> Vector:
    """Return all parameters in one array, in their order, rows of matrices after each other."""
    parts = [np.ravel(value) for each in values for value in each.values()]
    return np.concatenate(parts) if parts else np.zeros(0)


@intrinsic
def _behind(typing_context: Any, pointer: Any, count: Any) -> Any:
    """Return the pointer to the number that is ``count`` places behind."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.gep(values[0], [values[1]])

    return POINTER(POINTER, nb_types.intp), generate


@lru_cache(maxsize=_KEPT)
def reader(shapes: Shapes, first: int = 0) -> Any:
    """Return the compiled function from the pointer to all numbers to a tuple of parameters.

    Those of these ``shapes`` begin at the number ``first``.
    """
    if not shapes:
        return numba.njit(lambda pointer: ())
    shape, others = shapes[0], reader(shapes[1:], first + prod(shapes[0]))
    if shape == ():
        return numba.njit(
            lambda pointer: (numba.carray(pointer, (first + 1,))[first], *others(pointer))
        )
    return numba.njit(
        lambda pointer: (numba.carray(_behind(pointer, first), shape), *others(pointer))
    )


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
