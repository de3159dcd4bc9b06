"""The comparison of a setup: its own controller, and tuned ones for its plant, in its scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from quell.analysis import LoopAnalysis, analyse
from quell.controllers import Controller
from quell.experiments.compare.study import Comparison, compare
from quell.experiments.compare.tuned import STRUCTURES, Entry, of_loop, tuned
from quell.plants.linear_part import linear_model, linear_part
from quell.setup.loading import Setup
from quell.simulation import Scenario
from quell.tuning import Constraints
from quell.types import Progress

# Least bound of |T|: with integral action |T| is 1 at low frequencies, and rounding is beyond.
_LEAST_M_T = 1.01
OWN = "setup"
"""Name of the setup's own controller."""


@dataclass(frozen=True)
class SetupComparison:
    """A comparison: plant, controllers, constraints and results."""

    plant: str  #: name of the plant
    linear: Any  #: its linear part, for which the controllers were tuned
    dt: float
    controllers: Mapping[str, Controller]
    entries: Mapping[str, Entry]
    constraints: Constraints | None
    load_at: float | None
    result: Comparison


def of_setup(
    given: Setup,
    names: Sequence[str],
    bounds: tuple[float | None, float | None, float | None],
    load_at: float | None,
    progress: Progress,
) -> SetupComparison:
    """Compare ``names``, of ``"setup"`` and ``STRUCTURES``; raises ``ValueError`` for others.

    ``bounds`` are M_s, M_t and M_ks of tuned loops; those of the setup's controller, before it has
    learned anything, stand for None. Tuned controllers have its limits of u, too.
    """
    unknown = [name for name in names if name != OWN and name not in STRUCTURES]
    if unknown:
        known = ", ".join((OWN, *STRUCTURES))
        raise ValueError(f"controllers: {unknown[0]!r} must be one of {known}")
    plant, scenario = given.needed("plant"), given.needed("scenario")
    dt = float(given.controller.dt)
    linear, delay = linear_part(linear_model(plant), dt)
    chosen = [name for name in names if name != OWN]
    entries: dict[str, Entry] = {}
    constraints = None
    if chosen:
        how: dict[str, Any] = {"limits": _limits(given.controller), "delay": delay}
        wanted = _constraints(bounds, analyse(linear, given.controller, delay=delay))
        entries, constraints = tuned(linear, dt, chosen, wanted, progress=progress, **how)
    made = {name: e.controller for name, e in entries.items() if e.controller is not None}
    controllers = {name: given.controller if name == OWN else made.get(name) for name in names}
    possible = {name: each for name, each in controllers.items() if each is not None}
    begins = _begins(scenario) if load_at is None else load_at
    report = partial(progress, "runs")
    result = compare(plant, possible, scenario, load_at=begins, progress=report)
    whole = linear if delay == 0.0 else plant
    return SetupComparison(plant.name, whole, dt, possible, entries, constraints, begins, result)


def _constraints(
    bounds: tuple[float | None, float | None, float | None], own: LoopAnalysis
) -> Constraints:
    if None not in bounds or not own.stable:
        given = dict(zip(("m_s", "m_t", "m_ks"), bounds, strict=True))
        return Constraints(**{name: value for name, value in given.items() if value is not None})
    found = of_loop(own)
    pairs = zip(bounds, (found.m_s, found.m_t, found.m_ks), strict=True)
    m_s, m_t, m_ks = (other if bound is None else bound for bound, other in pairs)
    # Every loop has an M_s above 1, but |T| may be 1 at its largest.
    return Constraints(m_s=m_s, m_t=max(m_t, _LEAST_M_T), m_ks=m_ks)


def _limits(controller: Any) -> dict[str, Any]:
    inner = getattr(controller, "controller", controller)
    found = getattr(getattr(inner, "parameters", None), "limits", None)
    if found is None:
        return {}
    return {"u_min": float(found.low), "u_max": float(found.high)}


def _begins(scenario: Scenario) -> float | None:
    """Return when the first disturbance that begins later than the run does so [s], if any."""
    times = [float(getattr(each, "at", 0.0)) for each in scenario.disturbances]
    return min((time for time in times if 0.0 < time < scenario.duration), default=None)
