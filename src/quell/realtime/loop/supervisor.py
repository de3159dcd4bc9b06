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

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.scalars import Scalars
from quell.realtime.loop.modes import Cause, Mode, Request
from quell.realtime.system.atomics import load_acquire, store_release

# Once u is zero it is written FLUSH + 1 more times, in case frames are lost. Chosen by hand.
FLUSH = 3
# START may take _LONGEST_START · (settle + _SETTLE_MARGIN) samples: enough for a device that misses
# some. Chosen by hand; not tuned further.
_LONGEST_START, _SETTLE_MARGIN = 10, 100
# Number of changes of mode that are kept (96 KiB). The last ones are reserved for the end of the
# run, which takes two: RAMP and STOPPED.
_KEPT, RESERVED = 4096, 4


class Rules(NamedTuple):
    """The supervisor's rules; ``Safety.rules`` makes them."""

    low: float  #: lower limit of u [u-unit], ≤ 0
    high: float  #: upper limit, ≥ 0
    most_error: float  #: largest ``|r − y|`` [y-unit]
    most_f: float  #: largest ``|f̂|`` [y-unit/s^n]
    hold: int
    ramp: int
    settle: int
    most_saturated: int
    most_overruns: int


class Memory(Scalars):
    """State of the supervisor from one cycle to the next."""

    mode: int
    samples: int  #: good samples in a row in START, cycles so far in RAMP and STOPPED
    began: int  #: index k of the scenario's first sample; −1 before it
    missed_in_row: int  #: deadlines without a good sample, those that were skipped included
    skipped_in_row: int
    at_limit_in_row: int  #: samples with u at a limit
    overruns_in_row: int
    unsent_in_row: int
    maybe_stale: int  #: not zero if the next measurement may be an old one
    tripped: int  #: not zero if the device has set u to zero for good
    u: float  #: as applied [u-unit]
    ramp_start: float  #: u at the beginning of the ramp [u-unit]
    y: float  #: last good measurement [y-unit]; NaN before the first
    offset: float  #: distance from the reference to y at the scenario's first sample [y-unit]


class Counters(Scalars):
    """Counters of a run; the first fields of ``quell.realtime.loop.result.Tally``, in its order."""

    cycles: int
    overruns: int
    skipped: int
    missed: int
    clipped: int
    unsent: int


class SupervisorState(NamedTuple):
    """State of the supervisor, which the loop writes and another thread may read."""

    memory: NDArray[Memory]
    counters: NDArray[Counters]
    changes: NDArray[np.int64]  #: k, mode and cause of each change of mode (·, 3)
    changed: NDArray[np.int64]  #: number of changes of mode that are kept (1,), an atomic word
    requests: NDArray[np.int64]  #: a ``Request`` (1,), an atomic word that another thread writes


def initial_state() -> SupervisorState:
    """Return the state before the first cycle."""
    memory, changed, requests = Memory.zeros(), np.zeros(1, np.int64), np.zeros(1, np.int64)
    memory[0].began, memory[0].y = -1, np.nan
    changes = np.zeros((_KEPT, 3), np.int64)
    return SupervisorState(memory, Counters.zeros(), changes, changed, requests)


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
                memory.began = k
            else:
                memory.samples += 1
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
    elif memory.mode == Mode.START and k > _LONGEST_START * (rules.settle + _SETTLE_MARGIN):
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
