"""Records of a machine that a page sends: read, identified, and kept as the plants to tune for.

A page sends a file in parts of base64 (``part``), and then how it is to be read and identified
(``record``). The file lies in a temporary folder while it is read, which is removed. Reading,
identification and the set of plants are those of ``quell tune RECORD``.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from quell.commissioning import measured
from quell.identification import Measured
from quell.lti.canonical import format_roots
from quell.setup.loading import Setup
from quell.studio.messages import Columns, columns, frame
from quell.studio.runs import Report, Stale, StoppedError, caught_warnings, linear_of, stoppable
from quell.tuning import Constraints, Tuned, tune
from quell.tuning.designs import range_of_u
from quell.tuning.plants import RecordModel, record_model, with_known_noise
from quell.tuning.written import Written

MOST_FILE = 8 * 2**20
"""Largest file of a record [bytes]; chosen by hand: 50 000 rows of ten columns take five MB."""
MOST_SAMPLES = 50_000
"""Most samples of a record; chosen by hand: so many take minutes to identify."""

# Endings of names that say how a file is read; any other one is read as text, by its content.
_SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".nc", ".mcap", ".toml")
# Keys of a message and the types that they may have, besides None.
_READING = {"read_columns": str, "dt": float, "time_unit": str}
_MODEL = {"order": int, "zeros": int, "integrators": int, "friction": bool, "rest": bool}
_MODEL |= {"max_delay": float, "held_out": float}
_TYPES = {str: "a text", float: "a number", int: "a whole number", bool: "true or false"}
# Names in the page of what is an option of the command line.
_FIELDS = {
    "columns": "Columns",
    "dt": "Sample time",
    "time-unit": "Time unit",
    "order": "Poles",
    "model-order": "Poles",
    "zeros": "Zeros",
    "integrators": "Integrators",
    "friction": "Friction",
    "rest": "At rest before",
    "max-delay": "Longest delay",
    "held-out": "Held out",
}
# Structures of the first controller: the next one is tried where one stabilises no loop.
_FIRST = ("pi", "pid", "bandwidths")
# Heights of the steps in the first scenario, as shares of the ranges of y and u in the record.
_STEP, _LOAD = 0.5, 0.25
# Share of the time until the plants are known, of that until there is a controller. By hand.
_IDENTIFYING = 0.85


class Shown(NamedTuple):
    """The record of a page: the set of plants, or why there is none."""

    plant: Any  # table of the model in a setup
    dt: float  # [s]
    plants: list[Any]
    delays: list[float]  # [s]
    refusal: str  # why nothing is tuned for the record; empty if it is
    model: Any  # what the record shows


class PageRecord:
    """The record of one page: the parts of its file that have come, and what it shows."""

    def __init__(self) -> None:
        self._parts = bytearray()
        self.shown: Shown | None = None

    def take_part(self, message: Mapping[str, Any]) -> None:
        """Append a part: ``data`` in base64, whose first byte is the byte ``at`` of the file."""
        at, data = message.get("at"), message.get("data")
        if at == 0:
            self._parts.clear()
        if type(at) is not int or at != len(self._parts) or not isinstance(data, str):
            raise ValueError(f"at = {at!r:.40}: the parts of a file must come one after the other")
        try:
            content = base64.b64decode(data, validate=True)
        except (binascii.Error, ValueError):
            raise ValueError("data: must be base64") from None
        if at + len(content) > MOST_FILE:
            self._parts.clear()
            raise ValueError(
                f"the file has more than {MOST_FILE // 2**20} MiB: the studio takes no larger one; "
                "leave out columns or rows, or use quell tune FILE"
            )
        self._parts += content

    def content(self, size: Any) -> bytes:
        """Return the file, which must have come whole, and forget its parts."""
        found = bytes(self._parts)
        self._parts.clear()
        if size != len(found):
            raise ValueError(f"size = {size!r:.40}: {len(found)} bytes of the file have come")
        return found

    def plants(self, setup: Setup, message: Mapping[str, Any]) -> tuple[Any, Any]:
        """Return what a setup is tuned for: plants and their delays [s], or its one plant.

        While the page shows a record (``record``) and the setup has the record's plant and sample
        time, they are those that the record shows.

        Raises
        ------
        ValueError
            where nothing is to be tuned for the record that the page shows.
        """
        if message.get("record") is not True:
            return linear_of(setup)
        if self.shown is None:
            raise ValueError("record: it is not known here any more; identify it again")
        if self.shown.refusal:
            raise ValueError(
                f"NOT: no plant to tune for: {self.shown.refusal}; change the fields and identify "
                "again, or close the record to tune for the plant in the form"
            )
        if self._is_of_record(setup, message):
            return self.shown.plants, self.shown.delays
        return linear_of(setup)

    def with_noise(
        self,
        bounds: Constraints,
        limits: Mapping[str, Any],
        setup: Setup,
        message: Mapping[str, Any],
    ) -> Constraints:
        """Return the constraints with the noise of y that record, encoder or scenario tell of."""
        shown, scenario = self.shown, setup.scenario
        if shown is not None and self._is_of_record(setup, message):
            return with_known_noise(bounds, shown.model, range_of_u(limits))
        noise = 0.0
        if setup.plant is not None and scenario is not None:
            noise = Written(setup.plant, scenario, float(setup.controller.dt)).noise
        return with_known_noise(bounds, setup.plant, range_of_u(limits), noise)

    def _is_of_record(self, setup: Setup, message: Mapping[str, Any]) -> bool:
        """Whether the page shows a record, and the setup has its plant and its sample time."""
        shown = self.shown
        if message.get("record") is not True or shown is None:
            return False
        same = message["setup"].get("plant") == shown.plant
        return same and float(setup.controller.dt) == shown.dt


def read_file(content: bytes, name: str, options: Mapping[str, Any]) -> tuple[Measured, list[str]]:
    """Return the record in the content of a file, and the warnings of reading it.

    Raises
    ------
    ValueError
        as ``measured``, and for more samples than ``MOST_SAMPLES``.
    """
    suffix = PurePath(name).suffix.lower()
    with TemporaryDirectory(prefix="quell-studio-") as folder:
        path = Path(folder) / f"record{suffix if suffix in _SUFFIXES else '.txt'}"
        path.write_bytes(content)
        how = options.get("read_columns") or "", options.get("dt"), options.get("time_unit")
        try:
            with caught_warnings() as caught:
                record = measured(path, *how)
        except (ValueError, OSError) as error:
            raise ValueError(for_page(str(error).replace(str(path), name))) from None
        finally:
            path.unlink(missing_ok=True)
    if record.y.size > MOST_SAMPLES:
        raise ValueError(
            f"data = {name!r}: has {record.y.size} samples: the studio takes at most "
            f"{MOST_SAMPLES}; give a part of it, or each second sample, or use quell tune FILE"
        )
    return record, [for_page(text.replace(str(path), name)) for text in caught]


def for_page(text: str) -> str:
    """Return a text with the fields of the page in place of options of the command line."""

    def named(found: re.Match[str]) -> str:
        field = _FIELDS.get(found[1])
        return found[0] if field is None else f"the field {field}"

    def valued(found: re.Match[str]) -> str:
        field = _FIELDS.get(found[1])
        return found[0] if field is None else f"(the field {field}: {found[2]})"

    return re.sub(r"--([a-z-]+)", named, re.sub(r"\(--([a-z-]+) ([^()\s]+)\)", valued, text))


def record_frames(
    record: PageRecord, message: Mapping[str, Any], stale: Stale, report: Report
) -> Iterator[bytes]:
    """Yield what a record shows: its model with its fit and error, and a setup to tune on.

    The message has the ``content`` of the file, its ``name``, and options of reading and model.
    """
    options, wide = _options(message), columns(message)
    name = " ".join(str(message.get("name") or "record").split())[:100]
    record.shown = None
    read, caught = read_file(message["content"], name, options)

    tell = stoppable(report, stale)

    def identifying(share: float) -> None:
        tell("identifying", _IDENTIFYING * share)

    def tuning(_: str, share: float) -> None:
        tell("tuning a first controller", _IDENTIFYING + (1.0 - _IDENTIFYING) * share)

    model = {key: options[key] for key in _MODEL if key in options}
    found = record_model(read, **model, progress=identifying)
    table = _plant_table(found)
    plants, delays, refusal, first = _first_design(found, tuning)
    record.shown = Shown(table, read.dt, plants, delays, refusal, found.model)
    lines = [for_page(line) for line in found.lines]
    header = {
        "kind": "record",
        "id": message["id"],
        "name": name,
        "samples": read.y.size,
        "dt": read.dt,
        "lines": [line for line in lines if not line.startswith("NOT")],
        "nots": [line for line in lines if line.startswith("NOT")],
        "warnings": caught,
        "fits": found.model.fits,
        "held_from": found.model.held_from * read.dt,
        "plants": [_row(*each) for each in zip(plants, delays, strict=True)],
        "refusal": refusal,
        "signals": {"y": str(read.signals.y), "u": str(read.signals.u)},
        "setup": None if first is None else _tables(first, table, read, PurePath(name).stem),
        "structure": "" if first is None else first.design.name,
    }
    yield frame(header, _curves(found, wide))
    yield frame({"kind": "done", "id": message["id"]})


def _options(message: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a message that are given, each of its type."""
    found: dict[str, Any] = {}
    for key, kind in (_READING | _MODEL).items():
        value = message.get(key)
        if value is None:
            continue
        whole = isinstance(value, int) and not isinstance(value, bool)
        good = whole if kind is int else isinstance(value, kind) or (kind is float and whole)
        if not good or (kind is str and len(value) > 200):
            raise ValueError(f"{key} = {value!r:.40}: must be {_TYPES[kind]}")
        found[key] = float(value) if kind is float else value
    return found


def _first_design(
    found: RecordModel, progress: Callable[[str, float], None]
) -> tuple[list[Any], list[float], str, Tuned | None]:
    """Return the plants, their delays, why there is nothing to tune for, and a first controller."""
    if found.refusal:
        return [], [], for_page(found.refusal), None
    try:
        plants, delays = found.plants
    except ValueError as error:
        return [], [], for_page(str(error)), None
    reason = ""
    for structure in _FIRST:
        how: dict[str, Any] = {"structure": structure, "delay": delays, "compare": ()}
        try:
            return plants, delays, "", tune(plants, found.model.dt, **how, progress=progress)
        except StoppedError:
            raise
        except ValueError as error:
            reason = str(error)
    return plants, delays, for_page(reason), None


def _plant_table(found: RecordModel) -> dict[str, Any]:
    """Return the table of the model in a setup, without its constant force and friction."""
    model = found.model
    table: dict[str, Any] = {"kind": "linear", "num": model.num.tolist(), "den": model.den.tolist()}
    named = {"y": str(model.signals.y), "u": str(model.signals.u)}
    if known := {key: text for key, text in named.items() if text}:
        table["signals"] = known
    return {"kind": "delayed", "delay": model.delay, "plant": table} if model.delay else table


def _tables(first: Tuned, plant: Any, read: Measured, title: str) -> dict[str, Any]:
    """Return a setup of the model with a first controller: a step, and then a load at the input."""
    scenario = dict(first.setup["scenario"])
    last = scenario["duration"]
    y, u = (float(f"{np.ptp(signal):.1g}") for signal in (read.y, read.u))
    scenario["reference"] = {"kind": "step", "height": _STEP * y}
    scenario["disturbances"] = [{"kind": "step", "height": _LOAD * u, "at": 0.5 * last}]
    designed = {key: dict(table) for key, table in first.design.tables.items()}
    windows = [{"stop": 0.5 * last}, {"start": 0.5 * last}]
    about = {"title": title or "Record", "dt": read.dt, "plant": plant}
    return about | designed | {"scenario": scenario, "metrics": windows}


def _row(plant: Any, delay: float) -> dict[str, str]:
    """Return poles, gain and delay of a plant of the set as text."""
    num, den = plant
    integrators = int(np.argmax(den[::-1] != 0.0))
    gain = f"{num[-1] / den[den.size - 1 - integrators]:.4g}"
    of = {0: "", 1: " of s G", 2: " of s² G"}.get(integrators, f" of s^{integrators} G")
    poles = format_roots(np.roots(den).astype(np.complex128))
    cells = {"poles": poles, "gain": gain + of, "delay": f"{delay:.3g}"}
    return {key: text.replace("-", "−") for key, text in cells.items()}


def _curves(found: RecordModel, wide: int) -> dict[str, Any]:
    """Return the record, the simulated y and the residual for plots of some columns of pixels."""
    model = found.model
    cut = Columns(model.y.size, wide)
    curves = {"u": model.u, "y": model.y, "simulated": model.simulated}
    curves["residual"] = model.y - model.simulated
    t = cut.times(model.dt * np.arange(float(model.y.size)))
    return {"t": t} | {name: cut.points(values) for name, values in curves.items()}
