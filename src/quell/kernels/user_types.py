"""Types with implementations that the user registered, and errors of compiling these."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core.errors import NumbaError

# Types with implementations from outside of this package, and their names in messages.
_USER_TYPES: dict[type, str] = {}

# Lines of Numba's error text that carry no reason.
_NO_REASON = re.compile(
    r"\W*$|There are \d|- Of which|Overload in|With argument|Rejected as|- Resolution|"
    r"(\w+Error: )?Failed in nopython"
)


def add_user_type(cls: type) -> None:
    """Add a type for which the user has registered an implementation."""
    _USER_TYPES.setdefault(cls, cls.__name__)


def set_display_name(cls: type, name: str) -> None:
    """Use ``name`` for a user's type in messages: users know the class that makes it better."""
    if cls in _USER_TYPES:
        _USER_TYPES[cls] = name


def uses_user_types(value: Any) -> bool:
    """Return whether ``value``, or an entry of a tuple at any depth, is of a user's type."""
    if not _USER_TYPES:
        return False
    return type(value) in _USER_TYPES or (
        isinstance(value, tuple) and any(map(uses_user_types, value))
    )


@contextmanager
def explain_compile_errors(*arguments: Any) -> Iterator[None]:
    """Replace Numba's error about a user's function by a ``ValueError`` with one line."""
    try:
        yield
    except NumbaError as error:
        message = _explanation(str(error)) if any(map(uses_user_types, arguments)) else ""
        if not message:
            raise
        raise ValueError(message) from None


def _explanation(text: str) -> str:
    """Return the error of the innermost user's function in Numba's text; empty if there is none."""
    names = {cls.__name__: name for cls, name in _USER_TYPES.items()}
    calls = [found for found in re.finditer(r">>> (\w+)\((\w+)\(", text) if found[2] in names]
    if not calls:
        return ""
    rest = text[calls[-1].end() :]
    lines = [line.strip() for line in rest.splitlines()[1:]]
    reason = next((line for line in lines if not _NO_REASON.match(line)), "no reason given")
    allocates = "NRT required" in rest or "Only accept returning of array" in rest
    return (
        f"{names[calls[-1][2]]}.{calls[-1][1]} (for {calls[-1][2]}) "
        f"{'allocates memory' if allocates else 'can not be compiled'} "
        f"({reason.removesuffix(' found for signature:')}): use loops over numbers and arrays that "
        "are there from the start, as fields of the memory; no new arrays, no lists, no slices "
        "that are assigned to. simulate(..., interpret=True) runs it as Python"
    )
