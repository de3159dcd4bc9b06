"""Recordings as MCAP: a message for each row, and the header as metadata.

The topic is ``/loop``, the metadata record ``quell``. The file is written by foxglove-sdk, in
chunks. A finished chunk is on disk; here chunks are finished twice a second. They are not
compressed: the values of a loop are mostly noise, of which compression saves about a tenth
for milliseconds of work. The log time of a message is its deadline.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from quell.files import check_writable
from quell.optional import import_extra
from quell.realtime.telemetry.header import Header
from quell.realtime.telemetry.ros_message import log_rows, open_topic
from quell.types import Matrix

MAGIC = b"\x89MCAP0\r\n"
RECORD = "quell"  # name of the metadata record with the header

# Time between two chunks [s]: with the writer's 0.25 s a killed process loses less than 1 s.
_CHUNK_TIME = 0.5
# A chunk is finished at this size, too [bytes]; a full disk costs the rows of the last one. Chosen
# by hand: a third of a second at 1 kHz and 24 values a row.
_CHUNK_SIZE = 65_536


class _File:
    """File for foxglove's writer that keeps the first error instead of raising it.

    The writer would hide the reason of a failure and log each later message. It is told that all
    went well; ``error`` holds the failure.
    """

    def __init__(self, path: Path) -> None:
        self._raw = path.open("xb", buffering=0)
        self._position = self._end = 0
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:
        """Write all of ``data``, or keep the error."""
        rest = memoryview(data)
        try:
            while rest and self.error is None:
                rest = rest[self._raw.write(rest) :]
        except OSError as error:
            self.error = error
        self._position += len(data)
        self._end = max(self._end, self._position)
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move to a position: the length of a finished chunk is written before it."""
        self._position = offset + (0, self._position, self._end)[whence]
        if self.error is None:
            self._raw.seek(self._position)
        return self._position

    def flush(self) -> None:
        """Do nothing: the file has no buffer."""

    def close(self) -> None:
        """Close the file."""
        self._raw.close()


class McapSink:
    """Write rows to an MCAP file ``path``, which grows as they come.

    A file that exists is refused, or replaced if ``overwrite`` is True.
    """

    def __init__(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        self.path, self.overwrite = Path(path), overwrite
        self.name = str(self.path)
        self._writer: Any = None
        self._flushed = 0.0

    def check(self) -> None:
        """Raise a ``ValueError`` if the file can't be written or may not be replaced."""
        check_writable(self.path, self.overwrite)

    def open(self, header: Header) -> None:
        """Begin the file; the header is on disk at once, or an ``OSError`` says why it is not."""
        foxglove = import_extra("foxglove", "telemetry", "an MCAP file")
        mcap = import_extra("foxglove.mcap", "telemetry", "an MCAP file")
        self.check()
        self.path.unlink(missing_ok=True)
        self._header = header
        self._context = foxglove.Context()  # kept: a topic is closed with it
        self._file = _File(self.path)
        options = mcap.MCAPWriteOptions(compression=None, chunk_size=_CHUNK_SIZE)
        self._writer = foxglove.open_mcap(self._file, context=self._context, writer_options=options)
        self._writer.write_metadata(RECORD, {"header": header.to_json()})
        self._topic = open_topic(foxglove, header, self._context)
        self._writer.flush()
        self._flushed = time.monotonic()
        if self._file.error is not None:  # a full disk: nothing must move unrecorded
            with suppress(OSError):
                self.close()
            raise self._file.error

    def write(self, rows: Matrix) -> None:
        """Add a message for each row."""
        log_rows(self._topic, self._header, rows)
        self._check()

    def flush(self) -> None:
        """Finish the chunk if it is half a second old."""
        if time.monotonic() - self._flushed >= _CHUNK_TIME:
            self._writer.flush()
            self._flushed = time.monotonic()
        self._check()

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            writer, self._writer = self._writer, None
            self._topic.close()
            writer.close()
            self._file.close()
            self._check()

    def _check(self) -> None:
        """Raise the error that the file kept."""
        if self._file.error is not None:
            raise self._file.error
