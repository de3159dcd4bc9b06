"""A run at a rig: from a device and a controller to a record."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from os import PathLike
from types import FrameType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers.axes import Axes
from quell.controllers.base import Controller, check_controller
from quell.quantities import UNKNOWN, AxesSignals, Signals
from quell.realtime.channels import await_channels, channel_inputs, checked_channels
from quell.realtime.cycle import ControlLoop
from quell.realtime.devices import Device, PythonHandle, check_counts, counts_of, handle_of
from quell.realtime.memory_file import MemoryFile, memory_file
from quell.realtime.recordings import Event, Header, MemorySink, Sink, file_sink, row_channels
from quell.realtime.safety import Safety, as_scenario, check_takes_reference, reference_samples
from quell.realtime.supervisor import RESERVED, Cause, Ending, Mode, Request, Rules, SupervisorState
from quell.realtime.system import (
    Timing,
    checked_cpu,
    checked_priority,
    enter_real_time,
    load_acquire,
    real_time_process,
    system_clock,
    termination_handler,
)
from quell.realtime.telemetry import TelemetryWriter
from quell.records.record import signals_of_loop
from quell.signals import Signal
from quell.simulation.scenario import Scenario

# ---- The result of a run at a rig ----


class ModeChange(NamedTuple):
    """A change of the supervisor's mode."""

    t: float  # time since the loop's first cycle [s]
    mode: Mode
    cause: Cause
    signal: str = ""  # axis or actuator to which it is due; empty if there is one y and one u

    def __str__(self) -> str:
        """Return the change as a sentence."""
        due = f"{self.signal}: " if self.signal else ""
        return f"{self.t:9.3f} s  {self.mode.name}: {due}{self.cause.text}"


class Tally(NamedTuple):
    """Numbers of cycles and of events in them."""

    cycles: int
    overruns: int  # cycles that woke, or ended, after the next deadline
    skipped: int  # deadlines that were skipped because of that
    missed: int  # cycles without a good measurement
    clipped: int  # cycles in which the supervisor's limits changed the controller's u
    unsent: int  # commands that could not be sent
    rows_lost: int  # rows that are missing in a file, or another sink: a full disk, a slow one


@dataclass(frozen=True, eq=False)
class RigRun:
    """The record of one run at a rig."""

    #: the samples of the scenario; ``ended`` is zero if it did not begin
    trajectory: Any
    record: Any  #: all cycles, also before the scenario (START) and after it (RAMP, STOPPED)
    timing: Timing  #: histograms of lateness and step time
    changes: tuple[ModeChange, ...]  #: changes of the supervisor's mode and their causes
    tally: Tally  #: numbers of cycles, overruns, missed samples and so on
    counters: dict[str, int]  #: the device's counters, of frames for instance
    notes: tuple[str, ...]  #: remarks, for example on permitted real-time scheduling
    #: safety rules of the run, with those that were derived; ``rules.text(dt)``
    rules: Rules

    @property
    def overruns(self) -> int:
        """Cycles that woke, or ended, after the next deadline."""
        return self.tally.overruns

    @property
    def completed(self) -> bool:
        """Whether the scenario was run to its end."""
        return any(change.cause.ending is Ending.COMPLETED for change in self.changes)

    @property
    def verdict(self) -> str:
        """The reason of the end, in a sentence."""
        changes = (change for change in reversed(self.changes) if change.cause is not Cause.RAMPED)
        return str(next(changes, "it never began")).strip()

    def metrics(self, start: float = 0.0, stop: float | None = None, **options: Any) -> Any:
        """Return ``Trajectory.metrics``; times count from the scenario's first sample [s].

        Of several axes they are a dictionary by the axis' name.

        If the run was ended early, there are no measures of a step in the window in which it ended,
        and ``missing`` says why, as does the error about a window without samples.
        """
        run, why = self.trajectory, f"the run was ended early: {self.verdict}"
        try:
            found = run.metrics(start, stop, **options)
        except ValueError as error:
            if self.completed:
                raise
            raise ValueError(f"{error}; {why}") from None
        if self.completed or (stop is not None and stop <= run.ended):
            return found
        if run.several:
            return {name: each.without_step(why) for name, each in found.items()}
        return found.without_step(why)

    def text(self) -> str:
        """Return changes, counters, timing and notes as lines of text."""
        device = counters_text({name: n for name, n in self.counters.items() if n})
        return "\n".join(
            [
                *map(str, self.changes),
                counters_text(self.tally._asdict()),
                *([f"device: {device}"] if device else []),
                self.timing.text(),
                *self.notes,
            ]
        )


def counters_text(counters: Mapping[str, int]) -> str:
    """Return counters as a line of text."""
    return ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in counters.items())


def tally(state: SupervisorState, rows_lost: int) -> Tally:
    """Return the supervisor's counters, and the number of lost rows."""
    return Tally._make([*state.counters.view(np.int64).tolist(), rows_lost])


_OF_AXIS = (Cause.MISSED, Cause.LOST, Cause.IMPLAUSIBLE, Cause.TRACKING_ERROR, Cause.F_HAT)
_OF_ACTUATOR = (Cause.SATURATED, Cause.NOT_A_NUMBER)


def signal_name(cause: Cause, signal: int, axis_names: Sequence[str]) -> str:
    """Return the axis or actuator, number ``signal`` from 1 on, to which a cause is due."""
    if axis_names and signal and cause in (*_OF_AXIS, Cause.WRONG_WAY):
        return axis_names[signal - 1]
    if axis_names and signal and cause in _OF_ACTUATOR:
        return f"u[{signal - 1}]"
    return ""


def mode_changes(
    state: SupervisorState, dt: float, first: int = 0, axis_names: Sequence[str] = ()
) -> tuple[ModeChange, ...]:
    """Return the changes of mode from number ``first`` on; the loop may be running meanwhile.

    Of several axes they name the axis or the actuator.
    """
    rows = state.changes[first : load_acquire(state.changed, 0)]
    changes = []
    for k, mode, cause, signal in rows.tolist():
        name = signal_name(Cause(cause), signal, axis_names)
        changes.append(ModeChange(k * dt, Mode(mode), Cause(cause), name))
    return tuple(changes)


def lost_changes(state: SupervisorState, dt: float) -> tuple[str, ...]:
    """Return a note if there were more changes of mode than are kept."""
    kept, limit = int(state.changed[0]), state.changes.shape[0]
    if kept < limit - RESERVED:
        return ()
    last = state.changes[kept - 1, 0] * dt
    return (f"only the first {kept} changes of mode, until {last:.3f} s, were kept",)


def silence_of(
    record: Any, changes: Sequence[ModeChange], before: Mapping[str, int], after: Mapping[str, int]
) -> tuple[str, ...]:
    """Return a note that says what came from the device when missed samples ended the run.

    Parameters
    ----------
    record
        all cycles.
    changes
        changes of mode.
    before, after
        the device's counters at the begin of the run and at its end.
    """
    end = next((each for each in changes if each.cause in (Cause.LOST, Cause.STALLED)), None)
    if end is None:
        return ()
    missed = np.asarray(record["events"]).astype(np.int64) & (Event.MISSED | Event.GAP) != 0
    at = int(np.searchsorted(record["k"], round(end.t / record.dt)))
    first = last = min(at, missed.size - 1)
    while first > 0 and missed[first - 1]:
        first -= 1
    while last < missed.size and missed[last]:
        last += 1
    count = max(last - first, 1)
    begin = record["k"][first] * record.dt
    span = f"for {count * record.dt:.3g} s ({count} samples) from {begin:.3f} s on"
    if "not_finite" not in after:
        return (f"the device gave no measurement, or none that is a number, {span}",)
    wrong = after["not_finite"] - before.get("not_finite", 0)
    if wrong:
        return (
            f"no good measurement came {span}; {wrong} packets of the run had a value that is not "
            "finite: look at the sensor of the device",
        )
    late = after.get("stale", 0) - before.get("stale", 0)
    return (
        f"no packet of the device came in time {span}, and no value was wrong: the device, the "
        f"network or this computer was busy, or the device has stopped ({late} packets were too "
        "old); the safety rule hold, or hold_time, says how long u may be held",
    )


def missing_channels(record: Any, names: Sequence[str]) -> tuple[str, ...]:
    """Return a note if channels that the controller uses were missing while it was in control."""
    if not names:
        return ()
    flags = np.asarray(record["events"]).astype(np.int64) & Event.CHANNEL != 0
    count = int(np.sum(flags & (record["mode"] == Mode.RUN)))
    if not count:
        return ()
    return (
        f"channels: in {count} samples under control one that the controller uses was missing, and "
        "its last value was held; the record has them as nan and the event CHANNEL",
    )


def scenario_part(record: Any, state: SupervisorState, samples: int) -> Any:
    """Return the samples of a record that belong to the scenario."""
    k, began = record["k"], state.memory[0].began
    inside = (k >= began) & (k < began + samples) & (began >= 0)
    log = np.ascontiguousarray(record.log[inside])
    return replace(record, log=log, ended=max(log.shape[0] - 1, 0) * record.dt)


# ---- A run at a rig ----

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
    signals: Signals | AxesSignals | None = None,
    memory: MemoryFile | str | PathLike[str] | None = None,
    channels: Sequence[str] = (),
) -> RigRun:
    """Close a controller's loop around a device in real time, at the controller's sample time.

    The controller starts with nothing learned, on a state of its own, as in ``simulate``, or with
    what is in the file ``memory``. For
    ``safety.settle_time`` it observes, with u at zero and y as its reference; then it takes over
    without a bump, and the scenario's time begins. At the end, on Ctrl-C or SIGTERM, when its
    terminal is closed, and after any fault, u is ramped to zero; a second Ctrl-C makes it zero at
    once. The device is closed in any case.

    Parameters
    ----------
    device
        see ``quell.realtime.Device``; ``open_device(url, dt)`` makes one.
    controller
        any controller with finite ``u_min`` and ``u_max``, here or in ``safety``; ``quell.Axes``
        for a device of several axes, which is opened with ``signals``.
    scenario
        a reference, or a ``Scenario``, of which reference, duration and seed count: the rig has its
        own disturbances and noise. Of several axes a reference for each, or one for all.
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
        (``quell.realtime.recordings``); a record in memory is kept in any case.
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
        "voltage [V]"}`; those of the device, or of the plant in the setup, by default. Of several
        axes a ``quell.quantities.AxesSignals``.
    memory
        file, or a ``MemoryFile``, in which what was learned outlives the run. If it exists, the
        controller begins with it, from rest; one that does not fit is an error, before anything
        moves. It is replaced when the run ends, whole or not at all, but not after a fault, to
        which what was learned may have contributed; and on ``MemoryFile.save()`` or SIGUSR1.
    channels
        names of the numbers that the device gives beside y, in its order: the external signals of
        the controller's schedule first, ``held`` for whether the plant is held, others to be
        recorded only. The last value of one that is missing is held (``realtime.channels``).

    Raises
    ------
    ValueError
        for a controller that takes u_0 in the place of a reference, u without finite limits, a
        device of another dt or with other numbers of signals, a reference that is not finite, a
        schedule without its signals, and channels that the device or the controller does not know.
    ConnectionError
        if a call of the device's driver does not return, or a channel does not come.
    """
    handle = handle_of(device)
    with closing(device):
        check_controller(controller, several=isinstance(controller, Axes))
        check_takes_reference(controller)
        dt = controller.dt
        own = getattr(device, "dt", dt)
        if abs(own - dt) > 1e-9 * dt:  # allows for the rounding of 1 / rate
            raise ValueError(
                f"device has dt = {own!r} s, the controller {dt!r} s: must be the same"
            )
        check_counts(device, counts_of(controller))
        scenario = as_scenario(scenario, duration)
        rules = (Safety() if safety is None else safety).rules(controller, scenario)
        names = checked_channels(controller, channels)
        reference = reference_samples(scenario, controller, approach)
        priority, cpu = checked_priority(priority), checked_cpu(cpu)
        kept, state, learned = memory_file(memory), None, ""
        if kept is not None:
            state, learned = kept.start(controller)
        rows = MemorySink()
        writer = TelemetryWriter(
            _header(device, controller, signals, names), [rows, *_sinks(telemetry, overwrite)]
        )
        if isinstance(handle, PythonHandle):
            device.read()  # an error of the driver comes before compiling
        await_channels(device, channel_inputs(controller, names), names, dt)
        loop = ControlLoop.of(
            device,
            controller,
            reference,
            rules,
            system_clock(spin),
            writer.ring,
            channels=names,
            state=state,
        )
        supervisor = loop.controller.supervisor
        writer.urgent = loop.interpreted and priority > 1
        if hasattr(device, "restart_session"):
            device.restart_session()  # compiling may have taken longer than the device waits
        before = dict(getattr(device, "counters", {}))
        writer.header = replace(writer.header, started=time.time_ns())
        real_time = real_time_process(priority, loop.interpreted)
        # Signals first and last: a second Ctrl-C must not lose the end of the record.
        by_signal = nullcontext() if kept is None else kept.saved_by_signal()
        with _requests_by_signals(supervisor.requests), by_signal, writer, real_time as notes:
            notes += [learned] if learned else []
            _run_thread(loop, controller, priority, cpu, notes, on_change, kept)
            device.close()  # before the record is finished, which may take time
    if kept is not None:
        notes.append(_last_save(kept, supervisor, dt))
    if scenario.disturbances or scenario.noise != 0.0:
        notes.append("disturbances and noise of the scenario are ignored: the rig has its own")
    if scenario.schedule:
        notes.append("schedule of the scenario is ignored: the device gives the signals")
    handle = loop.handle
    if isinstance(handle, PythonHandle) and handle.errors:
        count, last = int(handle.faults[0]), handle.errors[0]
        notes.append(f"the device raised {count} errors, the last of them: {last!r}")
    notes += [*lost_changes(supervisor, dt), *(f"telemetry: {p}" for p in writer.problems)]
    record = rows.trajectory()
    if not rules.names:
        record = replace(record, u_limits=(rules.limits.low[0], rules.limits.high[0]))
    counters = dict(getattr(device, "counters", {}))
    changes = mode_changes(supervisor, dt, axis_names=getattr(controller, "names", ()))
    notes += [*silence_of(record, changes, before, counters), *missing_channels(record, names)]
    return RigRun(
        trajectory=scenario_part(record, supervisor, reference.r.shape[0]),
        record=record,
        timing=loop.timing,
        changes=changes,
        tally=tally(supervisor, writer.lost),
        counters=counters,
        notes=tuple(notes),
        rules=rules,
    )


def _last_save(kept: MemoryFile, supervisor: SupervisorState, dt: float) -> str:
    """Save at the end of a run, unless a fault has ended it; return a note."""
    faults = [each for each in mode_changes(supervisor, dt) if each.cause.ending is Ending.FAULT]
    if faults:
        return (
            f"memory: NOT saved at the end, {kept.path} is as before: {faults[0].cause.text}; what "
            "was learned may have contributed"
        )
    return kept.write(supervisor.steps)


def _header(
    device: Device, controller: Any, signals: Signals | AxesSignals | None, channels: Sequence[str]
) -> Header:
    counts, notes = (1, 1), {}
    if isinstance(controller, Axes):
        counts = controller.outputs, controller.inputs
        pairs = zip(controller.names, controller.axes, strict=True)
        notes = {"axes": {name: list(axis.features) for name, axis in pairs}}
    known = getattr(device, "signals", UNKNOWN) if signals is None else signals
    known = signals_of_loop(known, controller)
    units = {}
    if isinstance(known, Signals):
        units = {"y": known.y.unit, "u": known.u.unit}
    return Header(
        channels=row_channels(controller.channels, channels, *counts),
        dt=controller.dt,
        features=tuple(controller.features),
        device=getattr(device, "name", type(device).__name__),
        controller=getattr(controller, "name", type(controller).__name__),
        units={name: unit for name, unit in units.items() if unit},
        notes=notes | ({"signals": known.texts()} if known.known else {}),
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
    controller: Any,
    priority: int,
    cpu: int | None,
    notes: list[str],
    on_change: Callable[[ModeChange], None] | None,
    memory: MemoryFile | None,
) -> None:
    """Run the loop on a thread of its own; report changes of mode, give up a driver that hangs."""
    dt, names = controller.dt, getattr(controller, "names", ())
    raised: list[BaseException] = []

    def work() -> None:
        try:
            enter_real_time(priority, cpu, notes)
            if isinstance(loop.handle, PythonHandle):
                # The driver may set itself up with the first write, and start a watchdog: not
                # before the loop is ready.
                at_rest: Any = np.zeros(controller.inputs) if names else 0.0
                loop.handle.device.write(at_rest)
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
            for change in mode_changes(supervisor, dt, seen, names):
                seen += 1
                if on_change is not None:
                    on_change(change)
            if memory is not None and (note := memory.save_if_asked(supervisor.steps)):
                notes.append(note)
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
