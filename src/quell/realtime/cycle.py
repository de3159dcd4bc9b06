"""The loop of a run: by deadlines or by the ticks of a device, compiled before the first sample.

The loop by deadlines: one function for the whole run, compiled if the device allows it.

Cycle k has the deadline ``origin + k dt``. The loop sleeps until this time, takes the measurement,
calls supervisor and controller, writes u, and pushes a row to the telemetry. A cycle that ends
after the next deadline has overrun: the deadlines that have passed are skipped (k jumps). For the
controller they are samples without a measurement in which u stayed the same, so its observer
follows the plant.

The loop around a device with a clock of its own takes the same control step for each tick.

The device numbers its ticks, so the loop knows them all, however late their measurements come. If
several wait, because the loop, the device or the wire was late, the loop takes a step for each of
them, in order and with its own measurement, and sends u for the newest. Each measurement also says
which command acts from its tick on (``Tick.u``). If that is not the u that was meant, because it
came too late and the device held the u before it, the controller is told so before its next step.
So a delay costs no accuracy of the estimates; u itself acts late, which nobody can undo.

A tick whose measurement was lost is a step without measurement. A tick counts as lost when a newer
one comes, or after ``hold`` further samples without any. Until then u is held: it is sent again
each sample, so that the device hears from the loop.

The loop sleeps until the next tick is expected and then waits for its measurement. The grid of
these times follows the device's clock: if the loop had to wait for the measurement, the grid moves
later by that time, by 1/500 of a sample at most; if it was there, earlier by 1/20 000 of a sample.

A control loop: device, controller, supervisor and reference, compiled before the first cycle.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers.base import bumpless_transfer, set_reference_derivatives, write_row
from quell.controllers.several import (
    axes_of,
    control_all,
    inputs_of,
    motion_by,
    outputs_of,
    set_applied_controls,
    write_applied,
)
from quell.kernels.dispatch import (
    compiled,
    explain_compile_errors,
    generic,
    interpreted,
    is_finite,
    kernel,
    specialised,
)
from quell.kernels.sized import Size
from quell.realtime import devices, recordings, system
from quell.realtime.channels import (
    ChannelInputs,
    channel_inputs,
    pass_channels,
    read_inputs,
    record_channels,
)
from quell.realtime.devices import (
    Tick,
    ask,
    drop_signals,
    read_acting,
    read_measurement,
    read_signals,
    read_tick,
    write_signals,
)
from quell.realtime.recordings import Event, loop_channels, row_channels
from quell.realtime.safety import ReferenceSamples
from quell.realtime.supervisor import (
    FLUSH,
    Cause,
    LoopSignals,
    Memory,
    Mode,
    Request,
    Rules,
    RunLimits,
    SupervisorState,
    all_measured,
    change_mode,
    finished,
    initial_state,
    supervise_controls,
    update_mode,
)
from quell.realtime.system import count_duration, load_acquire, now, store_release, wait_until
from quell.realtime.telemetry import Ring, push
from quell.records.record import columns_of
from quell.types import Channels, Vector

# ---- The loop by deadlines ----

_MISSED, _OVERRAN, _CLIPPED = int(Event.MISSED), int(Event.OVERRUN), int(Event.CLIPPED)
_UNSENT, _CHANGED, _CHANNEL = int(Event.UNSENT), int(Event.CHANGED), int(Event.CHANNEL)


class CycleLog(NamedTuple):
    """Outputs of the loop for other threads."""

    ring: Ring
    row: Vector  #: work array: one row
    channels: int  #: index of the device's channels, behind the controller's
    controller: Size  #: index of the controller's channels
    lateness: NDArray[np.int64]  #: histogram, see ``count_duration``
    step_time: NDArray[np.int64]  #: histogram


class SupervisedController(NamedTuple):
    """A controller, its supervisor, its reference and its log: the arguments of a control step."""

    design: Any  #: parameters of the controller
    state: Any  #: state of the controller
    rules: RunLimits
    supervisor: SupervisorState
    reference: Any  #: ``ReferenceSamples``, or another one with ``set_references``
    log: CycleLog
    inputs: ChannelInputs  #: what the device gives beside y
    f_hat: NDArray[np.int64]
    """Places in a row of the learned and of the observer's part of f̂ of each axis; −1 (n, 2)."""


@compiled
def run_cycles(handle: Any, clock: Any, period: float, controller: Any) -> None:
    """Run until the supervisor has stopped the device; a sample lasts ``period`` [ns].

    ``controller`` is a ``SupervisedController``, or a ``CompiledController`` around one.
    """
    supervisor, log = controller.supervisor, controller.log
    counters = supervisor.counters[0]
    origin = now(clock) + int(period)
    k = left_out = 0
    while not finished(supervisor):
        deadline = origin + int(k * period)
        woke = wait_until(clock, deadline)
        lateness = woke - deadline
        overslept = int(lateness / period)
        left_out += overslept
        k += overslept
        _count_skipped(supervisor, overslept)
        y, waited = read_measurement(handle, clock, woke)
        take_inputs(controller, handle, y)
        changed, clipped = supervisor.changed[0], counters.clipped
        control_step(controller, k, left_out)
        fault = write_signals(handle, supervisor.signals.u)
        count_fault(supervisor, fault)
        written = now(clock)
        due = origin + int((k + 1) * period)
        missed_next = 1 + int((written - due) / period) if written >= due else 0
        overran = overslept + missed_next > 0
        count_cycle(supervisor, overran)
        events = cycle_events(controller, overran, fault, changed, clipped)
        fill_row(controller, k, lateness, written - woke - waited, events)
        push(log.ring, log.row)
        _count_skipped(supervisor, missed_next)
        left_out = missed_next
        k += 1 + missed_next


@kernel
def take_inputs(controller: Any, handle: Any, y: float) -> None:
    """Take all measurements and channels of the device; ``y`` is the measurement of one axis."""
    measured = controller.supervisor.signals.y
    measured[0] = y
    read_signals(handle, measured)
    read_inputs(controller.inputs, handle)


@kernel
def _skip_inputs(controller: SupervisedController) -> None:
    """Take a sample without measurements."""
    measured = controller.supervisor.signals.y
    for i in range(measured.size):
        measured[i] = np.nan


@kernel
def _finish_signals(controller: SupervisedController, handle: Any, u: float) -> None:
    """Correct u of the row before by what acts since then, ``u``; NaN if it is not known.

    If it is not the u of that step, tell the controller, before it takes the next one.
    """
    if not is_finite(u):
        return
    acting, row, different = controller.supervisor.signals.acting, controller.log.row, False
    at = recordings.R + 3 * controller.supervisor.signals.y.size
    acting[0] = u
    read_acting(handle, acting)
    for c in range(acting.size):
        different |= acting[c] != row[at + c]
        row[at + c] = acting[c]
    if different and controller.supervisor.memory[0].mode != Mode.STOPPED:
        design, state = controller.design, controller.state
        set_applied_controls(design, state, acting)
        write_applied(design, state, acting, row[controller.log.controller :])


@kernel
def count_fault(supervisor: SupervisorState, fault: int) -> None:
    """Keep what ``write_signals`` has returned."""
    memory = supervisor.memory[0]
    memory.unsent_in_row = memory.unsent_in_row + 1 if fault == 1 else 0
    memory.tripped = 1 if fault > 1 else 0
    supervisor.counters[0].unsent += 1 if fault == 1 else 0


@kernel
def count_cycle(supervisor: SupervisorState, overran: bool) -> None:
    """Count a cycle, and whether it took longer than a sample."""
    memory, counters = supervisor.memory[0], supervisor.counters[0]
    memory.overruns_in_row = memory.overruns_in_row + 1 if overran else 0
    counters.overruns += 1 if overran else 0
    counters.cycles += 1


@kernel
def cycle_events(controller: Any, overran: bool, fault: int, changed: int, clipped: int) -> int:
    """Return the ``Event`` flags; ``changed`` and ``clipped`` are counters before the step."""
    supervisor, missed = controller.supervisor, False
    for i in range(supervisor.signals.y.size):
        missed |= not is_finite(supervisor.signals.y[i])
    return (
        (_MISSED if missed else 0)
        + (_OVERRAN if overran else 0)
        + (_CLIPPED if supervisor.counters[0].clipped > clipped else 0)
        + (_UNSENT if fault == 1 else 0)
        + (_CHANGED if supervisor.changed[0] > changed else 0)
        + (_CHANNEL if controller.inputs.missing[0] != 0 else 0)
    )


@kernel
def fill_row(controller: Any, k: int, lateness: int, step_time: int, events: int) -> None:
    """Write time, mode, events and signals into the row."""
    log, signals = controller.log, controller.supervisor.signals
    row, at, n = log.row, recordings.R, signals.y.size
    row[recordings.K] = k
    row[recordings.LATENESS] = 1e-9 * lateness
    row[recordings.STEP_TIME] = 1e-9 * step_time
    row[recordings.MODE] = controller.supervisor.memory[0].mode
    row[recordings.EVENTS] = events
    for i in range(n):
        row[at + i] = signals.r[i]
        row[at + n + i] = signals.watched[i].y
        row[at + 2 * n + i] = signals.y[i]
    for c in range(signals.u.size):
        row[at + 3 * n + c] = signals.u[c]
    count_duration(log.lateness, lateness)
    count_duration(log.step_time, step_time)


@kernel
def _count_skipped(supervisor: SupervisorState, deadlines: int) -> None:
    """Count deadlines that are skipped: nothing is known of their samples."""
    memory = supervisor.memory[0]
    supervisor.counters[0].skipped += deadlines
    memory.missed_in_row += deadlines
    memory.skipped_in_row += deadlines


@generic
def control_step(controller: Any, k: int, left_out: int) -> None:
    """Take a sample of supervisor and controller: find the u to apply.

    First the controller takes the ``left_out`` deadlines before k as samples without measurement.
    Channels of the controller are written into the row.
    """
    raise TypeError


@control_step.register(SupervisedController)
def _control_step(controller: SupervisedController, k: int, left_out: int) -> None:
    design, state, rules = controller.design, controller.state, controller.rules
    supervisor, reference, row = controller.supervisor, controller.reference, controller.log.row
    memory, signals = supervisor.memory[0], supervisor.signals
    store_release(supervisor.steps, 0, supervisor.steps[0] + 1)
    update_mode(rules, supervisor, k, samples_of(reference))
    first = k - min(left_out, rules.hold)
    if memory.mode == Mode.RUN and memory.began == k:
        bumpless_transfer(design, state)
        for i in range(signals.y.size):
            signals.offset[i] = signals.y[i] - first_of(reference, i)
        first = k
    awake = memory.mode != Mode.STOPPED and all_measured(supervisor)
    pass_channels(controller.inputs, design, state, rules.hold)
    record_channels(controller.inputs, row[controller.log.channels :])
    for c in range(signals.u.size):
        signals.wished[c] = 0.0
    for i in range(first, k + 1):
        set_references(reference, design, state, memory, signals, i)
        for j in range(signals.y.size):
            signals.measured[j] = signals.y[j] if i == k else np.nan
        if awake:
            control_all(design, state, reference.given, signals.measured, signals.wished)
            if i < k:
                set_applied_controls(design, state, signals.u)
    own = row[controller.log.controller : controller.log.channels]
    write_row(design, state, own)
    for i in range(signals.f_hat.size):
        learned, residual = controller.f_hat[i, 0], controller.f_hat[i, 1]
        signals.f_hat[i] = row[learned] + row[residual] if learned >= 0 else 0.0
    supervise_controls(rules, supervisor, k)
    different = False
    for c in range(signals.u.size):
        different |= signals.u[c] != signals.wished[c]
    if awake and different:
        set_applied_controls(design, state, signals.u)
        supervisor.counters[0].clipped += 1 if memory.mode == Mode.RUN else 0
    write_applied(design, state, signals.u, own)
    motion_by(design, state, rules.b0, signals.u, signals.v)
    store_release(supervisor.steps, 0, supervisor.steps[0] + 1)


@generic
def samples_of(reference: Any) -> int:
    """Return after how many samples a reference is over."""
    raise TypeError


@generic
def first_of(reference: Any, i: int) -> float:
    """Return the first sample of a reference, of axis i."""
    raise TypeError


@generic
def set_references(
    reference: Any, design: Any, state: Any, memory: Memory, signals: LoopSignals, k: int
) -> None:
    """Set ``reference.given``, what controllers get in sample k: y before the scenario begins."""
    raise TypeError


@samples_of.register(ReferenceSamples)
def _samples(reference: ReferenceSamples) -> int:
    return reference.r.shape[0]


@first_of.register(ReferenceSamples)
def _first(reference: ReferenceSamples, i: int) -> float:
    return reference.r[0, i]


@set_references.register(ReferenceSamples)
def _set_references(
    reference: ReferenceSamples,
    design: Any,
    state: Any,
    memory: Memory,
    signals: LoopSignals,
    k: int,
) -> None:
    if memory.began < 0:
        for i in range(signals.r.size):
            signals.r[i] = reference.given[i] = signals.watched[i].y
        return
    at = min(k - memory.began, reference.r.shape[0] - 1)
    approaches, place = at < reference.approach.shape[0], 0
    for i in range(signals.r.size):
        offset = signals.offset[i] if approaches else 0.0
        signals.r[i] = reference.r[at, i]
        if offset != 0.0:
            signals.r[i] += offset * reference.approach[at, 0]
        reference.given[i] = signals.r[i]
        for j in range(reference.counts[i]):
            reference.current[place] = reference.derivatives[at, place]
            if offset != 0.0:
                reference.current[place] += offset * reference.approach[at, 1 + j]
            place += 1
    if place > 0:
        set_reference_derivatives(design, state, reference.current)


# ---- The loop around a device with a clock of its own ----

# Time that the device has for its first measurement, and time between two looks at the requests
# meanwhile [ns]; for slow devices at least five ticks and two. Chosen by hand: a rig ticks before
# it answers the first frame.
_FIRST, _LOOK = 2_000_000_000, 20_000_000
_FIRST_TICKS, _LOOK_TICKS = 5.0, 2.0
# A measurement is given up half a sample after its tick: the other half is for the controller.
_TIMEOUT = 0.5
# Shares of a sample: the largest shift of the grid towards later, which undoes forty shifts towards
# earlier (chosen by hand), and a shift towards earlier. That is 50 ppm, the tolerance of a quartz
# clock: the grid never falls behind one.
_LATER, _EARLIER = 500.0, 20_000.0


@compiled
def follow_ticks(handle: Any, clock: Any, period: float, controller: SupervisedController) -> None:
    """Run until the supervisor has stopped the device; its ticks are ``period`` [ns] apart."""
    supervisor, log = controller.supervisor, controller.log
    memory, counters = supervisor.memory[0], supervisor.counters[0]
    origin = 0
    if not finished(supervisor):
        origin = _first_tick(handle, clock, supervisor, period)
    k = ahead = invented = 0  # ``ahead``: steps to take until that of the tick which came last
    ready = origin  # when the loop last had to wait for the device
    tick = Tick(np.nan, 0, np.nan, 0, 0)
    while not finished(supervisor):
        due = origin + int(k * period)
        expected = max(due, ready)
        caught_up, overslept = tick.left == 0 and ahead == 0, 0
        woke = wait_until(clock, due) if caught_up else now(clock)
        late = woke - expected
        if ahead == 0:
            tick = _next_tick(handle, clock, period, controller, expected, invented)
            taken = now(clock)
            overslept = _overslept(controller, period, late if caught_up else 0, taken - expected)
            invented -= tick.steps
            if invented < 0:
                ahead, invented = -invented, 0
                if tick.waited > 0:
                    ready = taken
                    origin += min(tick.waited, max(int(period / _LATER), 1))
                elif late < period:
                    origin -= max(int(period / _EARLIER), 1)
            else:  # the device is silent: the loop goes on by its own clock
                ahead = 1 + max(int((taken - expected) / period), 0)
                invented += ahead
        ahead -= 1
        if ahead == 0:
            take_inputs(controller, handle, tick.y)
        else:
            _skip_inputs(controller)
        superseded = ahead > 0 or tick.left > 0
        taken = now(clock)
        if k > 0:
            _finish_signals(controller, handle, tick.u)
            push(log.ring, log.row)
        if overslept > 0:
            memory.skipped_in_row = overslept
            memory.missed_in_row += overslept
        changed, clipped = supervisor.changed[0], counters.clipped
        control_step(controller, k, 0)
        fault = 0
        if superseded:
            counters.skipped += 1
        else:
            fault = write_signals(handle, supervisor.signals.u)
            count_fault(supervisor, fault)
        written = now(clock)
        overran = overslept > 0 or written - taken >= period
        count_cycle(supervisor, overran)
        events = cycle_events(controller, overran, fault, changed, clipped)
        fill_row(controller, k, late, written - taken, events)
        k += 1
    if k > 0:
        push(log.ring, log.row)


@kernel
def _overslept(controller: SupervisedController, period: float, late: int, silent: int) -> int:
    """Return by how many samples the loop itself was late.

    It woke ``late`` [ns] behind the tick, or it slept while it waited: that took ``silent`` [ns],
    longer than u is held.
    """
    waited = int(silent / period)
    return max(int(late / period), waited if waited > controller.rules.hold + 1 else 0, 0)


@kernel
def _first_tick(handle: Any, clock: Any, supervisor: SupervisorState, period: float) -> int:
    """Wait for a tick; return the time of the next one, that of cycle 0 [ns]."""
    begin = now(clock)
    left = 1
    while left > 0:  # ticks that have come before
        left = read_tick(handle, clock, begin).left
    while (
        now(clock) < begin + max(_FIRST, int(_FIRST_TICKS * period))
        and load_acquire(supervisor.requests, 0) == Request.NONE
    ):
        before = now(clock)
        ask(handle)
        tick = read_tick(handle, clock, before + max(_LOOK, int(_LOOK_TICKS * period)))
        after = now(clock)
        if is_finite(tick.y) and tick.left == 0:
            return after + int(period)
        if after == before:  # the device does not wait, and no time passes
            break
    change_mode(supervisor, 0, Mode.STOPPED, Cause.NO_MEASUREMENT)
    return now(clock) + int(period)


@kernel
def _next_tick(
    handle: Any,
    clock: Any,
    period: float,
    controller: SupervisedController,
    expected: int,
    invented: int,
) -> Tick:
    """Return the next tick; none if it does not come within the time for which u is held.

    ``expected`` is the time at which it should come [ns]. The loop has taken ``invented`` steps by
    its own clock since the device fell silent: older ticks are left out.
    """
    supervisor = controller.supervisor
    memory = supervisor.memory[0]
    holds = memory.mode <= Mode.HOLD and memory.missed_in_row <= controller.rules.hold
    most = controller.rules.hold if holds else 0
    until = expected + int((most + _TIMEOUT) * period)
    behind, waited, samples = 0, 0, 1
    while True:
        end = min(until, expected + int(samples * period))
        tick = read_tick(handle, clock, end)
        waited += tick.waited
        behind += tick.steps
        if behind > invented:
            return Tick(tick.y, behind, tick.u, tick.left, waited)
        time = now(clock)
        if tick.steps > 0 and time < until:
            continue
        asked = load_acquire(supervisor.requests, 0)
        if time >= until or (asked != Request.NONE and memory.mode <= Mode.HOLD):
            break
        fault = write_signals(handle, supervisor.signals.u)
        count_fault(supervisor, fault)
        if fault > 1 or memory.unsent_in_row > controller.rules.hold:
            break
        samples = 1 + max(int((time - expected) / period), samples)
    drop_signals(handle)
    return Tick(np.nan, behind, np.nan, 0, waited)


# ---- A compiled control step in an interpreted loop, for devices that need Python ----


class CompiledController(NamedTuple):
    """A supervised controller for ``run_cycles``, with its compiled control step."""

    supervisor: SupervisorState
    log: CycleLog
    inputs: ChannelInputs
    controller: SupervisedController
    step: Callable[[Any, int, int], None]


@compiled
def _step(controller: Any, k: int, left_out: int) -> None:
    control_step(controller, k, left_out)


@control_step.register(CompiledController)
def _call_step(controller: CompiledController, k: int, left_out: int) -> None:
    controller.step(controller.controller, k, left_out)


def compiled_controller(controller: SupervisedController) -> CompiledController:
    """Return the controller with its compiled control step."""
    step = specialised(_step, controller, 0, 0)
    inputs = controller.inputs
    return CompiledController(controller.supervisor, controller.log, inputs, controller, step)


# ---- A control loop ----


def supervise(
    controller: Any,
    reference: Any,
    rules: Rules,
    ring: Ring,
    channels: Sequence[str] = (),
    state: Any = None,
) -> SupervisedController:
    """Return a supervised controller for ``control_step``; arguments are those of ``of`` below."""
    counts = outputs_of(controller), inputs_of(controller)
    columns = row_channels(controller.channels, channels, *counts)
    row = np.zeros(sum(width for _, width in columns))
    before = [f"{name}." if name else "" for name in axes_of(controller)]
    return SupervisedController(
        design=controller.parameters,
        state=controller.initial_state() if state is None else state,
        rules=rules.limits,
        supervisor=initial_state(*counts),
        reference=reference,
        log=CycleLog(
            ring=ring,
            row=row,
            channels=row.size - len(channels),
            controller=sum(width for _, width in loop_channels(*counts)),
            lateness=system.empty_counts(),
            step_time=system.empty_counts(),
        ),
        inputs=channel_inputs(controller, channels),
        f_hat=np.array([_places_of_f(columns, each) for each in before]),
    )


@dataclass(frozen=True, eq=False)
class ControlLoop:
    """A supervised controller around a device; ``of`` makes and compiles one.

    If the device needs Python, the loop is interpreted and only its control step is compiled;
    ``interpret`` makes both plain Python, to debug.
    """

    handle: Any
    clock: Any
    period: float  # sample time [ns]
    controller: SupervisedController
    paced: bool  # whether the device's ticks pace the loop, and not the loop's own deadlines
    interpret: bool = False

    @classmethod
    def of(
        cls,
        device: devices.Device,
        controller: Any,
        reference: Any,
        rules: Rules,
        clock: Any,
        ring: Ring,
        *,
        channels: Sequence[str] = (),
        state: Any = None,
        interpret: bool = False,
    ) -> ControlLoop:
        """Return the compiled loop of a device and a controller.

        It runs on ``state``; by default on a new one with nothing learned. ``channels`` are those
        of the device, as ``checked_channels`` returns them.
        """
        supervised = supervise(controller, reference, rules, ring, channels, state)
        handle = devices.handle_of(device)
        paced = getattr(device, "paced", False) and not isinstance(handle, devices.PythonHandle)
        loop = cls(handle, clock, controller.dt * 1e9, supervised, paced, interpret)
        loop._compile()
        return loop

    @property
    def interpreted(self) -> bool:
        """Whether the loop runs as plain Python."""
        return self.interpret or isinstance(self.handle, devices.PythonHandle)

    @property
    def timing(self) -> system.Timing:
        """Punctuality so far."""
        log = self.controller.log
        return system.Timing(system.Histogram.of(log.lateness), system.Histogram.of(log.step_time))

    def run(self) -> None:
        """Run all cycles."""
        controller: Any = self.controller
        entry: Any = follow_ticks if self.paced else run_cycles
        if self.interpreted:
            entry = interpreted(entry)
            controller = controller if self.interpret else compiled_controller(controller)
        else:
            entry = specialised(entry, self.handle, self.clock, self.period, controller)
        with np.errstate(over="ignore", invalid="ignore"):
            entry(self.handle, self.clock, self.period, controller)

    def _compile(self) -> None:
        """Compile by a run that is finished before it begins, or by a step after its end."""
        finished = copy.deepcopy(self.controller.supervisor)
        finished.memory[0].mode, finished.memory[0].samples = Mode.STOPPED, FLUSH + 1
        state = copy.deepcopy(self.controller.state)
        over = self.controller._replace(supervisor=finished, state=state)
        with explain_compile_errors(self.handle, self.controller.design):
            replace(self, controller=over).run()
            if self.interpreted and not self.interpret:
                control_step(compiled_controller(over), 0, 0)


def _places_of_f(columns: Channels, prefix: str) -> tuple[int, int]:
    """Return the places in a row of the learned and of the observer's part of f̂; −1 without.

    Names of channels of an axis begin with ``prefix``.
    """
    names, known = ("f_learned", "f_residual"), {name for name, width in columns if width}
    if not {f"{prefix}{name}" for name in names} <= known:
        return -1, -1
    learned, residual = (columns_of(columns, f"{prefix}{name}").start for name in names)
    return learned, residual
