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

Safety rules: when a running loop goes to its safe state, and how.

The reference of a run: its samples, and the approach to it from the first y.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quell import checks
from quell.controllers import ADRC
from quell.controllers.base import Controller
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.sized import Buffer, Scalars
from quell.realtime.system import load_acquire, store_release
from quell.records.record import in_steps
from quell.signals import Signal, as_signal
from quell.signals.shapes import check_derivative
from quell.simulation.driver import Scenario
from quell.types import Matrix, Vector

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


# ---- Rules and state of the supervisor ----

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
    y_low: float = -np.inf  #: plausible range of y [y-unit]
    y_high: float = np.inf
    longest_start: int = 1 << 60  #: samples after which START is given up
    direction: float = 0.0  #: sign of b0; 0 for no check of the first motion
    reach: float = np.nan  #: error at which the law puts u to its limit [y-unit]

    def text(self, dt: float) -> str:
        """Return the rules as a line of text, for a sample time ``dt`` [s]."""
        parts = [f"u from {self.low:.6g} to {self.high:.6g}"]
        if np.isfinite([self.y_low, self.y_high]).any():
            parts.append(f"y from {self.y_low:.6g} to {self.y_high:.6g}")
        if np.isfinite(self.most_error):
            parts.append(f"|r − y| up to {self.most_error:.6g}")
        if np.isfinite(self.most_f):
            parts.append(f"|f̂| up to {self.most_f:.6g}")
        parts.append("first motion checked" if self.direction else "first motion not checked")
        for name in ("settle", "hold", "ramp", "most_overruns", "most_saturated"):
            samples = getattr(self, name)
            if samples * dt < 1e9:
                parts.append(f"{name} {samples} samples ({samples * dt:.6g} s)")
        return ", ".join(parts)


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
    changes: NDArray[np.int64]  #: k, mode and cause of each change of mode (·, 3)
    changed: NDArray[np.int64]  #: number of changes of mode that are kept (1,), an atomic word
    requests: NDArray[np.int64]  #: a ``Request`` (1,), an atomic word that another thread writes
    #: twice the number of control steps, odd during one (1,): an atomic word
    steps: NDArray[np.int64]


def initial_state() -> SupervisorState:
    """Return the state before the first cycle."""
    memory, (changed, requests, steps) = Memory.zeros(), np.zeros((3, 1), np.int64)
    memory[0].began, memory[0].y = -1, np.nan
    memory[0].y_rest_low, memory[0].y_rest_high = np.inf, -np.inf
    changes = np.zeros((_KEPT, 3), np.int64)
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
def runs_away(rules: Rules, memory: Memory, r: float) -> bool:
    """Return whether y runs away against u, in a sample of RUN with the reference ``r``.

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


# ---- Default bounds of y, derived from the reference and from what the control signal can do ----

# Default distance from the reference's range to a bound of y, in units of that range plus the reach
# of u. In 1500 random stable loops with loads of up to 0.9 of u's limit, y left the range by at
# most 6.5 of these units (two seeds of benchmarks/direction.py).
_MARGIN = 10.0
# The same without a known b0, times the largest of 1 and |r|: as the limit of ``simulate``.
_MARGIN_WITHOUT_MODEL = 1e6


def reach(controller: Controller, low: float, high: float) -> float:
    """Return the error at which the law ``k1 e / b0`` alone puts u to its limit [y-unit].

    With all poles at −omega_c it is ``b0 max|u| / omega_c^m``. It is the scale of motions of y that
    are within the power of u: a load that u can hold moves y by a part of it. NaN for a controller
    that is not an ADRC, possibly behind prefilters.
    """
    adrc = inner_adrc(controller)
    if adrc is None:
        return float("nan")
    design = adrc.parameters
    return float(abs(design.b0) * max(abs(low), abs(high)) / design.law[0])


def inner_adrc(controller: Any) -> ADRC | None:
    """Return the ADRC behind all prefilters; None for another controller."""
    while not isinstance(controller, ADRC):
        controller = getattr(controller, "controller", None)
        if controller is None:
            return None
    return controller


def plausible_range(reference: ArrayLike, reach: float) -> tuple[float, float]:
    """Return bounds of y that a good run does not come near to [y-unit].

    ``reference`` are the samples of the reference, and ``reach`` is that of ``reach``. Zero counts
    as a value of the reference because a run usually begins there.
    """
    r = np.append(np.asarray(reference, dtype=float), 0.0)
    low, high = float(np.min(r)), float(np.max(r))
    if np.isfinite(reach):
        margin = _MARGIN * (high - low + reach)
    else:
        margin = _MARGIN_WITHOUT_MODEL * max(1.0, -low, high)
    return low - margin, high + margin


# ---- The reference of a run ----

# A record of so many samples with twenty channels takes 1.6 GB.
_MOST_SAMPLES = 10_000_000
# s(τ) of the least jerk from rest at 0 to rest at 1 (Flash & Hogan, J. Neuroscience 5, 1985, (3)).
_LEAST_JERK = np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])


class ReferenceSamples(NamedTuple):
    """The reference for all samples of a run: code is not compiled for each duration."""

    r: Buffer  # (samples,) [y-unit]
    derivatives: Buffer  # (samples, d): r', r'', …, as many as the controller uses
    approach: Buffer  # (·, 1 + d): ``approach_curve`` and its derivatives for a distance of 1
    current: Vector  # work array: derivatives of one sample (d,)


def as_scenario(value: Scenario | Signal | float, duration: float | None) -> Scenario:
    """Return a scenario, or make one of a reference that takes ``duration`` [s]."""
    if not isinstance(value, Scenario):
        if duration is None:
            raise ValueError("duration = None: give the duration [s], or a quell.Scenario")
        return Scenario(as_signal(value, "scenario"), duration)
    if value.rest_at:
        raise ValueError(
            f"rest_at = {value.rest_at!r}: a real plant can't be put back to rest; leave it out"
        )
    return value if duration is None else Scenario(value.reference, duration, seed=value.seed)


def reference_samples(
    scenario: Scenario, dt: float, derivatives: int, approach: float
) -> ReferenceSamples:
    """Return the reference for every sample, and its approach within ``approach`` [s]."""
    if scenario.duration / dt > _MOST_SAMPLES:
        times = f"duration = {scenario.duration!r} s with dt = {dt!r} s"
        raise ValueError(f"{times}: must be at most {_MOST_SAMPLES:.0e} samples")
    t = np.arange(math.floor(in_steps(scenario.duration, dt)) + 1) * dt
    signals = [scenario.seeded_signals(len(scenario.disturbances))[0]]
    for _ in range(derivatives):
        check_derivative(signals[-1])
        signals.append(signals[-1].derivative())
    columns = np.column_stack([signal(t) for signal in signals])
    finite = np.isfinite(columns).all(axis=1)
    if not finite.all():
        raise ValueError(
            f"reference: it or one of its derivatives is not finite at {t[np.argmin(finite)]:.6g} s"
        )
    curve = approach_curve(dt, checks.non_negative("approach", approach, "s"), derivatives)
    return ReferenceSamples(
        columns[:, 0].copy(), columns[:, 1:].copy(), curve, np.zeros(derivatives)
    )


def approach_curve(dt: float, time: float, derivatives: int) -> Matrix:
    """Return ``1 − s(t / time)`` and its derivatives before ``time`` [s], (·, 1 + derivatives)."""
    scale = time or 1.0
    tau = np.arange(math.ceil(in_steps(time, dt)) if time else 0) * dt / scale
    rest = 1.0 - _LEAST_JERK
    return np.column_stack(
        [(rest.deriv(i) if i else rest)(tau) / scale**i for i in range(derivatives + 1)]
    )


# ---- Safety rules ----

# More samples than any run has.
_NEVER = 1 << 60


class _Count(NamedTuple):
    """A number of samples that is also given, by another field, as a time."""

    samples: str  # field that counts samples
    time: str  # field in seconds
    default: float  # [s]
    least: int  # least samples of the default
    fewest: int  # least value of the field that counts samples


# Defaults chosen by hand for 1 kHz: hold must be shorter than the device's watchdog (20 ticks for a
# rig), and settle as long as the observer needs. A slower loop gets at least so many samples that
# one late cycle ends no run (hold, most_overruns), u goes down in small steps (ramp), and an
# observer with omega_o dt = 0.3 has settled (settle).
_COUNTS = (
    _Count("hold", "hold_time", 0.005, 5, 0),
    _Count("most_overruns", "overrun_time", 0.005, 5, 0),
    _Count("ramp", "ramp_time", 0.05, 10, 1),
    _Count("settle", "settle_time", 0.2, 20, 1),
    _Count("most_saturated", "saturated_time", math.inf, _NEVER, 1),
)
# START may take ten times as long as settle and a second more, or ten samples: enough for a device
# that misses some. Chosen by hand; not tuned further.
_START_FACTOR, _START_MORE, _START_SAMPLES = 10, 1.0, 10


@dataclass(frozen=True)
class Safety:
    """Safety rules of a loop; ``quell.realtime.supervisor`` describes its states.

    Times are rounded to whole samples, at least one. Their defaults are for 1 kHz and hold down to
    a number of samples, so that slow loops get enough of them.

    Parameters
    ----------
    u_min, u_max
        limits of the u that is sent to the device [u-unit], with zero, the safe u, between them;
        the controller's own by default. If both are given, the narrower ones hold. A loop without
        any limit is refused.
    most_error
        largest ``|r − y|`` [y-unit]; beyond it u is ramped to zero.
    most_f
        largest ``|f̂|`` [y-unit/s^n], if the controller reports one; beyond it u is ramped to zero.
    most_saturated
        number of samples in a row for which u may lie at one of its limits; any by default.
    hold
        number of samples in a row for which u is held if no good measurement comes, the loop itself
        stands still, or the device can't be reached; after that u is ramped to zero.
    most_overruns
        number of cycles in a row that may take longer than a sample.
    ramp
        number of samples in which u goes to zero.
    settle
        number of samples for which the controller observes, with u at zero, before it takes over.
    y_min, y_max
        plausible range of y [y-unit]; beyond it u is ramped to zero. By default the range of the
        reference and zero, wider by ten times the sum of that range and of the error at which the
        law puts u to its limit, ``b0 max|u| / omega_c^m``; for a controller without b0 by a million
        times the largest ``|r|`` or 1. Infinite for no limit.
    hold_time
        ``hold`` in seconds; 0.005 s by default, at least five samples.
    overrun_time
        ``most_overruns`` as the time that so many samples take [s]; 0.005 s by default, at least
        five samples.
    ramp_time
        ``ramp`` in seconds; 0.05 s by default, at least ten samples.
    settle_time
        ``settle`` in seconds; 0.2 s by default, at least twenty samples.
    saturated_time
        ``most_saturated`` in seconds; any time by default.
    check_direction
        whether u is ramped to zero if y first moves, and runs away, against the sign of b0 u
        (``quell.realtime.supervisor``); only for controllers with a b0.

    Raises
    ------
    ValueError
        for limits without zero between them, numbers out of range, or a number given both in
        samples and in seconds.
    """

    u_min: float = -math.inf
    u_max: float = math.inf
    most_error: float = math.inf
    most_f: float = math.inf
    most_saturated: int | None = None
    hold: int | None = None
    most_overruns: int | None = None
    ramp: int | None = None
    settle: int | None = None
    y_min: float | None = None
    y_max: float | None = None
    hold_time: float | None = None
    overrun_time: float | None = None
    ramp_time: float | None = None
    settle_time: float | None = None
    saturated_time: float | None = None
    check_direction: bool = True

    def __post_init__(self) -> None:
        _check_around_zero(*checks.interval("u_min", self.u_min, "u_max", self.u_max))
        checks.interval(
            *("y_min", -math.inf if self.y_min is None else self.y_min),
            *("y_max", math.inf if self.y_max is None else self.y_max),
        )
        for name in ("most_error", "most_f"):
            value = getattr(self, name)
            if value != math.inf:
                checks.positive(name, value)
        for count in _COUNTS:
            samples, time = getattr(self, count.samples), getattr(self, count.time)
            checks.optional(checks.whole, count.samples, samples, count.fewest)
            checks.optional(checks.positive, count.time, time, "s")
            if samples is not None and time is not None:
                raise ValueError(
                    f"{count.samples} = {samples!r}, {count.time} = {time!r}: give one of them, "
                    f"{count.samples} in samples or {count.time} in seconds"
                )
        checks.flag("check_direction", self.check_direction)

    def rules(self, controller: Controller, scenario: Scenario | None = None) -> Rules:
        """Return the supervisor's rules for a controller, with the narrower limits of both.

        The default bounds of y come from the reference of ``scenario``; without one there are none.

        Raises
        ------
        ValueError
            if u has no finite limits, or zero is not between them.
        """
        own = getattr(controller, "limits", None)
        low = max(float(self.u_min), -math.inf if own is None else own.low)
        high = min(float(self.u_max), math.inf if own is None else own.high)
        if not (math.isfinite(low) and math.isfinite(high)):
            raise ValueError(
                f"u_min = {low!r}, u_max = {high!r}: must be finite for a real device; "
                "give u_min and u_max to the controller or to quell.realtime.Safety"
            )
        _check_around_zero(low, high)
        scale = reach(controller, low, high)
        y_low, y_high = -math.inf, math.inf
        if scenario is not None:
            r = reference_samples(scenario, controller.dt, 0, 0.0).r
            y_low, y_high = plausible_range(r, scale)
        adrc = inner_adrc(controller) if self.check_direction else None
        counts = {count.samples: self._samples(count, controller.dt) for count in _COUNTS}
        more = max(round(_START_MORE / controller.dt), _START_SAMPLES)
        return Rules(
            low=low,
            high=high,
            most_error=float(self.most_error),
            most_f=float(self.most_f),
            **counts,
            y_low=y_low if self.y_min is None else float(self.y_min),
            y_high=y_high if self.y_max is None else float(self.y_max),
            longest_start=_START_FACTOR * counts["settle"] + more,
            direction=0.0 if adrc is None else math.copysign(1.0, adrc.parameters.b0),
            reach=scale,
        )

    def _samples(self, count: _Count, dt: float) -> int:
        """Return a number of samples for the sample time ``dt`` [s]."""
        samples, time = getattr(self, count.samples), getattr(self, count.time)
        if samples is not None:
            return int(samples)
        if time is not None:
            return min(max(round(time / dt), 1), _NEVER)
        return (
            count.least
            if math.isinf(count.default)
            else max(round(count.default / dt), count.least)
        )


def default_hold(dt: float) -> int:
    """Return the default of ``Safety.hold`` for a sample time ``dt`` [s]."""
    return Safety()._samples(_COUNTS[0], dt)


def _check_around_zero(low: float, high: float) -> None:
    if not low <= 0.0 <= high or low == high:
        raise ValueError(
            f"u_min = {low!r}, u_max = {high!r}: must have zero, the safe u, between them"
        )
