"""The interface between the loop and a device: a plant in hardware, simulated, or behind a wire.

A device is an object with ``read() -> y``, ``write(u)`` and ``close()``. A device that can be used
from compiled code also has a ``handle``: a NamedTuple for whose type ``read_measurement`` and
``write_command`` are registered. Any other device gets a ``PythonHandle``; its loop runs as Python.

A device with its own clock sends a numbered measurement at each of its ticks; its attribute
``paced`` is True, and ``read_tick`` waits for the next one. Other devices answer at any time.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import generic, generic_with_default


@runtime_checkable
class Device(Protocol):
    """A plant that can be read and written, one sample at a time."""

    def read(self) -> float:
        """Return the newest measurement [y-unit], NaN if none has come in time."""

    def write(self, u: float) -> None:
        """Apply the control signal ``u`` [u-unit] until the next one."""

    def close(self) -> None:
        """Set u to zero and release the device; a second call does nothing."""


class Listener(Protocol):
    """The device's end of a wire, made from a URL by ``listen`` of the registry.

    Constructors raise a ``ValueError`` for a wrong URL, and if it is in use or can't be opened.
    """

    url: str
    transport: Any  # its type has the functions of ``quell.realtime.wire.transport``

    def close(self) -> None:
        """Release the wire."""


@generic
def read_measurement(handle: Any, clock: Any, until: int) -> tuple[float, int]:
    """Return the newest measurement [y-unit] and the time spent waiting for it [ns].

    Each measurement is returned once. If there is no new one, the handle of a paced device waits
    until the time ``until`` [ns] of ``clock``. NaN if none has come, or if the device has sent NaN.
    """
    raise TypeError


class Tick(NamedTuple):
    """A tick of a device with its own clock."""

    y: float  #: measurement [y-unit]; NaN if none came, or if the device has sent NaN
    steps: int  #: ticks since the last one that was returned; 0 if none came in time
    u: float  #: control signal from this tick on [u-unit]; NaN if it is not known
    left: int  #: number of newer ticks that have come already
    waited: int  #: time spent waiting [ns]


@generic
def read_tick(handle: Any, clock: Any, until: int) -> Tick:
    """Return the next tick of a paced device in order, however late it comes.

    If there is none, wait for it until the time ``until`` [ns] of ``clock``.
    """
    raise TypeError


@generic
def write_command(handle: Any, u: float) -> int:
    """Apply ``u`` [u-unit]; return 0, 1 if it can't be sent, more if the device keeps u at zero."""
    raise TypeError


@generic_with_default
def ask(handle: Any) -> None:
    """Ask a paced device, which sends only as long as it hears from the loop, for measurements."""


class PythonHandle(NamedTuple):
    """A device that only Python can use."""

    device: Device
    errors: list[Exception]  #: the exception that it raised last, if any
    faults: NDArray[np.int64]  #: number of exceptions that it raised (1,)


def handle_of(device: Device) -> Any:
    """Return the handle of a device, a ``PythonHandle`` if it has none."""
    if isinstance(device, type) or not isinstance(device, Device):
        raise ValueError(
            f"device = {device!r}: must have read(), write(u) and close(), "
            "for example quell.realtime.TwinDevice(plant, dt)"
        )
    handle = getattr(device, "handle", None)
    return PythonHandle(device, [], np.zeros(1, dtype=np.int64)) if handle is None else handle


@read_measurement.register(PythonHandle)
def _read_measurement(handle: PythonHandle, clock: Any, until: int) -> tuple[float, int]:
    try:
        return float(handle.device.read()), 0
    except Exception as error:  # whatever a driver raises, the loop must go on to its safe action
        _count_error(handle, error)
        return math.nan, 0


@write_command.register(PythonHandle)
def _write_command(handle: PythonHandle, u: float) -> int:
    try:
        handle.device.write(float(u))
    except Exception as error:
        _count_error(handle, error)
        return 1
    return 0


def _count_error(handle: PythonHandle, error: Exception) -> None:
    handle.faults[0] += 1
    handle.errors[:] = [error]
