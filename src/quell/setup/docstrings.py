"""Descriptions from docstrings: of a function, and of its parameters."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Any

# A line of names, and the indented lines that describe them.
_ENTRY = re.compile(r"^(\S[^\n]*)\n((?:[ ]+[^\n]*\n?|\n)+)", re.MULTILINE)
_PARAMETERS = re.compile(r"^Parameters\n-+\n(.*?)(?=^\w[^\n]*\n-+\n|\Z)", re.MULTILINE | re.DOTALL)


def summary(function: Callable[..., Any]) -> str:
    """Return the first paragraph of a docstring."""
    return " ".join((inspect.getdoc(function) or "").split("\n\n")[0].split())


def parameter_descriptions(function: Callable[..., Any]) -> dict[str, str]:
    """Return the description of each parameter; a class inherits those of its bases."""
    if not isinstance(function, type):
        return _parameters(inspect.getdoc(function) or "")
    found: dict[str, str] = {}
    for cls in reversed(function.__mro__[:-1]):
        found |= _parameters(inspect.cleandoc(cls.__dict__.get("__doc__") or ""))
    return found


def is_reference(description: str) -> bool:
    """Return whether a description only refers to another one."""
    return description.startswith("as for")


def _parameters(docstring: str) -> dict[str, str]:
    section = _PARAMETERS.search(docstring)
    return {
        name.strip().lstrip("*"): " ".join(re.sub(r"\s*\[\d+\]_", "", text).split())
        for names, text in (_ENTRY.findall(section[1] + "\n") if section else ())
        for name in names.split(",")
    }
