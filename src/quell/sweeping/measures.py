"""Measures of each run that a sweep stores: ``Measure``, functions of a run, and their names."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from quell import checks
from quell.records.metrics import MEASURES, SETTLING_BAND
from quell.records.trajectory import Trajectory
from quell.types import Vector

UNITS = {
    "overshoot": ("overshoot, as a fraction of the step", "1"),
    "settling_time": ("time after which y stays near the target", "s"),
    "rise_time": ("time from 10 % to 90 % of the step", "s"),
    "peak_error": ("largest |r - y|", "y-unit"),
    "rms": ("root mean square of r - y", "y-unit"),
    "iae": ("integral of |r - y|", "y-unit s"),
    "ise": ("integral of (r - y)^2", "y-unit^2 s"),
    "itae": ("integral of t |r - y|", "y-unit s^2"),
    "control_variation": ("sum of the moves of u, without the first", "u-unit"),
    "total_variation": ("sum of the moves of u", "u-unit"),
    "control_energy": ("integral of u^2", "u-unit^2 s"),
}
"""Description and unit of each measure, in files."""


@dataclass(frozen=True)
class Measure:
    """A measure of ``Trajectory.metrics`` in a window of time.

    Parameters
    ----------
    name
        ``peak_error``, ``rms``, ``iae``, ``ise``, ``itae``, ``control_variation``,
        ``total_variation``, ``control_energy``, ``overshoot``, ``settling_time`` or ``rise_time``.
    start, stop, target, band
        as those of ``Trajectory.metrics``.
    axis
        name of the axis, of a run of several axes.

    Raises
    ------
    ValueError
        for an unknown measure, or a window that ends before it begins.
    """

    name: str
    start: float = 0.0
    stop: float | None = None
    target: float | None = None
    band: float = SETTLING_BAND
    axis: str = ""

    def __post_init__(self) -> None:
        if self.name not in MEASURES:
            hint = checks.nearest(str(self.name), MEASURES)
            raise ValueError(f"metrics: {self.name!r} is unknown, {hint}")
        checks.finite("start", self.start)
        if self.stop is not None:
            checks.interval("start", self.start, "stop", self.stop)
        checks.optional(checks.finite, "target", self.target)
        checks.positive("band", self.band)
        if not isinstance(self.axis, str):
            raise ValueError(f"axis = {self.axis!r:.60}: must be the name of an axis, or ''")

    @property
    def window(self) -> tuple[Any, ...]:
        """Start, stop, target and band."""
        return self.start, self.stop, self.target, self.band


Measures: TypeAlias = Mapping[str, Measure | Callable[[Any], float]]


def as_measures(metrics: Any) -> Measures:
    """Return the measures of a sweep by the name of their variable.

    ``metrics`` has names of measures, or a measure or a function of a run for each name. Of several
    axes the name of the axis stands before it, as ``"elbow.rms"``.
    """
    if isinstance(metrics, str) or not isinstance(metrics, Mapping | Sequence):
        raise ValueError(f"metrics = {metrics!r:.60}: must be names, or measures by name")
    if not isinstance(metrics, Mapping):
        for i, name in enumerate(metrics):
            if not isinstance(name, str):
                rule = "a list has names; give each measure or function a name, {'name': …}"
                raise ValueError(f"metrics[{i}] = {name!r:.60}: {rule}")
        metrics = {name: name for name in metrics}
    found: dict[str, Any] = {}
    for name, each in metrics.items():
        if not isinstance(name, str) or not name:
            raise ValueError(f"metrics: {name!r:.60}: the name of a measure must be a text")
        found[name] = _named(each) if isinstance(each, str) else each
        if not isinstance(found[name], Measure) and not callable(found[name]):
            rule = "must be a quell.sweeping.Measure, or a function of a Trajectory"
            raise ValueError(f"metrics[{name!r}] = {each!r:.60}: {rule}")
    if not found:
        raise ValueError("metrics is empty: must name at least one measure")
    return found


def _named(text: str) -> Measure:
    """Return the measure of a name, before which the name of an axis may stand."""
    axis, point, name = text.rpartition(".")
    if point and not axis:
        raise ValueError(
            f"metrics: {text!r}: has no axis before the point; give {name}, or AXIS.{name}"
        )
    return Measure(name, axis=axis)


def describe_measures(measures: Measures) -> dict[str, Any]:
    """Return the attributes of the variable of each measure."""
    found: dict[str, Any] = {}
    for name, each in measures.items():
        if isinstance(each, Measure):
            about, unit = UNITS[each.name]
            window: dict[str, Any] = {"start": each.start, "stop": each.stop}
            window |= {"target": each.target, "axis": each.axis or None}
            given = {key: value for key, value in window.items() if value is not None}
            found[name] = {"long_name": about, "units": unit, **given, "band": each.band}
        else:
            found[name] = {"long_name": getattr(each, "__qualname__", type(each).__name__)}
    return found


def measure_runs(
    runs: Sequence[Trajectory], measures: Measures
) -> tuple[dict[str, Vector], list[str]]:
    """Return each measure (runs,), NaN where there is none, and the error of each run, if any."""
    values = {name: np.full(len(runs), np.nan) for name in measures}
    errors = [""] * len(runs)
    for i in range(len(runs)):
        try:
            for name, value in measure_run(runs[i], measures).items():
                values[name][i] = value
        except Exception as error:  # a function of the user's may raise anything
            errors[i] = f"{type(error).__name__}: {error}"
    return values, errors


def measure_run(run: Trajectory, measures: Measures) -> dict[str, float]:
    """Return each measure of a run, NaN where there is none."""
    windows: dict[tuple[Any, ...], dict[str, str]] = {}
    for name, each in measures.items():
        if isinstance(each, Measure):
            windows.setdefault((each.axis, *each.window), {})[name] = each.name
    values: dict[str, float] = {}
    for (axis, start, stop, target, band), wanted in windows.items():
        check_axis(axis, next(iter(wanted.values())), run.axis_names if run.several else None)
        one = run.axis(axis) if run.several else run
        if one.diverged and one.window(start, np.inf).start >= len(one):  # ended before it
            values |= dict.fromkeys(wanted, np.nan)
            continue
        found = one.metrics_of(tuple(wanted.values()), start, stop, target, band)
        values |= {name: found.get(measure, np.nan) for name, measure in wanted.items()}
    own = {name: each for name, each in measures.items() if not isinstance(each, Measure)}
    return values | {name: float(function(run)) for name, function in own.items()}


def check_axis(axis: str, name: str, axes: Sequence[str] | None) -> None:
    """Raise a ``ValueError`` unless a run has this axis; ``axes`` is None for a run of one."""
    if axes is None:
        if axis:
            raise ValueError(f"metrics: {axis}.{name}: the run has one axis; give {name}")
    elif not axis:
        example = f"{axes[0]}.{name}" if axes else name
        raise ValueError(f"metrics: {name}: the run has several axes; name one, {example}")
    elif axes and axis not in axes:
        hint = checks.nearest(axis, axes)
        raise ValueError(f"metrics: {axis}.{name}: the run has no axis {axis!r}, {hint}")
