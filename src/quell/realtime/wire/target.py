"""A controller that runs on the device itself: references go there, its telemetry comes back.

The frames are those of any session. Commands are references; a measurement is followed by a frame
of the kind ``TELEMETRY`` for each channel of the same tick, with the number of the measurement, the
index of the channel as state flags, and its value.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
import time
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.realtime.wire import frames
from quell.realtime.wire.device import WireDevice
from quell.realtime.wire.handle import WireHandle, is_own
from quell.realtime.wire.transport import receive, wait_for_frame
from quell.records.trajectory import Trajectory
from quell.signals.base import Signal, as_signal
from quell.types import Channels, Matrix, Status

# The reference and the control signal: what every record of a run has besides y.
_NEEDED = ("r", "u")


class _Value(NamedTuple):
    """A number from the device."""

    tick: int
    column: int  # 0: y
    number: float
    acts: bool  # whether a reference has acted at this tick


def record_target(
    device: WireDevice,
    reference: Signal | float,
    channels: Channels,
    duration: float,
    *,
    timeout: float = 1.0,
) -> Trajectory:
    """Send a reference to a controller on the device, and record its telemetry.

    The record begins with the tick at which the first reference acts. Each measurement is answered
    with the reference of the next tick. If that comes late, the device goes on with the former one;
    the channel ``r`` has what it used.

    Parameters
    ----------
    device
        an open device whose program computes u itself, such as
        ``examples/target/serial_target.c`` at a ``SerialDevice``.
    reference
        r over the time since the begin of the record [y-unit].
    channels
        name and width of the channels that the program sends, in its order, with ``("r", 1)`` and
        ``("u", 1)``. The output y is the measurement.
    duration
        length of the record [s], a whole number of samples.
    timeout
        longest time without a frame from the device [s].

    Returns
    -------
    Trajectory
        with y and the channels; NaN where a frame was lost.

    Raises
    ------
    ValueError
        if ``duration`` or ``timeout`` is not positive, if r or u is missing among the channels, a
        name is used twice or the device sends more, or if the reference is not finite.
    ConnectionError
        if nothing comes for ``timeout``, or if the device has ended the session or no longer
        follows the references because they came too late.
    """
    _check_channels(channels)
    timeout = checks.positive("timeout", timeout, "s")
    checks.positive("duration", duration, "s")
    rows = checks.samples("duration", duration, device.dt) + 1
    r = np.asarray(as_signal(reference, "reference")(np.arange(rows + 1) * device.dt))
    if not np.all(np.isfinite(r)):
        raise ValueError("reference: must be finite over the whole duration")
    recorded = (("y", 1), *channels)
    log = np.full((rows, sum(width for _, width in recorded)), math.nan)
    first, newest = 0, 0  # ticks; 0: none yet
    while first == 0 or newest < first + rows:
        answered = newest
        for value in _received(device, timeout):
            if first == 0 and value.acts:
                first = value.tick
            if first and value.tick < first + rows:
                _store(log, value, value.tick - first)
            if value.column == 0:
                newest = value.tick
        if newest > answered:
            device.write(float(r[min(newest + 1 - first, rows) if first else 0]))
    return _trajectory(device, recorded, log)


def _check_channels(channels: Channels) -> None:
    names = [name for name, _ in channels]
    missing = [name for name in _NEEDED if (name, 1) not in channels]
    if missing or len({"y", *names}) <= len(names):
        raise ValueError(
            f"channels = {names!r}: must have r and u, of width 1, and other names, each once; "
            "y is always recorded"
        )


def _received(device: WireDevice, timeout: float) -> list[_Value]:
    """Return the numbers in the frames that have come; wait for the first."""
    handle, values, end = device.handle, list[_Value](), time.monotonic() + timeout
    while not values and (left := end - time.monotonic()) > 0.0:
        wait_for_frame(handle.transport, round(1e9 * left))
        while (size := receive(handle.transport, handle.inbox)) >= 0:
            values += _values(handle, size)
        _check_state(device)
    if not values:
        raise ConnectionError(f"{device.url}: nothing has come for {timeout:g} s")
    return values


def _check_state(device: WireDevice) -> None:
    state = device.handle.endpoint.numbers[frames.STATE]
    if state & frames.GONE:
        raise ConnectionError(f"{device.url}: the device has ended the session")
    if state & frames.WATCHDOG_TRIPPED:
        raise ConnectionError(
            f"{device.url}: no reference came in time, and the device no longer follows them; "
            "begin a new session"
        )


def _values(handle: WireHandle, size: int) -> list[_Value]:
    """Return the number in the frame received last, or nothing."""
    own, frame = handle.endpoint, handle.inbox
    if not frames.is_well_formed(frame, size, own.counters) or is_own(own, frame, frames.WELCOME):
        return []
    if is_own(own, frame, frames.GOODBYE):
        own.numbers[frames.STATE] |= frames.GONE
        return []
    if is_own(own, frame, frames.TELEMETRY):
        column = 1 + int(frame.words[8])
    elif frames.accept(frame, own):
        column = 0
    else:
        return []
    return [_Value(int(frame.words[2]), column, float(frame.doubles[3]), frame.words[3] > 0)]


def _store(log: Matrix, value: _Value, row: int) -> None:
    if value.column >= log.shape[1]:
        raise ValueError(
            f"channels: must be all that the program sends; {log.shape[1] - 1} numbers are named, "
            f"and it has sent one with the index {value.column - 1}"
        )
    if row >= 0:
        log[row, value.column] = value.number


def _trajectory(device: WireDevice, channels: Channels, log: Matrix) -> Trajectory:
    record = Trajectory(log, channels, device.dt, ended=(len(log) - 1) * device.dt)
    flags = record["status"] if "status" in record.names else np.zeros(0)
    known = flags[(flags >= 0.0) & (flags <= max(Status) * 2)].astype(np.int64)
    status = Status(functools.reduce(operator.or_, known.tolist(), 0))
    return dataclasses.replace(record, status=status, plant=device.url)
