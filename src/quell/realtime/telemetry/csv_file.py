"""Recordings as CSV: a line of names, then a line for each row; beside it, ``<name>.json`` with what the columns do not say.

The first column is ``time`` [s]; the others are those of the row, ``x_hat[0]`` the first entry of a channel of several. Numbers are written
with as many digits as it takes to read back the very same bits, and NaN as ``nan``.
"""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from quell.files import check_writable, written_atomically
from quell.realtime.telemetry.channels import K
from quell.realtime.telemetry.header import Header
from quell.types import Matrix, Vector


class CsvSink:
    """Write rows to a CSV file, which grows as they come.

    Parameters
    ----------
    path
        where to; a file that is there is not overwritten.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.name = str(self.path)
        self._file: BinaryIO | None = None
        self._dt = 0.0
        self._first = True

    def open(self, header: Header) -> None:
        """Write the names, and the header beside."""
        check_new(self.path)
        with written_atomically(beside_of(self.path)) as part:
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
            # Some readers (PlotJuggler 3.15) tell from the first line what a column holds, and take 1e-05 for text.
            lines.append(",".join(map(_positional if self._first else repr, numbers)))
            self._first = False
        self._file.write(("\n".join(lines) + "\n").encode())

    def flush(self) -> None:
        """Hand what was written to the operating system: it outlives the process there."""
        if self._file is not None:
            self._file.flush()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            file, self._file = self._file, None
            file.close()


def _positional(number: float) -> str:
    return np.format_float_positional(number, trim="0")


def beside_of(path: Path) -> Path:
    """Return where the header of a CSV file lies."""
    return path.with_name(path.name + ".json")


def check_new(path: Path) -> None:
    """Check that a recording can be begun at ``path``.

    Raises
    ------
    ValueError
        where there is a file already, or none can be written.
    """
    if path.exists() and not path.is_dir():
        raise ValueError(
            f"path = {str(path)!r}: there is such a file; recordings are not overwritten: move it, or choose another name"
        )
    check_writable(path)


def read_csv(path: Path) -> tuple[Header, Matrix]:
    """Return what a ``CsvSink`` wrote, as far as it goes: a line that was cut short by the end of the process is left out.

    Without the header beside it, dt is that of the column ``time``, and what the entries of ``theta`` multiply is not known.

    Raises
    ------
    ValueError
        where the file is something else.
    """
    text = path.read_bytes()
    lines = text[: text.rfind(b"\n") + 1]
    names = lines[: lines.find(b"\n")].decode("utf-8", errors="replace").strip().split(",")
    body = lines[lines.find(b"\n") + 1 :]
    if names[:2] != ["time", "k"]:
        raise ValueError(
            "its first line is not the names of a recording's columns, from time and k on"
        )
    try:
        table = (
            np.loadtxt(io.BytesIO(body), delimiter=",", ndmin=2, comments=None)
            if body
            else np.empty((0, len(names)))
        )
    except ValueError as error:
        raise ValueError(f"a line is not {len(names)} numbers ({error})") from None
    if table.shape[1] != len(names):
        raise ValueError(f"it names {len(names)} columns and has {table.shape[1]}")
    time, rows = table[:, 0], np.ascontiguousarray(table[:, 1:])
    beside = beside_of(path)
    if beside.is_file():
        header = Header.from_json(beside.read_text(encoding="utf-8"))
    else:
        channels = _channels(names[1:])
        header = Header(channels, _sample_time(time, rows[:, K]), started=0)
    if header.columns != tuple(names[1:]):
        raise ValueError(f"its columns are not those that {beside.name} tells of")
    return header, rows


def _channels(columns: Sequence[str]) -> tuple[tuple[str, int], ...]:
    """Return the channels whose columns these are."""
    widths: dict[str, int] = {}
    for column in columns:
        name = column.partition("[")[0]
        widths[name] = widths.get(name, 0) + 1
    return tuple(widths.items())


def _sample_time(time: Vector, k: Vector) -> float:
    """Return dt from ``time = k dt``, to the last bit: of the numbers that make all rows true, the one with the fewest digits."""
    later = np.flatnonzero(k > 0)
    if later.size == 0:
        raise ValueError(
            "it has no row but the first and no header beside it, so that the sample time is not known"
        )
    last = later[-1]
    about = float(time[last] / k[last])
    near = [float(f"{about:.{digits}g}") for digits in (3, 6, 9, 12, 15)] + [
        about,
        *np.nextafter(about, [0.0, 2.0 * about]).tolist(),
    ]
    return next((dt for dt in near if np.array_equal(k * dt, time)), about)
