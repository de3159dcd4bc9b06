"""The loop: one function for the whole run, compiled if the device allows it.

Cycle k has the deadline ``origin + k dt``. The loop sleeps until this time, takes the measurement,
calls supervisor and controller, writes u, and pushes a row to the telemetry. A cycle that ends
after the next deadline has overrun: the deadlines that have passed are skipped (k jumps). For the
controller they are samples without a measurement in which u stayed the same, so its observer
follows the plant.

A device with a clock of its own (``paced``) sends a measurement at each of its ticks, and the loop
should wake when one comes. Therefore the grid of deadlines follows the device: if the loop had to
wait for the measurement, the grid moves later by that time, by 1/500 of a sample at most; if the
measurement was there already, the grid moves earlier by 1/20 000 of a sample. After a missed
sample, or if the loop itself was late, a measurement that was there already may be that of the tick
before: then the loop waits a short time for another.
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
from quell.realtime.devices.base import ask, read_measurement, write_command
from quell.realtime.loop.modes import Cause, Mode, Request
from quell.realtime.loop.reference import ReferenceSamples
from quell.realtime.loop.state import Memory, Rules, SupervisorState
from quell.realtime.loop.supervisor import (
    change_mode,
    finished,
    supervised_output,
    update_mode,
)
from quell.realtime.system.atomics import load_acquire
from quell.realtime.system.clock import now, wait_until
from quell.realtime.system.histogram import count_duration
from quell.realtime.telemetry import channels
from quell.realtime.telemetry.channels import LOOP_WIDTH, Event
from quell.realtime.telemetry.ring import Ring, push
from quell.types import Vector

# Time that a paced device has for its first measurement, and time between two looks at the requests
# meanwhile [ns]; for slow devices at least five ticks and two. Chosen by hand: a rig ticks before
# it answers the first frame.
_FIRST, _LOOK = 2_000_000_000, 20_000_000
_FIRST_TICKS, _LOOK_TICKS = 5.0, 2.0
# Shares of a sample. Half of it is for the measurement, half for the controller. The wait for a
# newer measurement and the largest shift towards later (which undoes forty shifts towards earlier)
# are chosen by hand.
_TIMEOUT, _RECHECK, _LATER = 0.5, 0.125, 500.0
# The shift towards earlier, 50 ppm, is the tolerance of an ordinary quartz clock: the grid never
# falls behind one.
_EARLIER = 20_000.0

_MISSED, _OVERRAN, _CLIPPED, _UNSENT, _CHANGED = (
    int(event)
    for event in (Event.MISSED, Event.OVERRUN, Event.CLIPPED, Event.UNSENT, Event.CHANGED)
)


class CycleTimes(NamedTuple):
    """Times of a cycle [ns]."""

    period: float  #: sample time
    timeout: int  #: wait for the measurement of a paced device, counted from the deadline
    recheck: int  #: wait for a newer measurement if the one found may be old, from the deadline
    later: int  #: largest shift of the grid towards later per cycle; 0 if the device is not paced
    earlier: int  #: shift of the grid towards earlier per cycle


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


def cycle_times(dt: float, paced: bool) -> CycleTimes:
    """Return the times of a cycle for a sample time ``dt`` [s]."""
    period = dt * 1e9
    shifts = [max(round(period / part), 1) if paced else 0 for part in (_LATER, _EARLIER)]
    return CycleTimes(period, round(_TIMEOUT * period), round(_RECHECK * period), *shifts)


@compiled
def run_cycles(handle: Any, clock: Any, times: CycleTimes, controller: Any) -> None:
    """Run until the supervisor has stopped the device.

    ``controller`` is a ``SupervisedController``, or a ``CompiledController`` around one.
    """
    supervisor, log = controller.supervisor, controller.log
    memory, counters = supervisor.memory[0], supervisor.counters[0]
    origin = 0
    if not finished(supervisor):
        origin = _first_deadline(handle, clock, supervisor, times)
    k = left_out = 0
    while not finished(supervisor):
        deadline = origin + int(k * times.period)
        woke = wait_until(clock, deadline)
        lateness = woke - deadline
        overslept = int(lateness / times.period)
        left_out += overslept
        k += overslept
        _count_skipped(supervisor, overslept)
        deadline = origin + int(k * times.period)
        y, waited, shift = _measure(handle, clock, times, supervisor, deadline)
        origin += shift
        changed, clipped = supervisor.changed[0], counters.clipped
        u = control_step(controller, k, left_out, y)
        fault = write_command(handle, u)
        memory.unsent_in_row = memory.unsent_in_row + 1 if fault == 1 else 0
        memory.tripped = 1 if fault > 1 else 0
        written = now(clock)
        due = origin + int((k + 1) * times.period)
        missed_next = 1 + int((written - due) / times.period) if written >= due else 0
        overran = overslept + missed_next > 0
        memory.overruns_in_row = memory.overruns_in_row + 1 if overran else 0
        counters.overruns += 1 if overran else 0
        counters.unsent += 1 if fault == 1 else 0
        counters.cycles += 1
        events = (
            (0 if is_finite(y) else _MISSED)
            + (_OVERRAN if overran else 0)
            + (_CLIPPED if counters.clipped > clipped else 0)
            + (_UNSENT if fault == 1 else 0)
            + (_CHANGED if supervisor.changed[0] > changed else 0)
        )
        _log_cycle(log, memory, k, lateness, written - woke - waited, events, y)
        _count_skipped(supervisor, missed_next)
        left_out = missed_next
        k += 1 + missed_next


@kernel
def _log_cycle(
    log: CycleLog, memory: Memory, k: int, lateness: int, step_time: int, events: int, y: float
) -> None:
    """Complete the row, in which reference and controller's channels are already, and push it."""
    row = log.row
    row[channels.K] = k
    row[channels.LATENESS] = 1e-9 * lateness
    row[channels.STEP_TIME] = 1e-9 * step_time
    row[channels.MODE] = memory.mode
    row[channels.EVENTS] = events
    row[channels.Y] = memory.y
    row[channels.Y_MEASURED] = y
    row[channels.U] = memory.u
    push(log.ring, row)
    count_duration(log.lateness, lateness)
    count_duration(log.step_time, step_time)


@kernel
def _first_deadline(handle: Any, clock: Any, supervisor: SupervisorState, times: CycleTimes) -> int:
    """Return the deadline of cycle 0 [ns]: a sample from now or from a paced device's next tick."""
    begin = now(clock)
    if times.later == 0:
        return begin + int(times.period)
    read_measurement(handle, clock, begin)  # discards a measurement of an unknown tick
    while (
        now(clock) < begin + max(_FIRST, int(_FIRST_TICKS * times.period))
        and load_acquire(supervisor.requests, 0) == Request.NONE
    ):
        before = now(clock)
        ask(handle)
        y, _ = read_measurement(handle, clock, before + max(_LOOK, int(_LOOK_TICKS * times.period)))
        after = now(clock)
        if is_finite(y):
            return after + int(times.period)
        if after == before:  # the device does not wait, and no time passes
            break
    change_mode(supervisor, 0, Mode.STOPPED, Cause.NO_MEASUREMENT)
    return now(clock) + int(times.period)


@kernel
def _count_skipped(supervisor: SupervisorState, deadlines: int) -> None:
    """Count deadlines that are skipped: nothing is known of their samples."""
    memory = supervisor.memory[0]
    supervisor.counters[0].skipped += deadlines
    memory.missed_in_row += deadlines
    memory.skipped_in_row += deadlines
    if deadlines > 0:
        memory.maybe_stale = 1


@kernel
def _measure(
    handle: Any, clock: Any, times: CycleTimes, supervisor: SupervisorState, deadline: int
) -> tuple[float, int, int]:
    """Return the measurement, the wait for it and the shift of the grid towards later [ns]."""
    memory = supervisor.memory[0]
    y, waited = read_measurement(handle, clock, deadline + times.timeout)
    if times.later == 0:
        return y, waited, 0
    if not is_finite(y):
        memory.maybe_stale = 1
        return y, waited, 0
    before = now(clock)
    if waited == 0 and memory.maybe_stale != 0 and before < deadline + times.recheck:
        memory.maybe_stale = 0
        newer, _ = read_measurement(handle, clock, deadline + times.recheck)
        waited = now(clock) - before
        if is_finite(newer):
            return newer, waited, min(waited, times.later)
    elif waited > 0:
        memory.maybe_stale = 0
        return y, waited, min(waited, times.later)
    return y, waited, -times.earlier


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
