"""``simulate``: one run of a plant and a controller through a scenario, or a batch of runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from quell import checks
from quell.controllers.base import Controller, check_controller
from quell.controllers.limits import limits_of
from quell.controllers.single import check_compilable, in_single_precision
from quell.kernels import dispatch
from quell.lti.models import is_linear_model
from quell.plants.base import Plant, check_plant
from quell.plants.labelled import signals_of
from quell.plants.linear import LinearPlant
from quell.records.batch_trajectory import BatchTrajectory
from quell.records.channels import signals_of_loop
from quell.records.trajectory import Trajectory
from quell.simulation.batch import simulate_batch
from quell.simulation.divergence import judge_integration
from quell.simulation.driver import Loop, logged_channels
from quell.simulation.sampled_scenario import SampledScenario, segments
from quell.simulation.scenario import Scenario, check_scenario


@overload
def simulate(  # type: ignore[overload-overlap]  # a plant is no sequence
    plant: Plant | tuple[ArrayLike, ...],
    controller: Controller,
    scenario: Scenario,
    *,
    record_every: int = 1,
    limit: float | None = None,
    interpret: bool = False,
    precision: str = "double",
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
    precision: str = "double",
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
    precision: str = "double",
    progress: Callable[[float], None] | None = None,
    record: Sequence[str] | None = None,
    workers: int | None = None,
) -> Trajectory | BatchTrajectory:
    """Run a controller on a plant through a scenario, or a batch of them on all cores.

    The controller starts with nothing learned, from a new state: neither it nor the plant is
    changed.

    Parameters
    ----------
    plant, controller, scenario
        parts of the loop; the sample time is the controller's. A linear plant may also be any
        argument of ``LinearPlant.of``, for example ``(numerator, denominator)``: a tuple or a list
        of numbers is one plant. If one of the three is a sequence of plants (``quell.plants.batch``
        or a list), controllers or scenarios, it is a batch: one run for each of its entries; the
        others are the same in all runs or a sequence of the same length. Run i is, bit for bit, the
        result of ``simulate`` for the i-th plant, controller and scenario alone. So all runs of one
        scenario have the same noise; for different noise pass scenarios with different seeds. All
        runs of a batch have the same sample time and duration.
    record_every
        record every ``record_every``-th sample; memory is used only for these.
    limit
        the run ends early, with ``Status.DIVERGED``, if ``|y|`` exceeds it or is not finite
        [y-unit]; by default a million times the largest of 1, ``|x0|`` and the reference in the
        first samples.
    interpret
        run the same functions as plain Python, the plant's too, to debug; about a thousand times
        slower.
    precision
        of the controller: ``"double"``, or ``"single"`` for what it computes on a processor without
        double precision (``quell.controllers.in_single_precision``). The plant is always in double;
        r and y are rounded where the controller receives them.
    progress
        called with the share done, 0 to 1, every few thousand samples, or every few runs.
    record
        for a batch: channels to record, ``("r", "y", "u")`` by default. A single run records all.
    workers
        for a batch: number of threads; the number of cores by default.

    Returns
    -------
    Trajectory or BatchTrajectory
        the recorded samples, up to the end of the run.

    Raises
    ------
    ValueError
        for arguments out of range, a plant that ``LinearPlant.of`` refuses, an x0 of the wrong
        size, more disturbances than the plant has inputs, or runs that do not fit into one batch.

    Warns
    -----
    DesignWarning
        if a nonlinear plant has too few sub-steps; the status then has ``POORLY_INTEGRATED``. A run
        that diverged is repeated with enough of them, to find out whether they were the cause.
    """
    interpret = interpret or dispatch.interpret_all
    if not hasattr(plant, "sampled") and is_linear_model(plant):
        plant = LinearPlant.of(plant)
    if checks.one_of("precision", precision, ("double", "single")) == "single":
        if not interpret:
            check_compilable()
        several = checks.is_sequence(controller)
        controller = _in_single(controller) if several else in_single_precision(controller)
    if any(checks.is_sequence(value) for value in (plant, controller, scenario)):
        options = (record_every, limit, interpret, progress, record, workers)
        return simulate_batch(plant, controller, scenario, *options)
    for name, value in (("record", record), ("workers", workers)):
        if value is not None:
            rule = "is for a batch; a single run records all channels, in this thread"
            raise ValueError(f"{name} = {value!r}: {rule}")
    check_plant(plant)
    check_controller(controller)
    check_scenario(scenario)
    every = checks.whole("record_every", record_every, 1)
    sampled = SampledScenario.of(scenario, plant, controller, limit)
    dt, samples = sampled.dt, sampled.samples
    loop = Loop(plant, plant.sampled(dt, interpret), controller, sampled, interpret)
    channels = logged_channels(plant, controller)
    log = np.empty(((samples - 1) // every + 1, loop.width))
    row = 0
    for segment in segments(sampled):
        row = loop.run(segment, log, row, every)
        if loop.diverged:
            break
        if progress is not None:
            progress(loop.done / samples)
    judge_integration(plant.name, [loop])
    return Trajectory(
        log=log[:row],
        channels=channels,
        dt=dt,
        every=every,
        status=loop.result_status,
        ended=loop.ended * dt,
        limit=sampled.limit,
        plant=plant.name,
        features=controller.features,
        signals=signals_of_loop(signals_of(plant), controller),
        u_limits=limits_of(controller),
        final_state=loop.state,
    )


def _in_single(controllers: Sequence[Controller]) -> list[Controller]:
    """Return controllers in single precision; what is the same object stays so."""
    single = {id(controller): in_single_precision(controller) for controller in controllers}
    return [single[id(controller)] for controller in controllers]
