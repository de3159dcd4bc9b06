"""A run at a rig: from a device and a controller to a record."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from os import PathLike
from types import FrameType

import numpy as np
from numpy.typing import NDArray

from quell.controllers.base import Controller, check_controller
from quell.quantities import UNKNOWN, Signals
from quell.realtime.devices.base import Device, PythonHandle, handle_of
from quell.realtime.loop.control_loop import ControlLoop
from quell.realtime.loop.modes import Request
from quell.realtime.loop.reference import as_scenario, reference_samples
from quell.realtime.loop.result import (
    ModeChange,
    RigRun,
    lost_changes,
    mode_changes,
    scenario_part,
    silence_of,
    tally,
)
from quell.realtime.loop.safety import Safety
from quell.realtime.system.clock import system_clock
from quell.realtime.system.interrupts import termination_handler
from quell.realtime.system.scheduling import (
    checked_cpu,
    checked_priority,
    enter_real_time,
    real_time_process,
)
from quell.realtime.telemetry.channels import row_channels
from quell.realtime.telemetry.header import Header
from quell.realtime.telemetry.sinks import MemorySink, Sink, file_sink
from quell.realtime.telemetry.writer import TelemetryWriter
from quell.records.channels import signals_of_loop
from quell.signals import Signal
from quell.simulation.scenario import Scenario

# Time between two looks of the main thread at the loop [s]; chosen by hand; not tuned further.
_LOOK = 0.05
# A call of a device's driver is given up after so many seconds, or samples if that is longer;
# chosen by hand; not tuned further.
_HUNG, _HUNG_SAMPLES = 3.0, 30.0


def run_rig(
    device: Device,
    controller: Controller,
    scenario: Scenario | Signal | float,
    *,
    duration: float | None = None,
    safety: Safety | None = None,
    approach: float = 1.0,  # chosen by hand
    telemetry: Sequence[str | PathLike[str] | Sink] = (),
    spin: float = 0.0,
    priority: int = 50,  # the middle of the range; chosen by hand
    cpu: int | None = None,
    on_change: Callable[[ModeChange], None] | None = None,
    overwrite: bool = False,
    signals: Signals | None = None,
) -> RigRun:
    """Close a controller's loop around a device in real time, at the controller's sample time.

    The controller starts with nothing learned, on a state of its own, as in ``simulate``. For
    ``safety.settle_time`` it observes, with u at zero and y as its reference; then it takes over
    without a bump, and the scenario's time begins. At the end, on Ctrl-C or SIGTERM, when its
    terminal is closed, and after any fault, u is ramped to zero; a second Ctrl-C makes it zero at
    once. The device is closed in any case.

    Parameters
    ----------
    device
        see ``quell.realtime.Device``; ``open_device(url, dt)`` makes one.
    controller
        any controller with finite ``u_min`` and ``u_max``, here or in ``safety``.
    scenario
        a reference, or a ``Scenario``, of which reference, duration and seed count: the rig has its
        own disturbances and noise.
    duration
        duration [s]; the scenario's own by default.
    safety
        limits, and what happens beyond them; ``Safety()`` by default. ``safety.rules(controller,
        scenario).text(dt)`` shows the rules before a run, ``RigRun.rules`` after it.
    approach
        time [s] in which the reference moves, with the least jerk, from where y is to the
        scenario's; 0 for a jump.
    telemetry
        files that end in ``.csv`` or ``.mcap``, or other sinks
        (``quell.realtime.telemetry.sinks``); a record in memory is kept in any case.
    spin
        time before each deadline in which the loop polls the clock instead of sleeping [s]: it
        wakes more punctually and heats the processor.
    priority
        SCHED_FIFO priority of the loop, 1 to 99, together with locked memory; 0 for an ordinary
        process. ``notes`` say what is not permitted.
    cpu
        number of the processor for the loop; any by default.
    on_change
        called with each change of the supervisor's mode, soon after it, in this thread.
    overwrite
        whether files of ``telemetry`` that exist are replaced; they are refused otherwise.
    signals
        names and units of y and u for records, telemetry and plots, `{y = "angle [rad]", u =
        "voltage [V]"}`; those of the device, or of the plant in the setup, by default.

    Raises
    ------
    ValueError
        for u without finite limits, a device of another dt, a reference that is not finite.
    ConnectionError
        if a call of the device's driver does not return.
    """
    handle = handle_of(device)
    with closing(device):
        check_controller(controller)
        dt = controller.dt
        own = getattr(device, "dt", dt)
        if abs(own - dt) > 1e-9 * dt:  # allows for the rounding of 1 / rate
            raise ValueError(
                f"device has dt = {own!r} s, the controller {dt!r} s: must be the same"
            )
        scenario = as_scenario(scenario, duration)
        rules = (Safety() if safety is None else safety).rules(controller, scenario)
        derivatives = getattr(controller, "derivatives", 0)
        reference = reference_samples(scenario, dt, derivatives, approach)
        priority, cpu = checked_priority(priority), checked_cpu(cpu)
        memory = MemorySink()
        writer = TelemetryWriter(
            _header(device, controller, signals), [memory, *_sinks(telemetry, overwrite)]
        )
        if isinstance(handle, PythonHandle):
            device.read()  # an error of the driver comes before compiling
        loop = ControlLoop.of(device, controller, reference, rules, system_clock(spin), writer.ring)
        supervisor = loop.controller.supervisor
        writer.urgent = loop.interpreted and priority > 1
        if hasattr(device, "restart_session"):
            device.restart_session()  # compiling may have taken longer than the device waits
        before = dict(getattr(device, "counters", {}))
        writer.header = replace(writer.header, started=time.time_ns())
        real_time = real_time_process(priority, loop.interpreted)
        # Signals first and last: a second Ctrl-C must not lose the end of the record.
        with _requests_by_signals(supervisor.requests), writer, real_time as notes:
            _run_thread(loop, dt, priority, cpu, notes, on_change)
            device.close()  # before the record is finished, which may take time
    if scenario.disturbances or scenario.noise != 0.0:
        notes.append("disturbances and noise of the scenario are ignored: the rig has its own")
    handle = loop.handle
    if isinstance(handle, PythonHandle) and handle.errors:
        count, last = int(handle.faults[0]), handle.errors[0]
        notes.append(f"the device raised {count} errors, the last of them: {last!r}")
    notes += [*lost_changes(supervisor, dt), *(f"telemetry: {p}" for p in writer.problems)]
    record = replace(memory.trajectory(), u_limits=(rules.low, rules.high))
    counters, changes = dict(getattr(device, "counters", {})), mode_changes(supervisor, dt)
    notes += silence_of(record, changes, before, counters)
    return RigRun(
        trajectory=scenario_part(record, supervisor, reference.r.size),
        record=record,
        timing=loop.timing,
        changes=changes,
        tally=tally(supervisor, writer.dropped),
        counters=counters,
        notes=tuple(notes),
        rules=rules,
    )


def _header(device: Device, controller: Controller, signals: Signals | None) -> Header:
    known = getattr(device, "signals", UNKNOWN) if signals is None else signals
    known = signals_of_loop(known, controller)
    units = {"y": known.y.unit, "u": known.u.unit}
    return Header(
        channels=row_channels(controller.channels),
        dt=controller.dt,
        features=tuple(controller.features),
        device=getattr(device, "name", type(device).__name__),
        controller=getattr(controller, "name", type(controller).__name__),
        units={name: unit for name, unit in units.items() if unit},
        notes={"signals": known.texts()} if known.known else {},
    )


def _sinks(telemetry: Sequence[str | PathLike[str] | Sink], overwrite: bool) -> list[Sink]:
    """Return the sinks; those for files are checked, because compiling may take a minute."""
    if isinstance(telemetry, str | PathLike):
        raise ValueError(f"telemetry = {str(telemetry)!r}: must be a list of files and sinks")
    sinks: list[Sink] = []
    for entry in telemetry:
        if isinstance(entry, str | PathLike):
            file = file_sink(entry, overwrite)
            file.check()
            sinks.append(file)
        else:
            sinks.append(entry)
    return sinks


def _run_thread(
    loop: ControlLoop,
    dt: float,
    priority: int,
    cpu: int | None,
    notes: list[str],
    on_change: Callable[[ModeChange], None] | None,
) -> None:
    """Run the loop on a thread of its own; report changes of mode, give up a driver that hangs."""
    raised: list[BaseException] = []

    def work() -> None:
        try:
            enter_real_time(priority, cpu, notes)
            if isinstance(loop.handle, PythonHandle):
                # The driver may set itself up with the first write, and start a watchdog: not
                # before the loop is ready.
                loop.handle.device.write(0.0)
            loop.run()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=work, name="quell-loop", daemon=True)
    thread.start()
    supervisor = loop.controller.supervisor
    counters = supervisor.counters[0]
    seen, cycles, progressed, hung = 0, -1, time.monotonic(), False
    try:
        while thread.is_alive() and not hung:
            thread.join(_LOOK)
            for change in mode_changes(supervisor, dt, seen):
                seen += 1
                if on_change is not None:
                    on_change(change)
            if counters.cycles != cycles or not loop.interpreted:
                cycles, progressed = int(counters.cycles), time.monotonic()
            hung = time.monotonic() - progressed > max(_HUNG, _HUNG_SAMPLES * dt)
    except BaseException:
        supervisor.requests[0] = max(int(supervisor.requests[0]), Request.RAMP)
        thread.join(max(_HUNG, (loop.controller.rules.ramp + _HUNG_SAMPLES) * dt))
        raise
    if hung:
        seconds = time.monotonic() - progressed
        raise ConnectionError(
            f"device: read() or write() did not return for {seconds:.1f} s; it was closed"
        )
    if raised:
        raise raised[0]


@contextmanager
def _requests_by_signals(requests: NDArray[np.int64]) -> Iterator[None]:
    """Request a ramp at the first signal and zero at the second, if this is the main thread."""

    def request(number: int, frame: FrameType | None) -> None:
        first = requests[0] == Request.NONE
        requests[0] = Request.RAMP if first else Request.ZERO

    if threading.current_thread() is threading.main_thread():
        with termination_handler(request):
            yield
    else:
        yield
