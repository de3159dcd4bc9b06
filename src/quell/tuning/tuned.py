"""The result of a tuning."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from quell.analysis.loop import LoopAnalysis
from quell.controllers.adrc.feedforward import Feedforward
from quell.controllers.base import Controller
from quell.files import nonfinite_to_none, written_atomically
from quell.parallel import one_blas_thread
from quell.quantities import UNKNOWN, Signals
from quell.records.plotting import given_axes
from quell.tuning.constraints import Constraints
from quell.tuning.designs import Task, tradeoff
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.result import report
from quell.tuning.result.design import Design
from quell.tuning.result.plots import draw
from quell.tuning.result.reference_step import ReferenceStep, reference_step
from quell.tuning.result.setup_file import toml_text
from quell.tuning.simulated import Checked, Search
from quell.tuning.uncertain import Check


@dataclass(frozen=True, eq=False)
class Tuned:
    """The controller of a structure with the best objective under constraints; from ``tune``.

    Attributes
    ----------
    design : Design
        the chosen structure's design; ``controller`` is its controller.
    designs : Mapping
        the designs of all structures by name, the chosen one included.
    analysis : LoopAnalysis
        ``analyse`` of the first plant with the controller.
    constraints : Constraints
        the bounds, M_ks included if it follows from the optimal PI controller's.
    objective : str
        what was optimised.
    task : Task
        what all structures were tuned for.
    check : Check or None
        the result on fresh samples, if the plant has ranges.
    setup : Mapping
        tables of the setup file besides those of the controller.
    search : Search or None
        the trials, if the tuning was by simulation; ``search.front`` with several objectives.
    simulated_check : Mapping or None
        the objectives on fresh samples, if the plant has ranges and the tuning was by simulation.
    signals : Signals
        names and units of the plant's u and y.
    """

    design: Design
    designs: Mapping[str, Design]
    analysis: LoopAnalysis
    constraints: Constraints
    objective: str
    task: Task
    check: Check | None = None
    setup: Mapping[str, Any] = field(default_factory=dict)
    noise_bound: str = ""
    search: Search | None = None
    simulated_check: Mapping[str, Checked] | None = None
    signals: Signals = UNKNOWN

    @property
    def controller(self) -> Controller:
        """The tuned controller."""
        controller = self.design.controller
        assert controller is not None  # ``tune`` raises an error instead
        return controller

    @property
    def plants(self) -> PlantSet:
        """The plants, sampled."""
        return self.task.plants

    @cached_property
    def tradeoff(self) -> list[tuple[str, float, float]]:
        """Name, limit and objective for limits 10 % below and above the active ones.

        Empty after a tuning by simulation, which would have to be repeated.
        """
        if self.search is not None:
            return []
        with one_blas_thread():
            return tradeoff(self.task, self.design)

    @cached_property
    def reference_step(self) -> ReferenceStep:
        """Overshoot and settling time of a step of the reference, and a prefilter if it needs one.

        That of the linear loop with the first plant, without the controller's feedforward.
        """
        solution = self.design.solution
        controller = self.controller if solution is None else solution.controller
        return reference_step(self.plants, controller)

    @property
    def active(self) -> tuple[str, ...]:
        """The constraints at their limits, as text."""
        plants = len(self.plants.plants)
        return tuple(report.active_text(each, plants) for each in self.design.active)

    @property
    def damping(self) -> str:
        """The least damped pole of the loop, and the plant's own modes in it, as a line."""
        return report.damping_line(self.design, self.constraints.damping)

    @property
    def left_out(self) -> str:
        """The part of the plant that is not in the observer's model as text; empty if all is."""
        solution = self.design.solution
        reduced = getattr(solution.structure, "reduced", None) if solution is not None else None
        if reduced is None or not str(reduced):
            return ""
        return (
            f"the {reduced} of the plant: not in the observer's model of order {reduced.order}, "
            "belongs to f; all measures count it"
        )

    @property
    def costs(self) -> list[str]:
        """Costs of the chosen structure against the best one, PI and PID, as sentences."""
        return report.costs(self.design, self.designs, self.objective)

    def __repr__(self) -> str:
        return f"Tuned {self.design.name}:\n{self.summary()}"

    def summary(self) -> str:
        """Return constraints, measures, costs and trade-off in some lines."""
        lines = [f"constraints: {self.constraints}"]
        lines += [self.noise_bound] if self.noise_bound else []
        quantity = report.quantity(self.objective)
        second = report.second_quantity(self.objective)
        for name, value, *rest in report.rows(self.designs, self.objective):
            lines.append(f"{name}: {quantity} {value}; " + _measures(second, rest))
        lines += [self.left_out] if self.left_out else []
        lines += [f"active: {', '.join(self.active) or 'no constraint'}", *self.costs]
        lines += [self.damping, str(self.reference_step)]
        forward = getattr(self.design.controller, "feedforward", False)
        if isinstance(forward, Feedforward):
            lines.append(f"feedforward: {forward.describe()}")
        lines += report.tradeoff_lines(self.tradeoff, self.objective)
        lines += [str(self.check)] if self.check is not None else []
        for name, each in (self.simulated_check or {}).items():
            ends = f"95 % interval {each.low:.4g} to {each.high:.4g}"
            lines.append(f"{name} on {each.samples} fresh samples: {each.value:.4g} ({ends})")
        return "\n".join([*lines, self.analysis.summary()])

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw Bode diagram, sensitivities with their bounds, step and load responses.

        The references are beside the tuned controller. Returns the array of axes; ``axes`` are four
        to draw into, new ones by default.
        """
        named = {name: each for name, each in self.designs.items() if each.controller is not None}
        chosen = {"tuned": self.design}
        others = {key: named[key] for key in ("pi", "pid") if key in named}
        others = {key: each for key, each in others.items() if each is not self.design}
        drawn = self.plants, chosen | others, self.constraints, self.signals
        return draw(*drawn, given_axes(axes, ax))

    def toml(self) -> str:
        """Return a setup file with plant and controller, for ``quell run`` and ``run-rig``."""
        comment = f"{self.design.name}, tuned by quell\nconstraints: {self.constraints}\n"
        comment += f"active: {', '.join(self.active) or 'none'}\n{self.reference_step}"
        comment += f"\n{self.left_out}" if self.left_out else ""
        replaced = ("observer", "controller")
        tables = {key: value for key, value in self.setup.items() if key not in replaced}
        return toml_text({**tables, **self.design.tables}, comment)

    def save(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write ``toml()`` into a file, whole or not at all; an existing one is not replaced."""
        with written_atomically(Path(path), overwrite) as part:
            part.write_text(self.toml(), encoding="utf-8")

    def to_json(self) -> dict[str, Any]:
        """Return all results for ``quell.files.write_json``."""
        check = None
        if self.check is not None:
            check = {**vars(self.check), "interval": list(self.check.interval)}
            check = {k: dict(v) if isinstance(v, Mapping) else v for k, v in check.items()}
        found: dict[str, Any] = nonfinite_to_none(
            {
                "structure": self.design.name,
                "objective": self.objective,
                "constraints": dict(vars(self.constraints)),
                "noise_bound": self.noise_bound,
                "design": self.design.to_json(),
                "designs": {name: each.to_json() for name, each in self.designs.items()},
                "costs": self.costs,
                "damping": self.damping,
                "reference_step": {
                    "overshoot": self.reference_step.overshoot,
                    "settling": self.reference_step.settling,
                    "prefilter_omega": getattr(self.reference_step.prefilter, "omega", None),
                },
                "tradeoff": [
                    {"constraint": name, "limit": limit, "objective": value}
                    for name, limit, value in self.tradeoff
                ],
                "check": check,
                "search": None if self.search is None else self.search.to_json(),
                "simulated_check": None
                if self.simulated_check is None
                else {name: each._asdict() for name, each in self.simulated_check.items()},
                "plants": len(self.plants.plants),
                "dt": self.plants.dt,
            }
        )
        return found


def _measures(second: str, cells: list[str]) -> str:
    *numbers, reason = cells
    if reason:
        return reason
    value, m_s, m_t, m_ks, margin = numbers
    return f"{second} {value}, M_s {m_s}, M_t {m_t}, M_ks {m_ks}, delay margin {margin}"
