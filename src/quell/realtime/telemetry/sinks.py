"""Where telemetry goes: files of several kinds, live viewers, memory."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from quell.realtime.telemetry.csv_file import CsvSink
from quell.realtime.telemetry.header import Header
from quell.realtime.telemetry.live import LiveSink
from quell.realtime.telemetry.load import trajectory_of
from quell.realtime.telemetry.mcap_file import McapSink
from quell.realtime.telemetry.writer import Sink
from quell.records.trajectory import Trajectory
from quell.types import Matrix

__all__ = ["CsvSink", "LiveSink", "McapSink", "MemorySink", "file_sink"]


class MemorySink:
    """Keep rows in memory: some 20 numbers a cycle, which at 1 kHz are 10 MB a minute."""

    name = "memory"

    def __init__(self) -> None:
        self._header: Header | None = None
        self._rows: list[Matrix] = []

    def open(self, header: Header) -> None:
        """Begin anew."""
        self._header = header
        self._rows = []

    def write(self, rows: Matrix) -> None:
        """Keep the rows."""
        self._rows.append(rows)

    def flush(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    def trajectory(self) -> Trajectory:
        """Return what was kept, as ``load`` does for a file."""
        if self._header is None:
            raise ValueError("nothing was recorded yet")
        rows = np.concatenate(self._rows) if self._rows else np.empty((0, self._header.width))
        return trajectory_of(self._header, rows)


def file_sink(path: str | os.PathLike[str]) -> Sink:
    """Return the sink for a file, by its suffix: ``.csv`` or ``.mcap``.

    Raises
    ------
    ValueError
        for another suffix.
    """
    kinds: dict[str, Callable[[str | os.PathLike[str]], Sink]] = {
        ".csv": CsvSink,
        ".mcap": McapSink,
    }
    suffix = Path(path).suffix.lower()
    if suffix not in kinds:
        raise ValueError(f"path = {os.fspath(path)!r}: must end in {' or '.join(kinds)}")
    return kinds[suffix](path)
