"""The loop around a device with a clock of its own: it takes a control step for each tick.

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
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quell.controllers.base import set_applied_control
from quell.kernels.dispatch import compiled, is_finite, kernel
from quell.realtime.devices.base import Tick, ask, read_tick, write_command
from quell.realtime.loop.cycle import (
    SupervisedController,
    control_step,
    count_cycle,
    count_fault,
    cycle_events,
    fill_row,
)
from quell.realtime.loop.modes import Cause, Mode, Request
from quell.realtime.loop.state import SupervisorState
from quell.realtime.loop.supervisor import change_mode, finished
from quell.realtime.system.atomics import load_acquire
from quell.realtime.system.clock import now, wait_until
from quell.realtime.telemetry import channels
from quell.realtime.telemetry.ring import push

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
        superseded = ahead > 0 or tick.left > 0
        taken = now(clock)
        if k > 0:
            _finish_row(controller, tick.u)
        if overslept > 0:
            memory.skipped_in_row = overslept
            memory.missed_in_row += overslept
        changed, clipped = supervisor.changed[0], counters.clipped
        u = control_step(controller, k, 0, y)
        fault = 0
        if superseded:
            counters.skipped += 1
        else:
            fault = write_command(handle, u)
            count_fault(supervisor, fault)
        written = now(clock)
        overran = overslept > 0 or written - taken >= period
        count_cycle(supervisor, overran)
        events = cycle_events(supervisor, y, overran, fault, changed, clipped)
        fill_row(log, memory, k, late, written - taken, events, y)
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
def _finish_row(controller: SupervisedController, u: float) -> None:
    """Push the row of the step before; ``u`` is what acts since then, if it is known.

    If it is not the u of that step, tell the controller, before it takes the next one.
    """
    row = controller.log.row
    if is_finite(u) and u != row[channels.U]:
        row[channels.U] = u
        if controller.supervisor.memory[0].mode != Mode.STOPPED:
            set_applied_control(controller.design, controller.state, u)
    push(controller.log.ring, row)


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
        fault = write_command(handle, memory.u)
        count_fault(supervisor, fault)
        if fault > 1 or memory.unsent_in_row > controller.rules.hold:
            break
        samples = 1 + max(int((time - expected) / period), samples)
    return Tick(np.nan, behind, np.nan, 0, waited)
