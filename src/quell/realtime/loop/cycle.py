"""The loop by deadlines: one function for the whole run, compiled if the device allows it.

Cycle k has the deadline ``origin + k dt``. The loop sleeps until this time, takes the measurement,
calls supervisor and controller, writes u, and pushes a row to the telemetry. A cycle that ends
after the next deadline has overrun: the deadlines that have passed are skipped (k jumps). For the
controller they are samples without a measurement in which u stayed the same, so its observer
follows the plant.

The loop around a device with a clock of its own is in ``ticks``; it has the same control step.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers.base import (
    bumpless_transfer,
    control,
    set_applied_control,
    set_reference_derivatives,
    write_row,
)
from quell.kernels.dispatch import compiled, generic, is_finite, kernel
from quell.realtime.devices.base import read_measurement, write_command
from quell.realtime.loop.modes import Mode
from quell.realtime.loop.reference import ReferenceSamples
from quell.realtime.loop.state import Memory, Rules, SupervisorState
from quell.realtime.loop.supervisor import (
    finished,
    supervised_output,
    update_mode,
)
from quell.realtime.system.clock import now, wait_until
from quell.realtime.system.histogram import count_duration
from quell.realtime.telemetry import channels
from quell.realtime.telemetry.channels import LOOP_WIDTH, Event
from quell.realtime.telemetry.ring import Ring, push
from quell.types import Vector

_MISSED, _OVERRAN, _CLIPPED, _UNSENT, _CHANGED = (
    int(event)
    for event in (Event.MISSED, Event.OVERRUN, Event.CLIPPED, Event.UNSENT, Event.CHANGED)
)


class CycleLog(NamedTuple):
    """Outputs of the loop for other threads."""

    ring: Ring
    row: Vector  #: work array: one row
    f_learned: int  #: index of the learned part of f̂ in a row; −1 if the controller reports none
    f_residual: int  #: index of the observer's part of f̂
    lateness: NDArray[np.int64]  #: histogram, see ``count_duration``
    step_time: NDArray[np.int64]  #: histogram


class SupervisedController(NamedTuple):
    """A controller, its supervisor, its reference and its log: the arguments of a control step."""

    design: Any  #: parameters of the controller
    state: Any  #: state of the controller
    rules: Rules
    supervisor: SupervisorState
    reference: ReferenceSamples
    log: CycleLog


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
        changed, clipped = supervisor.changed[0], counters.clipped
        u = control_step(controller, k, left_out, y)
        fault = write_command(handle, u)
        count_fault(supervisor, fault)
        written = now(clock)
        due = origin + int((k + 1) * period)
        missed_next = 1 + int((written - due) / period) if written >= due else 0
        overran = overslept + missed_next > 0
        count_cycle(supervisor, overran)
        events = cycle_events(supervisor, y, overran, fault, changed, clipped)
        fill_row(log, memory, k, lateness, written - woke - waited, events, y)
        push(log.ring, log.row)
        _count_skipped(supervisor, missed_next)
        left_out = missed_next
        k += 1 + missed_next


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
    log: CycleLog, memory: Memory, k: int, lateness: int, step_time: int, events: int, y: float
) -> None:
    """Complete the row, in which reference and controller's channels are already."""
    row = log.row
    row[channels.K] = k
    row[channels.LATENESS] = 1e-9 * lateness
    row[channels.STEP_TIME] = 1e-9 * step_time
    row[channels.MODE] = memory.mode
    row[channels.EVENTS] = events
    row[channels.Y] = memory.y
    row[channels.Y_MEASURED] = y
    row[channels.U] = memory.u
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
    update_mode(rules, supervisor, k, y, reference.r.size)
    first = k - min(left_out, rules.hold)
    if memory.mode == Mode.RUN and memory.began == k:
        bumpless_transfer(design, state)
        memory.offset = y - reference.r[0]
        first = k
    awake = memory.mode != Mode.STOPPED and is_finite(memory.y)
    r, wished, f_hat = 0.0, 0.0, 0.0
    for i in range(first, k + 1):
        r = _set_reference(design, state, reference, memory, i)
        if awake:
            wished = control(design, state, r, y if i == k else np.nan)
            if i < k:
                set_applied_control(design, state, memory.u)
    write_row(design, state, row[LOOP_WIDTH:])
    if controller.log.f_learned >= 0:
        f_hat = row[controller.log.f_learned] + row[controller.log.f_residual]
    u = supervised_output(rules, supervisor, k, wished, r, f_hat)
    if awake and u != wished:
        set_applied_control(design, state, u)
        supervisor.counters[0].clipped += 1 if memory.mode == Mode.RUN else 0
    row[channels.R] = r
    return u


@kernel
def _set_reference(
    design: Any, state: Any, reference: ReferenceSamples, memory: Memory, k: int
) -> float:
    """Return the reference of sample k (y before the scenario begins); pass its derivatives on."""
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
