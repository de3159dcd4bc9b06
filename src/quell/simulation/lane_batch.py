"""Batches of linear runs over lanes: the work of ``simulate(..., exact=False)``.

The equations are those of the controllers and plants (``lanes.py``); only the order of sums
differs. Whatever does not qualify (``lane_groups.py``), and whatever turns out to be irregular, is
left to the exact loop.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers.base import Controller
from quell.kernels.lanes import LANES
from quell.parallel import in_parallel, part_of
from quell.plants.base import Plant
from quell.simulation.lane_groups import Group, LinearRun, groups_of, linear_runs
from quell.simulation.lanes import COLLECTED, run_lanes
from quell.simulation.sampled_scenario import SampledScenario, segment_bounds
from quell.types import Status

# Few enough that handing out jobs takes little of a thread's time, enough that all threads end at
# about the same time. Chosen by hand.
_JOBS_PER_THREAD = 4

Inputs = NDArray[np.float64]  # w, r and its derivatives, noise (samples, …)


class Outcome(NamedTuple):
    """Arrays that a batch writes; the runs are the last axis but that of the samples."""

    log: NDArray[np.float64]  # (rows, runs, samples)
    lengths: NDArray[np.int64]  # recorded samples (runs,)
    status: NDArray[np.int64]  # flags (runs,)
    ended: NDArray[np.int64]  # last sample, or the one at which a run diverged (runs,)


def run_over_lanes(
    plants: Sequence[Plant],
    controllers: Sequence[Controller],
    scenarios: Sequence[SampledScenario],
    recorded: Sequence[tuple[str, int]],
    every: int,
    outcome: Outcome,
    progress: Callable[[float], None] | None = None,
    workers: int | None = None,
) -> list[int]:
    """Run what qualifies over lanes; return the indices of the runs that are left.

    ``recorded`` has the channel and the place in it of each row of the log.
    """
    runs, samples = linear_runs(plants, controllers, scenarios), scenarios[0].samples
    groups = list(groups_of(runs, recorded))
    rests = set[int]().union(*(s.rest_samples for s in {id(s): s for s in scenarios}.values()))
    places = [(0, 0)] * len(groups)
    for first, last in segment_bounds(samples, rests) if groups else ():
        live = [i for i, group in enumerate(groups) if np.any(group.lanes.ended < 0)]
        shared = _shared_inputs([groups[i] for i in live], first, last)
        steps = [
            partial(_run_group, groups[i], shared, first, last, outcome.log, every, places[i])
            for i in live
        ]
        size = max(1, len(steps) // (_JOBS_PER_THREAD * (workers or os.cpu_count() or 1)))
        jobs = [partial(_run_all, steps[k : k + size]) for k in range(0, len(steps), size)]
        done = part_of(progress, first * len(runs), last * len(runs), samples * len(plants))
        for i, place in zip(live, chain(*in_parallel(jobs, done, workers)), strict=True):
            places[i] = place
    left = set(range(len(plants)))
    for group, (row, _) in zip(groups, places, strict=True):
        left -= set(_conclude(group, row, samples, outcome))
    return sorted(left)


def _run_all(steps: Sequence[Callable[[], tuple[int, int]]]) -> list[tuple[int, int]]:
    return [step() for step in steps]


def _shared_inputs(groups: Sequence[Group], first: int, last: int) -> Mapping[int, Inputs]:
    """Return the inputs of a segment that several runs have."""
    runs = [run for group in groups for run in group.runs]
    counts = Counter(run.signals for run in runs)
    scenarios = {run.signals: run for run in runs if counts[run.signals] > 1}
    return {key: _inputs(run, first, last) for key, run in scenarios.items()}


def _inputs(run: LinearRun, first: int, last: int) -> Inputs:
    segment = run.scenario.segment(first, last)
    return np.column_stack([segment.w, segment.r, segment.derivatives, segment.noise])


def _run_group(
    group: Group,
    shared: Mapping[int, Inputs],
    first: int,
    last: int,
    log: NDArray[np.float64],
    every: int,
    place: tuple[int, int],
) -> tuple[int, int]:
    """Take a group through a segment, in a thread; return the place in the log to go on at."""
    _start(group, first)
    inputs = _inputs_of_lanes(group.runs, shared, first, last)
    rows, (row, until_next) = group.lanes.rows, place
    # Columns of the inputs by the row that they are copied to; recorded inputs are written here.
    columns = {rows.w + j: j for j in range(rows.u_plant - rows.w)} | {
        rows.v: rows.u_plant - rows.w
    }
    targets = np.array([c for c, r in enumerate(group.channels) if r not in columns], np.int64)
    collected = np.empty((COLLECTED, targets.size, LANES))
    runs = np.array([run.place for run in group.runs], np.int64)
    channels = group.channels[targets]
    end, after = run_lanes(
        group.lanes, inputs, first, log, channels, targets, runs, collected, *place, every
    )
    for c, r in enumerate(group.channels.tolist()):
        if r in columns:
            log[c, runs, row:end] = inputs[until_next::every, columns[r], : len(runs)].T
    return int(end), int(after)


def _inputs_of_lanes(
    runs: Sequence[LinearRun], shared: Mapping[int, Inputs], first: int, last: int
) -> Inputs:
    """Return the inputs (samples, …, lanes), with one lane if they are the same for all runs."""
    each = {run.signals: run for run in runs}
    parts = {
        key: shared[key] if key in shared else _inputs(run, first, last)
        for key, run in each.items()
    }
    if len(parts) == 1:
        return next(iter(parts.values()))[..., None]
    inputs = np.zeros((*parts[runs[0].signals].shape, LANES))
    for i, run in enumerate(runs):
        inputs[..., i] = parts[run.signals]
    return inputs


def _start(group: Group, first: int) -> None:
    """Put the plants to their initial states where a run starts, at first or from rest."""
    lanes, rows = group.lanes, group.lanes.rows
    which = lanes.ended < 0
    for i, run in enumerate(group.runs):
        which[i] &= first == 0 or first in run.scenario.rest_samples
    lanes.starting[:] = which
    if np.any(which):
        n = lanes.plant.shape[0]
        for begin, end, value in (
            (rows.x, rows.x + n, group.x0[:n]),
            (rows.plant_delay, rows.law_delay, group.x0[n:]),
            (rows.law_delay, rows.end, 0.0),
            (rows.u, rows.u + 1, 0.0),
        ):
            lanes.values[begin:end] = np.where(which, value, lanes.values[begin:end])


def _conclude(group: Group, row: int, samples: int, outcome: Outcome) -> list[int]:
    """Write lengths, status and ends of the runs that are regular; return their indices."""
    count = len(group.runs)
    lanes = group.lanes
    regular = np.flatnonzero(lanes.irregular[:count] == 0)
    which = np.array([run.place for run in group.runs])[regular]
    ended, diverged = lanes.ended[regular], lanes.ended[regular] >= 0
    flags = np.sum(lanes.seen, axis=0).astype(np.int64)[regular]
    outcome.status[which] = flags | np.where(diverged, int(Status.DIVERGED), 0)
    outcome.ended[which] = np.where(diverged, ended, samples - 1)
    outcome.lengths[which] = np.where(diverged, lanes.lengths[regular], row)
    return [int(i) for i in which]
