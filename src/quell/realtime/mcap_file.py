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

from quell.realtime.channels import K
from quell.realtime.csv_file import check_new
from quell.realtime.extras import needed
from quell.realtime.header import Header
from quell.realtime.ros_message import MARK, SCHEMA, TOPIC, definition, log_time, messages
from quell.types import Matrix

MAGIC = b"\x89MCAP0\r\n"
RECORD = "quell"
"""Name of the metadata record with the header."""

_ON_DISK_EVERY = 0.5  # [s]


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
        foxglove = needed("foxglove", "telemetry", "an MCAP file")
        mcap = needed("foxglove.mcap", "telemetry", "an MCAP file")
        check_new(self.path)
        self._header, context = header, foxglove.Context()
        options = mcap.MCAPWriteOptions(compression=None)
        self._writer = foxglove.open_mcap(str(self.path), context=context, writer_options=options)
        self._writer.write_metadata(RECORD, {"header": header.to_json()})
        schema = foxglove.Schema(name=SCHEMA, encoding="ros2msg", data=definition(header).encode())
        self._channel = foxglove.Channel(TOPIC, schema=schema, message_encoding="cdr", context=context)
        self._writer.flush()
        self._flushed = time.monotonic()

    def write(self, rows: Matrix) -> None:
        """Add a message for each row."""
        for message, k in zip(messages(rows), rows[:, K].tolist(), strict=True):
            self._channel.log(message, log_time=log_time(self._header, k))

    def flush(self) -> None:
        """Finish the chunk, where half a second has passed since the last one; whatever was not written fails here."""
        if time.monotonic() - self._flushed >= _ON_DISK_EVERY:
            self._writer.flush()
            self._flushed = time.monotonic()

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            writer, self._writer = self._writer, None
            self._channel.close()
            writer.close()


def read_mcap(path: Path) -> tuple[Header, Matrix]:
    """Return what a ``McapSink`` wrote, as far as it goes: what comes after the last whole chunk is left out.

    Raises
    ------
    ValueError
        where the file is something else.
    ImportError
        where the package mcap is missing.
    """
    needed("mcap", "telemetry", "reading an MCAP file")
    header: Header | None = None
    schemas: dict[int, str] = {}
    topics: dict[int, tuple[str, str | None]] = {}
    rows: list[bytes] = []
    for record in _records(path):
        kind = type(record).__name__
        if kind == "Message":
            if topics.get(record.channel_id) == (TOPIC, SCHEMA):
                rows.append(record.data)
        elif kind == "Schema":
            schemas[record.id] = record.name
        elif kind == "Channel":
            topics[record.id] = (record.topic, schemas.get(record.schema_id))
        elif kind == "Metadata" and record.name == RECORD:
            header = Header.from_json(record.metadata.get("header", ""))
    if header is None:
        raise ValueError(f"it has no metadata record {RECORD!r}: it was not recorded by quell")
    size = len(MARK) + 8 * header.width
    if any(len(row) != size or row[:4] != MARK for row in rows):
        raise ValueError(f"a message on {TOPIC} is not one of a row of {header.width} numbers")
    numbers = np.frombuffer(b"".join(row[4:] for row in rows), dtype="<f8")
    return header, numbers.reshape(-1, header.width).astype(np.float64)


def _records(path: Path) -> Iterator[Any]:
    """Return the records of a file, up to where it ends or makes no sense any more."""
    from mcap.exceptions import McapError
    from mcap.stream_reader import StreamReader

    with path.open("rb") as file:
        try:
            yield from StreamReader(file).records
        except (McapError, struct.error, UnicodeDecodeError):
            return
