"""The result of a tuning as text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from quell.analysis.loop import duration
from quell.tuning.optimiser.damping import USUAL_DAMPING
from quell.tuning.optimiser.requirements import Active
from quell.tuning.result.design import Design

_UNITS = {"load": "k_i", "load-iae": "∫|y|", "tracking": "RMS of r − y"}


def quantity(objective: str) -> str:
    """Return the name of what an objective is about."""
    return _UNITS.get(objective, objective)


def second_quantity(objective: str) -> str:
    """Return the name of the measure beside the objective."""
    return "k_i" if objective == "load-iae" else "IAE"


def relative(design: Design, other: Design, objective: str) -> float:
    """Return how many times as good ``design`` is as ``other``."""
    better, worse = design.objective, other.objective
    if objective != "load":
        better, worse = worse, better
    if better == worse:  # both zero, perhaps, or infinite
        return 1.0
    return better / worse if worse != 0.0 else math.inf


def active_text(active: Active, plants: int) -> str:
    """Return a constraint at its limit as text."""
    where = "" if math.isnan(active.omega) else f" at {active.omega:.3g} rad/s"
    which = f" of plant {active.plant}" if plants > 1 and where else ""
    return f"{active.name} = {active.value:.4g} (limit {active.limit:.4g}){where}{which}"


def rows(designs: Mapping[str, Design], objective: str) -> list[tuple[str, ...]]:
    """Return rows: name, objective, IAE (or k_i), M_s, M_t, M_ks, delay margin, a reason."""
    found: list[tuple[str, ...]] = []
    for design in designs.values():
        if design.controller is None:
            found.append((design.name, *["–"] * 6, design.reason))
            continue
        m = design.measures
        numbers = (f"{m[kind]:.3f}" for kind in ("M_s", "M_t"))
        margin = duration(m["delay_margin"])
        second = design.k_i if objective == "load-iae" else m["iae"]
        first = (design.name, f"{design.objective:.4g}", f"{second:.3g}")
        found.append((*first, *numbers, f"{m['M_ks']:.4g}", margin, ""))
    return found


def costs(chosen: Design, designs: Mapping[str, Design], objective: str) -> list[str]:
    """Return sentences: what the chosen structure costs against the best one, PI and PID."""
    usable = {
        name: design
        for name, design in designs.items()
        if design.controller is not None and design is not chosen
    }
    what = quantity(objective)
    lines = []
    for name in ("pi", "pid"):
        if name in usable:
            share = relative(chosen, usable[name], objective)
            lines.append(
                f"{chosen.name} against the optimal {name.upper()} controller under the same "
                f"constraints: {share:.3g} times as good in {what}"
            )
    if usable:
        best = max(usable.values(), key=lambda design: relative(design, chosen, objective))
        share = relative(best, chosen, objective)
        if share > 1.0:
            lines.append(
                f"{chosen.name} costs {100.0 * (1.0 - 1.0 / share):.3g} % of {what} against the "
                f"best structure, {best.name}"
            )
        else:
            lines.append(
                f"{chosen.name} is the best of these structures; the next one, {best.name}, costs "
                f"{100.0 * (1.0 - share):.3g} %"
            )
    return lines + _integrators_line(chosen, usable, objective)


def _integrators_line(chosen: Design, others: Mapping[str, Design], objective: str) -> list[str]:
    """Return a line where several integrators bring nothing: one is at least as good."""
    if _integrators(chosen) < 2:
        return []
    single = [each for each in others.values() if _integrators(each) == 1]
    best = max(single, key=lambda each: relative(each, chosen, objective), default=None)
    if best is None or relative(best, chosen, objective) < 1.0:
        return []
    what = {"tracking": "this reference"}.get(objective, "a step of the load")
    return [
        f"NOT better with {_integrators(chosen)} integrators: {best.name} has one, and is at least "
        f"as good for {what}; take it, unless the load is a ramp or a slow sinusoid"
    ]


def _integrators(design: Design) -> int:
    return 0 if design.solution is None else design.solution.structure.integrators


def damping_line(design: Design, bound: float | None) -> str:
    """Return the damping of the loop's poles, and of the plant's own modes in it."""
    parts = []
    for pole in design.least_damped:
        which = "mode of the plant" if pole.own else "least damped pole of the loop"
        parts.append(f"{which}: damping {pole.damping:.3g} at {abs(pole.s):.3g} rad/s")
    line = "; ".join(parts) or "no pole of the loop oscillates, but for those of a dead time"
    if design.undamped:
        remedy = "take another structure, or looser bounds"
        return f"NOT damped: {line}: with the bound of damping no controller was found; {remedy}"
    if bound is None and design.measures["damping"] < USUAL_DAMPING:
        return f"NOT damped: {line}: no plant has it; bound it by Constraints(damping=)"
    return line


def tradeoff_lines(tradeoff: Sequence[tuple[str, float, float]], objective: str) -> list[str]:
    """Return what other limits would give: (constraint, its limit, objective)."""
    what = quantity(objective)
    return [f"{name} {limit:.4g}: {what} {value:.4g}" for name, limit, value in tradeoff]
