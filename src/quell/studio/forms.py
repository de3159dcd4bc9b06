"""Descriptions of the tables of a setup, from which the page makes its forms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic_core import PydanticUndefined

from quell.setup import reference, registry
from quell.setup.schema import CallTable
from quell.studio.messages import FILE_KINDS, Granted

# Keys that are tables of another group, and lists of them.
_NESTED = {
    "plant": "plant",
    **dict.fromkeys(("reference", "noise", "then", "cycle"), "signal"),
    "notch": "notch",
    "feedback": "feedback",
    "feedforward": "feedforward",
    "signals": "labels",
}
_LISTS = {"disturbances": "signal", "features": "feature"}
# Keys for later: a page has no place for them.
_HIDDEN = ("uncertain", "certified_for", "name")


def forms(granted: Granted) -> dict[str, Any]:
    """Return for each group of tables its kinds, and for each kind its keys.

    Plants that are files are left out if they are not granted.
    """
    files = {each[0] for each in granted.files}
    without = {*FILE_KINDS, "no-learner"} - files
    groups: Mapping[str, Mapping[str, type[CallTable]]] = {
        "plant": registry.PLANTS,
        "observer": registry.OBSERVERS,
        "controller": registry.CONTROLLERS,
        "learner": registry.LEARNERS,
        "prefilter": registry.PREFILTERS,
        "signal": registry.SIGNALS,
        "feature": registry.FEATURES,
        "notch": {"": registry.Notch},
        "feedback": {"": registry.Feedback},
        "feedforward": registry.FEEDFORWARDS,
        "labels": {"": registry.Labels},
        "guard": {"": registry.Guard},
        "scenario": {"": registry.Scenario},
        "metrics": {"": registry.Metrics},
    }
    return {
        group: {
            kind: {"about": _plain(table.__doc__ or ""), "keys": _keys(table)}
            for kind, table in kinds.items()
            if kind not in without
        }
        for group, kinds in groups.items()
    }


def _keys(table: type[CallTable]) -> list[dict[str, Any]]:
    found = []
    for key, kind, _, about in reference.keys(table):
        if key in _HIDDEN:
            continue
        default = table.model_fields[key].default
        needed = default is PydanticUndefined
        entry: dict[str, Any] = {"key": key, "type": kind, "about": _plain(about), "needed": needed}
        if not needed and isinstance(default, bool | int | float | str | tuple):
            entry["default"] = list(default) if isinstance(default, tuple) else default
        if key in _NESTED:
            entry["group"] = _NESTED[key]
        if key in _LISTS:
            entry["list_of"] = _LISTS[key]
        found.append(entry)
    return found


def _plain(text: str) -> str:
    """Return a text without marks of code, its first letter a capital."""
    text = text.replace("`", "").removeprefix("Return ").removeprefix("Design ")
    return text[:1].upper() + text[1:]
