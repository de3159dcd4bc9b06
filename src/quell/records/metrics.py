"""Measures of a response: times in seconds, values in the unit of y, from plain finite arrays.

Integrals are trapezoidal. With ``record_every`` the integrals stay close, but the control variation
is right only for a complete record.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

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


STEP_MEASURES = ("overshoot", "settling_time", "rise_time")
"""Measures that only a step has."""
MEASURES = (
    *STEP_MEASURES,
    *("peak_error", "rms", "iae", "ise", "itae", "control_variation", "total_variation"),
)
"""All measures, in the order of ``Metrics``."""

_TOO_LARGE = "the number is too large for a float"


class Metrics(dict[str, float]):
    """Measures of a response, by name.

    ``missing`` has the reason for each measure that does not exist: it is not in the dictionary, or
    it is NaN. ``band`` is the half width of the settling band, as a fraction of the step.
    """

    def __init__(self, values: dict[str, float], missing: dict[str, str], band: float) -> None:
        super().__init__(values)
        self.missing, self.band = missing, band

    def without_step(self, reason: str) -> Metrics:
        """Return all but the measures of a step, which are missing for a ``reason``."""
        values = {name: value for name, value in self.items() if name not in STEP_MEASURES}
        return Metrics(values, self.missing | dict.fromkeys(STEP_MEASURES, reason), self.band)


class BatchMetrics(dict[str, Vector]):
    """Measures of the responses of a batch, arrays (runs,) by name.

    ``missing[name][i]`` is the reason why run i does not have a measure. ``band`` is the half width
    of the settling band, as a fraction of the step.
    """

    def __init__(
        self, values: dict[str, Vector], missing: dict[str, dict[int, str]], band: float
    ) -> None:
        super().__init__(values)
        self.missing, self.band = missing, band


class Window(NamedTuple):
    """The samples of a window of time."""

    t: Vector  # [s]
    r: Vector
    y: Vector
    u: Vector
    r_before: Vector  # the last two references before the window, fewer at the start of the record
    u_before: float  # the u before the window, zero at the start of the record


def measured(
    window: Window,
    target: float | None,
    band: float,
    incomplete: str | None,
    names: Collection[str] = MEASURES,
) -> Metrics:
    """Return measures of a window, by default all; ``incomplete`` says why not all of it is there.

    ``incomplete`` is None for a window that is complete.
    """
    t, r, y, u, r_before, u_before = window
    error = r - y
    goal = float(r[-1]) if target is None else checks.finite("target", target)
    band = checks.positive("band", band)
    values, missing = {}, dict[str, str]()
    step = [name for name in STEP_MEASURES if name in names]
    if step:
        k = 0 if target is not None else _only_change(r)
        if k:
            r_before = r[max(k - 2, 0) : k]
        initial = float(y[k])
        fault = incomplete or _no_step(r[k:], r_before, goal, initial, target is not None)
        missing = dict.fromkeys(step, fault) if fault else {}
        if not fault:
            values = _step_measures(step, t[k:], y[k:], goal, band, initial)
            times = [name for name in step if name != "overshoot"]
            missing = {name: _never(name, band) for name in times if math.isnan(values[name])}
    with np.errstate(over="ignore", invalid="ignore"):
        values |= {name: of(t, error) for name, of in _OF_ERROR.items() if name in names}
    if "control_variation" in names:
        values["control_variation"] = control_variation(u)
    if "total_variation" in names:
        values["total_variation"] = total_variation(u, u_before)
    unexplained = values.keys() - missing.keys()
    missing |= {name: _TOO_LARGE for name in unexplained if not math.isfinite(values[name])}
    return Metrics(values, missing, band)


_OF_ERROR: Mapping[str, Callable[[Vector, Vector], float]] = {
    "peak_error": lambda t, error: peak(error),
    "rms": lambda t, error: rms(error),
    "iae": iae,
    "ise": ise,
    "itae": itae,
}


def _step_measures(
    names: Collection[str], t: Vector, y: Vector, goal: float, band: float, initial: float
) -> dict[str, float]:
    of = {
        "overshoot": lambda: overshoot(y, goal, initial),
        "settling_time": lambda: settling_time(t, y, goal, band, initial),
        "rise_time": lambda: rise_time(t, y, goal, initial),
    }
    return {name: of[name]() for name in names}


def _never(name: str, band: float) -> str:
    """Return why a time of a step that there is does not exist."""
    if name == "rise_time":
        return "y does not reach 90 % of the step in the window"
    return f"at the end of the window y is not within ±{100.0 * band:g} % of the step"


def _only_change(r: Vector) -> int:
    """Return the index from which the reference has its last value, if it changes once; else 0."""
    changes = np.flatnonzero(np.diff(r))
    # A change at the second sample is a step at the start of the window, a sample off.
    return int(changes[0]) + 1 if changes.size == 1 and changes[0] > 0 else 0


def _no_step(r: Vector, r_before: Vector, goal: float, initial: float, asked: bool) -> str | None:
    """Return why there is no step to ``goal`` at the first sample, None if there is one.

    With a target it is a step if the user ``asked`` for it. Else the reference must step there, or
    a sample off, and stay; at 0 s there always is a step.
    """
    if goal == initial:
        return "y is at the target at the start of the window: no step"
    if asked:
        return None
    if r.size == 1:
        return "there is only one sample in the window: no step response"
    if bool((r[1:] != goal).any()):
        return "r changes within the window: give target to judge it as a move to there"
    if r_before.size and not bool((r_before != goal).any() or r[0] != goal):
        return "r does not step at the start of the window: no step"
    return None
