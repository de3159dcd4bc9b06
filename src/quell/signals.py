"""References, disturbances and noise as functions of time.

A signal is an immutable object called with an array of times [s]; it returns an array of values. It has no state, so it can be
evaluated anywhere, in any order, in pieces of any size, always with the same bits. Signals add, subtract and scale::

    reference   = Sinusoid(amplitude=1.0, omega=1.0).until(110.0, then=Step(at=110.0))
    disturbance = 0.5 * Step(at=2.0) + BandLimitedNoise(power=1e-6, sample_time=0.01)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np

from quell import checks
from quell.types import Vector

# Edges that fall on a sample belong to it even when k * dt is short of it by rounding.
_EDGE = 1e-9


@dataclass(frozen=True)
class Signal:
    """What every signal can do; ``evaluate`` is what a new kind has to give."""

    def evaluate(self, t: Vector) -> Vector:
        """Return the values at the times ``t`` [s], an array of the same shape."""
        raise TypeError(f"{type(self).__name__} must define evaluate(t)")

    def __call__(self, t: Any) -> Vector:
        """Return the values at the times ``t`` [s]; a number gives a 0-d array."""
        times = np.asarray(t, dtype=np.float64)
        values = np.asarray(self.evaluate(times), dtype=np.float64)
        if values.shape != times.shape:
            raise ValueError(f"{type(self).__name__}.evaluate returned shape {values.shape} for times of shape {times.shape}")
        return values

    def seeded(self, seed: int) -> Signal:
        """Return this signal with its noise, if it has any, drawn from ``seed``."""
        return self

    def until(self, time: float, then: Signal | float) -> Signal:
        """Return this signal before ``time`` [s] and ``then``, a signal or a number, from it on."""
        return Switched((checks.finite("time", time),), (self, as_signal(then, "then")))

    def __add__(self, other: Signal | float) -> Signal:
        return Sum((self, as_signal(other)))

    def __sub__(self, other: Signal | float) -> Signal:
        return Sum((self, -1.0 * as_signal(other)))

    def __mul__(self, factor: float) -> Signal:
        return Scaled(checks.finite("factor", factor), self)

    def __neg__(self) -> Signal:
        return Scaled(-1.0, self)

    def __rsub__(self, other: Signal | float) -> Signal:
        return as_signal(other) - self

    def __truediv__(self, factor: float) -> Signal:
        return Scaled(1.0 / checks.nonzero("factor", factor, "a signal can't be divided by it"), self)

    __radd__ = __add__
    __rmul__ = __mul__


@dataclass(frozen=True)
class Constant(Signal):
    """The same ``value`` at all times."""

    value: float = 0.0

    def __post_init__(self) -> None:
        checks.finite("value", self.value)

    def evaluate(self, t: Vector) -> Vector:
        """Return ``value`` everywhere."""
        return np.full(t.shape, float(self.value))


@dataclass(frozen=True)
class Step(Signal):
    """Zero before ``at`` [s], ``height`` from it on."""

    height: float = 1.0
    at: float = 0.0

    def __post_init__(self) -> None:
        _check_finite(self)

    def evaluate(self, t: Vector) -> Vector:
        """Return the step."""
        return np.where(t >= self.at - _EDGE, float(self.height), 0.0)


@dataclass(frozen=True)
class Ramp(Signal):
    """Zero before ``start`` [s], then rising by ``slope`` a second until ``stop`` [s], then held."""

    slope: float = 1.0
    start: float = 0.0
    stop: float = math.inf

    def __post_init__(self) -> None:
        checks.finite("slope", self.slope)
        checks.interval("start", checks.finite("start", self.start), "stop", self.stop)

    def evaluate(self, t: Vector) -> Vector:
        """Return the ramp."""
        return self.slope * (np.clip(t, self.start, self.stop) - self.start)


@dataclass(frozen=True)
class Sinusoid(Signal):
    """``amplitude · sin(omega (t − start) + phase)`` from ``start`` [s] on, zero before; ``omega`` in rad/s, ``phase`` in rad."""

    amplitude: float = 1.0
    omega: float = 1.0
    phase: float = 0.0
    start: float = 0.0

    def __post_init__(self) -> None:
        _check_finite(self)

    def evaluate(self, t: Vector) -> Vector:
        """Return the sinusoid."""
        since = t - self.start
        started = since >= -_EDGE
        if not started.any():
            return np.zeros(t.shape)
        wave = self.amplitude * np.sin(self.omega * since + self.phase)
        return wave if started.all() else np.where(started, wave, 0.0)


@dataclass(frozen=True)
class Chirp(Signal):
    """A sinusoid whose frequency moves linearly from ``omega_start`` to ``omega_end`` [rad/s] in ``duration`` [s], then stays.

    The phase is the integral of the frequency, so it has no jump.
    """

    amplitude: float = 1.0
    omega_start: float = 0.1
    omega_end: float = 10.0
    duration: float = 10.0
    start: float = 0.0

    def __post_init__(self) -> None:
        _check_finite(self)
        checks.positive("duration", self.duration, "s")

    def evaluate(self, t: Vector) -> Vector:
        """Return the chirp."""
        since = np.maximum(t - self.start, 0.0)
        sweep = np.minimum(since, self.duration)
        phase = self.omega_start * sweep + 0.5 * (self.omega_end - self.omega_start) * sweep**2 / self.duration
        return self.amplitude * np.sin(phase + self.omega_end * (since - sweep))


@dataclass(frozen=True)
class Trapezoid(Signal):
    """A move from 0 to ``distance`` with a trapezoidal velocity profile, then held.

    Parameters
    ----------
    distance
        where the move ends [y-unit], of either sign.
    duration
        how long it takes [s].
    ramp_time
        how long it accelerates, and decelerates [s]; at most half of ``duration`` (then the profile is a triangle). A third of
        ``duration`` by default, the profile of least energy.
    start
        when it begins [s].
    """

    distance: float = 1.0
    duration: float = 2.0
    ramp_time: float | None = None
    start: float = 0.0

    def __post_init__(self) -> None:
        checks.finite("distance", self.distance)
        checks.finite("start", self.start)
        checks.positive("duration", self.duration, "s")
        ramp = self._ramp
        if not 0.0 < ramp <= self.duration / 2:
            raise ValueError(f"ramp_time = {self.ramp_time!r}: must be in (0, duration / 2 = {self.duration / 2}]")

    @property
    def _ramp(self) -> float:
        return self.duration / 3 if self.ramp_time is None else checks.finite("ramp_time", self.ramp_time)

    def evaluate(self, t: Vector) -> Vector:
        """Return the position along the move."""
        ramp, since = self._ramp, np.clip(t - self.start, 0.0, self.duration)
        cruise = self.distance / (self.duration - ramp)
        left = self.duration - since
        speeding = 0.5 * cruise / ramp * since**2
        braking = self.distance - 0.5 * cruise / ramp * left**2
        return np.where(since < ramp, speeding, np.where(left < ramp, braking, cruise * (since - 0.5 * ramp)))


@dataclass(frozen=True)
class Scaled(Signal):
    """``factor`` times another signal; written ``factor * signal``."""

    factor: float
    signal: Signal

    def evaluate(self, t: Vector) -> Vector:
        """Return the scaled values."""
        return self.factor * self.signal(t)

    def seeded(self, seed: int) -> Signal:
        """Seed the signal inside."""
        return replace(self, signal=self.signal.seeded(seed))


@dataclass(frozen=True)
class Sum(Signal):
    """The sum of several signals; written ``a + b``."""

    terms: tuple[Signal, ...]

    def evaluate(self, t: Vector) -> Vector:
        """Return the sum."""
        total = np.zeros(t.shape)
        for term in self.terms:
            total = total + term(t)
        return total

    def seeded(self, seed: int) -> Signal:
        """Seed every term, each with a stream of its own."""
        return replace(self, terms=seeded_apart(self.terms, seed))


@dataclass(frozen=True)
class Switched(Signal):
    """Pieces in time: ``pieces[i]`` holds from ``times[i − 1]`` to ``times[i]`` [s]; each is a function of absolute time."""

    times: tuple[float, ...]
    pieces: tuple[Signal, ...]

    def __post_init__(self) -> None:
        times = checks.vector("times", self.times)
        if len(self.pieces) != times.size + 1:
            raise ValueError(f"pieces has {len(self.pieces)} entries, times {times.size}: there must be one piece more than times")
        if np.any(np.diff(times) <= 0.0):
            raise ValueError(f"times = {self.times!r}: must increase")

    def evaluate(self, t: Vector) -> Vector:
        """Return the values of whichever piece holds."""
        edges = np.asarray(self.times) - _EDGE
        if t.size:
            first, last = np.searchsorted(edges, (t.min(), t.max()), side="right")
            if first == last:
                return self.pieces[first](t)
        which = np.searchsorted(edges, t, side="right")
        values = np.empty(t.shape)
        for i, piece in enumerate(self.pieces):
            mine = which == i
            values[mine] = piece(t[mine])
        return values

    def seeded(self, seed: int) -> Signal:
        """Seed every piece, each with a stream of its own."""
        return replace(self, pieces=seeded_apart(self.pieces, seed))


@dataclass(frozen=True, eq=False)
class Samples(Signal):
    """Recorded samples.

    Parameters
    ----------
    times
        when they were taken [s], increasing.
    values
        what they were.
    hold
        ``"linear"`` interpolates, ``"previous"`` holds each value until the next. Outside of the record the end values hold.
    """

    times: Any
    values: Any
    hold: str = "linear"

    def __post_init__(self) -> None:
        times = checks.vector("times", self.times)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", checks.vector("values", self.values, times.size))
        checks.one_of("hold", self.hold, ("linear", "previous"))
        if times.size == 0 or np.any(np.diff(times) <= 0.0):
            raise ValueError("times: must hold at least one sample and increase")

    def evaluate(self, t: Vector) -> Vector:
        """Return the samples at ``t``."""
        if self.hold == "linear":
            return np.asarray(np.interp(t, self.times, self.values))
        index = np.searchsorted(self.times - _EDGE, t, side="right") - 1
        return np.asarray(self.values[np.maximum(index, 0)])


@dataclass(frozen=True)
class BandLimitedNoise(Signal):
    """White noise limited in band by holding each draw, as Simulink's block "Band-Limited White Noise".

    Parameters
    ----------
    power
        the height of the power spectral density [unit²/Hz]; the variance of a draw is ``power / sample_time``.
    sample_time
        how long each draw is held [s]; the spectrum is flat well below π / sample_time rad/s.
    seed
        which noise; the same seed gives the same bits whatever times are asked for.
    """

    power: float = 1e-12
    sample_time: float = 0.01
    seed: int = field(default=0)

    def __post_init__(self) -> None:
        checks.non_negative("power", self.power)
        checks.positive("sample_time", self.sample_time, "s")
        checks.whole("seed", self.seed, 0)

    def evaluate(self, t: Vector) -> Vector:
        """Return the draws that hold at ``t``; none are drawn for negative times, which give zero."""
        count = t * (1.0 / self.sample_time) + (1.0 + 1e-6)
        if t.size and not float(np.max(np.abs(count))) < 2.0**52:
            raise ValueError(f"sample_time = {self.sample_time!r}: too short to be counted in times of {float(np.max(np.abs(t))):g} s")
        index = count.astype(np.int64) - 1  # floor, for times from 0 on
        first, last = (int(index.min()) // _BLOCK, int(index.max()) // _BLOCK) if t.size else (0, -1)
        blocks = np.arange(first, last + 1) if last - first < _BLOCKS_AT_ONCE else np.unique(index // _BLOCK)
        values = np.zeros(t.shape)
        sigma = math.sqrt(self.power / self.sample_time)
        for block in blocks[blocks >= 0].tolist():
            place = index - block * _BLOCK
            if blocks.size == 1:
                return sigma * _draws(self.seed, block)[place]
            mine = (place >= 0) & (place < _BLOCK)
            values[mine] = sigma * _draws(self.seed, block)[place[mine]]
        return values

    def seeded(self, seed: int) -> Signal:
        """Return the same noise from another seed."""
        return replace(self, seed=seed)


# Draws come in blocks, each with a generator of its own, so that any stretch of time can be asked for.
_BLOCK = 4096
_BLOCKS_AT_ONCE = 64


@lru_cache(maxsize=16)
def _draws(seed: int, block: int) -> Vector:
    draws = np.random.default_rng([seed, block]).standard_normal(_BLOCK)
    draws.flags.writeable = False
    return draws


def seeded_apart(signals: Sequence[Signal], seed: int) -> tuple[Signal, ...]:
    """Seed several signals from one seed, so that no two of them share a stream."""
    if not signals:
        return ()
    children = np.random.SeedSequence(seed).generate_state(len(signals), np.uint32).tolist()
    return tuple(signal.seeded(child) for signal, child in zip(signals, children, strict=True))


def as_signal(value: Signal | float, name: str = "signal") -> Signal:
    """Return a signal as it is and a number as a constant; ``name`` is what an error calls it."""
    return value if isinstance(value, Signal) else Constant(checks.finite(name, value))


KINDS: Mapping[str, type[Signal]] = {
    "constant": Constant,
    "step": Step,
    "ramp": Ramp,
    "sinusoid": Sinusoid,
    "chirp": Chirp,
    "trapezoid": Trapezoid,
    "samples": Samples,
    "noise": BandLimitedNoise,
}
"""The signals that a name and numbers describe, as scenario files use them."""


def make(kind: str, **parameters: Any) -> Signal:
    """Make a signal from the name of its kind and its parameters.

    Raises
    ------
    ValueError
        for an unknown kind or parameter; the message lists the known ones.
    """
    cls = KINDS[checks.one_of("signal", kind, tuple(KINDS))]
    known = tuple(f.name for f in fields(cls))
    for name in parameters:
        checks.one_of(f"parameter of signal {kind!r}", name, known)
    try:
        return cls(**parameters)
    except TypeError as error:
        raise ValueError(f"signal {kind!r}: {str(error).split('() ')[-1]}") from None


def _check_finite(signal: Signal) -> None:
    for f in fields(signal):
        checks.finite(f.name, getattr(signal, f.name))
