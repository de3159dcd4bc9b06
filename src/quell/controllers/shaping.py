"""Prefilters of the reference: input shapers, and moves within limits of speed and acceleration.

**Input shaping** splits the reference into delayed parts whose vibrations of a mode cancel. For a
mode ``s² + 2ζω s + ω²`` with ``ω_d = ω √(1 − ζ²)`` and ``K = exp(−ζπ/√(1 − ζ²))``, impulses at
``t_i = i τ`` have the amplitudes ``c_i K^(τ_i)/Σ``, where τ_i is t_i in half periods ``π/ω_d`` and
Σ makes their sum 1::

            τ            c
    ZV      half period  1, 1
    ZVD     half period  1, 2, 1
    MZV     3/4 of it    1, √2, 1
    EI      half period  (1 + v)/4, (1 − v)/2, (1 + v)/4
    2 humps half period  c_0, ½ − c_0, ½ − c_0, c_0
    3 humps half period  c_0, (1 − v)/4, 1 − 2 (c_0 + c_1), (1 − v)/4, c_0

with ``c_0 = (3x² + 2x + 3v²)/(16x)``, ``x = (v² (√(1 − v²) + 1))^(1/3)`` for two humps and
``c_0 = (1 + 3v + 2√(2 (v² + v)))/16`` for three. ZV leaves no vibration of exactly this mode, ZVD
none to first order in an error of ω (Singer & Seering, *ASME J. Dynamic Systems, Measurement, and
Control* 112, 1990, eqs. (11) and (13)); MZV is shorter than ZVD by a quarter, with a band between
those of both. EI accepts a share v of the vibration at the mode itself and has a wider band in
which no more than v is left (Singhose, Seering & Singer, *ASME J. Mechanical Design* 116, 1994);
with several humps the band is wider still and the shaper longer (Singhose, Porter, Tuttle & Singer,
*ASME J. Dynamic Systems, Measurement, and Control* 119, 1997). The c of EI are exact without
damping; with it the powers of K keep the vibration of the mode below v.

Relative to that after a single impulse, the vibration of a mode after the last of impulses a_i at
t_i is::

    V = e^(−ζω t_N) √( (Σ a_i e^(ζω t_i) cos ω_d t_i)² + (Σ a_i e^(ζω t_i) sin ω_d t_i)² )

An impulse between two samples is split over both, linearly.

**A move within limits** of speed, acceleration and jerk: r is the target. When it changes,
the quickest move from the present position, speed and acceleration is planned
(``signals/moves.py``). So the reference that the controller gets, and its first three derivatives,
are those of a jerk-limited move at any moment, and it comes to rest at r exactly.

Within a part of constant jerk the motion is computed from the beginning of the part, so that
rounding does not add up, and in the last one from its end: the way there has no overshoot, not even
of rounding.

With smoothing it is the mean of the move over a time W, of which the derivatives are differences::

    z^(i)(t) = ( p^(i−1)(t) − p^(i−1)(t − W) ) / W

So a jerk that jumps becomes one that changes at a bounded rate: there is a fourth derivative, for
the feedforward of a plant with a resonance. The mean is taken by the trapezoidal rule, beside the
present p: at rest it is p exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.prefilters import prefilter, settle, stopping_point, write_derivatives
from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single
from quell.kernels.sized import Buffer, Scalars
from quell.signals.moves import PARTS, moved, plan, stopping_way
from quell.types import Vector

# Limit on memory: 80 MB. Chosen by hand.
_MOST_SAMPLES = 10_000_000


class ShaperDesign(NamedTuple):
    """Impulses on samples; the buffer is one sample longer than the longest delay."""

    delays: NDArray[np.int64]  # in samples
    weights: Vector
    length: int


class ShaperMemory(NamedTuple):
    """The references of the last samples, as a ring."""

    past: Buffer
    at: Vector  # (1,): index of the newest


@prefilter.register(ShaperDesign)
def _prefilter(design: ShaperDesign, memory: ShaperMemory, r: float) -> float:
    at = min(max(int(memory.at[0]), 0), memory.past.size - 1)
    at = at + 1 if at < memory.past.size - 1 else 0
    memory.at[0] = at
    memory.past[at] = r
    total = 0.0
    for i in range(design.delays.size):
        place = at - design.delays[i]
        if place < 0:
            place += design.length
        total += design.weights[i] * memory.past[place]
    return total


@settle.register(ShaperDesign)
def _settle(design: ShaperDesign, memory: ShaperMemory, value: float) -> None:
    for i in range(memory.past.size):
        memory.past[i] = value


@dataclass(frozen=True)
class Shaper:
    """A sequence of impulses that is convolved with the reference, as ``ZV`` returns it.

    Parameters
    ----------
    times
        times of the impulses [s], from 0 on, increasing.
    amplitudes
        their amplitudes, with the sum 1.

    Raises
    ------
    ValueError
        for different numbers of both, times that do not increase from 0, and another sum than 1.
    """

    times: tuple[float, ...]
    amplitudes: tuple[float, ...]

    def __post_init__(self) -> None:
        times = checks.vector("times", self.times)
        amplitudes = checks.vector("amplitudes", self.amplitudes, times.size)
        if times.size == 0 or times[0] != 0.0 or np.any(np.diff(times) <= 0.0):
            raise ValueError(f"times = {self.times!r}: must begin at 0.0 and increase")
        if not math.isclose(float(np.sum(amplitudes)), 1.0, rel_tol=1e-9):
            raise ValueError(f"amplitudes = {self.amplitudes!r}: must add up to 1")
        object.__setattr__(self, "times", tuple(times.tolist()))
        object.__setattr__(self, "amplitudes", tuple(amplitudes.tolist()))

    def residual(self, omega: float, zeta: float = 0.0) -> float:
        """Return the vibration V of a mode after the last impulse, as the module defines it."""
        omega, zeta = _mode(omega, zeta)
        damped = omega * math.sqrt(1.0 - zeta**2)
        vibration = sum(
            a * np.exp(zeta * omega * (t - self.times[-1]) + 1j * damped * t)
            for a, t in zip(self.amplitudes, self.times, strict=True)
        )
        return float(abs(vibration))

    def design(self, dt: float) -> ShaperDesign:
        """Return the impulses on samples of ``dt`` [s].

        Raises ``ValueError`` for a dt that is not positive, or a shaper of more than ten million
        samples.
        """
        if self.times[-1] / checks.positive("dt", dt, "s") > _MOST_SAMPLES:
            rule = f"the shaper's {self.times[-1]:.3g} s must be at most {_MOST_SAMPLES} samples"
            raise ValueError(f"dt = {dt!r} s: {rule}")
        weights: dict[int, float] = {}
        for time, amplitude in zip(self.times, self.amplitudes, strict=True):
            before = math.floor(time / dt + 1e-9)
            share = max(time / dt - before, 0.0)
            parts = (before, (1.0 - share) * amplitude), (before + 1, share * amplitude)
            for place, weight in parts:
                if abs(weight) > 1e-12:  # the rest of a rounded time
                    weights[place] = weights.get(place, 0.0) + weight
        delays = np.array(list(weights), dtype=np.int64)
        return ShaperDesign(delays, np.array(list(weights.values())), max(weights) + 1)

    def memory(self, design: ShaperDesign) -> ShaperMemory:
        """Return a buffer at rest."""
        return ShaperMemory(np.zeros(design.length), np.zeros(1))


def ZV(omega: float, zeta: float = 0.0) -> Shaper:  # noqa: N802 - the field's name
    """Return the zero-vibration shaper of a mode: two impulses, half a period apart.

    Parameters
    ----------
    omega
        undamped frequency of the mode [rad/s].
    zeta
        its damping ratio, 0 to below 1.

    Raises
    ------
    ValueError
        for a frequency or damping out of range.
    """
    half, K = _half_period(omega, zeta)
    return Shaper((0.0, half), (1.0 / (1.0 + K), K / (1.0 + K)))


def ZVD(omega: float, zeta: float = 0.0) -> Shaper:  # noqa: N802
    """Return the ZVD shaper: three impulses, twice as long as ``ZV`` and more robust.

    Parameters and errors as for ``ZV``.
    """
    half, K = _half_period(omega, zeta)
    amplitudes = (1.0 / (1.0 + K) ** 2, 2.0 * K / (1.0 + K) ** 2, (K / (1.0 + K)) ** 2)
    return Shaper((0.0, half, 2.0 * half), amplitudes)


def MZV(omega: float, zeta: float = 0.0) -> Shaper:  # noqa: N802
    """Return the modified ZV shaper: three impulses, three quarters as long as ``ZVD``.

    It is the usual choice of printers' firmware. Parameters and errors as for ``ZV``.
    """
    return _shaper(omega, zeta, 0.75, (1.0, math.sqrt(2.0), 1.0))


def EI(  # noqa: N802
    omega: float, zeta: float = 0.0, *, tolerance: float = 0.05, humps: int = 1
) -> Shaper:
    """Return an extra-insensitive shaper: as long as ``ZVD``, for a wider band of frequencies.

    Parameters
    ----------
    omega, zeta
        as for ``ZV``.
    tolerance
        share v of the vibration that may be left, above 0 and at most 0.5.
    humps
        1, 2 or 3: number of maxima of the vibration that is left, over frequency. With v = 0.05 and
        without damping the vibration is at most v from 0.80 to 1.20, 0.64 to 1.36 and 0.52 to
        1.48 times omega; ``ZVD`` has 0.86 to 1.14. The last impulse comes after 1, 1.5 and 2
        periods.

    Raises
    ------
    ValueError
        for a number out of range.
    """
    v = checks.positive("tolerance", tolerance)
    if v > 0.5:
        raise ValueError(f"tolerance = {tolerance!r}: must be at most 0.5, half of the vibration")
    side = 0.25 * (1.0 - v)
    if humps == 1:
        c: tuple[float, ...] = (0.25 * (1.0 + v), 2.0 * side, 0.25 * (1.0 + v))
    elif humps == 2:
        x = (v**2 * (math.sqrt(1.0 - v**2) + 1.0)) ** (1.0 / 3.0)
        first = (3.0 * x**2 + 2.0 * x + 3.0 * v**2) / (16.0 * x)
        c = (first, 0.5 - first, 0.5 - first, first)
    elif humps == 3:
        first = (1.0 + 3.0 * v + 2.0 * math.sqrt(2.0 * (v**2 + v))) / 16.0
        c = (first, side, 1.0 - 2.0 * (first + side), side, first)
    else:
        raise ValueError(f"humps = {humps!r}: must be 1, 2 or 3")
    return _shaper(omega, zeta, 1.0, c)


def _mode(omega: float, zeta: float) -> tuple[float, float]:
    omega, zeta = checks.positive("omega", omega, "rad/s"), checks.non_negative("zeta", zeta)
    if zeta >= 1.0:
        raise ValueError(f"zeta = {zeta!r}: must be below 1, or the mode does not vibrate")
    return omega, zeta


def _half_period(omega: float, zeta: float) -> tuple[float, float]:
    """Return π/ω_d [s] and K."""
    omega, zeta = _mode(omega, zeta)
    root = math.sqrt(1.0 - zeta**2)
    return math.pi / (omega * root), math.exp(-zeta * math.pi / root)


def _shaper(omega: float, zeta: float, apart: float, c: tuple[float, ...]) -> Shaper:
    """Return impulses c_i K^τ_i that are ``apart`` half periods apart, with the sum 1."""
    half, K = _half_period(omega, zeta)
    weights = [each * K ** (i * apart) for i, each in enumerate(c)]
    total = math.fsum(weights)
    times = tuple(i * apart * half for i in range(len(c)))
    return Shaper(times, tuple(weight / total for weight in weights))


# Rounding of r − p, and of the way of a stop, in units of the last digit of r and p.
_ROUNDING, _ROUNDING_SINGLE = 2e-15, 1e-6
# A part that ends on a sample has ended there, if rounding makes it end later by this share of dt.
_EDGE = 1e-9
# Samples after which the beginning of a part is moved: counts in single precision end at 2^24.
_MOST_SAMPLES_PROFILE = 1e6


class ProfileDesign(NamedTuple):
    """Parameters."""

    v_max: float  # [y-unit/s]
    a_max: float  # [y-unit/s²]
    j_max: float  # [y-unit/s³]
    dt: float  # [s]


class ProfileLoop(Scalars):
    """Scalars kept from one sample to the next."""

    target: float  # of the move
    v_max: float  # the limits with which it was planned
    a_max: float
    j_max: float
    part: float  # index of the part that runs; PARTS at rest
    last: float  # index of the last part with a duration
    samples: float  # since `offset`
    offset: float  # time in the part, when samples were counted from [s]
    p_begin: float  # position, speed and acceleration at the beginning of the part
    v_begin: float
    a_begin: float
    p: float  # reference of this sample, and its derivatives
    v: float
    a: float
    jerk: float


class ProfileMemory(NamedTuple):
    """State."""

    times: Vector  # durations of the parts (PARTS,) [s]
    jerks: Vector  # their jerks (PARTS,) [y-unit/s³]
    loop: NDArray[ProfileLoop]  # (1,)


@prefilter.register(ProfileDesign)
def _prefilter_profile(design: ProfileDesign, memory: ProfileMemory, r: float) -> float:
    loop = memory.loop[0]
    if loop.part < PARTS:
        loop.samples += 1.0
        _advance(design, memory)
    changed = loop.v_max != design.v_max or loop.a_max != design.a_max
    if r != loop.target or changed or loop.j_max != design.j_max:
        _begin(design, memory, r)
    return loop.p


@kernel
def _begin(design: ProfileDesign, memory: ProfileMemory, r: float) -> None:
    """Plan the move from here to r."""
    loop, times = memory.loop[0], memory.times
    rounding = (_ROUNDING_SINGLE if is_single(loop.p) else _ROUNDING) * (abs(r) + abs(loop.p))
    distance = r - loop.p
    loop.v_max, loop.a_max, loop.j_max = design.v_max, design.a_max, design.j_max
    plan(
        times, memory.jerks, loop.v, loop.a, distance, rounding,
        design.v_max, design.a_max, design.j_max,
    )  # fmt: skip
    loop.target = r
    loop.p_begin, loop.v_begin, loop.a_begin = loop.p, loop.v, loop.a
    loop.samples = loop.offset = loop.part = loop.last = 0.0
    for i in range(PARTS):
        if times[i] > _EDGE * design.dt:
            loop.last = i
    _advance(design, memory)


@kernel
def _advance(design: ProfileDesign, memory: ProfileMemory) -> None:
    """Set the reference and its derivatives to those of this sample."""
    loop = memory.loop[0]
    part, t, p, v, a = _part_of(design, memory, loop.samples)
    if part > loop.part:
        loop.part, loop.offset, loop.samples = part, t, 0.0
        loop.p_begin, loop.v_begin, loop.a_begin = p, v, a
    if part > loop.last:
        loop.part = PARTS
    loop.p, loop.v, loop.a, loop.jerk = _motion(memory, part, t, p, v, a)
    if loop.samples >= _MOST_SAMPLES_PROFILE:
        loop.p_begin, loop.v_begin, loop.a_begin = loop.p, loop.v, loop.a
        memory.times[min(max(int(part), 0), memory.times.size - 1)] -= t
        loop.offset = loop.samples = 0.0


@kernel
def _part_of(
    design: ProfileDesign, memory: ProfileMemory, samples: float
) -> tuple[float, float, float, float, float]:
    """Return the part after some samples, the time in it, and the motion at its beginning."""
    loop, times = memory.loop[0], memory.times
    part, t = loop.part, loop.offset + samples * design.dt
    p, v, a = loop.p_begin, loop.v_begin, loop.a_begin
    for i in range(PARTS):
        if part == i and t >= times[i] - _EDGE * design.dt:
            way, v, a = moved(v, a, memory.jerks[i], times[i])
            p += way
            t -= times[i]
            part += 1.0
    return part, t, p, v, a


@kernel
def _motion(
    memory: ProfileMemory, part: float, t: float, p: float, v: float, a: float
) -> tuple[float, float, float, float]:
    """Return position, speed, acceleration, jerk at a time t in a part that begins with p, v, a."""
    loop = memory.loop[0]
    if part > loop.last:
        return loop.target, 0.0, 0.0, 0.0
    place = min(max(int(part), 0), memory.jerks.size - 1)
    jerk = memory.jerks[place]
    if part == loop.last:
        left = memory.times[place] - t
        way = jerk * left * left * left / 6.0
        return loop.target - way, 0.5 * jerk * left * left, -jerk * left, jerk
    way, v, a = moved(v, a, jerk, t)
    return p + way, v, a, jerk


@write_derivatives.register(ProfileDesign)
def _write_derivatives(design: ProfileDesign, memory: ProfileMemory, derivatives: Vector) -> None:
    loop = memory.loop[0]
    derivatives[0], derivatives[1], derivatives[2] = loop.v, loop.a, loop.jerk


@stopping_point.register(ProfileDesign)
def _stopping_point(design: ProfileDesign, memory: ProfileMemory) -> float:
    # A stop begins in the next sample.
    loop = memory.loop[0]
    if loop.part >= PARTS:
        return loop.target
    part, t, p, v, a = _part_of(design, memory, loop.samples + 1.0)
    p, v, a, _ = _motion(memory, part, t, p, v, a)
    return p + stopping_way(v, a, design.a_max, design.j_max)


@settle.register(ProfileDesign)
def _settle_profile(design: ProfileDesign, memory: ProfileMemory, value: float) -> None:
    loop = memory.loop[0]
    loop.p = loop.target = value
    loop.v = loop.a = loop.jerk = 0.0
    loop.v_max, loop.a_max, loop.j_max = design.v_max, design.a_max, design.j_max
    loop.part = PARTS


class SmoothedDesign(NamedTuple):
    """Parameters with smoothing."""

    profile: ProfileDesign
    length: int  # samples of which the mean is taken
    width: float  # W [s]


class SmoothedMemory(NamedTuple):
    """State with smoothing: the motions of the last samples as rings, and the mean."""

    profile: ProfileMemory
    p: Buffer
    v: Buffer
    a: Buffer
    jerk: Buffer
    at: Vector  # (1,): index of the newest
    changes: Vector  # (4,): derivatives of the mean


@prefilter.register(SmoothedDesign)
def _prefilter_smoothed(design: SmoothedDesign, memory: SmoothedMemory, r: float) -> float:
    prefilter(design.profile, memory.profile, r)
    loop, changes, size = memory.profile.loop[0], memory.changes, memory.p.size
    at = min(max(int(memory.at[0]), 0), size - 1)
    at = at + 1 if at < size - 1 else 0
    # The oldest, W ago, gives its place to the newest.
    oldest = memory.p[at]
    changes[0] = (loop.p - oldest) / design.width
    changes[1] = (loop.v - memory.v[at]) / design.width
    changes[2] = (loop.a - memory.a[at]) / design.width
    changes[3] = (loop.jerk - memory.jerk[at]) / design.width
    memory.p[at], memory.v[at], memory.a[at] = loop.p, loop.v, loop.a
    memory.jerk[at] = loop.jerk
    memory.at[0] = at
    total = 0.5 * (oldest - loop.p)
    for i in range(size):
        total += memory.p[i] - loop.p
    return loop.p + total / design.length


@write_derivatives.register(SmoothedDesign)
def _write_derivatives_smoothed(
    design: SmoothedDesign, memory: SmoothedMemory, derivatives: Vector
) -> None:
    for i in range(derivatives.size):
        derivatives[i] = memory.changes[i]


@stopping_point.register(SmoothedDesign)
def _stopping_point_smoothed(design: SmoothedDesign, memory: SmoothedMemory) -> float:
    return stopping_point(design.profile, memory.profile)


@settle.register(SmoothedDesign)
def _settle_smoothed(design: SmoothedDesign, memory: SmoothedMemory, value: float) -> None:
    settle(design.profile, memory.profile, value)
    for i in range(memory.p.size):
        memory.p[i] = value
        memory.v[i] = memory.a[i] = memory.jerk[i] = 0.0
    for i in range(memory.changes.size):
        memory.changes[i] = 0.0


@dataclass(frozen=True)
class ProfileGenerator:
    """A prefilter that moves to r within limits of speed, acceleration and jerk, on line.

    For use in ``Prefiltered``: r of each step is the target, which may change in any sample, also
    while the axis moves. The reference then follows the quickest move from its present position,
    speed and acceleration, and comes to rest at the target exactly. Its speed, acceleration and
    jerk are derivatives for a controller with feedforward; higher ones are zero.

    To stop as soon as the limits allow, give ``Prefiltered.stopping_point`` as r.

    Parameters
    ----------
    v_max, a_max, j_max
        limits of speed [y-unit/s], acceleration [y-unit/s²] and jerk [y-unit/s³] of the reference.
    smoothing
        time of which the mean of the move is taken [s], rounded to samples; it is added to the
        duration, and there is a fourth derivative; none by default.

    Raises
    ------
    ValueError
        for a limit that is not positive, a smoothing that is negative, or in ``design`` one of more
        than ten million samples.

    Notes
    -----
    Limits that become lower while the axis moves (``NAME_retune`` of exported code) act at once: a
    speed above its limit is reduced first; an acceleration above its limit is not raised.

    It is for targets that stand still for some samples. One that moves in each sample is followed,
    too, within the limits, but with a jerk that alternates, which feedforward passes on to u: take
    a ``ReferenceModel`` for it, or the derivatives of its formula.

    Examples
    --------
    >>> profile = ProfileGenerator(v_max=2.0, a_max=10.0, j_max=100.0)
    >>> design = profile.design(dt=0.01)
    >>> memory = profile.memory(design)
    >>> [round(prefilter(design, memory, 1.0), 6) for _ in range(4)]
    [0.0, 1.7e-05, 0.000133, 0.00045]
    """

    v_max: float
    a_max: float
    j_max: float
    smoothing: float = 0.0

    def __post_init__(self) -> None:
        checks.positive("v_max", self.v_max, "y-unit/s")
        checks.positive("a_max", self.a_max, "y-unit/s²")
        checks.positive("j_max", self.j_max, "y-unit/s³")
        checks.non_negative("smoothing", self.smoothing, "s")

    @property
    def derivatives(self) -> int:
        """Number of derivatives of its output: three, with smoothing four."""
        return 4 if self.smoothing > 0.0 else 3

    def design(self, dt: float) -> ProfileDesign | SmoothedDesign:
        """Return the parameters for a sample time [s]."""
        dt = checks.positive("dt", dt, "s")
        plain = ProfileDesign(float(self.v_max), float(self.a_max), float(self.j_max), dt)
        if not self.smoothing > 0.0:
            return plain
        if self.smoothing / dt > _MOST_SAMPLES:
            rule = f"must be at most {_MOST_SAMPLES} samples"
            raise ValueError(f"smoothing = {self.smoothing!r} s with dt = {dt!r} s: {rule}")
        length = max(round(self.smoothing / dt), 1)
        return SmoothedDesign(plain, length, length * dt)

    def memory(self, design: ProfileDesign | SmoothedDesign) -> ProfileMemory | SmoothedMemory:
        """Return the state at rest at zero."""
        plain = design.profile if isinstance(design, SmoothedDesign) else design
        memory = ProfileMemory(np.zeros(PARTS), np.zeros(PARTS), ProfileLoop.zeros())
        settle(plain, memory, 0.0)
        if not isinstance(design, SmoothedDesign):
            return memory
        p, v, a, jerk = np.zeros((4, design.length))
        return SmoothedMemory(memory, p, v, a, jerk, np.zeros(1), np.zeros(4))
