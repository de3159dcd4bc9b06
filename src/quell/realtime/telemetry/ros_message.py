"""A row as a ROS 2 message: PlotJuggler and Foxglove read those without being told anything else, from files and live.

The definition (``ros2msg``) is a line for each channel. The message in plain CDR, little endian (OMG DDSI-RTPS 2.5, 10.2), is four bytes
that say so, and then the numbers: all of them are 64 bits, so nothing is padded, and arrays of fixed length have no count.
"""

from __future__ import annotations

from quell.realtime.telemetry.header import Header
from quell.records.record import is_vector, meaning
from quell.types import Matrix

SCHEMA = "quell/msg/Cycle"
TOPIC = "/loop"
MARK = b"\x00\x01\x00\x00"
"""What a message begins with: plain CDR, little endian, no options."""


def definition(header: Header) -> str:
    """Return the definition of a row's message: ``float64 y``, ``float64[3] x_hat``, … with meanings and units as comments."""
    lines = []
    for name, width in header.channels:
        if width:
            told, unit = meaning(name)
            kind = f"float64[{width}]" if is_vector(name, width) else "float64"
            lines.append(f"{kind} {name}  # {told} [{header.units.get(name, unit)}]")
    return "\n".join(lines) + "\n"


def messages(rows: Matrix) -> list[bytes]:
    """Return the message of each row."""
    return [MARK + row.tobytes() for row in rows.astype("<f8", copy=False)]


def log_time(header: Header, k: float) -> int:
    """Return when the row of deadline ``k`` was due: nanoseconds since 1970, UTC."""
    return header.started + round(k * header.dt * 1e9)
