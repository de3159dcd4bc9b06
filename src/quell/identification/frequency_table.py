"""Tables of frequencies: the response G(jω) or a power spectrum, from drives and analysers.

A column of frequencies stands beside size and phase, real and imaginary part, or a power spectrum;
which is which follows from the words and units of their names. Numbers, separators and comments are
read as those of a record (``record_layout``).
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.files import MAX_SIZE
from quell.identification.frequencies import KNOWN
from quell.identification.record_file import OpenTable, numbers_of, open_table
from quell.identification.record_layout import ROLES, found_in, listed, name_of
from quell.types import Vector

# Words of the names of columns, in lower case, the first kind that has one of them; made by hand
# from exports of drives, analysers, oscilloscopes and printers.
_WORDS = {
    "coherence": {"coherence", "coh", "kohärenz", "coherency"},
    "deviation": {"deviation"},
    "phase": {"phase", "phas", "angle", "arg", "phi", "φ", "phasengang"},
    "real": {"real", "re", "realteil"},
    "imag": {"imag", "im", "imaginary", "imaginär", "imaginärteil"},
    "power": {"psd", "power", "spectrum", "asd"},
    "size": {
        *("magnitude", "mag", "gain", "amplitude", "ampl", "amp", "abs", "betrag", "modulus"),
        *("amplitudengang", "ratio", "db"),
    },
    "omega": {"omega", "w", "ω"},
    "f": {"f", "freq", "frequency", "frequenz", "fréquence", "frecuencia", "hz"},
}
_HERTZ = {"": 1.0, "hz": 1.0, "khz": 1e3, "mhz": 1e6, "1/s": 1.0, "s^-1": 1.0}
_DEGREES = ("deg", "°", "degree", "degrees", "grad")
# Phases beyond this are in degrees where no unit says so [rad]: a table in radians is unwrapped
# over more than two turns rarely.
_TURNS = 4.5 * math.pi
# Coherence below which a frequency is left out: noise has more power than the response.
_COHERENT = 0.5
# Share of steps from line to line that go the same way in a table of frequencies. By hand.
_ORDERED = 0.8
_FEWEST = 8


class FrequencyTable(NamedTuple):
    """A table of frequencies."""

    omega: Vector  #: rising [rad/s] (N,)
    response: NDArray[np.complex128] | None  #: G (N,); None of a table without phase
    power: Vector | None  #: power spectrum, or |G|² without phase (N,)
    deviation: Vector | None  #: relative deviation of G (N,), if the table has it
    columns: tuple[str, ...]  #: names of the columns that are used
    notes: tuple[str, ...]  #: what was assumed, and how many lines are left out


class _Column(NamedTuple):
    place: int
    kind: str
    name: str
    unit: str  # in lower case


def frequency_table(
    path: str | os.PathLike[str], columns: Sequence[str] = (), *, max_size: float = MAX_SIZE
) -> FrequencyTable | None:
    """Read a table of frequencies; return None if a file is none.

    It is one if a column is named as a frequency (f, freq, Frequency (Hz), omega) and rises or
    falls, none is named as time, and others are size (magnitude, gain), phase, real and imaginary
    part, or power spectrum (psd).
    Without a unit frequencies are in Hz, and omega in rad/s. A size is in dB if its name says so or
    a value is negative. A phase without unit is in degrees if it is beyond 4.5 π.

    Parameters
    ----------
    path
        the file.
    columns
        names or numbers (from 1 on) of its columns, the frequency first; by default the only ones
        that may be meant.
    max_size
        limit of what the file may unpack to [MB].

    Raises
    ------
    ValueError
        for columns that are missing, or may be several, and as ``read_record``.
    """
    found = _opened(Path(path), columns, max_size)
    if found is None:
        return None
    opened, used = found
    numbers = numbers_of(opened, [one.place for one in used], [one.name for one in used])
    steps = np.diff(numbers[:, 0])
    if not columns and max(np.sum(steps > 0.0), np.sum(steps < 0.0)) < _ORDERED * steps.size:
        return None  # samples of a drive's frequency
    return _table(opened.where, used, numbers)


def _opened(
    path: Path, columns: Sequence[str], max_size: float
) -> tuple[OpenTable, list[_Column]] | None:
    """Return the open table and the columns to use; None if it is no table of frequencies."""
    if path.suffix.lower() in (".toml", ".nc", ".mcap") or not path.is_file():
        return None
    # A line of names may be a comment, which is no line of names of a record.
    for asked in (ROLES[:3], ()):
        try:
            opened = open_table(path, asked, True, max_size)
        except ValueError:
            return None
        if opened.layout.names is None:
            continue
        names, units = opened.layout.names, opened.layout.units
        known = [_column(i, *pair) for i, pair in enumerate(zip(names, units, strict=True))]
        wanted = _asked(names, known, columns) if columns else [*filter(None, known)]
        kinds = [one.kind for one in wanted]
        timed = bool(found_in(names, units, "t", "t"))
        if kinds and ("f" in kinds or "omega" in kinds) and (columns or not timed):
            used = _used(opened.where, wanted)
            if used:
                return opened, used
    return None


def _column(place: int, text: str, below: str) -> _Column | None:
    """Return a column by the words of its name; None if it is of no use."""
    base, unit = name_of(text, below)
    words = {*re.findall(r"[^\W\d_]+", base)}
    unit = unit.lower()
    if unit in ("rad/s", "rad_s", "1/s") and not words & {"phase", "angle", "arg"}:
        kind = "omega"
    elif base == "time" and unit == "hz":
        kind = "f"
    else:
        kind = next((kind for kind, known in _WORDS.items() if words & known), "")
        if not kind and unit == "db":
            kind = "size"
        if not kind and unit in ("hz", "khz"):
            kind = "f"
    return _Column(place, kind, " ".join(text.split()), unit) if kind else None


def _asked(
    names: Sequence[str], known: Sequence[_Column | None], columns: Sequence[str]
) -> list[_Column]:
    """Return the columns that are asked for by name or number, as far as they are known."""
    found = []
    for asked in columns:
        places = [i for i, name in enumerate(names) if " ".join(name.split()) == asked]
        if not places:
            places = [i for i, name in enumerate(names) if name_of(name).base == asked.lower()]
        if not places and asked.isdecimal() and 1 <= int(asked) <= len(names):
            places = [int(asked) - 1]
        column = known[places[0]] if places else None
        if column is not None:
            found.append(column)
    return found


def _used(where: str, columns: Sequence[_Column]) -> list[_Column]:
    """Return frequency and response, or power, one column each; none if something is missing."""
    frequency = _one(where, columns, "f") or _one(where, columns, "omega")
    assert frequency is not None
    more = [_one(where, columns, kind) for kind in ("deviation", "coherence")]
    beside = [one for one in more if one is not None]
    kinds = {one.kind for one in columns}
    if {"real", "imag"} <= kinds:
        pair = [_one(where, columns, "real"), _one(where, columns, "imag")]
    elif {"size", "phase"} <= kinds:
        pair = [_one(where, columns, "size"), _one(where, columns, "phase")]
    elif "power" in kinds or "size" in kinds:
        pair = [_one(where, columns, "power") or _one(where, columns, "size")]
    else:
        return []
    return [frequency, *(one for one in pair if one is not None), *beside]


def _one(where: str, columns: Sequence[_Column], kind: str) -> _Column | None:
    """Return the column of a kind; a gain in dB is taken before an amplitude in volts."""
    found = [one for one in columns if one.kind == kind]
    if len(found) > 1 and kind == "size":
        found = [one for one in found if one.unit == "db"] or found
    if len(found) > 1:
        several = listed([one.name for one in found])
        raise ValueError(
            f"{where}: the {_CALLED.get(kind, kind)} may be {several}; name the columns, the "
            "frequency first (--columns)"
        )
    return found[0] if found else None


_CALLED = {"f": "frequency", "size": "magnitude", "omega": "frequency", "power": "power spectrum"}


def _table(where: str, used: list[_Column], numbers: Any) -> FrequencyTable:
    values = {one.kind: numbers[:, i].copy() for i, one in enumerate(used)}
    units = {one.kind: one.unit for one in used}
    notes: list[str] = []
    first = used[0]
    turns = 1.0 if first.kind == "omega" else 2.0 * math.pi
    if first.kind == "f" and first.unit not in _HERTZ:
        raise ValueError(
            f"{where}: column {first.name!r} has the unit {first.unit}: must be Hz, kHz or rad/s"
        )
    scale = turns * (_HERTZ[first.unit] if first.kind == "f" else 1.0)
    omega = values[first.kind] * scale
    kept = omega > 0.0
    if "coherence" in values:
        kept &= values["coherence"] >= _COHERENT
    if "deviation" in values:
        kept &= values["deviation"] <= KNOWN
    if {"real", "imag"} <= values.keys():
        response = values["real"] + 1j * values["imag"]
    elif {"size", "phase"} <= values.keys():
        size = _size(values["size"], units["size"], notes)
        response = size * np.exp(1j * _radians(values["phase"], units["phase"], notes))
    else:
        response = None
    power = None
    if response is not None:
        kept &= (response != 0.0) & np.isfinite(response)
    elif "power" in values:
        power = _power(values["power"], units["power"], used[1].name)
    else:
        power = _size(values["size"], units["size"], notes) ** 2
    if power is not None:
        kept &= power > 0.0
    count = int(np.sum(~kept))
    if count:
        notes.append(f"{count} frequencies are left out: zero, or with little coherence")
    place = np.flatnonzero(kept)
    place = place[np.argsort(omega[place], kind="stable")]
    twice = np.flatnonzero(np.diff(omega[place]) == 0.0)
    if twice.size:
        notes.append(f"{twice.size} frequencies are there twice; the last one counts")
        place = np.delete(place, twice)
    if place.size < _FEWEST:
        raise ValueError(
            f"{where}: has {place.size} frequencies that can be used: must have at least "
            f"{_FEWEST}; measure more, with more power"
        )
    given = values.get("deviation")
    return FrequencyTable(
        omega[place],
        None if response is None else response[place],
        None if power is None else power[place],
        None if given is None else given[place],
        tuple(one.name for one in used),
        tuple(notes),
    )


def _size(values: Vector, unit: str, notes: list[str]) -> Vector:
    if unit == "db" or (unit == "" and np.any(values < 0.0)):
        if unit == "":
            notes.append("the magnitude is taken in dB, as it is negative")
        return np.asarray(10.0 ** (values / 20.0))
    if unit == "":
        notes.append("the magnitude is taken as a factor, not in dB: its name has no unit")
    return values


def _radians(values: Vector, unit: str, notes: list[str]) -> Vector:
    if unit in _DEGREES:
        return np.radians(values)
    if unit in ("rad", "mrad"):
        return values * (1e-3 if unit == "mrad" else 1.0)
    degrees = float(np.max(np.abs(values))) > _TURNS
    name = "degrees" if degrees else "radians"
    notes.append(f"the phase is taken in {name}, by its range: its name has no unit")
    return np.radians(values) if degrees else values


def _power(values: Vector, unit: str, name: str) -> Vector:
    if "db" in unit or np.any(values < 0.0):
        return np.asarray(10.0 ** (values / 10.0))
    return values**2 if "asd" in name.lower() else values
