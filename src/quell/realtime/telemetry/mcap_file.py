"""Recordings as MCAP: a message a row on the topic ``/loop`` (see ``ros_message``), and the header as the metadata record ``quell``.

The file is written by foxglove-sdk, in chunks. A chunk is on disk once it is finished, which is done twice a second here, whatever the
rate, and it is not compressed: the numbers of a loop are mostly noise, of which compression saves a tenth, for milliseconds of work. The
log time of a message is when its deadline was due.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from quell.optional import import_extra
from quell.realtime.telemetry.channels import K
from quell.realtime.telemetry.csv_file import check_new
from quell.realtime.telemetry.header import Header
from quell.realtime.telemetry.ros_message import MARK, SCHEMA, TOPIC, definition, log_time, messages
from quell.types import Matrix

MAGIC = b"\x89MCAP0\r\n"
RECORD = "quell"
"""Name of the metadata record with the header."""

_ON_DISK_EVERY = 0.5  # [s]
_BLOCK = 4096  # rows are numbers, not objects, from so many on


class _File:
    """The file under foxglove's writer, which would keep the reason of a failure to itself and log each message after it.

    So a failure is noted here, and the writer is told that all went well until it is closed.
    """

    def __init__(self, path: Path) -> None:
        self._raw = path.open("xb", buffering=0)
        self._place = self._end = 0
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:
        """Write all of ``data``, or take note of why not."""
        rest = memoryview(data)
        try:
            while rest and self.error is None:
                rest = rest[self._raw.write(rest) :]
        except OSError as error:
            self.error = error
        self._place += len(data)
        self._end = max(self._end, self._place)
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Go to a place: the length of a chunk is written before it when it is finished."""
        self._place = offset + (0, self._place, self._end)[whence]
        if self.error is None:
            self._raw.seek(self._place)
        return self._place

    def flush(self) -> None:
        """Do nothing: all is with the operating system."""

    def close(self) -> None:
        """Close the file."""
        self._raw.close()


class McapSink:
    """Write rows to an MCAP file, which grows as they come.

    Parameters
    ----------
    path
        where to; a file that is there is not overwritten.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.name = str(self.path)
        self._writer: Any = None
        self._flushed = 0.0

    def open(self, header: Header) -> None:
        """Begin the file; the header is on disk at once."""
        foxglove = import_extra("foxglove", "telemetry", "an MCAP file")
        mcap = import_extra("foxglove.mcap", "telemetry", "an MCAP file")
        check_new(self.path)
        self._header = header
        self._context = context = foxglove.Context()  # a channel is closed with it
        self._file = _File(self.path)
        self._writer = foxglove.open_mcap(
            self._file, context=context, writer_options=mcap.MCAPWriteOptions(compression=None)
        )
        self._writer.write_metadata(RECORD, {"header": header.to_json()})
        schema = foxglove.Schema(name=SCHEMA, encoding="ros2msg", data=definition(header).encode())
        self._channel = foxglove.Channel(
            TOPIC, schema=schema, message_encoding="cdr", context=context
        )
        self._writer.flush()
        self._flushed = time.monotonic()

    def write(self, rows: Matrix) -> None:
        """Add a message for each row."""
        for message, k in zip(messages(rows), rows[:, K].tolist(), strict=True):
            self._channel.log(message, log_time=log_time(self._header, k))
        self._check()

    def flush(self) -> None:
        """Finish the chunk, where half a second has passed since the last one."""
        if time.monotonic() - self._flushed >= _ON_DISK_EVERY:
            self._writer.flush()
            self._flushed = time.monotonic()
        self._check()

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            writer, self._writer = self._writer, None
            self._channel.close()
            writer.close()
            self._file.close()
            self._check()

    def _check(self) -> None:
        """Say what the file could not do."""
        if self._file.error is not None:
            raise self._file.error


def read_mcap(path: Path) -> tuple[Header, Matrix]:
    """Return what a ``McapSink`` wrote, as far as it goes: what comes after the last whole chunk is left out.

    Raises
    ------
    ValueError
        where the file is something else.
    ImportError
        where the package mcap is missing.
    """
    import_extra("mcap", "telemetry", "reading an MCAP file")
    header: Header | None = None
    schemas: dict[int, str] = {}
    topics: dict[int, tuple[str, str | None]] = {}
    rows: list[bytes] = []
    blocks: list[Matrix] = []
    for record in _records(path):
        kind = type(record).__name__
        if kind == "Message":
            if topics.get(record.channel_id) == (TOPIC, SCHEMA):
                rows.append(record.data)
                if len(rows) == _BLOCK:
                    blocks.append(_numbers(rows))
                    rows = []
        elif kind == "Schema":
            schemas[record.id] = record.name
        elif kind == "Channel":
            topics[record.id] = (record.topic, schemas.get(record.schema_id))
        elif kind == "Metadata" and record.name == RECORD:
            header = Header.from_json(record.metadata.get("header", ""))
    if header is None:
        raise ValueError(f"it has no metadata record {RECORD!r}: it was not recorded by quell")
    blocks = [block for block in (*blocks, _numbers(rows)) if block.size]
    if any(block.shape[1] != header.width for block in blocks):
        raise ValueError(f"a message on {TOPIC} is not a row of {header.width} numbers")
    return header, np.concatenate(blocks) if blocks else np.empty((0, header.width))


def _numbers(messages: list[bytes]) -> Matrix:
    """Return the rows (messages, width) that messages hold."""
    if not messages:
        return np.empty((0, 0))
    size = len(messages[0])
    if size % 8 != len(MARK) or not all(
        len(message) == size and message.startswith(MARK) for message in messages
    ):
        raise ValueError(f"the messages on {TOPIC} are not rows of the same width")
    numbers = np.frombuffer(b"".join(message[len(MARK) :] for message in messages), dtype="<f8")
    return numbers.reshape(len(messages), -1).astype(np.float64)


def _records(path: Path) -> Iterator[Any]:
    """Return the records of a file, up to where it ends or makes no sense any more."""
    from mcap.exceptions import McapError
    from mcap.stream_reader import StreamReader

    with path.open("rb") as file:
        try:
            yield from StreamReader(file).records
        except (McapError, struct.error, UnicodeDecodeError):
            return
