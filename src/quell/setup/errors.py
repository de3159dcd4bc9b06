"""Errors of a setup file: one line each, with file, path of the key, value and rule."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from quell.checks import nearest
from quell.setup.schema import CONTEXT

# Pydantic's names of type errors, and the type that is expected.
_TYPES = {
    **{"float_type": "a number", "int_type": "a whole number", "bool_type": "true or false"},
    **{"string_type": "a text", "tuple_type": "a list", "model_type": "a table"},
}


# What to add where a table or key is missing, by its path; {} is the name of the file.
_REMEDIES = {
    "controller": "give tables [controller] and [observer]; quell tune {} --out tuned.toml finds "
    "both for the plant",
    "dt": "give the sample time of the loop [s] at the top of the file, dt = 0.001",
}


class SetupError(ValueError):
    """A setup that cannot be used; ``mistakes`` has a line for each error."""

    def __init__(self, mistakes: Sequence[str]) -> None:
        super().__init__("\n".join(mistakes))
        self.mistakes = tuple(mistakes)


def with_path(name: str, path: str, error: Exception, keys: Sequence[str]) -> SetupError:
    """Return an error with the file's name and the path in front.

    The path includes the key that the message begins with, where that is one of ``keys``.
    """
    text = " ".join(str(error).split())
    begins = any(text.startswith((f"{key} ", f"{key}[", f"{key}:")) for key in keys)
    return SetupError([f"{name}: {path}{'.' if begins and path else ': ' if path else ''}{text}"])


def from_validation(name: str, error: ValidationError, data: Any) -> SetupError:
    """Return the errors in the tables and keys of the file ``name``, which holds ``data``."""
    lines: list[str] = []
    expected: dict[str, list[str]] = {}
    for found in error.errors():
        kind, value, context = found["type"], found["input"], found.get("ctx", {})
        path = _path(found["loc"], data, absent=kind == "missing")
        if kind in _TYPES:
            one_of_many = kind == "tuple_type" and isinstance(value, Mapping)
            types = expected.setdefault(f"{path} = {_short(value)}: must be", [])
            types.append(f"[[{path}]]" if one_of_many else _TYPES[kind])
        elif kind == "unknown":
            start, known = f"{path}." if path else "", context["known"]
            lines += [f"{start}{key}: unknown; {_hint(key, known)}" for key in context["keys"]]
        elif kind == "missing":
            remedy = f"; {_REMEDIES[path].format(name)}" if path in _REMEDIES else ""
            lines.append(f"{path}: missing{remedy}")
        elif kind == "union_tag_invalid" and isinstance(value, Mapping):
            hint = nearest(str(value["kind"]), _tags(context))
            lines.append(f"{path}.kind = {_short(value['kind'])}: unknown; {hint}")
        elif kind == "union_tag_not_found" and isinstance(value, Mapping):
            lines.append(f"{path}.kind: missing")
        elif kind in ("union_tag_not_found", "union_tag_invalid"):
            lines.append(f"{path} = {_short(value)}: must be a table")
        elif kind == "value_error" and str(context.get("error")).startswith(f"{path} = "):
            lines.append(str(context["error"]))
        else:
            lines.append(f"{path} = {_short(value)}: {found['msg']}")
    lines += [f"{line} {' or '.join(dict.fromkeys(names))}" for line, names in expected.items()]
    return SetupError([f"{name}: {line}" for line in lines])


def _hint(key: str, known: Sequence[str]) -> str:
    if key in CONTEXT:
        top = f"{key} belongs at the top of the file"
        if key == "trust":
            return "a file can't ask for trust; give --trust"
        return top if key == "dt" else f"[{key}] is a table of its own"
    return nearest(key, known)


def _tags(context: Mapping[str, Any]) -> list[str]:
    tags = [tag.strip().strip("'") for tag in str(context.get("expected_tags", "")).split(",")]
    return [tag for tag in tags if tag not in ("number", "list", "flag")]


def _path(loc: Sequence[str | int], data: Any, absent: bool) -> str:
    """Return the path of a key in the file, from the location that Pydantic reports.

    A location also has the names of choices, which are no keys of ``data``. The last key may be
    absent from ``data``.
    """
    path = ""
    for i, step in enumerate(loc):
        if isinstance(data, Mapping) and (step in data or (absent and i + 1 == len(loc))):
            path += f".{step}" if path else str(step)
            data = data.get(step)
        elif isinstance(step, int) and isinstance(data, Sequence):
            path += f"[{step}]"
            data = data[step] if step < len(data) else None  # it may be absent
    return path


def _short(value: Any) -> str:
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 60 else f"{text[:57]}..."
