"""A move with limits of speed, acceleration and jerk."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.signals.base import EDGE_TOLERANCE, Constant, Signal, check_finite_fields
from quell.types import Vector


class Phases(NamedTuple):
    """Durations of the parts of a move from rest to rest [s]."""

    jerk: float  # of each of the four parts with the largest jerk
    acceleration: float  # of each of the two parts with constant acceleration
    cruise: float  # of the part with constant speed

    @property
    def duration(self) -> float:
        """Duration of the whole move [s]."""
        return 4.0 * self.jerk + 2.0 * self.acceleration + self.cruise


def phases(distance: float, v_max: float, a_max: float, j_max: float) -> Phases:
    """Return the parts of the quickest move over a distance ≥ 0 within the limits.

    It has seven parts: jerk up, constant acceleration, jerk down, constant speed, and the mirror
    image; those that the distance leaves no room for have the duration zero (Biagiotti &
    Melchiorri, *Trajectory Planning for Automatic Machines and Robots*, Springer 2008, sect. 3.4).
    """
    reaches = v_max * j_max >= a_max**2  # the largest acceleration, before the largest speed
    jerk = a_max / j_max if reaches else math.sqrt(v_max / j_max)
    acceleration = v_max / a_max - jerk if reaches else 0.0
    cruise = distance / v_max - (2.0 * jerk + acceleration)
    if cruise >= 0.0:
        return Phases(jerk, acceleration, cruise)
    ramp = a_max / j_max
    speed = 0.5 * a_max * (math.sqrt(ramp**2 + 4.0 * distance / a_max) - ramp)
    if speed >= a_max * ramp:
        return Phases(ramp, max(speed / a_max - ramp, 0.0), 0.0)
    return Phases((0.5 * distance / j_max) ** (1.0 / 3.0), 0.0, 0.0)


@dataclass(frozen=True)
class LimitedMove(Signal):
    """The quickest move from 0 to ``distance`` within limits of speed, acceleration and jerk.

    Its acceleration is a trapezoid, or a triangle, in each half; then the distance is held. The
    jerk is the last derivative without impulses: ``derivative`` has zero for the next ones.

    Parameters
    ----------
    distance
        final position [y-unit], of either sign.
    v_max, a_max, j_max
        limits of speed [y-unit/s], acceleration [y-unit/s²] and jerk [y-unit/s³].
    start
        time of its start [s].
    order
        order of the derivative; 0 is the move itself.

    Raises
    ------
    ValueError
        for a limit that is not positive.

    Examples
    --------
    >>> move = LimitedMove(1.5708, v_max=20.0, a_max=500.0, j_max=20_000.0)
    >>> round(move.duration, 4)
    0.1435
    """

    distance: float = 1.0
    v_max: float = 1.0
    a_max: float = 1.0
    j_max: float = 1.0
    start: float = 0.0
    order: int = 0

    def __post_init__(self) -> None:
        check_finite_fields(self, "distance", "start")
        checks.positive("v_max", self.v_max, "y-unit/s")
        checks.positive("a_max", self.a_max, "y-unit/s²")
        checks.positive("j_max", self.j_max, "y-unit/s³")
        checks.whole("order", self.order, 0, 3)

    @property
    def phases(self) -> Phases:
        """Durations of its parts."""
        return phases(abs(self.distance), self.v_max, self.a_max, self.j_max)

    @property
    def duration(self) -> float:
        """Duration of the move [s]."""
        return self.phases.duration

    def evaluate(self, t: Vector) -> Vector:
        """Return the position along the move, or its derivative."""
        parts, sign = self.phases, math.copysign(1.0, self.distance)
        since = t - self.start
        if self.order > 0:  # an edge on a sample belongs to it
            since = since + EDGE_TOLERANCE
        whole = parts.duration
        # The second half is the mirror image of the first one, in which rounding errors are small.
        second = since > 0.5 * whole
        near = np.clip(np.where(second, whole - since, since), 0.0, 0.5 * whole)
        value = sign * _first_half(parts, self.j_max, near, self.order)
        if self.order == 0:
            return np.where(second, self.distance - value, value)
        value = np.where(second, (-1.0) ** (self.order + 1) * value, value)
        return np.where((since >= 0.0) & (since < whole), value, 0.0)

    def derivative(self) -> Signal:
        """Return the next derivative, without the impulses of the jerk's jumps."""
        return Constant(0.0) if self.order == 3 else replace(self, order=self.order + 1)


def _first_half(parts: Phases, jerk: float, t: Vector, order: int) -> Vector:
    """Return position, speed, acceleration or jerk up to the middle of the move."""
    state = np.zeros(4)  # at the beginning of a part
    ends = np.cumsum([parts.jerk, parts.acceleration, parts.jerk])
    value, begin = np.zeros(np.shape(t)), 0.0
    for i, (end, now) in enumerate(zip([*ends, math.inf], [jerk, 0.0, -jerk, 0.0], strict=True)):
        state[3] = now
        inside = (t >= begin) if i else np.ones(np.shape(t), dtype=bool)
        value = np.where(inside, _moved(state, np.maximum(t - begin, 0.0), order), value)
        if math.isfinite(end):
            state = np.array([_moved(state, end - begin, each) for each in range(4)], dtype=float)
            begin = float(end)
    return value


def _moved(state: Vector, t: Vector | float, order: int) -> Vector:
    """Return a derivative of the motion with constant jerk after a time t."""
    total = np.zeros(np.shape(t))
    for i in range(3, order - 1, -1):
        total = total * t / (i + 1 - order) + state[i]
    return total
