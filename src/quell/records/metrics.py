"""Measures of a response: times in seconds, values in the unit of y, from plain finite arrays.

Integrals are trapezoidal. With ``record_every`` the integrals stay close, but the control variation
is right only for a complete record.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quell import checks
from quell.types import Matrix, Vector

SETTLING_BAND = 0.02
"""Default half width of the settling band, as a fraction of the step: the 2 % of textbooks (Ogata,
*Modern Control Engineering*, section 5-3)."""


REST_BAND = 0.05
"""RMS distance from the target, as a fraction of the step, up to which y rests there at the end of
a record: the wider one of the two settling bands of textbooks, and above the noise of most records.
A wider settling band replaces it."""

# The end of a record: its last samples, as a share of all. Whether y rests is judged over it, and a
# stay in the settling band that is shorter than half of it may be a passage. Chosen by hand.
_END = 0.1


def overshoot(y: Vector, target: float, initial: float = 0.0, band: float = SETTLING_BAND) -> float:
    """Return how far y goes beyond ``target``, as a fraction of the step; 0.0 if it never does.

    NaN if y does not rest at the target at the end: in the last tenth of the record its RMS
    distance from there is more than ``REST_BAND`` of the step, or ``band`` where that is wider.
    Then y still rises, oscillates or runs away, and how far it goes is not known.
    """
    y = _record(y)
    move = checks.nonzero("target - initial", target - initial, "there is no move to overshoot")
    beyond = (y - target) / move
    if not rms(beyond[-_ending(y) :]) <= max(checks.positive("band", band), REST_BAND):
        return math.nan
    return max(float(np.max(beyond)), 0.0)


def settling_time(
    t: Vector, y: Vector, target: float, band: float = SETTLING_BAND, initial: float = 0.0
) -> float:
    """Return the time after ``t[0]`` from which on y stays near ``target`` [s].

    Near means not further than ``band`` times the step. 0.0 if y never leaves this band, NaN if it
    is outside at the end, or if it came inside just before, for less than a twentieth of the record
    and for less time than at an earlier passage: so does an oscillation that goes on.
    """
    t, y = _pair(t, y)
    move = checks.nonzero("target - initial", target - initial, "there is no move to settle")
    width = checks.positive("band", band) * abs(move)
    outside = np.flatnonzero(np.abs(y - target) > width)
    if outside.size == 0:
        return 0.0
    stay = y.size - 1 - int(outside[-1])
    passages = np.diff(outside, prepend=-1) - 1
    if stay == 0 or (2 * stay < _ending(y) and stay <= int(np.max(passages))):
        return math.nan
    return float(t[outside[-1] + 1] - t[0])


def rise_time(t: Vector, y: Vector, target: float, initial: float = 0.0) -> float:
    """Return the time from 10 % to 90 % of the step, interpolated [s].

    0.0 if the first y is beyond 90 % already, NaN if y stays below, or if it runs away: at the end
    it is further from the target than at the start.
    """
    t, y = _pair(t, y)
    move = checks.nonzero("target - initial", target - initial, "there is no move to rise")
    done = (y - initial) / move
    if rms(done[-_ending(y) :] - 1.0) > 1.0:
        return math.nan
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


def control_energy(t: Vector, u: Vector) -> float:
    """Return ``∫ u² dt`` of a u that is held from each sample to the next [u-unit² s].

    It is what LQ designs weigh, and the heat in a winding whose current is u; not the energy of a
    drive in general, which depends on the speed, too (``quell.experiments.compare``).
    """
    t, u = _pair(t, u)
    return float(np.sum(np.square(u[:-1]) * np.diff(t)))


def _ending(y: Vector) -> int:
    """Return the number of samples at the end of a record over which rest is judged."""
    return max(round(_END * y.size), 1)


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


# ---- Whether y runs away ----

# The record in windows of one length, of whose peaks of |r − y| the last four are compared; the
# share of the samples of these four at which u is at an end of its range, for a u that is at its
# limit; and the multiples of the task beyond which |r − y| is far, and lost with such a u. All
# chosen by hand.
_WINDOWS, _STUCK, _FAR, _LOST = 8, 0.8, 10.0, 2.0
# The last peak is above the largest of the first half, in which noise and loads were there, too, by
# these factors: where it grows to far beyond the task; where it does so with u at a limit; and
# where there is no task. An exponential function that grows to 10 has 3.2 times its value in the
# middle. In a loop without task each peak has this factor to the one before, more than that of an
# error that grows with the time or its square. All chosen by hand.
_GROWN, _PUSHED, _ALONE, _EACH = 3.0, 1.5, 5.0, 1.5
# The factor of an exponential function does not fall; that of a line, whose begin is known to a
# window, does so to 8/9 at most. By closed form.
_STEADY = 0.9


def runs_away(r: Matrix, y: Matrix, u: Matrix) -> NDArray[np.bool_]:
    """Return for each run whether y leaves r instead of following it (runs,).

    The task of a run is the largest distance of r from the first y: the range of r with the initial
    error. The error is the distance of y from r. It grows if its peaks do in the last four eighths
    of the run, to the largest of all. y runs away if

    - the error grows to more than ten times the task and three times that of the first half;
    - or in the last eighth it is above ten times the task, and that of the whole time before;
    - or u is at an end of its range for most of the time (80 % of the second half), and the error
      grows beyond the task and 1.5 times that of the first half, or stays beyond twice the task
      (ten times, if u does not move at all);
    - or there is no task (only disturbances act), and the error grows by a factor of 1.5 from each
      of these eighths to the next, or more, and not by less and less, as an exponential function
      does, to five times that of the first half.

    Parameters
    ----------
    r, y
        reference and output (runs, samples), complete.
    u
        control signals (runs, samples, inputs); none of them if they are not known.
    """
    runs, samples = y.shape
    size = samples // _WINDOWS
    if size < 2:
        return np.zeros(runs, dtype=bool)
    used = slice(samples - _WINDOWS * size, None)
    error = (y - r)[:, used].reshape(runs, _WINDOWS, size)
    peaks = np.max(np.abs(error), axis=2)
    task = np.max(np.abs(r - y[:, :1]), axis=1)
    last, early = peaks[:, -1], np.max(peaks[:, :4], axis=1)
    before = np.max(peaks[:, :-1], axis=1)
    grows = np.all(np.diff(peaks[:, 4:], axis=1) > 0.0, axis=1) & (last > early)
    far, none = last > _FAR * task, task == 0.0
    away: NDArray[np.bool_] = far & (
        (~none & grows & (last > _GROWN * early))
        | (~none & (last > _FAR * before))
        | (grows & (last > _ALONE * early) & _is_exponential(peaks[:, 4:]))
    )
    least = np.min(np.abs(error[:, 4:]), axis=(1, 2))  # in the second half
    pushed = (grows & (last > task) & (last > _PUSHED * early)) | (~none & (least > _LOST * task))
    for i in np.flatnonzero(pushed & ~away).tolist():
        # A u that never moves may be that of a loop at rest, in noise.
        rests = bool(np.all(np.ptp(u[i], axis=0) == 0.0)) and not least[i] > _FAR * task[i]
        away[i] = _at_an_end(u[i], 4 * size) and not (rests and not grows[i])
    return away


def _is_exponential(peaks: Matrix) -> NDArray[np.bool_]:
    """Return whether peaks grow from each to the next, by a factor that does not fall (runs,).

    The response to a load that came late grows, too, but by less and less.
    """
    enough = np.all(peaks[:, 1:] >= _EACH * peaks[:, :-1], axis=1)
    steady: NDArray[np.bool_] = peaks[:, -1] * peaks[:, -3] >= _STEADY * peaks[:, -2] ** 2
    return enough & steady


def _at_an_end(u: Matrix, last: int) -> bool:
    """Return whether one of u (samples, inputs) is at an end of its range most of the time."""
    if u.shape[1] == 0:
        return False
    ending, low, high = u[-last:], np.min(u, axis=0), np.max(u, axis=0)
    near = 1e-3 * (high - low)  # of a measured u, too
    share = np.mean((ending <= low + near) | (ending >= high - near), axis=0)
    return bool(np.max(share) >= _STUCK)


# ---- All measures of a window ----

STEP_MEASURES = ("overshoot", "settling_time", "rise_time")
"""Measures that only a step has."""
MEASURES = (
    *STEP_MEASURES,
    *("peak_error", "rms", "iae", "ise", "itae"),
    *("control_variation", "total_variation", "control_energy"),
)
"""All measures, in the order of ``Metrics``."""
OF_U = MEASURES[-3:]
"""Those of u alone."""

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
            done = (y[k:] - initial) / (goal - initial)
            missing = {name: _never(name, band, done) for name in step if math.isnan(values[name])}
    with np.errstate(over="ignore", invalid="ignore"):
        values |= {name: of(t, error) for name, of in _OF_ERROR.items() if name in names}
    if "control_variation" in names:
        values["control_variation"] = control_variation(u)
    if "total_variation" in names:
        values["total_variation"] = total_variation(u, u_before)
    if "control_energy" in names:
        with np.errstate(over="ignore"):
            values["control_energy"] = control_energy(t, u)
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
        "overshoot": lambda: overshoot(y, goal, initial, band),
        "settling_time": lambda: settling_time(t, y, goal, band, initial),
        "rise_time": lambda: rise_time(t, y, goal, initial),
    }
    return {name: of[name]() for name in names}


def _never(name: str, band: float, done: Vector) -> str:
    """Return why a measure of a step that there is does not exist; ``done`` is its share."""
    if name == "rise_time":
        if np.max(done) < 0.9:
            return "y does not reach 90 % of the step in the window"
        return "at the end of the window y is further from the target than at its start"
    if name == "overshoot":
        rest = 100.0 * max(band, REST_BAND)
        return f"at the end of the window y does not rest at the target (RMS to {rest:g} %)"
    if abs(done[-1] - 1.0) > band:
        return f"at the end of the window y is not within ±{100.0 * band:g} % of the step"
    return f"y passes ±{100.0 * band:g} % of the step at the end of the window, as it did before"


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


# ---- What is worse than before ----

WORSE = 0.1
"""A measure is worse from this relative change on: less is hardly seen, and two designs differ by
it anyway. Chosen by hand."""

LOWER_IS_BETTER: Mapping[str, str] = {
    "overshoot": "overshoot",
    "settling_time": "settling time [s]",
    "rise_time": "rise time [s]",
    "peak_error": "peak of r − y",
    "rms": "RMS error",
    "iae": "IAE",
    "ise": "ISE",
    "itae": "ITAE",
    "effort": "mean |du/dt|",
    "control_variation": "activity of u, Σ|Δu|",
    "total_variation": "activity of u with its first jump",
    "noise_to_control": "noise in u",
    "m_s": "M_s",
    "m_t": "M_t",
}
"""Measures of a run or a loop that should be low, with their names for a verdict."""
HIGHER_IS_BETTER: Mapping[str, str] = {
    "gain_margin": "gain margin",
    "gain_reduction": "margin to a lower gain",
    "phase_margin": "phase margin [°]",
    "delay_margin": "delay margin [s]",
}
"""Those that should be high."""
# A change of an overshoot counts from this share of the step on. Chosen by hand.
_SEEN = 0.01


class Worse(NamedTuple):
    """A measure that is worse than before."""

    name: str
    before: float
    now: float  #: NaN if it does not exist any more

    @property
    def text(self) -> str:
        """The measure with both values."""
        label = {**LOWER_IS_BETTER, **HIGHER_IS_BETTER}[self.name]
        before, now = (
            "∞" if each == math.inf else f"{each:.3g}" for each in (self.before, self.now)
        )
        return f"{label} {before} → {'none any more' if math.isnan(self.now) else now}"


def worsened(
    before: Mapping[str, float | None], now: Mapping[str, float | None]
) -> tuple[Worse, ...]:
    """Return all measures that are worse than before by more than ``WORSE``, in a fixed order.

    Parameters
    ----------
    before, now
        measures by name; those that are in neither ``LOWER_IS_BETTER`` nor ``HIGHER_IS_BETTER``,
        and those that did not exist before, are left out. None and NaN do not exist.
    """
    found = []
    for name in (*LOWER_IS_BETTER, *HIGHER_IS_BETTER):
        old, new = (math.nan if (v := of.get(name)) is None else float(v) for of in (before, now))
        if math.isnan(old):
            continue
        if name in LOWER_IS_BETTER:
            worse = new > old + max(WORSE * abs(old), _SEEN if name == "overshoot" else 0.0)
        else:
            worse = new < old - WORSE * abs(old) if math.isfinite(old) else new < old
        if worse or math.isnan(new):
            found.append(Worse(name, old, new))
    if any(each.name == "control_variation" for each in found):  # which the other one contains
        found = [each for each in found if each.name != "total_variation"]
    return tuple(found)
