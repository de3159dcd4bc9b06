"""Results of a tuning: designs, text, figures, scenario and setup file.

The result of a tuning as text.

The step of the reference: overshoot, settling time, and a prefilter where it overshoots.

A design for loads takes what overshoot of the reference it may: M_s, M_t and the load say little
about it. A lag before the loop (``ReferenceModel``) changes the response to the reference alone.

Figures of a tuning: Bode diagram, sensitivities, step and load responses.

The scenario of a tuned setup file: a step of the reference, a load, and where each is judged.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from quell import checks
from quell.analysis.loop import duration
from quell.controllers.base import Controller
from quell.controllers.feedforward import Feedforward
from quell.controllers.prefilters import ReferenceModel
from quell.files import nonfinite_to_none
from quell.plants.base import measure
from quell.plants.linear import DelayedPlant, EncodedPlant, LinearPlant, delayed
from quell.plants.linearise import operating_point_of
from quell.plants.nonlinear import NonlinearPlant, checked_point
from quell.quantities import Signals
from quell.records.plotting import grid_of_axes, new_figure
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser import loops
from quell.tuning.optimiser.loops import Inputs, PlantSet, SetResponses, law_of, load_step, response
from quell.tuning.optimiser.requirements import (
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
from quell.types import Matrix, Vector

# ---- A structure tuned under constraints, with what it reaches ----

# A constraint within this share of its limit is active.
_ACTIVE = 5e-3
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
        found: dict[str, Any] = nonfinite_to_none(
            {
                "name": self.name,
                "values": dict(self.values),
                "objective": self.objective,
                "k_i": self.k_i,
                "measures": dict(self.measures),
                "active": [active._asdict() for active in self.active],
                "least_damped": [
                    {
                        "damping": pole.damping,
                        "omega": abs(pole.s),
                        "plant": pole.plant,
                        "own": pole.own,
                    }
                    for pole in self.least_damped
                ],
                "tables": {key: dict(table) for key, table in self.tables.items()},
                "undamped": self.undamped,
                "reason": self.reason,
            }
        )
        return found


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
        if kind in bounds and at.value >= (1.0 - _ACTIVE) * bounds[kind]:
            active.append(Active(kind, at.value, bounds[kind], at.omega, at.plant))
    measures["noise_gain"] = float(noise_gain(plants, C)[0])
    over = SetResponses(plants, load_step(plants))
    measures["iae"] = float(np.max(scores("load-iae", structure, solution.values, over)))
    measures["delay_margin"] = float(delay_margin(plants, structure, values)[0])
    for extra in problem.extras:
        ratio = float(extra.ratio(structure, values)[0])
        if ratio >= 1.0 - _ACTIVE:
            value = extra.limit / ratio if extra.name == "delay margin" else extra.limit * ratio
            active.append(Active(extra.name, value, extra.limit, math.nan, 0))
    least = _least_damped(counted(plants, poles, problem.damping or USUAL_DAMPING))
    measures["damping"] = min((pole.damping for pole in least if not pole.own), default=1.0)
    for pole in least if problem.damping is not None else ():
        if pole.ratio >= 1.0 - _ACTIVE:
            name = "damping of the plant's mode" if pole.own else "damping"
            active.append(Active(name, pole.damping, pole.least, abs(pole.s), pole.plant))
    limit, fastest = constraints.omega_o_dt, _fastest(solution, constraints, plants)
    if np.any(structure.rules(values)[0] < _ACTIVE):  # the faster real pole of a pair
        fastest = limit
    if fastest >= (1.0 - _ACTIVE) * limit:
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


# ---- The step of the reference ----

# Overshoot from which on a prefilter is offered, and that it leaves; the band of the settling time.
MOST_OVERSHOOT, _BAND = 0.05, 0.02
# Order of the prefilter, steps of the bisection for its bandwidth, and its range in 1/dt.
_ORDER, _BISECTIONS, _SLOWEST = 2, 30, 1e-6


class ReferenceStep(NamedTuple):
    """The response of the first plant to a step of the reference."""

    overshoot: float  #: share of the step
    settling: float  #: time until it stays within 2 % of the step [s]; NaN if it does not
    prefilter: ReferenceModel | None  #: the fastest with which it overshoots by 5 % at most
    settling_with_prefilter: float  #: [s]; NaN without one

    def __str__(self) -> str:
        """Return overshoot, settling time and the offer of a prefilter as a sentence."""
        if math.isnan(self.settling):
            return "step of the reference: it does not settle in the time that was looked at"
        text = (
            f"step of the reference: overshoots by {100.0 * self.overshoot:.1f} %, settles within "
            f"2 % in {self.settling:.3g} s"
        )
        if self.prefilter is None:
            return text
        return (
            f'{text}; with a prefilter ([prefilter] kind = "reference-model", order = {_ORDER}, '
            f"omega = {self.prefilter.omega:.4g}) it overshoots by 5 % and settles in "
            f"{self.settling_with_prefilter:.3g} s"
        )


def reference_step(plants: PlantSet, controller: Controller) -> ReferenceStep:
    """Return the response of the first plant with a linear controller."""
    inputs, law = loops.reference_step(plants), law_of(controller)
    y, dt = response(plants.scaled()[0], law, inputs), plants.dt * inputs.distance
    overshoot, settling = _measured(y, dt)
    if not overshoot > MOST_OVERSHOOT:
        return ReferenceStep(overshoot, settling, None, math.nan)
    # With the pulse response any prefilter is a convolution.
    pulse = np.diff(y, prepend=0.0)
    low, high, best = _SLOWEST / dt, 1.0 / dt, None
    for _ in range(_BISECTIONS):
        omega = math.sqrt(low * high)
        after = _measured(_behind(ReferenceModel(omega, _ORDER), pulse, dt), dt)
        if after[0] <= MOST_OVERSHOOT:
            low, best = omega, (ReferenceModel(omega, _ORDER), after[1])
        else:
            high = omega
    if best is None:
        return ReferenceStep(overshoot, settling, None, math.nan)
    return ReferenceStep(overshoot, settling, *best)


def peak_of_u(plants: PlantSet, controller: Controller) -> float:
    """Return the largest ``|u|`` after a unit step of r [u-unit/y-unit], without limits of u."""
    inputs, first, law = loops.reference_step(plants), plants.scaled()[0], law_of(controller)
    largest = float(np.max(np.abs(response(first, law, inputs, "u"))))
    if inputs.distance > 1:  # the law may be faster than that
        start = inputs._replace(distance=1)
        largest = max(largest, float(np.max(np.abs(response(first, law, start, "u")))))
    return largest


def _behind(model: ReferenceModel, pulse: Vector, dt: float) -> Vector:
    """Return the response to a step through a prefilter (k,)."""
    # All its poles are at the same place: r_f is the step through that many equal lags.
    lag = math.exp(-model.omega * dt)
    found = np.cumsum(pulse)
    for _ in range(model.order):
        found = lfilter([1.0 - lag], [1.0, -lag], found)
    return np.asarray(found, dtype=np.float64)


def _measured(y: Vector, dt: float) -> tuple[float, float]:
    """Return overshoot and settling time of the response to a unit step, NaN if it does not."""
    if not np.all(np.isfinite(y)):
        return math.nan, math.nan
    off = np.flatnonzero(np.abs(y - 1.0) > _BAND)
    settled = off.size == 0 or off[-1] < y.size - 1
    settling = float((off[-1] + 1 if off.size else 0) * dt) if settled else math.nan
    return max(float(np.max(y)) - 1.0, 0.0), settling


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
        law, scaled = law_of(design.controller), plants.scaled()
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


# ---- The scenario of a tuned setup file ----

# A step and a load take at most this share each of what u has left at rest, as both act in the end.
_SHARE = 0.4
# A solution of A x + B u = −E w, C x = r within this share of its right side is one.
_SOLVED = 1e-6
# Smaller parts of a solution are rounding.
_ROUNDING = 1e-12
# Names of the times at which signals begin, in their tables.
_TIMES = ("at", "start")


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


def held_sizes(
    linear: LinearPlant, rest: Rest | None, limits: Limits, peak: float
) -> tuple[float, float]:
    """Return the sizes of a step of r [y-unit] and of the first load that u can hold, of 1 at most.

    At rest the step needs u with ``A x + B u = 0``, ``C x = 1``, the load ``A x + B u = −E``,
    ``C x = 0``; each gets 40 % of what the limits leave. A step that needs no u at rest, as that of
    an axis, keeps the largest ``|u|`` on the way within the limits, which is ``peak`` after a step
    of 1 without limits [u-unit/y-unit]. A size is negative where u has more room on the other side,
    as that of a load on a heater at zero.
    """
    at = 0.0 if rest is None else rest.u
    low, high = limits
    n = linear.order
    matrix = np.block([[linear.A, linear.B], [linear.C, np.zeros((1, 1))]])
    rights = [np.append(np.zeros(n), 1.0)]
    rights += [np.append(-linear.E[:, 0], 0.0)] if linear.disturbances else []
    sizes: list[float] = []
    for right in rights:
        found = np.linalg.lstsq(matrix, right, rcond=None)[0]
        solved = np.linalg.norm(matrix @ found - right) <= _SOLVED * np.linalg.norm(right)
        u = float(found[-1]) if solved else 0.0
        # How large a positive and a negative one may be.
        ends = (high - at, low - at) if u > 0.0 else (low - at, high - at)
        most = [1.0 if u == 0.0 else min(1.0, abs(_SHARE * end / u)) for end in ends]
        size = most[0] if most[0] >= most[1] else -most[1]
        if not sizes and u == 0.0 and peak > 0.0:
            size = min(1.0, min(high - at, at - low) / peak)
        sizes.append(float(f"{size:.2g}"))
    return sizes[0], sizes[-1]


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
            begins = (known.get(name) for name in _TIMES)
            times |= {float(time) for time in begins if isinstance(time, float | int)}
    end = float(scenario.get("duration", np.inf))
    return _windows(sorted(time for time in times if 0.0 <= time < end))


def _windows(times: list[float]) -> list[dict[str, float]]:
    ends = [{"stop": later} for later in times[1:]]
    return [{"start": at, **end} for at, end in zip(times, [*ends, {}], strict=True)]


def late_tables(tables: Mapping[str, Any], delay: float, samples: int) -> dict[str, Any]:
    """Return the tables of a setup whose plant is behind a further delay [s] of so many states.

    Names, ranges, paths of a sweep and operating points stay those of the plant inside.
    """
    plant = tables["plant"]
    inner: dict[str, Any] = {"kind": plant} if isinstance(plant, str) else dict(plant)
    outer: dict[str, Any] = {"kind": "delayed", "delay": delay}
    if "signals" in inner:
        outer["signals"] = inner.pop("signals")
    if "uncertain" in inner:
        outer["uncertain"] = {f"plant.{key}": ends for key, ends in inner.pop("uncertain").items()}
    found = {**tables, "plant": outer | {"plant": inner}}
    scenario, sweep = tables.get("scenario"), tables.get("sweep")
    if isinstance(scenario, Mapping) and "x0" in scenario:
        found["scenario"] = {**scenario, "x0": [*scenario["x0"], *[0.0] * samples]}
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


def plant_table(
    linear: LinearPlant, actuator_lag: float, delay: float, dt: float
) -> tuple[dict[str, Any], int]:
    """Return the table of a linear plant behind a lag and a delay [s] of u, sampled at ``dt`` [s].

    Beside it, how many states lag and delay append, which are u at rest.
    """
    if actuator_lag > 0.0:
        n = linear.order
        A = np.block([[linear.A, linear.B], [np.zeros((1, n)), np.full((1, 1), -1 / actuator_lag)]])
        B = np.append(np.zeros(n), 1.0 / actuator_lag)
        E = np.vstack([linear.E, np.zeros((1, linear.disturbances))])
        linear = LinearPlant(A, B, np.append(linear.C[0], 0.0), E)
    table: dict[str, Any] = {
        "kind": "linear",
        "A": _rows(linear.A),
        "B": linear.B[:, 0].tolist(),
        "C": linear.C[0].tolist(),
        "E": _rows(linear.E),
    }
    appended = int(actuator_lag > 0.0)
    if delay == 0.0:
        return table, appended
    appended += delayed(linear, delay, dt).order - linear.order
    return {"kind": "delayed", "plant": table, "delay": delay}, appended


def _rows(matrix: Matrix) -> list[list[float]]:
    found: list[list[float]] = matrix.tolist()
    return found
