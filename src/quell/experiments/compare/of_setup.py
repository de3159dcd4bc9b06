"""The comparison of a setup: its own controller, and tuned ones for its plant, in its scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from quell.analysis import LoopAnalysis, analyse
from quell.controllers import Controller
from quell.controllers.prefilters.prefilter import without_prefilters
from quell.experiments.compare.study import Comparison, compare
from quell.experiments.compare.tuned import STRUCTURES, Entry, of_loop, tuned
from quell.plants.delay import delayed
from quell.plants.linear_part import linear_model, linear_part
from quell.setup.loading import Setup
from quell.setup.vary import varied
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
    notes: tuple[str, ...] = ()  #: what was changed so that all are compared alike


def of_setup(
    given: Setup,
    names: Sequence[str],
    bounds: tuple[float | None, float | None, float | None],
    load_at: float | None,
    progress: Progress,
) -> SetupComparison:
    """Compare ``names``, of ``"setup"`` and ``STRUCTURES``; raises ``ValueError`` for others.

    ``bounds`` are M_s, M_t and M_ks of tuned loops; those of [tune], or else of the setup's
    controller before it has learned anything, stand for None. The delay of [tune] is behind u in
    all loops, and no loop has feedforward, as not all structures can. Tuned controllers have the
    limits of u of the setup's, too.
    """
    unknown = [name for name in names if name != OWN and name not in STRUCTURES]
    if unknown:
        known = ", ".join((OWN, *STRUCTURES))
        raise ValueError(f"controllers: {unknown[0]!r} must be one of {known}")
    plant, scenario = given.needed("plant"), given.needed("scenario")
    dt = float(given.controller.dt)
    late = _late(plant, given, dt)
    if scenario.x0 is not None and late.order > plant.order:  # u was zero before
        x0 = [*np.asarray(scenario.x0).tolist(), *[0.0] * (late.order - plant.order)]
        scenario = replace(scenario, x0=x0)
    plant, own, notes = late, given.controller, list[str]()
    linear, delay = linear_part(linear_model(plant), dt)
    chosen = [name for name in names if name != OWN]
    entries: dict[str, Entry] = {}
    constraints = None
    if chosen and getattr(without_prefilters(own), "feedforward", False):
        own = varied(given, {"controller.feedforward": False}).controller
        notes.append(f"{OWN}: without its feedforward, which PID and LQG do not have")
    if chosen:
        how: dict[str, Any] = {"limits": _limits(given.controller), "delay": delay}
        wanted = _constraints(_asked(bounds, given), analyse(linear, own, delay=delay))
        entries, constraints = tuned(linear, dt, chosen, wanted, progress=progress, **how)
    made = {name: e.controller for name, e in entries.items() if e.controller is not None}
    controllers = {name: own if name == OWN else made.get(name) for name in names}
    possible = {name: each for name, each in controllers.items() if each is not None}
    begins = _begins(scenario) if load_at is None else load_at
    report = partial(progress, "runs")
    result = compare(plant, possible, scenario, load_at=begins, progress=report)
    whole = linear if delay == 0.0 else plant
    parts = plant.name, whole, dt, possible, entries, constraints, begins, result
    return SetupComparison(*parts, tuple(notes))


def _asked(
    bounds: tuple[float | None, float | None, float | None], given: Setup
) -> tuple[float | None, float | None, float | None]:
    """Return the bounds, those that [tune] names in place of None."""
    table = given.description.tune
    written = {} if table is None else table.written()
    m_s, m_t, m_ks = (
        written.get(name) if bound is None else bound
        for name, bound in zip(("m_s", "m_t", "m_ks"), bounds, strict=True)
    )
    return m_s, m_t, m_ks


def _late(plant: Any, given: Setup, dt: float) -> Any:
    """Return the plant behind the delay of [tune], which the design of `quell tune` has, too."""
    delay = (given.tune or {}).get("delay", 0.0)
    if not isinstance(delay, float | int):
        raise ValueError(f"tune.delay = {delay!r}: must be one number here, one plant is compared")
    return plant if delay == 0.0 else delayed(plant, delay, dt)


def _constraints(
    bounds: tuple[float | None, float | None, float | None], own: LoopAnalysis
) -> Constraints:
    if None not in bounds or not own.stable:
        given = zip(("m_s", "m_t", "m_ks"), bounds, strict=True)
        kept: dict[str, Any] = {name: value for name, value in given if value is not None}
        return Constraints(**kept, damping=None)
    found = of_loop(own)
    pairs = zip(bounds, (found.m_s, found.m_t, found.m_ks), strict=True)
    m_s, m_t, m_ks = (other if bound is None else bound for bound, other in pairs)
    # Every loop has an M_s above 1, but |T| may be 1 at its largest.
    return Constraints(m_s=m_s, m_t=max(m_t, _LEAST_M_T), m_ks=m_ks, damping=None)


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
