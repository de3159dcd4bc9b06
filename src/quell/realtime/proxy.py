"""A compensator between a host and a drive that both stay as they are.

To the host the proxy is the drive: it listens as a rig does (``realtime/rig.py``), sends
measurements and takes commands. To the drive it is the loop of ``run_rig``, with the same
supervisor, rules and causes (``realtime/supervisor.py``). In each tick

1. the newest command of the host is u_0;
2. the newest measurement of the drive goes to the compensator and to the host, and so do the
   drive's channels (``realtime/channels.py``);
3. the supervisor's u goes to the drive: in RUN the compensator's, zero in START and STOPPED.

So the drive has one more sample of delay than without the proxy, where host and proxy have clocks
of their own: a command waits for the proxy's tick, a measurement for the host's.

=======  ========================================================================================
mode     while
=======  ========================================================================================
START    there is no host that commands, or ``settle`` good samples have not come since: u = 0
RUN      the host commands
HOLD     a measurement is missing: u stays as it is
RAMP     after a fault, or at the end of the host's session: u goes to zero within ``ramp`` samples,
         u_0 and the compensation together
STOPPED  u = 0. After a fault the proxy ends and the host's session with it; it stays at rest until
         it is started anew. After a session that its host has ended it goes back to START
=======  ========================================================================================

A host is lost if more than ``hold`` ticks in a row had no command of it: u_0 is held until then. A
host that comes back, or another one, can change nothing in RAMP and STOPPED. What it commands in
START is not applied.

Drives of several axes have ``Axes`` of compensators: the host's command is u_0 of all actuators. A
measurement that is missing holds all u, and is so for its own axis in the observers.

Where clocks differ, a tick may find no new measurement. One is replaced by the last one for the
host; from the second in a row on the host gets NaN, which is no measurement, and no channels. So it
does what it does without the proxy. The compensator gets NaN in each case.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.axes import Axes
from quell.controllers.base import check_controller, limits_of
from quell.controllers.compensated import takes_control
from quell.controllers.compensator import Compensator
from quell.kernels.dispatch import is_finite, kernel
from quell.plants.base import advance, all_signals, as_input, measure_all
from quell.realtime import cycle, devices, rig
from quell.realtime.channels import await_channels, checked_channels
from quell.realtime.cycle import control_step, count_cycle, count_fault, take_inputs
from quell.realtime.devices import read_measurement, write_signals
from quell.realtime.rig import BEHIND, LIVE, STATE, TRIPPED
from quell.realtime.run import ModeChange, mode_changes, signal_name
from quell.realtime.safety import Safety
from quell.realtime.supervisor import (
    Cause,
    Ending,
    Host,
    LoopSignals,
    Memory,
    Mode,
    Request,
    SupervisorState,
    change_mode,
    finished,
    wait_for_host,
)
from quell.realtime.system import now, store_release, system_clock
from quell.realtime.telemetry import ring
from quell.types import Vector

# Measurements in a row that are replaced by the last one for the host: two clocks that differ leave
# one out now and then, but not two.
_REPLACED = 1
# Time that the drive has for its first measurement [s], and least samples: as in ``run_rig``.
_FIRST, _FIRST_SAMPLES = 2.0, 50
# More samples than any run has.
_NEVER = 1 << 60
# Entries of ``Drive.counts``: ticks, the session that the compensator works for, and
# ``RigModel.counts[BEHIND]``.
_TICK, _SESSION, _LATE = range(3)


class HostCommand(NamedTuple):
    """The commands of the host, in the place of a reference."""

    given: Vector  # u_0 of this tick (m,)


@cycle.samples_of.register(HostCommand)
def _samples(reference: HostCommand) -> int:
    return _NEVER


@cycle.first_of.register(HostCommand)
def _first(reference: HostCommand, i: int) -> float:
    return 0.0


@cycle.set_references.register(HostCommand)
def _set_commands(
    reference: HostCommand, design: Any, state: Any, memory: Memory, signals: LoopSignals, k: int
) -> None:
    if memory.began < 0:
        for c in range(reference.given.size):
            reference.given[c] = 0.0


class Drive(NamedTuple):
    """The measurements of a drive."""

    y: Vector  # of this tick, NaN where they are missing (n,)
    last: Vector  # last good ones; NaN before the first (n,)
    silent: NDArray[np.int64]  # samples in a row without one (n,)
    counts: NDArray[np.int64]
    first: int  # ticks until which the first ones must have come


class ProxyDesign(NamedTuple):
    """A drive and the compensator in front of it."""

    handle: Any  # of the device
    clock: Any
    controller: cycle.SupervisedController
    drive: Drive


as_input.register(ProxyDesign)(all_signals)


# ---- The host's side ----


@kernel
def _shown(drive: Drive, i: int, y: float) -> float:
    """Take the newest measurement of an axis, NaN if it is missing; return that for the host."""
    drive.y[i] = y
    if is_finite(y):
        drive.last[i] = y
        drive.silent[i] = 0
    else:
        drive.silent[i] += 1
    return drive.last[i] if drive.silent[i] <= _REPLACED else np.nan


@kernel
def _hide_channels(proxy: ProxyDesign) -> None:
    """Make the channels of a silent drive missing."""
    least = proxy.drive.silent[0]
    for i in range(proxy.drive.silent.size):
        least = min(least, proxy.drive.silent[i])
    if least > _REPLACED:
        values = proxy.controller.inputs.values
        for i in range(values.size):
            values[i] = np.nan


@measure_all.register(ProxyDesign)
def _measure_all(proxy: ProxyDesign, x: Vector, y: Vector) -> None:
    first, _ = read_measurement(proxy.handle, proxy.clock, now(proxy.clock))
    take_inputs(proxy.controller, proxy.handle, first)
    for i in range(y.size):
        y[i] = _shown(proxy.drive, i, proxy.controller.supervisor.signals.y[i])
    _hide_channels(proxy)


@rig.measure_channels.register(ProxyDesign)
def _measure_channels(proxy: ProxyDesign, x: Vector, values: Vector) -> None:
    for i in range(values.size):
        values[i] = proxy.controller.inputs.values[i]


@rig.tell_host.register(ProxyDesign)
def _tell(proxy: ProxyDesign, counts: NDArray[np.int64], session: int) -> None:
    memory, own = proxy.controller.supervisor.memory[0], proxy.drive.counts
    if memory.mode == Mode.START:
        own[_SESSION] = session
    memory.host = Host.ABSENT
    if counts[STATE] == TRIPPED:
        memory.host = Host.LOST
    elif counts[STATE] == LIVE and session == own[_SESSION]:
        memory.host = Host.PRESENT
    own[_LATE] = counts[BEHIND]


# ---- The drive's side ----


@advance.register(ProxyDesign)
def _advance(
    proxy: ProxyDesign, x: Vector, scratch: Vector, t: float, u: Vector, w: Vector
) -> None:
    """Take the sample of a tick and send its u to the drive."""
    controller, drive = proxy.controller, proxy.drive
    for c in range(u.size):
        controller.reference.given[c] = u[c]
    supervisor, k = controller.supervisor, drive.counts[_TICK]
    memory, seen = supervisor.memory[0], True
    for i in range(drive.last.size):
        seen &= is_finite(drive.last[i])
    if not seen:  # the first ones may take their time
        memory.missed_in_row = 0
        if k == drive.first and memory.mode != Mode.STOPPED:
            change_mode(supervisor, k, Mode.STOPPED, Cause.NO_MEASUREMENT)
    elif drive.counts[_LATE] != 0 and not is_finite(drive.y[0]):
        memory.skipped_in_row += 1
    if finished(supervisor) and memory.ended_by == Cause.HOST_LEFT:
        wait_for_host(supervisor, k)
    control_step(controller, k, 0)
    count_fault(supervisor, write_signals(proxy.handle, supervisor.signals.u))
    count_cycle(supervisor, drive.counts[_LATE] > 1)
    drive.counts[_TICK] = k + 1


@rig.has_ended.register(ProxyDesign)
def _has_ended(proxy: ProxyDesign) -> bool:
    supervisor = proxy.controller.supervisor
    return finished(supervisor) and supervisor.memory[0].ended_by != Cause.HOST_LEFT


@rig.may_end.register(ProxyDesign)
def _may_end(proxy: ProxyDesign, stop: int) -> bool:
    supervisor = proxy.controller.supervisor
    asked = Request.RAMP if stop < 2 else Request.ZERO
    if asked > supervisor.requests[0]:
        store_release(supervisor.requests, 0, asked)
    return finished(supervisor)


@rig.fill_log.register(ProxyDesign)
def _fill_log(proxy: ProxyDesign, row: Vector) -> None:
    supervisor = proxy.controller.supervisor
    row[0] = supervisor.memory[0].mode
    for c in range(supervisor.signals.u.size):
        row[1 + c] = supervisor.signals.u[c]


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
    safety
        rules of the supervisor, as for ``run_rig``; ``Safety()`` by default, in which y has no
        bounds, as nobody knows where the host will go. ``drive.rules.text(dt)`` shows them.

    Raises
    ------
    ValueError
        for another controller, limits of u that are not finite, a device of another dt, with other
        numbers of signals or in Python only, a schedule without its signals, and for
        ``most_error``, as the host alone has a reference.
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
        self,
        device: devices.Device,
        compensator: Compensator | Axes,
        *,
        channels: Sequence[str] = (),
        safety: Safety | None = None,
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
        safety = Safety() if safety is None else safety
        if np.any(np.isfinite(safety.most_error)):
            raise ValueError(
                f"most_error = {safety.most_error!r}: has no effect here, as the host has the "
                "reference; leave it out, and give y_min and y_max where the plant must not go"
            )
        self.rules = safety.rules(compensator)
        devices.check_counts(device, devices.counts_of(compensator))
        outputs, inputs = devices.counts_of(compensator) or (1, 1)
        self.log_columns: tuple[str, ...] = ("mode", "u_drive")
        if axes is not None:  # a plant with several signals has these attributes
            self.outputs, self.inputs = outputs, inputs
            self.log_columns = ("mode", *(f"u_drive[{c}]" for c in range(inputs)))
        own = float(getattr(device, "dt", compensator.dt))
        if abs(own - compensator.dt) > 1e-9 * compensator.dt:
            raise ValueError(
                f"device has dt = {own!r} s, the compensator {compensator.dt!r} s: must be the same"
            )
        self.device, self.compensator = device, compensator
        self._handle = devices.handle_of(device)
        if isinstance(self._handle, devices.PythonHandle):
            raise ValueError(
                f"device = {device!r}: must be one that compiled code can use, such as udp:// or "
                "serial://"
            )
        self._state = compensator.initial_state()
        command = HostCommand(np.zeros(inputs))
        parts = (compensator, command, self.rules, ring(1, 1), self.channels, self._state)
        self._controller = cycle.supervise(*parts)
        # The drive's clock is not the proxy's: good samples in a row may never be many.
        self._supervisor.memory[0].forgiven = self._controller.rules.hold
        self._drive = Drive(
            y=np.full(outputs, np.nan),
            last=np.full(outputs, np.nan),
            silent=np.zeros(outputs, dtype=np.int64),
            counts=np.zeros(3, dtype=np.int64),
            first=max(round(_FIRST / compensator.dt), _FIRST_SAMPLES),
        )
        await_channels(device, self._controller.inputs, self.channels, compensator.dt)

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
        return ProxyDesign(self._handle, system_clock(), self._controller, self._drive)

    @property
    def watchdog(self) -> int:
        """Ticks in a row without a command after which the host is lost: more than ``hold``."""
        return int(self._controller.rules.hold) + 1

    @property
    def estimate(self) -> Any:
        """The compensator's estimates after the last tick; of several axes by name."""
        compensator: Any = self.compensator
        return compensator.read(self._state)

    @property
    def counters(self) -> dict[str, int]:
        """Number of ticks without a measurement, of any axis, and of commands not sent."""
        counters = self._supervisor.counters[0]
        return {"missing": int(counters.missed), "unsent": int(counters.unsent)}

    @property
    def mode(self) -> Mode:
        """The supervisor's mode."""
        return Mode(int(self._supervisor.memory[0].mode))

    @property
    def u(self) -> Any:
        """The u of the last tick, as sent to the drive; of several axes an array (m,)."""
        u = self._supervisor.signals.u
        return u.copy() if isinstance(self.compensator, Axes) else float(u[0])

    def changes(self, first: int = 0) -> tuple[ModeChange, ...]:
        """Return the changes of the supervisor's mode, from number ``first`` on."""
        names = getattr(self.compensator, "names", ())
        return mode_changes(self._supervisor, self.compensator.dt, first, names)

    @property
    def fault(self) -> str:
        """The limit or fault for which u was ramped to zero, as a clause; else empty."""
        memory = self._supervisor.memory[0]
        cause = Cause(int(memory.ended_by))
        if memory.mode < Mode.RAMP or cause.ending is not Ending.FAULT:
            return ""
        names = getattr(self.compensator, "names", ())
        signal = signal_name(cause, int(memory.ended_signal), names)
        return f"{signal}: {cause.text}" if signal else cause.text

    @property
    def _supervisor(self) -> SupervisorState:
        return self._controller.supervisor

    def close(self) -> None:
        """Set the drive's u to zero and release it."""
        self.device.close()
