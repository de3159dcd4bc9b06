"""One line for each mistake in a setup file: the file, the key's path, the value and the rule, or the known name that is nearest."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from quell.setup.schema import CONTEXT

# What pydantic calls a value of the wrong type, and what should be there.
_TYPES = {
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "a text",
    "tuple_type": "a list",
    "model_type": "a table",
}


class SetupError(ValueError):
    """A setup that can not be used; ``mistakes`` has a line for each."""

    def __init__(self, mistakes: Sequence[str]) -> None:
        super().__init__("\n".join(mistakes))
        self.mistakes = tuple(mistakes)


def refused(name: str, path: str, error: Exception, keys: Sequence[str]) -> SetupError:
    """Return what a constructor says of its arguments with the path of their table in front, and of the key where it begins with one."""
    said = " ".join(str(error).split())
    begins = any(said.startswith((f"{key} ", f"{key}[", f"{key}:")) for key in keys)
    return SetupError([f"{name}: {path}{'.' if begins and path else ': ' if path else ''}{said}"])


def mistakes(name: str, error: ValidationError, data: Any) -> SetupError:
    """Return what is wrong with the tables and keys of the file ``name``, which holds ``data``."""
    lines: list[str] = []
    wanted: dict[str, list[str]] = {}
    for found in error.errors():
        kind, value, context = found["type"], found["input"], found.get("ctx", {})
        path = _path(found["loc"], data, absent=kind == "missing")
        if kind in _TYPES:
            one_of_many = kind == "tuple_type" and isinstance(value, Mapping)
            wanted.setdefault(f"{path} = {_short(value)}: must be", []).append(
                f"[[{path}]]" if one_of_many else _TYPES[kind]
            )
        elif kind == "unknown":
            lines += [
                f"{path}{'.' if path else ''}{key}: unknown; {_advice(key, context['known'])}"
                for key in context["keys"]
            ]
        elif kind == "missing":
            lines.append(f"{path}: missing")
        elif kind == "union_tag_invalid" and isinstance(value, Mapping):
            lines.append(
                f"{path}.kind = {_short(value['kind'])}: unknown; "
                f"{nearest(str(value['kind']), _tags(context))}"
            )
        elif kind in ("union_tag_not_found", "union_tag_invalid"):
            lines.append(
                f"{path}.kind: missing"
                if isinstance(value, Mapping)
                else f"{path} = {_short(value)}: must be a table"
            )
        else:
            lines.append(f"{path} = {_short(value)}: {found['msg']}")
    lines += [f"{line} {' or '.join(dict.fromkeys(types))}" for line, types in wanted.items()]
    return SetupError([f"{name}: {line}" for line in lines])


def nearest(name: str, known: Sequence[str]) -> str:
    """Return ``did you mean …?`` for a name that is nearly one of the known, and all of them for one that is not."""
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]}?" if near else f"must be one of {', '.join(known)}"


def _advice(key: str, known: Sequence[str]) -> str:
    if key in CONTEXT:
        return (
            f"{key} has its place at the top of the file"
            if key == "dt"
            else f"[{key}] is a table of its own"
        )
    return nearest(key, known)


def _tags(context: Mapping[str, Any]) -> list[str]:
    tags = [tag.strip().strip("'") for tag in str(context.get("expected_tags", "")).split(",")]
    return [tag for tag in tags if tag not in ("number", "list")]


def _path(loc: Sequence[str | int], data: Any, absent: bool) -> str:
    """Return a key's path in the file: its places less the names of choices, which are no keys of ``data``; the last may be absent."""
    path = ""
    for i, step in enumerate(loc):
        if isinstance(data, Mapping) and (step in data or (absent and i + 1 == len(loc))):
            path += f".{step}" if path else str(step)
            data = data.get(step)
        elif isinstance(step, int) and isinstance(data, Sequence):
            path += f"[{step}]"
            data = data[step]
    return path


def _short(value: Any) -> str:
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 60 else f"{text[:57]}..."
