"""What the loop asks of a device, be it metal, a twin in this process or one at the other end of a wire.

A device is an object with ``read() -> y``, ``write(u)`` and ``close()``: whoever writes those three has a device. One that can be used
without Python says so by a ``line``: a NamedTuple for whose type ``fetch`` and ``put`` are registered below, and which the loop then calls
from compiled code; ``read`` and ``write`` are the same two, called from Python. A device without a ``line`` gets a ``PythonLine``, and
the loop around it runs as Python.

Some devices have a clock of their own: they send a measurement at each of their ticks, whether one asks or not (``paced`` is True). For
those ``fetch`` waits for the next tick. Others answer whenever they are asked.
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
def fetch(line: Any, clock: Any, until: int) -> tuple[float, int]:
    """Return the newest measurement [y-unit] and how long it was waited for [ns].

    A measurement is returned once. Where there is none that is new, a paced line waits for one until the time ``until`` [ns] of ``clock``;
    NaN where none has come, or where the device sent one.
    """
    raise TypeError


@generic
def put(line: Any, u: float) -> int:
    """Apply ``u`` [u-unit]; return 0, 1 where the device can't be reached, or more where it has set u to zero for good."""
    raise TypeError


class PythonLine(NamedTuple):
    """A device of which only Python can make use."""

    device: Any
    errors: list[Exception]
    """What it raised last: at most one."""
    faults: NDArray[np.int64]
    """How often it raised something (1,)."""


def line_of(device: Any) -> Any:
    """Return the line of a device, or one through Python where it has none.

    Raises
    ------
    ValueError
        for something that is no device.
    """
    if isinstance(device, type) or not isinstance(device, Device):
        raise ValueError(
            f"device = {device!r}: must have read(), write(u) and close(), for example quell.realtime.TwinDevice(plant, dt)"
        )
    line = getattr(device, "line", None)
    return PythonLine(device, [], np.zeros(1, dtype=np.int64)) if line is None else line


@fetch.register(PythonLine)
def _fetch(line: PythonLine, clock: Any, until: int) -> tuple[float, int]:
    try:
        return float(line.device.read()), 0
    except Exception as error:  # whatever a driver raises, the loop has to go on to its safe action
        _note(line, error)
        return math.nan, 0


@put.register(PythonLine)
def _put(line: PythonLine, u: float) -> int:
    try:
        line.device.write(float(u))
    except Exception as error:
        _note(line, error)
        return 1
    return 0


def _note(line: PythonLine, error: Exception) -> None:
    line.faults[0] += 1
    line.errors[:] = [error]
