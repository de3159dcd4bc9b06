"""Results of a tuning: designs, text, figures, scenario and setup file.

The result of a tuning as text.

The step of the reference: overshoot, settling time, and a prefilter where it overshoots.

A design for loads takes what overshoot of the reference it may: M_s, M_t and the load say little
about it. A lag before the loop (``ReferenceModel``) changes the response to the reference alone.

Figures of a tuning: Bode diagram, sensitivities, step and load responses.

The scenario of a tuned setup file: a step of the reference, a load, and where each is judged.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from quell.analysis.linearise import linear_law
from quell.analysis.loop import duration
from quell.controllers.base import Controller
from quell.controllers.feedforward import Feedforward
from quell.files import as_json
from quell.quantities import Signals
from quell.records.plotting import grid_of_axes, new_figure
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser.loops import Inputs, PlantSet, SetResponses, load_step, response
from quell.tuning.optimiser.requirements import (
    OF_SPECTRUM,
    USUAL_DAMPING,
    Active,
    Bound,
    Pole,
    all_peaks,
    beside_poles,
    closed_loop_poles,
    counted,
    scores,
    sizes,
)
from quell.tuning.optimiser.search import Problem, Solution, delay_margin, noise_gain
from quell.tuning.structures.base import named
from quell.types import Vector

# ---- A structure tuned under constraints, with what it reaches ----

ACTIVE = 5e-3
"""A constraint within this share of its limit is active."""
_KINDS = ("M_s", "M_t", "M_ks")


@dataclass(frozen=True, eq=False)
class Design:
    """A structure tuned under constraints, or why it could not be.

    ``measures`` has ``M_s``, ``M_t``, ``M_ks`` [u-unit/y-unit], ``noise_gain`` (RMS of u for white
    noise of RMS 1 in y), ``delay_margin`` [s], ``iae`` (integral of ``|y|`` after a unit step of
    the load), ``damping`` (the least of the loop's poles, but for modes of the plant): the worst
    over all plants.
    """

    name: str  #: name of the structure, with its order
    controller: Controller | None  #: None if ``reason`` says why there is none
    values: Mapping[str, float]  #: the free parameters by name; b0 and K with their sign
    #: what was optimised: k_i for load rejection [u-unit/(y-unit s)], which is to be large; else
    #: the integral of ``|y|`` or the RMS of r − y, which are to be small
    objective: float
    k_i: float  #: integral gain [u-unit/(y-unit s)]; infinite with more than one integrator
    measures: Mapping[str, float]
    active: tuple[Active, ...]  #: the constraints at their limits
    tables: Mapping[str, Mapping[str, Any]]  #: tables of a setup file for the controller
    solution: Solution | None = None  #: what the optimiser found
    reason: str = ""  #: why there is no controller; empty otherwise
    #: the least damped of the poles that count, and that of the plant's own modes
    least_damped: tuple[Pole, ...] = ()
    undamped: bool = False  #: whether it keeps the other constraints, but not that of damping

    def to_json(self) -> dict[str, Any]:
        """Return numbers and texts for a JSON file; infinite numbers become None."""
        names = ("name", "values", "objective", "k_i", "measures", "active", "tables", "undamped")
        own = ("damping", "plant", "own")
        poles = [as_json(pole, *own, omega=abs(pole.s)) for pole in self.least_damped]
        return as_json(self, *names, "reason", least_damped=poles)


def impossible(name: str, reason: str) -> Design:
    """Return a design without controller."""
    nan = math.nan
    return Design(name, None, {}, nan, nan, {}, (), {}, None, reason)


def design_of(
    name: str,
    problem: Problem,
    solution: Solution,
    constraints: Constraints,
    options: Mapping[str, Any],
) -> Design:
    """Return the design of a solution; ``options`` are those of the structure's controllers."""
    structure, values = solution.structure, solution.values
    measures, active, least = measured(problem, solution, constraints)
    k_i = math.inf if structure.integrators > 1 else float(structure.integral_gain(values[None])[0])
    size = math.exp(solution.cost)
    tables = structure.tables(values)
    for key, each in options.items():
        if each is not None:
            tables["controller"][key] = each.table() if isinstance(each, Feedforward) else each
    return Design(
        name=name,
        controller=structure.controller(values, **options),
        values=_signed(solution),
        objective=k_i if problem.objective == "load" else size,
        k_i=k_i,
        measures=measures,
        active=active,
        tables=tables,
        solution=solution,
        least_damped=least,
    )


def _signed(solution: Solution) -> dict[str, float]:
    """Return the values by name, the gain with its sign: the search is about its size."""
    structure = solution.structure
    values = named(structure, solution.values)
    values[structure.parameters[0].name] *= structure.gain_sign
    return values


def measured(
    problem: Problem, solution: Solution, constraints: Constraints
) -> tuple[dict[str, float], tuple[Active, ...], tuple[Pole, ...]]:
    """Return the measures, the active constraints, and the least damped poles."""
    plants, structure, values = problem.plants, solution.structure, solution.values[None, :]
    C = structure.response(values, plants.omega)
    poles = closed_loop_poles(plants, structure, solution.values)
    beside = beside_poles(plants, poles)

    def controller(omega: Vector) -> Any:
        return structure.response(values, omega)[0]

    measures, active = {}, []
    bounds = dict(problem.bounds)
    for kind in _KINDS:
        grid = sizes(kind, plants.P, C[0])
        largest = float(np.max(grid))
        bound = (Bound(kind, 1.0),)
        found = all_peaks(bound, plants, controller, C[0], beside, 0.9 * largest)
        at = max(found, key=lambda entry: entry[1].value)[1]
        measures[kind] = at.value
        if kind in bounds and at.value >= (1.0 - ACTIVE) * bounds[kind]:
            active.append(Active(kind, at.value, bounds[kind], at.omega, at.plant))
    measures["noise_gain"] = float(noise_gain(plants, C)[0])
    over = SetResponses(plants, load_step(plants))
    measures["iae"] = float(np.max(scores("load-iae", structure, solution.values, over)))
    measures["delay_margin"] = float(delay_margin(plants, structure, values)[0])
    for extra in problem.extras:
        ratio = float(extra.ratio(structure, values)[0])
        if ratio >= 1.0 - ACTIVE:
            value = extra.limit / ratio if extra.name == "delay margin" else extra.limit * ratio
            active.append(Active(extra.name, value, extra.limit, math.nan, 0))
    least = _least_damped(counted(plants, poles, problem.damping or USUAL_DAMPING))
    measures["damping"] = min((pole.damping for pole in least if not pole.own), default=1.0)
    for pole in least if problem.damping is not None else ():
        if pole.ratio >= 1.0 - ACTIVE:
            name = "damping of the plant's mode" if pole.own else "damping"
            active.append(Active(name, pole.damping, pole.least, abs(pole.s), pole.plant))
    limit, fastest = constraints.omega_o_dt, _fastest(solution, constraints, plants)
    if np.any(structure.rules(values)[0] < ACTIVE):  # the faster real pole of a pair
        fastest = limit
    if fastest >= (1.0 - ACTIVE) * limit:
        active.append(Active("|p| dt", min(fastest, limit), limit, math.nan, 0))
    return measures, tuple(active), least


def _least_damped(poles: list[Pole]) -> tuple[Pole, ...]:
    """Return the least damped pole, and that of the plant's modes, where there are any."""
    groups = ([pole for pole in poles if pole.own == own] for own in (False, True))
    return tuple(min(group, key=lambda pole: pole.damping) for group in groups if group)


def _fastest(solution: Solution, constraints: Constraints, plants: PlantSet) -> float:
    """Return the largest ``|p| dt`` of parameters that are bounded by it."""
    found = 0.0
    for parameter, value in zip(solution.structure.parameters, solution.values, strict=True):
        if parameter.unit == "rad/s":
            found = max(found, float(value) * plants.dt)
        elif parameter.name == "T_f":
            found = max(found, constraints.omega_o_dt * parameter.low / float(value))
    return found


# ---- The result of a tuning as text ----

_UNITS = {"load": "k_i", "load-iae": "∫|y|", "tracking": "RMS of r − y"}
_UNITS |= {OF_SPECTRUM: "RMS of y"}


def quantity(objective: str) -> str:
    """Return the name of what an objective is about."""
    return _UNITS.get(objective, objective)


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


def rows(designs: Mapping[str, Design], objective: str) -> tuple[list[str], list[list[str]]]:
    """Return the headings of a table of designs, and a row for each, with a reason behind it.

    Objective, IAE (or k_i), M_s, M_t, M_ks, delay margin; where axes or points were tuned alone,
    too, the objective over that.
    """
    second = ("k_i", "k_i") if objective == "load-iae" else ("IAE", "iae")
    columns: list[tuple[str, str, Callable[[float], str]]] = [
        (quantity(objective), "objective", "{:.4g}".format),
        (*second, "{:.3g}".format),
        ("M_s", "M_s", "{:.3f}".format),
        ("at other speeds", "M_s elsewhere", "{:.3f}".format),
        ("M_t", "M_t", "{:.3f}".format),
        ("M_ks", "M_ks", "{:.4g}".format),
        ("delay margin", "delay_margin", duration),
    ]
    columns += [("over that alone", "ratio", "{:.3f}".format), ("b0", "b0", "{:.4g}".format)]
    found, shown = [], set[str]()
    for design in designs.values():
        known = {"objective": design.objective, "k_i": design.k_i, **design.measures}
        if "alone" in known:
            size = known["iae"] if math.isnan(design.objective) else design.objective
            known["ratio"] = size / known["alone"]
        known = {key: value for key, value in known.items() if not math.isnan(value)}
        shown |= known.keys()
        found.append((design, known))
    columns = [each for each in columns if each[1] in shown]
    table = [
        [
            design.name,
            *(show(known[key]) if key in known else "–" for _, key, show in columns),
            design.reason,
        ]
        for design, known in found
    ]
    return ["structure", *(heading for heading, _, _ in columns)], table


def costs(chosen: Design, designs: Mapping[str, Design], objective: str) -> list[str]:
    """Return sentences: how many times the objective of PI, PID and the best one it has."""
    usable = {
        name: design
        for name, design in designs.items()
        if design.controller is not None and design is not chosen
    }
    lines = [
        f"{_times(chosen, usable[name], objective)} the optimal {name.upper()} controller under "
        "the same constraints"
        for name in ("pi", "pid")
        if name in usable
    ]
    if usable:
        best = max(usable.values(), key=lambda design: relative(design, chosen, objective))
        if relative(best, chosen, objective) > 1.0:
            lines.append(f"{_times(chosen, best, objective)} {best.name}, the best of those tried")
        else:
            of_next = _times(best, chosen, objective)
            lines.append(f"{chosen.name} is the best of those tried; next: {of_next} it")
    return lines + _integrators_line(chosen, usable, objective)


def _times(design: Design, other: Design, objective: str) -> str:
    """Return how many times the other's objective a design has, up to the other's name."""
    share, better = relative(other, design, objective), "less"
    if objective == "load":
        share, better = relative(design, other, objective), "more"
    return f"{design.name} has {share:.3g} times the {quantity(objective)} ({better} is better) of"


def not_tried(designs: Mapping[str, Design], resonant: bool) -> list[str]:
    """Return a line where the plant has a resonance and no observer with free poles knows it."""
    name = "model-based-poles"
    if not resonant or name in designs:
        return []
    return [
        f"NOT tried: {name}, which often rejects the load better on a plant with a resonance but "
        f"damps it little: give --structure {name}, and look at the damping"
    ]


def _integrators_line(chosen: Design, others: Mapping[str, Design], objective: str) -> list[str]:
    """Return a line where several integrators bring nothing: one is at least as good."""
    if _integrators(chosen) < 2:
        return []
    single = [each for each in others.values() if _integrators(each) == 1]
    best = max(single, key=lambda each: relative(each, chosen, objective), default=None)
    if best is None or relative(best, chosen, objective) < 1.0:
        return []
    what = {"tracking": "this reference", OF_SPECTRUM: "this load"}.get(
        objective, "a step of the load"
    )
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


# Doubling M_ks must improve the objective by this share, or the knee is passed.
_KNEE = 0.1


def noise_line(curve: Sequence[tuple[float, float]], objective: str) -> str:
    """Return what the objective is over bounds of M_ks, and where more noise brings little."""
    points = ", ".join(f"{value:.4g} for {limit:.4g}" for limit, value in curve)
    text = f"{quantity(objective)} over bounds of M_ks: {points}"
    sizes = [(limit, math.log(value)) for limit, value in curve]
    sign = 1.0 if objective == "load" else -1.0
    slopes = [
        sign * (after - before) / math.log2(higher / lower)
        for (lower, before), (higher, after) in itertools.pairwise(sizes)
    ]
    small = [slope < math.log1p(_KNEE) for slope in slopes]
    knee = next((i for i in range(len(small)) if all(small[i:])), None)
    if knee is None:
        return f"{text}; more noise in u still brings more"
    return (
        f"{text}; above {curve[knee][0]:.4g} doubling it improves by less than {100.0 * _KNEE:g} %"
    )


# ---- Figures of a tuning ----

# The responses last so many times the radian of the loop's crossover; most samples of them. They
# are drawn until all of them stay within this share of their range, and this much longer.
_LASTS, _MOST, _SETTLED, _LONGER = 40.0, 20_000, 0.02, 1.2
# The lowest frequency that is drawn, in units of the lowest crossover, and the least |L| and |S|.
_LOWEST, _LEAST_LOOP, _LEAST_SENSITIVITY = 3e-3, 1e-4, 1e-2
# Phases are drawn where |L| is above this share: beyond, with a dead time, the grid may miss turns.
_PHASE_FROM = 0.02
# The largest number of plants whose responses are drawn one by one.
_DRAWN = 12
_COLORS = ("black", "#c1440e", "#2a6f97", "#6a994e")


def draw(
    plants: PlantSet,
    designs: Mapping[str, Design],
    constraints: Constraints,
    signals: Signals,
    axes: Any = None,
) -> Any:
    """Draw designs with all plants into four axes, the first design in black; return the axes.

    The phase of L, dashed and for the first plant only, has an axis of its own at the right.
    """
    axes = grid_of_axes(axes, partial(new_figure, 10.0, 7.5), 2, 2)
    bode, sensitivity, step, load = np.ravel(axes)
    phase = bode.twinx()
    omega, shown = plants.omega, range(min(len(plants.plants), _DRAWN))
    lowest, last, largest = math.inf, 0.0, 1.0
    for color, (label, design) in zip(_COLORS, designs.items(), strict=False):
        assert design.solution is not None
        assert design.controller is not None
        C = design.solution.structure.response(design.solution.values[None, :], omega)[0]
        L, dashed = plants.P[0] * C, {"color": color, "linewidth": 0.9, "linestyle": "--"}
        phase.semilogx(omega, np.where(np.abs(L) >= _PHASE_FROM, phase_of(L), np.nan), **dashed)
        crossover = _crossover(L, omega, plants.crossover)
        lowest = min(lowest, crossover)
        law, scaled = linear_law(design.controller), plants.scaled()
        count = min(int(_LASTS / crossover / plants.dt) + 2, _MOST)
        unit, none, t = np.ones(count), np.zeros(count), np.arange(count) * plants.dt
        for j in shown:
            text = label if label == design.name else f"{label}: {design.name}"
            name = text if j == 0 else None
            style: dict[str, Any] = {"color": color, "linewidth": 1.2, "label": name}
            style["alpha"] = 1.0 if j == 0 else 0.35
            bode.loglog(omega, np.abs(plants.P[j] * C), **style)
            other = style | {"linestyle": "--", "label": None}
            for kind, look in (("M_s", style), ("M_t", other)):
                size = sizes(kind, plants.P[j], C)
                sensitivity.loglog(omega, size, **look)
                largest = max(largest, float(np.max(size)))
            for axis, inputs in ((step, Inputs(unit, none)), (load, Inputs(none, unit))):
                y = response(scaled[j], law, inputs)
                axis.plot(t, y, **style)
                last = max(last, float(t[_settled(y)]))
    for limit, style_of in ((constraints.m_s, "-"), (constraints.m_t, "--")):
        if limit is not None:
            sensitivity.axhline(limit, color="0.5", linewidth=0.8, linestyle=style_of)
            largest = max(largest, limit)
    bode.axhline(1.0, color="0.5", linewidth=0.8)
    bode.set_ylim(_LEAST_LOOP, None)
    sensitivity.set_ylim(_LEAST_SENSITIVITY, 1.5 * largest)
    phase.set_ylabel("phase of L [°]")
    phase.axhline(-180.0, color="0.5", linewidth=0.8, linestyle="--")
    bode.set(title="loop L, its phase dashed", ylabel="|L|")
    sensitivity.set(title="sensitivities, with their bounds", ylabel="|S|, |T| dashed")
    step.set(title=f"step of r{_by_one(signals.y.unit)}")
    load.set(title=f"step of a load at the plant's input{_by_one(signals.u.unit)}")
    for axis in (bode, sensitivity):
        axis.set_xlabel("ω [rad/s]")
        axis.set_xlim(max(_LOWEST * lowest, float(omega[0])), None)
    for axis in (step, load):
        axis.set(xlabel="t [s]", ylabel=signals.y.label("y"), xlim=(0.0, _LONGER * last))
        axis.grid(alpha=0.3)
    load.legend(loc="upper right")
    return axes


def _by_one(unit: str) -> str:
    """Return the height of a unit step as text; empty for an unknown unit."""
    return f" by 1 {unit}" if unit else ""


def _settled(y: Vector) -> int:
    """Return the index from which on a response stays near its last value."""
    off = np.flatnonzero(np.abs(y - y[-1]) > _SETTLED * np.ptp(y))
    return int(off[-1]) if off.size else 0


def phase_of(L: Any) -> Vector:
    """Return the phase [°] along a grid, from between −360° and 0 at its first frequency on."""
    phase: Vector = np.degrees(np.unwrap(np.angle(L)))
    return phase - 360.0 * math.ceil(phase[0] / 360.0)


def _crossover(L: Any, omega: Vector, otherwise: float) -> float:
    """Return the lowest frequency at which |L| falls to 1."""
    size = np.abs(L)
    falls = np.flatnonzero((size[:-1] >= 1.0) & (size[1:] < 1.0))
    return float(omega[falls[0]]) if falls.size else otherwise


# ---- A tuned controller as a setup file in TOML ----

# A comment may have none of them, and a tab is of no use there.
_CONTROL = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")


def toml_text(tables: Mapping[str, Any], comment: str = "") -> str:
    """Return a TOML file with top-level keys and tables; ``comment`` lines stand first.

    Numbers are written in full precision. Tables within tables are written inline.
    """
    lines = [f"# {_CONTROL.sub(' ', line)}" for line in comment.splitlines()]
    plain = {key: value for key, value in tables.items() if not isinstance(value, Mapping)}
    listed = {
        key: value
        for key, value in plain.items()
        if isinstance(value, list | tuple)
        and value
        and all(isinstance(each, Mapping) for each in value)
    }
    lines += [f"{_key(key)} = {_value(value)}" for key, value in plain.items() if key not in listed]
    for key, value in tables.items():
        if isinstance(value, Mapping):
            lines += ["", f"[{_key(key)}]"]
            lines += [f"{_key(name)} = {_value(part)}" for name, part in value.items()]
    for key, entries in listed.items():
        for entry in entries:
            lines += ["", f"[[{_key(key)}]]"]
            lines += [f"{_key(name)} = {_value(part)}" for name, part in entry.items()]
    return "\n".join(lines).strip() + "\n"


def _key(name: str) -> str:
    bare = name.isascii() and re.fullmatch(r"[\w-]+", name) is not None
    return name if bare else _text(name)


def _text(value: str) -> str:
    # TOML has the escapes of JSON; it wants them for DEL, too, and halves of surrogate pairs are no
    # text in UTF-8.
    valid = value.encode("utf-8", "replace").decode("utf-8")
    return json.dumps(valid, ensure_ascii=False).replace("\x7f", "\\u007F")


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _text(value)
    if value is None:
        return '"none"'
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple | np.ndarray):
        return "[" + ", ".join(_value(part) for part in value) + "]"
    if isinstance(value, int | np.integer):
        return str(int(value))
    return repr(float(value))
