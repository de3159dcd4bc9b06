"""Signals of a given shape."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
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
