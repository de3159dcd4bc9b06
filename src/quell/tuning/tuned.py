"""The result of a tuning."""

from __future__ import annotations

import inspect
import itertools
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from quell import checks
from quell.analysis.loop import LoopAnalysis
from quell.controllers.feedforward import Feedforward
from quell.files import nonfinite_to_none, written_atomically
from quell.parallel import one_blas_thread
from quell.quantities import UNKNOWN, Signals
from quell.records.notebook import InNotebook
from quell.records.plotting import given_axes
from quell.sweeping.runs import latin_hypercube
from quell.sweeping.sweep import share_interval
from quell.tuning import report
from quell.tuning.acceptance import Judged, Loop, conditionally_stable, judge, with_prefilter
from quell.tuning.constraints import Constraints
from quell.tuning.designs import Task, noise_curve, tradeoff
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.optimiser.requirements import all_peaks, beside_poles, closed_loop_poles, counted
from quell.tuning.optimiser.search import Problem, Solution
from quell.tuning.report import Design, draw, toml_text
from quell.tuning.simulated import Checked, Search
from quell.tuning.structures.base import resonances
from quell.tuning.written import StepFigures
from quell.types import Matrix, Vector

# With more parameters, the corners of their box are not all in the set.
_MOST_CORNERS = 4
# A constraint counts as kept on a fresh sample up to this share beyond its limit: a result keeps to
# its limits within 0.1 %.
_TOLERANCE = 1e-3


def checked_range(name: str, ends: Any) -> tuple[float, float]:
    """Return the ends of the range of a parameter; ``ValueError`` unless low is below high."""
    low, high = checks.vector(f"uncertain.{name}", ends, 2).tolist()
    if not low < high:
        raise ValueError(f"uncertain.{name} = {ends!r}: must be [low, high], low below high")
    return low, high


@dataclass(frozen=True)
class Uncertain:
    """Ranges of a plant's parameters.

    Parameters
    ----------
    make
        returns a plant for values of the parameters, by name.
    ranges
        lowest and highest value of each parameter.
    """

    make: Any  # Callable[..., Any]; checked below
    ranges: Mapping[str, tuple[float, float]]

    def __post_init__(self) -> None:
        if not self.ranges:
            raise ValueError("uncertain = {}: must have at least one parameter")
        if not callable(self.make):
            rule = "with uncertain it must be a function that returns a plant for its parameters"
            raise ValueError(f"plant = {self.make!r:.80}: {rule}")
        try:
            inspect.signature(self.make).bind(**self.ranges)
        except TypeError as error:
            raise ValueError(f"uncertain: plant can't be called with these: {error}") from None
        for name, ends in self.ranges.items():
            checked_range(name, ends)

    @property
    def ends(self) -> Matrix:
        """Lowest and highest values (parameters, 2)."""
        return np.array([tuple(map(float, pair)) for pair in self.ranges.values()])

    def plants(self, values: Matrix) -> list[Any]:
        """Return a plant for each row of values (k, parameters)."""
        names = list(self.ranges)
        return [self.make(**dict(zip(names, row, strict=True))) for row in values.tolist()]

    def design_set(self, count: int, seed: int) -> Matrix:
        """Return the values to design for: the middle, the corners, a Latin hypercube."""
        ends = self.ends
        low, high = ends[:, 0], ends[:, 1]
        rows = [0.5 * (low + high)]
        if low.size <= _MOST_CORNERS:
            rows += [np.array(corner) for corner in itertools.product(*ends)]
        rest = count - len(rows)
        if rest > 0:
            cube = latin_hypercube(np.random.default_rng(seed), rest, low.size)
            rows += list(low + cube * (high - low))
        return np.array(rows)

    def fresh(self, count: int, seed: int) -> Matrix:
        """Return uniform values that the design did not have."""
        ends = self.ends
        draws = np.random.default_rng([seed, 1]).random((count, ends.shape[0]))
        return ends[:, 0] + draws * (ends[:, 1] - ends[:, 0])


@dataclass(frozen=True)
class Check:
    """A result on fresh samples of the plant.

    Attributes
    ----------
    samples
        number of plants.
    unstable, violating
        how many loops are unstable, and how many are, or exceed a limit.
    interval
        95 % interval of the share that violates (Clopper & Pearson 1934).
    worst
        largest measures of the stable loops, ``M_s``, …
    worst_values
        the parameters of the plant with the largest excess.
    of
        what was drawn.
    """

    samples: int
    unstable: int
    violating: int
    interval: tuple[float, float]
    worst: Mapping[str, float] = field(default_factory=dict)
    worst_values: Mapping[str, float] = field(default_factory=dict)
    of: str = "fresh samples"

    def __str__(self) -> str:
        """Return the check as a sentence."""
        low, high = (100.0 * end for end in self.interval)
        worst = ", ".join(f"{name} {value:.4g}" for name, value in self.worst.items())
        return (
            f"{self.samples} {self.of}: {self.violating} exceed a limit, {self.unstable} of "
            f"them unstable; a share of {low:.2g} to {high:.2g} % (95 % interval)"
            + (f". Largest: {worst}" if worst else "")
        )


def checked(
    problem: Problem, solution: Solution, plants: PlantSet, values: Matrix, names: list[str]
) -> Check:
    """Return how a solution does on fresh plants; ``values`` (k, parameters) belong to them."""
    structure, row = solution.structure, solution.values[None, :]

    def controller(omega: Vector) -> Any:
        return structure.response(row, omega)[0]

    poles = closed_loop_poles(plants, structure, solution.values)
    unstable = np.array([bool(np.any(s.real >= 0.0)) for s in poles])
    ratio = np.zeros(len(plants.plants))
    worst = {}
    beside = beside_poles(plants, poles)
    C = controller(plants.omega)
    peaks = all_peaks(problem.bounds, plants, controller, C, beside, 0.5)
    for number, (kind, limit) in enumerate(problem.bounds):
        own = np.zeros(ratio.size)
        for of_bound, peak in peaks:
            if of_bound == number:
                own[peak.plant] = max(own[peak.plant], peak.value)
        if not np.all(unstable):
            worst[kind] = float(np.max(own[~unstable])) * limit
        ratio = np.maximum(ratio, own)
    if problem.damping is not None:
        for pole in counted(plants, poles, problem.damping):
            ratio[pole.plant] = max(ratio[pole.plant], pole.ratio)
    ratio[unstable] = np.inf
    bad = ratio > 1.0 + _TOLERANCE
    at = int(np.argmax(ratio)) % values.shape[0]
    return Check(
        samples=ratio.size,
        unstable=int(np.sum(unstable)),
        violating=int(np.sum(bad)),
        interval=share_interval(int(np.sum(bad)), ratio.size),
        worst=worst,
        worst_values=dict(zip(names, values[at].tolist(), strict=True)),
    )


@dataclass(frozen=True, eq=False)
class Tuned(InNotebook):
    """The controller with the best objective under constraints, of one axis or several.

    From ``tune``, ``tune_schedule`` and ``tune_compensator``.

    Attributes
    ----------
    axes : tuple of Design
        the chosen design of each axis. ``design`` is that of a single one.
    designs : Mapping
        what ``rows`` shows, by name: of one axis all structures that were tuned, the chosen one
        included; else each axis, the loop at each operating point, or that with a compensator
        behind that of the controller alone.
    analysis : LoopAnalysis or MultivariableLoop
        ``analyse`` of the first plant with the controller.
    constraints : Constraints
        the bounds, M_ks included if it follows from the optimal PI controller's; of several axes
        those of each channel.
    objective : str
        what was optimised.
    task : Task or None
        what all structures of one axis were tuned for; None for what ``tune`` did not search as a
        structure.
    check : Check or None
        the result on fresh samples, if the plant has ranges or B0 may be off.
    setup : Mapping
        tables of the setup file besides those of the controller.
    search : Search or None
        the trials, if the tuning was by simulation; ``search.front`` with several objectives.
    simulated_check : Mapping or None
        the objectives on fresh samples, if the plant has ranges and the tuning was by simulation.
    signals : Signals
        names and units of the plant's u and y.
    doubts : tuple
        why the plant may differ from the model of a record that it was tuned for (``doubts`` of
        ``quell.tuning.plants``); they are in ``summary()``, JSON and the setup file.
    loop : Loop or None
        plant and scenario of the setup file that is written, in which the controller is judged.
    judged_at_limits : Judged or None
        what it does there, if u has limits: it decided on the design and the prefilter.
    told : tuple
        lines on a design that the objective alone prefers and that was left out, and on gains
        below which the loop is unstable.
    machine : Controller or None
        the controller where it is more than that of ``design``: with all axes, at its start.
    alone : Mapping
        the tuning of each axis by itself, by name, or of each operating point.
    details : Interaction, AtPoints, OnTop or None
        how several axes act on each other, what a schedule is at its points, and how a compensator
        changes the loop.
    """

    axes: tuple[Design, ...]
    designs: Mapping[str, Design]
    analysis: Any
    constraints: Constraints
    objective: str
    task: Task | None = None
    check: Check | None = None
    setup: Mapping[str, Any] = field(default_factory=dict)
    noise_bound: str = ""
    search: Search | None = None
    simulated_check: Mapping[str, Checked] | None = None
    signals: Signals = UNKNOWN
    doubts: tuple[str, ...] = ()
    loop: Loop | None = None
    judged_at_limits: Judged | None = None
    told: tuple[str, ...] = ()
    machine: Any = None
    alone: Mapping[Any, Tuned] = field(default_factory=dict)
    details: Any = None

    @property
    def nots(self) -> tuple[str, ...]:
        """The ``doubts`` as lines that begin with NOT."""
        return tuple(f"NOT: the margins hold for the model only: {text}" for text in self.doubts)

    @property
    def design(self) -> Design:
        """The chosen design of a single axis; ``ValueError`` for several."""
        if len(self.axes) != 1:
            raise ValueError(f"design: there are {len(self.axes)} axes; axes has a design for each")
        return self.axes[0]

    @property
    def controller(self) -> Any:
        """The tuned controller, behind its prefilter if it has one."""
        if self.judged_at_limits is not None:
            return self.judged_at_limits.controller
        return self.axes[0].controller if self.machine is None else self.machine

    @property
    def met(self) -> bool:
        """Whether all bounds hold; of one axis ``tune`` raises an error instead."""
        return self.details is None or self.details.met

    @property
    def plants(self) -> PlantSet:
        """The plants of a single axis, sampled."""
        assert self.task is not None
        return self.task.plants

    @property
    def count(self) -> int:
        """The number of plants for which the bounds hold."""
        if self.details is not None:
            return self.details.plants
        return 1 if self.task is None else len(self.task.plants.plants)

    @cached_property
    def tradeoff(self) -> list[tuple[str, float, float]]:
        """Name, limit and objective for limits 10 % below and above the active ones.

        Empty after a tuning by simulation, which would have to be repeated, and without a task.
        """
        if self.search is not None or self.task is None:
            return []
        with one_blas_thread():
            return tradeoff(self.task, self.design)

    @cached_property
    def noise_curve(self) -> list[tuple[float, float]]:
        """Bounds of M_ks and the objective with them, where the bound is a guess; else empty."""
        if self.search is not None or self.task is None or not self.noise_bound:
            return []
        if self.constraints.m_ks is None:
            return []
        with one_blas_thread():
            return noise_curve(self.task, self.design)

    @property
    def noise(self) -> list[str]:
        """How noise in u is bounded, as lines, and what other bounds would give."""
        lines = [self.noise_bound] if self.noise_bound else []
        if len(self.noise_curve) > 1:
            lines.append(report.noise_line(self.noise_curve, self.objective))
        return lines

    @cached_property
    def judged(self) -> Judged | None:
        """What the controller does in the file that is written; None without a file.

        Its step of the reference, a prefilter, overloads, and lines that begin with NOT.
        """
        if self.judged_at_limits is not None or self.loop is None:
            return self.judged_at_limits
        return judge(self.loop, self.controller, self.analysis)

    @property
    def reference_step(self) -> StepFigures | None:
        """What the written loop does after the largest step of the reference in its scenario."""
        return None if self.judged is None else self.judged.step

    @property
    def active(self) -> tuple[str, ...]:
        """The constraints at their limits, as text."""
        found = [each for design in self.axes for each in design.active]
        found += [] if self.details is None else self.details.active
        return tuple(report.active_text(each, self.count) for each in found)

    @property
    def damping(self) -> str:
        """The least damped pole of the loop, and the plant's own modes in it, as a line."""
        if self.task is None:
            return ""
        return report.damping_line(self.design, self.constraints.damping)

    @property
    def left_out(self) -> str:
        """The part of the plant that is not in the observer's model as text; empty if all is."""
        solution = self.axes[0].solution
        reduced = getattr(solution.structure, "reduced", None) if solution is not None else None
        if reduced is None or not str(reduced):
            return ""
        return (
            f"the {reduced} of the plant: not in the observer's model of order {reduced.order}, "
            "belongs to f; all measures count it"
        )

    @property
    def in_the_file(self) -> list[str]:
        """What the written loop does, as lines: step, overloads, what is not as it should be."""
        judged = self.judged
        lines = [] if judged is None else str(judged).splitlines()
        return [*self.told, *lines, *conditionally_stable(self._gains())]

    def _gains(self) -> list[tuple[float, float]]:
        """Return the margins of gain of the loops with all plants, where they are stable."""
        if self.task is None:
            return []
        found = [self.analysis.margins.gain] if self.analysis.stable else []
        if self.design.controller is not None and len(self.plants.plants) > 1:
            law = self.analysis.law
            loops = [LoopAnalysis(each, law, self.plants.dt) for each in self.plants.scaled()]
            found += [each.margins.gain for each in loops if each.stable]
        return found

    @property
    def costs(self) -> list[str]:
        """The chosen structure against the best one tried, PI and PID, as sentences.

        And one that was not tried, for a plant with a resonance.
        """
        if self.task is None:
            return []
        lines = report.costs(self.design, self.designs, self.objective)
        single = len(self.designs) == 1  # compares nothing
        resonant = not single and bool(resonances(self.task.model))
        return lines + report.not_tried(self.designs, resonant)

    def rows(self) -> tuple[list[str], list[list[str]]]:
        """Return the headings of a table of ``designs``, and a row of text for each."""
        return report.rows(self.designs, self.objective)

    def verdicts(self) -> list[str]:
        """Return what holds, what does not, and what is not known, as lines."""
        lines = [self.left_out, f"active: {', '.join(self.active) or 'no constraint'}"]
        lines += [self.damping]
        if self.details is not None:
            lines += self.details.lines(self)
        lines += self.in_the_file
        forward = getattr(self.axes[0].controller, "feedforward", False)
        if isinstance(forward, Feedforward):
            lines.append(f"feedforward: {forward.describe()}")
        lines += [str(self.check)] if self.check is not None else []
        for name, each in (self.simulated_check or {}).items():
            ends = f"95 % interval {each.low:.4g} to {each.high:.4g}"
            lines.append(f"{name} on {each.samples} fresh samples: {each.value:.4g} ({ends})")
        return [*filter(None, lines), *self.nots]

    def lines(self) -> list[str]:
        """Return what is told below the table: ``verdicts``, ``costs`` and ``tradeoff``."""
        others = report.tradeoff_lines(self.tradeoff, self.objective)
        return [*self.verdicts(), *self.costs, *(f"with {line}" for line in others)]

    _size = (8.0, 5.5)

    def _draw_small(self, figure: Any) -> None:
        count = (2, 2) if self.details is None else (self.details.drawn, 1)
        self.plot(figure.subplots(*count, squeeze=False).ravel())

    @property
    def title(self) -> str:
        """The tuned loop in a few words."""
        return self.design.name if len(self.axes) == 1 else f"{len(self.axes)} axes"

    def __repr__(self) -> str:
        return f"Tuned {self.title}:\n{self.summary()}"

    def summary(self) -> str:
        """Return constraints, measures, costs and trade-off in some lines."""
        lines = [self.bounds, *self.noise]
        (_, *headings), rows = self.rows()
        for name, *cells, reason in rows:
            figures = (" ".join(each) for each in zip(headings, cells, strict=True))
            lines.append(f"{name}: {reason or ', '.join(figures)}")
        lines += self.lines()
        return "\n".join([*lines, self.analysis.summary()] if self.details is None else lines)

    @property
    def bounds(self) -> str:
        """The constraints as a line."""
        of = "" if self.details is None else self.details.bounded
        return f"constraints: {self.constraints}{of}"

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw sensitivities with their bounds; of one axis Bode diagram and responses, too.

        The references are beside the tuned controller. Over the signal of a schedule b0, M_s and
        ``∫|y|``; of a compensator y after a step of the load. Returns the array of axes; ``axes``
        are those to draw into, new ones by default.
        """
        if self.details is not None:
            return self.details.plot(self.constraints.m_s, given_axes(axes, ax))
        named = {name: each for name, each in self.designs.items() if each.controller is not None}
        chosen = {"tuned": self.design}
        others = {key: named[key] for key in ("pi", "pid") if key in named}
        others = {key: each for key, each in others.items() if each is not self.design}
        drawn = self.plants, chosen | others, self.constraints, self.signals
        return draw(*drawn, given_axes(axes, ax))

    @property
    def tables(self) -> dict[str, Any]:
        """Tables of a setup file for the controller: observer, controller, prefilter.

        Of several axes ``axis`` has those of each, beside what its table in ``setup`` has.
        """
        if self.machine is None:
            judged = self.judged_at_limits
            return with_prefilter(self.design.tables, None if judged is None else judged.prefilter)
        if "axis" not in self.setup:
            raise ValueError("toml: there is no setup to complete; give tune its tables (setup)")
        parts = zip(self.setup["axis"], self.axes, self.controller.prefilters, strict=True)
        return {"axis": [with_prefilter({**own, **of.tables}, each) for own, of, each in parts]}

    def toml(self) -> str:
        """Return a setup file with plant and controller, for ``quell run`` and ``run-rig``."""
        tables, own = dict(self.setup), self.tables
        for name in ("observer", "controller") if "compensator" not in own else ():
            tables.pop(name, None)
        comment = f"{self.title}, tuned by quell\n{self.bounds}\n" + "\n".join(self.verdicts())
        return toml_text({**tables, **own}, comment)

    def save(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write ``toml()`` into a file, whole or not at all; an existing one is not replaced."""
        text = self.toml()
        with written_atomically(Path(path), overwrite) as part:
            part.write_text(text, encoding="utf-8")

    def to_json(self) -> dict[str, Any]:
        """Return all results for ``quell.files.write_json``; infinite numbers become None."""
        check = None
        if self.check is not None:
            check = {**vars(self.check), "interval": list(self.check.interval)}
            check = {k: dict(v) if isinstance(v, Mapping) else v for k, v in check.items()}
            del check["of"]
        judged: dict[str, Any] = {"reference_step": None, "overloads": [], "not": list(self.nots)}
        judged = judged if self.judged is None else self.judged.to_json()
        designs = {name: each.to_json() for name, each in self.designs.items()}
        chosen: dict[str, Any] = {"axes": [*designs.values()]}
        if len(self.axes) == 1:
            chosen = {"structure": self.title, "design": self.design.to_json(), "designs": designs}
        details: dict[str, Any] = {}
        if self.details is not None:
            details = {**self.details.to_json(), "verdicts": self.verdicts()}
        return nonfinite_to_none(
            {
                "objective": self.objective,
                "constraints": dict(vars(self.constraints)),
                "noise_bound": self.noise_bound,
                "doubts": self.doubts,
                **chosen,
                "costs": self.costs,
                "damping": self.damping,
                **judged,
                "tradeoff": [
                    {"constraint": name, "limit": limit, "objective": value}
                    for name, limit, value in self.tradeoff
                ],
                "noise_curve": [
                    {"m_ks": limit, "objective": value} for limit, value in self.noise_curve
                ],
                "check": check,
                "search": None if self.search is None else self.search.to_json(),
                "simulated_check": None
                if self.simulated_check is None
                else {name: each._asdict() for name, each in self.simulated_check.items()},
                "plants": self.count,
                "dt": float(self.controller.dt),
                **details,
            }
        )
