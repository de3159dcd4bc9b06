"""A compensator between a host and a drive that both stay as they are.

To the host the proxy is the drive: it listens as a rig does (``realtime/rig.py``), sends
measurements, takes commands, and has the rig's watchdog. To the drive it is the loop. In each tick

1. the newest command of the host is u_0 (zero if its watchdog has tripped);
2. the newest measurement of the drive goes to the compensator and to the host, and so do the
   drive's channels (``realtime/channels.py``);
3. the compensator's u goes to the drive.

So the drive has one more sample of delay than without the proxy, where host and proxy have clocks
of their own: a command waits for the proxy's tick, a measurement for the host's.

Drives of several axes have ``Axes`` of compensators: the host's command is u_0 of all actuators. A
measurement that is missing is so for its own axis.

Where clocks differ, a tick may find no new measurement. One is replaced by the last one for the
host; from the second in a row on the host gets NaN, which is no measurement, and no channels. So it
does what it does without the proxy. The compensator gets NaN in each case.

A drive is lost if it has set u to zero or ended its session, takes no command for more than
``Safety.hold`` samples, or gives no measurement for a second, at least fifty samples. Then the rig
ends the host's session and ``Rig.run``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.axes import Axes
from quell.controllers.base import check_controller, control, limits_of
from quell.controllers.compensated import takes_control
from quell.controllers.compensator import Compensator
from quell.controllers.several import control_all
from quell.kernels.dispatch import is_finite, kernel
from quell.plants.base import advance, measure
from quell.plants.multivariable import measure_all
from quell.realtime.channels import (
    ChannelInputs,
    await_channels,
    channel_inputs,
    checked_channels,
    pass_channels,
    read_inputs,
)
from quell.realtime.devices import (
    Device,
    PythonHandle,
    check_counts,
    counts_of,
    handle_of,
    read_measurement,
    read_signals,
    write_command,
    write_signals,
)
from quell.realtime.rig import is_lost, measure_channels
from quell.realtime.safety import default_hold
from quell.realtime.system import now, system_clock
from quell.realtime.wire import COMMAND_NOT_SENT, SESSION_GONE, TRIPPED
from quell.types import Vector

# Measurements in a row that are replaced by the last one for the host: two clocks that differ leave
# one out now and then, but not two.
_REPLACED = 1
# Time without any measurement after which the drive is lost [s], and least samples: by then a host
# with the default ``Safety`` has ramped u to zero. Chosen by hand.
_LOST_AFTER, _LOST_SAMPLES = 1.0, 50
# Entries of ``Drive.counts``: ticks without a measurement, commands that could not be sent, those
# in a row, why the drive is lost; and the reason that ``write_command`` does not know.
_MISSING, _UNSENT, _UNSENT_IN_ROW, _FAULT = range(4)
_SILENT = 4
_REASONS = {
    COMMAND_NOT_SENT: "commands could not be sent any more",
    TRIPPED: "its watchdog has set u to zero, because no command came in time",
    SESSION_GONE: "it has ended the session",
}


class Drive(NamedTuple):
    """The measurements and faults of a drive."""

    last: Vector  # last good measurements; NaN before the first (n,)
    silent: NDArray[np.int64]  # samples in a row without one (n,)
    counts: NDArray[np.int64]
    most: int  # samples without a measurement after which the drive is lost


class ProxyDesign(NamedTuple):
    """A drive and the compensator in front of it."""

    handle: Any  # of the device
    clock: Any
    design: Any  # parameters of the compensator
    state: Any
    inputs: ChannelInputs
    hold: int  # samples for which a missing ``held`` keeps its state, and commands may stay unsent
    drive: Drive


class AxesProxyDesign(NamedTuple):
    """Drives of several axes and the compensators in front of them."""

    one: ProxyDesign  # what one drive has as well
    y: Vector  # measurements, NaN where they are missing (n,)
    u: Vector  # what acts (m,)


@kernel
def _take(proxy: ProxyDesign, i: int, y: float) -> float:
    """Take the newest measurement of an axis, NaN if it is missing; return that for the host."""
    drive = proxy.drive
    if is_finite(y):
        drive.last[i] = y
        drive.silent[i] = 0
    else:
        drive.silent[i] += 1
        if drive.silent[i] > drive.most and drive.counts[_FAULT] == 0:
            drive.counts[_FAULT] = _SILENT
    return drive.last[i] if drive.silent[i] <= _REPLACED else np.nan


@kernel
def _taken(proxy: ProxyDesign, i: int) -> float:
    """Return the newest measurement of an axis; NaN if it is missing."""
    return proxy.drive.last[i] if proxy.drive.silent[i] == 0 else np.nan


@kernel
def _take_channels(proxy: ProxyDesign) -> None:
    """Read the channels after the measurements: none of a silent drive. Count what is missing."""
    silent = proxy.drive.silent
    least = most = silent[0]
    for i in range(silent.size):
        least, most = min(least, silent[i]), max(most, silent[i])
    proxy.drive.counts[_MISSING] += 1 if most > 0 else 0
    read_inputs(proxy.inputs, proxy.handle)
    if least > _REPLACED:
        for i in range(proxy.inputs.values.size):
            proxy.inputs.values[i] = np.nan


@kernel
def _count_fault(proxy: ProxyDesign, fault: int) -> None:
    """Count what writing a command has returned."""
    counts = proxy.drive.counts
    if fault == 0:
        counts[_UNSENT_IN_ROW] = 0
        return
    counts[_UNSENT] += 1
    counts[_UNSENT_IN_ROW] += 1
    if counts[_FAULT] == 0 and (fault > COMMAND_NOT_SENT or counts[_UNSENT_IN_ROW] > proxy.hold):
        counts[_FAULT] = fault


@measure.register(ProxyDesign)
def _measure(proxy: ProxyDesign, x: Vector) -> float:
    y, _ = read_measurement(proxy.handle, proxy.clock, now(proxy.clock))
    shown = _take(proxy, 0, y)
    _take_channels(proxy)
    return shown


@measure_all.register(AxesProxyDesign)
def _measure_all(proxy: AxesProxyDesign, x: Vector, y: Vector) -> None:
    one = proxy.one
    read_measurement(one.handle, one.clock, now(one.clock))
    read_signals(one.handle, proxy.y)
    for i in range(y.size):
        y[i] = _take(one, i, proxy.y[i])
    _take_channels(one)


@is_lost.register(ProxyDesign)
def _is_lost(proxy: ProxyDesign) -> bool:
    return proxy.drive.counts[_FAULT] != 0


@is_lost.register(AxesProxyDesign)
def _are_lost(proxy: AxesProxyDesign) -> bool:
    return proxy.one.drive.counts[_FAULT] != 0


@measure_channels.register(ProxyDesign)
def _measure_channels(proxy: ProxyDesign, x: Vector, values: Vector) -> None:
    for i in range(values.size):
        values[i] = proxy.inputs.values[i]


@measure_channels.register(AxesProxyDesign)
def _measure_channels_of_axes(proxy: AxesProxyDesign, x: Vector, values: Vector) -> None:
    measure_channels(proxy.one, x, values)


@advance.register(ProxyDesign)
def _advance(proxy: ProxyDesign, x: Vector, scratch: Vector, t: float, u: float, w: Vector) -> None:
    pass_channels(proxy.inputs, proxy.design, proxy.state, proxy.hold)
    acting = control(proxy.design, proxy.state, u, _taken(proxy, 0))
    _count_fault(proxy, write_command(proxy.handle, acting))


@advance.register(AxesProxyDesign)
def _advance_all(
    proxy: AxesProxyDesign, x: Vector, scratch: Vector, t: float, u: Vector, w: Vector
) -> None:
    one = proxy.one
    for i in range(proxy.y.size):
        proxy.y[i] = _taken(one, i)
    pass_channels(one.inputs, one.design, one.state, one.hold)
    control_all(one.design, one.state, u, proxy.y, proxy.u)
    _count_fault(one, write_signals(one.handle, proxy.u))


class CompensatedDrive:
    """A drive behind a compensator, as a plant for ``quell.realtime.Rig``.

    Parameters
    ----------
    device
        the drive, from ``open_device(url, dt)``, of several axes with their ``signals``; it is
        closed by ``close``.
    compensator
        a ``Compensator`` with limits of u, in double or single precision, or ``Axes`` of
        compensators without drives of their own; it is not changed.
    channels
        names of the numbers that the drive gives beside y, as for ``run_rig``; the host gets them,
        too.

    Raises
    ------
    ValueError
        for another controller, limits of u that are not finite, a device of another dt, with other
        numbers of signals or in Python only, a schedule without its signals.
    ConnectionError
        if a channel that the compensator uses does not come.

    Examples
    --------
    >>> import quell as ql
    >>> from quell.realtime import TwinDevice
    >>> drive = TwinDevice(ql.plants.LinearPlant.of(([2.0], [0.1, 1.0])), dt=0.01)
    >>> observer = ql.ESO.model_based(([20.0], [1.0, 10.0]), omega_o=30.0, dt=0.01)
    >>> seen_by_the_host = CompensatedDrive(drive, ql.Compensator(observer, u_min=-3.0, u_max=3.0))
    >>> seen_by_the_host.name
    'drive with a compensator'
    """

    name, disturbances = "drive with a compensator", 0
    order = 0  # its state is not the rig's: a session of the host does not reset the drive

    def __init__(
        self, device: Device, compensator: Compensator | Axes, *, channels: Sequence[str] = ()
    ) -> None:
        axes = compensator if isinstance(compensator, Axes) else None
        check_controller(compensator, "compensator", several=axes is not None)
        inner = getattr(compensator, "controller", compensator)
        if not (takes_control(inner) if axes is None else axes.takes_u_0):
            raise ValueError(
                f"compensator = {type(compensator).__name__}: must be a quell.Compensator, or Axes "
                "of such without drives; the host has the controller"
            )
        self.channels = checked_channels(compensator, channels)
        limits = limits_of(compensator) if axes is None else (axes.limits.low, axes.limits.high)
        if not np.all(np.isfinite(limits)):
            raise ValueError("compensator: give it u_min and u_max, finite limits for the drive")
        check_counts(device, counts_of(compensator))
        outputs = 1
        if axes is not None:  # a plant with several signals has these attributes
            self.outputs, self.inputs = axes.outputs, axes.inputs
            outputs = axes.outputs
        own = float(getattr(device, "dt", compensator.dt))
        if abs(own - compensator.dt) > 1e-9 * compensator.dt:
            raise ValueError(
                f"device has dt = {own!r} s, the compensator {compensator.dt!r} s: must be the same"
            )
        self.device, self.compensator = device, compensator
        self._handle = handle_of(device)
        if isinstance(self._handle, PythonHandle):
            raise ValueError(
                f"device = {device!r}: must be one that compiled code can use, such as udp:// or "
                "serial://"
            )
        self._state = compensator.initial_state()
        self._drive = Drive(
            last=np.full(outputs, np.nan),
            silent=np.zeros(outputs, dtype=np.int64),
            counts=np.zeros(4, dtype=np.int64),
            most=max(round(_LOST_AFTER / compensator.dt), _LOST_SAMPLES),
        )
        self._inputs = channel_inputs(compensator, self.channels)
        await_channels(device, self._inputs, self.channels, compensator.dt)

    def __repr__(self) -> str:
        place = getattr(self.device, "url", type(self.device).__name__)
        return f"CompensatedDrive({place!r}, {self.compensator!r})"

    @property
    def compiled(self) -> bool:
        """Whether it can run compiled: always."""
        return True

    def sampled(self, dt: float, interpret: bool = False) -> ProxyDesign | AxesProxyDesign:
        """Return the parameters, for the compensator's sample time."""
        if abs(checks.positive("dt", dt, "s") - self.compensator.dt) > 1e-9 * dt:
            raise ValueError(f"dt = {dt!r} s: must be the compensator's, {self.compensator.dt!r} s")
        controller = self.compensator.parameters, self._state
        hold = default_hold(self.compensator.dt)
        parts: Any = (*controller, self._inputs, hold, self._drive)
        one = ProxyDesign(self._handle, system_clock(), *parts)
        if not isinstance(self.compensator, Axes):
            return one
        return AxesProxyDesign(one, np.zeros(self.outputs), np.zeros(self.inputs))

    @property
    def estimate(self) -> Any:
        """The compensator's estimates after the last tick; of several axes by name."""
        compensator: Any = self.compensator
        return compensator.read(self._state)

    @property
    def counters(self) -> dict[str, int]:
        """Number of ticks without a measurement, of any axis, and of commands not sent."""
        counts = self._drive.counts
        return {"missing": int(counts[_MISSING]), "unsent": int(counts[_UNSENT])}

    @property
    def fault(self) -> str:
        """Why the drive is lost, or silent for more than ``Safety.hold`` samples; else empty."""
        reason, silent = int(self._drive.counts[_FAULT]), self._drive.silent
        if reason in _REASONS:
            return _REASONS[reason]
        missing = np.flatnonzero(silent > default_hold(self.compensator.dt))
        if missing.size == 0:
            return ""
        ticks = int(silent.max())
        of = ""
        if isinstance(self.compensator, Axes) and missing.size < silent.size:
            of = " of " + ", ".join(self.compensator.names[i] for i in missing)
        time = f"{ticks} ticks, {ticks * self.compensator.dt:.3g} s"
        return f"no measurement{of} has come for {time}"

    def close(self) -> None:
        """Set the drive's u to zero and release it."""
        self.device.close()
