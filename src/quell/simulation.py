"""Plants and controllers through scenarios: one run, or many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from quell import checks
from quell.batch import simulate_batch
from quell.batch_record import BatchTrajectory
from quell.controllers.base import Controller
from quell.driver import Course, Loop, channels_of, check_part, pieces
from quell.models import is_model
from quell.plants.base import Plant
from quell.plants.linear import LinearPlant
from quell.signals import Constant, Signal, as_signal, seeded_apart
from quell.trajectory import Trajectory
from quell.types import Status


@dataclass(frozen=True)
class Scenario:
    """What happens to the loop.

    Parameters
    ----------
    reference
        what y has to follow [y-unit]; a signal or a number.
    disturbances
        one signal or number for each disturbance input of the plant, in its order; missing ones are zero.
    noise
        what is added to y before the controller sees it; none by default.
    duration
        how long it takes [s]; the record has the samples from 0 to ``duration``, both included.
    x0
        the plant's state at the start; zero by default.
    rest_at
        times [s] at which the plant is put back to ``x0`` and the controller starts from rest, with what it has learned.
    seed
        which noise; the same seed gives the same bits.

    Raises
    ------
    ValueError
        for a duration that is not positive, a seed below zero, something that is no signal, or ``rest_at`` times that do not increase
        within the duration.
    """

    reference: Signal | float = 0.0
    duration: float = 10.0
    disturbances: Sequence[Signal | float] = ()
    noise: Signal | float = 0.0
    x0: Any = None
    rest_at: Sequence[float] = field(default=())
    seed: int = 0

    def __post_init__(self) -> None:
        checks.positive("duration", self.duration, "s")
        checks.whole("seed", self.seed, 0)
        as_signal(self.reference, "reference")
        as_signal(self.noise, "noise")
        if not isinstance(self.disturbances, Sequence):
            raise ValueError(f"disturbances = {self.disturbances!r}: must be a sequence of signals or numbers, one for each input")
        for i, disturbance in enumerate(self.disturbances):
            as_signal(disturbance, f"disturbances[{i}]")
        times = checks.vector("rest_at", self.rest_at)
        if times.size and (np.any(np.diff(times) <= 0.0) or times[0] <= 0.0 or times[-1] >= self.duration):
            raise ValueError(f"rest_at = {self.rest_at!r}: must increase and lie within (0, duration = {self.duration!r})")

    def seeded_signals(self, inputs: int) -> tuple[Signal, tuple[Signal, ...], Signal]:
        """Return the reference, ``inputs`` disturbances and the noise, with all that is random drawn from ``seed``."""
        if len(self.disturbances) > inputs:
            raise ValueError(f"disturbances has {len(self.disturbances)} signals: the plant has {inputs} disturbance inputs")
        given = (as_signal(self.reference), *map(as_signal, self.disturbances))
        noise = as_signal(self.noise).seeded(self.seed)
        # The noise takes the seed itself, so that its bits do not depend on how many disturbances there are.
        reference, *disturbances = seeded_apart(given, self.seed)
        return reference, (*disturbances, *[Constant(0.0)] * (inputs - len(disturbances))), noise


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

    The controller starts with nothing learned, on a state of its own: neither it nor the plant is changed.

    Parameters
    ----------
    plant, controller, scenario
        what to run; the sample time is the controller's. A linear plant may also be given as ``LinearPlant.of`` takes it, for example as
        ``(numerator, denominator)``: numbers in a tuple or a list are one plant. Where one of the three is a sequence of plants
        (``quell.plants.batch``, or a list of them), controllers or scenarios, it is a
        batch: a run for each of its entries, the others the same in all runs or a sequence of the same length. Run i is, bit for bit, what
        ``simulate`` gives for the i-th plant, controller and scenario alone. So all runs of one scenario have the same noise; for other
        noise give a sequence of scenarios with other seeds. All runs of a batch have the same sample time and duration.
    record_every
        keep every so-many-th sample; the memory used is that of the record.
    limit
        the run ends early, with ``Status.DIVERGED``, where ``|y|`` goes beyond it or is not finite [y-unit]; by default at a million
        times the largest of 1, ``|x0|`` and the reference in the first samples.
    interpret
        run the same functions as plain Python, the plant's too, to debug; about a thousand times slower.
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
        for arguments out of range, a plant that ``LinearPlant.of`` refuses, an x0 of the wrong size, more disturbances than the plant has
        inputs, or runs that do not fit into one batch.
    """
    if not hasattr(plant, "sampled") and is_model(plant):
        plant = LinearPlant.of(plant)
    if any(isinstance(value, Sequence) for value in (plant, controller, scenario)):
        return simulate_batch(plant, controller, scenario, record_every, limit, interpret, progress, record, workers)
    for name, value in (("record", record), ("workers", workers)):
        if value is not None:
            raise ValueError(f"{name} = {value!r}: is for a batch; a single run records all channels, in this thread")
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
