"""Recordings as CSV: a line of names, then a line for each row; the header is in ``<name>.json``.

The first column is ``time`` [s]; the others are those of the row, ``x_hat[0]`` the first entry of a
vector channel. Numbers have the digits that it takes to read the same bits back; NaN is ``nan``.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from quell.files import check_writable, written_atomically
from quell.reading import byte_lines, check_size, whole_text
from quell.realtime.telemetry.channels import K
from quell.realtime.telemetry.header import Header
from quell.types import Channels, Matrix, Vector

# Numbers that are converted to an array at once when reading; chosen by hand, not tuned further.
_BLOCK = 100_000


class CsvSink:
    """Write rows to a CSV file ``path``, which grows as they come, and a header beside it.

    Files that exist are refused, or replaced if ``overwrite`` is True.
    """

    def __init__(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        self.path, self.overwrite = Path(path), overwrite
        self.name = str(self.path)
        self._file: BinaryIO | None = None
        self._dt = 0.0
        self._first = True

    def check(self) -> None:
        """Raise a ``ValueError`` if a file can't be written or may not be replaced."""
        for path in (self.path, header_path(self.path)):
            check_writable(path, self.overwrite)

    def open(self, header: Header) -> None:
        """Write the line of names, and the header beside the file."""
        self.check()
        self.path.unlink(missing_ok=True)
        with written_atomically(header_path(self.path), self.overwrite) as part:
            part.write_text(header.to_json() + "\n", encoding="utf-8")
        self._dt, self._first = header.dt, True
        self._file = self.path.open("xb")
        self._file.write((",".join(("time", *header.columns)) + "\n").encode())
        self._file.flush()

    def write(self, rows: Matrix) -> None:
        """Add a line for each row."""
        assert self._file is not None
        lines = []
        for row in rows.tolist():
            numbers = [row[K] * self._dt, *row]
            # Some readers (PlotJuggler 3.15) take the type of a column from the first line, and
            # 1e-05 for text.
            text = partial(np.format_float_positional, trim="0") if self._first else repr
            lines.append(",".join(map(text, numbers)))
            self._first = False
        self._file.write(("\n".join(lines) + "\n").encode())

    def flush(self) -> None:
        """Pass what was written to the operating system, where it outlives the process."""
        if self._file is not None:
            self._file.flush()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            file, self._file = self._file, None
            file.close()


def header_path(path: Path) -> Path:
    """Return the path of the header of a CSV file."""
    return path.with_name(path.name + ".json")


def read_csv(path: Path, most: int) -> tuple[Header, Matrix]:
    """Return header and rows of a ``CsvSink``'s file, without a last line that was cut short.

    Without the header beside it, dt comes from the column ``time``; ``features`` are unknown. The
    rows may take ``most`` bytes.
    """
    lines = byte_lines(path)
    names = next(lines, b"").decode("utf-8", errors="replace").strip().split(",")
    if names[:2] != ["time", "k"]:
        raise ValueError("its first line is not the names of a recording's columns: time, k, …")
    beside = header_path(path)
    header = Header.from_json(whole_text(beside)) if beside.is_file() else None
    channels = _channels(names[1:]) if header is None else header.channels
    table = _table(lines, len(names), most)
    time, rows = table[:, 0], np.ascontiguousarray(table[:, 1:])
    if header is None:
        header = Header(channels, _sample_time(time, rows[:, K]), started=0)
    if header.columns != tuple(names[1:]):
        raise ValueError(f"its columns differ from those in {beside.name}")
    return header, rows


def _table(lines: Iterator[bytes], width: int, most: int) -> Matrix:
    """Return lines of ``width`` numbers as a matrix of at most ``most`` bytes."""
    filled = ((number, line) for number, line in enumerate(lines, 2) if line.strip())
    blocks, size = [np.empty((0, width))], 0
    while block := list(islice(filled, max(1, _BLOCK // width))):
        size += 8 * width * len(block)
        check_size(size, most)
        rows = _numbers([line for _, line in block])
        if rows is None or rows.shape[1] != width:
            numbers = (number for number, line in block if not _is_row(line, width))
            raise ValueError(f"line {next(numbers)} is not {width} numbers")
        blocks.append(rows)
    return np.concatenate(blocks)


def _numbers(lines: list[bytes]) -> Matrix | None:
    """Return lines as a matrix; None if they are not equally many numbers each."""
    try:
        return np.loadtxt(lines, delimiter=",", ndmin=2, comments=None)
    except ValueError:
        return None


def _is_row(line: bytes, width: int) -> bool:
    row = _numbers([line])
    return row is not None and row.shape[1] == width


def _channels(columns: list[str]) -> Channels:
    """Return the channels with these columns."""
    widths: dict[str, int] = {}
    for column in columns:
        name = column.partition("[")[0]
        widths[name] = widths.get(name, 0) + 1
    return tuple(widths.items())


def _sample_time(time: Vector, k: Vector) -> float:
    """Return the dt with the fewest digits for which all rows have exactly ``time = k dt``."""
    later = np.flatnonzero(k > 0)
    if later.size == 0:
        raise ValueError(
            "its sample time is unknown: it has no row after the first and no header beside it"
        )
    last = later[-1]
    about = float(time[last] / k[last])
    rounded = [float(f"{about:.{digits}g}") for digits in (3, 6, 9, 12, 15)]
    with np.errstate(all="ignore"):  # a damaged file may hold any numbers
        candidates = [*rounded, about, *np.nextafter(about, [0.0, 2.0 * about]).tolist()]
        return next((dt for dt in candidates if np.array_equal(k * dt, time)), about)
