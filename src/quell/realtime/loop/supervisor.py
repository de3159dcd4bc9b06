"""What the loop does where something goes wrong: hold, then ramp u to zero, then stop.

::

    START ──settled──▶ RUN ◀──a sample is missed, one comes──▶ HOLD
      │                 │                                       │
      └─────────────────┴──────── a cause, see Cause ───────────┴──▶ RAMP ──u is zero──▶ STOPPED

* START: u is zero and the controller watches, with its reference where y is, until ``settle`` samples in a row were good.
* RUN: u is what the controller says, within limits.
* HOLD: there was no good sample: u stays as it is. After ``hold`` of them in a row it is RAMP's turn.
* RAMP: u goes to zero in a straight line, in ``ramp`` samples, whatever happens meanwhile. There is no way back from here.
* STOPPED: u is zero; it is written some more times, in case a frame is lost.

All of it is arithmetic on two arrays, so that it can be tried out sample by sample without a clock or a device.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import is_finite, kernel
from quell.realtime.loop.modes import Cause, Mode, Request
from quell.realtime.system.atomics import store_release
from quell.types import Vector

# So many more zeros are written once u is zero.
FLUSH = 3
# To settle may take so many times as many samples as it has to.
_LONGEST_START = 10


class Rules(NamedTuple):
    """What the supervisor goes by; ``Safety`` makes it."""

    low: float
    """Of u [u-unit], ≤ 0."""
    high: float
    """≥ 0."""
    most_error: float
    """Largest ``|r − y|`` [y-unit]."""
    most_f: float
    """Largest ``|f̂|`` [y-unit/s^n]."""
    hold: int
    ramp: int
    settle: int
    most_saturated: int
    most_overruns: int


# Places of SupervisorState.counts.
(
    MODE,
    SAMPLES,  # good ones in START; done in RAMP and STOPPED
    BEGAN,  # k of the scenario's first sample; −1 before
    BLIND,  # deadlines in a row without a good sample
    SLEPT,  # those of them that were left out
    AT_LIMIT,  # samples in a row with u at a limit
    IN_A_ROW,  # cycles in a row that overran
    FAILED,  # commands in a row that did not get out
    CHANGES,  # of mode
    CYCLES,
    OVERRUNS,
    SKIPPED,  # deadlines
    MISSES,  # cycles without a good measurement
    CLIPPED,  # cycles in which u was not the controller's
    UNSENT,  # commands
    UNSURE,  # whether a measurement may be an old one
    TRIPPED,  # whether the device has set u to zero for good
) = range(17)
COUNTS = 17
# Places of SupervisorState.values.
U, FROM, Y, GAP = range(4)
VALUES = 4
# So many changes of mode are kept; the last places are not for HOLD and back.
_KEPT, _RESERVED = 4096, 4


class SupervisorState(NamedTuple):
    """What the supervisor remembers."""

    counts: NDArray[np.int64]
    """(COUNTS,)."""
    values: Vector
    """(VALUES,): u applied, u at the beginning of the ramp, last good y, distance from where y began to the reference."""
    changes: NDArray[np.int64]
    """(·, 3): k, mode, cause."""


def initial_state() -> SupervisorState:
    """Return what the supervisor knows before the first cycle."""
    state = SupervisorState(
        np.zeros(COUNTS, dtype=np.int64), np.zeros(VALUES), np.zeros((_KEPT, 3), dtype=np.int64)
    )
    state.counts[BEGAN] = -1
    state.values[Y] = np.nan
    return state


@kernel
def change_mode(state: SupervisorState, k: int, mode: int, cause: int) -> None:
    """Go over to another mode, and note why."""
    counts = state.counts
    counts[MODE], counts[SAMPLES] = mode, 0
    if mode == Mode.RAMP:
        state.values[FROM] = state.values[U]
    number = counts[CHANGES]
    kept = state.changes.shape[0]
    if number < kept - _RESERVED or (number < kept and mode >= Mode.RAMP):
        state.changes[number, 0], state.changes[number, 1], state.changes[number, 2] = (
            k,
            mode,
            cause,
        )
        store_release(counts, CHANGES, number + 1)


@kernel
def update_mode(
    rules: Rules, state: SupervisorState, k: int, y: float, request: int, samples: int
) -> None:
    """Choose the mode for this cycle, before the controller's step.

    ``y`` is the measurement, ``request`` what the main thread wants, ``samples`` how many the scenario has.
    """
    counts, values = state.counts, state.values
    good = is_finite(y)
    if good:
        values[Y] = y
    else:
        counts[BLIND] += 1
        counts[MISSES] += 1
    mode = counts[MODE]
    if request == Request.ZERO and mode != Mode.STOPPED:
        change_mode(state, k, Mode.STOPPED, Cause.ZERO_REQUESTED)
    elif mode <= Mode.HOLD:
        cause = _cause_to_end(rules, state, k, request, samples)
        if cause != Cause.NONE:
            change_mode(state, k, Mode.RAMP, cause)
        elif mode == Mode.START:
            if not good:
                counts[SAMPLES] = 0
            elif counts[SAMPLES] >= rules.settle:
                change_mode(state, k, Mode.RUN, Cause.SETTLED)
                counts[BEGAN] = k
            else:
                counts[SAMPLES] += 1
        elif good and mode == Mode.HOLD:
            change_mode(state, k, Mode.RUN, Cause.RECOVERED)
        elif not good and mode == Mode.RUN:
            change_mode(state, k, Mode.HOLD, Cause.MISSED)
    if good:
        counts[BLIND] = counts[SLEPT] = 0


@kernel
def _cause_to_end(rules: Rules, state: SupervisorState, k: int, request: int, samples: int) -> int:
    """Return why it has to end, as far as that is known before the controller's step."""
    counts = state.counts
    cause = Cause.NONE
    if request == Request.RAMP:
        cause = Cause.STOP_REQUESTED
    elif counts[BLIND] > rules.hold:
        cause = Cause.STALLED if counts[SLEPT] > rules.hold else Cause.LOST
    elif counts[FAILED] > rules.hold:
        cause = Cause.UNREACHABLE
    elif counts[IN_A_ROW] > rules.most_overruns:
        cause = Cause.OVERRUN
    elif counts[TRIPPED] != 0:
        cause = Cause.WATCHDOG
    elif counts[MODE] == Mode.START and k > _LONGEST_START * (rules.settle + 100):
        cause = Cause.UNSETTLED
    elif counts[BEGAN] >= 0 and k - counts[BEGAN] >= samples:
        cause = Cause.COMPLETED
    return cause


@kernel
def supervised_output(
    rules: Rules, state: SupervisorState, k: int, wished: float, r: float, f_hat: float
) -> float:
    """Return the u to apply, given what the controller wishes; in RUN, trip where a limit is passed.

    ``r`` is the reference of this sample, ``f_hat`` the estimate after it, zero where the controller has none.
    """
    counts, values = state.counts, state.values
    u = 0.0
    if counts[MODE] == Mode.RUN:
        u = min(max(wished, rules.low), rules.high)
        counts[AT_LIMIT] = counts[AT_LIMIT] + 1 if u == rules.low or u == rules.high else 0
        if not is_finite(wished):
            change_mode(state, k, Mode.RAMP, Cause.NOT_A_NUMBER)
        elif not abs(r - values[Y]) <= rules.most_error:
            change_mode(state, k, Mode.RAMP, Cause.TRACKING_ERROR)
        elif not abs(f_hat) <= rules.most_f:
            change_mode(state, k, Mode.RAMP, Cause.F_HAT)
        elif counts[AT_LIMIT] > rules.most_saturated:
            change_mode(state, k, Mode.RAMP, Cause.SATURATED)
    elif counts[MODE] == Mode.HOLD:
        u = values[U]
    if counts[MODE] == Mode.RAMP:
        counts[SAMPLES] += 1
        left = rules.ramp - counts[SAMPLES]
        u = values[FROM] * left / rules.ramp
        if left <= 0 or values[FROM] == 0.0:
            u = 0.0
            change_mode(state, k, Mode.STOPPED, Cause.RAMPED)
    elif counts[MODE] == Mode.STOPPED:
        counts[SAMPLES] += 1
    values[U] = u
    return u


@kernel
def finished(state: SupervisorState) -> bool:
    """Tell whether u is zero and was written often enough."""
    return state.counts[MODE] == Mode.STOPPED and state.counts[SAMPLES] > FLUSH
