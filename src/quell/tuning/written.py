"""The loop of the setup file that a tuning writes, and what it does there.

Margins come from linearising the controller. Whatever is said about a step, a load or an overload
comes from here: the controller as it is written runs on the plant as it is written, with delay, lag
of the actuator, friction, play, encoder and limits of u.

A figure that depends on the draw of the noise is that of the file's own seed, beside its range over
several draws. With the mean m of the responses and the standard deviation σ around it, the time at
which m stays within the band wider and narrower by 3 σ belong to that of the settling time: where
an overshoot just touches the band y settles before or behind it, and few draws may show one only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from quell.plants.base import measure_all, outputs_of
from quell.plants.linear import LinearPlant
from quell.quantities import UNKNOWN, Signals
from quell.records.metrics import SETTLING_BAND, settling_time
from quell.signals import Signal, Step, as_signal
from quell.simulation import Scenario, simulate
from quell.simulation.scenario import is_random
from quell.types import Vector

# Samples up to which a run is plain Python: that takes as long as code that is loaded from the disk
# cache; a longer run is compiled.
_AS_PYTHON = 2500
# Changes of a signal that are not beside others are steps, up to so many in a scenario.
_MOST_STEPS = 50
# Three standard deviations of the noise of y belong to the settling band.
_NOISE_BAND = 3.0
# Share of the samples at a limit in the last fifth of a run from which on the loop cycles there.
_AT_LIMIT, _LAST = 0.2, 5
DRAWS = 5
"""Draws of the noise over which the range of a figure is taken."""
# Ranges are told from this width on, as a share: of the step for an overshoot, else of the figure.
_POINTS, _SHARE = 0.01, 0.03
MOST_OVERSHOOT = 0.05
"""Largest overshoot of a step of the reference that is taken without a prefilter, as a share."""
# Loads in units of what u can hold, for so many closed-loop time constants.
_OVERLOAD, _CONSTANTS = 1.4, (5.0, 20.0)
# A load that u holds, with which an overload is compared.
_HELD = 0.3
# y is back where its error is this share of the largest one, and after this multiple of the time
# that overload and recovery without limits take it counts as slow. Chosen by hand: a double
# integrator with the quickest switching needs 1.5 of the first.
_BACK, _SLOW = 0.02, 3.0


Range = tuple[float, float]


def _range(values: Sequence[float]) -> Range | None:
    """Return the least and the largest value over draws, NaN where one is; None for one draw."""
    if len(values) == 1:
        return None
    return float(np.nanmin([*values, math.inf])), float(np.max(values))


def _over_draws(ends: Range | None, least: float, unit: str) -> str:
    """Return a range that is wider than ``least`` in brackets, else nothing."""
    if ends is None or ends[1] - ends[0] <= least:
        return ""
    low, high = (f"{end:.3g}" for end in ends)
    high = f"{unit} to never" if math.isnan(ends[1]) else f" to {high}{unit}"
    return f" ({low}{high} over {DRAWS} draws of the noise)"


class StepFigures(NamedTuple):
    """What the written loop does after a step of the reference."""

    size: float  #: of the step [y-unit]
    at: float  #: when it begins [s]
    overshoot: float  #: share of the step; infinite if y diverges
    settling: float  #: time until y stays within the band [s]; NaN if it does not
    band: float  #: half width of that band, as a share of the step
    looked: float  #: time that was looked at [s]
    limited: float  #: time that u is at a limit in it [s]
    signals: Signals = UNKNOWN  #: names and units of y and u
    overshoots: Range | None = None  #: least and largest over draws of the noise, if there is any
    settlings: Range | None = None  #: the same; NaN at its end where y does not settle with each

    def __str__(self) -> str:
        """Return the figures as a sentence."""
        unit = f" {self.signals.y.unit}" if self.signals.y.unit else ""
        begin = f"step of the reference by {self.size:.4g}{unit} at {self.at:.4g} s"
        if not math.isfinite(self.overshoot):
            return f"NOT stable: {begin}: y diverges"
        text = f"{begin}: overshoots by {100.0 * self.overshoot:.1f} %"
        if self.overshoots is not None:
            ends = 100.0 * self.overshoots[0], 100.0 * self.overshoots[1]
            text += _over_draws(ends, 100.0 * _POINTS, " %")
        wide = self.band > 1.1 * SETTLING_BAND
        band = f"{100.0 * (self.band if wide else SETTLING_BAND):.2g} %"
        if math.isnan(self.settling):
            return f"NOT settled: {text}; not within {band} at the end of its {self.looked:.3g} s"
        if wide:
            band += " (with three deviations of the noise)"
        text = f"{text}, settles within {band} in {self.settling:.3g} s"
        text += _over_draws(self.settlings, _SHARE * self.settling, " s")
        with_each = self.settlings is None or not math.isnan(self.settlings[1])
        return text if with_each else f"NOT settled with each draw of the noise: {text}"


class MoveFigures(NamedTuple):
    """What the written loop does along a reference that moves from sample to sample."""

    largest: float  #: largest ``|r − y|`` in the scenario [y-unit]; infinite if y diverges
    last: float  #: the same in its last tenth [y-unit]
    signals: Signals = UNKNOWN
    largests: Range | None = None  #: least and largest over draws of the noise, if there is any

    def __str__(self) -> str:
        """Return the figures as a sentence."""
        if not math.isfinite(self.largest):
            return "NOT stable: y diverges in the scenario"
        unit = f" {self.signals.y.unit}" if self.signals.y.unit else ""
        spread = _over_draws(self.largests, _SHARE * self.largest, unit)
        return (
            f"scenario: the largest |r − y| is {self.largest:.3g}{unit}{spread}, "
            f"{self.last:.3g}{unit} in its last tenth"
        )


def figures_table(figures: StepFigures | MoveFigures) -> dict[str, Any]:
    """Return figures as a table, without signals and ranges that they do not have."""
    return {
        key: value
        for key, value in figures._asdict().items()
        if key != "signals" and value is not None
    }


class Overload(NamedTuple):
    """What the written loop does after a load that u can't hold."""

    load: float  # size of the disturbance
    duration: float  # [s]
    peak: float  # largest error [y-unit]
    back: float  # time from its end until the error stays within 2 % of the largest; NaN if never
    usual: float  # the same after a load that u can hold [s]
    name: str = ""  # of several axes: which load
    last: str = ""  # the axis that comes back last
    backs: Range | None = None  # least and largest over draws of the noise, if there is any

    @property
    def passes(self) -> bool:
        """Whether y comes back, and not slowly."""
        return self.back <= _SLOW * (self.duration + self.usual)

    def __str__(self) -> str:
        """Return it as a part of a sentence."""
        how = "never" if math.isnan(self.back) else f"in {self.back:.3g} s"
        which = f"{self.name} by " if self.name else ""
        last = f" ({self.last})" if self.last else ""
        if not math.isnan(self.back):
            how += _over_draws(self.backs, _SHARE * self.back, " s")
        return f"{which}{self.load:.3g} for {self.duration:.3g} s: back {how}{last}"

    def to_json(self) -> dict[str, Any]:
        """Return it as a table."""
        return {key: value for key, value in self._asdict().items() if value not in ("", None)}


@dataclass(frozen=True, eq=False)
class Written:
    """Plant and scenario of the file, in which controllers are judged.

    ``scenario`` is None for ``quell.tune`` where the file has none: it makes one. Of a plant with
    several outputs the figures are those of one axis, and u is all actuators. ``others`` are
    further plants in the same scenario, for which the controller is meant, too: those of a set, and
    the points of a schedule, at whose signals ``at`` the controller is held.
    """

    plant: Any
    scenario: Any  # Scenario | None
    dt: float
    axis: int | None = None
    name: str = ""
    at: tuple[float, ...] = ()
    others: tuple[Written, ...] = ()
    of_others: str = ""  # what they are, as text
    linear: LinearPlant | None = None  # one of the others, without delay and lag

    def run(self, controller: Any, scenario: Scenario | None = None) -> Any:
        """Run a controller through the scenario, or another one: a ``Trajectory``, or of axes."""
        scenario = scenario or self.scenario
        short = scenario.duration <= _AS_PYTHON * self.dt and not self.name
        controller = controller.at(*self.at) if self.at else controller
        return simulate(self.plant, controller, scenario, interpret=short)

    def runs(self, controller: Any) -> list[Any]:
        """Return the run through the scenario, and those with other draws of its noise."""
        seed, draws = self.scenario.seed, DRAWS if is_random(self.scenario) else 1
        scenarios = [replace(self.scenario, seed=seed + k) for k in range(draws)]
        return [self.run(controller, scenario) for scenario in scenarios]

    @cached_property
    def _signals(self) -> tuple[tuple[Signal, ...], tuple[Signal, ...], tuple[Signal, ...]]:
        """References, disturbances and noise."""
        plant, outputs = self.plant, outputs_of(self.plant)
        return self.scenario.seeded(outputs, plant.disturbances, outputs, plant)

    @property
    def loads(self) -> tuple[Signal, ...]:
        """The disturbances of the scenario."""
        return self._signals[1]

    @cached_property
    def _noise(self) -> Vector:
        """Standard deviation of the noise of each y in a sample [y-unit]."""
        t = self._t[:_AS_PYTHON]
        return np.array([float(np.std(signal(t))) for signal in self._signals[2]])

    @property
    def noise(self) -> float:
        """Standard deviation of the noise of y in a sample [y-unit]."""
        return float(self._noise[self.axis or 0])

    @cached_property
    def _t(self) -> Vector:
        return np.arange(round(self.scenario.duration / self.dt) + 1) * self.dt

    @cached_property
    def start(self) -> float:
        """The y of the plant at the start."""
        x0 = self.scenario.x0
        x: Vector = np.zeros(self.plant.order) if x0 is None else np.asarray(x0, dtype=np.float64)
        model = self.plant.sampled(self.dt, interpret=True)
        y = np.zeros(outputs_of(self.plant))
        measure_all(model, x, y)
        return float(y[self.axis or 0])

    @cached_property
    def _events(self) -> tuple[tuple[int, float], ...] | None:
        """Samples at which a signal steps, with the size of a step of r; None if r moves."""
        references, loads, _ = self._signals
        own = references[self.axis or 0]
        sizes = np.diff(own(self._t), prepend=self.start)
        at = np.flatnonzero(sizes)
        if at.size > _MOST_STEPS or np.any(np.diff(at) == 1):
            return None
        found = {int(k): float(sizes[k]) for k in at}
        rest = [(signal, float(signal(0.0))) for signal in references if signal is not own]
        for signal, before in [*rest, *((load, 0.0) for load in loads)]:
            jumps = np.flatnonzero(np.diff(signal(self._t), prepend=before))
            alone = jumps.size <= _MOST_STEPS
            found = {**{int(k): 0.0 for k in jumps if alone}, **found}
        for time in np.ravel(self.scenario.rest_at):
            found.setdefault(round(float(time) / self.dt), 0.0)
        return tuple(sorted(found.items()))

    @property
    def moves(self) -> bool:
        """Whether the reference moves from sample to sample, so that it needs no generator."""
        return self.scenario is not None and self._events is None

    @cached_property
    def steps(self) -> tuple[tuple[int, int, float], ...]:
        """First and last sample of each step of the reference, and its size.

        The last one is that before the next step of any signal.
        """
        events = self._events or ()
        ends = [*(at for at, _ in events), self._t.size][1:]
        return tuple(
            (at, end, size) for (at, size), end in zip(events, ends, strict=True) if size != 0.0
        )

    @cached_property
    def largest(self) -> tuple[int, int, float] | None:
        """The largest of the ``steps``; None if there is none."""
        return max(self.steps, key=lambda step: abs(step[2]), default=None)

    def _of_axis(self, run: Any, name: str) -> Vector:
        return run[name] if self.axis is None else run[name][:, self.axis]

    def figures(self, controller: Any, run: Any) -> StepFigures | None:
        """Return what a run does after the largest step of the reference; None if it has none."""
        if self.largest is None:
            return None
        first, end, size = self.largest
        end = min(end, len(run))
        band, looked = SETTLING_BAND + _NOISE_BAND * self.noise / abs(size), (end - first) * self.dt
        at, signals = first * self.dt, self._names(run)
        if run.diverged or end <= first:
            return StepFigures(size, at, math.inf, math.nan, band, looked, 0.0, signals)
        y, r = (self._of_axis(run, name)[first:end] for name in ("y", "r"))
        goal = float(r[0])
        # As far as it was looked at: of a step that does not settle the text says so.
        move = (goal - float(y[0])) or size  # as in the metrics of a run
        over = max(float(np.max((y - goal) / move)), 0.0)
        settling = settling_time(self._t[first:end], y, goal, band, goal - move)
        at_limit = np.any(_at_limits(run["u"][first:end], controller), axis=(0, 2))
        limited = float(np.sum(at_limit)) * self.dt
        return StepFigures(size, at, over, settling, band, looked, limited, signals)

    def of_draws(
        self, controller: Any, runs: Sequence[Any]
    ) -> tuple[StepFigures | None, MoveFigures | None]:
        """Return ``figures`` of the first of some runs, or what it does ``along`` r that moves.

        With the ranges over all, which differ in the draw of the noise.
        """
        every = [self.figures(controller, run) for run in runs]
        steps = [each for each in every if each is not None]
        if not steps:
            moves = [self.along(run) for run in runs]
            return None, moves[0]._replace(largests=_range([each.largest for each in moves]))
        step, times = steps[0], [each.settling for each in steps]
        if len(steps) > 1 and not any(run.diverged for run in runs):
            assert self.largest is not None
            first, end, size = self.largest
            end = min(end, len(runs[0]))
            y = np.array([self._of_axis(run, "y")[first:end] for run in runs])
            mean, goal = np.mean(y, axis=0), float(self._of_axis(runs[0], "r")[first])
            move = (goal - float(mean[0])) or size
            wide = _NOISE_BAND * math.sqrt(float(np.mean(np.var(y, axis=0, ddof=1)))) / abs(move)
            for band in (step.band + wide, step.band - wide):
                if band > 0.0:
                    time = settling_time(self._t[first:end], mean, goal, band, goal - move)
                    times += [] if math.isnan(time) else [time]
        overshoots = _range([each.overshoot for each in steps])
        return step._replace(overshoots=overshoots, settlings=_range(times)), None

    def _names(self, run: Any) -> Signals:
        return run.signals if self.axis is None else run.axis(self.axis).signals

    def along(self, run: Any) -> MoveFigures:
        """Return how far a run is from its reference."""
        if run.diverged:
            return MoveFigures(math.inf, math.inf, self._names(run))
        error = np.abs(self._of_axis(run, "r") - self._of_axis(run, "y"))
        last = float(np.max(error[-max(len(run) // 10, 1) :]))
        return MoveFigures(float(np.max(error)), last, self._names(run))

    def error(self, controller: Any) -> float:
        """Return ∫|r − y| over the scenario [y-unit s]; infinite where y diverges."""
        run = self.run(controller)
        error = np.abs(self._of_axis(run, "r") - self._of_axis(run, "y"))
        return math.inf if run.diverged else float(np.sum(error)) * self.dt

    def until_settled(self, scenario_end: float) -> Scenario:
        """Return the scenario up to a time [s], without starts from rest after that."""
        rests = [time for time in np.ravel(self.scenario.rest_at) if time < scenario_end]
        last = min(scenario_end, self.scenario.duration)
        return replace(self.scenario, duration=last, rest_at=tuple(rests))

    def stepping(self, size: float, last: float, before: int) -> Written:
        """Return the same loop with a step of the reference alone, for a scenario without one.

        It comes after ``before`` samples, from rest, and is looked at for ``last`` seconds. All
        else is as at the start; a size of 0 is no step.
        """
        at = before * self.dt
        references, loads, _ = self._signals
        r: list[Any] = [float(signal(0.0)) for signal in references]
        if size:
            r[self.axis or 0] += Step(size, at)
        rest = replace(
            self.scenario,
            reference=r[0] if self.axis is None else r,
            disturbances=[float(load(0.0)) for load in loads],
            duration=at + max(round(last / self.dt), before) * self.dt,
            rest_at=(),
        )
        others = tuple(each.stepping(size, last, before) for each in self.others)
        return replace(self, scenario=rest, others=others)

    def cycles(self, controller: Any, run: Any) -> bool:
        """Return whether u still goes from limit to limit at the end of a run."""
        low, high = _at_limits(run["u"][-(len(run) // _LAST) :], controller)
        often = np.mean(low | high, axis=0) > _AT_LIMIT
        return bool(np.any(often & np.any(low, axis=0) & np.any(high, axis=0)))

    def overloads(
        self, controller: Any, step: StepFigures | None, tau: float, held: Any
    ) -> list[Overload]:
        """Return what the loop does after loads that u can't hold, for 5 and 20 time constants.

        Parameters
        ----------
        controller
            with limits of u.
        step
            what it does after the step of the scenario, behind which the loads come; None for a
            scenario whose reference moves, in which they come soon after the start.
        tau
            time constant of the closed loop [s].
        held
            u that holds a first disturbance of 1; of several axes a column for each disturbance
            (m, q), zero for one that is not looked at.
        """
        begin = _CONSTANTS[0 if self.scenario.x0 is None else 1] * tau  # until it is at rest
        if step is not None and self.largest is not None:
            first, end, _ = self.largest
            settled = max(2.0 * step.settling, begin)
            begin = first * self.dt + min(settled, 0.9 * (end - first) * self.dt)
        begin = max(round(begin / self.dt), 1) * self.dt
        before, columns = self.until_settled(begin), np.array(held, dtype=np.float64, ndmin=2)
        references, loads, _ = self._signals
        calm: Any = [as_signal(each).until(begin, float(each(begin))) for each in references]
        calm = calm[0] if self.axis is None else calm
        rest = np.atleast_1d(np.mean(self.run(controller, before)["u"][-10:], axis=0))
        room = [_room(column, rest, controller) for column in columns.T]
        if not any(room):
            return []
        several, names = self.axis is not None, getattr(controller, "names", ("",))

        def trial(k: int, size: float, duration: float, last: float, draw: int) -> Any:
            """Return the errors (samples, n) from the beginning of the load; None if y diverges."""
            end = begin + round(duration / self.dt) * self.dt
            at_rest = float(loads[k](begin))
            load = loads[k].until(begin, at_rest + size).until(end, at_rest)
            scenario = replace(
                before,
                seed=before.seed + draw,
                reference=calm,
                duration=round((end + last) / self.dt) * self.dt,
                disturbances=[*loads[:k], load, *loads[k + 1 :]],
            )
            run = self.run(controller, scenario)
            error = np.abs(run["y"] - run["r"])[round(begin / self.dt) :]
            return None if run.diverged else error.reshape(len(error), -1)

        def back(errors: Any, peaks: Vector, duration: float) -> tuple[int, float]:
            """Return which axis is back last, and how long after the load; NaN for never."""
            if errors is None:
                return 0, math.nan
            outside = errors > np.maximum(_BACK * peaks, _NOISE_BAND * self._noise)
            if np.any(outside[-1]):
                return int(np.argmax(outside[-1])), math.nan
            last = [int(np.flatnonzero(each)[-1]) + 1 if each.any() else 0 for each in outside.T]
            after = max(last) - round(duration / self.dt)
            return int(np.argmax(last)), max(float(after) * self.dt, 0.0)

        found, usual = [], dict[int, float]()
        for times in _CONSTANTS:
            duration, last = max(times * tau, self.dt), 40.0 * tau
            for share, draws in ((_HELD, 1), (_OVERLOAD, DRAWS if is_random(self.scenario) else 1)):
                of_draws = []
                for draw in range(draws):
                    tried = {}
                    for k, most in enumerate(room):
                        if most:
                            if share == _OVERLOAD:
                                last = 1.5 * _SLOW * (duration + usual[k])
                            tried[k] = trial(k, share * most, duration, last, draw)
                    # Of several axes each is back where it is little beside its largest error.
                    of_each = [np.max(each, axis=0) for each in tried.values() if each is not None]
                    peaks = np.max(of_each, axis=0) if of_each else np.array([math.inf])
                    times_back = {k: back(each, peaks, duration) for k, each in tried.items()}
                    of_draws.append((tried, times_back))
                tried, times_back = of_draws[0]
                if share == _HELD:
                    usual = {k: last if math.isnan(t) else t for k, (_, t) in times_back.items()}
            for k, (axis, t) in times_back.items():
                peak = math.inf if tried[k] is None else float(np.max(tried[k][:, axis]))
                which = (f"disturbance {k + 1}", str(names[axis])) if several else ("", "")
                backs = _range([each[k][1] for _, each in of_draws])
                size = _OVERLOAD * room[k]
                found.append(Overload(size, duration, peak, t, usual[k], *which, backs))
        return found


def _ends(controller: Any) -> tuple[Vector, Vector]:
    """Return the limits of each actuator (m,)."""
    limits = getattr(controller, "limits", None)
    ends = (-math.inf, math.inf) if limits is None else (limits.low, limits.high)
    return np.atleast_1d(ends[0]), np.atleast_1d(ends[1])


def bounded(controller: Any) -> bool:
    """Return whether an actuator has both limits."""
    low, high = _ends(controller)
    return bool(np.any(np.isfinite(high - low)))


def _at_limits(u: Any, controller: Any) -> Any:
    """Return which samples of u are at the lower and at the upper limit (2, k, m)."""
    low, high = _ends(controller)
    u = u.reshape(len(u), -1)
    return np.array([u <= low, u >= high])


def _room(held: Vector, rest: Vector, controller: Any) -> float:
    """Return the largest size of a disturbance that u can hold; 0 where there is none.

    ``held`` is the u (m,) that holds a size of 1, and ``rest`` the u without it. The sign is that
    with which the u that is needed most increases, or decreases where it has no upper limit.
    """
    low, high = _ends(controller)
    most = int(np.argmax(np.abs(held)))
    sign = 1.0 if (held[most] > 0.0) == math.isfinite(high[most]) else -1.0
    ends = np.where(sign * held > 0.0, high - rest, rest - low)
    with np.errstate(divide="ignore", invalid="ignore"):
        sizes = np.where(held != 0.0, ends / np.abs(held), math.inf)
    size = sign * float(np.min(sizes, initial=math.inf))
    return size if math.isfinite(size) else 0.0
