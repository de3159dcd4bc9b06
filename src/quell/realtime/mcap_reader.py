"""Recordings in MCAP, read within a limit of size.

The records of the file (mcap.dev/spec) and of its chunks are taken apart here, and the package
``mcap`` reads the fields of the few that a recording needs. Its own reader takes each length in the
file for true, and expands a chunk to any size.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from quell.checks import import_extra
from quell.files import check_settings, check_size
from quell.types import Matrix

SCHEMA = "quell/msg/Cycle"  # of the messages with rows
TOPIC = "/loop"
MARK = b"\x00\x01\x00\x00"  # first bytes of a message: plain CDR, little endian, no options
MAGIC = b"\x89MCAP0\r\n"  # first bytes of a file
RECORD = "quell"  # name of the metadata record with the header

_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _METADATA = 0x03, 0x04, 0x05, 0x06, 0x0C
_START = struct.Struct("<BQ")  # opcode and length of a record
_MESSAGE_START = struct.Struct("<HIQQ")  # channel, sequence number, log time, publish time
# Messages that are converted to an array at once; chosen by hand, not tuned further.
_BLOCK = 4096
# A record counts as at least so many bytes, however short it is: about what it takes in memory, and
# a limit of the time that many empty records can take. Chosen by hand.
_LEAST_RECORD = 64


class _DamagedError(Exception):
    """The records end here: cut short, or no MCAP."""


class _Record(NamedTuple):
    opcode: int
    body: bytes


def read_mcap(path: Path, most: int) -> tuple[str, Matrix]:
    """Return header, as JSON, and rows of a ``McapSink``'s file, up to its last complete chunk.

    The contents may take ``most`` bytes.
    """
    import_extra("mcap", "telemetry", "reading an MCAP file")
    header: str | None = None
    schemas: dict[int, str] = {}
    ours: set[int] = set()  # numbers of the channels that have the rows
    messages: list[bytes] = []
    blocks: list[Matrix] = []
    with contextlib.suppress(_DamagedError):  # all up to there is good
        for opcode, body in _records(path, most):
            if opcode == _MESSAGE:
                if int.from_bytes(body[:2], "little") in ours and len(body) >= _MESSAGE_START.size:
                    messages.append(body[_MESSAGE_START.size :])
                    if len(messages) == _BLOCK:
                        blocks.append(_rows(messages))
                        messages = []
            elif opcode == _SCHEMA:
                schema = _fields("Schema", body)
                schemas[schema.id] = schema.name
            elif opcode == _CHANNEL:
                channel = _fields("Channel", body)
                if (channel.topic, schemas.get(channel.schema_id)) == (TOPIC, SCHEMA):
                    ours.add(channel.id)
                else:
                    ours.discard(channel.id)
            elif opcode == _METADATA:
                check_settings(len(body))
                metadata = _fields("Metadata", body)
                if metadata.name == RECORD:
                    header = str(metadata.metadata.get("header", ""))
    if header is None:
        raise ValueError(f"it has no metadata record {RECORD!r}: it was not recorded by quell")
    blocks = [block for block in (*blocks, _rows(messages)) if block.size]
    if len({block.shape[1] for block in blocks}) > 1:
        raise ValueError(f"the messages on {TOPIC} are not rows of the same width")
    return header, np.concatenate(blocks) if blocks else np.empty((0, 0))


def whole_part(path: Path) -> tuple[int, int]:
    """Return how many bytes of a file are whole records, and how many messages are in them."""
    size, messages = len(MAGIC), 0
    end = path.stat().st_size
    with path.open("rb") as file:
        file.seek(size)
        while len(start := file.read(_START.size)) == _START.size:
            opcode, length = _START.unpack(start)
            if length > end - file.tell():
                break
            if opcode == _CHUNK:
                content = _split(_expanded(file.read(length), end))
                messages += sum(each.opcode == _MESSAGE for each in content)
            else:
                file.seek(length, os.SEEK_CUR)
            size = file.tell()
    return min(size, end), messages


def _rows(messages: list[bytes]) -> Matrix:
    """Return the rows (messages, width) of messages."""
    if not messages:
        return np.empty((0, 0))
    size = len(messages[0])
    if size % 8 != len(MARK) or not all(
        len(message) == size and message.startswith(MARK) for message in messages
    ):
        raise ValueError(f"the messages on {TOPIC} are not rows of the same width")
    values = np.frombuffer(b"".join(message[len(MARK) :] for message in messages), dtype="<f8")
    return values.reshape(len(messages), -1).astype(np.float64)


def _records(path: Path, most: int) -> Iterator[_Record]:
    """Yield the records that matter; a ``_DamagedError`` ends them."""
    size = 0
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        for record in _top_level(file, os.fstat(file.fileno()).st_size, most):
            in_chunk = record.opcode == _CHUNK
            for each in _split(_expanded(record.body, most)) if in_chunk else (record,):
                size += max(len(each.body), _LEAST_RECORD)
                check_size(size, most)
                yield each


def _top_level(file: BinaryIO, end: int, most: int) -> Iterator[_Record]:
    """Yield the records of a file of ``end`` bytes; others than ours are not read."""
    while len(start := file.read(_START.size)) == _START.size:
        opcode, length = _START.unpack(start)
        if length > end - file.tell():
            return
        if opcode in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _METADATA):
            check_size(length, most)
            yield _Record(opcode, file.read(length))
        else:
            file.seek(length, os.SEEK_CUR)


def _split(content: bytes) -> Iterator[_Record]:
    """Yield the records of a chunk."""
    at, end = 0, len(content)
    while at + _START.size <= end:
        opcode, length = _START.unpack_from(content, at)
        at += _START.size
        if length > end - at:
            raise _DamagedError
        if opcode in (_SCHEMA, _CHANNEL, _MESSAGE):
            yield _Record(opcode, content[at : at + length])
        else:
            yield _Record(0, b"")
        at += length


def _expanded(body: bytes, most: int) -> bytes:
    """Return the content of a chunk, of at most ``most`` bytes."""
    chunk = _fields("Chunk", body)
    if not chunk.compression:
        return chunk.data
    size = chunk.uncompressed_size
    check_size(size, most)
    if chunk.compression not in _DECOMPRESS:
        raise ValueError(f"its compression {chunk.compression!r} is unknown; must be zstd or lz4")
    content = _DECOMPRESS[chunk.compression](chunk.data, size + 1)
    if len(content) != size:
        raise _DamagedError
    return content


def _from_zstd(data: bytes, most: int) -> bytes:
    zstandard = import_extra("zstandard", "telemetry", "reading a compressed MCAP file")
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            return reader.read(most)
    except zstandard.ZstdError:
        raise _DamagedError from None


def _from_lz4(data: bytes, most: int) -> bytes:
    lz4 = import_extra("lz4.frame", "telemetry", "reading a compressed MCAP file")
    try:
        return lz4.LZ4FrameDecompressor().decompress(data, max_length=most)
    except (RuntimeError, EOFError):
        raise _DamagedError from None


# The functions that expand a chunk to at most so many bytes, by the name of its compression.
_DECOMPRESS = {"zstd": _from_zstd, "lz4": _from_lz4}


def _fields(kind: str, body: bytes) -> Any:
    """Return the fields of a record, as the package ``mcap`` reads them."""
    from mcap import records
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError

    try:
        return getattr(records, kind).read(ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, UnicodeDecodeError, OverflowError):
        raise _DamagedError from None
