"""A move with limits of speed, acceleration and jerk."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from quell import checks
from quell.signals.base import EDGE_TOLERANCE, Constant, Signal, check_finite_fields
from quell.signals.profile import PARTS, moved, plan
from quell.types import Vector


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

    @cached_property
    def _parts(self) -> tuple[Vector, Vector]:
        """Durations [s] and jerks of its parts."""
        times, jerks = np.zeros(PARTS), np.zeros(PARTS)
        limits = self.v_max, self.a_max, self.j_max
        plan(times, jerks, 0.0, 0.0, float(self.distance), 0.0, *limits)
        return times, jerks

    @property
    def duration(self) -> float:
        """Duration of the move [s]."""
        return float(np.sum(self._parts[0]))

    def evaluate(self, t: Vector) -> Vector:
        """Return the position along the move, or its derivative."""
        since = t - self.start
        if self.order > 0:  # an edge on a sample belongs to it
            since = since + EDGE_TOLERANCE
        # The second half is the mirror image of the first one, in which rounding errors are small.
        second = since > 0.5 * self.duration
        near = np.clip(np.where(second, self.duration - since, since), 0.0, None)
        value = self._first_half(near)
        if self.order == 0:
            return np.where(second, self.distance - value, value)
        value = np.where(second, (-1.0) ** (self.order + 1) * value, value)
        return np.where((since >= 0.0) & (since < self.duration), value, 0.0)

    def _first_half(self, t: Vector) -> Vector:
        """Return the position, or its derivative, up to the middle of the move."""
        value, begin, p, v, a = np.zeros(np.shape(t)), 0.0, 0.0, 0.0, 0.0
        times, jerks = self._parts
        for duration, jerk in zip(times[:5], jerks[:5], strict=True):
            inside = t >= begin
            since: Any = np.where(inside, t - begin, 0.0)
            way, *derivatives = moved(v, a, jerk, since)
            now = (p + way, *derivatives, jerk)[self.order]
            value = np.where(inside, now, value)
            way, v, a = moved(v, a, jerk, duration)
            begin, p = begin + duration, p + way
        return value

    def derivative(self) -> Signal:
        """Return the next derivative, without the impulses of the jerk's jumps."""
        return Constant(0.0) if self.order == 3 else replace(self, order=self.order + 1)
