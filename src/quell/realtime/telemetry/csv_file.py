"""Recordings as CSV: a line of names, then a line for each row; the header is in ``<name>.json``.

The first column is ``time`` [s]; the others are those of the row, ``x_hat[0]`` the first entry of a
vector channel. Numbers have the digits that it takes to read the same bits back; NaN is ``nan``.
"""

from __future__ import annotations

import io
import os
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from quell.files import check_new_file, written_atomically
from quell.realtime.telemetry.channels import K
from quell.realtime.telemetry.header import Header
from quell.types import Channels, Matrix, Vector


class CsvSink:
    """Write rows to a new CSV file ``path``, which grows as they come."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.name = str(self.path)
        self._file: BinaryIO | None = None
        self._dt = 0.0
        self._first = True

    def open(self, header: Header) -> None:
        """Write the line of names, and the header beside the file."""
        check_new_file(self.path)
        with written_atomically(header_path(self.path)) as part:
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


def read_csv(path: Path) -> tuple[Header, Matrix]:
    """Return header and rows of a ``CsvSink``'s file, without a last line that was cut short.

    Without the header beside it, dt comes from the column ``time``; ``features`` are unknown.
    """
    text = path.read_bytes()
    first, _, body = text[: text.rfind(b"\n") + 1].partition(b"\n")
    names = first.decode("utf-8", errors="replace").strip().split(",")
    if names[:2] != ["time", "k"]:
        raise ValueError("its first line is not the names of a recording's columns: time, k, …")
    try:
        table = np.empty((0, len(names)))
        if body:
            table = np.loadtxt(io.BytesIO(body), delimiter=",", ndmin=2, comments=None)
    except ValueError as error:
        raise ValueError(f"a line is not {len(names)} numbers ({error})") from None
    if table.shape[1] != len(names):
        raise ValueError(f"it names {len(names)} columns and has {table.shape[1]}")
    time, rows = table[:, 0], np.ascontiguousarray(table[:, 1:])
    beside = header_path(path)
    if beside.is_file():
        header = Header.from_json(beside.read_text(encoding="utf-8"))
    else:
        header = Header(_channels(names[1:]), _sample_time(time, rows[:, K]), started=0)
    if header.columns != tuple(names[1:]):
        raise ValueError(f"its columns differ from those in {beside.name}")
    return header, rows


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
    candidates = [*rounded, about, *np.nextafter(about, [0.0, 2.0 * about]).tolist()]
    return next((dt for dt in candidates if np.array_equal(k * dt, time)), about)
