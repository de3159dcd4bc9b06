"""The frame that carries one number between a device and the loop: 40 bytes on every wire.

======  ====  =======  ==========================================================================
offset  size  type     content
======  ====  =======  ==========================================================================
0       2     bytes    ``QL``
2       1     uint8    version of the protocol: 1
3       1     uint8    kind: 1 measurement, 2 command, 3 hello, 4 welcome, 5 goodbye,
                       6 telemetry of a controller on the device (``target``)
4       4     uint32   session: drawn by the loop for each run, never 0
8       4     uint32   number of the frame: the sender's count of ticks or cycles from 1, mod 2^32
12      4     uint32   answers: number of the newest frame accepted from the other side; 0 if none
16      8     int64    time: the sender's monotonic clock [ns]
24      8     float64  value: y [y-unit], u [u-unit]; in hello and welcome the sample time [s]
32      4     uint32   state flags of the sender: 1 its watchdog has set u to zero (measurement);
                       2 another session is active, 4 the sample time differs (welcome); 8 the
                       device has ended the session (goodbye); index of the channel (telemetry)
36      4     uint32   CRC-32 of the 36 bytes before it (IEEE 802.3, as in zlib, Ethernet and PNG)
======  ====  =======  ==========================================================================

All numbers are little-endian. Hello, welcome and goodbye have the number 0 and answer nothing.

A receiver accepts a measurement or a command if its length, its first three bytes and its CRC are
right, its kind is the expected one, its session is the receiver's, its number is newer than the
last accepted one (modulo 2^32, RFC 1982), and the frame it answers was sent at most ``most_age``
frames ago. Each rejected frame is counted under the first rule that it breaks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import is_finite, kernel

LENGTH = 40
VERSION = 1
MEASUREMENT, COMMAND, HELLO, WELCOME, GOODBYE, TELEMETRY = range(1, 7)
WATCHDOG_TRIPPED, BUSY, OTHER_DT, GONE = 1, 2, 4, 8

REFUSALS = (
    *("malformed", "version", "kind", "session", "duplicated", "reordered", "stale"),
    "address",
)
COUNTERS = ("accepted", *REFUSALS, "not_finite", "skipped", "not_sent")
"""Names of the counters. ``skipped`` frames were lost, or replaced by a newer one before use;
those under ``address`` came from somebody who has not opened the session."""
ACCEPTED, MALFORMED, WRONG_VERSION, WRONG_KIND, WRONG_SESSION = range(5)
DUPLICATED, REORDERED, STALE, ADDRESS, NOT_FINITE, SKIPPED, NOT_SENT = range(5, 12)

_MAGIC = int.from_bytes(b"QL", "little")
# Frame numbers are 32 bits wide.
_MODULUS = 1 << 32


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
    """Memory for a frame as bytes and as numbers; all arrays share it."""

    bytes: NDArray[np.uint8]  # (48,): longer than a frame, to notice a datagram that is too long
    shorts: NDArray[np.uint16]
    words: NDArray[np.uint32]
    longs: NDArray[np.int64]
    doubles: NDArray[np.float64]
    address: int  # address of the first byte


def buffer() -> Buffer:
    """Return an empty buffer for a frame."""
    raw = np.zeros(LENGTH // 8 + 1).view(np.uint8)
    shorts, words = raw.view("<u2"), raw.view("<u4")
    return Buffer(raw, shorts, words, raw.view("<i8"), raw.view("<f8"), raw.ctypes.data)


class Endpoint(NamedTuple):
    """The session as one side sees it; make it with ``endpoint``."""

    expects: int  # the kind it accepts: MEASUREMENT or COMMAND
    most_age: int  # a frame is stale if it answers one sent more than this number of frames ago
    numbers: NDArray[np.int64]
    """Session, number of the last frame sent, number of the last one accepted, the number that this
    one answered, and its state flags (5,)."""
    counters: NDArray[np.int64]  # number of frames for each name in ``COUNTERS`` (12,)


SESSION, SENT, RECEIVED, ANSWERED, STATE = range(5)


def endpoint(expects: int, session: int, most_age: int) -> Endpoint:
    """Return an endpoint that has neither sent nor received a frame."""
    numbers = np.array([session, 0, 0, 0, 0], dtype=np.int64)
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
    """Write a frame to ``out``."""
    out.shorts[0] = _MAGIC
    out.bytes[2] = VERSION
    out.bytes[3] = kind
    out.words[1] = session
    out.words[2] = number % _MODULUS
    out.words[3] = answers % _MODULUS
    out.longs[2] = time
    out.doubles[3] = value
    out.words[8] = state
    out.words[9] = crc32(out.bytes, LENGTH - 4)


@kernel
def write_next_frame(
    out: Buffer, own: Endpoint, kind: int, time: int, value: float, state: int
) -> None:
    """Write the next frame of the session to ``out``."""
    numbers = own.numbers
    numbers[SENT] += 1
    write_frame(out, kind, numbers[SESSION], numbers[SENT], numbers[RECEIVED], time, value, state)


@kernel
def is_well_formed(frame: Buffer, size: int, counters: NDArray[np.int64]) -> bool:
    """Return whether the first ``size`` bytes are a frame of this version; count them if not."""
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
def ahead_of(number: int, of: int) -> int:
    """Return how far ``number`` (modulo 2^32) is ahead of the count ``of``: −2^31 … 2^31 − 1."""
    return (number - of + _MODULUS // 2) % _MODULUS - _MODULUS // 2


@kernel
def accept(frame: Buffer, own: Endpoint) -> bool:
    """Return whether a well-formed frame is a new one of the expected kind; count it in any case.

    A frame whose value is not finite is accepted, because it shows that the other side is alive. It
    is also counted as ``not_finite``.
    """
    counters, numbers = own.counters, own.numbers
    if frame.bytes[3] != own.expects:
        counters[WRONG_KIND] += 1
        return False
    if int(frame.words[1]) != numbers[SESSION]:
        counters[WRONG_SESSION] += 1
        return False
    ahead = ahead_of(int(frame.words[2]), numbers[RECEIVED])
    if ahead <= 0:
        counters[DUPLICATED if ahead == 0 else REORDERED] += 1
        return False
    age = -ahead_of(int(frame.words[3]), numbers[SENT])
    if age > own.most_age or age < 0:
        counters[STALE] += 1
        return False
    counters[SKIPPED] += ahead - 1
    numbers[RECEIVED] += ahead
    numbers[ANSWERED] = int(frame.words[3])
    # GONE stays set: frames that were sent before a goodbye may be read after it.
    numbers[STATE] = int(frame.words[8]) | (numbers[STATE] & GONE)
    counters[ACCEPTED] += 1
    if not is_finite(frame.doubles[3]):
        counters[NOT_FINITE] += 1
    return True


@kernel
def is_backlog(own: Endpoint, accepted: int) -> bool:
    """Count all but the newest of the frames accepted at once as skipped; return whether too many.

    More than ``most_age`` frames at once may come from a queue that was full. Then even the newest
    of them may be old; it is counted as stale.
    """
    if accepted > 1:
        own.counters[SKIPPED] += accepted - 1
    if accepted <= own.most_age:
        return False
    own.counters[STALE] += 1
    return True


@kernel
def start_session(own: Endpoint, session: int) -> None:
    """Reset all numbers for a new session; the counters continue."""
    for i in range(own.numbers.size):
        own.numbers[i] = 0
    own.numbers[SESSION] = session


def counts_by_name(counters: NDArray[np.int64]) -> dict[str, int]:
    """Return the counters by their names."""
    return dict(zip(COUNTERS, map(int, counters), strict=True))
