"""Trying what a user has written, interpreted and on a fresh memory, so that mistakes are named before anything is compiled.

Each error names the user's class and the rule. What belongs to this package is not tried: its tests
do that.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from quell.kernels.dispatch import Generic
from quell.kernels.user_types import set_display_name

UNKNOWN = object()
"""What a function returns is not known: numbers decide, and those of the trial were no good ones."""


def is_user_defined(thing: Any) -> bool:
    """Return whether the class of ``thing`` is from outside of this package."""
    return not type(thing).__module__.startswith("quell.")


def attempt(what: str, rule: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return what ``function`` returns; an error becomes a ``ValueError`` with ``what`` failed and the ``rule``."""
    try:
        with np.errstate(all="ignore"):
            return function(*arguments)
    except Exception as error:
        raise ValueError(f"{what} fails with {type(error).__name__}: {error}; {rule}") from error


def attempt_kernel(what: str, rule: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Do what ``attempt`` does; ``UNKNOWN`` where there is a division by zero and the like, which gives inf or NaN once it is compiled."""
    try:
        return attempt(what, rule, function, *arguments)
    except ValueError as error:
        if isinstance(error.__cause__, ArithmeticError) or "math domain" in str(error.__cause__):
            return UNKNOWN
        raise


def check_registered(name: str, parameters: Any, *functions: Generic[Any, Any]) -> None:
    """Say which of these generic functions have nothing registered for the type of ``parameters``, which belongs to ``name``."""
    cls = type(parameters)
    set_display_name(cls, name)
    missing = [
        f.__name__
        for f in functions
        if cls not in f.implementations and object not in f.implementations
    ]
    if missing:
        rules = ", ".join(f"@{function}.register({cls.__name__})" for function in missing)
        raise ValueError(
            f"{name}: nothing is registered for {', '.join(missing)} and its parameters {cls.__name__}; write it under {rules}"
        )


def check_named_tuple(what: str, value: Any, of: str) -> Any:
    """Return ``value`` if it is a NamedTuple; ``of`` says what of."""
    if not (isinstance(value, tuple) and hasattr(value, "_fields")):
        raise ValueError(f"{what} returns {type(value).__name__}: must return a NamedTuple of {of}")
    return value


def check_arrays(what: str, memory: Any, nested: bool) -> None:
    """Say which field of a NamedTuple is no array of numbers; NamedTuples may stand among them where ``nested``."""
    check_named_tuple(what, memory, "arrays")
    for name, value in zip(memory._fields, memory, strict=True):
        if nested and isinstance(value, tuple):
            check_arrays(f"{what}.{name}", value, nested)
        elif not (
            isinstance(value, np.ndarray) and value.dtype.kind in ("f" if nested else "fiub")
        ):
            kind = (
                f"array of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
            )
            raise ValueError(
                f"{what} has {name}, {kind}: all of its fields must be arrays of float64, one number in an array (1,)"
            )


def check_number(what: str, value: Any) -> None:
    """Say so where a function does not return one number."""
    if not isinstance(value, int | float | np.integer | np.floating):
        shape = (
            f" of shape {np.shape(value)}" if isinstance(value, np.ndarray | tuple | list) else ""
        )
        raise ValueError(f"{what} returns {type(value).__name__}{shape}: must return one number")


def sample_values(size: int, start: float = 1.0) -> Any:
    """Return some numbers within [−1, 1] (size,)."""
    return np.sin(start + np.arange(size))
