"""Many runs at once, on all cores: what ``simulate`` does with a batch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import Controller, check_controller
from quell.kernels.sized import layout_of
from quell.parallel import in_parallel, one_blas_thread, part_of
from quell.plants.base import Plant, check_plant
from quell.plants.batch import PlantBatch
from quell.plants.labelled import signals_of
from quell.records.batch_trajectory import BatchTrajectory
from quell.records.channels import columns_of, readable_names, signals_of_loop
from quell.simulation.divergence import judge_integration
from quell.simulation.driver import SIGNALS, Loop, logged_channels
from quell.simulation.sampled_scenario import SampledScenario, Segment, segment_bounds
from quell.simulation.scenario import Scenario, check_scenario
from quell.types import Channels

_RECORDED = ("r", "y", "u")
# Runs in a job: enough that threads seldom wait for the next one, few enough that progress is
# reported often and that all threads end at about the same time. Chosen by hand.
_RUNS_PER_JOB = 16


class Outcome(NamedTuple):
    """Arrays that a batch writes; the runs are the last axis but that of the samples."""

    log: NDArray[np.float64]  # (rows, runs, samples)
    lengths: NDArray[np.int64]  # recorded samples (runs,)
    status: NDArray[np.int64]  # flags (runs,)
    ended: NDArray[np.int64]  # last sample, or the one at which a run diverged (runs,)


def simulate_batch(
    plant: Plant | Sequence[Plant],
    controller: Controller | Sequence[Controller],
    scenario: Scenario | Sequence[Scenario],
    record_every: int = 1,
    limit: float | None = None,
    interpret: bool = False,
    progress: Callable[[float], None] | None = None,
    record: Sequence[str] | None = None,
    workers: int | None = None,
) -> BatchTrajectory:
    """Run every plant, controller and scenario of a batch; see ``quell.simulate``."""
    plants, controllers, scenarios = _members(plant, controller, scenario)
    every = checks.whole("record_every", record_every, 1)
    workers = None if workers is None else checks.whole("workers", workers, 1)
    checks.optional(checks.positive, "limit", limit)
    sampled = _sampled(scenarios, plants[0], controllers, limit)
    dt, samples, runs = sampled[0].dt, sampled[0].samples, len(sampled)
    logged = logged_channels(plants[0], controllers[0])
    width = sum(width for _, width in logged)
    channels = _selected(_RECORDED if record is None else record, logged)
    columns = [k for name, _ in channels for k in range(width)[columns_of(logged, name)]]
    recorded = [(name, j) for name, width in channels for j in range(width)]
    # Channel by channel, so that a channel of all runs is contiguous in memory.
    log = np.empty((len(recorded), runs, (samples - 1) // every + 1))
    outcome = Outcome(log, *(np.zeros(runs, dtype=np.int64) for _ in range(3)))
    loops: list[Loop] = []
    first: dict[Any, Loop] = {}
    for i, model in enumerate(_models(plants, dt, interpret)):
        compiled = not interpret and plants[i].compiled
        structure = (id(controllers[i]), layout_of(model)) if compiled else i
        like = first.get(structure)
        loops.append(Loop(plants[i], model, controllers[i], sampled[i], interpret, like))
        first.setdefault(structure, loops[i])
    if max(columns) < len(SIGNALS) and not any(loop.integration.needed for loop in loops):
        width = len(SIGNALS)  # states and estimates are not used
    _run_loops(loops, columns, width, every, outcome, progress, workers)
    for i in np.flatnonzero(outcome.lengths < log.shape[2]).tolist():
        log[:, i, outcome.lengths[i] :] = np.nan
    name = plants.name if isinstance(plants, PlantBatch) else plants[0].name
    judge_integration(name, loops)
    for i, loop in enumerate(loops):
        outcome.status[i], outcome.ended[i] = int(loop.result_status), loop.ended
    return BatchTrajectory(
        log=np.moveaxis(log, 0, -1),
        channels=channels,
        dt=dt,
        every=every,
        lengths=outcome.lengths,
        status=outcome.status,
        ended=np.asarray(outcome.ended * dt, dtype=np.float64),
        limit=np.array([s.limit for s in sampled]),
        plant=name,
        parameters=plants.parameters if isinstance(plants, PlantBatch) else {},
        features=controllers[0].features,
        signals=signals_of_loop(signals_of(plants[0]), controllers[0]),
        final_states=tuple(loop.state for loop in loops),
    )


def _run_loops(
    loops: Sequence[Loop],
    columns: Sequence[int],
    width: int,
    every: int,
    outcome: Outcome,
    progress: Callable[[float], None] | None,
    workers: int | None,
) -> None:
    """Run the loops of a batch and record some columns of their logs."""
    log, lengths = outcome.log, outcome.lengths

    def run_some(
        which: Sequence[int], first: int, last: int, shared: Mapping[SampledScenario, Segment]
    ) -> None:
        """Take some runs through a segment, in a thread."""
        buffer = np.empty(((last - first) // every + 1, width))
        for i in which:
            segment = shared.get(loops[i].scenario) or loops[i].scenario.segment(first, last)
            try:
                rows = loops[i].run(segment, buffer, 0, every)
            except ValueError as error:
                raise ValueError(f"run {i}: {error}") from error
            at = int(lengths[i])
            for k, column in enumerate(columns):
                log[k, i, at : at + rows] = buffer[:rows, column]
            lengths[i] += rows

    counts = Counter(loop.scenario for loop in loops)
    samples = max((scenario.samples for scenario in counts), default=0)
    for first, last in segment_bounds(samples, set().union(*(s.rest_samples for s in counts))):
        live = [i for i, loop in enumerate(loops) if not loop.diverged]
        if not live:
            break
        shared = {s: s.segment(first, last) for s, count in counts.items() if count > 1}
        jobs = [
            partial(run_some, live[i : i + _RUNS_PER_JOB], first, last, shared)
            for i in range(0, len(live), _RUNS_PER_JOB)
        ]
        in_parallel(jobs, part_of(progress, first, last, samples), workers)


def _members(
    plant: Any, controller: Any, scenario: Any
) -> tuple[Sequence[Plant], Sequence[Controller], Sequence[Scenario]]:
    """Return plants, controllers and scenarios, one for each run."""
    given = {"plant": plant, "controller": controller, "scenario": scenario}
    check = {"plant": check_plant, "controller": check_controller, "scenario": check_scenario}
    lengths = {name: len(value) for name, value in given.items() if checks.is_sequence(value)}
    (leader, runs), *others = lengths.items()
    for name, length in others:
        if length != runs:
            raise ValueError(
                f"{name} has {length} entries, {leader} {runs}: "
                "must be one for all runs, or one for each"
            )
    if runs == 0:
        raise ValueError(f"{leader} has no entries: a batch must have at least one run")
    for name, value in given.items():
        if name not in lengths:
            check[name](value, name)
            given[name] = [value] * runs
        else:
            for i in range(runs):
                check[name](value[i], f"{name}[{i}]")
    plants = given["plant"]
    controllers, scenarios = list(given["controller"]), list(given["scenario"])
    if "plant" in lengths and not isinstance(plants, PlantBatch):
        plants = PlantBatch(plants)
    for i, other in enumerate(controllers):
        if other is controllers[0]:
            continue
        for what in ("dt", "channels", "features"):
            value, first = getattr(other, what), getattr(controllers[0], what)
            if value != first:
                raise ValueError(
                    f"controller[{i}] has {what} = {value!r}, controller[0] {first!r}: "
                    "must be the same; run them as two batches"
                )
    return plants, controllers, scenarios


def _sampled(
    scenarios: Sequence[Scenario], plant: Plant, controllers: Sequence[Controller], limit: Any
) -> list[SampledScenario]:
    """Return the sampled scenario of each run; runs of one scenario share theirs."""
    found: dict[tuple[int, int], SampledScenario] = {}
    sampled: list[SampledScenario] = []
    for i, (scenario, controller) in enumerate(zip(scenarios, controllers, strict=True)):
        key = id(scenario), getattr(controller, "derivatives", 0)
        if key not in found:
            try:
                found[key] = SampledScenario.of(scenario, plant, controller, limit)
            except ValueError as error:
                where = "" if all(each is scenario for each in scenarios) else f"scenario[{i}]: "
                raise ValueError(f"{where}{error}") from None
        sampled.append(found[key])
        if sampled[i].samples != sampled[0].samples:
            raise ValueError(
                f"scenario[{i}] has duration = {scenario.duration!r} s, scenario[0] "
                f"{scenarios[0].duration!r} s: must be the same in all runs of a batch; "
                "run them as two batches"
            )
    return sampled


def _models(plants: Sequence[Plant], dt: float, interpret: bool) -> list[Any]:
    """Return the sampled model of each plant; a plant that occurs in many runs is sampled once."""
    distinct = {id(plant): plant for plant in plants}
    with one_blas_thread():
        models = {key: plant.sampled(dt, interpret) for key, plant in distinct.items()}
    return [models[id(plant)] for plant in plants]


def _selected(record: Sequence[str], logged: Channels) -> Channels:
    """Return the channels of a log that are to be recorded, in the log's order."""
    names = readable_names(logged)
    wanted = set(names if record == "all" else [record] if isinstance(record, str) else record)
    for name in wanted:
        checks.one_of("record", name, (*names, "all"))
    if not wanted:
        raise ValueError(f"record = {record!r}: must name at least one channel")
    if "f_hat" in wanted:
        wanted |= {"f_learned", "f_residual"}
    return tuple((name, width) for name, width in logged if name in wanted)
