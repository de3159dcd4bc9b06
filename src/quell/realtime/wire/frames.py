"""The frame that carries one number from a device to the loop, or back: 40 bytes, the same on every wire.

======  ====  ==========  ==========================================================================================================
offset  size  type        what
======  ====  ==========  ==========================================================================================================
0       2     bytes       ``QL``
2       1     uint8       version of this table: 1
3       1     uint8       kind: 1 measurement, 2 command, 3 hello, 4 welcome, 5 goodbye
4       4     uint32      session: drawn by the loop for each run; never 0
8       4     uint32      number of the frame: the sender's own count of ticks or cycles, from 1 on, modulo 2^32
12      4     uint32      answers: number of the newest frame that the sender has accepted of the other side; 0 where there was none
16      8     int64       time: the sender's monotonic clock [ns]
24      8     float64     value: y [y-unit], u [u-unit]; hello and welcome: the sample time [s]
32      4     uint32      state of the sender: 0, or flags: 1 the watchdog has set u to zero; in a welcome that refuses: 2 another session
                          is alive, 4 the device has another sample time; in a goodbye of the device: 8
36      4     uint32      CRC-32 of the 36 bytes before (IEEE 802.3: that of zlib, Ethernet, PNG)
======  ====  ==========  ==========================================================================================================

All little-endian. A receiver accepts a measurement or a command only where it has this length, these first three bytes, the CRC, the kind
it expects, its session, and a number that is newer than that of the last one it accepted (modulo 2^32, RFC 1982); and what it answers must
not be longer ago than ``most_age`` frames, nor be still to come. All others are counted by the rule that they break.

Hello, welcome and goodbye have the number 0 and answer nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import is_finite, kernel

LENGTH = 40
VERSION = 1
MEASUREMENT, COMMAND, HELLO, WELCOME, GOODBYE = range(1, 6)
WATCHDOG_TRIPPED, BUSY, OTHER_DT, GONE = 1, 2, 4, 8

# Entries of the counters.
REFUSALS = ("malformed", "version", "kind", "session", "duplicated", "reordered", "stale")
COUNTERS = ("accepted", *REFUSALS, "not_finite", "skipped", "not_sent")
# Skipped are frames that were never used: lost, or overtaken by a newer one before they were looked at.
(
    ACCEPTED,
    MALFORMED,
    WRONG_VERSION,
    WRONG_KIND,
    WRONG_SESSION,
    DUPLICATED,
    REORDERED,
    STALE,
    NOT_FINITE,
    SKIPPED,
    NOT_SENT,
) = range(11)

_MAGIC = int.from_bytes(b"QL", "little")
_ROUND = 1 << 32


def _crc_table() -> NDArray[np.uint32]:
    table = np.zeros(256, dtype=np.uint32)
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = value >> 1 ^ (0xEDB88320 if value & 1 else 0)
        table[byte] = value
    return table


_CRC = _crc_table()


class Buffer(NamedTuple):
    """Room for a frame, seen as bytes and as numbers; all share memory."""

    bytes: NDArray[np.uint8]
    """(48,): what is longer than a frame has to be seen to be."""
    shorts: NDArray[np.uint16]
    words: NDArray[np.uint32]
    longs: NDArray[np.int64]
    doubles: NDArray[np.float64]
    address: int
    """Of the first byte."""


def buffer() -> Buffer:
    """Return room for a frame and a little more."""
    raw = np.zeros(LENGTH // 8 + 1).view(np.uint8)
    return Buffer(
        raw, raw.view("<u2"), raw.view("<u4"), raw.view("<i8"), raw.view("<f8"), raw.ctypes.data
    )


class Endpoint(NamedTuple):
    """What one side knows of its traffic with the other."""

    expects: int
    """The kind it accepts: MEASUREMENT or COMMAND."""
    most_age: int
    """What answers a frame that was sent more than so many frames ago is stale."""
    numbers: NDArray[np.int64]
    """Session, number of the last frame sent, number of the last one accepted, what that answered, its state (5,)."""
    counters: NDArray[np.int64]
    """How many frames met which fate (11,), see ``COUNTERS``."""


SESSION, SENT, RECEIVED, ANSWERED, STATE = range(5)


def endpoint(expects: int, session: int, most_age: int) -> Endpoint:
    """Return a peer that has heard nothing yet."""
    numbers = np.zeros(5, dtype=np.int64)
    numbers[SESSION] = session
    return Endpoint(expects, most_age, numbers, np.zeros(len(COUNTERS), dtype=np.int64))


@kernel
def crc32(data: NDArray[np.uint8], size: int) -> int:
    """Return the CRC-32 of the first ``size`` bytes."""
    value = 0xFFFFFFFF
    for i in range(size):
        value = (value >> 8) ^ int(_CRC[(value ^ int(data[i])) & 0xFF])
    return value ^ 0xFFFFFFFF


@kernel
def write_frame(
    out: Buffer,
    kind: int,
    session: int,
    number: int,
    answers: int,
    time: int,
    value: float,
    state: int,
) -> None:
    """Write a frame."""
    out.shorts[0] = _MAGIC
    out.bytes[2] = VERSION
    out.bytes[3] = kind
    out.words[1] = session
    out.words[2] = number % _ROUND
    out.words[3] = answers % _ROUND
    out.longs[2] = time
    out.doubles[3] = value
    out.words[8] = state
    out.words[9] = crc32(out.bytes, LENGTH - 4)


@kernel
def is_well_formed(frame: Buffer, size: int, counters: NDArray[np.int64]) -> bool:
    """Tell whether the first ``size`` bytes are a whole frame of this version; count it where they are not."""
    if (
        size != LENGTH
        or frame.shorts[0] != _MAGIC
        or int(frame.words[9]) != crc32(frame.bytes, LENGTH - 4)
    ):
        counters[MALFORMED] += 1
        return False
    if frame.bytes[2] != VERSION:
        counters[WRONG_VERSION] += 1
        return False
    return True


@kernel
def write_next_frame(
    out: Buffer, own: Endpoint, kind: int, time: int, value: float, state: int
) -> None:
    """Write the next frame of a session."""
    own.numbers[SENT] += 1
    write_frame(
        out,
        kind,
        own.numbers[SESSION],
        own.numbers[SENT],
        own.numbers[RECEIVED],
        time,
        value,
        state,
    )


@kernel
def accept(frame: Buffer, size: int, own: Endpoint) -> bool:
    """Tell whether the first ``size`` bytes are the news that was expected; count them either way."""
    return is_well_formed(frame, size, own.counters) and accept_well_formed(frame, own)


@kernel
def accept_well_formed(frame: Buffer, own: Endpoint) -> bool:
    """Tell whether a well-formed frame is the news that was expected; count it either way.

    Accepted is also a frame whose value is no number: that it came is news. It is counted once more, as ``not_finite``.
    """
    counters, numbers = own.counters, own.numbers
    if frame.bytes[3] != own.expects:
        counters[WRONG_KIND] += 1
        return False
    if int(frame.words[1]) != numbers[SESSION]:
        counters[WRONG_SESSION] += 1
        return False
    ahead = _ahead(int(frame.words[2]), numbers[RECEIVED])
    if ahead <= 0:
        counters[DUPLICATED if ahead == 0 else REORDERED] += 1
        return False
    age = -_ahead(int(frame.words[3]), numbers[SENT])
    if age > own.most_age or age < 0:
        counters[STALE] += 1
        return False
    counters[SKIPPED] += ahead - 1
    numbers[RECEIVED] += ahead
    numbers[ANSWERED] = int(frame.words[3])
    numbers[STATE] = int(frame.words[8]) | (
        numbers[STATE] & GONE
    )  # a goodbye may be read before what was sent before it
    counters[ACCEPTED] += 1
    if not is_finite(frame.doubles[3]):
        counters[NOT_FINITE] += 1
    return True


@kernel
def start_session(own: Endpoint, session: int) -> None:
    """Begin anew: nothing sent, nothing heard; what was counted stays."""
    for i in range(own.numbers.size):
        own.numbers[i] = 0
    own.numbers[SESSION] = session


@kernel
def _ahead(number: int, of: int) -> int:
    """Return how far a number modulo 2^32 is ahead of one that counts on, −2^31 … 2^31 − 1."""
    return (number - of + _ROUND // 2) % _ROUND - _ROUND // 2


def counts_by_name(counters: Any) -> dict[str, int]:
    """Return counters by name."""
    return dict(zip(COUNTERS, map(int, counters), strict=True))
