"""Messages and frames of the page, and the tables from which it makes its forms.

Messages of the page: what they may ask for, and how large that may be.

Frames for the page: a JSON header and arrays of float32, little endian.

A frame is the length of the header (4 bytes), the header in UTF-8, spaces up to a multiple of four
bytes, and the arrays one after the other; ``arrays`` in the header has name and length of each.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Set
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic_core import PydanticUndefined

from quell import checks
from quell.files import nonfinite_to_none, whole_text
from quell.plants.registry import IDENTIFIED_NUMBERS, identified_numbers
from quell.setup import axes, loading, registry
from quell.setup.schema import CallTable
from quell.types import Vector

# ---- Messages of the page ----

MOST_BYTES = 262_144
"""Largest message [bytes]; chosen by hand: a setup takes two thousand, one with matrices fifty."""

# A run of so many samples takes some 0.3 s; chosen by hand.
_MOST_SAMPLES = 200_000
# Largest whole number in a setup, besides seeds and counts of an encoder: orders, numbers of
# features and the like, which decide how much memory a controller takes. Chosen by hand.
_MOST_PARTS = 200
_FREE_NUMBERS = ("seed", "counts", "dac_bits")
# Entries of a list, and samples of a delay. Chosen by hand.
_MOST_ENTRIES, _MOST_DELAYED = 1000, 10_000
# Pixels across a plot.
_COLUMNS = (50, 4000)
# Tables that reach devices, files or other processes.
_NOT_HERE = ("rig", "sweep")
# Keys that name files, in tables of any kind; and those of plants from files.
_FILES = ("path", "storage", "telemetry", "function", "file", "source")
_FROM_FILES = {"fmu": ("path",), "identified": ("path",), "python": ("source", "output")}
FILE_KINDS = tuple(_FROM_FILES)
"""Kinds of plants that are files, some of them programs."""

TASKS = ("run", "band", "compare", "tune", "export", "toml", "open", "part", "record", "cancel")


class Granted(NamedTuple):
    """Files that the user named on the command line; a page can name no others."""

    files: frozenset[tuple[Any, ...]] = frozenset()  #: from ``files_of``
    trust: bool = False  #: whether Python files may be run


_NOTHING = Granted()


def files_of(tables: Any) -> frozenset[tuple[Any, ...]]:
    """Return kind and file of each plant in the tables of a setup that is from a file."""
    parts = tables.values() if isinstance(tables, dict) else tables
    found: set[tuple[Any, ...]] = set()
    if isinstance(tables, dict) and tables.get("kind") in FILE_KINDS and not _has_numbers(tables):
        found.add(_file_of(tables))
    if isinstance(tables, dict | list | tuple):
        found = found.union(*map(files_of, parts))
    return frozenset(found)


def _has_numbers(table: Mapping[str, Any]) -> bool:
    """Return whether a table has the numbers of an identified model, and names no file."""
    return table.get("kind") == "identified" and "path" not in table


def with_models(tables: Any, models: Mapping[str, str] | None = None) -> Any:
    """Return tables of a setup with the numbers of identified models in place of their files.

    Parameters
    ----------
    models
        texts of files of results by name, without folder; None reads the files that are named.

    Raises
    ------
    ValueError
        for a file that is no file of results, and for one that is not in ``models``.
    """
    if isinstance(tables, list | tuple):
        return [with_models(part, models) for part in tables]
    if not isinstance(tables, Mapping):
        return tables
    path = tables.get("path")
    if tables.get("kind") != "identified" or not isinstance(path, str):
        return {key: with_models(part, models) for key, part in tables.items()}
    found = identified_numbers(_model_text(path, models), f"path = {path!r}")
    rest = {key: part for key, part in tables.items() if key != "path"}
    numbers = {key: found[key] for key in IDENTIFIED_NUMBERS if found.get(key) is not None}
    if not {"friction", "friction_width"} <= numbers.keys() or not numbers["friction"]:
        for key in ("friction", "friction_width"):
            numbers.pop(key, None)
    return rest | numbers


def _model_text(path: str, models: Mapping[str, str] | None) -> str:
    name = PurePosixPath(path.replace("\\", "/")).name
    if models is None:
        try:
            return whole_text(path)
        except OSError as error:
            raise ValueError(f"path = {path!r}: can't be read ({error.strerror})") from None
    if name not in models:
        raise ValueError(
            f"plant: its model is in the file {name}: open the setup and {name} together"
        )
    return models[name]


def _file_of(table: Mapping[str, Any]) -> tuple[Any, ...]:
    kind = table["kind"]
    return (kind, *(str(table.get(key)) for key in _FROM_FILES[kind]))


def parsed(text: str | bytes) -> dict[str, Any]:
    """Return a message as a dictionary; raise a ``ValueError`` if it is not one.

    A message has ``do``, one of ``TASKS``, and ``id``, a whole number that the answers repeat.
    """
    if len(text) > MOST_BYTES:
        raise ValueError(f"the message has {len(text)} bytes: must have at most {MOST_BYTES}")
    try:
        found = json.loads(text, parse_constant=_refuse_constant)
    except RecursionError:
        raise ValueError("the message is nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"the message is not JSON: {error}") from None
    if not isinstance(found, dict):
        raise ValueError("the message must be an object with do and id")
    checks.one_of("do", found.get("do"), TASKS)
    number = found.get("id")
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < 2**53:
        raise ValueError("id: must be a whole number")
    return found


def identity(text: str | bytes) -> int | None:
    """Return the id of a message that may be malformed, None if it has none."""
    try:
        number = json.loads(text)["id"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return number if type(number) is int and 0 <= number < 2**53 else None


def columns(message: Mapping[str, Any]) -> int:
    """Return how many pixels the plots of the page have across."""
    low, high = _COLUMNS
    wide = message.get("columns", 600)
    if isinstance(wide, bool) or not isinstance(wide, int) or not low <= wide <= high:
        raise ValueError(f"columns = {wide!r:.40}: must be a whole number from {low} to {high}")
    return wide


def number(message: Mapping[str, Any], key: str, usual: float, low: float, high: float) -> float:
    """Return a number of a message within its range."""
    value = message.get(key, usual)
    good = isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
    if not good:
        raise ValueError(f"{key} = {value!r:.40}: must be a number from {low:g} to {high:g}")
    return float(value)


def setup_tables(message: Mapping[str, Any], granted: Granted) -> dict[str, Any]:
    """Return the tables of the setup in a message; raise a ``ValueError`` for too large ones."""
    tables = message.get("setup")
    if not isinstance(tables, dict):
        raise ValueError("setup: must be a table, as a setup file has it")
    return checked(tables, granted)


def checked(tables: dict[str, Any], granted: Granted = _NOTHING) -> dict[str, Any]:
    """Return the tables of a setup that the studio can take, or raise a ``ValueError``."""
    try:
        return _checked(tables, granted)
    except RecursionError:
        raise ValueError("setup: its tables or lists are nested too deeply") from None


def _checked(tables: dict[str, Any], granted: Granted) -> dict[str, Any]:
    tables = {key: table for key, table in tables.items() if key not in _NOT_HERE}
    dt = tables.get("dt")
    if isinstance(dt, bool) or not isinstance(dt, int | float) or not 0.0 < dt < math.inf:
        raise ValueError(f"dt = {dt!r:.40}: must be a positive sample time [s]")
    scenario = tables.get("scenario")
    duration = scenario.get("duration", 10.0) if isinstance(scenario, dict) else 10.0
    if isinstance(duration, int | float) and duration > _MOST_SAMPLES * dt:
        raise ValueError(
            f"scenario.duration = {duration:g} s: must be at most {_MOST_SAMPLES} samples, "
            f"{_MOST_SAMPLES * dt:g} s at dt = {dt:g} s"
        )
    named = files_of(tables) - granted.files
    if named:
        what = ", ".join(" ".join(each) for each in sorted(named))
        raise ValueError(
            f"{what}: the studio opens no files that a page names; name the setup on the command "
            "line, quell studio setup.toml"
        )
    _check_sizes(tables, "", float(dt))
    return tables


def _check_sizes(value: Any, path: str, dt: float) -> None:
    """Check all numbers and lists of a setup that decide how much memory and time it takes."""
    key = path.rpartition(".")[2].partition("[")[0]
    if isinstance(value, dict):
        # A file is granted, or was refused before.
        from_file = value.get("kind") in FILE_KINDS
        for each, part in value.items():
            if each in _FILES and not from_file:
                raise ValueError(f"{path}.{each}: the studio opens no files")
            _check_sizes(part, f"{path}.{each}" if path else str(each), dt)
    elif isinstance(value, list | tuple):
        if len(value) > _MOST_ENTRIES:
            raise ValueError(f"{path}: has {len(value)} entries, must have at most {_MOST_ENTRIES}")
        for i, part in enumerate(value):
            _check_sizes(part, f"{path}[{i}]", dt)
    elif isinstance(value, float) and not math.isfinite(value) and key not in _INFINITE:
        raise ValueError(f"{path} = {value!r}: must be finite")
    elif isinstance(value, int) and not isinstance(value, bool):
        # In JSON a whole number may stand for any number, so only what must be whole is small.
        if key in _PARTS and abs(value) > _MOST_PARTS:
            raise ValueError(f"{path} = {value}: must be at most {_MOST_PARTS} in the studio")
        if abs(value) > 2**53:
            raise ValueError(f"{path}: is beyond what numbers in the studio can be")
    if key in ("delay", "dead_time", "late") and isinstance(value, int | float):
        samples = value if key == "late" else value / dt
        if samples > _MOST_DELAYED:
            raise ValueError(f"{path} = {value:g}: must be at most {_MOST_DELAYED} samples")


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no number in JSON")


def _whole_keys() -> frozenset[str]:
    """Return the keys of setups whose values are whole numbers, besides ``_FREE_NUMBERS``."""
    from quell.setup import registry
    from quell.setup.loading import keys

    groups = (
        *(registry.PLANTS, registry.OBSERVERS, registry.LEARNERS, registry.CONTROLLERS),
        *(registry.PREFILTERS, registry.SIGNALS, registry.FEATURES),
    )
    found = {
        key
        for group in groups
        for table in group.values()
        for key, kind, *_ in keys(table)
        if "whole number" in kind
    }
    return frozenset(found - set(_FREE_NUMBERS) | {"orders"})


_PARTS = _whole_keys()
_INFINITE = frozenset(("u_min", "u_max", "rate_limit", "stop"))


# ---- Frames for the page ----

Indices = NDArray[np.intp]
_LENGTH = struct.Struct("<I")


def frame(header: Mapping[str, Any], arrays: Mapping[str, Any] | None = None) -> bytes:
    """Return a frame; numbers of the header that are not finite become ``null``."""
    parts = {name: np.asarray(part, dtype="<f4").ravel() for name, part in (arrays or {}).items()}
    about = dict(header) | {"arrays": [[name, part.size] for name, part in parts.items()]}
    return _framed(about, b"".join(part.tobytes() for part in parts.values()))


def file_frame(header: Mapping[str, Any], content: bytes) -> bytes:
    """Return a frame with the bytes of a file, in place of arrays."""
    return _framed(dict(header) | {"arrays": [], "bytes": len(content)}, content)


def _framed(header: dict[str, Any], content: bytes) -> bytes:
    text = json.dumps(nonfinite_to_none(header), allow_nan=False).encode()
    text += b" " * (-(len(text) + _LENGTH.size) % 4)
    return _LENGTH.pack(len(text)) + text + content


def parsed_frame(data: bytes) -> tuple[dict[str, Any], dict[str, Vector], bytes]:
    """Return header, arrays and the bytes behind them of a frame; what the page does, in Python."""
    (length,) = _LENGTH.unpack_from(data)
    at = _LENGTH.size + length
    header = json.loads(data[_LENGTH.size : at])
    arrays = {}
    for name, size in header["arrays"]:
        arrays[name] = np.frombuffer(data, dtype="<f4", count=size, offset=at).astype(np.float64)
        at += 4 * size
    return header, arrays, data[at:]


class Columns:
    """Columns of pixels for ``samples`` samples: two points each, at its extrema.

    A curve drawn through these points covers the same pixels as one through all samples, because a
    column shows the range of the values in it.
    """

    def __init__(self, samples: int, columns: int) -> None:
        self.all = samples <= 2 * columns
        edges = np.linspace(0, samples, min(columns, samples) + 1).astype(np.intp)
        self._first = edges[:-1]
        self._places = np.stack([edges[:-1], (edges[:-1] + edges[1:]) // 2], axis=1).ravel()

    def times(self, t: Vector) -> Vector:
        """Return the times of the points."""
        return t if self.all else t[self._places]

    def points(self, values: Vector) -> Vector:
        """Return two points for each column; the extremum that is first in time stands first."""
        if self.all:
            return values
        low = np.minimum.reduceat(values, self._first)
        high = np.maximum.reduceat(values, self._first)
        last = np.append(self._first[1:], values.size) - 1
        rising = values[last] >= values[self._first]
        pairs = np.where(rising[:, None], np.stack([low, high], 1), np.stack([high, low], 1))
        return pairs.ravel()

    def low(self, values: Vector) -> Vector:
        """Return the least value of each column, twice."""
        return values if self.all else np.repeat(np.minimum.reduceat(values, self._first), 2)

    def high(self, values: Vector) -> Vector:
        """Return the largest value of each column, twice."""
        return values if self.all else np.repeat(np.maximum.reduceat(values, self._first), 2)


# ---- Descriptions of the tables of a setup, from which the page makes its forms ----

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
_HIDDEN_OF = {"identified": ("path",)}


def forms(granted: Granted) -> dict[str, Any]:
    """Return for each group of tables its kinds, and for each kind its keys.

    ``"one"`` has the groups of a setup of one axis, ``"several"`` those of one of several axes.

    Plants that are files are left out if they are not granted; an identified one has its numbers.
    """
    files = {each[0] for each in granted.files}
    without = {*FILE_KINDS, "no-learner"} - files - {"identified"}
    shared: dict[str, Mapping[str, type[CallTable]]] = {
        "learner": registry.LEARNERS,
        "signal": registry.SIGNALS,
        "feature": registry.FEATURES,
        "notch": {"": registry.Notch},
        "feedback": {"": registry.Feedback},
        "feedforward": registry.FEEDFORWARDS,
        "labels": {"": registry.Labels},
        "guard": {"": registry.Guard},
    }
    one = shared | {
        "plant": registry.PLANTS,
        "observer": registry.OBSERVERS,
        "controller": registry.CONTROLLERS,
        "prefilter": registry.PREFILTERS,
        "scenario": {"": registry.Scenario},
        "metrics": {"": registry.Metrics},
    }
    several = shared | {
        "plant": registry.AXES_PLANTS,
        "observer": axes.OBSERVERS,
        "controller": {"adrc": axes.CONTROLLER},
        "axes": {"": axes.AXES},
        "scenario": {"": axes.SCENARIO},
        "metrics": {"": axes.METRICS},
    }
    return {"one": _described(one, without), "several": _described(several, without)}


def _described(
    groups: Mapping[str, Mapping[str, type[CallTable]]], without: Set[str]
) -> dict[str, Any]:
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
    for key, kind, _, about in loading.keys(table):
        if key in _HIDDEN or key in _HIDDEN_OF.get(table.kind_name, ()):
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
