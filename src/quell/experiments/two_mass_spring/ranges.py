"""Means and 95 % intervals over seeds of the noise, under forces of three frequencies.

The rows are all controllers of the study: those of the paper, those that were added, and what a
learner is made of, one by one. The step and the margins are those of the run with the paper's
force, because a force begins after the step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from scipy.special import stdtrit

from quell.controllers.adrc.adrc import ADRC
from quell.experiments.common.scores import Scores
from quell.experiments.two_mass_spring.setup import (
    LOADS,
    PAPERS_LOAD,
    Settings,
    controllers,
    further_controllers,
    margins,
    quick_run,
    scenario,
    score,
)
from quell.parallel import in_parallel
from quell.plants import two_mass_spring
from quell.simulation.simulate import simulate
from quell.types import Progress

_OF_STEP = ("overshoot", "settling_time", "control_variation")


@dataclass(frozen=True)
class Range:
    """Mean of a score over the seeds; None where a run has none, as one that diverged."""

    mean: float | None
    half_width: float | None  #: of the 95 % interval of the mean, by Student's t; None for a seed
    missing: int  #: runs without this score


Ranges: TypeAlias = Mapping[str, Mapping[str, Range]]


def peak_name(load: float) -> str:
    """Return the name of the largest distance of y from 1 under a force of a frequency [rad/s]."""
    return f"peak_at_{load:.3g}"


SCORES = (*_OF_STEP, *map(peak_name, LOADS), "m_s", "m_ks")
"""Names of the scores that have ranges."""


def all_controllers(settings: Settings) -> dict[str, ADRC]:
    """Return the controllers of the ranges by name."""
    return controllers(settings) | further_controllers(settings)


def ranges(settings: Settings, progress: Progress | None = None) -> Ranges:
    """Run every controller with the seeds ``seed`` … ``seed + seeds − 1`` and each force."""
    progress = progress or (lambda part, share: None)
    laws = all_controllers(settings)
    seeds = [settings.seed + i for i in range(settings.seeds)]
    jobs = [
        partial(_scores, replace(settings, seed=seed), law, load)
        for law in laws.values()
        for seed in seeds
        for load in LOADS
    ]
    done = in_parallel(jobs, partial(progress, "seeds and forces"))
    count = len(seeds) * len(LOADS)
    parts = {name: done[i * count : (i + 1) * count] for i, name in enumerate(laws)}
    return {name: _of_scores(found) for name, found in parts.items()}


def _scores(settings: Settings, law: ADRC, load: float) -> Scores:
    """Return the peak under one force, and under the paper's all else, too."""
    if load != PAPERS_LOAD:
        return {peak_name(load): score(quick_run(settings, law, load))["disturbance_peak"]}
    run = simulate(two_mass_spring(), law, scenario(settings))
    found = score(run) | margins(law, run)
    wanted = {name: found[name] for name in (*_OF_STEP, "m_s", "m_ks")}
    return wanted | {peak_name(load): found["disturbance_peak"]}


def _of_scores(found: Iterable[Scores]) -> dict[str, Range]:
    runs = list(found)
    return {name: range_of(run[name] for run in runs if name in run) for name in SCORES}


def range_of(values: Iterable[float | None]) -> Range:
    """Return mean and interval of values; a mean over some of the runs alone would mislead."""
    every = list(values)
    given = np.array([value for value in every if value is not None])
    if given.size < len(every) or given.size == 0:
        return Range(None, None, len(every) - given.size)
    half = None
    if given.size > 1:
        deviation = float(np.std(given, ddof=1))
        half = float(stdtrit(given.size - 1, 0.975)) * deviation / math.sqrt(given.size)
    return Range(float(np.mean(given)), half, 0)


def ranges_to_json(found: Ranges, settings: Settings) -> dict[str, Any]:
    """Return plain data for ``json.dump``."""
    rows = {
        name: {key: asdict(each) for key, each in scores.items()} for name, scores in found.items()
    }
    loads = {peak_name(load): load for load in LOADS}
    return {"ranges": {"seeds": settings.seeds, "loads": loads, "controllers": rows}}
