"""Measures of a response: times in seconds, values in the unit of y, from plain finite arrays.

Integrals are trapezoidal. With ``record_every`` the integrals stay close, but the control variation
is right only for a complete record.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from quell import checks
from quell.types import Vector

SETTLING_BAND = 0.02
"""Default half width of the settling band, as a fraction of the step: the 2 % of textbooks (Ogata,
*Modern Control Engineering*, section 5-3)."""


def overshoot(y: Vector, target: float, initial: float = 0.0) -> float:
    """Return how far y goes beyond ``target``, as a fraction of the step; 0.0 if it never does."""
    move = checks.nonzero("target - initial", target - initial, "there is no move to overshoot")
    return max(float(np.max((_record(y) - target) / move)), 0.0)


def settling_time(
    t: Vector, y: Vector, target: float, band: float = SETTLING_BAND, initial: float = 0.0
) -> float:
    """Return the time after ``t[0]`` from which on y stays near ``target`` [s].

    Near means not further than ``band`` times the step. 0.0 if y never leaves this band, NaN if it
    is outside at the end.
    """
    t, y = _pair(t, y)
    move = checks.nonzero("target - initial", target - initial, "there is no move to settle")
    width = checks.positive("band", band) * abs(move)
    outside = np.flatnonzero(np.abs(y - target) > width)
    if outside.size == 0:
        return 0.0
    if outside[-1] + 1 == y.size:
        return float("nan")
    return float(t[outside[-1] + 1] - t[0])


def rise_time(t: Vector, y: Vector, target: float, initial: float = 0.0) -> float:
    """Return the time from 10 % to 90 % of the step, interpolated [s].

    0.0 if the first y is beyond 90 % already, NaN if y stays below.
    """
    t, y = _pair(t, y)
    move = checks.nonzero("target - initial", target - initial, "there is no move to rise")
    done = (y - initial) / move
    return _first_crossing(t, done, 0.9) - _first_crossing(t, done, 0.1)


def peak(error: Vector) -> float:
    """Return ``max |e|``."""
    return float(np.max(np.abs(_record(error))))


def rms(error: Vector) -> float:
    """Return the root mean square of e."""
    return float(np.sqrt(np.mean(np.square(_record(error)))))


def iae(t: Vector, error: Vector) -> float:
    """Return ``∫ |e| dt``."""
    t, error = _pair(t, error)
    return float(np.trapezoid(np.abs(error), t))


def ise(t: Vector, error: Vector) -> float:
    """Return ``∫ e² dt``."""
    t, error = _pair(t, error)
    return float(np.trapezoid(np.square(error), t))


def itae(t: Vector, error: Vector) -> float:
    """Return ``∫ (t − t[0]) |e| dt``."""
    t, error = _pair(t, error)
    return float(np.trapezoid((t - t[0]) * np.abs(error), t))


def control_variation(u: Vector) -> float:
    """Return ``Σ |u_k − u_{k−1}|`` from the second sample on [u-unit].

    The jump from the u before the record to its first sample is left out; ``total_variation`` has
    it. At a step of the reference this jump is often the largest.
    """
    return float(np.sum(np.abs(np.diff(_record(u)))))


def total_variation(u: Vector, before: float = 0.0) -> float:
    """Return ``TV = Σ |u_k − u_{k−1}|`` with the first jump, from ``before`` to ``u_0`` [u-unit].

    It is the sum of all moves of the input up and down (Skogestad, *Simple analytic rules for model
    reduction and PID controller tuning*, J. Process Control 13, 2003, section 4.1).
    """
    first = abs(float(_record(u)[0]) - checks.finite("before", before))
    return first + control_variation(u)


def _first_crossing(t: Vector, done: Vector, level: float) -> float:
    above = np.flatnonzero(done >= level)
    if above.size == 0:
        return float("nan")
    k = int(above[0])
    if k == 0:
        return float(t[0])
    share = (level - done[k - 1]) / (done[k] - done[k - 1])
    return float(t[k - 1] + share * (t[k] - t[k - 1]))


def _record(values: ArrayLike) -> Vector:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or array.size == 0:
        rule = "must be a vector of at least one sample; widen the window of time"
        raise ValueError(f"record has shape {array.shape}: {rule}")
    if not np.all(np.isfinite(array)):
        sample = int(np.argmin(np.isfinite(array)))
        fault = f"a value that is not finite at sample {sample}"
        raise ValueError(f"record has {fault}: take only what is before it")
    return array


def _pair(t: ArrayLike, values: ArrayLike) -> tuple[Vector, Vector]:
    t, values = _record(t), _record(values)
    if t.size != values.size:
        raise ValueError(f"t has {t.size} samples, the record {values.size}: must be the same")
    return t, values
