"""Whether a tuned loop is accepted as it is written: its step, its overloads, its limits.

Limits of u are not in the loop that was tuned. So each design that may be chosen runs in the file
that would be written: with its prefilter through the scenario, and with loads that u can't hold. A
loop that is conditionally stable, or whose observer models another plant, may cycle there between
the limits, or take long until it is back.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell.analysis.loop import LoopAnalysis
from quell.controllers.base import Controller
from quell.controllers.prefilters import Prefiltered, ReferenceModel
from quell.plants.linear import LinearPlant
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.reference import (
    ORDER_OF_AXIS,
    Axis,
    model_of_linear_step,
    profile_for,
    reference_model_for,
    room_of_u,
)
from quell.tuning.structures.base import Model, resonances
from quell.tuning.written import (
    MOST_OVERSHOOT,
    SHARE,
    MoveFigures,
    Overload,
    StepFigures,
    Written,
    held_load,
    held_step,
)

# Where the scenario has no step: how long one is looked at, in time constants of the loop, and the
# time before it, in samples.
_LOOKED, _BEFORE = 150.0, 10
# The first reference model that is tried at limits, in units of the bandwidth of the loop.
_FASTEST_MODEL = 3.0


class Loop(NamedTuple):
    """What is known of the tuned loop of a design."""

    written: Written
    linear: LinearPlant  # the first plant, without delay and lag
    model: Model
    plants: PlantSet
    limits: tuple[float, float]  # of u
    rest: float  # u at rest
    shaped: bool  # whether a prefilter is added where the step needs one


class Judged(NamedTuple):
    """A design in the file that is written."""

    controller: Controller  #: with its prefilter
    prefilter: Any  #: None if it has none
    step: StepFigures | None  #: after the largest step of the scenario; None if its r moves
    move: MoveFigures | None  #: along a reference that moves
    offered: ReferenceModel | None  #: a prefilter that is not in the file
    offered_step: StepFigures | None  #: what the step is with it
    overloads: tuple[Overload, ...]  #: after loads that u can't hold
    failures: tuple[str, ...]  #: lines that begin with NOT

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
        if self.overloads:
            loads = "; ".join(str(each) for each in self.overloads)
            lines.append(f"overload, a load of 1.4 times what u can hold: {loads}")
        lines += [line for line in self.failures if line not in lines]
        return "\n".join(lines)


def _described(prefilter: Any) -> str:
    """Return the keys of a prefilter's table."""
    return ", ".join(
        f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value:.4g}"
        for key, value in prefilter_table(prefilter).items()
    )


def prefilter_table(prefilter: Any) -> dict[str, Any]:
    """Return the table of a prefilter in a setup file."""
    model = isinstance(prefilter, ReferenceModel)
    return {"kind": "reference-model" if model else "profile-generator"} | dict(vars(prefilter))


def time_constant(analysis: LoopAnalysis, plants: PlantSet) -> float:
    """Return 1/ω_c of a loop with its gain crossover ω_c [s]."""
    omega = analysis.margins.phase_omega
    return 1.0 / (omega if math.isfinite(omega) and omega > 0.0 else plants.crossover)


def axis_of(linear: LinearPlant, tau: float, plants: PlantSet) -> Axis | None:
    """Return the rigid part of a plant that needs no u at rest; None for another one.

    ``tau`` is the time constant of the closed loop [s].
    """
    gain = abs(complex(plants.responses(np.array([1.0 / tau]))[0, 0]))
    return Axis.of(linear, 1.0 / gain)


def judge(loop: Loop, controller: Controller, analysis: LoopAnalysis) -> Judged:
    """Return what a controller does in the file that would be written."""
    tau = time_constant(analysis, loop.plants)
    axis, limits = axis_of(loop.linear, tau, loop.plants), loop.limits
    limited = math.isfinite(limits[0]) or math.isfinite(limits[1])
    bounded = math.isfinite(limits[1] - limits[0])
    written = loop.written
    if written.largest is None and not written.moves:
        needed = axis.needs(tau) if axis is not None else abs(held_step(loop.linear))
        room = min(limits[1] - loop.rest, loop.rest - limits[0])
        size = SHARE * room / needed if bounded and needed > 0.0 else 1.0
        written = written.stepping(float(f"{size:.2g}"), _LOOKED * tau, _BEFORE)
    prefilter, offered, offered_step = None, None, None
    failures: list[str] = []
    if loop.shaped and bounded and axis is not None:
        if resonances(loop.model):
            fastest = _FASTEST_MODEL * ORDER_OF_AXIS / tau
            prefilter = reference_model_for(written, controller, fastest, ORDER_OF_AXIS).prefilter
        else:
            room = room_of_u(written, loop.linear, limits, loop.rest)
            prefilter = profile_for(written, controller, axis, tau, room).prefilter
    whole = controller if prefilter is None else Prefiltered(controller, prefilter)
    run = written.run(whole)
    step = written.figures(whole, run)
    if prefilter is None and step is not None and step.overshoot > MOST_OVERSHOOT:
        if loop.shaped and limited:
            prefilter = reference_model_for(written, controller, _FASTEST_MODEL / tau).prefilter
            if prefilter is not None:
                whole = Prefiltered(controller, prefilter)
                run = written.run(whole)
                step = written.figures(whole, run)
        elif not limited and math.isfinite(step.overshoot):
            offered, offered_step = _offer(written, loop.plants, controller, tau)
    move = written.along(run) if step is None else None
    first = str(move if step is None else step)
    if first.startswith("NOT"):
        failures.append(first)
    elif loop.shaped and step is not None and bounded and step.overshoot > 1.2 * MOST_OVERSHOOT:
        failures.append(
            f"NOT below {100.0 * MOST_OVERSHOOT:.0f} %: no prefilter was found with which the step "
            "overshoots less at the limits of u; give a smaller step, or move the reference slowly"
        )
    if bounded and written.cycles(whole, run):
        failures.append(
            "NOT at rest: at the end of the scenario u still goes from limit to limit; bound the "
            "loop more (M_ks, M_s), or give a smaller step"
        )
    overloads: list[Overload] = []
    held = held_load(loop.linear)
    if bounded and held and not failures:
        overloads = written.overloads(whole, step, tau, held)
        failures += [_slow(each) for each in overloads if not each.passes]
    rest = offered, offered_step, tuple(overloads), tuple(failures)
    return Judged(whole, prefilter, step, move, *rest)


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
    if not getattr(controller, "derivatives", 0):
        model = model_of_linear_step(plants, controller)
    if model is None:
        found = reference_model_for(written, controller, _FASTEST_MODEL / tau)
        return found.prefilter, found.step
    shaped = Prefiltered(controller, model)
    return model, written.figures(shaped, written.run(shaped))
