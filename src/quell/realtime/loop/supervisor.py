"""The supervisor: after a fault it holds u, then ramps it to zero, then stops.

::

    START ──settled──▶ RUN ◀──a sample is missed, one comes──▶ HOLD
      │                 │                                       │
      └─────────────────┴──────── a cause, see Cause ───────────┴──▶ RAMP ──u is zero──▶ STOPPED

* START: u is zero and the controller observes, with y as its reference, until ``settle`` samples
  in a row were good.
* RUN: u is the controller's, within limits.
* HOLD: there was no good sample, and u stays as it is; RAMP after ``hold`` such samples in a row.
* RAMP: u goes to zero in a straight line within ``ramp`` samples, whatever happens meanwhile;
  there is no way back to RUN.
* STOPPED: u is zero; it is written some more times, in case a frame is lost.

All of it is arithmetic on arrays, so that tests can run it without a clock or a device.
"""

from __future__ import annotations

from quell.kernels.dispatch import is_finite, kernel
from quell.realtime.loop.direction import ARMED, OFF, runs_away
from quell.realtime.loop.modes import Cause, Mode, Request
from quell.realtime.loop.state import RESERVED, Memory, Rules, SupervisorState
from quell.realtime.system.atomics import load_acquire, store_release

# Once u is zero it is written FLUSH + 1 more times, in case frames are lost. Chosen by hand.
FLUSH = 3


@kernel
def change_mode(state: SupervisorState, k: int, mode: int, cause: int) -> None:
    """Change the mode and keep the cause."""
    memory = state.memory[0]
    memory.mode = mode
    memory.samples = 0
    if mode == Mode.RAMP:
        memory.ramp_start = memory.u
    number = state.changed[0]
    kept = state.changes.shape[0]
    if number < kept - RESERVED or (number < kept and mode >= Mode.RAMP):
        state.changes[number, 0] = k
        state.changes[number, 1] = mode
        state.changes[number, 2] = cause
        store_release(state.changed, 0, number + 1)


@kernel
def update_mode(rules: Rules, state: SupervisorState, k: int, y: float, samples: int) -> None:
    """Choose the mode of cycle ``k`` before the controller's step.

    ``y`` is the measurement, ``samples`` the number of samples of the scenario.
    """
    memory = state.memory[0]
    good = is_finite(y)
    if good:
        memory.y = y
    else:
        memory.missed_in_row += 1
        state.counters[0].missed += 1
    mode = memory.mode
    request = load_acquire(state.requests, 0)
    if request == Request.ZERO and mode != Mode.STOPPED:
        change_mode(state, k, Mode.STOPPED, Cause.ZERO_REQUESTED)
    elif mode <= Mode.HOLD:
        cause = _cause_to_end(rules, memory, k, request, samples)
        if cause != Cause.NONE:
            change_mode(state, k, Mode.RAMP, cause)
        elif mode == Mode.START:
            if not good:
                memory.samples = 0
            elif memory.samples >= rules.settle:
                change_mode(state, k, Mode.RUN, Cause.SETTLED)
                memory.began, memory.y_began = k, y
                memory.watching = ARMED if rules.direction != 0.0 else OFF
            else:
                memory.samples += 1
                memory.y_rest_low = min(memory.y_rest_low, y)
                memory.y_rest_high = max(memory.y_rest_high, y)
        elif good and mode == Mode.HOLD:
            change_mode(state, k, Mode.RUN, Cause.RECOVERED)
        elif not good and mode == Mode.RUN:
            change_mode(state, k, Mode.HOLD, Cause.MISSED)
    if good:
        memory.missed_in_row = 0
        memory.skipped_in_row = 0


@kernel
def _cause_to_end(rules: Rules, memory: Memory, k: int, request: int, samples: int) -> int:
    """Return the cause to end the run, as far as it is known before the controller's step."""
    cause = Cause.NONE
    if request == Request.RAMP:
        cause = Cause.STOP_REQUESTED
    elif memory.missed_in_row > rules.hold:
        cause = Cause.STALLED if memory.skipped_in_row > rules.hold else Cause.LOST
    elif memory.unsent_in_row > rules.hold:
        cause = Cause.UNREACHABLE
    elif memory.overruns_in_row > rules.most_overruns:
        cause = Cause.OVERRUN
    elif memory.tripped != 0:
        cause = Cause.WATCHDOG
    elif memory.y < rules.y_low or memory.y > rules.y_high:
        cause = Cause.IMPLAUSIBLE
    elif memory.mode == Mode.START and k > rules.longest_start:
        cause = Cause.UNSETTLED
    elif memory.began >= 0 and k - memory.began >= samples:
        cause = Cause.COMPLETED
    return cause


@kernel
def supervised_output(
    rules: Rules, state: SupervisorState, k: int, wished: float, r: float, f_hat: float
) -> float:
    """Return the u to apply in cycle ``k``; in RUN, end the run if a limit is exceeded.

    ``wished`` is the controller's u, ``r`` the reference of this sample, ``f_hat`` the estimate
    after it, zero if the controller has none.
    """
    memory = state.memory[0]
    u = 0.0
    if memory.mode == Mode.RUN:
        u = min(max(wished, rules.low), rules.high)
        at_limit = u == rules.low or u == rules.high
        memory.at_limit_in_row = memory.at_limit_in_row + 1 if at_limit else 0
        if not is_finite(wished):
            change_mode(state, k, Mode.RAMP, Cause.NOT_A_NUMBER)
        elif not abs(r - memory.y) <= rules.most_error:
            change_mode(state, k, Mode.RAMP, Cause.TRACKING_ERROR)
        elif not abs(f_hat) <= rules.most_f:
            change_mode(state, k, Mode.RAMP, Cause.F_HAT)
        elif memory.at_limit_in_row > rules.most_saturated:
            change_mode(state, k, Mode.RAMP, Cause.SATURATED)
        elif runs_away(rules, memory, r):
            change_mode(state, k, Mode.RAMP, Cause.WRONG_WAY)
    elif memory.mode == Mode.HOLD:
        u = memory.u
    if memory.mode == Mode.RAMP:
        memory.samples += 1
        left = rules.ramp - memory.samples
        u = memory.ramp_start * left / rules.ramp
        if left <= 0 or memory.ramp_start == 0.0:
            u = 0.0
            change_mode(state, k, Mode.STOPPED, Cause.RAMPED)
    elif memory.mode == Mode.STOPPED:
        memory.samples += 1
    memory.u = u
    return u


@kernel
def finished(state: SupervisorState) -> bool:
    """Return whether u is zero and was written often enough."""
    return state.memory[0].mode == Mode.STOPPED and state.memory[0].samples > FLUSH
