"""What docstrings say of a call and of its parameters."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Any


def summary(call: Callable[..., Any]) -> str:
    """Return the first sentence, or paragraph, of a docstring."""
    return " ".join((inspect.getdoc(call) or "").split("\n\n")[0].split())


def described(call: Callable[..., Any]) -> dict[str, str]:
    """Return what the section "Parameters" says of each, by name; a class's bases are asked for what it leaves out."""
    if isinstance(call, type):
        told: dict[str, str] = {}
        for cls in reversed(call.__mro__[:-1]):
            told |= _section(inspect.cleandoc(cls.__dict__.get("__doc__") or ""))
        return told
    return _section(inspect.getdoc(call) or "")


def refers(text: str) -> bool:
    """Tell whether what a docstring says of a parameter is that another one says it."""
    return text.startswith("as for")


def _section(text: str) -> dict[str, str]:
    match = re.search(
        r"^Parameters\n-+\n(.*?)(?=^\w[^\n]*\n-+\n|\Z)", text, re.MULTILINE | re.DOTALL
    )
    told: dict[str, str] = {}
    if match:
        for names, words in re.findall(
            r"^(\S[^\n]*)\n((?:[ ]+[^\n]*\n?|\n)+)", match[1] + "\n", re.MULTILINE
        ):
            for name in names.split(","):
                told[name.strip().lstrip("*")] = " ".join(re.sub(r"\s*\[\d+\]_", "", words).split())
    return told
