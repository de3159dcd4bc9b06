"""The guard: how much a learner may say.

*What is known exactly.* ``f_plain = Δf̂ + f_L^F = f^F`` is what an ESO without learner would have estimated from the same y and u
(``lag.py``). So, one lag of the observer later, it is known what that ESO has missed, and which part of it the learner's output g
meant to make up for:

    q = F (f − f^F) = f_plain − f_plain^F,        p = (1 − F) F g = g^F − g^FF

Low frequencies, where any ESO is good without help, count little in both.

*Trust is earned.* q and p are put in relation to each other sample by sample, so that one shock does not outvote minutes, and
averaged over T seconds in which something happens:

    m_xy ← m_xy + (dt/T) a (x y / s − m_xy),        s = q² + p²,        a = min(1, s / (0.4 e)²)

with e the usual size of q, in which an outlier counts for no more than five times what is usual. The share of the plain ESO's error
that the learner would have removed,
``η = (2 m_qp − m_pp) / m_qq``, decides:

    β = min( clip(η / 0.2, 0, 1),  1.2 m_qq / m_pp )

The second term is for learners that say the right thing too loud, which makes a loop's gain exceed one and is dangerous though η
is positive. A learner starts, and starts again after it was cut off, with the record of one that has nothing to do with f: it has to be
right for 0.7 T, unheard, before it is heard at all, and for 0.9 T to be heard in full.

*No sample is trusted.* ``f − f^F`` has the size e, so whatever is further from f_plain than that is not f:

    held = g clipped to f_plain ± κe, and faded to zero between κe and 3κe from it,        f_L = β held

and f_L moves by 2 omega_o e a second at most, unless the bound itself moves it. What is not finite, or a hundred times larger than
f, is cut off within the sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.kernels.dispatch import generic, is_finite, kernel
from quell.learners.lag import lag_memory, lag_of, lag_push
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# Averages are taken over so many lags N/omega_o of the observer: 15 s in the two-mass study.
_AVERAGE = 30.0
# The usual size of q follows within two lags where it grows, and is remembered for 200.
_ATTACK, _MEMORY = 2.0, 200.0
_OUTLIER = 5.0
# Samples below this share of the usual size count less: they are noise.
_QUIET = 0.4
# A learner is fully heard from this explained share on.
_TRUSTED = 0.2
# It may have so much more energy than what it should explain.
_LOUD = 1.2
# Outside of the bound it fades to nothing at so many times the bound.
_FADE = 3.0
# In omega_o times the usual size of q, a second.
_FASTEST = 2.0
# It explodes where it is so many times larger than f.
_EXPLODES = 100.0
_TINY = 1e-200


class Reason(IntEnum):
    """Why a learner's authority is what it is."""

    TRUSTED = 0
    UNPROVEN = 1
    TOO_LOUD = 2
    OUT_OF_BOUNDS = 3
    TOO_FAST = 4
    EXPLODED = 5
    NOT_FINITE = 6

    @property
    def message(self) -> str:
        """The reason as a sentence."""
        return _MESSAGES[self]


_MESSAGES = {
    Reason.TRUSTED: "The learner explains what the observer would have missed and has full authority.",
    Reason.UNPROVEN: "The learner explains too little of what the observer misses, or has not done so for long enough.",
    Reason.TOO_LOUD: "The learner's output is larger than what it should explain and is scaled down.",
    Reason.OUT_OF_BOUNDS: "The learner's output is further from the observer's estimate than f can be and was clipped or dropped.",
    Reason.TOO_FAST: "The learner's output moves faster than f can and was slowed down.",
    Reason.EXPLODED: "The learner's output is a hundred times larger than f; it was cut off and has to prove itself again.",
    Reason.NOT_FINITE: "The learner's output is not a number; it was cut off, begins anew and has to prove itself again.",
}

_TRUST, _UNPROVEN, _TOO_LOUD, _OUT, _TOO_FAST, _EXPLODED, _NOT_FINITE = (
    int(reason) for reason in Reason
)


@generic
def assess(guard: Any, memory: Any, f_plain: float) -> None:
    """Take note of what an ESO without learner would have estimated."""
    raise TypeError


@generic
def limit(
    guard: Any, memory: Any, f_plain: float, constant: float, slope: float, u_before: float
) -> tuple[float, float, bool]:
    """Return what is left of the learner's ``constant + slope · u``, and whether it was cut off because it is not finite."""
    raise TypeError


@generic
def record_output(guard: Any, memory: Any, f_learned: float) -> None:
    """Take note of the ``f_learned`` that the observer is fed."""
    raise TypeError


@generic
def write_channels(guard: Any, memory: Any, row: Vector) -> int:
    """Write what the guard knows (``GUARD_CHANNELS``) to the start of ``row``; return how many numbers that are."""
    raise TypeError


@generic
def reset_filters(guard: Any, memory: Any) -> None:
    """Forget what belongs to the moment (filters); keep the learner's record."""
    raise TypeError


GUARD_CHANNELS = (("authority", 1), ("error_plain", 1), ("error_learned", 1), ("reason", 1))


class UnguardedDesign(NamedTuple):
    """Parameters of no guard: none."""


class UnguardedMemory(NamedTuple):
    """State of no guard."""

    nothing: Vector
    """(0,)."""


@assess.register(UnguardedDesign)
def _watch_nothing(guard: UnguardedDesign, memory: UnguardedMemory, f_plain: float) -> None:
    pass


@limit.register(UnguardedDesign)
def _permit_all(
    guard: UnguardedDesign,
    memory: UnguardedMemory,
    f_plain: float,
    constant: float,
    slope: float,
    u_before: float,
) -> tuple[float, float, bool]:
    return constant, slope, False


@record_output.register(UnguardedDesign)
def _note_nothing(guard: UnguardedDesign, memory: UnguardedMemory, f_learned: float) -> None:
    pass


@write_channels.register(UnguardedDesign)
def _explain_nothing(guard: UnguardedDesign, memory: UnguardedMemory, row: Vector) -> int:
    return 0


@reset_filters.register(UnguardedDesign)
def _calm_nothing(guard: UnguardedDesign, memory: UnguardedMemory) -> None:
    pass


class GuardDesign(NamedTuple):
    """Parameters of the guard."""

    lag: Any
    forget: float
    """dt/T."""
    attack: float
    decay: float
    """Of the usual size of q, a sample."""
    bound: float
    """κ."""
    fastest: float
    """Largest change of f_L in a sample, in units of the usual size of q."""
    least_slope: float
    largest_slope: float
    """Where ∂f_L/∂u is used; outside, the learner's output is taken for a constant."""


class GuardMemory(NamedTuple):
    """State of the guard."""

    chain: Matrix
    """The lag filters of f_plain, g and g^F (3, N)."""
    shown: Vector
    """What they show (3,)."""
    record: Vector
    """(5,): m_qq, m_qp, m_pp; mean squares of q and of q − p [(y-unit/s^n)²]."""
    moment: Vector
    """(6,): authority, usual size of q, g of the sample, the last f_L, reason, samples so far."""


# Places in GuardMemory.
_F_PLAIN, _G, _GG = range(3)
_QQ, _QP, _PP, _PLAIN, _LEARNED = range(5)
_AUTHORITY, _USUAL, _OUTPUT, _LAST, _REASON, _SINCE = range(6)


@assess.register(GuardDesign)
def _assess(guard: GuardDesign, memory: GuardMemory, f_plain: float) -> None:
    shown, record, moment = memory.shown, memory.record, memory.moment
    q, p = f_plain - shown[_F_PLAIN], shown[_G] - shown[_GG]
    qq, pp = q * q, p * p
    if not is_finite(qq + pp):
        # A measurement beyond all numbers, perhaps: what it left here is worth nothing.
        reset_filters(guard, memory)
        return
    shown[_F_PLAIN] = lag_push(guard.lag, memory.chain, _F_PLAIN, f_plain)
    shown[_GG] = lag_push(guard.lag, memory.chain, _GG, shown[_G])
    usual = moment[_USUAL]
    # Once there is a usual size, an outlier counts for no more than five times that: one bad measurement must not open all bounds.
    moment[_SINCE] += 1.0
    large = abs(q) if moment[_SINCE] * guard.forget < 1.0 else min(abs(q), _OUTLIER * usual)
    usual += guard.attack * (large - usual) if large > usual else -guard.decay * usual
    moment[_USUAL] = max(usual, _TINY)
    size, quiet = qq + pp, (_QUIET * usual) ** 2
    if size < _TINY:
        return
    rate = guard.forget * (size / quiet if size < quiet else 1.0)
    each = rate / size
    record[_QQ] += each * qq - rate * record[_QQ]
    record[_QP] += each * q * p - rate * record[_QP]
    record[_PP] += each * pp - rate * record[_PP]
    record[_PLAIN] += guard.forget * (qq - record[_PLAIN])
    record[_LEARNED] += guard.forget * ((q - p) * (q - p) - record[_LEARNED])


@limit.register(GuardDesign)
def _limit(
    guard: GuardDesign,
    memory: GuardMemory,
    f_plain: float,
    constant: float,
    slope: float,
    u_before: float,
) -> tuple[float, float, bool]:
    record, moment = memory.record, memory.moment
    output = constant + slope * u_before
    most = _EXPLODES * max(abs(f_plain), moment[_USUAL])
    if not (abs(output) <= most and is_finite(slope)):
        finite = is_finite(output) and is_finite(slope)
        moment[_OUTPUT] = min(max(output, -most), most) if finite else 0.0
        moment[_AUTHORITY] = 0.0
        moment[_REASON] = _EXPLODED if finite else _NOT_FINITE
        _distrust(record)
        return 0.0, 0.0, not finite
    moment[_OUTPUT] = output
    authority, reason = _authority(record)
    moment[_AUTHORITY] = authority
    bound, away = guard.bound * moment[_USUAL], abs(output - f_plain)
    inside = away <= bound
    held = output
    if not inside:
        reason = _OUT
        held = (
            min(max(output, f_plain - bound), f_plain + bound)
            * max(_FADE - away / max(bound, _TINY), 0.0)
            / (_FADE - 1.0)
        )
    wished, change = authority * held, guard.fastest * moment[_USUAL]
    permitted = min(max(wished, moment[_LAST] - change), moment[_LAST] + change)
    permitted = min(max(permitted, min(f_plain - bound, 0.0)), max(f_plain + bound, 0.0))
    steady = permitted == wished
    if not steady:
        reason = _TOO_FAST
    moment[_REASON] = reason
    if inside and steady and guard.least_slope <= authority * slope <= guard.largest_slope:
        return authority * constant, authority * slope, False
    return permitted, 0.0, False


@kernel
def _authority(record: Vector) -> tuple[float, int]:
    """Return β and the reason for it."""
    if not record[_QQ] > _TINY:
        return 0.0, _UNPROVEN
    explained = (2.0 * record[_QP] - record[_PP]) / record[_QQ]
    heard = explained / _TRUSTED
    if heard <= 0.0:
        return 0.0, _UNPROVEN
    quiet = _LOUD * record[_QQ] / record[_PP]  # what explains something has m_pp > 0
    if quiet < min(heard, 1.0):
        return quiet, _TOO_LOUD
    return (heard, _UNPROVEN) if heard < 1.0 else (1.0, _TRUST)


@kernel
def _distrust(record: Vector) -> None:
    """Give a learner the record of one that is as large as what it should explain, and has nothing to do with it."""
    record[_QQ] = record[_PP] = 0.5
    record[_QP] = 0.0


@record_output.register(GuardDesign)
def _record_output(guard: GuardDesign, memory: GuardMemory, f_learned: float) -> None:
    memory.shown[_G] = lag_push(guard.lag, memory.chain, _G, memory.moment[_OUTPUT])
    memory.moment[_LAST] = f_learned


@write_channels.register(GuardDesign)
def _write_channels(guard: GuardDesign, memory: GuardMemory, row: Vector) -> int:
    row[0] = memory.moment[_AUTHORITY]
    row[1] = math.sqrt(memory.record[_PLAIN])
    row[2] = math.sqrt(memory.record[_LEARNED])
    row[3] = memory.moment[_REASON]
    return 4


@reset_filters.register(GuardDesign)
def _reset_filters(guard: GuardDesign, memory: GuardMemory) -> None:
    for i in range(memory.chain.shape[0]):
        memory.shown[i] = 0.0
        for j in range(memory.chain.shape[1]):
            memory.chain[i, j] = 0.0
    memory.moment[_OUTPUT] = memory.moment[_LAST] = 0.0


@dataclass(frozen=True)
class Guard:
    """Gives a learner the authority that it has earned; ``ADRC(observer, omega_c, learner=..., guard=Guard())``.

    The module's docstring has the equations, docs/theory what is proved and what is measured. Nothing in it depends on the unit of y or u.

    Parameters
    ----------
    bound
        how far from the plain observer's estimate a learner's output may be, in units of the usual error of that estimate: κ.
    time
        over how long a learner's record is averaged, T [s]; by default 30 lags ``(n + 1)/omega_o`` of the observer.

    Raises
    ------
    ValueError
        for a parameter that is not positive.
    """

    bound: float = 1.2
    time: float | None = None

    def __post_init__(self) -> None:
        checks.positive("bound", self.bound)
        if self.time is not None:
            checks.positive("time", self.time, "s")

    def design(self, observer: ESO) -> GuardDesign:
        """Return the parameters for an observer."""
        lag_time = observer.lag_time
        dt, time = observer.dt, _AVERAGE * lag_time if self.time is None else self.time
        slopes = sorted([-0.5 * observer.b0, observer.b0])
        return GuardDesign(
            lag=lag_of(observer),
            forget=-math.expm1(-dt / time),
            attack=-math.expm1(-dt / (_ATTACK * lag_time)),
            decay=-math.expm1(-dt / (_MEMORY * lag_time)),
            bound=float(self.bound),
            fastest=_FASTEST * observer.omega_o * dt,
            least_slope=slopes[0],
            largest_slope=slopes[1],
        )

    def memory(self, parameters: GuardDesign) -> GuardMemory:
        """Return the state before the first sample: nothing proved."""
        record = np.zeros(5)
        _distrust(record)
        return GuardMemory(lag_memory(parameters.lag, 3), np.zeros(3), record, np.zeros(6))
