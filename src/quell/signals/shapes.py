"""Signals: the base class, shapes, sums, repeats, recorded samples."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from quell import checks
from quell.hints import explained
from quell.types import Vector, warn

# ---- The base class of signals, and how signals are combined ----

# Tolerance [s] by which an edge on a sample belongs to it if rounding makes k dt fall short of it.
# Chosen by hand, far below usable sample times; not tuned further.
EDGE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Signal:
    """Base class of signals; a new kind must define ``evaluate``."""

    def evaluate(self, t: Vector) -> Vector:
        """Return the values at the times ``t`` [s], an array of the same shape."""
        raise TypeError(f"{type(self).__name__} must define evaluate(t)")

    def __call__(self, t: Any) -> Vector:
        """Return the values at the times ``t`` [s]; a number gives a 0-d array."""
        times = np.asarray(t, dtype=np.float64)
        values = np.asarray(self.evaluate(times), dtype=np.float64)
        if values.shape != times.shape:
            raise ValueError(
                f"{type(self).__name__}.evaluate returned shape {values.shape} for times of shape "
                f"{times.shape}"
            )
        return values

    def seeded(self, seed: int) -> Signal:
        """Return this signal with its noise, if any, drawn from ``seed``."""
        return self

    def derivative(self) -> Signal:
        """Return the derivative in time, without the impulses of jumps.

        Raise a ``ValueError`` if it is not known in closed form.
        """
        raise ValueError(
            f"reference has no derivative known in closed form, {type(self).__name__} has none: "
            "take another signal, define derivative(), or use a prefilter"
        )

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
        factor = checks.nonzero("factor", factor, "a signal can't be divided by it")
        return Scaled(1.0 / factor, self)

    __radd__ = __add__
    __rmul__ = __mul__


@dataclass(frozen=True)
class Constant(Signal):
    """A constant ``value``."""

    value: float = 0.0

    def __post_init__(self) -> None:
        checks.finite("value", self.value)

    def evaluate(self, t: Vector) -> Vector:
        """Return the constant."""
        return np.full(t.shape, float(self.value))

    def derivative(self) -> Signal:
        """Return zero."""
        return Constant(0.0)


@dataclass(frozen=True)
class Scaled(Signal):
    """``factor`` times another signal; written ``factor * signal``."""

    factor: float
    signal: Signal

    def evaluate(self, t: Vector) -> Vector:
        """Return the scaled values."""
        return self.factor * self.signal(t)

    def derivative(self) -> Signal:
        """Return the scaled derivative."""
        return replace(self, signal=self.signal.derivative())

    def seeded(self, seed: int) -> Signal:
        """Return the signal with seeded noise."""
        return replace(self, signal=self.signal.seeded(seed))


@dataclass(frozen=True)
class Sum(Signal):
    """The sum of several signals; written ``a + b``."""

    terms: tuple[Signal, ...]

    def evaluate(self, t: Vector) -> Vector:
        """Return the sum."""
        total = np.zeros(t.shape)
        for term in self.terms:
            total += term(t)
        return total

    def derivative(self) -> Signal:
        """Return the sum of the derivatives."""
        return replace(self, terms=tuple(term.derivative() for term in self.terms))

    def seeded(self, seed: int) -> Signal:
        """Return the sum with independently seeded terms."""
        return replace(self, terms=seeded_apart(self.terms, seed))


@dataclass(frozen=True)
class Switched(Signal):
    """Signals one after the other: ``pieces[i]`` from ``times[i − 1]`` to ``times[i]`` [s].

    Each piece is evaluated at absolute time.
    """

    times: tuple[float, ...]
    pieces: tuple[Signal, ...]

    def __post_init__(self) -> None:
        times = checks.vector("times", self.times)
        if len(self.pieces) != times.size + 1:
            sizes = f"pieces has {len(self.pieces)} entries, times {times.size}"
            raise ValueError(f"{sizes}: there must be one piece more than times")
        if np.any(np.diff(times) <= 0.0):
            raise ValueError(f"times = {self.times!r}: must increase")

    def evaluate(self, t: Vector) -> Vector:
        """Return the values of the piece at each time."""
        edges = [time - EDGE_TOLERANCE for time in self.times]
        if t.size:
            first, last = bisect_right(edges, t.min()), bisect_right(edges, t.max())
            if first == last:
                return self.pieces[first](t)
        which = np.searchsorted(edges, t, side="right")
        values = np.empty(t.shape)
        for i, piece in enumerate(self.pieces):
            inside = which == i
            values[inside] = piece(t[inside])
        return values

    def derivative(self) -> Signal:
        """Return the derivatives of the pieces."""
        return replace(self, pieces=tuple(piece.derivative() for piece in self.pieces))

    def seeded(self, seed: int) -> Signal:
        """Return the signal with independently seeded pieces."""
        return replace(self, pieces=seeded_apart(self.pieces, seed))


def as_signal(value: Signal | float, name: str = "signal") -> Signal:
    """Return a signal as it is and a number as a constant; errors call the value ``name``."""
    if isinstance(value, Signal):
        return value
    if callable(value) or np.ndim(value) > 0:
        what = "a function" if callable(value) else f"{np.size(value)} numbers"
        raise ValueError(
            f"{name}: is {what}, must be a number or a signal; samples become one by "
            "quell.signals.Samples(times, values)"
        )
    return Constant(checks.finite(name, value))


def seeded_apart(signals: Sequence[Signal], seed: int) -> tuple[Signal, ...]:
    """Return the signals seeded from one seed, with independent streams."""
    if not signals:
        return ()
    seeds = _seeds(seed, len(signals))
    return tuple(signal.seeded(child) for signal, child in zip(signals, seeds, strict=True))


@lru_cache(maxsize=64)
def _seeds(seed: int, count: int) -> tuple[int, ...]:
    return tuple(np.random.SeedSequence(seed).generate_state(count, np.uint32).tolist())


def check_finite_fields(signal: Signal, *names: str) -> None:
    """Raise a ``ValueError`` if a parameter, by default any, is not a finite number."""
    for name in names or [f.name for f in fields(signal)]:
        checks.finite(name, getattr(signal, name))


# ---- Signals of a given shape ----


@explained("quell.signals.Step(height=1.0, at=0.5)")
@dataclass(frozen=True)
class Step(Signal):
    """Zero before ``at`` [s], ``height`` from it on."""

    height: float = 1.0
    at: float = 0.0

    def __post_init__(self) -> None:
        check_finite_fields(self)

    def evaluate(self, t: Vector) -> Vector:
        """Return the step."""
        return np.where(t >= self.at - EDGE_TOLERANCE, float(self.height), 0.0)

    def derivative(self) -> Signal:
        """Return zero."""
        return Constant(0.0)


@dataclass(frozen=True)
class Ramp(Signal):
    """Zero before ``start`` [s], then ``slope`` times the time until ``stop`` [s], then held."""

    slope: float = 1.0
    start: float = 0.0
    stop: float = math.inf

    def __post_init__(self) -> None:
        checks.finite("slope", self.slope)
        checks.interval("start", checks.finite("start", self.start), "stop", self.stop)

    def evaluate(self, t: Vector) -> Vector:
        """Return the ramp."""
        return self.slope * (np.clip(t, self.start, self.stop) - self.start)

    def derivative(self) -> Signal:
        """Return the slope between ``start`` and ``stop``."""
        rising = Step(self.slope, self.start)
        return rising if math.isinf(self.stop) else rising - Step(self.slope, self.stop)


@explained("quell.signals.Sinusoid(amplitude=1.0, omega=6.28)")
@dataclass(frozen=True)
class Sinusoid(Signal):
    """``amplitude · sin(omega (t − start) + phase)``, zero before ``start`` [s].

    ``omega`` is in rad/s, ``phase`` in rad.
    """

    amplitude: float = 1.0
    omega: float = 1.0
    phase: float = 0.0
    start: float = 0.0

    def __post_init__(self) -> None:
        check_finite_fields(self)

    def evaluate(self, t: Vector) -> Vector:
        """Return the sinusoid."""
        since = t - self.start
        started = since >= -EDGE_TOLERANCE
        if not started.any():
            return np.zeros(t.shape)
        wave = self.amplitude * np.sin(self.omega * since + self.phase)
        return wave if started.all() else np.where(started, wave, 0.0)

    def derivative(self) -> Signal:
        """Return the sinusoid a quarter of a period ahead."""
        amplitude, phase = self.amplitude * self.omega, self.phase + 0.5 * math.pi
        return replace(self, amplitude=amplitude, phase=phase)


@dataclass(frozen=True)
class Chirp(Signal):
    """A sinusoid whose frequency moves from ``omega_start`` to ``omega_end`` [rad/s], then stays.

    It moves in ``duration`` [s] linearly, or with ``logarithmic`` exponentially, so that each
    octave takes the same time. The phase is the integral of the frequency and has no jump.
    """

    amplitude: float = 1.0
    omega_start: float = 0.1
    omega_end: float = 10.0
    duration: float = 10.0
    start: float = 0.0
    logarithmic: bool = False

    def __post_init__(self) -> None:
        check_finite_fields(self, "amplitude", "omega_start", "omega_end", "start")
        checks.positive("duration", self.duration, "s")
        if checks.flag("logarithmic", self.logarithmic):
            checks.positive("omega_start", self.omega_start, "rad/s")
            checks.positive("omega_end", self.omega_end, "rad/s")

    def omega(self, t: Any) -> Vector:
        """Return its frequency [rad/s] at the times ``t`` [s]."""
        share = np.clip((np.asarray(t, dtype=np.float64) - self.start) / self.duration, 0.0, 1.0)
        if self.logarithmic:
            return np.asarray(self.omega_start * (self.omega_end / self.omega_start) ** share)
        return np.asarray(self.omega_start + (self.omega_end - self.omega_start) * share)

    def evaluate(self, t: Vector) -> Vector:
        """Return the chirp."""
        since = np.maximum(t - self.start, 0.0)
        sweep = np.minimum(since, self.duration)
        ratio = self.omega_end / self.omega_start if self.logarithmic else 1.0
        growth = math.log(ratio) / self.duration
        if growth:
            phase = self.omega_start * np.expm1(growth * sweep) / growth
        else:
            change = self.omega_end - self.omega_start
            phase = self.omega_start * sweep + 0.5 * change * sweep**2 / self.duration
        return self.amplitude * np.sin(phase + self.omega_end * (since - sweep))


@dataclass(frozen=True)
class Trapezoid(Signal):
    """A move from 0 to ``distance`` with a trapezoidal velocity profile, then held.

    Parameters
    ----------
    distance
        final position [y-unit], of either sign.
    duration
        duration of the move [s].
    ramp_time
        duration of the acceleration, and of the deceleration [s]; at most half of ``duration``
        (then the profile is a triangle). A third by default, the profile of least energy.
    start
        time of its start [s].
    """

    distance: float = 1.0
    duration: float = 2.0
    ramp_time: float | None = None
    start: float = 0.0

    def __post_init__(self) -> None:
        check_finite_fields(self, "distance", "start")
        checks.positive("duration", self.duration, "s")
        ramp = self._ramp
        if not 0.0 < ramp <= self.duration / 2:
            bound = self.duration / 2
            raise ValueError(f"ramp_time = {ramp!r}: must be in (0, duration / 2 = {bound}]")

    @property
    def _ramp(self) -> float:
        if self.ramp_time is None:
            return self.duration / 3
        return checks.finite("ramp_time", self.ramp_time)

    def evaluate(self, t: Vector) -> Vector:
        """Return the position along the move."""
        ramp, since = self._ramp, np.clip(t - self.start, 0.0, self.duration)
        cruise = self.distance / (self.duration - ramp)
        left = self.duration - since
        accelerating = 0.5 * cruise / ramp * since**2
        braking = self.distance - 0.5 * cruise / ramp * left**2
        cruising = cruise * (since - 0.5 * ramp)
        return np.where(since < ramp, accelerating, np.where(left < ramp, braking, cruising))

    def derivative(self) -> Signal:
        """Return the speed: the difference of two ramps."""
        ramp, end = self._ramp, self.start + self.duration
        slope = self.distance / (self.duration - ramp) / ramp
        return Ramp(slope, self.start, self.start + ramp) - Ramp(slope, end - ramp, end)


@dataclass(frozen=True)
class SmoothMove(Signal):
    """A move from 0 to ``distance`` along a polynomial with smooth ends, then held.

    With σ = (t − start)/duration the position is ``distance · I_σ(m + 1, m + 1)``, the regularised
    incomplete beta function: the speed is proportional to ``σ^m (1 − σ)^m``. For m = 2 it is the
    move of least jerk (Flash & Hogan, *J. Neuroscience* 5, 1985).

    Parameters
    ----------
    distance
        final position [y-unit], of either sign.
    duration
        duration of the move [s].
    smoothness
        number m of continuous derivatives, 1 to 12; feedforward for a plant of order n needs n.
    start
        time of its start [s].
    order
        order of the derivative; 0 is the move itself.
    """

    distance: float = 1.0
    duration: float = 2.0
    smoothness: int = 4
    start: float = 0.0
    order: int = 0

    def __post_init__(self) -> None:
        check_finite_fields(self, "distance", "start")
        checks.positive("duration", self.duration, "s")
        checks.whole("smoothness", self.smoothness, 1, 12)
        checks.whole("order", self.order, 0)

    def evaluate(self, t: Vector) -> Vector:
        """Return the position along the move, or its derivative."""
        sigma = np.clip((t - self.start) / self.duration, 0.0, 1.0)
        # Mirror the first half, because near σ = 1 rounding errors of the polynomial are large.
        second_half = sigma > 0.5
        near = np.where(second_half, 1.0 - sigma, sigma)
        polynomial, end = _smooth_position(self.smoothness, self.order)
        value = polynomial(near) / end * self.distance / self.duration**self.order
        if self.order == 0:
            return np.where(second_half, self.distance - value, value)
        value = np.where(second_half, (-1.0) ** (self.order + 1) * value, value)
        after = self.start + self.duration - EDGE_TOLERANCE
        return np.where((t >= self.start - EDGE_TOLERANCE) & (t < after), value, 0.0)

    def derivative(self) -> Signal:
        """Return the next derivative."""
        return replace(self, order=self.order + 1)


@lru_cache(maxsize=64)
def _smooth_position(m: int, order: int) -> tuple[np.polynomial.Polynomial, float]:
    """Return a derivative of ``∫ σ^m (1 − σ)^m dσ``, and the integral over the whole move."""
    power = np.polynomial.Polynomial([math.comb(m, i) * (-1.0) ** i for i in range(m + 1)])
    position = (power * np.polynomial.Polynomial.basis(m)).integ()
    return position.deriv(order) if order else position, position(0.5) * 2.0


# ---- A signal that repeats another one ----

# Largest number of repetitions: times are then still exact to a nanosecond within a period of 10 s.
_MOST = 10**6


@dataclass(frozen=True)
class Repeated(Signal):
    """A cycle that is repeated: ``cycle(t − start − k period)`` in repetition k.

    Before ``start`` it is the cycle at negative times, and after the last repetition the cycle goes
    on past its period. Noise in a cycle is repeated as well. A cycle should end where it begins,
    else the signal jumps.

    Parameters
    ----------
    cycle
        signal of time since the beginning of the repetition [s]; used from 0 to ``period``.
    period
        time from one repetition to the next [s].
    count
        number of repetitions; by default it never ends.
    start
        time of the first repetition [s].

    Raises
    ------
    ValueError
        for a cycle that is no signal or number, a period that is not positive, or a count below 1.

    Examples
    --------
    >>> there_and_back = Trapezoid(1.0, 1.0) - Trapezoid(1.0, 1.0, start=2.0)
    >>> moves = Repeated(there_and_back, period=4.0, count=50)
    >>> square_wave = Repeated(Constant(1.0).until(0.5, then=-1.0), period=1.0)
    """

    cycle: Signal | float
    period: float
    count: int | None = None
    start: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "cycle", as_signal(self.cycle, "cycle"))
        checks.positive("period", self.period, "s")
        checks.optional(checks.whole, "count", self.count, 1, _MOST)
        checks.finite("start", self.start)

    @property
    def _cycle(self) -> Signal:
        return as_signal(self.cycle)

    def evaluate(self, t: Vector) -> Vector:
        """Return the values of the cycle."""
        since = t - self.start
        repetition = np.maximum(np.floor((since + EDGE_TOLERANCE) / self.period), 0.0)
        if self.count is not None:
            repetition = np.minimum(repetition, self.count - 1.0)
        return self._cycle(since - repetition * self.period)

    def derivative(self) -> Signal:
        """Return the repeated derivative of the cycle."""
        return replace(self, cycle=self._cycle.derivative())

    def seeded(self, seed: int) -> Signal:
        """Return the signal with seeded noise, the same in all repetitions."""
        return replace(self, cycle=self._cycle.seeded(seed))


# ---- Recorded samples as a signal, with their derivatives ----

# Degree of the spline: r to r'''' are continuous, as the feedforward of a flexible axis needs them.
_DEGREE = 5


@dataclass(frozen=True, eq=False)
class Samples(Signal):
    """Recorded samples, interpolated or held; beyond the ends the first and last value hold.

    Parameters
    ----------
    times
        times of the samples [s], increasing.
    values
        of the same size.
    hold
        ``"linear"`` interpolates, ``"previous"`` holds each value until the next, ``"spline"`` lays
        a spline of degree 5 through the samples, at rest (r' = r'' = 0) at both ends: its first
        four derivatives are continuous inside. It smooths no noise.
    derivatives
        samples of r', r'', … [y-unit/s^i], as many as are known, each of the size of ``values``;
        for ``"linear"`` and ``"previous"``. Else those of lines are their slopes, and there is no
        second one: a controller with feedforward is warned.

    Raises
    ------
    ValueError
        for times that do not increase, other sizes, and derivatives beside a spline, which has its
        own.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.linspace(0.0, 1.0, 11)
    >>> move = Samples(t, 10 * t**3 - 15 * t**4 + 6 * t**5, hold="spline")
    >>> round(float(move.derivative()(0.5)), 6)
    1.875
    """

    times: Any
    values: Any
    hold: str = "linear"
    derivatives: Sequence[Any] = ()

    def __post_init__(self) -> None:
        times = checks.vector("times", self.times)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", checks.vector("values", self.values, times.size))
        checks.one_of("hold", self.hold, ("linear", "previous", "spline"))
        if times.size == 0 or np.any(np.diff(times) <= 0.0):
            raise ValueError("times: must hold at least one sample and increase")
        if not checks.is_sequence(self.derivatives) and np.ndim(self.derivatives) != 2:
            raise ValueError(f"derivatives = {self.derivatives!r}: must be a list of samples")
        if self.hold == "spline" and len(self.derivatives):
            raise ValueError(
                "derivatives: are those of the spline; leave them out, or take hold = 'linear'"
            )
        if self.hold == "spline" and times.size < 2:
            raise ValueError(f"times has {times.size} sample: a spline needs two")
        known = [
            checks.vector(f"derivatives[{i}]", each, times.size)
            for i, each in enumerate(self.derivatives)
        ]
        object.__setattr__(self, "derivatives", tuple(known))

    def evaluate(self, t: Vector) -> Vector:
        """Return the samples at ``t``."""
        if self.hold == "linear":
            return np.asarray(np.interp(t, self.times, self.values))
        if self.hold == "spline":
            return np.asarray(self._spline(np.clip(t, self.times[0], self.times[-1])))
        index = np.searchsorted(self.times - EDGE_TOLERANCE, t, side="right") - 1
        return np.asarray(self.values[np.maximum(index, 0)])

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import make_interp_spline

        rest = [(1, 0.0), (2, 0.0)]
        return make_interp_spline(self.times, self.values, k=_DEGREE, bc_type=(rest, rest))

    def derivative(self) -> Signal:
        """Return the derivative: as given, of the spline, or the slope between samples."""
        first, last = float(self.times[0]), float(self.times[-1])
        if self.hold == "spline":
            inside: Signal = _SplineDerivative(self._spline.derivative(), last)
            return Constant(0.0).until(first, then=inside)
        if len(self.derivatives):
            own, *rest = self.derivatives
            inside = replace(self, values=own, derivatives=tuple(rest))
            return Constant(0.0).until(first, then=inside.until(last, then=0.0))
        if self.hold == "previous" or self.times.size < 2:
            return Constant(0.0)
        slopes = np.diff(self.values) / np.diff(self.times)
        lines = Samples(self.times, np.append(slopes, 0.0), hold="previous")
        return Constant(0.0).until(first, then=lines)


def check_derivative(signal: Signal) -> None:
    """Warn if the derivative of a signal is zero because held samples in it have no other one."""
    parts: list[Any] = [signal]
    while parts:
        part = parts.pop()
        if isinstance(part, tuple):
            parts += part
        elif isinstance(part, Samples):
            if part.hold == "previous" and not part.derivatives and np.ptp(part.values) > 0.0:
                message = (
                    "the reference has samples that are held, or joined by lines, without another "
                    "derivative: feedforward gets zero; give Samples(derivatives=...), or take "
                    'hold="spline"'
                )
                warn(message)
                return
        elif isinstance(part, Signal):
            parts += [getattr(part, each.name) for each in fields(part)]


@dataclass(frozen=True, eq=False)
class _SplineDerivative(Signal):
    """A derivative of a spline, zero from ``last`` [s] on."""

    spline: Any
    last: float

    def evaluate(self, t: Vector) -> Vector:
        """Return the values."""
        inside = t < self.last - EDGE_TOLERANCE
        return np.where(inside, self.spline(np.minimum(t, self.last)), 0.0)

    def derivative(self) -> Signal:
        """Return the next derivative; zero beyond the degree."""
        if self.spline.k == 0:
            return Constant(0.0)
        return replace(self, spline=self.spline.derivative())
