"""What the loop asks of a device, be it metal, a twin in this process or one at the other end of a wire.

A device is an object with ``read() -> y``, ``write(u)`` and ``close()``: whoever writes those three has a device. One that can be used
without Python says so by a ``handle``: a NamedTuple for whose type ``read_measurement`` and ``write_command`` are registered below, and which the loop then calls
from compiled code; ``read`` and ``write`` are the same two, called from Python. A device without a ``handle`` gets a ``PythonHandle``, and
the loop around it runs as Python.

Some devices have a clock of their own: they send a measurement at each of their ticks, whether one asks or not (``paced`` is True). For
those ``read_measurement`` waits for the next tick. Others answer whenever they are asked.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import generic


@runtime_checkable
class Device(Protocol):
    """A plant that can be read and written, one sample at a time."""

    def read(self) -> float:
        """Return the newest measurement [y-unit], NaN where none has come in time."""

    def write(self, u: float) -> None:
        """Apply the control signal ``u`` [u-unit] until the next one."""

    def close(self) -> None:
        """Set u to zero, and give the device free; calling it twice does no harm."""


@generic
def read_measurement(handle: Any, clock: Any, until: int) -> tuple[float, int]:
    """Return the newest measurement [y-unit] and how long it was waited for [ns].

    A measurement is returned once. Where there is none that is new, a paced handle waits for one until the time ``until`` [ns] of ``clock``;
    NaN where none has come, or where the device sent one.
    """
    raise TypeError


@generic
def write_command(handle: Any, u: float) -> int:
    """Apply ``u`` [u-unit]; return 0, 1 where the device can't be reached, or more where it has set u to zero for good."""
    raise TypeError


class PythonHandle(NamedTuple):
    """A device of which only Python can make use."""

    device: Any
    errors: list[Exception]
    """What it raised last: at most one."""
    faults: NDArray[np.int64]
    """How often it raised something (1,)."""


def handle_of(device: Any) -> Any:
    """Return the handle of a device, or one through Python where it has none.

    Raises
    ------
    ValueError
        for something that is no device.
    """
    if isinstance(device, type) or not isinstance(device, Device):
        raise ValueError(
            f"device = {device!r}: must have read(), write(u) and close(), for example quell.realtime.TwinDevice(plant, dt)"
        )
    handle = getattr(device, "handle", None)
    return PythonHandle(device, [], np.zeros(1, dtype=np.int64)) if handle is None else handle


@read_measurement.register(PythonHandle)
def _read_measurement(handle: PythonHandle, clock: Any, until: int) -> tuple[float, int]:
    try:
        return float(handle.device.read()), 0
    except Exception as error:  # whatever a driver raises, the loop has to go on to its safe action
        _note(handle, error)
        return math.nan, 0


@write_command.register(PythonHandle)
def _write_command(handle: PythonHandle, u: float) -> int:
    try:
        handle.device.write(float(u))
    except Exception as error:
        _note(handle, error)
        return 1
    return 0


def _note(handle: PythonHandle, error: Exception) -> None:
    handle.faults[0] += 1
    handle.errors[:] = [error]
