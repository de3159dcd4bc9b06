"""The loop of the setup file that a tuning writes: its plant, its scenario, and what it does there.

Margins come from linearising the controller. Whatever is said about a step, a load or an overload
comes from here: the controller as it is written runs on the plant as it is written, with delay, lag
of the actuator, friction, play, encoder and limits of u.

The scenario of a tuned setup file: a step of the reference, a load, and where each is judged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.base import limits_of
from quell.plants.base import Plant, measure
from quell.plants.linear import DelayedPlant, EncodedPlant, LinearPlant, delayed, lagged
from quell.plants.linearise import operating_point_of
from quell.plants.nonlinear import NonlinearPlant, checked_point
from quell.quantities import UNKNOWN, Signals
from quell.records.metrics import SETTLING_BAND, settling_time
from quell.records.trajectory import Trajectory
from quell.signals import Signal, Step, as_signal
from quell.simulation import Scenario, simulate
from quell.types import Vector

# ---- The operating point ----

# A step and a load take at most this share each of what u has left at rest, as both act in the end.
SHARE = 0.4
# A solution of A x + B u = −E w, C x = r within this share of its right side is one.
_SOLVED = 1e-6
# Smaller parts of a solution are rounding.
_ROUNDING = 1e-12
# Names of the times at which signals begin, in their tables.
_BEGINS = ("at", "start")


Limits = tuple[float, float]
"""u_min and u_max of the controller [u-unit], infinite where it has none."""


class Rest(NamedTuple):
    """An operating point: what holds the plant at rest there."""

    u: float  # [u-unit]
    y: float  # [y-unit]
    x0: tuple[float, ...] = ()  # state of the plant in the setup file; empty if it is not known
    w: tuple[float, ...] = ()  # its disturbances


def checked_rest(rest: Any) -> Rest | None:
    """Return the argument ``rest`` of ``tune``: None, (u, y) or a ``Rest``."""
    if rest is None or isinstance(rest, Rest):
        return rest
    u, y = checks.vector("rest", rest, 2).tolist()
    return Rest(u, y)


def rest_of_plant(plant: Any, dt: float, operating_point: Any = None) -> Rest | None:
    """Return the operating point of a nonlinear plant, as ``linear_part`` takes it; else None."""
    delayed: list[DelayedPlant] = []
    while isinstance(plant, DelayedPlant | EncodedPlant):
        delayed += [plant] if isinstance(plant, DelayedPlant) else []
        plant = plant.plant
    if operating_point is not None and hasattr(plant, "sampled"):
        x, u = checked_point(operating_point)
    elif isinstance(plant, NonlinearPlant):
        x, u = operating_point_of(plant)
    else:
        return None
    state = np.asarray(x, dtype=np.float64)
    y = float(measure(plant.sampled(dt, interpret=True), state))
    waiting = sum(each.order - each.plant.order for each in delayed)
    return Rest(float(u), y, (*state.tolist(), *[float(u)] * waiting), (0.0,) * plant.disturbances)


def rest_of_linear(linear: LinearPlant, rest: Rest) -> Rest:
    """Return state and disturbances that hold a linear plant at rest at (u, y).

    They solve ``A x + B u + E w = 0``, ``C x = y``, with the smallest ones if there are several.
    """
    n, m = linear.order, linear.disturbances
    matrix = np.block([[linear.A, linear.E], [linear.C, np.zeros((1, m))]])
    right = np.append(-linear.B[:, 0] * rest.u, rest.y)
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    found[np.abs(found) < _ROUNDING * np.max(np.abs(found), initial=0.0)] = 0.0
    return rest._replace(x0=tuple(found[:n].tolist()), w=tuple(found[n:].tolist()))


def rest_within(linear: LinearPlant, rest: Rest | None, limits: Limits) -> Rest | None:
    """Return an operating point within the limits of u: the given one, else zero or their middle.

    Raises ``ValueError`` for limits within which there is no such point.
    """
    low, high = limits
    at = 0.0 if rest is None else rest.u
    if low <= at <= high:
        return rest
    within = f"must lie within u_min = {low:g} and u_max = {high:g}"
    if rest is not None:
        raise ValueError(f"u at rest = {at:g}: {within}; no controller can hold the plant there")
    middle = 0.5 * (low + high)
    if not np.isfinite(middle) or np.linalg.matrix_rank(linear.A) < linear.order:
        raise ValueError(
            f"u at rest = 0: {within}; give u and y at rest: rest = (u, y), or --u-rest and "
            "--y-rest"
        )
    y = -float((linear.C @ np.linalg.solve(linear.A, linear.B))[0, 0]) * middle
    return Rest(middle, y)


def held_by(linear: LinearPlant, right: Vector) -> float:
    """Return u of a plant at rest, with ``A x + B u`` and ``C x`` as ``right`` (n + 1,) has them.

    Zero where there is none, as for a step of an axis.
    """
    matrix = np.block([[linear.A, linear.B], [linear.C, np.zeros((1, 1))]])
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    solved = np.linalg.norm(matrix @ found - right) <= _SOLVED * np.linalg.norm(right)
    return float(found[-1]) if solved else 0.0


def held_step(linear: LinearPlant) -> float:
    """Return the u that holds y at 1; zero for an axis, which needs none [u-unit/y-unit]."""
    return held_by(linear, np.append(np.zeros(linear.order), 1.0))


def held_load(linear: LinearPlant) -> float:
    """Return the u that holds y at zero under a first disturbance of 1; zero where none does."""
    if linear.disturbances == 0:
        return 0.0
    return held_by(linear, np.append(-linear.E[:, 0], 0.0))


def held_sizes(
    linear: LinearPlant, rest: Rest | None, limits: Limits, of_axis: float
) -> tuple[float, float]:
    """Return the sizes of a step of r [y-unit] and of the first load that u can hold, of 1 at most.

    At rest each needs 40 % of what the limits leave. A step that needs no u at rest, as that of an
    axis, uses 40 % of it on the way: ``of_axis`` is what a step of 1 needs [u-unit/y-unit]. A size
    is negative where u has more room on the other side, as that of a load on a heater at zero.
    """
    at = 0.0 if rest is None else rest.u
    low, high = limits
    sizes: list[float] = []
    for u in (held_step(linear), held_load(linear)):
        # How large a positive and a negative one may be.
        ends = (high - at, low - at) if u > 0.0 else (low - at, high - at)
        most = [1.0 if u == 0.0 else min(1.0, abs(SHARE * end / u)) for end in ends]
        size = most[0] if most[0] >= most[1] else -most[1]
        if not sizes and u == 0.0 and of_axis > 0.0:
            size = min(1.0, SHARE * min(high - at, at - low) / of_axis)
        sizes.append(float(f"{size:.2g}"))
    return sizes[0], sizes[1] if linear.disturbances else sizes[0]


# ---- Tables of plant and scenario, and their objects ----


def scenario_tables(
    last: float, disturbances: int, rest: Rest | None, sizes: tuple[float, float] = (1.0, 1.0)
) -> dict[str, Any]:
    """Return ``scenario`` and ``metrics``: a step, and later a load if there is an input for it.

    ``sizes`` are those of the step and the load.
    A loop at an operating point has half of ``last`` [s] to come to rest: the controller starts
    from u = 0.
    """
    half, step = 0.5 * last, {"kind": "step"}
    if rest is None:
        at, constant, y = 0.0, [0.0] * disturbances, 0.0
    else:
        at, y = half, rest.y
        constant = [*rest.w, *[0.0] * (disturbances - len(rest.w))]
    at, load_at, end = (float(f"{time:.6g}") for time in (at, at + half, at + last))
    begins: Mapping[str, Any] = {"at": at} if at else {}
    reference: Any = {**step, **begins, **_size(sizes[0])}
    scenario: dict[str, Any] = {"duration": end, "reference": [y, reference] if y else reference}
    if rest is not None and rest.x0:
        scenario["x0"] = list(rest.x0)
    if disturbances:
        load: Any = {**step, "at": load_at, **_size(sizes[1])}
        first = [constant[0], load] if constant[0] else load
        scenario["disturbances"] = [first, *constant[1:]]
    return {"scenario": scenario, "metrics": _windows([at, load_at] if disturbances else [at])}


def _size(size: float) -> dict[str, float]:
    return {} if size == 1.0 else {"height": size}


def windows_of(scenario: Mapping[str, Any]) -> list[dict[str, float]]:
    """Return windows of a scenario's table, from one beginning of a signal to the next."""
    times = {0.0}
    signals = [scenario.get("reference"), *scenario.get("disturbances", ())]
    for signal in signals:
        parts = signal if isinstance(signal, list | tuple) else [signal]
        for part in parts:
            known = part if isinstance(part, Mapping) else {}
            begins = (known.get(name) for name in _BEGINS)
            times |= {float(time) for time in begins if isinstance(time, float | int)}
    end = float(scenario.get("duration", np.inf))
    return _windows(sorted(time for time in times if 0.0 <= time < end))


def _windows(times: list[float]) -> list[dict[str, float]]:
    ends = [{"stop": later} for later in times[1:]]
    return [{"start": at, **end} for at, end in zip(times, [*ends, {}], strict=True)]


def late_tables(
    tables: Mapping[str, Any], plant: Plant, dt: float, delay: float = 0.0, lag: float = 0.0
) -> dict[str, Any]:
    """Return the tables of a setup whose plant is behind a lag of its actuator and a delay [s].

    ``plant`` is the one of the tables. Names, ranges, paths of a sweep and operating points stay
    those of the plant inside; a start gets zeros for the further states. Raises ``ValueError`` for
    a delay that the plant can't have.
    """
    found = dict(tables)
    if lag > 0.0:
        inner: Any = plant
        while isinstance(inner, DelayedPlant | EncodedPlant):
            inner = inner.plant
        found = _outside(found, {"kind": "lagged", "lag": lag}, inner.order, 1)
        plant = lagged(plant, lag)
    if delay > 0.0:
        more = delayed(plant, delay, dt).order - plant.order
        found = _outside(found, {"kind": "delayed", "delay": delay}, plant.order, more)
    return found


def _outside(
    tables: Mapping[str, Any], outer: dict[str, Any], at: int, more: int
) -> dict[str, Any]:
    """Return the tables with a plant around theirs that has ``more`` states, at place ``at``."""
    plant = tables["plant"]
    inner: dict[str, Any] = {"kind": plant} if isinstance(plant, str) else dict(plant)
    outer = dict(outer)
    if "signals" in inner:
        outer["signals"] = inner.pop("signals")
    if "uncertain" in inner:
        outer["uncertain"] = {f"plant.{key}": ends for key, ends in inner.pop("uncertain").items()}
    found = {**tables, "plant": outer | {"plant": inner}}
    scenario, sweep = tables.get("scenario"), tables.get("sweep")
    if isinstance(scenario, Mapping) and "x0" in scenario:
        x0 = [*scenario["x0"]]
        found["scenario"] = {**scenario, "x0": [*x0[:at], *[0.0] * more, *x0[at:]]}
    if isinstance(sweep, Mapping) and isinstance(sweep.get("parameters"), Mapping):
        moved = {
            f"plant.{key}" if key.startswith("plant.") else key: value
            for key, value in sweep["parameters"].items()
        }
        found["sweep"] = {**sweep, "parameters": moved}
    tune = tables.get("tune")
    if isinstance(tune, Mapping) and isinstance(tune.get("schedule"), Mapping):
        found["tune"] = {**tune, "schedule": _inside(tune["schedule"])}
    return found


def _inside(schedule: Mapping[str, Any]) -> dict[str, Any]:
    """Return the operating points of a plant for one that contains it as ``plant``."""
    if "parameter" in schedule:
        names = schedule["parameter"]
        moved = [f"plant.{each}" for each in ([names] if isinstance(names, str) else names)]
        return {**schedule, "parameter": moved[0] if isinstance(names, str) else moved}
    points = [{**each, "plant": {"plant": each["plant"]}} for each in schedule["points"]]
    return {**schedule, "points": points}


def plant_table(
    linear: LinearPlant, actuator_lag: float, delay: float, dt: float
) -> tuple[dict[str, Any], int]:
    """Return the table of a linear plant behind a lag and a delay [s] of u, sampled at ``dt`` [s].

    Beside it, how many states lag and delay append, which are u at rest.
    """
    table: dict[str, Any] = {
        "kind": "linear",
        "A": linear.A.tolist(),
        "B": linear.B[:, 0].tolist(),
        "C": linear.C[0].tolist(),
        "E": linear.E.tolist(),
    }
    plant, order = late_plant(linear, actuator_lag, delay, dt), linear.order
    found = late_tables({"plant": table}, linear, dt, delay, actuator_lag)
    return found["plant"], plant.order - order


def late_plant(plant: Plant, actuator_lag: float, delay: float, dt: float) -> Plant:
    """Return a plant behind a lag and a delay [s] of u, if there are any."""
    plant = lagged(plant, actuator_lag) if actuator_lag > 0.0 else plant
    return delayed(plant, delay, dt) if delay > 0.0 else plant


def scenario_of(table: Mapping[str, Any]) -> Scenario:
    """Return the scenario of a table that ``scenario_tables`` made."""

    def signal(part: Any) -> Signal:
        if isinstance(part, list):
            first, second = map(signal, part)
            return first + second
        if isinstance(part, Mapping):
            return Step(**{key: value for key, value in part.items() if key != "kind"})
        return as_signal(part)

    loads = tuple(map(signal, table.get("disturbances", ())))
    return Scenario(signal(table["reference"]), table["duration"], loads, x0=table.get("x0"))


# ---- What the written loop does ----

# Samples up to which a run is plain Python: that takes as long as code that is loaded from the disk
# cache; a longer run is compiled.
_AS_PYTHON = 2500
# Changes of a signal that are not beside others are steps, up to so many in a scenario.
_MOST_STEPS = 50
# Three standard deviations of the noise of y belong to the settling band.
_NOISE_BAND = 3.0
# Share of the samples at a limit in the last fifth of a run from which on the loop cycles there.
_AT_LIMIT, _LAST = 0.2, 5
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

    def __str__(self) -> str:
        """Return the figures as a sentence."""
        unit = f" {self.signals.y.unit}" if self.signals.y.unit else ""
        begin = f"step of the reference by {self.size:.4g}{unit} at {self.at:.4g} s"
        if not math.isfinite(self.overshoot):
            return f"NOT stable: {begin}: y diverges"
        text = f"{begin}: overshoots by {100.0 * self.overshoot:.1f} %"
        wide = self.band > 1.1 * SETTLING_BAND
        band = f"{100.0 * (self.band if wide else SETTLING_BAND):.2g} %"
        if math.isnan(self.settling):
            return f"NOT settled: {text}; not within {band} at the end of its {self.looked:.3g} s"
        if wide:
            band += " (with three deviations of the noise)"
        return f"{text}, settles within {band} in {self.settling:.3g} s"


class MoveFigures(NamedTuple):
    """What the written loop does along a reference that moves from sample to sample."""

    largest: float  #: largest ``|r − y|`` in the scenario [y-unit]; infinite if y diverges
    last: float  #: the same in its last tenth [y-unit]
    signals: Signals = UNKNOWN

    def __str__(self) -> str:
        """Return the figures as a sentence."""
        if not math.isfinite(self.largest):
            return "NOT stable: y diverges in the scenario"
        unit = f" {self.signals.y.unit}" if self.signals.y.unit else ""
        return (
            f"scenario: the largest |r − y| is {self.largest:.3g}{unit}, {self.last:.3g}{unit} in "
            "its last tenth"
        )


class Overload(NamedTuple):
    """What the written loop does after a load that u can't hold."""

    load: float  # size of the disturbance
    duration: float  # [s]
    peak: float  # largest error [y-unit]
    back: float  # time from its end until the error stays within 2 % of the largest; NaN if never
    usual: float  # the same after a load that u can hold [s]

    @property
    def passes(self) -> bool:
        """Whether y comes back, and not slowly."""
        return self.back <= _SLOW * (self.duration + self.usual)

    def __str__(self) -> str:
        """Return it as a part of a sentence."""
        how = "never" if math.isnan(self.back) else f"in {self.back:.3g} s"
        return f"{self.load:.3g} for {self.duration:.3g} s: back {how}"


@dataclass(frozen=True, eq=False)
class Written:
    """Plant and scenario of the file, in which controllers are judged.

    ``scenario`` is None for ``quell.tune`` where the file has none: it makes one.
    """

    plant: Plant
    scenario: Any  # Scenario | None
    dt: float

    def run(self, controller: Any, scenario: Scenario | None = None) -> Trajectory:
        """Run a controller through the scenario, or another one."""
        scenario = scenario or self.scenario
        short = scenario.duration <= _AS_PYTHON * self.dt
        found: Trajectory = simulate(self.plant, controller, scenario, interpret=short)
        return found

    @cached_property
    def noise(self) -> float:
        """Standard deviation of the noise of y in a sample [y-unit]."""
        signals = self.scenario.seeded_signals(self.plant.disturbances)
        return float(np.std(signals[2](self._t[:_AS_PYTHON])))

    @cached_property
    def _t(self) -> Vector:
        return np.arange(round(self.scenario.duration / self.dt) + 1) * self.dt

    @cached_property
    def _start(self) -> float:
        """The y of the plant at the start."""
        x0 = self.scenario.x0
        x: Vector = np.zeros(self.plant.order) if x0 is None else np.asarray(x0, dtype=np.float64)
        return float(measure(self.plant.sampled(self.dt, interpret=True), x))

    @cached_property
    def _events(self) -> tuple[tuple[int, float], ...] | None:
        """Samples at which a signal steps, with the size of a step of r; None if r moves."""
        r, loads, _ = self.scenario.seeded_signals(self.plant.disturbances)
        values = r(self._t)
        sizes = np.diff(values, prepend=self._start)
        at = np.flatnonzero(sizes)
        if at.size > _MOST_STEPS or np.any(np.diff(at) == 1):
            return None
        found = {int(k): float(sizes[k]) for k in at}
        for load in loads:
            jumps = np.flatnonzero(np.diff(load(self._t), prepend=0.0))
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

    def figures(self, controller: Any, run: Trajectory) -> StepFigures | None:
        """Return what a run does after the largest step of the reference; None if it has none."""
        if self.largest is None:
            return None
        first, end, size = self.largest
        end = min(end, len(run))
        band, looked = SETTLING_BAND + _NOISE_BAND * self.noise / abs(size), (end - first) * self.dt
        at, signals = first * self.dt, run.signals
        if run.diverged or end <= first:
            return StepFigures(size, at, math.inf, math.nan, band, looked, 0.0, signals)
        y, u, r = (run[name][first:end] for name in ("y", "u", "r"))
        goal, t = float(r[0]), self._t[first:end]
        # As far as it was looked at: of a step that does not settle the text says so.
        move = (goal - float(y[0])) or size  # as in the metrics of a run
        over = max(float(np.max((y - goal) / move)), 0.0)
        settling = settling_time(t, y, goal, band, goal - move)
        limited = float(np.sum(_limited(u, controller))) * self.dt
        return StepFigures(size, at, over, settling, band, looked, limited, signals)

    def along(self, run: Trajectory) -> MoveFigures:
        """Return how far a run is from its reference."""
        if run.diverged:
            return MoveFigures(math.inf, math.inf, run.signals)
        error = np.abs(run["r"] - run["y"])
        last = float(np.max(error[-max(len(run) // 10, 1) :]))
        return MoveFigures(float(np.max(error)), last, run.signals)

    def until_settled(self, scenario_end: float) -> Scenario:
        """Return the scenario up to a time [s], without starts from rest after that."""
        rests = [time for time in np.ravel(self.scenario.rest_at) if time < scenario_end]
        last = min(scenario_end, self.scenario.duration)
        return replace(self.scenario, duration=last, rest_at=tuple(rests))

    def stepping(self, size: float, last: float, before: int) -> Written:
        """Return the same loop with a step of the reference alone, for a scenario without one.

        It comes after ``before`` samples, from rest, and is looked at for ``last`` seconds.
        """
        t0, at = np.zeros(1), before * self.dt
        r, loads, _ = self.scenario.seeded_signals(self.plant.disturbances)
        rest = replace(
            self.scenario,
            reference=float(r(t0)[0]) + Step(size, at),
            disturbances=[float(load(t0)[0]) for load in loads],
            duration=at + max(round(last / self.dt), before) * self.dt,
            rest_at=(),
        )
        return replace(self, scenario=rest)

    def cycles(self, controller: Any, run: Trajectory) -> bool:
        """Return whether u still goes from limit to limit at the end of a run."""
        last = run["u"][-(len(run) // _LAST) :]
        low, high = limits_of(controller)
        at = last <= low, last >= high
        return bool(np.mean(at[0] | at[1]) > _AT_LIMIT and np.any(at[0]) and np.any(at[1]))

    def overloads(
        self, controller: Any, step: StepFigures | None, tau: float, held: float
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
            u that holds a first disturbance of 1.
        """
        begin = _CONSTANTS[0] * tau
        if step is not None and self.largest is not None:
            first, end, _ = self.largest
            settled = max(2.0 * step.settling, begin)
            begin = first * self.dt + min(settled, 0.9 * (end - first) * self.dt)
        begin = max(round(begin / self.dt), 1) * self.dt
        before = self.until_settled(begin)
        given = as_signal(self.scenario.seeded_signals(self.plant.disturbances)[0])
        reference = given.until(begin, float(given(begin)))
        loads = [as_signal(each) for each in before.disturbances] or [as_signal(0.0)]
        rest = float(np.mean(self.run(controller, before)["u"][-10:]))
        low, high = limits_of(controller)
        room = high - rest if math.isfinite(high) else low - rest
        if not room or not math.isfinite(room):
            return []
        found, calm = [], loads[0](begin)

        def trial(share: float, duration: float, last: float) -> tuple[float, float]:
            """Return the largest error and the time until y is back."""
            end = begin + round(duration / self.dt) * self.dt
            size = share * room / held
            load = loads[0].until(begin, float(calm) + size).until(end, float(calm))
            scenario = replace(
                before,
                reference=reference,
                duration=round((end + last) / self.dt) * self.dt,
                disturbances=(load, *loads[1:]),
            )
            run = self.run(controller, scenario)
            if run.diverged:
                return math.inf, math.nan
            error = np.abs(run["y"] - run["r"])[round(begin / self.dt) :]
            after = round((end - begin) / self.dt)
            peak = float(np.max(error))
            outside = np.flatnonzero(error > max(_BACK * peak, _NOISE_BAND * self.noise))
            if outside.size and outside[-1] == error.size - 1:
                return peak, math.nan
            return peak, max(float(outside[-1] + 1 - after) * self.dt, 0.0) if outside.size else 0.0

        for times in _CONSTANTS:
            duration = max(times * tau, self.dt)
            last = 40.0 * tau
            usual = trial(_HELD, duration, last)[1]
            usual = last if math.isnan(usual) else usual
            peak, back = trial(_OVERLOAD, duration, 1.5 * _SLOW * (duration + usual))
            found.append(Overload(_OVERLOAD * room / held, duration, peak, back, usual))
        return found


def _limited(u: Vector, controller: Any) -> Any:
    """Return which samples of u are at a limit."""
    low, high = limits_of(controller)
    return (u <= low) | (u >= high)
