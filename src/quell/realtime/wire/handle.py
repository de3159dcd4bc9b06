"""The loop's access to a device at the other end of a wire, the same for every transport.

The device has its own clock and sends a measurement at each tick. ``read_tick`` takes them in order
and waits for the next if there is none, ``read_measurement`` takes the newest. ``write_command``
sends a command that names the measurement it answers; a measurement names the command that acts
from its tick on.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import is_finite, kernel
from quell.realtime.devices.base import Tick, ask, read_measurement, read_tick, write_command
from quell.realtime.system.clock import SystemClock, now
from quell.realtime.wire import frames
from quell.realtime.wire.frames import Buffer, Endpoint
from quell.realtime.wire.transport import MOST_AT_ONCE, receive, send, wait_for_frame

NOT_SENT, TRIPPED, GONE = 1, 2, 3
"""Faults that ``write_command`` returns: the command could not be sent; the device's watchdog has
set u to zero until a new session; the device has ended the session."""


QUEUED = 64
"""Measurements that wait for the loop at most; more than 50 at once are stale anyway."""
SENT_KEPT = 128
"""Commands that are remembered: the device accepts none that is older than its watchdog."""
_FIRST, _WAITING, _LAST = range(3)


class TickQueue(NamedTuple):
    """Measurements that have come and were not used yet; make it with ``tick_queue``."""

    counts: NDArray[np.int64]
    """Index of the oldest, how many wait, number of the last one used (3,)."""
    numbers: NDArray[np.int64]  # (64,)
    y: NDArray[np.float64]  # [y-unit] (64,)
    u: NDArray[np.float64]  # what acts since then [u-unit] (64,)
    sent: NDArray[np.float64]  # the command of each number, modulo 128 (128,)


def tick_queue() -> TickQueue:
    """Return an empty queue."""
    numbers, y, u = np.zeros(QUEUED, dtype=np.int64), np.zeros(QUEUED), np.zeros(QUEUED)
    return TickQueue(np.zeros(3, dtype=np.int64), numbers, y, u, np.zeros(SENT_KEPT))


class WireHandle(NamedTuple):
    """The loop's end of a wire."""

    transport: Any
    endpoint: Endpoint
    inbox: Buffer
    outbox: Buffer
    watch: SystemClock  # limits waiting: a wire takes real time even if the loop's clock is virtual
    dt: float  # sample time, in hellos [s]
    queue: TickQueue


@read_measurement.register(WireHandle)
def _read_measurement(handle: WireHandle, clock: Any, until: int) -> tuple[float, int]:
    """Return the newest measurement; those before it are left out."""
    tick = read_tick(handle, clock, until)
    waited, skipped = tick.waited, 0
    while tick.left > 0:
        tick = read_tick(handle, clock, 0)
        skipped += 1
    handle.endpoint.counters[frames.SKIPPED] += skipped
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
        if not frames.is_well_formed(frame, size, own.counters):
            continue
        if is_own(own, frame, frames.GOODBYE):
            own.numbers[frames.STATE] |= frames.GONE
        elif not is_own(own, frame, frames.WELCOME) and frames.accept(frame, own):
            accepted += 1
            at = (queue.counts[_FIRST] + queue.counts[_WAITING]) % QUEUED
            queue.y[at] = frame.doubles[3] if is_finite(frame.doubles[3]) else math.nan
            queue.u[at] = _acting(handle)
            queue.numbers[at] = own.numbers[frames.RECEIVED]
            if queue.counts[_WAITING] < QUEUED:
                queue.counts[_WAITING] += 1
            else:
                queue.counts[_FIRST] = (queue.counts[_FIRST] + 1) % QUEUED
                own.counters[frames.SKIPPED] += 1
    if accepted > own.most_age and frames.is_backlog(own, accepted):
        queue.counts[_WAITING] = 0


@kernel
def _acting(handle: WireHandle) -> float:
    """Return the u that acts since the measurement accepted last, NaN if it is not known."""
    own = handle.endpoint
    sent, answered = own.numbers[frames.SENT], own.numbers[frames.ANSWERED]
    if answered == 0 or own.numbers[frames.STATE] != 0:  # before the first command, or tripped
        return 0.0
    age = frames.ahead_of(sent, answered)
    return handle.queue.sent[(sent - age) % SENT_KEPT] if age < SENT_KEPT else math.nan


@kernel
def _next(handle: WireHandle, waited: int) -> Tick:
    """Take the oldest measurement from the queue."""
    counts = handle.queue.counts
    if counts[_WAITING] == 0:
        return Tick(math.nan, 0, math.nan, 0, waited)
    at = counts[_FIRST]
    number = handle.queue.numbers[at]
    steps = number - counts[_LAST]
    counts[_LAST] = number
    counts[_FIRST] = (at + 1) % QUEUED
    counts[_WAITING] -= 1
    return Tick(handle.queue.y[at], steps, handle.queue.u[at], counts[_WAITING], waited)


@ask.register(WireHandle)
def _ask(handle: WireHandle) -> None:
    """Repeat the hello of the session: a device is silent if it hears nothing."""
    own, time = handle.endpoint, now(handle.watch)
    session = own.numbers[frames.SESSION]
    frames.write_frame(handle.outbox, frames.HELLO, session, 0, 0, time, handle.dt, 0)
    send(handle.transport, handle.outbox)


@kernel
def is_own(own: Endpoint, frame: Buffer, kind: int) -> bool:
    """Return whether a frame is of this kind and of the endpoint's session."""
    return frame.bytes[3] == kind and int(frame.words[1]) == own.numbers[frames.SESSION]


@write_command.register(WireHandle)
def _write_command(handle: WireHandle, u: float) -> int:
    own = handle.endpoint
    frames.write_next_frame(handle.outbox, own, frames.COMMAND, now(handle.watch), u, 0)
    handle.queue.sent[own.numbers[frames.SENT] % SENT_KEPT] = u
    failed = send(handle.transport, handle.outbox) != 0
    if failed:
        own.counters[frames.NOT_SENT] += 1
    state = own.numbers[frames.STATE]
    if state & frames.GONE:
        return GONE
    if state & frames.WATCHDOG_TRIPPED:
        return TRIPPED
    return NOT_SENT if failed else 0
