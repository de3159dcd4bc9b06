"""Signals of a given shape."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quell import checks
from quell.signals.base import EDGE_TOLERANCE, Constant, Signal, check_finite_fields
from quell.types import Vector


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

    def derivative(self) -> Signal:
        """Return the slope while it rises."""
        rising = Step(self.slope, self.start)
        return rising if math.isinf(self.stop) else rising - Step(self.slope, self.stop)


@dataclass(frozen=True)
class Sinusoid(Signal):
    """``amplitude · sin(omega (t − start) + phase)`` from ``start`` [s] on, zero before; ``omega`` in rad/s, ``phase`` in rad."""

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
        return replace(
            self, amplitude=self.amplitude * self.omega, phase=self.phase + 0.5 * math.pi
        )


@dataclass(frozen=True)
class Chirp(Signal):
    """A sinusoid whose frequency moves from ``omega_start`` to ``omega_end`` [rad/s] in ``duration`` [s], then stays.

    It moves linearly, or with ``logarithmic`` by the same factor in every second: then each octave gets the same time. The phase is the
    integral of the frequency, so it has no jump.
    """

    amplitude: float = 1.0
    omega_start: float = 0.1
    omega_end: float = 10.0
    duration: float = 10.0
    start: float = 0.0
    logarithmic: bool = False

    def __post_init__(self) -> None:
        for name in ("amplitude", "omega_start", "omega_end", "start"):
            checks.finite(name, getattr(self, name))
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
        growth = (
            math.log(self.omega_end / self.omega_start) / self.duration if self.logarithmic else 0.0
        )
        if growth:
            phase = self.omega_start * np.expm1(growth * sweep) / growth
        else:
            phase = (
                self.omega_start * sweep
                + 0.5 * (self.omega_end - self.omega_start) * sweep**2 / self.duration
            )
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
            raise ValueError(
                f"ramp_time = {self.ramp_time!r}: must be in (0, duration / 2 = {self.duration / 2}]"
            )

    @property
    def _ramp(self) -> float:
        return (
            self.duration / 3
            if self.ramp_time is None
            else checks.finite("ramp_time", self.ramp_time)
        )

    def evaluate(self, t: Vector) -> Vector:
        """Return the position along the move."""
        ramp, since = self._ramp, np.clip(t - self.start, 0.0, self.duration)
        cruise = self.distance / (self.duration - ramp)
        left = self.duration - since
        speeding = 0.5 * cruise / ramp * since**2
        braking = self.distance - 0.5 * cruise / ramp * left**2
        return np.where(
            since < ramp, speeding, np.where(left < ramp, braking, cruise * (since - 0.5 * ramp))
        )

    def derivative(self) -> Signal:
        """Return the speed: a trapezoid of two ramps."""
        ramp, end = self._ramp, self.start + self.duration
        acceleration = self.distance / (self.duration - ramp) / ramp
        return Ramp(acceleration, self.start, self.start + ramp) - Ramp(
            acceleration, end - ramp, end
        )


@dataclass(frozen=True)
class SmoothMove(Signal):
    """A move from 0 to ``distance`` along the polynomial whose first derivatives vanish at both ends, then held.

    With σ = (t − start)/duration the position is ``distance · I_σ(m + 1, m + 1)``, the regularised incomplete beta function: its speed is
    proportional to ``σ^m (1 − σ)^m``. For m = 2 that is the move of least jerk (Flash & Hogan, *J. Neuroscience* 5, 1985).

    Parameters
    ----------
    distance
        where the move ends [y-unit], of either sign.
    duration
        how long it takes [s].
    smoothness
        how many derivatives m are continuous, 1 to 12: feedforward for a plant of order n wants n.
    start
        when it begins [s].
    order
        which derivative of it this is; 0 is the move itself.
    """

    distance: float = 1.0
    duration: float = 2.0
    smoothness: int = 4
    start: float = 0.0
    order: int = 0

    def __post_init__(self) -> None:
        checks.finite("distance", self.distance)
        checks.finite("start", self.start)
        checks.positive("duration", self.duration, "s")
        checks.whole("smoothness", self.smoothness, 1, 12)
        checks.whole("order", self.order, 0)

    def evaluate(self, t: Vector) -> Vector:
        """Return the position along the move, or its derivative."""
        m, sigma = self.smoothness, np.clip((t - self.start) / self.duration, 0.0, 1.0)
        # The second half is the first one mirrored: the polynomial itself cancels badly near σ = 1.
        back = sigma > 0.5
        near = np.where(back, 1.0 - sigma, sigma)
        speed = np.polynomial.Polynomial(
            [math.comb(m, i) * (-1.0) ** i for i in range(m + 1)]
        ) * np.polynomial.Polynomial.basis(m)
        position = speed.integ()
        value = position.deriv(self.order)(near) if self.order else position(near)
        value = value / (position(0.5) * 2.0) * self.distance / self.duration**self.order
        mirrored = self.distance - value if self.order == 0 else (-1.0) ** (self.order + 1) * value
        inside = np.where(back, mirrored, value)
        return (
            inside
            if self.order == 0
            else np.where(
                (t >= self.start - EDGE_TOLERANCE)
                & (t < self.start + self.duration - EDGE_TOLERANCE),
                inside,
                0.0,
            )
        )

    def derivative(self) -> Signal:
        """Return the next derivative."""
        return replace(self, order=self.order + 1)


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
        index = np.searchsorted(self.times - EDGE_TOLERANCE, t, side="right") - 1
        return np.asarray(self.values[np.maximum(index, 0)])

    def derivative(self) -> Signal:
        """Return the slope between samples."""
        if self.hold == "previous" or self.times.size < 2:
            return Constant(0.0)
        slopes = np.diff(self.values) / np.diff(self.times)
        return Constant(0.0).until(
            self.times[0], then=Samples(self.times, np.append(slopes, 0.0), hold="previous")
        )
