"""Rows as ROS 2 messages, which PlotJuggler and Foxglove read without configuration.

The definition (``ros2msg``) has a line for each channel. The message in plain CDR, little endian
(OMG DDSI-RTPS 2.5, section 10.2), is a mark of four bytes and then the values: all have 64 bits, so
nothing is padded, and arrays of fixed length have no count.
"""

from __future__ import annotations

from typing import Any

from quell.realtime.telemetry.channels import K
from quell.realtime.telemetry.header import Header
from quell.records.channels import describe, is_vector
from quell.types import Matrix, Vector

SCHEMA = "quell/msg/Cycle"
TOPIC = "/loop"
MARK = b"\x00\x01\x00\x00"  # first bytes of a message: plain CDR, little endian, no options


def definition(header: Header) -> str:
    """Return the definition of a row's message, with meanings and units as comments."""
    lines = []
    for name, width in header.channels:
        if width:
            text, unit = describe(name, header.signals)
            kind = f"float64[{width}]" if is_vector(name, width) else "float64"
            lines.append(f"{kind} {name}  # {text} [{header.units.get(name, unit)}]")
    return "\n".join(lines) + "\n"


def advertised(header: Header) -> dict[str, Any]:
    """Return the channel for rows as a Foxglove server advertises it."""
    names = {"id": 1, "topic": TOPIC, "encoding": "cdr", "schemaName": SCHEMA}
    return {**names, "schemaEncoding": "ros2msg", "schema": definition(header)}


def message(row: Vector) -> bytes:
    """Return a row as a message."""
    return MARK + row.astype("<f8", copy=False).tobytes()


def row_time(header: Header, k: float) -> int:
    """Return the time of the deadline k, in nanoseconds since 1970."""
    return header.started + round(k * header.dt * 1e9)


def open_topic(foxglove: Any, header: Header, context: Any) -> Any:
    """Return a Foxglove channel for rows in a context."""
    schema = foxglove.Schema(name=SCHEMA, encoding="ros2msg", data=definition(header).encode())
    return foxglove.Channel(TOPIC, schema=schema, message_encoding="cdr", context=context)


def log_rows(topic: Any, header: Header, rows: Matrix) -> None:
    """Log a message for each row, at the time of its deadline."""
    for row, k in zip(rows, rows[:, K].tolist(), strict=True):
        topic.log(message(row), log_time=row_time(header, k))
