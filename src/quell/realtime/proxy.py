"""A compensator between a host and a drive that both stay as they are.

To the host the proxy is the drive: it listens as a rig does (``realtime/rig.py``), sends
measurements, takes commands, and has the rig's watchdog. To the drive it is the loop. In each tick

1. the newest command of the host is u_0 (zero if its watchdog has tripped);
2. the newest measurement of the drive goes to the compensator and to the host, and so do the
   drive's channels (``realtime/channels.py``);
3. the compensator's u goes to the drive.

So the drive has one more sample of delay than without the proxy, where host and proxy have clocks
of their own: a command waits for the proxy's tick, a measurement for the host's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.base import check_controller, control, limits_of
from quell.controllers.compensated import takes_control
from quell.controllers.compensator import Compensator
from quell.kernels.dispatch import is_finite
from quell.plants.base import advance, measure
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
    handle_of,
    read_measurement,
    write_command,
)
from quell.realtime.rig import measure_channels
from quell.realtime.safety import default_hold
from quell.realtime.system import now, system_clock
from quell.types import Vector

# Entries of the state: last good measurement, whether the newest one is missing, faults in writing.
_Y, _MISSING, _UNSENT = range(3)


class ProxyDesign(NamedTuple):
    """A drive and the compensator in front of it."""

    handle: Any  # of the device
    clock: Any
    design: Any  # parameters of the compensator
    state: Any
    inputs: ChannelInputs
    hold: int  # samples for which a missing ``held`` keeps its state


@measure.register(ProxyDesign)
def _measure(proxy: ProxyDesign, x: Vector) -> float:
    y, _ = read_measurement(proxy.handle, proxy.clock, now(proxy.clock))
    read_inputs(proxy.inputs, proxy.handle)
    x[_MISSING] = 1.0
    if is_finite(y):
        x[_Y] = y
        x[_MISSING] = 0.0
    return x[_Y]


@measure_channels.register(ProxyDesign)
def _measure_channels(proxy: ProxyDesign, x: Vector, values: Vector) -> None:
    for i in range(values.size):
        values[i] = proxy.inputs.values[i]


@advance.register(ProxyDesign)
def _advance(proxy: ProxyDesign, x: Vector, scratch: Vector, t: float, u: float, w: Vector) -> None:
    y = x[_Y] if x[_MISSING] == 0.0 else np.nan
    pass_channels(proxy.inputs, proxy.design, proxy.state, proxy.hold)
    acting = control(proxy.design, proxy.state, u, y)
    if write_command(proxy.handle, acting) != 0:
        x[_UNSENT] += 1.0


class CompensatedDrive:
    """A drive behind a compensator, as a plant for ``quell.realtime.Rig``.

    Parameters
    ----------
    device
        the drive, from ``open_device(url, dt)``; it is closed by ``close``.
    compensator
        a ``Compensator`` with limits of u, in double or single precision; it is not changed.
    channels
        names of the numbers that the drive gives beside y, as for ``run_rig``; the host gets them,
        too.

    Raises
    ------
    ValueError
        for another controller, limits of u that are not finite, a device of another dt or in
        Python only, a schedule without its signals.
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

    name, order, disturbances = "drive with a compensator", 3, 0

    def __init__(
        self, device: Device, compensator: Compensator, *, channels: Sequence[str] = ()
    ) -> None:
        check_controller(compensator, "compensator")
        inner = getattr(compensator, "controller", compensator)
        if not takes_control(inner):
            raise ValueError(
                f"compensator = {type(compensator).__name__}: must be a quell.Compensator; the "
                "host has the controller"
            )
        self.channels = checked_channels(compensator, channels)
        if not np.all(np.isfinite(limits_of(compensator))):
            raise ValueError("compensator: give it u_min and u_max, finite limits for the drive")
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

    def sampled(self, dt: float, interpret: bool = False) -> ProxyDesign:
        """Return the parameters, for the compensator's sample time."""
        if abs(checks.positive("dt", dt, "s") - self.compensator.dt) > 1e-9 * dt:
            raise ValueError(f"dt = {dt!r} s: must be the compensator's, {self.compensator.dt!r} s")
        controller = self.compensator.parameters, self._state
        hold = default_hold(self.compensator.dt)
        return ProxyDesign(self._handle, system_clock(), *controller, self._inputs, hold)

    @property
    def estimate(self) -> Any:
        """The compensator's estimates after the last tick."""
        return self.compensator.read(self._state)

    def close(self) -> None:
        """Set the drive's u to zero and release it."""
        self.device.close()
