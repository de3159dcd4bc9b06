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
measurement that is missing is so for its own axis; the host gets the last one of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

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
from quell.realtime.rig import measure_channels
from quell.realtime.safety import default_hold
from quell.realtime.system import now, system_clock
from quell.types import Vector

# The state has the last good measurements (n,), whether the newest ones are missing (n,), and the
# number of faults in writing.


class ProxyDesign(NamedTuple):
    """A drive and the compensator in front of it."""

    handle: Any  # of the device
    clock: Any
    design: Any  # parameters of the compensator
    state: Any
    inputs: ChannelInputs
    hold: int  # samples for which a missing ``held`` keeps its state


class AxesProxyDesign(NamedTuple):
    """Drives of several axes and the compensators in front of them."""

    one: ProxyDesign  # what one drive has as well
    y: Vector  # measurements, NaN where they are missing (n,)
    u: Vector  # what acts (m,)


@kernel
def _keep(x: Vector, axes: int, i: int, y: float) -> float:
    """Return the last good measurement of an axis, which is ``y`` if it is good."""
    x[axes + i] = 1.0
    if is_finite(y):
        x[i] = y
        x[axes + i] = 0.0
    return x[i]


@kernel
def _kept(x: Vector, axes: int, i: int) -> float:
    """Return the newest measurement of an axis; NaN if it is missing."""
    return x[i] if x[axes + i] == 0.0 else np.nan


@measure.register(ProxyDesign)
def _measure(proxy: ProxyDesign, x: Vector) -> float:
    y, _ = read_measurement(proxy.handle, proxy.clock, now(proxy.clock))
    read_inputs(proxy.inputs, proxy.handle)
    return _keep(x, 1, 0, y)


@measure_all.register(AxesProxyDesign)
def _measure_all(proxy: AxesProxyDesign, x: Vector, y: Vector) -> None:
    one = proxy.one
    read_measurement(one.handle, one.clock, now(one.clock))
    read_signals(one.handle, proxy.y)
    read_inputs(one.inputs, one.handle)
    for i in range(y.size):
        y[i] = _keep(x, y.size, i, proxy.y[i])


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
    acting = control(proxy.design, proxy.state, u, _kept(x, 1, 0))
    if write_command(proxy.handle, acting) != 0:
        x[x.size - 1] += 1.0


@advance.register(AxesProxyDesign)
def _advance_all(
    proxy: AxesProxyDesign, x: Vector, scratch: Vector, t: float, u: Vector, w: Vector
) -> None:
    one = proxy.one
    for i in range(proxy.y.size):
        proxy.y[i] = _kept(x, proxy.y.size, i)
    pass_channels(one.inputs, one.design, one.state, one.hold)
    control_all(one.design, one.state, u, proxy.y, proxy.u)
    if write_signals(one.handle, proxy.u) != 0:
        x[x.size - 1] += 1.0


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
        self.order = 3
        if axes is not None:  # a plant with several signals has these attributes
            self.outputs, self.inputs = axes.outputs, axes.inputs
            self.order = 2 * axes.outputs + 1
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
        one = ProxyDesign(self._handle, system_clock(), *controller, self._inputs, hold)
        if not isinstance(self.compensator, Axes):
            return one
        return AxesProxyDesign(one, np.zeros(self.outputs), np.zeros(self.inputs))

    @property
    def estimate(self) -> Any:
        """The compensator's estimates after the last tick; of several axes by name."""
        compensator: Any = self.compensator
        return compensator.read(self._state)

    def close(self) -> None:
        """Set the drive's u to zero and release it."""
        self.device.close()
