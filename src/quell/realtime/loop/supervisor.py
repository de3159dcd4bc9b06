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

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import is_finite, kernel
from quell.realtime.telemetry.ring import load_acquire, store_release
from quell.types import Vector

START, RUN, HOLD, RAMP, STOPPED = range(5)
(
    NONE,
    SETTLED,
    MISSED,
    BACK,
    LOST,
    STALLED,
    OVERRUN,
    UNREACHED,
    WATCHDOG,
    ERROR,
    F_HAT,
    SATURATED,
    NOT_A_NUMBER,
    ASKED,
    AT_ONCE,
    OVER,
    RAMPED,
    SILENT,
    UNSETTLED,
) = range(19)
# What the main thread asks for: to ramp down, or zero at once.
GO_ON, END, ZERO = range(3)
# So many more zeros are written once u is zero.
FLUSH = 3


# To settle may take so many times as many samples as it has to.
_LONGEST_START = 10


class Mode(IntEnum):
    """State of the supervisor, the channel ``mode``."""

    START = START
    RUN = RUN
    HOLD = HOLD
    RAMP = RAMP
    STOPPED = STOPPED


class Cause(IntEnum):
    """Why the mode changed; ``words`` says it."""

    NONE = NONE
    SETTLED = SETTLED
    MISSED = MISSED
    BACK = BACK
    LOST = LOST
    STALLED = STALLED
    OVERRUN = OVERRUN
    UNREACHED = UNREACHED
    WATCHDOG = WATCHDOG
    ERROR = ERROR
    F_HAT = F_HAT
    SATURATED = SATURATED
    NOT_A_NUMBER = NOT_A_NUMBER
    ASKED = ASKED
    AT_ONCE = AT_ONCE
    OVER = OVER
    RAMPED = RAMPED
    SILENT = SILENT
    UNSETTLED = UNSETTLED

    @property
    def words(self) -> str:
        """The cause, as a clause."""
        return _WORDS[self]


_WORDS = {
    Cause.NONE: "it began",
    Cause.SETTLED: "enough good samples were seen",
    Cause.MISSED: "no measurement came, or one that is no number",
    Cause.BACK: "a good measurement came",
    Cause.LOST: "too many samples in a row were missed: look at the device and the wire",
    Cause.STALLED: "the loop itself stood still for too many samples: look at the load of the machine",
    Cause.OVERRUN: "too many cycles in a row took longer than a sample: take a longer dt, or less work",
    Cause.UNREACHED: "the device could not be reached too often in a row: look at the wire",
    Cause.WATCHDOG: "the device has set u to zero for good: commands did not arrive in time, or it was ended",
    Cause.ERROR: "|r − y| went beyond most_error",
    Cause.F_HAT: "|f_hat| went beyond most_f",
    Cause.SATURATED: "u lay at a limit for longer than most_saturated samples",
    Cause.NOT_A_NUMBER: "the controller's u was no number",
    Cause.ASKED: "it was asked to stop",
    Cause.AT_ONCE: "it was asked to stop at once",
    Cause.OVER: "the scenario is over",
    Cause.RAMPED: "u is zero",
    Cause.SILENT: "no measurement ever came: is the device running?",
    Cause.UNSETTLED: "there were never enough good samples in a row to begin with",
}


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


# Places of Watch.counts.
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
# Places of Watch.values.
U, FROM, Y, GAP = range(4)
VALUES = 4
# So many changes of mode are kept; the last places are not for HOLD and back.
_KEPT, _RESERVED = 4096, 4


class Watch(NamedTuple):
    """What the supervisor remembers."""

    counts: NDArray[np.int64]
    """(COUNTS,)."""
    values: Vector
    """(VALUES,): u applied, u at the beginning of the ramp, last good y, distance from where y began to the reference."""
    changes: NDArray[np.int64]
    """(·, 3): k, mode, cause."""


def watch() -> Watch:
    """Return what the supervisor knows before the first cycle."""
    memory = Watch(
        np.zeros(COUNTS, dtype=np.int64), np.zeros(VALUES), np.zeros((_KEPT, 3), dtype=np.int64)
    )
    memory.counts[BEGAN] = -1
    memory.values[Y] = np.nan
    return memory


@kernel
def change(watch: Watch, k: int, mode: int, cause: int) -> None:
    """Go over to another mode, and note why."""
    counts = watch.counts
    counts[MODE], counts[SAMPLES] = mode, 0
    if mode == RAMP:
        watch.values[FROM] = watch.values[U]
    number = counts[CHANGES]
    kept = watch.changes.shape[0]
    if number < kept - _RESERVED or (number < kept and mode >= RAMP):
        watch.changes[number, 0], watch.changes[number, 1], watch.changes[number, 2] = (
            k,
            mode,
            cause,
        )
        store_release(counts, CHANGES, number + 1)


@kernel
def judge(rules: Rules, watch: Watch, k: int, y: float, asked: int, samples: int) -> None:
    """Choose the mode for this cycle, before the controller's step.

    ``y`` is the measurement, ``asked`` what the main thread wants, ``samples`` how many the scenario has.
    """
    counts, values = watch.counts, watch.values
    good = is_finite(y)
    if good:
        values[Y] = y
    else:
        counts[BLIND] += 1
        counts[MISSES] += 1
    mode = counts[MODE]
    if asked == ZERO and mode != STOPPED:
        change(watch, k, STOPPED, AT_ONCE)
    elif mode <= HOLD:
        cause = _cause(rules, watch, k, asked, samples)
        if cause != NONE:
            change(watch, k, RAMP, cause)
        elif mode == START:
            if not good:
                counts[SAMPLES] = 0
            elif counts[SAMPLES] >= rules.settle:
                change(watch, k, RUN, SETTLED)
                counts[BEGAN] = k
            else:
                counts[SAMPLES] += 1
        elif good and mode == HOLD:
            change(watch, k, RUN, BACK)
        elif not good and mode == RUN:
            change(watch, k, HOLD, MISSED)
    if good:
        counts[BLIND] = counts[SLEPT] = 0


@kernel
def _cause(rules: Rules, watch: Watch, k: int, asked: int, samples: int) -> int:
    """Return why it has to end, as far as that is known before the controller's step."""
    counts = watch.counts
    cause = NONE
    if asked == END:
        cause = ASKED
    elif counts[BLIND] > rules.hold:
        cause = STALLED if counts[SLEPT] > rules.hold else LOST
    elif counts[FAILED] > rules.hold:
        cause = UNREACHED
    elif counts[IN_A_ROW] > rules.most_overruns:
        cause = OVERRUN
    elif counts[TRIPPED] != 0:
        cause = WATCHDOG
    elif counts[MODE] == START and k > _LONGEST_START * (rules.settle + 100):
        cause = UNSETTLED
    elif counts[BEGAN] >= 0 and k - counts[BEGAN] >= samples:
        cause = OVER
    return cause


@kernel
def decide(rules: Rules, watch: Watch, k: int, wished: float, r: float, f_hat: float) -> float:
    """Return the u to apply, given what the controller wishes; in RUN, trip where a limit is passed.

    ``r`` is the reference of this sample, ``f_hat`` the estimate after it, zero where the controller has none.
    """
    counts, values = watch.counts, watch.values
    u = 0.0
    if counts[MODE] == RUN:
        u = min(max(wished, rules.low), rules.high)
        counts[AT_LIMIT] = counts[AT_LIMIT] + 1 if u == rules.low or u == rules.high else 0
        if not is_finite(wished):
            change(watch, k, RAMP, NOT_A_NUMBER)
        elif not abs(r - values[Y]) <= rules.most_error:
            change(watch, k, RAMP, ERROR)
        elif not abs(f_hat) <= rules.most_f:
            change(watch, k, RAMP, F_HAT)
        elif counts[AT_LIMIT] > rules.most_saturated:
            change(watch, k, RAMP, SATURATED)
    elif counts[MODE] == HOLD:
        u = values[U]
    if counts[MODE] == RAMP:
        counts[SAMPLES] += 1
        left = rules.ramp - counts[SAMPLES]
        u = values[FROM] * left / rules.ramp
        if left <= 0 or values[FROM] == 0.0:
            u = 0.0
            change(watch, k, STOPPED, RAMPED)
    elif counts[MODE] == STOPPED:
        counts[SAMPLES] += 1
    values[U] = u
    return u


@kernel
def finished(watch: Watch) -> bool:
    """Tell whether u is zero and was written often enough."""
    return watch.counts[MODE] == STOPPED and watch.counts[SAMPLES] > FLUSH


def changes(watch: Watch, first: int = 0) -> NDArray[np.int64]:
    """Return the changes of mode (·, 3) from number ``first`` on, while the loop may be running."""
    return watch.changes[first : load_acquire(watch.counts, CHANGES)].copy()
