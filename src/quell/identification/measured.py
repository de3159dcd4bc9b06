"""Records of input and output: read from CSV files, or simulated."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.controllers.linear.law import LinearLaw
from quell.controllers.linear.linear import LinearController
from quell.files import csv_rows, read_text
from quell.identification.excitation import Excitation
from quell.plants import Plant
from quell.simulation import Scenario, simulate
from quell.types import Matrix, Vector

# Times may be off the grid by this share of a sample: chosen by hand, so that rounded times pass
# and a gap does not.
_JITTER = 0.2
# Least number of samples: chosen by hand, ``identify`` asks for more.
_FEWEST = 8

_Row = tuple[int, list[str]]  # line number and cells


class Measured(NamedTuple):
    """An evenly sampled record."""

    u: Vector
    y: Vector
    dt: float  #: [s]
    reference: Vector | None


def excited(plant: Plant, design: Excitation) -> Measured:
    """Return the simulated record of a plant at rest that gets a designed excitation as u.

    Raises
    ------
    ValueError
        as ``simulate``.
    """
    none = np.zeros(0)
    law = LinearLaw(np.zeros((0, 0)), none, none, none, none, 1.0, 0.0)  # u = r
    scenario = Scenario(reference=design.signal, duration=(design.u.size - 1) * design.dt)
    run = simulate(plant, LinearController(law, design.dt), scenario)
    return Measured(run["u"], run["y_measured"], design.dt, None)


def read_record(
    path: str | os.PathLike[str], columns: Sequence[str] = ("t", "u", "y"), dt: float | None = None
) -> Measured:
    """Read a record from a CSV file.

    Parameters
    ----------
    path
        the file, separated by commas, semicolons or tabs, as its first line is; with semicolons or
        tabs a comma is a decimal point. A first line that is not numbers has the names of the
        columns.
    columns
        columns of time [s], input and output, and optionally of the external signal of a closed
        loop: names if the file has them, or numbers from 1 on. With ``dt`` there is no time.
    dt
        sample time [s] of a file without times.

    Raises
    ------
    ValueError
        names line and column of a fault in the file.
    """
    if dt is not None:
        checks.positive("dt", dt, "s")
    where = f"data = {os.fspath(path)!r}"
    if len(set(columns)) != len(columns) or len(columns) not in ((3, 4) if dt is None else (2, 3)):
        rule = "t,u,y or t,u,y,r" if dt is None else "u,y or u,y,r, as dt is given"
        raise ValueError(f"columns = {','.join(columns)!r}: must be {rule}, by names or numbers")
    rows = _rows(Path(path), where)
    header = None if all(_is_number(cell) for cell in rows[0][1]) else rows[0][1]
    if header is not None:
        rows = rows[1:]
    if len(rows) < _FEWEST:
        raise ValueError(f"{where}: has {len(rows)} samples; must have at least {_FEWEST}")
    width = len(rows[0][1] if header is None else header)
    roles = enumerate(columns, start=int(dt is not None))
    places = [_place(where, header, width, name, role) for role, name in roles]
    values = _values(where, rows, places, columns)
    if dt is None:
        dt = _sample_time(where, values[:, 0], [number for number, _ in rows])
        values = values[:, 1:]
    u, y, *reference = (column.copy() for column in values.T)
    return Measured(u, y, dt, reference[0] if reference else None)


def _rows(path: Path, where: str) -> list[_Row]:
    text = read_text(path, where)
    lines = (line for line in text.splitlines() if line.strip() and not line.startswith("#"))
    first = next(lines, "")
    separator = next((mark for mark in ("\t", ";") if mark in first), ",")
    rows = [row for row in csv_rows(text, where, separator) if not row[1][0].startswith("#")]
    if not rows:
        raise ValueError(f"{where}: is empty")
    if separator != ",":
        rows = [(number, [_with_point(cell) for cell in row]) for number, row in rows]
    return rows


def _with_point(cell: str) -> str:
    pointed = cell.replace(",", ".", 1)
    return pointed if _is_number(pointed) else cell


def _place(where: str, header: list[str] | None, width: int, name: str, role: int) -> int:
    """Return the index of a column; in a file without names the first are time, input, output."""
    if header is not None and name in header:
        if header.count(name) > 1:
            raise ValueError(f"{where}: column {name} is there {header.count(name)} times")
        return header.index(name)
    if name.isdecimal():
        if not 1 <= int(name) <= width:
            rule = f"there are {width}, counted from 1"
            raise ValueError(f"{where}: column {name} is missing; {rule}")
        return int(name) - 1
    if header is None and name == ("t", "u", "y", "r")[role]:
        place = role - (role > 0 and width < 3)
        if place < width:
            return place
    has = f"no line names columns, there are {width}"
    if header is not None:
        has = f"the first line names {', '.join(header)}"
    raise ValueError(f"{where}: column {name} is missing; {has}; say which with --columns")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _values(where: str, rows: list[_Row], places: list[int], names: Sequence[str]) -> Matrix:
    """Return the values (samples, columns)."""
    try:
        cells = [[row[place] for place in places] for _, row in rows]
        values = np.array(cells, dtype=np.float64)
        # Python accepts 1_000.
        if np.all(np.isfinite(values)) and not any("_" in cell for row in cells for cell in row):
            return values
    except (ValueError, IndexError):
        pass
    # One at a time, to name the faulty one.
    columns = list(zip(places, names, strict=True))
    return np.array(
        [[_value(where, number, row, *column) for column in columns] for number, row in rows]
    )


def _value(where: str, number: int, row: list[str], place: int, name: str) -> float:
    text = row[place] if place < len(row) else ""
    if not _is_number(text) or "_" in text:
        raise ValueError(f"{where}, line {number}: {name} = {text!r}: must be a number")
    value = float(text)
    if not math.isfinite(value):
        rule = "must be finite; mend the record or cut it there"
        raise ValueError(f"{where}, line {number}: {name} = {text}: {rule}")
    return value


def _sample_time(where: str, t: Vector, lines: list[int]) -> float:
    dt = float(np.median(np.diff(t)))
    if not dt > 0.0:
        raise ValueError(f"{where}: t must rise, half of its steps do not")
    dt = float(t[-1] - t[0]) / max(round((t[-1] - t[0]) / dt), 1)
    off = np.abs(np.diff(t) - dt)
    worst = int(np.argmax(off))
    if off[worst] > _JITTER * dt or round((t[-1] - t[0]) / dt) != t.size - 1:
        raise ValueError(
            f"{where}, line {lines[worst + 1]}: t rises by {t[worst + 1] - t[worst]:.6g} s where "
            f"samples are {dt:.6g} s apart: must be evenly sampled; interpolate, or cut the record "
            "at the gap"
        )
    # With few digits in the times, the sample time is more exact than they are.
    rounded = float(f"{dt:.6g}")
    return rounded if abs(rounded - dt) * t.size < _JITTER * dt else dt
