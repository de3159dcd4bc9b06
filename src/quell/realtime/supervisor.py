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

One axis is the case of one y and one u. Of several a sample is good if all measurements came: if
one did not, all u are held, and the observers of the other axes go on with their own. After a fault
all u go to zero together, each in a straight line, because a machine of which one axis is still
driven is no safer than one that is not. The cause names the signal to which it is due:
``Memory.culprit``. Each axis is judged by v, the share of all u that moves it: ``b0 u`` of one
axis, ``(B0 u)_i`` of several.

All of it is arithmetic on arrays, so that tests can run it without a clock or a device.

A check of the signs of y, u and b0 by the first motion after the controller takes over.

With one of the signs wrong the loop has positive feedback: y leaves its place of rest against the
push of u, and ``|r − y|`` grows by a factor e in about 1/omega_c. A load, a zero in the right half
plane and noise move y against u as well, but not so far. So the run ends only if

1. y first moves (beyond its noise before the run, and 2 % of the reach of u) against the sum of v
   so far, while the reference already goes the other way and is further away from
   the place of rest than y. A load that moves y before the reference moves ends the check. So
   does a first motion in the right direction: signs do not change during a run;
2. y then goes on to twice the largest of three distances: the reference's distance from the
   place of rest, the reach of u (``quell.realtime.supervisor.reach``), and ten times the noise;
   while v pushes the other way with at least half of its limit.

The numbers come from random honest loops with loads, friction, delays, zeros in the right half
plane and learners, and the same loops with a wrong sign: ``benchmarks/direction.py``.

A check of the sign of b0 of a compensator, whose reference is known to its host only.

While u is not at a limit, ``f̂ + v = b0 u_0`` by definition, with each sign of b0. At a limit
that sum is what really moves y, ``y^(n)`` without a model. With the wrong sign it goes against
v, and the compensator, which takes this for a load, holds u at the limit. So in each sample
at a limit ``−(f̂ + v) v``, in units of the largest ``v²``, is added to a score, and in
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
from quell.kernels.sized import Scalars, Work
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


class RunLimits(NamedTuple):
    """The supervisor's rules for n axes and m control signals, as kernels take them."""

    low: Vector  #: lower limits of u [u-unit], ≤ 0 (m,)
    high: Vector  #: upper limits, ≥ 0
    most_error: Vector  #: largest ``|r − y|`` [y-unit] (n,)
    most_f: Vector  #: largest ``|f̂|`` [y-unit/s^n]
    y_low: Vector  #: plausible range of y [y-unit]
    y_high: Vector
    direction: Vector  #: 1, or 0 for no check of the first motion
    reach: Vector  #: error at which the law puts u to its limit [y-unit]
    b0: Vector  #: v = b0 u of one axis; several axes know their v themselves
    v_low: Vector  #: least v within the limits of u, with the first B0 [y-unit/s^n]
    v_high: Vector  #: and largest
    most_opposed: Vector  #: largest score of the check of the sign of b0 [samples]
    hold: int
    ramp: int
    settle: int
    most_saturated: int
    most_overruns: int
    longest_start: int = 1 << 60  #: samples after which START is given up


@dataclass(frozen=True, eq=False)
class Rules:
    """The supervisor's rules; ``Safety.rules`` makes them."""

    names: tuple[str, ...]  #: of several axes; none of one
    limits: RunLimits

    def text(self, dt: float) -> str:
        """Return the rules as a line of text, for a sample time ``dt`` [s]."""
        rules, parts = self.limits, []
        for k, (low, high) in enumerate(zip(rules.low, rules.high, strict=True)):
            name = f"u[{k}]" if self.names else "u"
            parts.append(f"{name} from {low:.6g} to {high:.6g}")
        for i, name in enumerate(self.names or ("",)):
            before = f"{name}: " if name else ""
            if np.isfinite([rules.y_low[i], rules.y_high[i]]).any():
                parts.append(f"{before}y from {rules.y_low[i]:.6g} to {rules.y_high[i]:.6g}")
            if np.isfinite(rules.most_error[i]):
                parts.append(f"{before}|r − y| up to {rules.most_error[i]:.6g}")
            if np.isfinite(rules.most_f[i]):
                parts.append(f"{before}|f̂| up to {rules.most_f[i]:.6g}")
        if np.isfinite(rules.most_opposed).any():
            parts.append("sign of b0 checked")
        else:
            parts.append(f"first motion {'checked' if np.any(rules.direction) else 'not checked'}")
        for name in ("settle", "hold", "ramp", "most_overruns", "most_saturated"):
            samples = getattr(rules, name)
            if samples * dt < 1e9:
                parts.append(f"{name} {samples} samples ({samples * dt:.6g} s)")
        return ", ".join(parts)

    def _asdict(self) -> dict[str, Any]:
        """Return the rules by name: numbers of one axis, lists with one for each of several."""
        found: dict[str, Any] = {"axes": list(self.names)} if self.names else {}
        for name, value in self.limits._asdict().items():
            each = value.tolist() if isinstance(value, np.ndarray) else value
            found[name] = each[0] if isinstance(each, list) and not self.names else each
        return found


class Memory(Scalars):
    """State of the supervisor from one cycle to the next."""

    mode: int
    samples: int  #: good samples in a row in START, cycles so far in RAMP and STOPPED
    began: int  #: index k of the scenario's first sample; −1 before it
    missed_in_row: int  #: deadlines without a good sample, those that were skipped included
    skipped_in_row: int
    overruns_in_row: int
    unsent_in_row: int
    tripped: int  #: not zero if the device has set u to zero for good
    culprit: int  #: number of the signal, from 1, to which the next change is due; 0 if to none
    forgiven: int  #: missed samples in a row after which START goes on to count good ones
    host: int  #: a ``Host``
    waited: int  #: index k of the last cycle without a host
    ended_by: int  #: cause of the last RAMP, or of STOPPED without one
    ended_signal: int  #: its signal, as ``culprit``


class Watch(Scalars):
    """The judgement of an axis by its first motion and the sign of its b0."""

    y: float  #: last good measurement [y-unit]; NaN before the first
    y_rest_low: float  #: least y since the first cycle, before the scenario [y-unit]
    y_rest_high: float  #: largest
    y_began: float  #: y at the scenario's first sample [y-unit]
    pushed: float  #: sum of v since then
    watching: int  #: how the first motion is judged, see ``quell.realtime.supervisor``
    opposed: float  #: score of the check of the sign of b0 [samples]


class Counters(Scalars):
    """Counters of a run; the first fields of ``quell.realtime.run.Tally``, in its order."""

    cycles: int
    overruns: int
    skipped: int
    missed: int
    clipped: int
    unsent: int


class LoopSignals(NamedTuple):
    """The signals of a loop from one cycle to the next, for n axes and m control signals."""

    y: Vector  #: as measured in this sample; NaN for what has not come (n,)
    measured: Vector  #: what the controller gets: NaN in a sample that was skipped (n,)
    r: Vector  #: references of this sample (n,)
    f_hat: Vector  #: estimates after it; zero without (n,)
    offset: Vector  #: distances from the references to y at the scenario's first sample (n,)
    v: Vector  #: share of the applied u that moves each axis [y-unit/s^n] (n,)
    wished: Vector  #: the controller's u (m,)
    u: Vector  #: as applied (m,)
    acting: Vector  #: what acts at a device with a clock of its own (m,)
    next: Work  #: u of this sample, before it is applied (m,)
    ramp_start: Vector  #: u at the beginning of the ramp (m,)
    at_limit: NDArray[np.int64]  #: samples in a row with u at a limit (m,)
    watched: NDArray[Watch]  #: (n,)


class SupervisorState(NamedTuple):
    """State of the supervisor, which the loop writes and another thread may read."""

    memory: NDArray[Memory]
    counters: NDArray[Counters]
    signals: LoopSignals
    #: k, mode, cause and number of the signal from 1, or 0, of each change of mode (·, 4)
    changes: NDArray[np.int64]
    changed: NDArray[np.int64]  #: number of changes of mode that are kept (1,), an atomic word
    requests: NDArray[np.int64]  #: a ``Request`` (1,), an atomic word that another thread writes
    #: twice the number of control steps, odd during one (1,): an atomic word
    steps: NDArray[np.int64]


def initial_state(outputs: int = 1, inputs: int = 1) -> SupervisorState:
    """Return the state before the first cycle, for n axes and m control signals."""
    memory, (changed, requests, steps) = Memory.zeros(), np.zeros((3, 1), np.int64)
    memory[0].began = -1
    watched = np.zeros(outputs, Watch.zeros().dtype)
    for each in watched:
        each.y, each.y_rest_low, each.y_rest_high = np.nan, np.inf, -np.inf
    signals = LoopSignals(
        y=np.full(outputs, np.nan),
        measured=np.full(outputs, np.nan),
        r=np.zeros(outputs),
        f_hat=np.zeros(outputs),
        offset=np.zeros(outputs),
        v=np.zeros(outputs),
        wished=np.zeros(inputs),
        u=np.zeros(inputs),
        acting=np.zeros(inputs),
        next=np.zeros(inputs),
        ramp_start=np.zeros(inputs),
        at_limit=np.zeros(inputs, dtype=np.int64),
        watched=watched,
    )
    changes = np.zeros((_KEPT, 4), np.int64)
    return SupervisorState(memory, Counters.zeros(), signals, changes, changed, requests, steps)


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
def runs_away(rules: RunLimits, signals: LoopSignals, i: int) -> bool:
    """Return whether axis i runs away against u, in a sample of RUN.

    ``signals.v`` is that of the u which acted until this sample, ``signals.r`` the references.
    """
    watch, v = signals.watched[i], signals.v[i]
    if watch.watching == OFF:
        return False
    watch.pushed += v
    moved, wanted, reach = watch.y - watch.y_began, signals.r[i] - watch.y_began, rules.reach[i]
    against = moved * watch.pushed < 0.0
    noise = _NOISE * (watch.y_rest_high - watch.y_rest_low)
    if watch.watching == ARMED and abs(moved) > max(noise, _MOTION * reach):
        first = against and wanted * watch.pushed > 0.0 and abs(wanted) >= abs(moved)
        watch.watching = SUSPECT if first else OFF
    if watch.watching != SUSPECT or v * watch.pushed <= 0.0:
        return False
    if not against:
        if abs(moved) > max(noise, _RIGHT * reach):
            watch.watching = OFF
        return False
    limit = rules.v_high[i] if v > 0.0 else -rules.v_low[i]
    far = _FAR * max(abs(wanted), reach, noise)
    return abs(v) >= _STRONG * limit and abs(moved) > far


# Taken from the score of the check of b0 in a sample in which u is not at a limit. Chosen with the
# lag times of ``quell.realtime.safety`` by random loops: benchmarks/proxy_faults.py.
_FORGIVEN = 0.25


@kernel
def is_opposed(rules: RunLimits, signals: LoopSignals, i: int, at_limit: bool) -> bool:
    """Update the score of the check of the sign of b0; return whether it is above its largest.

    ``signals.v`` is that of the u which acted until this sample, ``signals.f_hat`` the estimate
    after it, and ``at_limit`` says whether that u was at a limit.
    """
    watch, v = signals.watched[i], signals.v[i]
    if not is_finite(rules.most_opposed[i]):
        return False
    if at_limit:
        push = max(rules.v_high[i], -rules.v_low[i])
        change = (signals.f_hat[i] + v) * v / (push * push)
        watch.opposed -= min(max(change, -1.0), 1.0)
    else:
        watch.opposed -= _FORGIVEN
    watch.opposed = max(watch.opposed, 0.0)
    return watch.opposed > rules.most_opposed[i]


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
        for c in range(state.signals.u.size):
            state.signals.ramp_start[c] = state.signals.u[c]
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
def update_mode(rules: RunLimits, state: SupervisorState, k: int, samples: int) -> None:
    """Choose the mode of cycle ``k`` before the controller's step, by its measurements.

    ``samples`` is the number of samples of the scenario.
    """
    memory, signals = state.memory[0], state.signals
    count, missing, last, outside = signals.y.size, 0, 0, 0
    for i in range(count):
        watch = signals.watched[i]
        if is_finite(signals.y[i]):
            watch.y = signals.y[i]
        else:
            missing, last = missing + 1, i + 1
        if outside == 0 and (watch.y < rules.y_low[i] or watch.y > rules.y_high[i]):
            outside = i + 1
    good, settling = missing == 0, memory.mode == Mode.START
    memory.culprit = 0 if missing == count else last
    _choose_mode(rules, state, k, good, outside, samples)
    memory.culprit = 0
    if settling and memory.mode == Mode.RUN:
        for c in range(signals.at_limit.size):
            signals.at_limit[c] = 0
        for i in range(count):
            watch = signals.watched[i]
            watch.y_began, watch.opposed = signals.y[i], 0.0
            watch.watching = ARMED if rules.direction[i] != 0.0 else OFF
    elif settling and good and memory.mode == Mode.START:
        for i in range(count):
            watch = signals.watched[i]
            watch.y_rest_low = min(watch.y_rest_low, signals.y[i])
            watch.y_rest_high = max(watch.y_rest_high, signals.y[i])


@kernel
def _choose_mode(
    rules: RunLimits, state: SupervisorState, k: int, good: bool, outside: int, samples: int
) -> None:
    """Choose the mode of cycle ``k``.

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
    rules: RunLimits, memory: Memory, k: int, request: int, outside: int, samples: int
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
def supervise_controls(rules: RunLimits, state: SupervisorState, k: int) -> None:
    """Write the u to apply in cycle ``k``; in RUN, end the run if a limit is exceeded.

    ``state.signals`` have the controller's u, and references and f̂ of this sample.
    """
    memory, signals = state.memory[0], state.signals
    count = signals.u.size
    for c in range(count):
        signals.next[c] = signals.u[c] if memory.mode == Mode.HOLD else 0.0
    if memory.mode == Mode.RUN:
        _limit_and_end(rules, state, k)
    if memory.mode == Mode.RAMP:
        memory.samples += 1
        left, most = rules.ramp - memory.samples, 0.0
        for c in range(count):
            signals.next[c] = signals.ramp_start[c] * left / rules.ramp
            most = max(most, abs(signals.ramp_start[c]))
        if left <= 0 or most == 0.0:
            for c in range(count):
                signals.next[c] = 0.0
            change_mode(state, k, Mode.STOPPED, Cause.RAMPED)
    elif memory.mode == Mode.STOPPED:
        memory.samples += 1
    for c in range(count):
        signals.u[c] = signals.next[c]


@kernel
def _limit_and_end(rules: RunLimits, state: SupervisorState, k: int) -> None:
    """Put the controller's u within its limits; change the mode to RAMP if a rule is broken."""
    memory, signals = state.memory[0], state.signals
    was_at_limit, cause, culprit = False, Cause.NONE, 0
    for c in range(signals.u.size):
        was_at_limit |= signals.at_limit[c] > 0
    for c in range(signals.u.size):
        u = min(max(signals.wished[c], rules.low[c]), rules.high[c])
        signals.next[c] = u
        at_limit = u == rules.low[c] or u == rules.high[c]
        signals.at_limit[c] = signals.at_limit[c] + 1 if at_limit else 0
    for i in range(signals.watched.size):  # the later ones of these rules go first
        opposed = is_opposed(rules, signals, i, was_at_limit)
        if runs_away(rules, signals, i) or opposed:
            cause, culprit = Cause.WRONG_WAY, i + 1
    for c in range(signals.u.size):
        if signals.at_limit[c] > rules.most_saturated:
            cause, culprit = Cause.SATURATED, c + 1
    for i in range(signals.watched.size):
        if not abs(signals.f_hat[i]) <= rules.most_f[i]:
            cause, culprit = Cause.F_HAT, i + 1
    for i in range(signals.watched.size):
        if not abs(signals.r[i] - signals.watched[i].y) <= rules.most_error[i]:
            cause, culprit = Cause.TRACKING_ERROR, i + 1
    for c in range(signals.u.size):
        if not is_finite(signals.wished[c]):
            cause, culprit = Cause.NOT_A_NUMBER, c + 1
    if cause != Cause.NONE:
        memory.culprit = culprit
        change_mode(state, k, Mode.RAMP, cause)


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


@kernel
def all_measured(state: SupervisorState) -> bool:
    """Return whether each measurement has come once."""
    for i in range(state.signals.watched.size):  # noqa: SIM110  kernels keep to loops
        if not is_finite(state.signals.watched[i].y):
            return False
    return True
