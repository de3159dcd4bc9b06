"""The folder of a sweep: what it is, and a file for each part of its runs.

Each file is written whole or not at all. The folder of a sweep that was killed holds the parts that
were done; what is missing is done when the sweep goes on.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quell import checks
from quell.files import write_json, written_atomically
from quell.records.record import netcdf_of
from quell.sweeping.measures import UNITS, Measure, Measures
from quell.sweeping.plan import Part, Plan
from quell.sweeping.runs import Outcome
from quell.sweeping.values import labels

MANIFEST = "sweep.json"
_FORMAT = "quell sweep 1"
# Limit of the manifest's size: it has texts of the setup and no value of each run. By hand.
_MOST_BYTES = 16_000_000


@dataclass(frozen=True)
class Store:
    """The folder of a sweep."""

    folder: Path
    runs: int
    chunk: int  #: runs in a file
    about: Mapping[str, Any]  #: what makes it this sweep
    labels: Mapping[str, list[str] | None]  #: texts of parameters that are not numbers, by name
    measures: Mapping[str, Any]  #: attributes of the measures, by name

    def file(self, first: int) -> Path:
        """Return the file of the runs from ``first`` on."""
        return self.folder / f"runs-{first:010d}.nc"

    def parts(self) -> Iterator[tuple[int, int]]:
        """Return an iterator over first run and end of each file."""
        for first in range(0, self.runs, self.chunk):
            yield first, min(first + self.chunk, self.runs)

    def missing(self) -> list[tuple[int, int]]:
        """Return the parts that have no file yet."""
        there = {file.name for file in self.folder.iterdir()}
        return [each for each in self.parts() if self.file(each[0]).name not in there]

    def write(self, part: Part, outcome: Outcome) -> None:
        """Write the file of a part."""
        errors = sorted(outcome.messages)
        seeds = part.seeds[part.places(np.arange(part.first, part.last))[0]]
        variables: dict[str, tuple[str, Any, Mapping[str, Any]]] = {
            name: ("run", values, self.measures[name]) for name, values in outcome.measures.items()
        }
        variables["status"] = ("run", outcome.status.astype(np.int32), {})
        variables["ended"] = ("run", outcome.ended, {"units": "s"})
        variables["seed"] = ("run", seeds, {})
        variables["error_run"] = ("error", np.array(errors, np.int64) + part.first, {})
        variables["error"] = ("error", [outcome.messages[i] for i in errors], {})
        for name, column in part.columns().items():
            texts = self.labels[name]
            codes = column if texts is None else column.astype(np.int32)
            about = {} if texts is None else {"labels": texts}
            variables[parameter_variable(name)] = ("run", codes, {"parameter": name, **about})
        attributes = {"format": _FORMAT, "first": part.first}
        image = netcdf_of(
            {"run": part.last - part.first, "error": len(errors)}, variables, attributes
        )
        with written_atomically(self.file(part.first), overwrite=True) as file:
            file.write_bytes(image)


def parameter_variable(name: str) -> str:
    """Return the name of a parameter's variable: a slash would be a group of the file."""
    return f"parameter_{name.replace('/', '_')}"


def describe_measures(measures: Measures) -> dict[str, Any]:
    """Return the attributes of the variable of each measure."""
    found: dict[str, Any] = {}
    for name, each in measures.items():
        if isinstance(each, Measure):
            about, unit = UNITS[each.name]
            window = {"start": each.start, "stop": each.stop, "target": each.target}
            given = {key: value for key, value in window.items() if value is not None}
            found[name] = {"long_name": about, "units": unit, **given, "band": each.band}
        else:
            found[name] = {"long_name": getattr(each, "__qualname__", type(each).__name__)}
    return found


def open_store(folder: str | os.PathLike[str]) -> Store:
    """Return the sweep that a folder holds.

    Raises
    ------
    ValueError
        if there is none.
    """
    path = Path(folder)
    try:
        with (path / MANIFEST).open("rb") as file:
            text = file.read(_MOST_BYTES + 1)
        if len(text) > _MOST_BYTES:
            raise ValueError(f"is larger than {_MOST_BYTES / 1e6:.0f} MB")
        told = json.loads(text)
        if not isinstance(told, dict) or told.get("format") != _FORMAT:
            raise ValueError(f"format is not {_FORMAT!r}")
        return Store(
            path,
            checks.whole("runs", told["runs"], 1),
            checks.whole("chunk", told["chunk"], 1),
            dict(told["about"]),
            dict(told["labels"]),
            dict(told["measures"]),
        )
    except OSError as error:
        why = f"{MANIFEST} can't be read ({error.strerror})"
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        why = f"{MANIFEST} is none of quell's: {error}"
    raise ValueError(f"folder = {str(path)!r}: holds no sweep: {why}")


def existing_store(folder: str | os.PathLike[str], about: Mapping[str, Any]) -> Store | None:
    """Return the sweep in a folder if it is the same; None if the folder is empty or not there.

    Raises
    ------
    ValueError
        if the folder holds another sweep or other files, or is no folder.
    """
    path = Path(folder)
    if not os.path.lexists(path):
        return None
    if not path.is_dir():
        raise ValueError(f"folder = {str(path)!r}: must be a folder, is a file")
    if not (path / MANIFEST).exists():
        if any(not each.name.startswith(".") for each in path.iterdir()):
            raise ValueError(f"folder = {str(path)!r}: holds other files; choose an empty folder")
        return None
    store = open_store(path)
    differ = [key for key, value in about.items() if store.about.get(key) != value]
    if differ:
        raise ValueError(
            f"folder = {str(path)!r}: holds the results of another sweep, which differs in "
            f"{', '.join(differ)}; choose another folder"
        )
    return store


def new_store(
    folder: str | os.PathLike[str],
    plan: Plan,
    chunk: int,
    about: Mapping[str, Any],
    measures: Measures,
) -> Store:
    """Make the folder of a sweep, and the file that says what it is."""
    path, runs = Path(folder), plan.runs
    texts = {name: labels(plan.lists.get(name, ())) for name in plan.parameters}
    store = Store(path, runs, chunk, about, texts, describe_measures(measures))
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"folder = {str(path)!r}: can't be made ({error.strerror})") from None
    told = {"format": _FORMAT, "runs": runs, "chunk": chunk}
    told |= {"about": about, "labels": store.labels, "measures": store.measures}
    write_json(path / MANIFEST, told)
    return store


def hash_of(value: Any) -> str:
    """Return a short hash of what JSON can hold."""
    text = json.dumps(value, sort_keys=True, default=repr)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
