"""Records from CSV files: time, input, output, and what was sent in from outside."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.files import csv_rows, read_text
from quell.types import Vector

# Times may be this much of a sample off the grid, as rounded ones are.
_JITTER = 0.2
_FEWEST = 8


class Measured(NamedTuple):
    """A record, evenly sampled."""

    u: Vector
    y: Vector
    dt: float
    """[s]."""
    reference: Vector | None


def read_record(
    path: str | os.PathLike[str], columns: Sequence[str] = ("t", "u", "y"), dt: float | None = None
) -> Measured:
    """Read a record from a CSV file.

    Parameters
    ----------
    path
        the file, with commas, semicolons or tabs between, as its first line has them; between semicolons or tabs a comma is a decimal
        point. A first line that is not numbers names the columns.
    columns
        which are time [s], input and output, and if there are four, what was sent into the loop from outside: names where the file has
        them, or numbers from 1 on. With ``dt`` the time is left out.
    dt
        sample time [s] of a file without times.

    Raises
    ------
    ValueError
        where the file can't be read, a column is missing, a value is no number, or the times are not even; it names line and column.
    """
    if dt is not None:
        checks.positive("dt", dt, "s")
    where = f"data = {os.fspath(path)!r}"
    wanted = (2, 3) if dt is not None else (3, 4)
    if len(columns) not in wanted or len(set(columns)) != len(columns):
        what = "u,y or u,y,r, as dt is given" if dt is not None else "t,u,y or t,u,y,r"
        raise ValueError(
            f"columns = {','.join(columns)!r}: must be {what}, by their names or numbers"
        )
    rows = _rows(Path(path), where)
    header = rows[0][1] if any(not _is_number(cell) for cell in rows[0][1]) else None
    if header is not None:
        rows = rows[1:]
    if len(rows) < _FEWEST:
        raise ValueError(f"{where}: has {len(rows)} samples; must have at least {_FEWEST}")
    width = len(header if header is not None else rows[0][1])
    places = [
        _place(where, header, width, name, i + (dt is not None)) for i, name in enumerate(columns)
    ]
    values, plain = np.zeros((0, 0)), False
    try:
        values = np.array([[row[place] for place in places] for _, row in rows], dtype=np.float64)
        plain = bool(np.all(np.isfinite(values))) and not any(
            "_" in row[place] for _, row in rows for place in places
        )
    except (ValueError, IndexError):
        pass
    if not plain:
        # One at a time, to say which one it is.
        values = np.array(
            [
                [
                    _value(where, number, row, place, name)
                    for place, name in zip(places, columns, strict=True)
                ]
                for number, row in rows
            ]
        )
    if dt is None:
        dt = _sample_time(where, values[:, 0], [number for number, _ in rows])
        values = values[:, 1:]
    reference = values[:, 2].copy() if values.shape[1] > 2 else None
    return Measured(values[:, 0].copy(), values[:, 1].copy(), dt, reference)


def _rows(path: Path, where: str) -> list[tuple[int, list[str]]]:
    text = read_text(path, where)
    between = _separator(
        next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    )
    rows = [
        (number, row)
        for number, row in csv_rows(text, where, between)
        if not row[0].startswith("#")
    ]
    if not rows:
        raise ValueError(f"{where}: is empty")
    if between != ",":
        rows = [(number, [_with_point(cell) for cell in row]) for number, row in rows]
    return rows


def _separator(line: str) -> str:
    return next((mark for mark in ("\t", ";") if mark in line), ",")


def _with_point(cell: str) -> str:
    pointed = cell.replace(",", ".", 1)
    return pointed if _is_number(pointed) else cell


def _place(where: str, header: list[str] | None, width: int, name: str, role: int) -> int:
    """Return where a column is; without names in the file the first are time, input, output."""
    if header is not None and name in header:
        if header.count(name) > 1:
            raise ValueError(f"{where}: column {name} is there {header.count(name)} times")
        return header.index(name)
    if name.isdecimal():
        if not 1 <= int(name) <= width:
            raise ValueError(
                f"{where}: column {name} is missing; there are {width}, counted from 1"
            )
        return int(name) - 1
    if header is None and name == ("t", "u", "y", "r")[role]:
        place = role - (role > 0 and width < 3)
        if place < width:
            return place
    has = (
        f"the first line names {', '.join(header)}"
        if header is not None
        else f"no line names columns, there are {width}"
    )
    raise ValueError(f"{where}: column {name} is missing; {has}; say which with --columns")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _value(where: str, number: int, row: list[str], place: int, name: str) -> float:
    text = row[place] if place < len(row) else ""
    if not _is_number(text) or "_" in text:
        raise ValueError(f"{where}, line {number}: {name} = {text!r}: must be a number")
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(
            f"{where}, line {number}: {name} = {text}: must be finite; mend the record or cut it there"
        )
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
            f"{where}, line {lines[worst + 1]}: t rises by {t[worst + 1] - t[worst]:.6g} s where samples are {dt:.6g} s apart: "
            "must be evenly sampled; interpolate, or cut the record at the gap"
        )
    # Of times with few digits the sample time is known better than they are.
    rounded = float(f"{dt:.6g}")
    return rounded if abs(rounded - dt) * t.size < _JITTER * dt else dt
