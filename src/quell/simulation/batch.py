"""Many runs at once, on all cores: what ``simulate`` does with a batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.parallel import in_parallel, one_blas_thread
from quell.plants.batch import PlantBatch
from quell.records.batch_trajectory import BatchTrajectory
from quell.records.channels import columns_of, readable_names
from quell.simulation.driver import Course, Loop, Stretch, channels_of, check_part, pieces

_RECORDED = ("r", "y", "u")
# Runs in a job: enough that a thread seldom comes back for more, few enough that progress is told
# and no thread is left waiting.
_RUNS_AT_ONCE = 16


def simulate_batch(
    plant: Any,
    controller: Any,
    scenario: Any,
    record_every: int = 1,
    limit: float | None = None,
    interpret: bool = False,
    progress: Callable[[float], None] | None = None,
    record: Sequence[str] | None = None,
    workers: int | None = None,
) -> BatchTrajectory:
    """Run every plant of a batch; see ``quell.simulate``."""
    plants, controllers, scenarios = _parts(plant, controller, scenario)
    every = checks.whole("record_every", record_every, 1)
    workers = None if workers is None else checks.whole("workers", workers, 1)
    courses = _courses(scenarios, plants[0], controllers, limit)
    course, runs = courses[0], len(courses)
    every_channel = channels_of(plants[0], controllers[0])
    channels = _wanted(_RECORDED if record is None else record, every_channel)
    columns = [
        column
        for name, _ in channels
        for column in range(*columns_of(every_channel, name).indices(10**9))
    ]
    loops = _loops(plants, controllers, courses, interpret)
    # Column by column, so that a channel of all runs lies in one piece.
    log = np.moveaxis(np.empty((len(columns), runs, (course.samples - 1) // every + 1)), 0, -1)
    lengths = np.zeros(runs, dtype=np.int64)

    def proceed(
        which: NDArray[np.int64], first: int, last: int, shared: Mapping[int, Stretch]
    ) -> None:
        """Take some runs through a stretch, in a thread of its own."""
        own = np.empty(((last - first) // every + 1, sum(width for _, width in every_channel)))
        for i in which.tolist():
            stretch = shared.get(id(courses[i])) or courses[i].stretch(first, last)
            try:
                rows = loops[i].run(stretch, own, 0, every)
            except ValueError as error:
                raise ValueError(f"run {i}: {error}") from error
            at = int(lengths[i])
            for k, column in enumerate(columns):
                log[i, at : at + rows, k] = own[:rows, column]
            lengths[i] += rows

    for first, last in pieces(course.samples, set().union(*(c.rests for c in set(courses)))):
        live = np.array([i for i in range(runs) if not loops[i].diverged], dtype=np.int64)
        if live.size == 0:
            break
        shared = {id(c): c.stretch(first, last) for c in _several(courses)}
        jobs = [
            partial(proceed, live[i : i + _RUNS_AT_ONCE], first, last, shared)
            for i in range(0, live.size, _RUNS_AT_ONCE)
        ]
        in_parallel(jobs, _told(progress, first, last, course.samples), workers)
    for i in range(runs):
        log[i, lengths[i] :] = np.nan
    return BatchTrajectory(
        log=log,
        channels=channels,
        dt=course.dt,
        every=every,
        lengths=lengths,
        status=np.array([int(loop.status) for loop in loops]),
        ended=np.array([loop.ended for loop in loops]) * course.dt,
        limit=np.array([c.limit for c in courses]),
        plant=plants.name if isinstance(plants, PlantBatch) else plants[0].name,
        parameters=plants.parameters if isinstance(plants, PlantBatch) else {},
        features=controllers[0].features,
        final_states=tuple(loop.state for loop in loops),
    )


def _parts(
    plant: Any, controller: Any, scenario: Any
) -> tuple[Sequence[Any], Sequence[Any], Sequence[Any]]:
    """Return plants, controllers and scenarios, one for each run."""
    given = {"plant": plant, "controller": controller, "scenario": scenario}
    lengths = {name: len(value) for name, value in given.items() if isinstance(value, Sequence)}
    (leader, runs), *others = lengths.items()
    for name, length in others:
        if length != runs:
            raise ValueError(
                f"{name} has {length} entries, {leader} {runs}: must be one for all runs, or one for each"
            )
    if runs == 0:
        raise ValueError(f"{leader} has no entries: a batch must have at least one run")
    for kind, value in given.items():
        if kind not in lengths:
            check_part(kind, value)
        for i in range(lengths.get(kind, 0)):
            check_part(kind, value[i], f"{kind}[{i}]")
    plants = (
        plant
        if isinstance(plant, PlantBatch)
        else PlantBatch(plant)
        if "plant" in lengths
        else [plant] * runs
    )
    controllers, scenarios = (
        list(given[kind]) if kind in lengths else [given[kind]] * runs
        for kind in ("controller", "scenario")
    )
    for i, other in enumerate(controllers):
        for what in ("dt", "channels", "features"):
            mine, first = getattr(other, what), getattr(controllers[0], what)
            if mine != first:
                raise ValueError(
                    f"controller[{i}] has {what} = {mine!r}, controller[0] {first!r}: must be the same; run them as two batches"
                )
    return plants, controllers, scenarios


def _courses(
    scenarios: Sequence[Any], plant: Any, controllers: Sequence[Any], limit: float | None
) -> list[Course]:
    """Return the course of each run; runs of one scenario share theirs."""
    found: dict[tuple[int, int], Course] = {}
    courses: list[Course] = []
    for i, (scenario, controller) in enumerate(zip(scenarios, controllers, strict=True)):
        key = id(scenario), getattr(controller, "derivatives", 0)
        if key not in found:
            found[key] = Course.of(scenario, plant, controller, limit)
        courses.append(found[key])
        if courses[i].samples != courses[0].samples:
            raise ValueError(
                f"scenario[{i}] has duration = {scenario.duration!r} s, scenario[0] {scenarios[0].duration!r} s: "
                "must be the same in all runs of a batch; run them as two batches"
            )
    return courses


def _several(courses: Sequence[Course]) -> list[Course]:
    """Return the courses that more than one run takes."""
    count: dict[int, int] = {}
    for course in courses:
        count[id(course)] = count.get(id(course), 0) + 1
    return list({id(course): course for course in courses if count[id(course)] > 1}.values())


def _loops(
    plants: Sequence[Any], controllers: Sequence[Any], courses: Sequence[Course], interpret: bool
) -> list[Loop]:
    models: dict[int, Any] = {}
    with one_blas_thread():
        for plant in plants:
            if id(plant) not in models:
                models[id(plant)] = plant.sampled(courses[0].dt, interpret)
    return [
        Loop(plant, models[id(plant)], controllers[i], courses[i], interpret)
        for i, plant in enumerate(plants)
    ]


def _wanted(
    record: Sequence[str], channels: tuple[tuple[str, int], ...]
) -> tuple[tuple[str, int], ...]:
    """Return the channels of a log that are to be kept, in the log's order."""
    names = readable_names(channels)
    asked = set(names if record == "all" else [record] if isinstance(record, str) else record)
    for name in asked:
        checks.one_of("record", name, (*names, "all"))
    if not asked:
        raise ValueError(f"record = {record!r}: must name at least one channel")
    if "f_hat" in asked:
        asked |= {"f_learned", "f_residual"}
    return tuple((name, width) for name, width in channels if name in asked)


def _told(
    progress: Callable[[float], None] | None, first: int, last: int, samples: int
) -> Callable[[float], None] | None:
    return (
        None
        if progress is None
        else lambda share: progress((first + share * (last - first)) / samples)
    )
