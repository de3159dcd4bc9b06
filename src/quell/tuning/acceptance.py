"""Whether tuned loops are accepted as they are written: their steps, overloads and limits.

Limits of u are not in the loop that was tuned. So each design that may be chosen runs in the file
that would be written: with its prefilter through the scenario, and with loads that u can't hold. A
loop that is conditionally stable, or whose observer models another plant, may cycle there between
the limits, or take long until it is back.

So do all tuned results: single loops, those with a compensator, at the points of a schedule and of
several axes; and a controller that is meant for a set of plants, for some of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from quell.analysis.loop import LoopAnalysis
from quell.controllers.base import Controller
from quell.controllers.prefilters import Prefiltered, ReferenceModel
from quell.plants.linear import LinearPlant
from quell.simulation import Scenario
from quell.tuning import reference
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.structures.base import Model, resonances
from quell.tuning.tables import SHARE, held_load, held_state, held_step, late_plant
from quell.tuning.written import (
    MOST_OVERSHOOT,
    MoveFigures,
    Overload,
    StepFigures,
    Written,
    bounded,
    figures_table,
)
from quell.types import Matrix, Vector

# Where the scenario has no step: how long one is looked at, in time constants of the loop, and the
# time before it, in samples.
_LOOKED, _BEFORE = 150.0, 10
# The first reference model that is tried at limits, in units of the bandwidth of the loop.
FASTEST_MODEL = 3.0
# Plants of a set in which a controller is run at most: those of the most and the least gain and
# phase at the crossover come first.
_MOST_PLANTS = 8
WORSE = 1.5
"""A design that fails gives way to one whose objective is at most so many times its own."""
Design = TypeVar("Design")


class Loop(NamedTuple):
    """What is known of the tuned loop of a design."""

    written: Written
    linear: LinearPlant  # the first plant, without delay and lag
    model: Model | None  # None where no prefilter is added
    plants: PlantSet
    limits: tuple[float, float]  # of u
    rest: float  # u at rest
    shaped: bool  # whether a prefilter is added where the step needs one


class Seen(NamedTuple):
    """What a controller does in one scenario with one plant, or of one axis."""

    name: str  # empty for that of the file
    step: StepFigures | None  # after the largest step of the scenario; None if its r moves
    move: MoveFigures | None  # along a reference that moves
    overloads: tuple[Overload, ...]
    failures: tuple[str, ...]  # lines that begin with NOT
    prefilter: Any = None  # of an axis

    def __str__(self) -> str:
        """Return its step or move as a line, with the name and the prefilter behind it."""
        what = str(self.move if self.step is None else self.step)
        what += f" ({self.name})" if self.name else ""
        if self.prefilter is not None:
            what += f", behind the prefilter {_described(self.prefilter)}"
        return what

    def to_json(self) -> dict[str, Any]:
        """Return it as a table."""
        step, move = (None if each is None else figures_table(each) for each in self[1:3])
        loads = [each.to_json() for each in self.overloads]
        found = {"name": self.name, "step": step, "move": move, "overloads": loads}
        if self.prefilter is not None:
            found["prefilter"] = prefilter_table(self.prefilter)
        return found


class Judged(NamedTuple):
    """A design in the file that is written."""

    controller: Any  #: with its prefilter
    prefilter: Any  #: None if it has none
    step: StepFigures | None  #: after the largest step of the scenario; None if its r moves
    move: MoveFigures | None  #: along a reference that moves
    offered: ReferenceModel | None  #: a prefilter that is not in the file
    offered_step: StepFigures | None  #: what the step is with it
    overloads: tuple[Overload, ...]  #: after loads that u can't hold
    failures: tuple[str, ...]  #: lines that begin with NOT
    others: tuple[Seen, ...] = ()  #: with other plants or at other points; or the axes
    several: str = ""  #: what the others are
    larger: StepFigures | None = None  #: after nearly the largest step that u can hold

    def __str__(self) -> str:
        """Return what was found, in lines."""
        lines = [] if self.move is None else [str(self.move)]
        if self.step is not None:
            text = str(self.step)
            if self.prefilter is not None:
                text += f", behind the [prefilter] {_described(self.prefilter)}"
            if self.offered is not None and self.offered_step is not None:
                step = self.offered_step
                text += (
                    f"; with a prefilter ([prefilter] {_described(self.offered)}) it overshoots by "
                    f"{100.0 * step.overshoot:.1f} % and settles in {step.settling:.3g} s"
                )
            lines.append(text)
        if self.larger is not None:
            lines.append(f"one near what u can hold: {self.larger}".replace(": NOT", ", NOT"))
        if self.overloads:
            loads = "; ".join(str(each) for each in self.overloads)
            lines.append(f"overload, a load of 1.4 times what u can hold: {loads}")
        if self.several:
            lines.append(f"{self.several}: {_together(self.others)}")
        else:
            lines[:0] = map(str, self.others)
        lines += [line for line in self.failures if line not in lines]
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Return step, overloads and failures for ``quell.files.write_json``."""
        step = self.step
        found = None if step is None else {**figures_table(step), "prefilter": None}
        if found is not None:
            if self.prefilter is not None:
                found["prefilter"] = prefilter_table(self.prefilter)
            found["prefilter_omega"] = getattr(self.offered, "omega", None)
        loads = [each.to_json() for each in self.overloads]
        told: dict[str, Any] = {"reference_step": found, "overloads": loads}
        told["not"] = list(self.failures)
        if self.others:
            told["others"] = [each.to_json() for each in self.others]
        return told


def _described(prefilter: Any) -> str:
    """Return the keys of a prefilter's table."""
    return ", ".join(
        f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value:.4g}"
        for key, value in prefilter_table(prefilter).items()
    )


def prefilter_table(prefilter: Any) -> dict[str, Any]:
    """Return the table of a prefilter in a setup file."""
    model = isinstance(prefilter, ReferenceModel)
    without = {"rate_limit": math.inf, "smoothing": 0.0}
    known = {key: value for key, value in vars(prefilter).items() if value != without.get(key)}
    return {"kind": "reference-model" if model else "profile-generator"} | known


def with_prefilter(tables: Mapping[str, Any], prefilter: Any) -> dict[str, Any]:
    """Return tables of a setup file with that of a prefilter, if there is one they do not have."""
    if prefilter is None or "prefilter" in tables:
        return dict(tables)
    return {"prefilter": prefilter_table(prefilter), **tables}


def time_constant(analysis: LoopAnalysis, plants: PlantSet) -> float:
    """Return 1/ω_c of a loop with its gain crossover ω_c [s]."""
    omega = analysis.margins.phase_omega
    return 1.0 / (omega if math.isfinite(omega) and omega > 0.0 else plants.crossover)


def axis_of(linear: LinearPlant | None, tau: float, plants: PlantSet) -> reference.Axis | None:
    """Return the rigid part of a plant that needs no u at rest; None for another one.

    ``tau`` is the time constant of the closed loop [s].
    """
    if linear is None:
        return None
    gain = abs(complex(plants.responses(np.array([1.0 / tau]))[0, 0]))
    return reference.Axis.of(linear, 1.0 / gain)


def judge(loop: Loop, controller: Controller, analysis: LoopAnalysis) -> Judged:
    """Return what a controller does in the file that would be written, and with other plants."""
    tau = time_constant(analysis, loop.plants)
    axis, limits = axis_of(loop.linear, tau, loop.plants), loop.limits
    limited = math.isfinite(limits[0]) or math.isfinite(limits[1])
    both = math.isfinite(limits[1] - limits[0])
    written = loop.written
    if written.largest is None and not written.moves:
        needed = axis.needs(tau) if axis is not None else abs(held_step(loop.linear))
        room = min(limits[1] - loop.rest, loop.rest - limits[0])
        size = SHARE * room / needed if both and needed > 0.0 else 1.0
        written = written.stepping(float(f"{size:.2g}"), _LOOKED * tau, _BEFORE)
    prefilter, offered, offered_step = None, None, None
    if loop.shaped and both and axis is not None:
        modes = [] if loop.model is None else resonances(loop.model)
        period = 2.0 * math.pi / modes[0] if modes else 0.0
        room = reference.room_of_u(written, loop.linear, limits, loop.rest)
        every = [axis, *(axis_of(each.linear, tau, loop.plants) for each in written.others)]
        heaviest = reference.Axis.heaviest([each for each in every if each is not None])
        found = reference.Shaped(None, None)
        if not modes or written.largest is not None:
            found = reference.profile_for(written, controller, heaviest, tau, room, period)
        if modes:
            fastest = FASTEST_MODEL * reference.ORDER_OF_AXIS / tau
            model = reference.reference_model_for(
                written, controller, fastest, reference.ORDER_OF_AXIS
            )
            if found.step is None or (
                model.step is not None and model.step.settling < found.step.settling
            ):
                found = model
        prefilter = found.prefilter
    process = loop.shaped and both and axis is None and written.largest is not None
    if prefilter is None and written.largest is not None:
        step = reference.worst_step(written, controller)
        if step.overshoot > MOST_OVERSHOOT:
            if loop.shaped and limited:
                model = reference.reference_model_for(
                    written, controller, FASTEST_MODEL / tau, within=not process
                )
                prefilter = model.prefilter
            elif not limited and math.isfinite(step.overshoot):
                offered, offered_step = _offer(written, loop.plants, controller, tau)
    larger = None
    if process:
        most = reference.largest_step(written, loop.linear, limits, loop.rest)
        prefilter, larger = reference.bounded_rate(written, controller, prefilter, most, tau)
    whole = controller if prefilter is None else Prefiltered(controller, prefilter)
    held = np.array([[held_load(loop.linear)]])
    remedy = ""
    if loop.shaped:
        remedy = (
            "no prefilter was found with which the step overshoots less at the limits of u; give a "
            "smaller step, or move the reference slowly"
        )
    own = _seen(written, whole, tau, held, remedy)
    others, failures, several = tuple[Seen, ...](), own.failures, ""
    if both and not failures and written.others:
        others = tuple(
            _seen(each, whole, tau, held, remedy, runs=[each.run(whole)]) for each in written.others
        )
        failures = _of_others(others)
        several = f"with {len(others)} {written.of_others}"
    rest = offered, offered_step, own.overloads, failures, others, several, larger
    return Judged(whole, prefilter, own.step, own.move, *rest)


def quick_without(loop: Loop, controller: Controller, analysis: LoopAnalysis) -> bool:
    """Return whether steps of a process overshoot little at the limits of u, without prefilter."""
    if loop.written.largest is None or not math.isfinite(loop.limits[1] - loop.limits[0]):
        return False
    tau = time_constant(analysis, loop.plants)
    if axis_of(loop.linear, tau, loop.plants) is not None:
        return False
    most = reference.largest_step(loop.written, loop.linear, loop.limits, loop.rest)
    return reference.needs_none(loop.written, controller, most, tau)


def judge_axes(
    written: Written,
    controller: Any,
    tau: float,
    held: Matrix,
    size: Vector,
    with_prefilters: Callable[[Any, Sequence[Written]], Any],
) -> Judged:
    """Return what a controller of several axes does in the file, each axis and after overloads.

    Parameters
    ----------
    written
        plant and scenario.
    controller
        as it is written.
    tau
        time constant of the slowest axis [s].
    held
        u that holds each disturbance of 1 (m, q).
    size
        step of each reference (n,) for a scenario in which none steps or moves.
    with_prefilters
        function of the controller and the file of each axis that returns it behind prefilters, or
        None; it is called where a step overshoots, or needs the limits of u.
    """
    axes = [replace(written, axis=i) for i in range(len(controller.names))]
    before = _BEFORE
    if written.scenario.x0 is not None:  # comes to rest first
        before = max(round(_LOOKED / 5.0 * tau / written.dt), _BEFORE)
    of_file = any(each.largest or each.moves for each in axes)
    if not of_file:
        axes = [
            each.stepping(float(f"{step:.2g}"), _LOOKED * tau, before)
            for each, step in zip(axes, size.tolist(), strict=True)
        ]
    seen = _axes_seen(axes, controller, tau)
    if of_file and bounded(controller) and any(_needs_prefilter(each, written.dt) for each in seen):
        shaped = with_prefilters(controller, axes)
        if shaped is not None:
            controller, seen = shaped, _axes_seen(axes, shaped, tau)
    failures = tuple(dict.fromkeys(line for each in seen for line in each.failures))
    over = [
        f"{100.0 * each.step.overshoot:.1f} % of {each.name}"
        for each in seen
        if each.step is not None and each.step.overshoot > 1.2 * MOST_OVERSHOOT
    ]
    if of_file and over and not failures and bounded(controller):
        failures = (
            f"NOT below {100.0 * MOST_OVERSHOOT:.0f} %: steps overshoot by {', '.join(over)}; no "
            "prefilters were found with which they do less: give references that the actuators can "
            "follow (LimitedMove), smaller steps, or bound the loop more (M_ks)",
        )
    overloads: list[Overload] = []
    if bounded(controller) and not failures:
        calm = axes[0].stepping(0.0, _LOOKED * tau, before)
        overloads = calm.overloads(controller, None, tau, held)
        failures = tuple(_slow(each) for each in overloads if not each.passes)
    rest = None, None, tuple(overloads), failures, tuple(seen)
    return Judged(controller, None, None, None, *rest)


def _axes_seen(axes: Sequence[Written], controller: Any, tau: float) -> list[Seen]:
    """Return what each axis does in its file; files of one scenario are one run."""
    seen, runs = [], dict[int, Any]()
    for axis, name, shaper in zip(axes, controller.names, controller.prefilters, strict=True):
        key = id(axis.scenario)
        runs[key] = runs[key] if key in runs else axis.runs(controller)
        found = _seen(axis, controller, tau, np.zeros(1), "", name, runs[key])
        seen.append(found._replace(prefilter=shaper))
    return seen


def _needs_prefilter(axis: Seen, dt: float) -> bool:
    """Return whether a step overshoots, does not settle, or needs the limits of u."""
    step = axis.step
    if step is None or axis.prefilter is not None:
        return False
    over = not step.overshoot <= MOST_OVERSHOOT or math.isnan(step.settling)
    return over or step.limited > reference.few_at_limits(step.settling, dt)


def _seen(
    written: Written,
    controller: Any,
    tau: float,
    held: Matrix,
    remedy: str,
    name: str = "",
    runs: Sequence[Any] | None = None,
) -> Seen:
    """Return what a controller does in a scenario, and where u has limits after overloads.

    ``remedy`` is what to do where the step overshoots; empty where that is no failure. ``runs``
    are the run through the scenario and those with other draws of its noise, if there are any.
    """
    name, runs = name or written.name, written.runs(controller) if runs is None else runs
    step, move = written.of_draws(controller, runs)
    first, limited = str(move if step is None else step), bounded(controller)
    failures = [first] if first.startswith("NOT") else []
    over = 0.0 if step is None else step.overshoot
    if not failures and remedy and limited and over > 1.2 * MOST_OVERSHOOT:
        failures.append(
            f"NOT below {100.0 * MOST_OVERSHOOT:.0f} %: the step overshoots by {100.0 * over:.1f} "
            f"%: {remedy}"
        )
    if limited and written.cycles(controller, runs[0]):
        failures.append(
            "NOT at rest: at the end of the scenario u still goes from limit to limit; bound the "
            "loop more (M_ks, M_s), or give a smaller step"
        )
    overloads: list[Overload] = []
    if limited and np.any(held) and not failures:
        overloads = written.overloads(controller, step, tau, held)
        failures += [_slow(each) for each in overloads if not each.passes]
    named = tuple(f"{line} ({name})" if name else line for line in failures)
    return Seen(name, step, move, tuple(overloads), named)


def _of_others(others: Sequence[Seen]) -> tuple[str, ...]:
    """Return the first failure with other plants, and with how many of them there are some."""
    failing = [each for each in others if each.failures]
    if not failing:
        return ()
    count = f"; {len(failing)} of {len(others)} fail" if len(others) > 1 else ""
    return (f"{failing[0].failures[0]}{count}",)


def _together(others: Sequence[Seen]) -> str:
    """Return the worst figures of several as a part of a sentence."""
    parts = []
    steps = [each.step for each in others if each.step is not None]
    if steps:
        worst = max(steps, key=lambda step: step.overshoot)
        times = [step.settling for step in steps]
        until = "not all settle" if np.isnan(times).any() else f"settles in {max(times):.3g} s"
        parts.append(f"overshoots by {100.0 * worst.overshoot:.1f} %, {until} at most")
    moves = [each.move.largest for each in others if each.move is not None]
    if moves:
        parts.append(f"the largest |r − y| is {max(moves):.3g}")
    times = [load.back for each in others for load in each.overloads]
    if times:
        never = np.isnan(times).any()
        back = "not back from all overloads" if never else f"back in {max(times):.3g} s"
        parts.append(back if never else f"{back} after overloads at most")
    return "; ".join(parts)


def accepted(
    first: Design, others: Iterable[Design], judged: Callable[[Design], Judged], name: str
) -> tuple[Design, Judged, str]:
    """Return the first design that is accepted at the limits of u, what it does, what is left out.

    ``others`` are those that may take the place of ``first``, whose ``name`` stands in the text.
    Where none is accepted it is ``first``.
    """
    found = judged(first)
    for each in others if found.failures else ():
        other = judged(each)
        if not other.failures:
            return each, other, f"{name} is left out: {found.failures[0]}"
    return first, found, ""


def conditionally_stable(gains: Iterable[tuple[float, float]], of: str = "") -> list[str]:
    """Return a line with the least and the largest gain of loops, where a least one is needed.

    ``gains`` are the margins of gain of stable loops, ``of`` says what the gain is one of.
    """
    ends = np.array(list(gains)).reshape(-1, 2)
    if ends.size == 0 or not np.max(ends[:, 0]) > 0.0:
        return []
    low, high = float(np.max(ends[:, 0])), float(np.min(ends[:, 1]))
    return [f"conditionally stable: it bears {low:.3g} to {high:.3g} times its gain{of}"]


def place_of(
    file: Written,
    linear: LinearPlant,
    late: tuple[float, float],
    name: str,
    at: tuple[float, ...] = (),
) -> Written:
    """Return another plant in the scenario of a file, at rest where the file's is.

    ``late`` are the lag of the actuator and the delay [s], ``at`` the signals of a schedule at
    which the controller is held.
    """
    scenario = replace(file.scenario, schedule=()) if at else file.scenario
    if linear.disturbances == 0:
        linear = LinearPlant(linear.A, linear.B, linear.C)
    plant = late_plant(linear, *late, file.dt)
    if scenario.x0 is not None:
        w = [float(load(0.0)) for load in file.loads]
        x, u = held_state(linear, file.start, w)
        scenario = replace(scenario, x0=[*x, *[u] * (plant.order - linear.order)])
    return Written(plant, scenario, file.dt, name=name, at=at, linear=linear)


def with_others(
    file: Written, linear: Sequence[LinearPlant], late: Sequence[tuple[float, float]], of: PlantSet
) -> Written:
    """Return the file with other plants of a set, for which the controller is meant, too.

    ``linear`` and ``late`` are the plants without the factors of their gain.
    """
    if len(of.plants) == 1:
        return file
    at = of.responses(np.array([of.crossover]))[:, 0]
    sizes, phases = np.abs(at), np.angle(at / at[0])
    first = [int(pick(values)) for values in (sizes, phases) for pick in (np.argmax, np.argmin)]
    spread = np.linspace(1, len(of.plants) - 1, min(_MOST_PLANTS, len(of.plants) - 1))
    members = dict.fromkeys([*first, *np.unique(np.round(spread).astype(int)).tolist()])
    chosen = [i for i in members if i != 0][:_MOST_PLANTS]
    others = []
    for i in chosen:
        j, factor = i % len(linear), float(of.factors[i])
        plant = linear[j]
        if factor != 1.0:
            plant = LinearPlant(plant.A, factor * plant.B, plant.C, factor * plant.E)
        others.append(place_of(file, plant, late[j], f"plant {i + 1} of the set"))
    what = f"other plants of the set of {len(of.plants)}, linear"
    return replace(file, others=tuple(others), of_others=what)


def file_without_step(plant: Any, dt: float, axes: int = 0) -> Written:
    """Return a plant in a scenario in which nothing happens yet, for one that has no file."""
    scenario = Scenario([0.0] * axes if axes else 0.0, duration=_BEFORE * dt)
    return Written(plant, scenario, dt)


def _slow(each: Overload) -> str:
    return (
        f"NOT soon back after an overload: a load of {each}, after one that u can hold in "
        f"{each.usual:.3g} s; bound the loop more (M_ks, M_s), or keep such loads away"
    )


def _offer(
    written: Written, plants: PlantSet, controller: Controller, tau: float
) -> tuple[ReferenceModel | None, StepFigures | None]:
    """Return a prefilter for a loop without limits of u, and the step with it."""
    model = None
    if not getattr(controller, "derivatives", 0) and not written.others:
        model = reference.model_of_linear_step(plants, controller)
    if model is None:
        model = reference.reference_model_for(written, controller, FASTEST_MODEL / tau).prefilter
    if model is None:
        return None, None
    shaped = Prefiltered(controller, model)
    return model, written.figures(shaped, written.run(shaped))
