"""The runs of a part of a sweep: what a worker does."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers.base import Controller, check_controller
from quell.lti.models import is_linear_model
from quell.parallel import one_blas_thread
from quell.plants.base import Plant, check_plant
from quell.plants.linear import LinearPlant
from quell.signals import Signal
from quell.simulation.scenario import Scenario, check_scenario
from quell.simulation.simulate import simulate
from quell.sweeping.measures import Measures, measure_runs
from quell.sweeping.plan import Part
from quell.types import Vector

ERROR = -1
"""Status of a run that could not be built, simulated or judged; its message says why."""

# Memory for the records of the runs that are simulated at once [bytes]: as quick as more, and many
# workers fit into a machine. Runs at once: enough that a batch's own cost is small. By hand.
_RECORD_BYTES, _MOST_AT_ONCE = 8e6, 256
# Seconds for which runs are repeated to know their time. By hand.
_TIMING = 2.0


@dataclass(frozen=True)
class Job:
    """The work of each run of a sweep."""

    build: Callable[..., Any]  #: returns the parts of a run, see ``sweep``
    measures: Measures
    record: tuple[str, ...]  #: channels that functions of a run need
    takes_seed: bool  #: whether ``build`` gets the seed of the run; otherwise the scenario does


class Parts(NamedTuple):
    """A plant, a controller and a scenario."""

    plant: Plant
    controller: Controller
    scenario: Scenario


class Outcome(NamedTuple):
    """Results of some runs."""

    measures: dict[str, Vector]
    status: NDArray[np.int64]  # flags, or ``ERROR``
    ended: Vector  # [s]
    messages: dict[int, str]  # why a run has ``ERROR``, by its place among them

    @classmethod
    def empty(cls, measures: Measures, runs: int) -> Outcome:
        """Return the outcome of ``runs`` runs of which nothing is known."""
        values = {name: np.full(runs, np.nan) for name in measures}
        return cls(values, np.full(runs, ERROR), np.full(runs, np.nan), {})


def run_part(job: Job, part: Part, runs: Sequence[int] | None = None) -> Outcome:
    """Do the runs of a part, by default all, some at a time; errors of single runs are recorded."""
    which = range(part.first, part.last) if runs is None else runs
    outcome = Outcome.empty(job.measures, len(which))
    at, size = 0, 1
    with one_blas_thread():
        while at < len(which):
            block = which[at : at + size]
            samples = _run_block(job, part, block, at, outcome)
            at += len(block)
            per_run = 8.0 * (len(job.record) + 1) * max(samples, 1)
            size = int(np.clip(_RECORD_BYTES / per_run, 1, _MOST_AT_ONCE))
    return outcome


def probe(job: Job, parts: Sequence[Part], more: Part) -> tuple[float, Outcome]:
    """Do the first run of each part; return the seconds for a run of many, and the outcome.

    This compiles the loops, or loads them from the disk cache, which all workers of a machine have
    in common. The time is that of runs in ``more``.
    """
    outcome = Outcome.empty(job.measures, len(parts))
    for i, part in enumerate(parts):
        found = run_part(job, part, [part.first])
        outcome.status[i] = found.status[0]
        if found.messages:
            outcome.messages[i] = found.messages[0]
    seconds = _seconds(job, more, 1)
    runs = min(int(_TIMING / max(seconds, 1e-9)), more.last - more.first)
    return _seconds(job, more, runs) / runs if runs > 1 else seconds, outcome


def _seconds(job: Job, part: Part, runs: int) -> float:
    """Return how long the first runs of a part take [s]."""
    began = time.perf_counter()
    run_part(job, part, range(part.first, part.first + runs))
    return time.perf_counter() - began


def built(job: Job, part: Part, run: int) -> Parts:
    """Return the parts of a run."""
    values = part.values(run)
    seed = part.seed(run)
    made = job.build(**values, seed=seed) if job.takes_seed else job.build(**values)
    plant, controller, scenario = _three(made)
    if not hasattr(plant, "sampled") and is_linear_model(plant):
        plant = LinearPlant.of(plant)
    check_plant(plant)
    check_controller(controller)
    check_scenario(scenario)
    if not job.takes_seed and is_random(scenario):
        scenario = replace(scenario, seed=seed)
    return Parts(plant, controller, scenario)


def is_random(scenario: Scenario) -> bool:
    """Return whether the signals of a scenario depend on its seed."""
    given: list[Any] = [scenario.reference, scenario.noise, *scenario.disturbances]
    return any(each.seeded(0) != each.seeded(1) for each in given if isinstance(each, Signal))


def _three(made: Any) -> tuple[Any, Any, Any]:
    needed = getattr(made, "needed", None)
    if callable(needed):  # a quell.setup.Setup
        return needed("plant"), made.controller, needed("scenario")
    try:
        plant, controller, scenario = made
    except (TypeError, ValueError):
        rule = "must return (plant, controller, scenario), or a setup"
        raise ValueError(f"build returned {made!r:.60}: {rule}") from None
    return plant, controller, scenario


def _run_block(job: Job, part: Part, runs: Sequence[int], at: int, outcome: Outcome) -> int:
    """Do some runs, whose places in the outcome begin at ``at``; return the samples of the longest.

    Runs that fit into a batch are simulated as one.
    """
    groups: dict[Hashable, list[tuple[int, Parts]]] = {}
    samples, scenario = 0, None
    for place, run in enumerate(runs, at):
        try:
            parts = built(job, part, run)
        except Exception as error:  # a function of the user's may raise anything
            outcome.messages[place] = _text(error)
            continue
        # Runs of one scenario share its samples.
        if scenario is not None and _same(scenario, parts.scenario):
            parts = parts._replace(scenario=scenario)
        scenario = parts.scenario
        groups.setdefault(_batch_key(parts), []).append((place, parts))
        samples = max(samples, int(scenario.duration / parts.controller.dt) + 1)
    for group in groups.values():
        _run_group(job, group, outcome)
    return samples


def _same(one: Scenario, other: Scenario) -> bool:
    try:
        return one is other or bool(one == other)
    except ValueError:  # arrays within them
        return False


def _batch_key(parts: Parts) -> Hashable:
    """Return what the runs of a batch must have in common."""
    plant, controller, scenario = parts
    about_plant = type(plant), plant.order, plant.disturbances
    about_controller = controller.dt, controller.channels, controller.features
    return *about_plant, *about_controller, type(controller), scenario.duration


def _run_group(job: Job, group: Sequence[tuple[int, Parts]], outcome: Outcome) -> None:
    """Simulate runs as one batch; if one of them makes that impossible, in halves."""
    places = [place for place, _ in group]
    plants, controllers, scenarios = zip(*(parts for _, parts in group), strict=True)
    options: dict[str, Any] = {"record": job.record, "workers": 1}
    try:
        result = simulate(list(plants), list(controllers), list(scenarios), **options)
    except Exception as error:  # a plant of the user's may raise anything
        if len(group) == 1:
            outcome.messages[places[0]] = _text(error).replace("run 0: ", "", 1)
            return
        half = len(group) // 2
        _run_group(job, group[:half], outcome)
        _run_group(job, group[half:], outcome)
        return
    values, errors = measure_runs(result, job.measures)
    for name, column in values.items():
        outcome.measures[name][places] = column
    outcome.ended[places] = result.ended
    outcome.status[places] = np.where([bool(text) for text in errors], ERROR, result.status)
    outcome.messages.update(
        {place: text for place, text in zip(places, errors, strict=True) if text}
    )


def _text(error: Exception) -> str:
    """Return the message of an error in one line, with its type if it is not about a value."""
    text = " ".join(str(error).split())
    return text if isinstance(error, ValueError) and text else f"{type(error).__name__}: {text}"
