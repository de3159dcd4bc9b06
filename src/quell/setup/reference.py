"""Tables of all keys of setup files in Markdown, for the documentation."""

from __future__ import annotations

import types
from collections.abc import Mapping
from typing import Any, Union, get_args, get_origin

from pydantic_core import PydanticUndefined

from quell.setup.schema import CallTable, Table

_TYPES = {float: "number", int: "whole number", bool: "true or false", str: "text"}


def keys(of: type[Table]) -> list[tuple[str, str, str, str]]:
    """Return name, type, default and description of each key of a table, except ``kind``."""
    return [
        (key, _type(field.annotation), _default(field.default), field.description or "")
        for key, field in of.model_fields.items()
        if key != "kind"
    ]


def table(of: type[Table]) -> str:
    """Return the keys of a table in Markdown; an empty text for a table without keys."""
    bar = r"\|"
    rows = [
        f"| `{key}` | {kind} | {default} | {text.replace('|', bar)} |"
        for key, kind, default, text in keys(of)
    ]
    heading = ["| key | type | default | |", "|---|---|---|---|"]
    return "\n".join(heading + rows if rows else []).replace("``", "`")


def markdown(kinds: Mapping[str, type[CallTable]]) -> str:
    """Return the kinds of a table and their keys in Markdown."""
    return "\n\n".join(
        f"**`{kind}`** {of.__doc__}\n\n{table(of)}".replace("``", "`") for kind, of in kinds.items()
    )


def _default(value: Any) -> str:
    if value is PydanticUndefined:
        return "**needed**"
    if value is None:
        return ""
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    return f"`{str(value).lower() if isinstance(value, bool) else repr(value)}`"


def _type(annotation: Any) -> str:
    """Return the name of a type in TOML."""
    if annotation in _TYPES:
        return _TYPES[annotation]
    origin = get_origin(annotation)
    inside = [part for part in get_args(annotation) if part is not types.NoneType]
    if origin is tuple:
        return "list"
    if origin is dict:
        return "table"
    if origin in (Union, types.UnionType):
        named = list(dict.fromkeys(_type(part) for part in inside))
        return "table" if all(name == "table" for name in named) else ", ".join(named)
    if origin is not None and inside:  # Annotated
        return _type(inside[0])
    return "table" if isinstance(annotation, type) and issubclass(annotation, Table) else "numbers"
