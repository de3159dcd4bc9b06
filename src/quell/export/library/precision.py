"""Single precision compared with double, in a scenario."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.prefilters import without_prefilters
from quell.controllers.several import inputs_of
from quell.export.controller_source import in_double_precision
from quell.learners.gaussian_process import SINGLE_NOVELTY, GaussianProcess
from quell.records.metrics import WORSE
from quell.simulation.scenario import Scenario
from quell.simulation.simulate import simulate
from quell.types import Status

# Single precision is accepted where u is the same to ``LIMIT``, or where what a user sees is: the
# RMS error of y, and the activity of u, Σ|Δu|. With a coarse encoder one count that flips early
# makes another u in each sample from there on, of the same loop.
#
# Largest RMS difference of u that is accepted, relative to the RMS of u. Rounding acts on
# u as noise does. One per cent of it is what a 6-bit converter adds, and does not show in y
# (a torsional axis: at 8 % the tracking error moves by 0.0035 %). The delta form stays below 0.2 %
# unless the rounding of y itself, times omega_o^(n+1), is too much for u.
LIMIT = 0.01
# Largest increase of the RMS error of y: an RMS of 200 independent samples is known to
# 1/√(2 · 200), 5 %, so a record hardly shows less. And of the activity of u: the share from which
# on a measure counts as worse where two loops are compared.
MOST_ERROR, MOST_ACTIVITY = 0.05, WORSE
# Share of samples at limits beyond which nothing is compared: there u is the limit itself, whatever
# the precision is, and the others may be few or far from where the plant works. Chosen by hand.
_MOST_LIMITED = 0.5
_AT_LIMITS = int(Status.SATURATED | Status.RATE_LIMITED)
# A signal of several axes rests if its RMS is below a unit of the last digit of the largest one.
_REST = float(np.finfo(np.float32).eps)
# Share by which a u at its limit may differ from it by rounding to single precision.
_ROUNDED = 4.0 * _REST


class Difference(NamedTuple):
    """RMS differences of a signal of several axes, relative to its RMS in double precision.

    Attributes
    ----------
    name
        as in a record: ``u[0]``, ``v[elbow]``, ``y[elbow]``; of state feedback ``y[0]``.
    single
        of a run in single precision, of u in the samples off its limits; None if there is nothing
        to compare: the signal rests in both runs, or u lies at its limits in most samples.
    noise
        of a run in double precision without measurement noise; None if the scenario has none.
    limited
        share of the samples in which u lies at its limits in one of the runs; for v and y that of
        the actuator that is limited least.
    """

    name: str
    single: float | None
    noise: float | None
    limited: float = 0.0

    @property
    def reason(self) -> str:
        """Why it is not compared, and what to do; empty if it is."""
        if self.single is not None:
            return ""
        if self.limited > _MOST_LIMITED:
            return (
                f"as u lies at its limits in {100 * self.limited:.3g} % of the samples of this "
                "scenario, where it is the same in both precisions; give a scenario that asks for "
                "less, at the positions and speeds of the machine"
            )
        return "which rests in this scenario; let its reference move"


class Comparison(NamedTuple):
    """RMS differences in a scenario, relative to the RMS of the signal in double precision.

    Attributes
    ----------
    u, y
        of a run in single precision, of u in the samples off its limits; of several signals the
        largest. NaN if u lies at its limits in most samples.
    u_noise, y_noise
        of a run in double precision without measurement noise, of the same signals; None if the
        scenario has none.
    diverged
        whether the run in single precision diverged, and that in double did not.
    each
        of controllers of several signals, each u, v and y; else empty.
    limited
        share of the samples in which u lies at its limits, of several signals the least.
    error, activity
        largest relative increase of the RMS of r − y of an axis, and of Σ|Δu| of an actuator.
        Below the rounding of y and u to single precision nothing counts.
    """

    u: float
    y: float
    u_noise: float | None
    y_noise: float | None
    diverged: bool
    each: tuple[Difference, ...] = ()
    limited: float = 0.0
    error: float = math.inf
    activity: float = math.inf

    @property
    def signals(self) -> tuple[Difference, ...]:
        """All signals, also u and y of a controller of one axis."""
        if self.each:
            return self.each
        rows = ("u", self.u, self.u_noise), ("y", self.y, self.y_noise)
        return tuple(
            Difference(name, None if math.isnan(single) else single, noise, self.limited)
            for name, single, noise in rows
        )

    def check(self, controller: Any) -> None:
        """Raise a ``ValueError`` if single precision differs too much for ``controller``.

        That is if u differs by more than ``LIMIT``, and besides the RMS error of y is larger by
        more than ``MOST_ERROR``, or the activity of u by more than ``MOST_ACTIVITY``. Also if it is
        not compared, because u lies at its limits.
        """
        seen = self.error <= MOST_ERROR and self.activity <= MOST_ACTIVITY
        if not self.diverged and (self.u <= LIMIT or (seen and not math.isnan(self.u))):
            return
        if not self.diverged and math.isnan(self.u):
            raise ValueError(
                f"precision = 'single': NOT compared with double, {self.signals[0].reason}; "
                "accept=True (--accept) writes it all the same"
            )
        signal = next((own.name for own in self.each if own.single == self.u), "u")
        what = (
            "the run diverges, or y runs away, in this scenario, and not in double precision"
            if self.diverged
            else f"changes {signal} by {100 * self.u:.2g} % RMS in this scenario, the RMS error of "
            f"y by {100 * self.error:+.2g} %, the activity of u by {100 * self.activity:+.2g} %; "
            f"{100 * LIMIT:g} % is the limit, or {100 * MOST_ERROR:g} % of the error together with "
            f"{100 * MOST_ACTIVITY:g} % of the activity"
        )
        raise ValueError(
            f"precision = 'single': {what}; {self._remedy(in_double_precision(controller))}, or "
            "double precision would help; accept=True (--accept) writes it all the same"
        )

    def _remedy(self, controller: Any) -> str:
        """Return what makes rounding smaller: of a learner's points, or else of y."""
        several = hasattr(controller, "inputs")
        for each in controller.axes if several else (without_prefilters(controller),):
            learner = getattr(each, "learner", None)
            if isinstance(learner, GaussianProcess) and learner.model.novelty < SINGLE_NOVELTY:
                return (
                    f"novelty={SINGLE_NOVELTY:g} of GaussianProcess (points so close that the "
                    "inverse of their covariance loses its digits are then not stored)"
                )
        if not several:
            return (
                "a lower omega_o, y as a difference of encoder counts (NAME_step_counts, with "
                "resolution=, --resolution)"
            )
        asked = [own for own in self.each if own.name.startswith("v[")]
        worst = max(asked, key=lambda own: own.single or 0.0, default=None)
        of = "" if worst is None or self.diverged else f" of {worst.name[2:-1]}"
        return f"a lower omega_o{of}, y as a difference from a position near the work"


def compared(plant: Any, controller: Any, scenario: Scenario) -> Comparison:
    """Return what single precision changes in a scenario, and what the measurement noise does.

    u is compared in the samples in which it is off its limits in both runs. Where it lies at them
    in most samples, nothing is compared.

    A signal of several axes is compared with its own RMS, or, if it rests, with the largest that
    it could be compared with: u and y of all, and the largest share of v = B0 u.
    """
    controller = in_double_precision(controller)
    double = simulate(plant, controller, scenario)
    single = simulate(plant, controller, scenario, precision="single")
    diverged, quiet = single.lost and not double.lost, None
    given: Any = scenario.noise
    noises = given if checks.is_sequence(given) else (given,)
    if not all(isinstance(each, int | float) and each == 0.0 for each in noises):
        quiet = simulate(plant, controller, replace(scenario, noise=0.0))
    each = []
    limited = _limited(double, single, controller)
    limited_quiet = limited if quiet is None else _limited(double, quiet, controller)
    shares = np.mean(limited, axis=0)
    least = float(np.min(shares))
    for name, (channel, column) in _signals_of(controller):
        share = float(shares[column]) if channel == "u" else least
        if share > _MOST_LIMITED:
            each.append(Difference(name, None, None, share))
            continue
        largest = _largest(double, controller, channel, column)
        place = channel, column, largest
        change, noise = (
            None if other is None else _difference(double, other, *place, at_limits)
            for other, at_limits in ((single, limited), (quiet, limited_quiet))
        )
        each.append(Difference(name, change, noise, share))
    worst = [
        max((own for own in each if own.name.startswith(kind)), key=lambda own: own.single or 0.0)
        for kind in "uy"
    ]
    u, y = (math.nan if least > _MOST_LIMITED else own.single or 0.0 for own in worst)
    several = tuple(each) if hasattr(controller, "inputs") else ()
    seen = _increases(double, single)
    return Comparison(u, y, worst[0].noise, worst[1].noise, diverged, several, least, *seen)


def _increases(double: Any, single: Any) -> tuple[float, float]:
    """Return the largest relative increases of the RMS of r − y and of Σ|Δu|."""
    count = min(len(double), len(single))
    of_y, of_u = [], []
    for run in (double, single):
        r, y, u = (run[name][:count].reshape(count, -1) for name in ("r", "y", "u"))
        error = r - y if r.shape == y.shape else y  # other outputs have no reference
        of_y.append(np.maximum(_rms(error), _ROUNDED * np.max(np.abs(y), axis=0)))
        moves = np.sum(np.abs(np.diff(u, axis=0)), axis=0)
        of_u.append(np.maximum(moves, count * _ROUNDED * np.max(np.abs(u), axis=0)))
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (np.nan_to_num(two / one, nan=1.0) - 1.0 for one, two in (of_y, of_u))
        error, activity = (float(np.max(each)) for each in found)
    return error, activity


def _limited(one: Any, two: Any, controller: Any) -> NDArray[np.bool_]:
    """Return where u lies at its limits in one of two runs (samples, actuators)."""
    count = min(len(one), len(two))
    found = np.zeros((count, inputs_of(controller)), dtype=np.bool_)
    for run in (one, two):
        if "status" not in run.names:  # a controller without limits
            continue
        flags = (np.ravel(run["status"])[:count].astype(np.int64) & _AT_LIMITS) != 0
        own = flags[:, None] & np.ones(found.shape[1], dtype=np.bool_)
        if hasattr(controller, "inputs"):  # the flags are those of all actuators together
            own &= _at_own_limits(np.reshape(run["u"], (len(run), -1))[:count], controller.limits)
        found |= own
    return found


def _at_own_limits(u: Any, limits: Any) -> NDArray[np.bool_]:
    """Return where each actuator has the value or the change of a limit (samples, actuators)."""
    room, du = _ROUNDED * np.max(np.abs(u), axis=0), np.diff(u, axis=0, prepend=u[:1])
    ends = (u, limits.low), (u, limits.high), (du, limits.most_change), (du, limits.least_change)
    return np.any([np.abs(each - end) <= room for each, end in ends], axis=0)


def _signals_of(controller: Any) -> list[tuple[str, tuple[str, int]]]:
    """Return names of the signals that are compared, with channel and column of a record."""
    if not hasattr(controller, "inputs"):
        return [("u", ("u", 0)), ("y", ("y", 0))]
    inputs, outputs, names = controller.inputs, controller.outputs, controller.names
    found = [(f"u[{k}]", ("u", k)) for k in range(inputs)]
    found += [(f"v[{name}]", ("v", i)) for i, name in enumerate(names)]
    return found + [(f"y[{name}]", ("y", i)) for i, name in enumerate(names or range(outputs))]


def _rms(values: Any) -> Any:
    """Return the RMS of each column."""
    return np.sqrt(np.mean(np.square(values), axis=0))


def _largest(run: Any, controller: Any, name: str, column: int) -> float:
    """Return the RMS with which a signal that rests is compared; 0 for a single one."""
    if not hasattr(controller, "inputs"):
        return 0.0
    if name == "v":
        return float(np.max(np.abs(controller.first_gain[column]) * _rms(run["u"])))
    return max(float(np.max(_rms(run[each]))) for each in (("u",) if name == "u" else ("y", "r")))


def _difference(
    reference: Any,
    other: Any,
    name: str,
    column: int,
    largest: float,
    limited: NDArray[np.bool_] | None = None,
) -> float | None:
    """Return the RMS difference of a signal, relative to the RMS of the reference.

    Of u the samples count that are not ``limited`` (samples, actuators), or all where all are. None
    for a signal that rests in both: below rounding in the one, and within ``LIMIT`` of ``largest``
    in the other.
    """
    count = min(len(reference), len(other))
    one, two = (each[name][:count].reshape(count, -1)[:, column] for each in (reference, other))
    if name == "u" and limited is not None and not np.all(limited[:, column]):
        off = ~limited[:, column]
        one, two = one[off], two[off]
    size, change = float(_rms(one)), float(_rms(two - one))
    if size <= _REST * largest:
        size = largest
        if change <= LIMIT * largest:
            return None
    return change / size if size > 0.0 else math.inf


def checked_comparison(
    controller: Any, single: bool, plant: Any, scenario: Scenario | None, accept: bool
) -> Comparison | None:
    """Return what single precision changes in a loop; None in double, and where it is not given.

    Raises
    ------
    ValueError
        for a plant or a scenario alone, or for double precision; and, without ``accept``, for a
        difference that is too large, or that is not measured.
    """
    checks.flag("accept", accept)
    if (plant is None) != (scenario is None) or not (single or plant is None):
        what = "a comparison needs both" if single else "are compared in single precision only"
        raise ValueError(f"plant, scenario: {what}; leave them out, or give both and 'single'")
    if plant is None or scenario is None:
        if single and not accept:
            raise ValueError(
                "precision = 'single': needs plant and scenario, to compare it with double "
                "precision; or accept=True (--accept)"
            )
        return None
    comparison = compared(plant, controller, scenario)
    if not accept:
        comparison.check(controller)
    return comparison
