"""A run at the rig: from a device and a controller to a record, with everything put back in order at the end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from os import PathLike
from typing import Any

from numpy.typing import NDArray

from quell.controllers.base import check_controller
from quell.realtime.devices.base import Device, PythonHandle, handle_of
from quell.realtime.loop.control_loop import ControlLoop, scenario_of, setpoints
from quell.realtime.loop.modes import Request
from quell.realtime.loop.result import (
    ModeChange,
    RigRun,
    mode_changes,
    scenario_part,
    tally_of,
    unkept,
)
from quell.realtime.loop.safety import Safety
from quell.realtime.loop.supervisor import CYCLES
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

# The main thread looks after the loop so often [s].
_LOOK = 0.05
# A device's driver that does not return for so long [s], and so many samples, is given up.
_HUNG = 3.0
_HUNG_SAMPLES = 30.0


def run_rig(
    device: Device,
    controller: Any,
    scenario: Any,
    *,
    duration: float | None = None,
    safety: Safety | None = None,
    approach: float = 1.0,
    telemetry: Sequence[str | PathLike[str] | Sink] = (),
    spin: float = 0.0,
    priority: int = 50,
    cpu: int | None = None,
    on_change: Callable[[ModeChange], None] | None = None,
) -> RigRun:
    """Close a controller's loop around a device, in real time, at the controller's sample time.

    The controller begins with nothing learned, on a state of its own, as in ``simulate``. For ``safety.settle`` samples it watches with u
    at zero and its reference where y is; then it takes over without a bump, and the scenario's time begins. At the end, on Ctrl-C or
    SIGTERM, when its terminal is closed, and where anything goes wrong, u is ramped to zero; a second Ctrl-C makes it zero at once. The
    device is closed in any case.

    Parameters
    ----------
    device
        what to control, see ``quell.realtime.Device``; ``open_device(url, dt)`` makes one.
    controller
        any controller with finite ``u_min`` and ``u_max``, here or in ``safety``.
    scenario
        a ``Scenario``, of which reference, duration and seed count: disturbances and noise are the rig's own; or a reference.
    duration
        how long it takes [s]; the scenario's own by default.
    safety
        limits, and what happens where they are passed; ``Safety()`` by default.
    approach
        in how many seconds the reference slides from where y is to where the scenario has it, with the least jerk; 0 lets it jump.
    telemetry
        files that end in ``.csv`` or ``.mcap``, or other sinks of ``quell.realtime.telemetry.sinks``; a record in memory is kept in any case.
    spin
        for so long before each deadline the processor is kept busy instead of asleep [s]: punctual, at the price of heat.
    priority
        SCHED_FIFO priority of the loop, 1 to 99, together with locked memory; 0 leaves all that alone. What is not permitted is said in
        ``notes``.
    cpu
        number of the processor that the loop is to have; any by default.
    on_change
        called with each change of the supervisor's mode, soon after it, in this thread.

    Returns
    -------
    RigRun

    Raises
    ------
    ValueError
        for arguments out of range, u without finite limits, a device of another sample time, a reference that is not finite.
    ConnectionError
        where the device's driver does not come back from a call.
    """
    handle = handle_of(device)
    with ExitStack() as stack:
        stack.callback(device.close)
        check_controller(controller)
        _check_dt(device, controller.dt)
        rules = (Safety() if safety is None else safety).rules(controller)
        course = scenario_of(scenario, duration)
        points = setpoints(course, controller.dt, getattr(controller, "derivatives", 0), approach)
        priority, cpu = checked_priority(priority), checked_cpu(cpu)
        memory = MemorySink()
        header = Header(
            channels=row_channels(controller.channels),
            dt=controller.dt,
            features=tuple(controller.features),
            device=getattr(device, "name", type(device).__name__),
            controller=getattr(controller, "name", type(controller).__name__),
        )
        if isinstance(telemetry, str | PathLike):
            raise ValueError(
                f"telemetry = {str(telemetry)!r}: must be a list of files and sinks, be it of one"
            )
        writer = TelemetryWriter(header, [memory, *(_sink(place) for place in telemetry)])
        if isinstance(handle, PythonHandle):
            handle.device.read()  # what it complains of comes before anything else
        loop = ControlLoop.of(device, controller, points, rules, system_clock(spin), writer.ring)
        writer.urgent = loop.interpreted and priority > 1
        _restart_session(device)
        writer.header = replace(header, started=time.time_ns())
        # The signals come first: who is impatient shall not lose the end of the record.
        with (
            _signals(loop.requests),
            writer,
            real_time_process(priority, loop.interpreted) as notes,
        ):
            _supervised(
                loop, controller.dt, priority, cpu, notes, on_change or (lambda change: None)
            )
            device.close()  # before the record is finished, which may take its time
    record = memory.trajectory()
    state = loop.supervisor
    if course.disturbances or course.noise != 0.0:
        notes.append(
            "disturbances and noise of the scenario are left to the rig, which has its own"
        )
    if isinstance(loop.handle, PythonHandle) and loop.handle.errors:
        notes.append(
            f"the device raised {int(loop.handle.faults[0])} errors, the last of them: {loop.handle.errors[0]!r}"
        )
    return RigRun(
        trajectory=scenario_part(record, state, points.r.size),
        record=record,
        timing=loop.timing,
        changes=mode_changes(state, controller.dt),
        tally=tally_of(state, writer.dropped),
        counters=dict(getattr(device, "counters", {})),
        notes=(
            *notes,
            *unkept(state, controller.dt),
            *(f"telemetry: {problem}" for problem in writer.problems),
        ),
    )


def _supervised(
    loop: ControlLoop,
    dt: float,
    priority: int,
    cpu: int | None,
    notes: list[str],
    on_change: Callable[[ModeChange], None],
) -> None:
    """Run the loop on a thread of its own, and tell what it does."""
    raised: list[BaseException] = []

    def work() -> None:
        try:
            enter_real_time(priority, cpu, notes)
            if isinstance(loop.handle, PythonHandle):
                # What it has to set up comes before the first cycle, but no sooner: a watchdog that this starts would not wait.
                loop.handle.device.write(0.0)
            loop.run()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=work, name="quell-loop", daemon=True)
    thread.start()
    seen, cycles, moved = 0, -1, time.monotonic()
    hung = False
    try:
        while thread.is_alive() and not hung:
            thread.join(_LOOK)
            for change in mode_changes(loop.supervisor, dt, seen):
                seen += 1
                on_change(change)
            if loop.supervisor.counts[CYCLES] != cycles or not loop.interpreted:
                cycles, moved = int(loop.supervisor.counts[CYCLES]), time.monotonic()
            hung = time.monotonic() - moved > max(_HUNG, _HUNG_SAMPLES * dt)
    except BaseException:
        loop.requests[0] = max(int(loop.requests[0]), Request.RAMP)
        thread.join(max(_HUNG, (loop.rules.ramp + _HUNG_SAMPLES) * dt))
        raise
    if hung:
        raise ConnectionError(
            f"device: read() or write() did not return for {time.monotonic() - moved:.1f} s; it was closed"
        )
    if raised:
        raise raised[0]


def _restart_session(device: Any) -> None:
    """Let a device that has sessions begin one now: compiling may have taken longer than it waits for a loop."""
    if hasattr(device, "restart_session"):
        device.restart_session()


def _check_dt(device: Any, dt: float) -> None:
    own = getattr(device, "dt", dt)
    if abs(own - dt) > 1e-9 * dt:
        raise ValueError(f"device has dt = {own!r} s, the controller {dt!r} s: must be the same")


def _sink(place: Any) -> Sink:
    return file_sink(place) if isinstance(place, str | PathLike) else place


@contextmanager
def _signals(requests: NDArray[Any]) -> Iterator[None]:
    """Let what ends other programs ask the loop to ramp down, and a second time for zero at once; in the main thread only."""

    def ask(number: int, frame: Any) -> None:
        requests[0] = (
            Request.ZERO if requests[0] == Request.RAMP else max(int(requests[0]), Request.RAMP)
        )

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with termination_handler(ask):
        yield
