"""Simulation of plants and controllers through scenarios: one run, or many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from quell import checks
from quell.controllers.base import Controller
from quell.lti.models import is_linear_model
from quell.plants.base import Plant
from quell.plants.linear import LinearPlant
from quell.records.batch_trajectory import BatchTrajectory
from quell.records.trajectory import Trajectory
from quell.simulation.batch import simulate_batch
from quell.simulation.driver import Course, Loop, channels_of, check_part, pieces
from quell.simulation.scenario import Scenario
from quell.types import Status


@overload
def simulate(  # type: ignore[overload-overlap]  # a plant is no sequence
    plant: Plant | tuple[ArrayLike, ...],
    controller: Controller,
    scenario: Scenario,
    *,
    record_every: int = 1,
    limit: float | None = None,
    interpret: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Trajectory: ...
@overload
def simulate(
    plant: Plant | Sequence[Plant],
    controller: Controller | Sequence[Controller],
    scenario: Scenario | Sequence[Scenario],
    *,
    record_every: int = 1,
    limit: float | None = None,
    interpret: bool = False,
    progress: Callable[[float], None] | None = None,
    record: Sequence[str] | None = None,
    workers: int | None = None,
) -> BatchTrajectory: ...
def simulate(
    plant: Any,
    controller: Any,
    scenario: Any,
    *,
    record_every: int = 1,
    limit: float | None = None,
    interpret: bool = False,
    progress: Callable[[float], None] | None = None,
    record: Sequence[str] | None = None,
    workers: int | None = None,
) -> Trajectory | BatchTrajectory:
    """Run a controller on a plant through a scenario; or many of them, each on its own, on all cores.

    The controller starts with nothing learned, on a state of its own: neither it nor the plant is
    changed.

    Parameters
    ----------
    plant, controller, scenario
        what to run; the sample time is the controller's. A linear plant may also be given as
        ``LinearPlant.of`` takes it, for example as ``(numerator, denominator)``: numbers in a tuple
        or a list are one plant. Where one of the three is a sequence of plants
        (``quell.plants.batch``, or a list of them), controllers or scenarios, it is a batch: a run
        for each of its entries, the others the same in all runs or a sequence of the same length.
        Run i is, bit for bit, what ``simulate`` gives for the i-th plant, controller and scenario
        alone. So all runs of one scenario have the same noise; for other noise give a sequence of
        scenarios with other seeds. All runs of a batch have the same sample time and duration.
    record_every
        keep every so-many-th sample; the memory used is that of the record.
    limit
        the run ends early, with ``Status.DIVERGED``, where ``|y|`` goes beyond it or is not finite
        [y-unit]; by default at a million times the largest of 1, ``|x0|`` and the reference in the
        first samples.
    interpret
        run the same functions as plain Python, the plant's too, to debug; about a thousand times
        slower.
    progress
        called with the share done, 0 to 1, every few thousand samples, or every few runs.
    record
        for a batch: the channels to keep; ``("r", "y", "u")`` by default. A single run keeps all.
    workers
        for a batch: how many threads share it; as many as there are cores by default.

    Returns
    -------
    Trajectory or BatchTrajectory
        what was recorded, as far as the run went.

    Raises
    ------
    ValueError
        for arguments out of range, a plant that ``LinearPlant.of`` refuses, an x0 of the wrong
        size, more disturbances than the plant has inputs, or runs that do not fit into one batch.
    """
    if not hasattr(plant, "sampled") and is_linear_model(plant):
        plant = LinearPlant.of(plant)
    if any(isinstance(value, Sequence) for value in (plant, controller, scenario)):
        return simulate_batch(
            plant, controller, scenario, record_every, limit, interpret, progress, record, workers
        )
    for name, value in (("record", record), ("workers", workers)):
        if value is not None:
            raise ValueError(
                f"{name} = {value!r}: is for a batch; a single run records all channels, in this thread"
            )
    check_part("plant", plant)
    check_part("controller", controller)
    check_part("scenario", scenario)
    every = checks.whole("record_every", record_every, 1)
    course = Course.of(scenario, plant, controller, limit)
    loop = Loop(plant, plant.sampled(course.dt, interpret), controller, course, interpret)
    channels = channels_of(plant, controller)
    log = np.empty(((course.samples - 1) // every + 1, sum(width for _, width in channels)))
    row = 0
    for first, last in pieces(course.samples, course.rests):
        row = loop.run(course.stretch(first, last), log, row, every)
        if loop.diverged:
            break
        if progress is not None:
            progress(last / course.samples)
    return Trajectory(
        log=log[:row],
        channels=channels,
        dt=course.dt,
        every=every,
        status=Status(loop.status),
        ended=loop.ended * course.dt,
        limit=course.limit,
        plant=plant.name,
        features=controller.features,
        final_state=loop.state,
    )
