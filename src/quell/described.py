"""``repr`` of objects: the class, and the arguments that it was made with."""

from __future__ import annotations

import inspect
from functools import cache
from typing import Any

import numpy as np

# Longest array that is printed with its numbers, and digits of a number.
_MOST, _DIGITS = 64, 6


class Described:
    """A base class of objects that print their class and the numbers that they were made with."""

    def __repr__(self) -> str:
        parts = (f"{name}={text(value)}" for name, value in self.described().items())
        return f"{type(self).__name__}({', '.join(parts)})"

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints, by name: arguments that differ from their defaults.

        An argument is found by its name among the attributes.
        """
        found = {}
        cls: Any = type(self)
        for name, default in _arguments(cls).items():
            value = getattr(self, name, default)
            if not _same(value, default):
                found[name] = value
        return found


@cache
def _arguments(cls: Any) -> dict[str, Any]:
    """Return the arguments of a class by name, with their defaults.

    Where ``__init__`` forwards ``**options``, the keyword-only ones of the base class follow.
    """
    found: dict[str, Any] = {}
    for depth, each in enumerate(c for c in cls.__mro__ if "__init__" in vars(c)):
        parameters = [*inspect.signature(vars(each)["__init__"]).parameters.values()][1:]
        for parameter in parameters:
            if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
                continue
            if depth == 0 or parameter.kind is parameter.KEYWORD_ONLY:
                found.setdefault(parameter.name, parameter.default)
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            break
    return found


def _same(value: Any, default: Any) -> bool:
    if value is default:
        return True
    plain = (bool, int, float, str, tuple)
    return isinstance(value, plain) and type(value) is type(default) and bool(value == default)


def text(value: Any) -> str:
    """Return a value in one line, numbers with six digits, long arrays by their shape."""
    if isinstance(value, float | np.floating):
        return f"{float(value):.{_DIGITS}g}"
    if isinstance(value, np.ndarray):
        if value.size > _MOST:
            return f"<array {value.shape}>"
        return text(value.tolist())
    if isinstance(value, list):
        return f"[{', '.join(map(text, value))}]"
    if isinstance(value, tuple):
        fields = getattr(value, "_fields", None)
        if fields is not None:
            named = (f"{name}={text(part)}" for name, part in zip(fields, value, strict=True))
            return f"{type(value).__name__}({', '.join(named)})"
        inside = ", ".join(map(text, value))
        return f"({inside},)" if len(value) == 1 else f"({inside})"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key!r}: {text(part)}" for key, part in value.items()) + "}"
    if inspect.isroutine(value) or isinstance(value, type):
        return str(getattr(value, "__qualname__", type(value).__name__))
    kind: Any = type(value)
    if kind.__repr__ is object.__repr__:  # an address says nothing
        return f"{kind.__name__}()"
    return " ".join(repr(value).split())
