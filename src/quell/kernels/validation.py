"""Trial of user-defined functions, interpreted, so that mistakes are reported before compilation.

Each error names the user's class and the rule. Classes of this package are not tried.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from quell.kernels.dispatch import Generic
from quell.kernels.scalars import Scalars
from quell.kernels.user_types import set_display_name
from quell.types import Vector

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
