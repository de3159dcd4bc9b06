"""Controllers side by side over seeds: of one axis or several, with intervals.

Each controller runs through the scenario once for each seed, so all meet the same noise and random
disturbances. A criterion c of an axis then is compared in pairs: with ``d_s = ln c_B − ln c_A`` for
seed s, its mean and Student's t for the mean of the d_s give the share by which A is lower, with an
interval (``monitoring.rank.decide``). The level is shared by all pairs of controllers, axes and
windows (Bonferroni), so that in 95 % of all cases no controller is called better that is not. What
differs by less than 0.1 % is alike: no model is as exact.

*All axes together* are the geometric mean of the axes' ratios, as their criteria have different
units: d_s is the mean over the axes. An axis where a criterion is zero, or rounding, has no ratio:
it is left out, and a line with NOT says so. Without anything random in the scenario there is one
run of each controller, and differences are what they are in this scenario.
"""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import check_controller
from quell.experiments.common import check_sample_times, save_figures
from quell.files import as_json
from quell.monitoring.rank import decide
from quell.parallel import in_parallel, part_of
from quell.plants.base import one_at_a_time, signals_of
from quell.quantities import UNKNOWN, Conversion, Quantity, conversion
from quell.records.gains import OneGain, gain_factor, one_gain, with_gain
from quell.records.metrics import MEASURES, OF_U, worsened
from quell.records.plotting import given_axes, grid_of_axes, new_figure
from quell.setup.axes import signals_in
from quell.setup.description import is_of_axes
from quell.setup.loading import Setup, check_window
from quell.simulation import Scenario, simulate
from quell.simulation.scenario import is_random
from quell.sweeping.measures import Measure, measure_run
from quell.sweeping.sweep import share_interval
from quell.tuning.simulated.problem import half_width_of_mean
from quell.types import Vector

CRITERIA = {"rms": "RMS error", "iae": "∫|error|", "peak_error": "largest |error|"}
"""Measures by which controllers are compared, with their names in sentences."""
ALL_AXES = "all axes"
"""Name of the verdict on all axes together."""
# Seeds by default: with ten, differences of a third of their spread are decided for two axes.
SEEDS = 10
# A smaller difference is called alike: no model is as exact. Chosen by hand.
_ALIKE = 1e-3
# A criterion is rounding up to this part of the largest |r| or |y| of its axis: loops at rest with
# r = 0.1 to 1000 have 3e-16 to 3e-14, a spindle at 1e4 rad with a 20-bit encoder 1e-10.
_ROUNDING = 1e-12
# Also up to this part of that of any axis, as the rounding of one moves the others: 1e-19 to 1e-16
# was seen. Chosen by hand, low, as the axes have different units.
_COUPLED = 1e-14

# ---- Verdicts ----


class Pair(NamedTuple):
    """How much lower the criterion of one controller is than that of another."""

    better: str  #: the one with the lower criterion, whether that is decided or not
    other: str
    lower: float  #: share by which ``better`` is lower than ``other``
    least: float  #: lower end of the interval of ``lower``; negative if it may be higher
    most: float  #: upper end
    decided: bool  #: whether ``better`` is better, by more than 0.1 %
    needed: int  #: seeds that would decide a difference like this; 0 if far too many, or decided


class Verdict(NamedTuple):
    """Which controller is best for an axis, or for all axes, in a window of time."""

    axis: str  #: its name; ``ALL_AXES``; "" if there is one axis only
    start: float  #: begin of the window [s]
    stop: float  #: its end [s]
    first: str | None  #: the lowest criterion; None if all diverged, or all axes are left out
    pairs: tuple[Pair, ...]  #: all pairs of those that never diverged, those with ``first`` first
    #: axes that all axes together are without: there a criterion is zero, or rounding
    left_out: tuple[str, ...] = ()

    @property
    def best(self) -> str | None:
        """The controller that is better than each other one; None if that is not decided."""
        decided = all(pair.decided for pair in self.pairs if pair.better == self.first)
        return self.first if decided else None

    def describe(self, criterion: str, seeds: int) -> list[str]:
        """Return lines, of which those that begin with NOT decide nothing."""
        where = f"{self.axis}, " if self.axis else ""
        where += f"{self.start:g} to {self.stop:g} s"
        what, exact = CRITERIA[criterion], seeds == 1
        without = []
        if self.left_out:
            its = ", ".join(self.left_out)
            without = [f"NOT in {where}: {its}: {what} is zero or rounding there, and has no ratio"]
        if self.first is None:
            return without or [f"NOT decided: {where}: all diverged"]
        lower: dict[str, list[str]] = {}
        undecided = []
        for pair in self.pairs:
            ends = "" if exact else f" ({100.0 * pair.least:.3g} to {100.0 * pair.most:.3g} %)"
            share = f"{100.0 * pair.lower:.3g} %{ends}"
            if pair.decided:
                lower.setdefault(pair.better, []).append(f"{share} lower than of {pair.other}")
            elif pair.better == self.first:
                remedy = "alike" if exact else f"alike, as far as {seeds} seeds show"
                remedy = f"give {pair.needed} seeds" if pair.needed else remedy
                text = f"{self.first} and {pair.other} differ by {share} in {what}"
                undecided.append(f"NOT decided: {where}: {text}: {remedy}")
        if not self.pairs:
            return [f"{where}: {self.first} is the only one that never diverged"]
        lines = []
        for better, shown in lower.items():
            word = "best is " if better == self.best else ""
            lines.append(f"{where}: {word}{better}: {what} {', '.join(shown)}")
        return lines + undecided + without


@dataclass(frozen=True)
class SeedComparison:
    """Controllers over seeds: the measures of all runs, and verdicts."""

    names: tuple[str, ...]  #: of the controllers
    axes: tuple[str, ...]  #: names of the axes; one empty name if there is one axis
    windows: tuple[tuple[float, float], ...]  #: begin and end of each [s]
    seeds: tuple[int, ...]  #: one if nothing in the scenario is random
    criterion: str
    #: each measure by its name (controllers, windows, axes, seeds), NaN where a run diverged or has
    #: none
    values: Mapping[str, NDArray[np.float64]]
    diverged: NDArray[np.bool_]  #: which runs diverged (controllers, seeds)
    rounding: NDArray[np.float64]  #: the criterion up to which it is rounding (windows, axes)
    verdicts: tuple[Verdict, ...]  #: for each window the axes and, of several, all together
    units: tuple[str, ...] = ()  #: unit of the y of each axis, empty if it is not known
    notes: tuple[str, ...] = field(default=())

    def mean(self, measure: str, name: str, window: int, axis: int) -> tuple[float, float]:
        """Return mean and half of the 95 % interval of a measure; NaN where there is none."""
        found = self.values[measure][self.names.index(name), window, axis]
        known = bool(np.all(np.isfinite(found)))
        half = half_width_of_mean(found) if known and found.size > 1 else math.nan
        return (float(np.mean(found)) if known else math.nan), half

    @property
    def worse(self) -> list[str]:
        """Lines on what of the best is worse than of another controller, by more than 10 %."""
        lines = []
        for verdict in self.verdicts:
            if verdict.best is None or verdict.axis not in self.axes:
                continue
            window = self.windows.index((verdict.start, verdict.stop))
            axis = self.axes.index(verdict.axis)
            means = {
                name: {each: self.mean(each, name, window, axis)[0] for each in self.values}
                for name in self.names
            }
            where = f"{verdict.axis}, " if verdict.axis else ""
            where += f"{verdict.start:g} to {verdict.stop:g} s"
            for pair in verdict.pairs:
                if pair.better != verdict.best:
                    continue
                found = worsened(means[pair.other], means[pair.better])
                texts = "; ".join(each.text for each in found if each.name != self.criterion)
                if texts:
                    lines.append(f"{where}: {pair.better} is worse than {pair.other} in {texts}")
        return lines

    def ratio(self, name: str, window: int) -> tuple[float, float]:
        """Return the geometric mean of the axes' ratios to the first controller.

        With half of its 95 % interval; NaN for one that diverged, or if no axis has a ratio.
        """
        values, rounding = self.values[self.criterion][:, window], self.rounding[window]
        kept = _has_ratio(values, rounding)
        if not kept.any():
            return math.nan, math.nan
        d = _logarithms(values, rounding)[:, kept].mean(axis=1)
        d = d[self.names.index(name)] - d[0]
        ratio = math.exp(float(np.mean(d)))
        half = half_width_of_mean(d) if d.size > 1 and np.all(np.isfinite(d)) else math.nan
        return ratio, ratio * half

    def describe(self) -> str:
        """Return the verdicts as text: which is best for each axis, and NOT where that is open."""
        count = len(self.seeds)
        lines = [line for each in self.verdicts for line in each.describe(self.criterion, count)]
        lines += self.worse
        for name, lost in zip(self.names, self.diverged, strict=True):
            if found := int(np.sum(lost)):
                low, high = (100.0 * end for end in share_interval(found, count))
                share = f", {low:.3g} to {high:.3g} % of all" if count > 1 else ""
                runs = f"{found} of {count} runs{share}"
                lines.append(f"NOT stable: {name} diverged or ran away in {runs}")
        if count == 1:
            lines.append(
                "NOT shown for other noise and disturbances: nothing in the scenario is random, so "
                "there is one run of each; add noise or random disturbances, and give seeds"
            )
        return "\n".join([*lines, *self.notes])

    def to_json(self) -> dict[str, Any]:
        """Return all numbers for JSON."""
        given = ("criterion", "axes", "windows", "seeds", "diverged", "rounding", "values")
        verdicts = [as_json(each, *each._fields, "best") for each in self.verdicts]
        about = {"controllers": self.names, "report": self.describe().splitlines()}
        return as_json(self, *given, verdicts=verdicts, **about)


# ---- The runs ----


def over_seeds(
    plant: Any,
    controllers: Mapping[str, Any],
    scenario: Scenario,
    *,
    seeds: int | None = None,
    windows: Sequence[Mapping[str, Any]] = (),
    criterion: str = "rms",
    confidence: float = 0.95,
    progress: Callable[[float], None] | None = None,
) -> SeedComparison:
    """Run controllers on a plant through a scenario, once for each seed, and decide which is best.

    Parameters
    ----------
    plant, scenario
        as for ``simulate``; the seeds are that of the scenario and those that follow it.
    controllers
        by name, two or more: all of one axis, or all ``quell.Axes`` of the same axes; with one
        sample time, as what y does between samples is in no measure.
    seeds
        number of seeds; by default 10, or one where nothing in the scenario is random.
    windows
        begin and end [s] of the windows that are judged, as ``{"start": 4.0, "stop": 9.0}``; also
        ``target`` and ``band`` as those of ``Trajectory.metrics``. By default one from the last
        start from rest on.
    criterion
        ``"rms"``, ``"iae"`` or ``"peak_error"`` of r − y; lower is better.
    confidence
        probability with which all verdicts hold together.
    progress
        called with the finished share, 0 to 1.

    Returns
    -------
    SeedComparison
        with all ``MEASURES`` of each run, axis and window, and verdicts that begin with NOT where
        the seeds do not decide. u of an axis of several is its v = B0 u; where B0 of the
        controllers differ, with that of the first for all (``quell.records.gains.one_gain``).

    Raises
    ------
    ValueError
        for fewer than two controllers, controllers of different axes or sample times, a window with
        other keys, before 0 s or without samples, several seeds where nothing is random, one where
        something is, and what ``simulate`` raises.

    Examples
    --------
    >>> import quell as ql
    >>> lag = ql.plants.LinearPlant([[-1.0]], [1.0], [1.0])
    >>> noisy = ql.Scenario(1.0, 5.0, noise=ql.signals.BandLimitedNoise(1e-6, 0.01))
    >>> some = {"slow": ql.baselines.PID(kp=2.0, ki=2.0, dt=0.01)}
    >>> some["quick"] = ql.baselines.PID(kp=6.0, ki=6.0, dt=0.01)
    >>> over_seeds(lag, some, noisy).verdicts[0].best
    'quick'
    """
    checks.one_of("criterion", criterion, tuple(CRITERIA))
    confidence = checks.positive("confidence", confidence)
    if confidence >= 1.0:
        raise ValueError(f"confidence = {confidence!r}: must be below 1, such as 0.95")
    if len(controllers) < 2:
        raise ValueError(f"controllers has {len(controllers)}: give two or more to compare")
    axes = _axes_of(controllers)
    check_sample_times(controllers)
    numbers = _seeds(scenario, seeds)
    judged = _windows(scenario, windows)
    spans = tuple(_span(window, scenario.duration) for window in judged)
    measures = {
        f"{i}.{axis}.{name}": Measure(name, **window, axis=axis)
        for i, window in enumerate(judged)
        for axis in axes
        for name in MEASURES
    }
    first = replace(scenario, seed=numbers[0])
    gain, fault = (
        _common_gain(plant, controllers, first) if axes != ("",) else (OneGain(None, True), "")
    )
    own: dict[str, Callable[[Any], float]] = {
        f"{i}.{axis}": partial(_largest, start=start, stop=stop, axis=axis)
        for i, (start, stop) in enumerate(spans)
        for axis in axes
    }

    def run(controller: Any, seed: int) -> tuple[dict[str, float], bool]:
        found = simulate(plant, controller, replace(scenario, seed=seed))
        if gain.B is not None:
            found = with_gain(found, gain.B)
        return measure_run(found, {**measures, **own}), bool(found.lost)

    made = [*controllers.values()]
    # The first seed of each compiles what is not compiled yet; the others then only run.
    total = len(made) * len(numbers)
    results: list[tuple[dict[str, float], bool]] = []
    for batch in (numbers[:1], numbers[1:]):
        jobs = [partial(run, controller, seed) for seed in batch for controller in made]
        share = part_of(progress, len(results), len(results) + len(jobs), total)
        results += in_parallel(jobs, share, 1 if one_at_a_time(plant) else None) if jobs else []
    shape = len(numbers), len(made), len(judged), len(axes), len(MEASURES)
    table = np.array([[found[name] for name in measures] for found, _ in results]).reshape(shape)
    diverged = np.array([lost for _, lost in results]).reshape(shape[:2])
    table[diverged] = np.nan
    largest = np.array([[found[name] for name in own] for found, _ in results])
    largest = np.moveaxis(largest.reshape(shape[:4]), 0, -1)
    values = {name: np.moveaxis(table[..., k], 0, -1) for k, name in enumerate(MEASURES)}
    if fault:
        values |= {name: np.full_like(values[name], math.nan) for name in OF_U}
    names = tuple(controllers)
    rounding = _rounding(largest, diverged.T, spans, criterion)
    level = _level(confidence, names, axes, spans)
    verdicts = _verdicts(names, axes, spans, values[criterion], diverged.T, level, rounding)
    found = names, axes, spans, numbers, criterion, values, diverged.T
    notes = [f"NOT compared: variation and ∫u² dt of u: {fault}"] if fault else gain.describe()
    return SeedComparison(*found, rounding, verdicts, notes=tuple(notes))


def _common_gain(
    plant: Any, controllers: Mapping[str, Any], scenario: Scenario
) -> tuple[OneGain, str]:
    """Return how v of all axes can be compared, and why it can't be."""
    first, *others = controllers.values()
    if all(_same_gain(getattr(first, n), getattr(c, n)) for c in others for n in ("B0", "M")):
        return OneGain(None, True), ""
    jobs = [partial(simulate, plant, controller, scenario) for controller in controllers.values()]
    runs: Any = in_parallel(jobs, None, 1 if one_at_a_time(plant) else None)
    factors = {name: gain_factor(run) for name, run in zip(controllers, runs, strict=True)}
    try:
        return one_gain(factors, first.inputs), ""
    except ValueError as error:
        return OneGain(None, False), str(error)


def _same_gain(one: Any, other: Any) -> bool:
    """Return whether two B0 or M are the same matrix, or function with the same parameters."""
    if isinstance(one, partial) and isinstance(other, partial):
        given = one.keywords, other.keywords
        return one.func is other.func and all(
            _same_gain(*(each.get(name) for each in given)) for name in {*given[0], *given[1]}
        )
    if callable(one) or callable(other) or one is None or other is None:
        return one is other
    return bool(np.array_equal(one, other))


def _axes_of(controllers: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of the axes, which all controllers have; ``("",)`` of one axis."""
    found: dict[str, tuple[str, ...]] = {}
    for name, controller in controllers.items():
        if hasattr(controller, "inputs"):  # of several signals
            found[name] = tuple(getattr(controller, "names", ()))
            if not found[name]:
                rule = "has no axes; compare quell.Axes, or controllers of one axis"
                raise ValueError(f"controllers[{name!r}] = {controller!r:.60}: {rule}")
        else:
            check_controller(controller, f"controllers[{name!r}]")
            found[name] = ("",)
    (first, axes), *others = found.items()
    for name, each in others:
        if each != axes:
            texts = [", ".join(some) if some != ("",) else "one axis" for some in (axes, each)]
            raise ValueError(
                f"{name} has {texts[1]}, {first} {texts[0]}: must have the same axes, in this order"
            )
    return axes


def _seeds(scenario: Scenario, seeds: int | None) -> tuple[int, ...]:
    """Return the seeds of the runs."""
    random = is_random(scenario)
    count = (SEEDS if random else 1) if seeds is None else checks.whole("seeds", seeds, 1)
    if random and count == 1:
        rule = "one run cannot tell luck from better; give two or more, or leave it out"
        raise ValueError(f"seeds = 1: {rule}")
    if not random and count > 1:
        rule = (
            "nothing in the scenario is random, so all runs would be one; add noise or random "
            "disturbances, or leave it out"
        )
        raise ValueError(f"seeds = {count}: {rule}")
    return tuple(range(scenario.seed, scenario.seed + count))


def _windows(scenario: Scenario, windows: Sequence[Any]) -> tuple[dict[str, Any], ...]:
    """Return the windows, checked, each with a begin within the scenario."""
    known = tuple(inspect.signature(check_window).parameters)
    rests = [float(time) for time in scenario.rest_at]
    found = tuple(windows) or ({"start": rests[-1] if rests else 0.0},)
    for i, window in enumerate(found):
        where = f"windows[{i}]"
        if not isinstance(window, Mapping):
            rule = 'must be a table, such as {"start": 4.0, "stop": 9.0}'
            raise ValueError(f"{where} = {window!r:.60}: {rule}")
        for key in window:
            if key not in known:
                hint = checks.nearest(str(key), known)
                raise ValueError(f"{where}: {key!r:.60} is unknown; {hint}")
        try:
            check_window(**window)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        start = float(window.get("start", 0.0))
        if start >= scenario.duration:
            rule = f"must be less than the scenario's duration, {scenario.duration:g} s"
            raise ValueError(f"{where}.start = {start:g}: {rule}")
    return tuple(map(dict, found))


def _span(window: Mapping[str, Any], duration: float) -> tuple[float, float]:
    stop = window.get("stop")
    return float(window.get("start", 0.0)), duration if stop is None else min(stop, duration)


def _level(confidence: float, names: Sequence[Any], axes: Sequence[Any], spans: Any) -> float:
    """Return the level of each of the comparisons, so that all hold together."""
    each = len(axes) + (len(axes) > 1)
    return (1.0 - confidence) / (len(list(combinations(names, 2))) * each * len(spans))


def _largest(run: Any, start: float, stop: float, axis: str) -> float:
    """Return the largest |r| or |y| of an axis in a window; NaN if the run ended before it."""
    one = run.axis(axis) if axis else run
    part = one.window(start, stop)
    seen = np.abs([one["r"][part], one["y"][part]])
    return float(np.max(seen)) if seen.size else math.nan


def _rounding(
    largest: NDArray[np.float64],
    diverged: NDArray[np.bool_],
    spans: Sequence[tuple[float, float]],
    criterion: str,
) -> NDArray[np.float64]:
    """Return the criterion up to which it is rounding (windows, axes).

    ``largest`` is the largest |r| or |y| (controllers, windows, axes, seeds). The least of all runs
    counts, or a controller that is far off would make the errors of all others rounding.
    """
    lost = np.isnan(largest) | diverged[:, None, None]
    least = np.min(np.where(lost, np.inf, largest), axis=(0, 3))
    least[np.isinf(least)] = 0.0  # all runs diverged
    found = np.maximum(_ROUNDING * least, _COUPLED * np.max(least, axis=1, keepdims=True))
    if criterion == "iae":
        found *= [[stop - start] for start, stop in spans]
    return np.maximum(found, np.finfo(np.float64).tiny)


def _has_ratio(values: NDArray[np.float64], rounding: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return in which axes no criterion of ``values`` (controllers, axes, seeds) is rounding."""
    return ~np.any(values <= rounding[:, None], axis=(0, 2))


def _logarithms(values: NDArray[np.float64], rounding: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the logarithms of a criterion; what is rounding is all the same."""
    return np.log(np.maximum(values, rounding[:, None]))


def _verdicts(
    names: tuple[str, ...],
    axes: tuple[str, ...],
    spans: Sequence[tuple[float, float]],
    values: NDArray[np.float64],
    diverged: NDArray[np.bool_],
    level: float,
    rounding: NDArray[np.float64],
) -> tuple[Verdict, ...]:
    """Return the verdicts of ``values`` (controllers, windows, axes, seeds) of the criterion."""
    stable = [i for i in range(len(names)) if not np.any(diverged[i])]
    found = []
    for k, span in enumerate(spans):
        logarithms = _logarithms(values[:, k], rounding[k])
        rows = {name: logarithms[:, i] for i, name in enumerate(axes)}
        kept = _has_ratio(values[:, k], rounding[k])
        left_out = tuple(name for name, has in zip(axes, kept, strict=True) if not has)
        if len(axes) > 1 and kept.any():
            rows[ALL_AXES] = logarithms[:, kept].mean(axis=1)
        for axis, row in rows.items():
            order = sorted(stable, key=lambda i: float(np.mean(row[i])))
            pairs = tuple(
                _pair(names[i], names[j], row[j] - row[i], level) for i, j in combinations(order, 2)
            )
            first = names[order[0]] if order else None
            without = left_out if axis == ALL_AXES else ()
            found.append(Verdict(axis, *span, first, pairs, without))
        if len(axes) > 1 and not kept.any():
            found.append(Verdict(ALL_AXES, *span, None, (), left_out))
    return tuple(found)


def _pair(better: str, other: str, d: Vector, level: float) -> Pair:
    """Compare two controllers by the logarithms of their ratio (seeds,)."""
    middle = float(np.mean(d))
    if d.size == 1:
        lower = -math.expm1(-middle)
        return Pair(better, other, lower, lower, lower, lower > _ALIKE, 0)
    spread = float(np.std(d, ddof=1)) / math.sqrt(d.size)
    alike = -math.log1p(-_ALIKE)
    found = decide(middle - alike, spread, d.size - 1.0, level)
    lower, least, most = (-math.expm1(-(each + alike)) for each in found.ends)
    open_ = not found.decided and not math.isnan(found.enough)
    needed = math.ceil(max(found.enough, 1.1) * d.size) if open_ else 0
    return Pair(better, other, lower, least, most, found.decided, needed)


# ---- Setups ----


def of_setups(
    setups: Mapping[str, Setup],
    *,
    seeds: int | None = None,
    criterion: str = "rms",
    progress: Callable[[float], None] | None = None,
) -> SeedComparison:
    """Compare the controllers of setups on the plant and in the scenario of the first.

    Parameters
    ----------
    setups
        by name, two or more; all of one axis, or all of the same axes, with one dt. Where another
        one has a plant, a scenario, references or windows of its own that differ, a note that
        begins with NOT says that they are not used.
    seeds, criterion, progress
        as for ``over_seeds``; the windows are those of [[metrics]].
    """
    if len(setups) < 2:
        raise ValueError(f"setups has {len(setups)}: give two or more to compare")
    (name, first), *others = setups.items()
    plant, scenario = first.needed("plant"), first.needed("scenario")
    controllers = {key: setup.controller for key, setup in setups.items()}
    _check_units(setups)
    how: dict[str, Any] = {"seeds": seeds, "criterion": criterion, "progress": progress}
    found = over_seeds(plant, controllers, scenario, windows=first.windows, **how)
    given = first.tables()
    notes = []
    for key, setup in others:
        unlike = [what for what in _task(given) if _unlike(what, given, setup.tables())]
        if unlike:
            its = ", ".join(unlike)
            notes.append(f"NOT its own {its}: {key} runs with the {its} of {name}, as all do")
    if is_of_axes(given):
        signals = signals_in(first.description, first.controller)
        units = tuple(each.unit for each in signals.y)
    else:
        units = (signals_of(plant).y.unit,)
    return replace(found, units=units, notes=(*found.notes, *notes))


def _check_units(setups: Mapping[str, Setup]) -> None:
    """Raise a ``ValueError`` for setups whose plants have y or u in other units than the first.

    Their controllers are made for these units, and run on the plant of the first.
    """
    found = {key: _quantities(setup) for key, setup in setups.items()}
    (name, first), *others = found.items()
    for key, each in others:
        for what, own in each.items():
            wanted = first.get(what, Quantity())
            known = conversion(own.unit, wanted.unit) if own.unit and wanted.unit else Conversion()
            if known is None or known.changes:
                raise ValueError(
                    f"{key}: {what} is {own.label(what)}, in {name} it is {wanted.label(what)}: "
                    "all controllers run on the plant of the first, so units must be the same; "
                    "design them in one unit"
                )


def _quantities(setup: Setup) -> dict[str, Quantity]:
    """Return what y and u of a setup's plant are, as far as it has one, or its axes."""
    tables = setup.tables()
    if is_of_axes(tables):
        signals = signals_in(setup.description, setup.controller)
        named = {f"y of {axis}": y for axis, y in zip(signals.axes, signals.y, strict=True)}
        return named | {f"u{k + 1}": u for k, u in enumerate(signals.u)}
    signals_of_it = signals_of(setup.plant) if setup.plant is not None else UNKNOWN
    return {"y": signals_of_it.y, "u": signals_of_it.u}


def _task(given: Mapping[str, Any]) -> tuple[str, ...]:
    of_axes = ("reference", "noise") if is_of_axes(given) else ()
    return "plant", "scenario", "metrics", *of_axes


def _unlike(what: str, given: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether another setup has a task of its own, that differs."""
    if what not in ("reference", "noise"):
        return what in other and other[what] != given.get(what)
    own, its = ([axis.get(what) for axis in tables["axis"]] for tables in (given, other))
    return any(b is not None and b != a for a, b in zip(own, its, strict=False))


# ---- The figure ----


def draw(result: SeedComparison, axes: Any = None, *, ax: Any = None) -> Any:
    """Draw the criterion of each controller: a dot for each seed, the mean and its 95 % interval.

    Parameters
    ----------
    result
        of ``over_seeds``.
    axes, ax
        matplotlib axes, a row for each window, a column for each axis; a new figure by default.

    Returns
    -------
    numpy.ndarray
        the axes (windows, axes).
    """
    rows, columns = len(result.windows), len(result.axes)
    make = partial(new_figure, 1.5 + 3.0 * columns, 0.8 + 2.6 * rows)
    grid = grid_of_axes(given_axes(axes, ax), make, rows, columns)
    unit = "{}" if result.criterion != "iae" else "{} s"
    for k, i in product(range(rows), range(columns)):
        here, axis = grid[k, i], result.axes[i]
        for j, name in enumerate(result.names):
            values = result.values[result.criterion][j, k, i]
            spread = np.linspace(-0.15, 0.15, values.size) if values.size > 1 else [0.0]
            here.plot(j + np.asarray(spread), values, ".", color=f"C{j}", alpha=0.4)
            middle, half = result.mean(result.criterion, name, k, i)
            if math.isfinite(middle):
                reach = half if math.isfinite(half) else 0.0
                here.errorbar(j, middle, reach, fmt="o", capsize=4, color=f"C{j}")
        here.set_xticks(range(len(result.names)), result.names)
        here.set_ylim(bottom=0.0)
        here.grid(alpha=0.3)
        start, stop = result.windows[k]
        where = f"{axis}, " if axis else ""
        here.set_title(f"{where}{start:g} to {stop:g} s", fontsize="medium")
        known = f" [{unit.format(result.units[i])}]" if result.units and result.units[i] else ""
        here.set_ylabel(f"{CRITERIA[result.criterion]}{known}")
    return grid


def save(
    result: SeedComparison,
    folder: str | os.PathLike[str],
    overwrite: bool = False,
    name: str = "over-seeds",
) -> list[Path]:
    """Write the figure into ``folder``, created if missing; return the paths."""
    return save_figures({name: partial(draw, result)}, folder, overwrite=overwrite)
