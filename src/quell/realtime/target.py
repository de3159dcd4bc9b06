"""A controller that runs on the device itself: references go there, its telemetry comes back.

The frames are those of any session. Commands are references; a measurement is followed by a frame
of the kind ``TELEMETRY`` for each channel of the same tick, with the number of the measurement, the
index of the channel as state flags, and its value.
"""

from __future__ import annotations

import dataclasses
import math
import time

import numpy as np

from quell import checks
from quell.kernels.dispatch import compiled, specialised
from quell.realtime import wire
from quell.realtime.wire import WireHandle, is_own, receive, wait_for_frame
from quell.realtime.wire_device import WireDevice
from quell.records.record import flags_of
from quell.records.trajectory import Trajectory
from quell.signals.shapes import Signal, as_signal
from quell.types import Channels, Matrix, Status

# The reference and the control signal: what every record of a run has besides y.
_NEEDED = ("r", "u")


# Numbers that are taken from the line at once: those of about a hundred ticks, so that references
# are sent even if frames come without a pause. Chosen by hand.
_AT_ONCE = 1000
# Columns of these numbers: tick, channel (-1: y), value, and whether a reference acts at this tick.
_TICK, _CHANNEL, _NUMBER, _ACTS = range(4)


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
        answered, values = newest, _received(device, timeout)
        acting = values[values[:, _ACTS] > 0.0, _TICK]
        if first == 0 and acting.size:
            first = int(acting[0])
        if first:
            _store(log, values, first)
        newest = int(np.max(values[values[:, _CHANNEL] < 0.0, _TICK], initial=newest))
        if newest > answered:
            device.write(float(r[min(newest + 1 - first, rows) if first else 0]))
    record = Trajectory(log, recorded, device.dt, ended=(len(log) - 1) * device.dt)
    flags = record["status"] if "status" in record.names else np.zeros(0)
    status = Status(int(np.bitwise_or.reduce(flags_of(flags))))
    return dataclasses.replace(record, status=status, plant=device.url)


def _check_channels(channels: Channels) -> None:
    names = [name for name, _ in channels]
    missing = [name for name in _NEEDED if (name, 1) not in channels]
    if missing or len({"y", *names}) <= len(names):
        raise ValueError(
            f"channels = {names!r}: must have r and u, of width 1, and other names, each once; "
            "y is always recorded"
        )


def _received(device: WireDevice, timeout: float) -> Matrix:
    """Return the numbers in the frames that have come, see ``_TICK``; wait for the first."""
    handle, values = device.handle, np.zeros((_AT_ONCE, 4))
    take = specialised(_take, handle, values)  # may compile it, which must not count as waiting
    count, end = 0, time.monotonic() + timeout
    while count == 0 and (left := end - time.monotonic()) > 0.0:
        wait_for_frame(handle.transport, round(1e9 * left))
        count = take(handle, values)
        _check_state(device)
    if count == 0:
        raise ConnectionError(f"{device.url}: nothing has come for {timeout:g} s")
    return values[:count]


@compiled
def _take(handle: WireHandle, values: Matrix) -> int:
    """Write the numbers in the frames that have come to ``values``; return how many."""
    own, frame, count = handle.endpoint, handle.inbox, 0
    while count < values.shape[0]:
        size = receive(handle.transport, frame)
        if size < 0:
            break
        if not wire.is_well_formed(frame, size, own.counters):
            continue
        if is_own(own, frame, wire.GOODBYE):
            own.numbers[wire.STATE] |= wire.GONE
            continue
        if is_own(own, frame, wire.TELEMETRY):
            channel = int(frame.words[8])
        elif not is_own(own, frame, wire.WELCOME) and wire.accept(frame, own):
            channel = -1
        else:
            continue
        values[count, _TICK] = frame.words[2]
        values[count, _CHANNEL] = channel
        values[count, _NUMBER] = frame.doubles[3]
        values[count, _ACTS] = 1.0 if frame.words[3] > 0 else 0.0
        count += 1
    return count


def _check_state(device: WireDevice) -> None:
    state = device.handle.endpoint.numbers[wire.STATE]
    if state & wire.GONE:
        raise ConnectionError(f"{device.url}: the device has ended the session")
    if state & wire.WATCHDOG_TRIPPED:
        raise ConnectionError(
            f"{device.url}: no reference came in time, and the device no longer follows them; "
            "begin a new session"
        )


def _store(log: Matrix, values: Matrix, first: int) -> None:
    """Write numbers into the log, whose first row is the tick ``first``."""
    row, column = (values[:, (_TICK, _CHANNEL)] - (first, -1)).astype(np.int64).T
    if np.max(column) >= log.shape[1]:
        raise ValueError(
            f"channels: must be all that the program sends; {log.shape[1] - 1} numbers are named, "
            f"and it has sent one with the index {np.max(column) - 1}"
        )
    within = (row >= 0) & (row < log.shape[0])
    log[row[within], column[within]] = values[within, _NUMBER]
