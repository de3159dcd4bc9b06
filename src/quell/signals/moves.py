"""The quickest move to rest at a point, within limits of speed, acceleration and jerk.

It begins with any speed and acceleration and has seven parts of constant jerk: the acceleration is
changed to a peak, held and changed to zero; the speed is held; and the same to rest. Parts for
which there is no time have the duration zero. By Pontryagin's principle the jerk of the quickest
move is at a limit or zero, and has this order.

**Direction.** Let d_s be the distance in which the axis stops soonest. It moves up, towards larger
positions, if the distance d is at least d_s, and else down, which is the mirror image.

**Peak.** Going up, the largest jerk acts, and at the limit of acceleration none, for a time s; then
the axis stops soonest. The distance D(s) that this takes does not decrease with s: with the
distance f(v, a) in which it stops from speed v and acceleration a, D' is 2J ∂f/∂a while the jerk
acts and J ∂f/∂a after that. So D(s) = d has one solution, between the shortest s from which the
stop begins downwards and the s with which the largest speed is just reached; if D is smaller there,
this speed is held. Newton's method finds it, in 5 to 10 steps as a rule, and bisection where it
does not converge. Only +, −, ·, / and square roots are used, which are rounded in the same way
everywhere: C code gives the same bits.

Limits may have become lower while the axis moves. A larger speed is reduced first; a larger
acceleration is not raised, and is within its limit from the next change of it on.

Durations are those of Ruckig (Berscheid & Kröger, *Robotics: Science and Systems* 2021), which is
for several axes and final speeds, and has no C code.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from quell import checks
from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single, sqrt
from quell.signals.shapes import EDGE_TOLERANCE, Constant, Signal, check_finite_fields
from quell.types import Vector

PARTS = 7
"""Number of parts of a profile."""

# Newton's method, and bisection where it does not halve its step, end after twice the number of
# bits at the latest.
_MOST_STEPS = 110
_EPSILON, _EPSILON_SINGLE = 2.2e-16, 1.2e-7  # spacing of the numbers at 1


@kernel
def moved(v: float, a: float, jerk: float, t: float) -> tuple[float, float, float]:
    """Return the way, the speed and the acceleration after a time t with constant jerk."""
    way = t * (v + t * (0.5 * a + t * jerk / 6.0))
    return way, v + t * (a + 0.5 * t * jerk), a + t * jerk


@kernel
def change_of_speed(
    v: float, a: float, wanted: float, a_max: float, j_max: float
) -> tuple[float, float, float, float]:
    """Return the quickest change from v and a to another constant speed.

    It has the jerk ``jerk`` for the first time, then none, then ``−jerk``; these four are returned.
    """
    free = v + 0.5 * a * abs(a) / j_max  # the speed if a is changed to zero at once
    sign = 1.0 if free <= wanted else -1.0
    change, a = sign * (wanted - v), sign * a
    peak, held = sqrt(max(j_max * change + 0.5 * a * a, 0.0)), 0.0
    if peak > max(a_max, a):
        peak = max(a_max, a)
        held = max((change - (peak * peak - 0.5 * a * a) / j_max) / peak, 0.0)
    return sign * j_max, max((peak - a) / j_max, 0.0), held, peak / j_max


@kernel
def way_of(v: float, a: float, jerk: float, first: float, held: float, last: float) -> float:
    """Return the way during a change of speed."""
    way, v, a = moved(v, a, jerk, first)
    more, v, a = moved(v, a, 0.0, held)
    way += more
    more, v, a = moved(v, a, -jerk, last)
    return way + more


@kernel
def stopping_way(v: float, a: float, a_max: float, j_max: float) -> float:
    """Return the way on which the axis stops soonest, with its sign."""
    jerk, first, held, last = change_of_speed(v, a, 0.0, a_max, j_max)
    return way_of(v, a, jerk, first, held, last)


@kernel
def _write(
    times: Vector, jerks: Vector, at: int, jerk: float, first: float, held: float, last: float
) -> None:
    """Write the three parts of a change of speed from the part ``at`` on."""
    times[at], jerks[at] = first, jerk
    times[at + 1], jerks[at + 1] = held, 0.0
    times[at + 2], jerks[at + 2] = last, -jerk


@kernel
def plan(
    times: Vector,
    jerks: Vector,
    v: float,
    a: float,
    distance: float,
    rounding: float,
    v_max: float,
    a_max: float,
    j_max: float,
) -> None:
    """Write durations and jerks of the parts of the quickest move (7,) to rest.

    Parameters
    ----------
    times, jerks
        are written: the durations [s] and the jerks [y-unit/s³].
    v, a
        speed and acceleration at the beginning.
    distance
        from there to the point of rest.
    rounding
        its error: a stop that ends so near is the move.
    v_max, a_max, j_max
        limits, positive.
    """
    for i in range(PARTS):
        times[i], jerks[i] = 0.0, 0.0
    jerk, first, held, last = change_of_speed(v, a, 0.0, a_max, j_max)
    stop = way_of(v, a, jerk, first, held, last)
    if abs(distance - stop) <= rounding:
        _write(times, jerks, 4, jerk, first, held, last)
        return
    sign = 1.0 if distance > stop else -1.0
    v, a, distance = sign * v, sign * a, sign * distance
    jerk, first, held, last = change_of_speed(v, a, v_max, a_max, j_max)
    rest = distance - way_of(v, a, jerk, first, held, last) - stopping_way(v_max, 0.0, a_max, j_max)
    if rest < 0.0 and jerk > 0.0:
        _plan_peak(times, jerks, sign, v, a, distance, first, held, a_max, j_max)
        return
    speed = v_max if rest >= 0.0 else _lower_speed(v, a, distance, v_max, a_max, j_max)
    jerk, first, held, last = change_of_speed(v, a, speed, a_max, j_max)
    _write(times, jerks, 0, sign * jerk, first, held, last)
    times[3] = max(rest, 0.0) / v_max
    jerk, first, held, last = change_of_speed(speed, 0.0, 0.0, a_max, j_max)
    _write(times, jerks, 4, sign * jerk, first, held, last)


@kernel
def _plan_peak(
    times: Vector,
    jerks: Vector,
    sign: float,
    v: float,
    a: float,
    distance: float,
    most_first: float,
    most_held: float,
    a_max: float,
    j_max: float,
) -> None:
    """Write the parts of a move that does not reach the largest speed; up is ``sign``."""
    epsilon = _EPSILON_SINGLE if is_single(v) else _EPSILON
    # The acceleration is raised for `reach`, and held for the rest of s.
    reach = max(a_max - a, 0.0) / j_max
    low, high = 0.0, most_first + most_held
    if v + 0.5 * a * abs(a) / j_max < 0.0:  # a stop begins upwards, too, until
        jerk, first, held, last = change_of_speed(v, a, 0.0, a_max, j_max)
        low = first + held
    s, step = 0.5 * (low + high), high - low
    for _ in range(_MOST_STEPS):
        raised = min(s, reach)
        way, v_1, a_1 = moved(v, a, j_max, raised)
        more, v_1, a_1 = moved(v_1, a_1, 0.0, s - raised)
        jerk, first, held, last = change_of_speed(v_1, a_1, 0.0, a_max, j_max)
        rest = way_of(v_1, a_1, jerk, first, held, last)
        excess = way + more + rest - distance
        # Rounding of the ways, whose terms are of both signs, is some units of their last digits.
        if abs(excess) <= 8.0 * epsilon * (abs(way) + abs(more) + abs(rest)):
            break
        # J ∂f/∂a of the stop
        slope = j_max * first * (0.5 * a_1 / j_max + last + held)
        if s < reach:
            slope *= 2.0
        if excess > 0.0:
            high = s
        else:
            low = s
        before = step
        step = excess / slope if slope > 0.0 else high - low
        if abs(step) <= 2.0 * epsilon * s or high - low <= 2.0 * epsilon * high:
            break
        if not low < s - step < high or abs(step) > 0.5 * abs(before):
            step = s - 0.5 * (low + high)
        s -= step
    times[0], jerks[0] = min(s, reach), sign * j_max
    times[1] = s - times[0]
    _write(times, jerks, 4, sign * jerk, first, held, last)


@kernel
def _lower_speed(
    v: float, a: float, distance: float, v_max: float, a_max: float, j_max: float
) -> float:
    """Return the speed to which one above v_max is reduced first, where there is no room for v_max.

    At speed 0 the way is that of the soonest stop, at v_max it is longer than the distance.
    """
    low, high = 0.0, v_max
    for _ in range(_MOST_STEPS // 2):
        speed = 0.5 * (low + high)
        jerk, first, held, last = change_of_speed(v, a, speed, a_max, j_max)
        way = way_of(v, a, jerk, first, held, last)
        if way + stopping_way(speed, 0.0, a_max, j_max) > distance:
            high = speed
        else:
            low = speed
    return low


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
