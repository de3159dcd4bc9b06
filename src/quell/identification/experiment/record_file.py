"""Records of input and output from CSV files."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

import numpy as np

from quell import checks
from quell.identification.experiment.measured import Measured
from quell.identification.experiment.record_times import (
    UNITS,
    check_unit,
    sample_time,
    warn_of_another_step,
)
from quell.reading import MAX_SIZE, bytes_of, check_size, csv_rows, text_lines
from quell.types import Matrix, Vector

# Least number of samples: chosen by hand, ``identify`` asks for more.
_FEWEST = 8
# Lines that are converted to an array at once; chosen by hand, not tuned further.
_BLOCK = 4096

_Row = tuple[int, list[str]]  # line number and cells


def read_record(
    path: str | os.PathLike[str],
    columns: Sequence[str] = ("t", "u", "y"),
    dt: float | None = None,
    *,
    time_unit: str | None = None,
    max_size: float = MAX_SIZE,
) -> Measured:
    """Read a record from a CSV file.

    Parameters
    ----------
    path
        the file, separated by commas, semicolons or tabs, as its first line is; with semicolons or
        tabs a comma is a decimal point. A first line that is not numbers has the names of the
        columns.
    columns
        columns of time, input and output, and optionally of the external signal of a closed loop:
        names if the file has them, or numbers from 1 on. With ``dt`` there is no time.
    dt
        sample time [s] of a file without times.
    time_unit
        unit of the times: ``s``, ``ms``, ``us`` or ``ns``. By default they are seconds, and a
        ``UserWarning`` says where they hardly can be.
    max_size
        limit of what the file may unpack to [MB].

    Raises
    ------
    ValueError
        names line and column of a fault in the file; and if the name of the column of times has
        another unit than s, and ``time_unit`` is not given.
    """
    if dt is not None:
        checks.positive("dt", dt, "s")
    if time_unit is not None:
        checks.one_of("time_unit", time_unit, tuple(UNITS))
        if dt is not None:
            raise ValueError(f"time_unit = {time_unit!r}: there are no times, as dt is given")
    _check_columns(columns, timed=dt is None)
    where, most = f"data = {os.fspath(path)!r}", bytes_of(max_size)
    rows = _rows(Path(path), where, most)
    first = next(rows, None)
    if first is None:
        raise ValueError(f"{where}: is empty")
    header = None if all(_is_number(cell) for cell in first[1] if cell) else first[1]
    if header is None:
        rows = chain((first,), rows)
    width = len(_without_empty_end(first[1]))
    roles = enumerate(columns, start=int(dt is not None))
    places = [_place(where, header, width, name, role) for role, name in roles]
    head = list(islice(rows, _FEWEST))
    if len(head) < _FEWEST:
        raise ValueError(f"{where}: has {len(head)} samples; must have at least {_FEWEST}")
    numbers, values = _values(where, chain(head, rows), places, columns, most)
    if dt is None:
        name = "" if header is None else header[places[0]]
        check_unit(where, name, time_unit)
        dt = sample_time(where, values[:, 0], numbers, time_unit)
        values = values[:, 1:]
    elif header is not None:
        warn_of_another_step(where, header, [row for _, row in head], dt)
    u, y, *reference = (column.copy() for column in values.T)
    return Measured(u, y, dt, reference[0] if reference else None)


def _check_columns(columns: Sequence[str], timed: bool) -> None:
    listed = checks.is_sequence(columns) and all(isinstance(name, str) for name in columns)
    counts = (3, 4) if timed else (2, 3)
    if not listed or len(set(columns)) != len(columns) or len(columns) not in counts:
        names = ",".join(columns) if listed else columns
        rule = "t,u,y or t,u,y,r" if timed else "u,y or u,y,r, as dt is given"
        listed_as = "" if listed else ", as a list"
        raise ValueError(f"columns = {names!r}: must be {rule}, by names or numbers{listed_as}")


def _rows(path: Path, where: str, most: int) -> Iterator[_Row]:
    """Yield number and cells of the lines of a file that are not comments."""
    lines, begin = text_lines(path, where, most), []
    for line in lines:
        begin.append(line)
        if line.strip() and not line.startswith("#"):
            break
    first = begin[-1] if begin else ""
    separator = next((mark for mark in ("\t", ";") if mark in first), ",")
    for number, row in csv_rows(chain(begin, lines), where, separator):
        if not row[0].startswith("#"):
            yield number, row if separator == "," else [_with_point(cell) for cell in row]


def _without_empty_end(row: list[str]) -> list[str]:
    """Return a row without the empty cell behind a delimiter at the end of its line."""
    return row[:-1] if row and not row[-1] else row


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


def _values(
    where: str, rows: Iterator[_Row], places: list[int], names: Sequence[str], most: int
) -> tuple[Vector, Matrix]:
    """Return the numbers of the lines, and their values (samples, columns)."""
    numbers: list[Vector] = []
    blocks: list[Matrix] = []
    size = 0
    while block := list(islice(rows, _BLOCK)):
        size += 8 * len(block) * (len(places) + 1)
        check_size(size, most, where)
        numbers.append(np.array([number for number, _ in block], dtype=np.float64))
        blocks.append(_block(where, block, places, names))
    return np.concatenate(numbers), np.concatenate(blocks)


def _block(where: str, rows: list[_Row], places: list[int], names: Sequence[str]) -> Matrix:
    """Return the values of some rows (rows, columns)."""
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
