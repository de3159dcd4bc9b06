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

from quell.controllers.allocation import apply_to_axes
from quell.controllers.axes import Axes
from quell.controllers.base import (
    bumpless_transfer,
    control,
    set_applied_control,
    set_reference_derivatives,
    write_row,
)
from quell.controllers.several import control_all
from quell.kernels.dispatch import (
    compiled,
    explain_compile_errors,
    generic,
    generic_with_default,
    interpreted,
    is_finite,
    kernel,
    specialised,
)
from quell.kernels.sized import Size
from quell.realtime import recordings
from quell.realtime.axes_supervisor import (
    AxesMemory,
    all_measured,
    axes_memory,
    set_applied_controls,
    supervise_outputs,
    update_axes_mode,
)
from quell.realtime.channels import (
    ChannelInputs,
    channel_inputs,
    pass_channels,
    read_inputs,
    record_channels,
)
from quell.realtime.devices import (
    Device,
    PythonHandle,
    Tick,
    ask,
    drop_signals,
    handle_of,
    read_acting,
    read_measurement,
    read_signals,
    read_tick,
    write_command,
    write_signals,
)
from quell.realtime.recordings import Event, loop_channels, row_channels
from quell.realtime.safety import AxesReference, ReferenceSamples
from quell.realtime.supervisor import (
    FLUSH,
    AxesLimits,
    Cause,
    Memory,
    Mode,
    Request,
    Rules,
    SupervisorState,
    change_mode,
    finished,
    initial_state,
    supervised_output,
    update_mode,
)
from quell.realtime.system import (
    Histogram,
    Timing,
    count_duration,
    empty_counts,
    load_acquire,
    now,
    store_release,
    wait_until,
)
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
    f_learned: int  #: index of the learned part of f̂ in a row; −1 if the controller reports none
    f_residual: int  #: index of the observer's part of f̂
    channels: int  #: index of the device's channels, behind the controller's
    controller: Size  #: index of the controller's channels
    lateness: NDArray[np.int64]  #: histogram, see ``count_duration``
    step_time: NDArray[np.int64]  #: histogram


class SupervisedController(NamedTuple):
    """A controller, its supervisor, its reference and its log: the arguments of a control step."""

    design: Any  #: parameters of the controller
    state: Any  #: state of the controller
    rules: Rules
    supervisor: SupervisorState
    reference: Any  #: ``ReferenceSamples``, or another one with ``set_reference``
    log: CycleLog
    inputs: ChannelInputs  #: what the device gives beside y


@compiled
def run_cycles(handle: Any, clock: Any, period: float, controller: Any) -> None:
    """Run until the supervisor has stopped the device; a sample lasts ``period`` [ns].

    ``controller`` is a ``SupervisedController``, or a ``CompiledController`` around one.
    """
    supervisor, log = controller.supervisor, controller.log
    memory, counters = supervisor.memory[0], supervisor.counters[0]
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
        take_inputs(controller, handle)
        changed, clipped = supervisor.changed[0], counters.clipped
        u = control_step(controller, k, left_out, y)
        fault = send_control(controller, handle, u)
        count_fault(supervisor, fault)
        written = now(clock)
        due = origin + int((k + 1) * period)
        missed_next = 1 + int((written - due) / period) if written >= due else 0
        overran = overslept + missed_next > 0
        count_cycle(supervisor, overran)
        events = cycle_events(supervisor, y, overran, fault, changed, clipped)
        events += _channel_event(controller.inputs)
        fill_row(log, memory, k, lateness, written - woke - waited, events)
        fill_signals(controller, y)
        push(log.ring, log.row)
        _count_skipped(supervisor, missed_next)
        left_out = missed_next
        k += 1 + missed_next


@generic
def take_inputs(controller: Any, handle: Any) -> None:
    """Take what the device gave beside the number that the loop has: channels, or all signals."""
    raise TypeError


@generic_with_default
def skip_inputs(controller: Any) -> None:
    """Take a sample without measurements."""


@generic
def send_control(controller: Any, handle: Any, u: float) -> int:
    """Let the device apply u, or all control signals; return what ``write_command`` does."""
    raise TypeError


@generic
def fill_signals(controller: Any, y: float) -> None:
    """Write y and u of this cycle into the row; ``y`` is as the device gave it."""
    raise TypeError


@generic
def finish_signals(controller: Any, handle: Any, u: float) -> None:
    """Correct u of the row before by what acts since then, ``u``; NaN if it is not known.

    If it is not the u of that step, tell the controller, before it takes the next one.
    """
    raise TypeError


@take_inputs.register(SupervisedController)
def _take_channels(controller: SupervisedController, handle: Any) -> None:
    read_inputs(controller.inputs, handle)


@send_control.register(SupervisedController)
def _send_control(controller: SupervisedController, handle: Any, u: float) -> int:
    return write_command(handle, u)


@fill_signals.register(SupervisedController)
def _fill_signals(controller: SupervisedController, y: float) -> None:
    row, memory = controller.log.row, controller.supervisor.memory[0]
    row[recordings.Y] = memory.y
    row[recordings.Y_MEASURED] = y
    row[recordings.U] = memory.u


@finish_signals.register(SupervisedController)
def _finish_signals(controller: SupervisedController, handle: Any, u: float) -> None:
    row = controller.log.row
    if is_finite(u) and u != row[recordings.U]:
        row[recordings.U] = u
        if controller.supervisor.memory[0].mode != Mode.STOPPED:
            set_applied_control(controller.design, controller.state, u)


@kernel
def _channel_event(inputs: ChannelInputs) -> int:
    """Return the ``Event`` flag of a missing channel."""
    return _CHANNEL if inputs.missing[0] != 0 else 0


@kernel
def count_fault(supervisor: SupervisorState, fault: int) -> None:
    """Keep what ``write_command`` has returned."""
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
def cycle_events(
    supervisor: SupervisorState, y: float, overran: bool, fault: int, changed: int, clipped: int
) -> int:
    """Return the ``Event`` flags; ``changed`` and ``clipped`` are counters before the step."""
    return (
        (0 if is_finite(y) else _MISSED)
        + (_OVERRAN if overran else 0)
        + (_CLIPPED if supervisor.counters[0].clipped > clipped else 0)
        + (_UNSENT if fault == 1 else 0)
        + (_CHANGED if supervisor.changed[0] > changed else 0)
    )


@kernel
def fill_row(
    log: CycleLog, memory: Memory, k: int, lateness: int, step_time: int, events: int
) -> None:
    """Write time, mode and events into the row."""
    row = log.row
    row[recordings.K] = k
    row[recordings.LATENESS] = 1e-9 * lateness
    row[recordings.STEP_TIME] = 1e-9 * step_time
    row[recordings.MODE] = memory.mode
    row[recordings.EVENTS] = events
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
def control_step(controller: Any, k: int, left_out: int, y: float) -> float:
    """Take a sample of supervisor and controller; return the u to apply.

    First the controller takes the ``left_out`` deadlines before k as samples without measurement.
    Reference and channels of the controller are written into the row.
    """
    raise TypeError


@control_step.register(SupervisedController)
def _control_step(controller: SupervisedController, k: int, left_out: int, y: float) -> float:
    design, state, rules = controller.design, controller.state, controller.rules
    supervisor, reference, row = controller.supervisor, controller.reference, controller.log.row
    memory = supervisor.memory[0]
    store_release(supervisor.steps, 0, supervisor.steps[0] + 1)
    update_mode(rules, supervisor, k, y, samples_of(reference))
    first = k - min(left_out, rules.hold)
    if memory.mode == Mode.RUN and memory.began == k:
        bumpless_transfer(design, state)
        memory.offset = y - first_of(reference, 0)
        first = k
    awake = memory.mode != Mode.STOPPED and is_finite(memory.y)
    pass_channels(controller.inputs, design, state, rules.hold)
    record_channels(controller.inputs, row[controller.log.channels :])
    r, wished, f_hat = 0.0, 0.0, 0.0
    for i in range(first, k + 1):
        r = set_reference(reference, design, state, memory, i)
        if awake:
            wished = control(design, state, r, y if i == k else np.nan)
            if i < k:
                set_applied_control(design, state, memory.u)
    write_row(design, state, row[controller.log.controller : controller.log.channels])
    if controller.log.f_learned >= 0:
        f_hat = row[controller.log.f_learned] + row[controller.log.f_residual]
    u = supervised_output(rules, supervisor, k, wished, r, f_hat)
    if awake and u != wished:
        set_applied_control(design, state, u)
        supervisor.counters[0].clipped += 1 if memory.mode == Mode.RUN else 0
    row[recordings.R] = r
    store_release(supervisor.steps, 0, supervisor.steps[0] + 1)
    return u


@generic
def samples_of(reference: Any) -> int:
    """Return after how many samples a reference is over."""
    raise TypeError


@generic
def first_of(reference: Any, i: int) -> float:
    """Return the first sample of a reference, of axis i."""
    raise TypeError


@generic
def set_reference(reference: Any, design: Any, state: Any, memory: Memory, k: int) -> float:
    """Return the reference of sample k (y before the scenario begins); pass its derivatives on."""
    raise TypeError


@samples_of.register(ReferenceSamples)
def _samples(reference: ReferenceSamples) -> int:
    return reference.r.size


@first_of.register(ReferenceSamples)
def _first(reference: ReferenceSamples, i: int) -> float:
    return reference.r[0]


@set_reference.register(ReferenceSamples)
def _set_reference(
    reference: ReferenceSamples, design: Any, state: Any, memory: Memory, k: int
) -> float:
    if memory.began < 0:
        return memory.y
    i = min(k - memory.began, reference.r.size - 1)
    offset = memory.offset if i < reference.approach.shape[0] else 0.0
    r = reference.r[i]
    if offset != 0.0:
        r += offset * reference.approach[i, 0]
    if reference.current.size > 0:
        for j in range(reference.current.size):
            reference.current[j] = reference.derivatives[i, j]
            if offset != 0.0:
                reference.current[j] += offset * reference.approach[i, 1 + j]
        set_reference_derivatives(design, state, reference.current)
    return r


# ---- The control step of several axes ----


class SupervisedAxes(NamedTuple):
    """Several axes with their supervisor; the numbers y and u of the loop stand for all of them.

    y is the first measurement if all came, else NaN, and u the first control signal.
    """

    design: Any  #: parameters of the controller
    state: Any  #: state of the controller
    rules: AxesLimits
    supervisor: SupervisorState
    reference: Any  #: ``AxesReference``, or another one with ``set_references``
    log: CycleLog
    inputs: ChannelInputs
    axes: AxesMemory
    f_hat: NDArray[np.int64]
    """Places in a row of the learned and of the observer's part of f̂ of each axis; −1 (n, 2)."""


@take_inputs.register(SupervisedAxes)
def _take_signals(controller: SupervisedAxes, handle: Any) -> None:
    read_signals(handle, controller.axes.y)
    read_inputs(controller.inputs, handle)


@skip_inputs.register(SupervisedAxes)
def _skip_signals(controller: SupervisedAxes) -> None:
    for i in range(controller.axes.y.size):
        controller.axes.y[i] = np.nan


@send_control.register(SupervisedAxes)
def _send_all(controller: SupervisedAxes, handle: Any, u: float) -> int:
    return write_signals(handle, controller.axes.u)


@fill_signals.register(SupervisedAxes)
def _fill_all(controller: SupervisedAxes, y: float) -> None:
    row, axes = controller.log.row, controller.axes
    count, at = axes.y.size, recordings.R
    for i in range(count):
        row[at + i] = axes.r[i]
        row[at + count + i] = axes.good[i]
        row[at + 2 * count + i] = axes.y[i]
    for c in range(axes.u.size):
        row[at + 3 * count + c] = axes.u[c]


@finish_signals.register(SupervisedAxes)
def _finish_all(controller: SupervisedAxes, handle: Any, u: float) -> None:
    if not is_finite(u):
        return
    axes, row, different = controller.axes, controller.log.row, False
    at = recordings.R + 3 * axes.y.size
    read_acting(handle, axes.acting)
    for c in range(axes.u.size):
        different |= axes.acting[c] != row[at + c]
        row[at + c] = axes.acting[c]
    if different and controller.supervisor.memory[0].mode != Mode.STOPPED:
        set_applied_controls(controller.design, controller.state, axes.acting)
        _fill_v(controller, axes.acting)


@kernel
def _fill_v(controller: SupervisedAxes, u: Vector) -> None:
    """Write ``v = B0 u`` of what is applied into the row: the controller's first channel."""
    at = controller.log.controller
    apply_to_axes(controller.state.gain, u, controller.log.row[at : at + controller.axes.y.size])


@control_step.register(SupervisedAxes)
def _control_axes(controller: SupervisedAxes, k: int, left_out: int, y: float) -> float:
    design, state, rules = controller.design, controller.state, controller.rules
    supervisor, reference, row = controller.supervisor, controller.reference, controller.log.row
    memory, axes = supervisor.memory[0], controller.axes
    store_release(supervisor.steps, 0, supervisor.steps[0] + 1)
    update_axes_mode(rules, supervisor, axes, k, samples_of(reference))
    first = k - min(left_out, rules.hold)
    if memory.mode == Mode.RUN and memory.began == k:
        bumpless_transfer(design, state)
        for i in range(axes.y.size):
            axes.offset[i] = axes.y[i] - first_of(reference, i)
        first = k
    awake = memory.mode != Mode.STOPPED and all_measured(axes)
    pass_channels(controller.inputs, design, state, rules.hold)
    record_channels(controller.inputs, row[controller.log.channels :])
    for c in range(axes.u.size):
        axes.wished[c] = 0.0
    for i in range(first, k + 1):
        set_references(reference, design, state, memory, axes, i)
        for j in range(axes.y.size):
            axes.measured[j] = axes.y[j] if i == k else np.nan
        if awake:
            control_all(design, state, reference.given, axes.measured, axes.wished)
            if i < k:
                set_applied_controls(design, state, axes.u)
    write_row(design, state, row[controller.log.controller : controller.log.channels])
    for i in range(axes.f_hat.size):
        learned, residual = controller.f_hat[i, 0], controller.f_hat[i, 1]
        axes.f_hat[i] = row[learned] + row[residual] if learned >= 0 else 0.0
    supervise_outputs(rules, supervisor, axes, k)
    different = False
    for c in range(axes.u.size):
        different |= axes.u[c] != axes.wished[c]
    if awake and different:
        set_applied_controls(design, state, axes.u)
        supervisor.counters[0].clipped += 1 if memory.mode == Mode.RUN else 0
    _fill_v(controller, axes.u)
    for i in range(axes.watched.size):
        axes.watched[i].u = row[controller.log.controller + i]
    store_release(supervisor.steps, 0, supervisor.steps[0] + 1)
    return axes.u[0]


@generic
def set_references(
    reference: Any, design: Any, state: Any, memory: Memory, axes: AxesMemory, k: int
) -> None:
    """Set ``reference.given``, what controllers get in sample k: y before the scenario begins."""
    raise TypeError


@samples_of.register(AxesReference)
def _axes_samples(reference: AxesReference) -> int:
    return reference.r.shape[0]


@first_of.register(AxesReference)
def _first_of_axis(reference: AxesReference, i: int) -> float:
    return reference.r[0, i]


@set_references.register(AxesReference)
def _set_references(
    reference: AxesReference, design: Any, state: Any, memory: Memory, axes: AxesMemory, k: int
) -> None:
    if memory.began < 0:
        for i in range(axes.r.size):
            axes.r[i] = reference.given[i] = axes.good[i]
        return
    at = min(k - memory.began, reference.r.shape[0] - 1)
    approaches, place = at < reference.approach.shape[0], 0
    for i in range(axes.r.size):
        offset = axes.offset[i] if approaches else 0.0
        axes.r[i] = reference.r[at, i]
        if offset != 0.0:
            axes.r[i] += offset * reference.approach[at, 0]
        reference.given[i] = axes.r[i]
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
        y = tick.y if ahead == 0 else np.nan
        if ahead == 0:
            take_inputs(controller, handle)
        else:
            skip_inputs(controller)
        superseded = ahead > 0 or tick.left > 0
        taken = now(clock)
        if k > 0:
            finish_signals(controller, handle, tick.u)
            push(log.ring, log.row)
        if overslept > 0:
            memory.skipped_in_row = overslept
            memory.missed_in_row += overslept
        changed, clipped = supervisor.changed[0], counters.clipped
        u = control_step(controller, k, 0, y)
        fault = 0
        if superseded:
            counters.skipped += 1
        else:
            fault = send_control(controller, handle, u)
            count_fault(supervisor, fault)
        written = now(clock)
        overran = overslept > 0 or written - taken >= period
        count_cycle(supervisor, overran)
        events = cycle_events(supervisor, y, overran, fault, changed, clipped)
        events += _channel_event(controller.inputs)
        fill_row(log, memory, k, late, written - taken, events)
        fill_signals(controller, y)
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
        fault = send_control(controller, handle, memory.u)
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
    controller: Any  #: a ``SupervisedController``, or ``SupervisedAxes``
    step: Callable[[Any, int, int, float], float]


@compiled
def _step(controller: Any, k: int, left_out: int, y: float) -> float:
    return control_step(controller, k, left_out, y)


@take_inputs.register(CompiledController)
def _take_inputs_of(controller: CompiledController, handle: Any) -> None:
    take_inputs(controller.controller, handle)


@send_control.register(CompiledController)
def _send_control_of(controller: CompiledController, handle: Any, u: float) -> int:
    return send_control(controller.controller, handle, u)


@fill_signals.register(CompiledController)
def _fill_signals_of(controller: CompiledController, y: float) -> None:
    fill_signals(controller.controller, y)


@control_step.register(CompiledController)
def _call_step(controller: CompiledController, k: int, left_out: int, y: float) -> float:
    return float(controller.step(controller.controller, k, left_out, y))


def compiled_controller(controller: Any) -> CompiledController:
    """Return the controller with its compiled control step."""
    step = specialised(_step, controller, 0, 0, 0.0)
    inputs = controller.inputs
    return CompiledController(controller.supervisor, controller.log, inputs, controller, step)


# ---- A control loop ----


def supervise(
    controller: Any,
    reference: Any,
    rules: Any,
    ring: Ring,
    channels: Sequence[str] = (),
    state: Any = None,
) -> Any:
    """Return a supervised controller for ``control_step``; arguments are those of ``of`` below."""
    axes = isinstance(controller, Axes)
    counts = (controller.outputs, controller.inputs) if axes else (1, 1)
    columns = row_channels(controller.channels, channels, *counts)
    row = np.zeros(sum(width for _, width in columns))
    f_learned, f_residual = _places_of_f(columns)
    log = CycleLog(
        ring=ring,
        row=row,
        f_learned=f_learned,
        f_residual=f_residual,
        channels=row.size - len(channels),
        controller=sum(width for _, width in loop_channels(*counts)),
        lateness=empty_counts(),
        step_time=empty_counts(),
    )
    common: dict[str, Any] = {
        "design": controller.parameters,
        "state": controller.initial_state() if state is None else state,
        "supervisor": initial_state(),
        "reference": reference,
        "log": log,
        "inputs": channel_inputs(controller, channels),
    }
    supervised: Any
    if axes:
        places = np.array([_places_of_f(columns, f"{name}.") for name in controller.names])
        memory = axes_memory(*counts)
        supervised = SupervisedAxes(rules=rules.limits, axes=memory, f_hat=places, **common)
    else:
        supervised = SupervisedController(rules=rules, **common)
    return supervised


@dataclass(frozen=True, eq=False)
class ControlLoop:
    """A supervised controller around a device; ``of`` makes and compiles one.

    If the device needs Python, the loop is interpreted and only its control step is compiled;
    ``interpret`` makes both plain Python, to debug.
    """

    handle: Any
    clock: Any
    period: float  # sample time [ns]
    controller: Any  # a ``SupervisedController``, or ``SupervisedAxes``
    paced: bool  # whether the device's ticks pace the loop, and not the loop's own deadlines
    interpret: bool = False

    @classmethod
    def of(
        cls,
        device: Device,
        controller: Any,
        reference: Any,
        rules: Any,
        clock: Any,
        ring: Ring,
        *,
        channels: Sequence[str] = (),
        state: Any = None,
        interpret: bool = False,
    ) -> ControlLoop:
        """Return the compiled loop of a device and a controller.

        It runs on ``state``; by default on a new one with nothing learned. ``channels`` are those
        of the device, as ``checked_channels`` returns them. Reference and rules of several axes are
        an ``AxesReference`` and ``AxesRules``.
        """
        supervised = supervise(controller, reference, rules, ring, channels, state)
        handle = handle_of(device)
        paced = getattr(device, "paced", False) and not isinstance(handle, PythonHandle)
        loop = cls(handle, clock, controller.dt * 1e9, supervised, paced, interpret)
        loop._compile()
        return loop

    @property
    def interpreted(self) -> bool:
        """Whether the loop runs as plain Python."""
        return self.interpret or isinstance(self.handle, PythonHandle)

    @property
    def timing(self) -> Timing:
        """Punctuality so far."""
        log = self.controller.log
        return Timing(Histogram.of(log.lateness), Histogram.of(log.step_time))

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
                control_step(compiled_controller(over), 0, 0, 0.0)


def _places_of_f(columns: Channels, prefix: str = "") -> tuple[int, int]:
    """Return the places in a row of the learned and of the observer's part of f̂; −1 without."""
    names, known = ("f_learned", "f_residual"), {name for name, width in columns if width}
    if not {f"{prefix}{name}" for name in names} <= known:
        return -1, -1
    learned, residual = (columns_of(columns, f"{prefix}{name}").start for name in names)
    return learned, residual
