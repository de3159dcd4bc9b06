"""The supervisor: safety rules, modes, the reference of a run, and the safe action after a fault.

The supervisor: after a fault it holds u, then ramps it to zero, then stops.

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

A check of the signs of y, u and b0 by the first motion after the controller takes over.

With one of the signs wrong the loop has positive feedback: y leaves its place of rest against the
push of u, and ``|r − y|`` grows by a factor e in about 1/omega_c. A load, a zero in the right half
plane and noise move y against u as well, but not so far. So the run ends only if

1. y first moves (beyond its noise before the run, and 2 % of the reach of u) against the sum of
   ``sign(b0) u`` so far, while the reference already goes the other way and is further away from
   the place of rest than y. A load that moves y before the reference moves ends the check. So
   does a first motion in the right direction: signs do not change during a run;
2. y then goes on to twice the largest of three distances: the reference's distance from the
   place of rest, the reach of u (``quell.realtime.supervisor.reach``), and ten times the noise;
   while u pushes the other way with at least half of its limit.

The numbers come from random honest loops with loads, friction, delays, zeros in the right half
plane and learners, and the same loops with a wrong sign: ``benchmarks/direction.py``.

A check of the sign of b0 of a compensator, whose reference is known to its host only.

While u is not at a limit, ``f̂ + b0 u = b0 u_0`` by definition, with each sign of b0. At a limit
that sum is what really moves y, ``y^(n)`` without a model. With the wrong sign it goes against
``b0 u``, and the compensator, which takes this for a load, holds u at the limit. So in each sample
at a limit ``−(f̂ + b0 u) b0 u``, in units of the largest ``(b0 u)²``, is added to a score, and in
the others a quarter is taken from it. The run ends where the score is above eight lag times of the
observer. A load within the limits of u keeps it at zero; a spring that swings at a limit brought it
to 5.8 lag times, in the worst of 300 honest loops (``benchmarks/proxy_faults.py``).

The host of a loop.

The proxy (``quell.realtime.proxy``) is driven by a host. Without one it stays in START, ready, with
u at zero. A host that ends its session brings it through RAMP and STOPPED back to START; one that
falls silent ends the run as any other fault does.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.sized import Scalars
from quell.realtime.system import load_acquire, store_release
from quell.types import Vector

# ---- Modes of the supervisor, causes of a change of mode, and requests to the loop ----


class Mode(IntEnum):
    """State of the supervisor, the channel ``mode``; see ``quell.realtime.supervisor``."""

    START = 0
    RUN = 1
    HOLD = 2
    RAMP = 3
    STOPPED = 4


class Request(IntEnum):
    """A request of another thread to the loop; a higher one prevails."""

    NONE = 0
    RAMP = 1  #: ramp u to zero
    ZERO = 2  #: set u to zero at once


class Host(IntEnum):
    """The host that a loop needs; a loop with a reference of its own needs none."""

    PRESENT = 0  #: it commands, or none is needed
    ABSENT = 1  #: there is none, or it has not sent a command yet
    LOST = 2  #: it fell silent in the middle of its session


class Ending(IntEnum):
    """The way in which a cause ends the run."""

    NO = 0  #: it does not: the run goes on, or had ended already
    COMPLETED = 1  #: the scenario was run to its end
    REQUESTED = 2  #: the run was asked to stop
    FAULT = 3  #: a limit or a fault stopped it


class Cause(IntEnum):
    """Cause of a change of mode."""

    text: str  #: the cause as a clause
    ending: Ending  #: how it ends the run

    def __new__(cls, number: int, text: str = "", ending: Ending = Ending.FAULT) -> Cause:
        """Return the member with this number."""
        member = int.__new__(cls, number)
        member._value_, member.text, member.ending = number, text, ending
        return member

    NONE = 0, "it began", Ending.NO
    SETTLED = 1, "enough good samples were seen", Ending.NO
    MISSED = 2, "no measurement came in time, or one that is not finite", Ending.NO
    RECOVERED = 3, "a good measurement came", Ending.NO
    LOST = 4, "too many samples in a row were missed: look at the device and the wire"
    STALLED = 5, "the loop stood still for too many samples: look at the load of the machine"
    OVERRUN = (
        6,
        "too many cycles in a row took longer than a sample: take a longer dt, or less work",
    )
    UNREACHABLE = 7, "too many commands in a row could not be sent: look at the wire"
    WATCHDOG = 8, "the device set u to zero for good: commands came too late, or it was ended"
    TRACKING_ERROR = 9, "|r − y| went beyond most_error"
    F_HAT = 10, "|f_hat| went beyond most_f"
    SATURATED = 11, "u lay at a limit for longer than most_saturated samples"
    NOT_A_NUMBER = 12, "the controller's u was not finite"
    STOP_REQUESTED = 13, "it was asked to stop", Ending.REQUESTED
    ZERO_REQUESTED = 14, "it was asked to stop at once", Ending.REQUESTED
    COMPLETED = 15, "the scenario is over", Ending.COMPLETED
    RAMPED = 16, "u is zero", Ending.NO
    NO_MEASUREMENT = 17, "no measurement ever came: is the device running?"
    UNSETTLED = 18, "there were never enough good samples in a row to begin with"
    IMPLAUSIBLE = (
        19,
        "y went beyond y_min … y_max: look at the sensor; set them where the plant may go further",
    )
    WRONG_WAY = (
        20,
        "y ran away against u: look at the sign of y, of u and of b0, or for a load beyond u's "
        "limits",
    )
    HOST_LEFT = 21, "the host has ended its session", Ending.REQUESTED
    HOST_LOST = 22, "no command of the host came in time: look at the host and its wire"
    WAITING = 23, "u is zero, the next host may come", Ending.NO


# ---- Rules and state of the supervisor ----

# Number of changes of mode that are kept (128 KiB). The last ones are reserved for the end of the
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
    y_low: float = -np.inf  #: plausible range of y [y-unit]
    y_high: float = np.inf
    longest_start: int = 1 << 60  #: samples after which START is given up
    direction: float = 0.0  #: sign of b0; 0 for no check of the first motion
    reach: float = np.nan  #: error at which the law puts u to its limit [y-unit]
    b0: float = np.nan  #: of a compensator [y-unit/s^n per u-unit]
    most_opposed: float = np.inf  #: largest score of the check of its sign [samples]

    def text(self, dt: float) -> str:
        """Return the rules as a line of text, for a sample time ``dt`` [s]."""
        parts = [f"u from {self.low:.6g} to {self.high:.6g}", *self.bounds_text()]
        parts.append(checked_text(bool(self.direction), self.most_opposed))
        return ", ".join([*parts, *counts_of_samples(self, dt)])

    def bounds_text(self) -> list[str]:
        """Return the bounds of y, of the error and of f̂ as text, where there are some."""
        parts = []
        if np.isfinite([self.y_low, self.y_high]).any():
            parts.append(f"y from {self.y_low:.6g} to {self.y_high:.6g}")
        if np.isfinite(self.most_error):
            parts.append(f"|r − y| up to {self.most_error:.6g}")
        if np.isfinite(self.most_f):
            parts.append(f"|f̂| up to {self.most_f:.6g}")
        return parts


class AxesLimits(NamedTuple):
    """The supervisor's rules for several axes, for kernels; names are those of ``Rules``."""

    low: Vector  #: (m,)
    high: Vector
    most_error: Vector  #: (n,)
    most_f: Vector
    y_low: Vector
    y_high: Vector
    direction: Vector  #: 1, or 0 for no check of the first motion
    reach: Vector
    push: Vector  #: largest ``|v|`` within the limits of u, with the first B0 [y-unit/s^n]
    most_opposed: Vector
    hold: int
    ramp: int
    settle: int
    most_saturated: int
    most_overruns: int
    longest_start: int


@dataclass(frozen=True, eq=False)
class AxesRules:
    """The supervisor's rules for several axes; ``Safety.rules`` makes them."""

    names: tuple[str, ...]  #: of the axes
    limits: AxesLimits  #: numbers for all, and arrays with one for each axis or actuator

    def text(self, dt: float) -> str:
        """Return the rules as a line of text, for a sample time ``dt`` [s]."""
        limits, parts = self.limits, []
        for k, (low, high) in enumerate(zip(limits.low, limits.high, strict=True)):
            parts.append(f"u[{k}] from {low:.6g} to {high:.6g}")
        for i, name in enumerate(self.names):
            own = Rules(
                *(0.0, 0.0, limits.most_error[i], limits.most_f[i]),
                *(limits.hold, limits.ramp, limits.settle),
                *(limits.most_saturated, limits.most_overruns),
                *(limits.y_low[i], limits.y_high[i]),
            )
            parts += [f"{name}: {part}" for part in own.bounds_text()]
        checked = checked_text(bool(np.any(limits.direction)), float(np.min(limits.most_opposed)))
        return ", ".join([*parts, checked, *counts_of_samples(limits, dt)])

    def _asdict(self) -> dict[str, Any]:
        """Return the rules by name, as ``Rules`` does; lists have one for each signal."""
        found = {"axes": list(self.names)}
        for name, value in self.limits._asdict().items():
            found[name] = value.tolist() if isinstance(value, np.ndarray) else value
        return found


def checked_text(first_motion: bool, most_opposed: float) -> str:
    """Return which check of signs there is as text."""
    if np.isfinite(most_opposed):
        return "sign of b0 checked"
    return "first motion checked" if first_motion else "first motion not checked"


def counts_of_samples(rules: Any, dt: float) -> list[str]:
    """Return the rules that are numbers of samples as text, with their times."""
    parts = []
    for name in ("settle", "hold", "ramp", "most_overruns", "most_saturated"):
        samples = getattr(rules, name)
        if samples * dt < 1e9:
            parts.append(f"{name} {samples} samples ({samples * dt:.6g} s)")
    return parts


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
    tripped: int  #: not zero if the device has set u to zero for good
    u: float  #: as applied [u-unit]
    ramp_start: float  #: u at the beginning of the ramp [u-unit]
    y: float  #: last good measurement [y-unit]; NaN before the first
    offset: float  #: distance from the reference to y at the scenario's first sample [y-unit]
    y_rest_low: float  #: least y since the first cycle, before the scenario [y-unit]
    y_rest_high: float  #: largest
    y_began: float  #: y at the scenario's first sample [y-unit]
    pushed: float  #: sum of u since then, with the sign of b0 [u-unit]
    watching: int  #: how the first motion is judged, see ``quell.realtime.supervisor``
    culprit: int  #: number of the signal, from 1, to which the next change is due; 0 if to none
    opposed: float  #: score of the check of the sign of b0 [samples]
    forgiven: int  #: missed samples in a row after which START goes on to count good ones
    host: int  #: a ``Host``
    waited: int  #: index k of the last cycle without a host
    ended_by: int  #: cause of the last RAMP, or of STOPPED without one
    ended_signal: int  #: its signal, as ``culprit``


class Counters(Scalars):
    """Counters of a run; the first fields of ``quell.realtime.run.Tally``, in its order."""

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
    #: k, mode, cause and number of the signal from 1, or 0, of each change of mode (·, 4)
    changes: NDArray[np.int64]
    changed: NDArray[np.int64]  #: number of changes of mode that are kept (1,), an atomic word
    requests: NDArray[np.int64]  #: a ``Request`` (1,), an atomic word that another thread writes
    #: twice the number of control steps, odd during one (1,): an atomic word
    steps: NDArray[np.int64]


def initial_state() -> SupervisorState:
    """Return the state before the first cycle."""
    memory, (changed, requests, steps) = Memory.zeros(), np.zeros((3, 1), np.int64)
    memory[0].began, memory[0].y = -1, np.nan
    memory[0].y_rest_low, memory[0].y_rest_high = np.inf, -np.inf
    changes = np.zeros((_KEPT, 4), np.int64)
    return SupervisorState(memory, Counters.zeros(), changes, changed, requests, steps)


# ---- A check of the signs of y, u and b0 by the first motion after the controller takes over ----

OFF, ARMED, SUSPECT = 0, 1, 2
"""Values of ``Memory.watching``: no check, no motion so far, y first moved against u."""

# Shares of the reach of u that count as a motion, and as a motion in the right direction later on.
_MOTION, _RIGHT = 0.02, 0.05
# Range of y before the run, times this, is noise: ten times what was seen in that short time.
_NOISE = 10.0
# Twice the largest distance: honest loops came to 1.07 of it, under a load of half of u's limit.
_FAR = 2.0
_STRONG = 0.5  # share of a limit of u


@kernel
def runs_away(rules: Any, memory: Memory, r: float) -> bool:
    """Return whether y runs away against u, in a sample of RUN with the reference ``r``.

    ``rules`` are ``Rules``, or have their ``low``, ``high``, ``direction`` and ``reach``.

    ``memory.u`` is the u that acted until this sample.
    """
    if memory.watching == OFF:
        return False
    push = rules.direction * memory.u
    memory.pushed += push
    moved, wanted = memory.y - memory.y_began, r - memory.y_began
    against = moved * memory.pushed < 0.0
    noise = _NOISE * (memory.y_rest_high - memory.y_rest_low)
    if memory.watching == ARMED and abs(moved) > max(noise, _MOTION * rules.reach):
        first = against and wanted * memory.pushed > 0.0 and abs(wanted) >= abs(moved)
        memory.watching = SUSPECT if first else OFF
    if memory.watching != SUSPECT or push * memory.pushed <= 0.0:
        return False
    if not against:
        if abs(moved) > max(noise, _RIGHT * rules.reach):
            memory.watching = OFF
        return False
    limit = rules.high if memory.u > 0.0 else -rules.low
    far = _FAR * max(abs(wanted), rules.reach, noise)
    return abs(memory.u) >= _STRONG * limit and abs(moved) > far


# Taken from the score of the check of b0 in a sample in which u is not at a limit. Chosen with the
# lag times of ``quell.realtime.safety`` by random loops: benchmarks/proxy_faults.py.
_FORGIVEN = 0.25


@kernel
def is_opposed(memory: Memory, most: float, v: float, f_hat: float, push: float, at: bool) -> bool:
    """Update the score of the check of the sign of b0; return whether it is above ``most``.

    ``v`` is b0 times the u that acted until this sample, ``push`` the largest, and ``at`` says
    whether u was at a limit.
    """
    if not is_finite(most):
        return False
    if at:
        memory.opposed -= min(max((f_hat + v) * v / (push * push), -1.0), 1.0)
    else:
        memory.opposed -= _FORGIVEN
    memory.opposed = max(memory.opposed, 0.0)
    return memory.opposed > most


# ---- The supervisor ----

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
    if mode >= Mode.RAMP and cause != Cause.RAMPED:
        memory.ended_by, memory.ended_signal = cause, memory.culprit
    number = state.changed[0]
    kept = state.changes.shape[0]
    if number < kept - RESERVED or (number < kept and mode >= Mode.RAMP):
        state.changes[number, 0] = k
        state.changes[number, 1] = mode
        state.changes[number, 2] = cause
        state.changes[number, 3] = memory.culprit
        store_release(state.changed, 0, number + 1)
    memory.culprit = 0


@kernel
def update_mode(rules: Rules, state: SupervisorState, k: int, y: float, samples: int) -> None:
    """Choose the mode of cycle ``k`` before the controller's step.

    ``y`` is the measurement, ``samples`` the number of samples of the scenario.
    """
    memory = state.memory[0]
    good, settling = is_finite(y), memory.mode == Mode.START
    if good:
        memory.y = y
    outside = memory.y < rules.y_low or memory.y > rules.y_high
    choose_mode(rules, state, k, good, 1 if outside else 0, samples)
    if settling and memory.mode == Mode.RUN:
        memory.at_limit_in_row = 0
        begin_watch(memory, y, rules.direction)
    elif settling and good and memory.mode == Mode.START:
        widen_rest(memory, y)


@kernel
def begin_watch(memory: Memory, y: float, direction: float) -> None:
    """Begin to judge the first motion, from y on, unless ``direction`` is 0."""
    memory.y_began, memory.opposed = y, 0.0
    memory.watching = ARMED if direction != 0.0 else OFF


@kernel
def widen_rest(memory: Memory, y: float) -> None:
    """Take y into the range before the scenario."""
    memory.y_rest_low = min(memory.y_rest_low, y)
    memory.y_rest_high = max(memory.y_rest_high, y)


@kernel
def choose_mode(
    rules: Any, state: SupervisorState, k: int, good: bool, outside: int, samples: int
) -> None:
    """Choose the mode of cycle ``k``; ``rules`` are those of one axis or of several.

    ``good`` says whether all measurements came, ``outside`` is the number, from 1, of one beyond
    its plausible range, 0 if there is none.
    """
    memory = state.memory[0]
    if not good:
        memory.missed_in_row += 1
        state.counters[0].missed += 1
    if memory.host != Host.PRESENT:
        memory.waited = k
    mode = memory.mode
    request = load_acquire(state.requests, 0)
    if request == Request.ZERO and mode != Mode.STOPPED:
        change_mode(state, k, Mode.STOPPED, Cause.ZERO_REQUESTED)
    elif mode <= Mode.HOLD:
        cause = _cause_to_end(rules, memory, k, request, outside, samples)
        if cause != Cause.NONE:
            change_mode(state, k, Mode.RAMP, cause)
        elif mode == Mode.START:
            if not good:
                memory.samples = 0 if memory.missed_in_row > memory.forgiven else memory.samples
            elif memory.samples < rules.settle:
                memory.samples += 1
            elif memory.host == Host.PRESENT:
                change_mode(state, k, Mode.RUN, Cause.SETTLED)
                memory.began = k
        elif good and mode == Mode.HOLD:
            change_mode(state, k, Mode.RUN, Cause.RECOVERED)
        elif not good and mode == Mode.RUN:
            change_mode(state, k, Mode.HOLD, Cause.MISSED)
    if good:
        memory.missed_in_row = 0
        memory.skipped_in_row = 0


@kernel
def _cause_to_end(
    rules: Any, memory: Memory, k: int, request: int, outside: int, samples: int
) -> int:
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
    elif outside != 0:
        cause, memory.culprit = Cause.IMPLAUSIBLE, outside
    elif memory.host == Host.LOST:
        cause = Cause.HOST_LOST
    elif memory.host == Host.ABSENT and memory.mode != Mode.START:
        cause = Cause.HOST_LEFT
    elif memory.mode == Mode.START and k - memory.waited > rules.longest_start:
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
        at_limit = memory.at_limit_in_row > 0
        push = rules.b0 * max(rules.high, -rules.low)
        opposed = is_opposed(memory, rules.most_opposed, rules.b0 * memory.u, f_hat, push, at_limit)
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
        elif opposed or runs_away(rules, memory, r):
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
def wait_for_host(state: SupervisorState, k: int) -> None:
    """Begin again in START, after a host has ended its session and u is zero."""
    memory = state.memory[0]
    memory.began, memory.waited = -1, k
    change_mode(state, k, Mode.START, Cause.WAITING)


@kernel
def finished(state: SupervisorState) -> bool:
    """Return whether u is zero and was written often enough."""
    return state.memory[0].mode == Mode.STOPPED and state.memory[0].samples > FLUSH
