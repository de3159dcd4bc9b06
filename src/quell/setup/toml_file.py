"""TOML files as dictionaries, within limits of size and depth."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from quell.reading import begin_of, encoding_of, kind_of, whole_text
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
        for a file that cannot be read, or is not TOML; for a record it names the commands that take
        one.
    """
    name = Path(path).name
    try:
        return name, parsed(name, whole_text(path))
    except OSError as error:
        raise SetupError([f"{path}: can't be read ({error.strerror})"]) from None
    except UnicodeDecodeError as error:
        fault = SetupError([f"{name}: not TOML: byte {error.start} is not UTF-8"])
    except SetupError as error:
        fault = error
    except ValueError as error:  # too long
        fault = SetupError([f"{name}: not a setup: {error}"])
    raise _of_another_kind(path, name) or fault


def _of_another_kind(path: str | os.PathLike[str], name: str) -> SetupError | None:
    """Return an error that says what a file is that is no setup, None if that is not known."""
    # It takes longer to import than a setup to read.
    from quell.identification.experiment.record_layout import seems_record

    begin = begin_of(path)
    kind = kind_of(begin)
    text = begin.decode(encoding_of(begin), errors="replace")
    if Path(path).suffix.lower() in (".mcap", ".nc") or seems_record(text.splitlines()[:-1]):
        rule = f"quell identify {name} finds a model in it, quell tune {name} --out tuned.toml a "
        rule += f"controller, as a setup, and quell b0 {name} the gain of the input"
        return SetupError([f"{name}: is a record, not a setup: {rule}"])
    if kind is not None:
        return SetupError([f"{name}: is {kind.what}, not a setup; give a file in TOML"])
    return None


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
