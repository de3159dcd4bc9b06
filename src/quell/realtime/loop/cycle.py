"""The loop: one function for the whole run, compiled where the device allows it, on a thread of its own.

Cycle k has the deadline ``origin + k dt``. The loop sleeps until then, by the absolute time, takes the measurement, lets supervisor and
controller have their say, writes u, and pushes a row to whoever records. A cycle that ends after the next deadline has overrun: the
deadlines that are past are left out (k jumps), they are never caught up with in a burst. The controller is told of them all the same, as of
samples without a measurement in which u stayed as it was: so its observer goes on with the plant, and a short stall is no blow to it.

A device with a clock of its own (``paced``) sends a measurement at each of its ticks, and the loop wants to wake when one comes. So the
grid of deadlines follows: where the measurement had to be waited for, it moves later by as much, a five-hundredth of a sample at
most; where it was there already, it moves earlier by a twenty-thousandth. A clock that is 50 ppm off never slips. Where a measurement was
there already after a miss, or after the loop itself was late, it may be that of the tick before: then the loop waits a little for another.
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
from quell.kernels.dispatch import compiled, is_finite, kernel
from quell.realtime.devices.base import read_measurement, write_command
from quell.realtime.loop.modes import Cause, Mode, Request
from quell.realtime.loop.supervisor import (
    BEGAN,
    BLIND,
    CHANGES,
    CLIPPED,
    CYCLES,
    FAILED,
    GAP,
    IN_A_ROW,
    MODE,
    OVERRUNS,
    SKIPPED,
    SLEPT,
    TRIPPED,
    UNSENT,
    UNSURE,
    Rules,
    SupervisorState,
    U,
    Y,
    change_mode,
    finished,
    supervised_output,
    update_mode,
)
from quell.realtime.system.atomics import load_acquire
from quell.realtime.system.clock import now, wait_until
from quell.realtime.system.histogram import count_duration
from quell.realtime.telemetry.channels import (
    EVENTS,
    LATENESS,
    LOOP_WIDTH,
    STEP_TIME,
    Y_MEASURED,
    Event,
    K,
)
from quell.realtime.telemetry.channels import MODE as ROW_MODE
from quell.realtime.telemetry.channels import R as ROW_R
from quell.realtime.telemetry.channels import U as ROW_U
from quell.realtime.telemetry.channels import Y as ROW_Y
from quell.realtime.telemetry.ring import Ring, push
from quell.types import Matrix, Vector

# A paced device has so long to send its first measurement; in between it is looked whether somebody wants to stop [ns].
_FIRST, _LOOK = 2_000_000_000, 20_000_000

_MISSED, _OVERRAN, _CLIPPED, _UNSENT, _CHANGED = (
    int(event)
    for event in (Event.MISSED, Event.OVERRUN, Event.CLIPPED, Event.UNSENT, Event.CHANGED)
)


class Setpoints(NamedTuple):
    """What y has to follow, for all samples of a run."""

    r: Vector
    """(samples,)."""
    derivatives: Matrix
    """(samples, d): r', r'', …, as many as the controller heeds."""
    slide: Matrix
    """(·, 1 + d): how the reference comes from where y is to r, and the derivatives of that, for a distance of 1; see ``sliding``."""
    now: Vector
    """Room for the derivatives of one sample (d,)."""


class Pace(NamedTuple):
    """When things are due; nanoseconds."""

    period: float
    """The sample time."""
    patience: int
    """So long after its deadline a measurement of a paced device may come."""
    probe: int
    """So long another one is waited for, where the one that was there may be old."""
    later: int
    """By so much a cycle the grid moves at most towards later; 0 for a device without a clock of its own."""
    earlier: int


class Books(NamedTuple):
    """Where the loop writes what happened, and reads what is asked of it."""

    ring: Ring
    row: Vector
    f_learned: int
    """Where f_L stands in the row; −1 where the controller reports none."""
    f_residual: int
    lateness: NDArray[np.int64]
    """A ``tally``."""
    step: NDArray[np.int64]
    """A ``tally``."""
    requests: NDArray[np.int64]
    """(1,): GO_ON, END or ZERO; another thread writes it."""


def pace(dt: float, paced: bool) -> Pace:
    """Return when things are due at a sample time ``dt`` [s]."""
    period = dt * 1e9
    later, earlier = (
        (max(round(period / 500.0), 1), max(round(period / 20_000.0), 1)) if paced else (0, 0)
    )
    return Pace(period, round(0.5 * period), round(0.125 * period), later, earlier)


@compiled
def run_cycles(
    handle: Any,
    clock: Any,
    design: Any,
    state: Any,
    rules: Rules,
    supervisor: SupervisorState,
    setpoints: Setpoints,
    pace: Pace,
    books: Books,
) -> None:
    """Run until the supervisor has stopped the device."""
    counts, row = supervisor.counts, books.row
    origin = 0
    if not finished(supervisor):
        origin = _first_deadline(handle, clock, supervisor, pace, books.requests)
    k = left_out = 0
    while not finished(supervisor):
        deadline = origin + int(k * pace.period)
        woke = wait_until(clock, deadline)
        lateness = woke - deadline
        slept_over = int(lateness / pace.period)
        left_out += slept_over
        k += slept_over
        _skip(counts, slept_over)
        y, waited, shift = _measure(handle, clock, pace, counts, origin + int(k * pace.period))
        origin += shift
        changes = counts[CHANGES]
        clipped = counts[CLIPPED]
        u = _steer(design, state, rules, supervisor, setpoints, books, k, left_out, y)
        fault = write_command(handle, u)
        unsent = fault == 1
        counts[FAILED] = counts[FAILED] + 1 if unsent else 0
        counts[TRIPPED] = fault > 1
        written = now(clock)
        due = origin + int((k + 1) * pace.period)
        missed_next = 1 + int((written - due) / pace.period) if written >= due else 0
        overran = slept_over + missed_next > 0
        counts[IN_A_ROW] = counts[IN_A_ROW] + 1 if overran else 0
        counts[OVERRUNS] += overran
        counts[UNSENT] += unsent
        counts[CYCLES] += 1
        step = written - woke - waited
        row[K] = k
        row[LATENESS] = 1e-9 * lateness
        row[STEP_TIME] = 1e-9 * step
        row[ROW_MODE] = counts[MODE]
        row[EVENTS] = (
            (0 if is_finite(y) else _MISSED)
            + (_OVERRAN if overran else 0)
            + (_CLIPPED if counts[CLIPPED] > clipped else 0)
            + (_UNSENT if unsent else 0)
            + (_CHANGED if counts[CHANGES] > changes else 0)
        )
        row[ROW_Y] = supervisor.values[Y]
        row[Y_MEASURED] = y
        row[ROW_U] = u
        push(books.ring, row)
        count_duration(books.lateness, lateness)
        count_duration(books.step, step)
        _skip(counts, missed_next)
        left_out = missed_next
        k += 1 + missed_next


@kernel
def _first_deadline(
    handle: Any, clock: Any, supervisor: SupervisorState, pace: Pace, requests: NDArray[np.int64]
) -> int:
    """Return when cycle 0 is due [ns]: a sample from now, or from a paced device's next tick."""
    begin = now(clock)
    if pace.later == 0:
        return begin + int(pace.period)
    read_measurement(handle, clock, begin)  # what is there already is of no tick that is known
    while (
        now(clock) < begin + max(_FIRST, int(5.0 * pace.period))
        and load_acquire(requests, 0) == Request.NONE
    ):
        before = now(clock)
        y, _ = read_measurement(handle, clock, before + max(_LOOK, int(2.0 * pace.period)))
        after = now(clock)
        if is_finite(y):
            return after + int(pace.period)
        if after == before:  # it does not wait, and no time passes
            break
    change_mode(supervisor, 0, Mode.STOPPED, Cause.NO_MEASUREMENT)
    return now(clock) + int(pace.period)


@kernel
def _skip(counts: NDArray[np.int64], deadlines: int) -> None:
    """Take note of deadlines that are left out: nothing is known of those samples."""
    counts[SKIPPED] += deadlines
    counts[BLIND] += deadlines
    counts[SLEPT] += deadlines
    if deadlines > 0:
        counts[UNSURE] = 1


@kernel
def _measure(
    handle: Any, clock: Any, pace: Pace, counts: NDArray[np.int64], deadline: int
) -> tuple[float, int, int]:
    """Return the measurement, how long it was waited for, and by how much the grid moves later [ns]."""
    y, waited = read_measurement(handle, clock, deadline + pace.patience)
    if pace.later == 0:
        return y, waited, 0
    if not is_finite(y):
        counts[UNSURE] = 1
        return y, waited, 0
    before = now(clock)
    if waited == 0 and counts[UNSURE] != 0 and before < deadline + pace.probe:
        counts[UNSURE] = 0
        newer, _ = read_measurement(handle, clock, deadline + pace.probe)
        waited = now(clock) - before
        if is_finite(newer):
            return newer, waited, min(waited, pace.later)
    elif waited > 0:
        counts[UNSURE] = 0
        return y, waited, min(waited, pace.later)
    return y, waited, -pace.earlier


@kernel
def _steer(
    design: Any,
    state: Any,
    rules: Rules,
    supervisor: SupervisorState,
    setpoints: Setpoints,
    books: Books,
    k: int,
    left_out: int,
    y: float,
) -> float:
    """Take a sample of supervisor and controller; return the u to apply, and write reference and report into the row.

    Of the ``left_out`` deadlines before k the controller is told first, as far as they are not the end of the run.
    """
    counts, values, row = supervisor.counts, supervisor.values, books.row
    update_mode(rules, supervisor, k, y, load_acquire(books.requests, 0), setpoints.r.size)
    first = k - min(left_out, rules.hold)
    if counts[MODE] == Mode.RUN and counts[BEGAN] == k:
        bumpless_transfer(design, state)
        values[GAP] = y - setpoints.r[0]
        first = k
    awake = counts[MODE] != Mode.STOPPED and is_finite(values[Y])
    r, wished, f_hat = 0.0, 0.0, 0.0
    for i in range(first, k + 1):
        r = _reference(design, state, setpoints, supervisor, i)
        if awake:
            wished = control(design, state, r, y if i == k else np.nan)
            if i < k:
                set_applied_control(design, state, values[U])
    write_row(design, state, row[LOOP_WIDTH:])
    if books.f_learned >= 0:
        f_hat = row[books.f_learned] + row[books.f_residual]
    u = supervised_output(rules, supervisor, k, wished, r, f_hat)
    if awake and u != wished:
        set_applied_control(design, state, u)
        counts[CLIPPED] += counts[MODE] == Mode.RUN
    row[ROW_R] = r
    return u


@kernel
def _reference(
    design: Any, state: Any, setpoints: Setpoints, supervisor: SupervisorState, k: int
) -> float:
    """Return the reference of this sample, and tell the controller its derivatives; where y is, before the scenario begins."""
    if supervisor.counts[BEGAN] < 0:
        return supervisor.values[Y]
    i = min(k - supervisor.counts[BEGAN], setpoints.r.size - 1)
    gap = supervisor.values[GAP] if i < setpoints.slide.shape[0] else 0.0
    r = setpoints.r[i]
    if gap != 0.0:
        r += gap * setpoints.slide[i, 0]
    if setpoints.now.size > 0:
        for j in range(setpoints.now.size):
            setpoints.now[j] = setpoints.derivatives[i, j]
            if gap != 0.0:
                setpoints.now[j] += gap * setpoints.slide[i, 1 + j]
        set_reference_derivatives(design, state, setpoints.now)
    return r
