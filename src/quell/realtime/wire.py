"""Devices at the other end of a wire: frames, sessions, reading and writing in ticks.

The frame that carries one number between a device and the loop: 40 bytes on every wire. Several
measurements, or several control signals, are numbers of one frame, 8 bytes longer for each further
one: state flags and CRC are behind the last number.

======  ====  =======  ==========================================================================
offset  size  type     content
======  ====  =======  ==========================================================================
0       2     bytes    ``QL``
2       1     uint8    version of the protocol: 1
3       1     uint8    kind: 1 measurement, 2 command, 3 hello, 4 welcome, 5 goodbye,
                       6 channel: another number of the device, or of a controller on it
4       4     uint32   session: drawn by the loop for each run, never 0
8       4     uint32   number of the frame: the sender's count of ticks or cycles from 1, mod 2^32
12      4     uint32   answers: number of the newest frame accepted from the other side; 0 if none
16      8     int64    time: the sender's monotonic clock [ns]
24      8     float64  value: y [y-unit], u [u-unit]; in hello and welcome the sample time [s]
32      4     uint32   state flags of the sender: 1 its watchdog has set u to zero (measurement);
                       2 another session is active, 4 the sample time differs, 16 the number of
                       signals differs (welcome); 8 the device has ended the session (goodbye);
                       index of the channel (telemetry). In a hello and a welcome for several
                       signals the second byte is the number of measurements, the third that of
                       control signals; zero for one of each
36      4     uint32   CRC-32 of the 36 bytes before it (IEEE 802.3, as in zlib, Ethernet and PNG)
======  ====  =======  ==========================================================================

All numbers are little-endian. Hello, welcome and goodbye have the number 0 and answer nothing. A
hello is as long as a measurement, the numbers behind the sample time are zero: so what answers it
is three times its bytes at most. Welcome, goodbye and channel have one number.

A receiver accepts a measurement or a command if its length, its first three bytes and its CRC are
right (there are as many numbers as the session has), its kind is the expected one, its session is
the receiver's, its number is newer than the last accepted one (modulo 2^32, RFC 1982), and the
frame it answers was sent at most ``most_age`` frames ago. Each rejected frame is counted under the
first rule that it breaks.

Functions that carry frames: each kind of wire implements them for its transport.

A transport is a NamedTuple; ``receive``, ``send`` and ``wait_for_frame`` are registered for its
type, and ``reply``, ``connect_to_sender`` and ``is_from_other_side`` if anyone can send to it. See
``realtime/transports.py`` for a complete example. None of these functions allocates memory, and
only ``wait_for_frame`` waits.

The loop's access to a device at the other end of a wire, the same for every transport.

The device has its own clock and sends a measurement at each tick. ``read_tick`` takes them in order
and waits for the next if there is none, ``read_measurement`` takes the newest. ``write_signals``
sends a command that names the measurement it answers; a measurement names the command that acts
from its tick on.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import generic, generic_with_default, is_finite, kernel
from quell.kernels.sized import Size
from quell.realtime import devices
from quell.realtime.devices import Tick, drop_signals, read_tick
from quell.realtime.system import SystemClock, external, now

# ---- The frame that carries one number between a device and the loop ----

LENGTH = 40
"""Bytes of a frame with one number; a further one has eight."""
MOST_SIGNALS = 16
"""Most measurements of a device, and most control signals."""
VERSION = 1
MEASUREMENT, COMMAND, HELLO, WELCOME, GOODBYE, TELEMETRY = range(1, 7)
WATCHDOG_TRIPPED, BUSY, OTHER_DT, GONE, OTHER_SIGNALS = 1, 2, 4, 8, 16

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
    """Memory for a frame as bytes and as numbers; all arrays share it, except ``length``."""

    bytes: NDArray[np.uint8]  # (40 + 8 signals,), longer than a frame: so long datagrams are seen
    shorts: NDArray[np.uint16]
    words: NDArray[np.uint32]
    longs: NDArray[np.int64]
    doubles: NDArray[np.float64]
    address: int  # address of the first byte
    length: NDArray[np.int64]  # bytes of the frame, once written or found well-formed (1,)


def buffer(signals: int = 1) -> Buffer:
    """Return an empty buffer for a frame of so many numbers."""
    raw = np.zeros(LENGTH // 8 + signals).view(np.uint8)
    shorts, words = raw.view("<u2"), raw.view("<u4")
    longs, doubles, length = raw.view("<i8"), raw.view("<f8"), np.full(1, LENGTH)
    return Buffer(raw, shorts, words, longs, doubles, raw.ctypes.data, length)


class Endpoint(NamedTuple):
    """The session as one side sees it; make it with ``endpoint``."""

    expects: int  # the kind it accepts: MEASUREMENT or COMMAND
    most_age: int  # a frame is stale if it answers one sent more than this number of frames ago
    numbers: NDArray[np.int64]
    """Session, number of the last frame sent, number of the last one accepted, the number that this
    one answered, and its state flags (5,)."""
    counters: NDArray[np.int64]  # number of frames for each name in ``COUNTERS`` (12,)
    signals: Size  # numbers of the frames that it accepts


SESSION, SENT, RECEIVED, ANSWERED, STATE = range(5)


def endpoint(expects: int, session: int, most_age: int, signals: int = 1) -> Endpoint:
    """Return an endpoint that has neither sent nor received a frame."""
    numbers = np.array([session, 0, 0, 0, 0], dtype=np.int64)
    return Endpoint(expects, most_age, numbers, np.zeros(len(COUNTERS), dtype=np.int64), signals)


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
    """Write a frame of one number to ``out``."""
    _begin_frame(out, kind, session, number, answers, time)
    out.doubles[3] = value
    _end_frame(out, 1, state)


@kernel
def _begin_frame(
    out: Buffer, kind: int, session: int, number: int, answers: int, time: int
) -> None:
    """Write what is before the numbers of a frame."""
    out.shorts[0] = _MAGIC
    out.bytes[2] = VERSION
    out.bytes[3] = kind
    out.words[1] = session
    out.words[2] = number % _MODULUS
    out.words[3] = answers % _MODULUS
    out.longs[2] = time


@kernel
def _end_frame(out: Buffer, signals: int, state: int) -> None:
    """Write what is behind the ``signals`` numbers of a frame."""
    size = LENGTH + 8 * (signals - 1)
    out.length[0] = size
    out.words[size // 4 - 2] = state
    out.words[size // 4 - 1] = crc32(out.bytes, size - 4)


@kernel
def write_next_numbers(
    out: Buffer, own: Endpoint, kind: int, time: int, values: NDArray[np.float64], state: int
) -> None:
    """Write the next frame of the session, with these numbers, to ``out``."""
    numbers = own.numbers
    numbers[SENT] += 1
    _begin_frame(out, kind, numbers[SESSION], numbers[SENT], numbers[RECEIVED], time)
    for i in range(values.size):
        out.doubles[3 + i] = values[i]
    _end_frame(out, values.size, state)


@kernel
def write_hello(out: Buffer, session: int, time: int, dt: float, outputs: int, inputs: int) -> None:
    """Write a hello for so many measurements and control signals to ``out``."""
    _begin_frame(out, HELLO, session, 0, 0, time)
    out.doubles[3] = dt
    for i in range(1, outputs):
        out.doubles[3 + i] = 0.0
    _end_frame(out, outputs, signals_word(outputs, inputs))


@kernel
def signals_word(outputs: int, inputs: int) -> int:
    """Return what the state of hello and welcome says of the signals; 0 for one of each."""
    return 0 if outputs == 1 and inputs == 1 else outputs << 8 | inputs << 16


@kernel
def is_well_formed(frame: Buffer, size: int, counters: NDArray[np.int64]) -> bool:
    """Return whether the first ``size`` bytes are a frame of this version; count them if not."""
    if (
        size < LENGTH
        or size % 8 != 0
        or size >= frame.bytes.size
        or frame.shorts[0] != _MAGIC
        or int(frame.words[size // 4 - 1]) != crc32(frame.bytes, size - 4)
    ):
        counters[MALFORMED] += 1
        return False
    if frame.bytes[2] != VERSION:
        counters[WRONG_VERSION] += 1
        return False
    frame.length[0] = size
    return True


@kernel
def ahead_of(number: int, of: int) -> int:
    """Return how far ``number`` (modulo 2^32) is ahead of the count ``of``: −2^31 … 2^31 − 1."""
    return (number - of + _MODULUS // 2) % _MODULUS - _MODULUS // 2


@kernel
def accept(frame: Buffer, own: Endpoint) -> bool:
    """Return whether a well-formed frame is a new one of the expected kind; count it in any case.

    A frame with a number that is not finite is accepted, because it shows that the other side is
    alive. It is also counted as ``not_finite``.
    """
    counters, numbers, size = own.counters, own.numbers, frame.length[0]
    if frame.bytes[3] != own.expects:
        counters[WRONG_KIND] += 1
        return False
    if size != LENGTH + 8 * (own.signals - 1):
        counters[MALFORMED] += 1
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
    numbers[STATE] = int(frame.words[size // 4 - 2]) | (numbers[STATE] & GONE)
    counters[ACCEPTED] += 1
    if not are_finite(frame, own.signals):
        counters[NOT_FINITE] += 1
    return True


@kernel
def are_finite(frame: Buffer, signals: int) -> bool:
    """Return whether all numbers of a frame are finite."""
    count = 0
    for i in range(signals):
        count += 1 if is_finite(frame.doubles[3 + i]) else 0
    return count == signals


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


# ---- Functions that carry frames ----

MOST_AT_ONCE = 1024
"""Packets read at once: a sender that floods the wire can't keep the other side from its cycle.
Chosen by hand; not tuned further."""


@generic
def receive(transport: Any, frame: Buffer) -> int:
    """Write the next packet to ``frame``; return its length in bytes, or -1 if none is waiting."""
    raise TypeError


@generic
def send(transport: Any, frame: Buffer) -> int:
    """Send a frame to the other side; return 0, or another number if it could not be sent."""
    raise TypeError


@generic
def wait_for_frame(transport: Any, nanoseconds: int) -> None:
    """Wait until a packet may have come, at most ``nanoseconds`` [ns]."""
    raise TypeError


@generic_with_default
def reply(transport: Any, frame: Buffer) -> int:
    """Send a frame to the sender of the packet received last; return the same as ``send``."""
    return send(transport, frame)


@generic_with_default
def connect_to_sender(transport: Any) -> None:
    """Make the sender of the packet received last the other side; nothing if there is only one."""


@generic_with_default
def is_from_other_side(transport: Any) -> bool:
    """Return whether the packet received last came from the other side; True if only it can send.

    The other side is the sender for which ``connect_to_sender`` was called last.
    """
    return True


# ---- Wait for a file descriptor, from compiled code and from Python ----

_SECOND = 1_000_000_000
# From poll.h: data can be read; error, hang-up or an invalid descriptor.
_POLLIN = 0x1
_GONE = 0x38
# Where the 16 bits of ``revents`` start in a pollfd that is read as one little-endian word.
_REVENTS = 48

_ppoll = external("ppoll", "int", "address", "long", "address", "address")


class Descriptor(NamedTuple):
    """A file descriptor to wait for; make it with ``descriptor``."""

    fd: int
    words: NDArray[np.int64]  # A pollfd, seconds and nanoseconds (3,)
    address: int  # address of ``words``


def descriptor(fd: int) -> Descriptor:
    """Return a ``Descriptor`` for the file descriptor ``fd``."""
    words = np.zeros(3, dtype=np.int64)
    words[:1].view(np.int32)[0] = fd
    words[:1].view(np.int16)[2] = _POLLIN
    return Descriptor(fd, words, words.ctypes.data)


@kernel
def wait_readable(descriptor: Descriptor, nanoseconds: int) -> None:
    """Wait until there is something to read, at most ``nanoseconds`` [ns]."""
    descriptor.words[1] = nanoseconds // _SECOND
    descriptor.words[2] = nanoseconds % _SECOND
    _ppoll(descriptor.address, 1, descriptor.address + 8, 0)


@kernel
def is_gone(descriptor: Descriptor) -> bool:
    """Return whether the last wait found that the descriptor can't be used any more."""
    return (descriptor.words[0] >> _REVENTS & _GONE) != 0


@kernel
def pause(descriptor: Descriptor, nanoseconds: int) -> None:
    """Sleep for less than a second [ns], whatever the descriptor does."""
    descriptor.words[1] = 0
    descriptor.words[2] = nanoseconds
    _ppoll(0, 0, descriptor.address + 8, 0)


# ---- The loop's access to a device at the other end of a wire, the same for every transport ----

COMMAND_NOT_SENT, TRIPPED, SESSION_GONE = 1, 2, 3
"""Faults that ``write_signals`` returns: the command could not be sent; the device's watchdog has
set u to zero until a new session; the device has ended the session."""


QUEUED = 64
"""Measurements that wait for the loop at most; more than 50 at once are stale anyway."""
SENT_KEPT = 128
"""Commands that are remembered: the device accepts none that is older than its watchdog."""
MOST_CHANNELS = 8
"""Channels of a device that are kept; those with a larger index are ignored."""
_FIRST, _WAITING, _LAST = range(3)


class TickQueue(NamedTuple):
    """Measurements that have come and were not used yet; make it with ``tick_queue``."""

    counts: NDArray[np.int64]
    """Index of the oldest, how many wait, number of the last one used (3,)."""
    numbers: NDArray[np.int64]  # (64,)
    y: NDArray[np.float64]  # [y-unit] (64, p)
    u: NDArray[np.float64]  # what acts since then [u-unit] (64, m)
    sent: NDArray[np.float64]  # the command of each number, modulo 128 (128, m)
    used_y: NDArray[np.float64]  # those of the measurement that was used last (p,)
    used_u: NDArray[np.float64]  # (m,)
    channels: NDArray[np.float64]  # with each measurement (64, 8)
    shown: NDArray[np.float64]  # with the measurement that was used last (8,)
    newest: NDArray[np.float64]  # those that came last (8,)
    came: NDArray[np.int64]  # number of the measurement with which they came (8,)


def tick_queue(outputs: int = 1, inputs: int = 1) -> TickQueue:
    """Return an empty queue."""
    return TickQueue(
        counts=np.zeros(3, dtype=np.int64),
        numbers=np.zeros(QUEUED, dtype=np.int64),
        y=np.zeros((QUEUED, outputs)),
        u=np.zeros((QUEUED, inputs)),
        sent=np.zeros((SENT_KEPT, inputs)),
        used_y=np.full(outputs, math.nan),
        used_u=np.full(inputs, math.nan),
        channels=np.full((QUEUED, MOST_CHANNELS), math.nan),
        shown=np.full(MOST_CHANNELS, math.nan),
        newest=np.full(MOST_CHANNELS, math.nan),
        came=np.zeros(MOST_CHANNELS, dtype=np.int64),
    )


class WireHandle(NamedTuple):
    """The loop's end of a wire."""

    transport: Any
    endpoint: Endpoint
    inbox: Buffer
    outbox: Buffer
    watch: SystemClock  # limits waiting: a wire takes real time even if the loop's clock is virtual
    dt: float  # sample time, in hellos [s]
    queue: TickQueue


@devices.read_measurement.register(WireHandle)
def _read_measurement(handle: WireHandle, clock: Any, until: int) -> tuple[float, int]:
    """Return the newest measurement; those before it are left out."""
    tick = read_tick(handle, clock, until)
    waited, skipped = tick.waited, 0
    while tick.left > 0:
        tick = read_tick(handle, clock, 0)
        skipped += 1
    handle.endpoint.counters[SKIPPED] += skipped
    return tick.y, waited


@read_tick.register(WireHandle)
def _read_tick(handle: WireHandle, clock: Any, until: int) -> Tick:
    begin = now(clock)
    waited = 0
    _fetch(handle)
    if handle.queue.counts[_WAITING] == 0:
        end = now(handle.watch) + until - begin
        left = until - begin
        while handle.queue.counts[_WAITING] == 0 and left > 0:
            wait_for_frame(handle.transport, left)
            _fetch(handle)
            left = end - now(handle.watch)
        waited = now(clock) - begin
    return _next(handle, waited)


@kernel
def _fetch(handle: WireHandle) -> None:
    """Put the measurements that have come into the queue."""
    own, frame, queue = handle.endpoint, handle.inbox, handle.queue
    accepted, received = 0, 0
    while received < MOST_AT_ONCE:
        size = receive(handle.transport, frame)
        if size < 0:
            break
        received += 1
        if not is_well_formed(frame, size, own.counters):
            continue
        if is_own(own, frame, GOODBYE):
            own.numbers[STATE] |= GONE
        elif is_own(own, frame, TELEMETRY):
            _take_channel(handle)
        elif not is_own(own, frame, WELCOME) and accept(frame, own):
            accepted += 1
            at = (queue.counts[_FIRST] + queue.counts[_WAITING]) % QUEUED
            for i in range(own.signals):
                value = frame.doubles[3 + i]
                queue.y[at, i] = value if is_finite(value) else math.nan
            _put_acting(handle, at)
            queue.numbers[at] = own.numbers[RECEIVED]
            for i in range(MOST_CHANNELS):
                is_fresh = own.numbers[RECEIVED] - queue.came[i] <= own.most_age
                queue.channels[at, i] = queue.newest[i] if is_fresh else math.nan
            if queue.counts[_WAITING] < QUEUED:
                queue.counts[_WAITING] += 1
            else:
                queue.counts[_FIRST] = (queue.counts[_FIRST] + 1) % QUEUED
                own.counters[SKIPPED] += 1
    if accepted > own.most_age and is_backlog(own, accepted):
        queue.counts[_WAITING] = 0


@kernel
def _take_channel(handle: WireHandle) -> None:
    """Keep the number of a channel, unless a newer one has come."""
    frame, queue = handle.inbox, handle.queue
    received, place = handle.endpoint.numbers[RECEIVED], int(frame.words[8])
    ahead = ahead_of(int(frame.words[2]), received)
    if place < MOST_CHANNELS and abs(ahead) <= handle.endpoint.most_age:
        number = received + ahead
        if number > queue.came[place]:
            value = frame.doubles[3]
            queue.came[place] = number
            queue.newest[place] = value if is_finite(value) else math.nan


@devices.read_channels.register(WireHandle)
def _read_channels(handle: WireHandle, values: NDArray[np.float64]) -> None:
    shown = handle.queue.shown
    for i in range(values.size):
        values[i] = shown[i] if i < shown.size else math.nan


@kernel
def _put_acting(handle: WireHandle, at: int) -> None:
    """Put the u that acts since the measurement accepted last; NaN if it is not known."""
    own, queue = handle.endpoint, handle.queue
    sent, answered = own.numbers[SENT], own.numbers[ANSWERED]
    idle = answered == 0 or own.numbers[STATE] != 0  # before the first command, or tripped
    age = ahead_of(sent, answered)
    for i in range(queue.used_u.size):
        value = queue.sent[(sent - age) % SENT_KEPT, i] if age < SENT_KEPT else math.nan
        queue.u[at, i] = 0.0 if idle else value


@kernel
def _next(handle: WireHandle, waited: int) -> Tick:
    """Take the oldest measurement from the queue."""
    counts = handle.queue.counts
    if counts[_WAITING] == 0:
        drop_signals(handle)
        return Tick(math.nan, 0, math.nan, 0, waited)
    at = counts[_FIRST]
    number = handle.queue.numbers[at]
    steps = number - counts[_LAST]
    counts[_LAST] = number
    counts[_FIRST] = (at + 1) % QUEUED
    counts[_WAITING] -= 1
    queue = handle.queue
    for i in range(MOST_CHANNELS):
        queue.shown[i] = queue.channels[at, i]
    y = queue.y[at, 0]
    for i in range(queue.used_y.size):
        queue.used_y[i] = queue.y[at, i]
        y = y if is_finite(queue.y[at, i]) else math.nan
    for i in range(queue.used_u.size):
        queue.used_u[i] = queue.u[at, i]
    return Tick(y, steps, queue.used_u[0], counts[_WAITING], waited)


@devices.read_signals.register(WireHandle)
def _read_signals(handle: WireHandle, y: NDArray[np.float64]) -> None:
    for i in range(y.size):
        y[i] = handle.queue.used_y[i]


@drop_signals.register(WireHandle)
def _drop_signals(handle: WireHandle) -> None:
    for i in range(handle.queue.used_y.size):
        handle.queue.used_y[i] = math.nan


@devices.read_acting.register(WireHandle)
def _read_acting(handle: WireHandle, u: NDArray[np.float64]) -> None:
    for i in range(u.size):
        u[i] = handle.queue.used_u[i]


@devices.ask.register(WireHandle)
def _ask(handle: WireHandle) -> None:
    """Repeat the hello of the session: a device is silent if it hears nothing."""
    own, time = handle.endpoint, now(handle.watch)
    outputs, inputs = handle.queue.used_y.size, handle.queue.used_u.size
    write_hello(handle.outbox, own.numbers[SESSION], time, handle.dt, outputs, inputs)
    send(handle.transport, handle.outbox)


@kernel
def is_own(own: Endpoint, frame: Buffer, kind: int) -> bool:
    """Return whether a frame of one number is of this kind and of the endpoint's session."""
    fits = frame.bytes[3] == kind and frame.length[0] == LENGTH
    return fits and int(frame.words[1]) == own.numbers[SESSION]


@devices.write_signals.register(WireHandle)
def _write_signals(handle: WireHandle, u: NDArray[np.float64]) -> int:
    own = handle.endpoint
    write_next_numbers(handle.outbox, own, COMMAND, now(handle.watch), u, 0)
    for i in range(u.size):
        handle.queue.sent[own.numbers[SENT] % SENT_KEPT, i] = u[i]
    failed = send(handle.transport, handle.outbox) != 0
    if failed:
        own.counters[NOT_SENT] += 1
    state = own.numbers[STATE]
    if state & GONE:
        return SESSION_GONE
    if state & WATCHDOG_TRIPPED:
        return TRIPPED
    return COMMAND_NOT_SENT if failed else 0
