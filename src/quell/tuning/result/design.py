"""A structure tuned under constraints, with what it reaches."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from quell.controllers.adrc.feedforward import Feedforward
from quell.controllers.base import Controller
from quell.files import nonfinite_to_none
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser.damping import (
    USUAL_DAMPING,
    Pole,
    beside_poles,
    closed_loop_poles,
    counted,
)
from quell.tuning.optimiser.extras import delay_margin, noise_gain
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.optimiser.objectives import scores
from quell.tuning.optimiser.problem import Problem, Solution
from quell.tuning.optimiser.requirements import Active, Bound, all_peaks, sizes
from quell.tuning.optimiser.time_responses import SetResponses, load_step
from quell.tuning.structures.base import named
from quell.types import Vector

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
