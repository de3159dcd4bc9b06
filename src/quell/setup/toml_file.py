"""TOML files as dictionaries, within limits of size and depth."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from quell.reading import whole_text
from quell.setup.errors import SetupError

# Tables and lists within each other: setups have up to six; signals that follow each other may have
# more. Chosen by hand, below what Python and Pydantic can follow.
_DEEPEST = 50
# A key of more parts than that. Reading one takes a time of the order of their number squared.
_PART = r"(?:[\w-]++|\"[^\"\n]*+\"|'[^'\n]*+')[ \t]*+"
_DEEP_KEY = re.compile(rf"(?<![\w-]){_PART}(?:\.[ \t]*+{_PART}){{{_DEEPEST}}}")


def read(path: str | os.PathLike[str]) -> tuple[str, dict[str, Any]]:
    """Return the name of a TOML file, for messages, and its content.

    Raises
    ------
    SetupError
        for a file that cannot be read, or is not TOML.
    """
    name = Path(path).name
    try:
        text = whole_text(path)
    except OSError as error:
        raise SetupError([f"{path}: can't be read ({error.strerror})"]) from None
    except UnicodeDecodeError as error:
        raise SetupError([f"{name}: not TOML: byte {error.start} is not UTF-8"]) from None
    except ValueError as error:  # too long
        raise SetupError([f"{name}: not a setup: {error}"]) from None
    return name, parsed(name, text)


def parsed(name: str, text: str) -> dict[str, Any]:
    """Return the content of the text of a file called ``name``; raise as ``read``."""
    try:
        if _DEEP_KEY.search(text):
            raise RecursionError
        data = tomllib.loads(text)
        _check_depth(data)
        return data
    except tomllib.TOMLDecodeError as error:
        raise SetupError([f"{name}: not TOML: {error}"]) from None
    except RecursionError:
        raise SetupError([f"{name}: not a setup: tables or lists are nested too deeply"]) from None
    except ValueError as error:  # a number of more digits than Python reads
        raise SetupError([f"{name}: not a setup: {error}"]) from None


def _check_depth(data: Any) -> None:
    """Raise a ``RecursionError`` if tables or lists are deeper than those of any setup."""
    level = [data]
    for _ in range(_DEEPEST):
        level = [
            part
            for each in level
            if isinstance(each, dict | list)
            for part in (each.values() if isinstance(each, dict) else each)
        ]
    if level:
        raise RecursionError


def immutable(value: Any) -> Any:
    """Return a value with tuples in place of lists, and None in place of the text ``none``."""
    if isinstance(value, Mapping):
        return {key: immutable(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return tuple(immutable(part) for part in value)
    return None if value == "none" else value
