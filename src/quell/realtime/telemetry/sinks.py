"""Sinks, which take the rows of a loop: their protocol, memory, and files by their suffix."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

import numpy as np

from quell.realtime.telemetry.csv_file import CsvSink
from quell.realtime.telemetry.header import Header
from quell.realtime.telemetry.load import trajectory_of
from quell.realtime.telemetry.mcap_file import McapSink
from quell.records.trajectory import Trajectory
from quell.types import Matrix


class Sink(Protocol):
    """A receiver of rows; all methods except ``open`` are called on the writer's thread."""

    name: str  #: name in messages

    def open(self, header: Header) -> None:
        """Begin a recording; raise a ``ValueError`` with the reason if that is impossible."""

    def write(self, rows: Matrix) -> None:
        """Take the next rows (rows, width), in order."""

    def flush(self) -> None:
        """Store what was taken where it outlives this process; called after each round of rows."""

    def close(self) -> None:
        """End the recording."""


class MemorySink:
    """Keep rows in memory: about 20 values a cycle, which is 10 MB a minute at 1 kHz."""

    name = "memory"

    def __init__(self) -> None:
        self._header: Header | None = None
        self._rows: list[Matrix] = []

    def open(self, header: Header) -> None:
        """Begin a new recording."""
        self._header, self._rows = header, []

    def write(self, rows: Matrix) -> None:
        """Keep the rows."""
        self._rows.append(rows)

    def flush(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    def trajectory(self) -> Trajectory:
        """Return the recording as ``load`` does for a file."""
        if self._header is None:
            raise ValueError("nothing was recorded yet")
        rows = np.concatenate(self._rows) if self._rows else np.empty((0, self._header.width))
        return trajectory_of(self._header, rows)


def file_sink(path: str | os.PathLike[str], overwrite: bool = False) -> CsvSink | McapSink:
    """Return the sink for a file by its suffix, ``.csv`` or ``.mcap``."""
    kinds: dict[str, type[CsvSink | McapSink]] = {".csv": CsvSink, ".mcap": McapSink}
    suffix = Path(path).suffix.lower()
    if suffix not in kinds:
        raise ValueError(f"path = {os.fspath(path)!r}: must end in {' or '.join(kinds)}")
    return kinds[suffix](path, overwrite)
