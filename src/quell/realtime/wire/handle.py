"""The loop's access to a device at the other end of a wire, the same for every transport.

The device has its own clock and sends a measurement at each tick. ``read_measurement`` takes the
newest one and waits for the next if there is none; ``write_command`` sends a command that names the
measurement it answers.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from quell.kernels.dispatch import is_finite, kernel
from quell.realtime.devices.base import ask, read_measurement, write_command
from quell.realtime.system.clock import SystemClock, now
from quell.realtime.wire import frames
from quell.realtime.wire.frames import Buffer, Endpoint
from quell.realtime.wire.transport import MOST_AT_ONCE, receive, send, wait_for_frame

NOT_SENT, TRIPPED, GONE = 1, 2, 3
"""Faults that ``write_command`` returns: the command could not be sent; the device's watchdog has
set u to zero until a new session; the device has ended the session."""


class WireHandle(NamedTuple):
    """The loop's end of a wire."""

    transport: Any
    endpoint: Endpoint
    inbox: Buffer
    outbox: Buffer
    watch: SystemClock  # limits waiting: a wire takes real time even if the loop's clock is virtual
    dt: float  # sample time, in hellos [s]


@read_measurement.register(WireHandle)
def _read_measurement(handle: WireHandle, clock: Any, until: int) -> tuple[float, int]:
    begin = now(clock)
    y, found = _newest(handle)
    if found:
        return y, 0
    end = now(handle.watch) + until - begin
    left = until - begin
    while not found and left > 0:
        wait_for_frame(handle.transport, left)
        y, found = _newest(handle)
        left = end - now(handle.watch)
    return y, now(clock) - begin


@kernel
def _newest(handle: WireHandle) -> tuple[float, bool]:
    """Return the newest measurement that has come, NaN if it is not finite, and whether one has."""
    own, frame = handle.endpoint, handle.inbox
    y, accepted, received = math.nan, 0, 0
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
            y = frame.doubles[3]
            accepted += 1
    if frames.is_backlog(own, accepted):
        return math.nan, False
    return (y if is_finite(y) else math.nan), accepted > 0


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
    failed = send(handle.transport, handle.outbox) != 0
    if failed:
        own.counters[frames.NOT_SENT] += 1
    state = own.numbers[frames.STATE]
    if state & frames.GONE:
        return GONE
    if state & frames.WATCHDOG_TRIPPED:
        return TRIPPED
    return NOT_SENT if failed else 0
