"""``simulate``: one run or a batch on all cores, and compilation before a study.

``simulate``: one run of a plant and a controller through a scenario, or a batch of runs.

Many runs at once, on all cores: what ``simulate`` does with a batch.
"""

from __future__ import annotations

import os
import signal
import warnings
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any, NamedTuple, TypeAlias, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quell import checks
from quell.controllers.axes import Axes
from quell.controllers.base import Controller, check_controller, limits_of
from quell.controllers.single import SinglePrecision, check_compilable, in_single_precision
from quell.controllers.state_space import StateFeedback
from quell.hints import explained
from quell.kernels import dispatch
from quell.kernels.cache import cache_path
from quell.kernels.sized import layout_of
from quell.lti.models import is_linear_model
from quell.parallel import in_parallel, one_blas_thread, part_of
from quell.plants.base import Plant, PlantBatch, check_plant, signals_of
from quell.plants.linear import LinearPlant, sampled_together
from quell.records.record import columns_of, readable_names, signals_of_loop
from quell.records.trajectory import BatchTrajectory, Trajectory
from quell.simulation import driver
from quell.simulation.scenario import (
    SampledScenario,
    Scenario,
    Segment,
    check_fit,
    check_scenario,
    segment_bounds,
)
from quell.types import Channels, Status

# ---- Many runs at once, on all cores ----

_RECORDED = ("r", "y", "u", "v")
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
    logged = driver.logged_channels(plants[0], controllers[0])
    width = sum(width for _, width in logged)
    usual = [name for name, _ in logged if name in _RECORDED]
    channels = _selected(usual if record is None else record, logged)
    columns = [k for name, _ in channels for k in range(width)[columns_of(logged, name)]]
    recorded = [(name, j) for name, width in channels for j in range(width)]
    # Channel by channel, so that a channel of all runs is contiguous in memory.
    log = np.empty((len(recorded), runs, (samples - 1) // every + 1))
    outcome = Outcome(log, *(np.zeros(runs, dtype=np.int64) for _ in range(3)))
    loops: list[driver.Loop] = []
    first: dict[Any, driver.Loop] = {}
    for i, model in enumerate(_models(plants, dt, interpret)):
        compiled = not interpret and plants[i].compiled
        structure = (id(controllers[i]), layout_of(model)) if compiled else i
        like = first.get(structure)
        loops.append(driver.Loop(plants[i], model, controllers[i], sampled[i], interpret, like))
        first.setdefault(structure, loops[i])
    narrow = driver.width_of_signals(plants[0], controllers[0])
    if max(columns) < narrow and not any(loop.integration.needed for loop in loops):
        width = narrow  # states and estimates are not used
    _run_loops(loops, columns, width, every, outcome, progress, workers)
    for i in np.flatnonzero(outcome.lengths < log.shape[2]).tolist():
        log[:, i, outcome.lengths[i] :] = np.nan
    name = plants.name if isinstance(plants, PlantBatch) else plants[0].name
    driver.judge_integration(name, loops)
    outcome.ended[:] = [loop.ended for loop in loops]
    outcome.status[:] = driver.judged(np.moveaxis(log, 0, -1), channels, loops)
    found: dict[str, Any] = {
        "log": np.moveaxis(log, 0, -1),
        "channels": channels,
        "dt": dt,
        "every": every,
        "lengths": outcome.lengths,
        "status": outcome.status,
        "ended": np.asarray(outcome.ended * dt, dtype=np.float64),
        "limit": np.array([s.limit for s in sampled]),
        "plant": name,
        "parameters": plants.parameters if isinstance(plants, PlantBatch) else {},
        "final_states": tuple(loop.state for loop in loops),
    }
    return BatchTrajectory(**found, **_names_of(plants[0], controllers[0]))


def _names_of(plant: Any, controller: Any) -> dict[str, Any]:
    """Return the names of signals, axes and features for a record."""
    if not is_of_several(controller):
        signals = signals_of_loop(signals_of(plant), controller)
        return {"features": controller.features, "signals": signals}
    features = tuple(axis.features for axis in controller.axes)
    return {"axis_names": controller.names, "axis_features": features}


def is_of_several(controller: Any) -> bool:
    """Return whether a controller has several signals, as ``Axes`` and ``StateFeedback``."""
    return hasattr(controller, "inputs")


def _run_loops(
    loops: Sequence[driver.Loop],
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
        which: Sequence[int], first: int, last: int, shared: Mapping[Any, Segment]
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
    check_any = partial(check_controller, several=True)
    check: dict[str, Callable[..., None]] = {
        "plant": check_plant,
        "controller": check_any,
        "scenario": check_scenario,
    }
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
        for what in ("dt", "channels", "features", "inputs", "outputs"):
            value, first = (getattr(each, what, 1) for each in (other, controllers[0]))
            if value != first:
                raise ValueError(
                    f"controller[{i}] has {what} = {value!r}, controller[0] {first!r}: "
                    "must be the same; run them as two batches"
                )
    for parts in zip(plants, controllers, strict=True):
        check_fit(*parts)
    return plants, controllers, scenarios


def _sampled(
    scenarios: Sequence[Scenario], plant: Plant, controllers: Sequence[Controller], limit: Any
) -> list[Any]:
    """Return the sampled scenario of each run; runs of one scenario share theirs."""
    found: dict[tuple[int, Any], Any] = {}
    sampled: list[Any] = []
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
    """Return the sampled model of each plant.

    A plant that occurs in many runs is sampled once, and linear plants are sampled together.
    """
    distinct = {id(plant): plant for plant in plants}
    with one_blas_thread():
        linear = {k: plant for k, plant in distinct.items() if type(plant) is LinearPlant}
        models: dict[int, Any] = dict(
            zip(linear, sampled_together([*linear.values()], dt), strict=True)
        )
        for key in distinct.keys() - linear.keys():
            models[key] = distinct[key].sampled(dt, interpret)
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


# ---- simulate ----


@overload
def simulate(  # type: ignore[overload-overlap]  # a plant is no sequence
    plant: Plant | tuple[ArrayLike, ...],
    controller: Controller | Axes | StateFeedback | SinglePrecision,
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
    controller: Controller | Axes | StateFeedback | Sequence[Any],
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
@explained("quell.simulate(plant, controller, quell.Scenario(reference=1.0, duration=10.0))")
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
        for a batch: channels to record, ``("r", "y", "u")`` by default, of several axes ``"v"``,
        too, or ``"all"``, with the estimates and a guard's authority. A single run records all.
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
        that diverged is repeated with enough of them, to find out whether they were the cause. And
        if a run diverged, or y ran away from r (``RAN_AWAY``,
        ``quell.records.metrics.runs_away``): its measures are not those of a loop that works. In a
        batch y can be judged where r and y are recorded.
    """
    interpret = interpret or dispatch.interpret_all
    if not hasattr(plant, "sampled") and is_linear_model(plant):
        plant = LinearPlant.of(plant)
    single = checks.one_of("precision", precision, ("double", "single")) == "single"
    if single:
        if not interpret:
            check_compilable()
        many = checks.is_sequence(controller)
        controller = _in_single(controller) if many else in_single_precision(controller)
    if any(checks.is_sequence(value) for value in (plant, controller, scenario)):
        options = (record_every, limit, interpret, progress, record, workers)
        runs = simulate_batch(plant, controller, scenario, *options)
        driver.warn_of_lost(runs)
        return runs
    for name, value in (("record", record), ("workers", workers)):
        if value is not None:
            rule = "is for a batch; a single run records all channels, in this thread"
            raise ValueError(f"{name} = {value!r}: {rule}")
    check_plant(plant)
    check_controller(controller, several=True)
    check_scenario(scenario)
    every = checks.whole("record_every", record_every, 1)
    sampled = SampledScenario.of(scenario, plant, controller, limit)
    dt = sampled.dt
    loop = driver.Loop(plant, plant.sampled(dt, interpret), controller, sampled, interpret)
    channels = driver.logged_channels(plant, controller)
    log = loop.run_through(every, progress)
    run = Trajectory(
        log=log,
        channels=channels,
        dt=dt,
        every=every,
        status=Status(int(driver.judged(log[None], channels, [loop])[0])),
        ended=loop.ended * dt,
        limit=sampled.limit,
        plant=plant.name,
        u_limits=(-np.inf, np.inf) if is_of_several(controller) else limits_of(controller),
        final_state=loop.state,
        **_names_of(plant, controller),
    )
    driver.warn_of_lost(run)
    return run


def _in_single(controllers: Sequence[Controller]) -> list[Controller]:
    """Return controllers in single precision; what is the same object stays so."""
    single = {id(controller): in_single_precision(controller) for controller in controllers}
    return [single[id(controller)] for controller in controllers]


# ---- Compile the loops of a study before it runs, in two processes if there are several ----

Parts: TypeAlias = tuple[Plant, Controller]


def precompile(loops: Sequence[Parts]) -> int:
    """Compile loops, or load them from the disk cache; return how many were compiled.

    If there are several to compile, a second process takes some of them, and this one loads their
    code from the disk cache then. This one begins at once and takes what takes longest; the second
    one imports quell first and takes what takes least. As always with ``multiprocessing``, that
    process imports the main module: a script needs ``if __name__ == "__main__"``.
    """
    missing = [parts for parts in _distinct(loops) if not _is_compiled(parts)]
    todo = deque(sorted(missing, key=lambda parts: _size(_arguments(parts)), reverse=True))
    with ExitStack() as stack:
        if len(missing) > 1 and cache_path() is not None and (os.cpu_count() or 1) > 1:
            stack.enter_context(_SecondProcess(todo))
        while (parts := _first(todo)) is not None:
            _compile(parts)
    for parts in loops:
        _compile(parts)
    return len(missing)


def _first(todo: deque[Parts]) -> Parts | None:
    try:
        return todo.popleft()
    except IndexError:  # the other process may have taken the last one in this moment
        return None


def _compile(parts: Parts) -> None:
    plant, controller = parts
    simulate(plant, controller, _short(controller))


def _short(controller: Controller) -> Scenario:
    dt = controller.dt
    return Scenario(duration=10 * dt, rest_at=(5 * dt,))


def _distinct(loops: Sequence[Parts]) -> list[Parts]:
    """Return the loops without those whose code is that of an earlier one."""
    found: dict[object, Parts] = {}
    for parts in loops:
        found.setdefault(layout_of(_arguments(parts)), parts)
    return list(found.values())


def _arguments(parts: Parts) -> tuple[object, ...]:
    """Return the parameters and the state of a loop, for whose types it is compiled."""
    plant, controller = parts
    return plant.sampled(controller.dt), controller.parameters, controller.initial_state()


def _size(part: object) -> int:
    """Return the number of values in parameters and state of a loop, with which its code grows."""
    return sum(map(_size, part)) if isinstance(part, tuple) else 1


def _is_compiled(parts: Parts) -> bool:
    plant, controller = parts
    scenario = SampledScenario.of(_short(controller), plant, controller, None)
    loop = driver.Loop(plant, plant.sampled(controller.dt), controller, scenario, interpret=False)
    return loop.is_compiled(scenario.segment(0, 1))


class _SecondProcess:
    """A context in which another process compiles the last of ``todo``, until it is empty."""

    def __init__(self, todo: deque[Parts]) -> None:
        context = get_context("spawn")
        self._todo = todo
        self._connection, self._other_end = context.Pipe()
        self._process = context.Process(target=_serve, args=(self._other_end,), daemon=True)
        self._thread = Thread(target=self._take, daemon=True)

    def __enter__(self) -> None:
        self._process.start()
        self._other_end.close()
        self._thread.start()

    def __exit__(self, *error: object) -> None:
        self._todo.clear()
        if error[0] is not None:
            self._process.terminate()
        self._thread.join()
        self._connection.close()
        self._process.join()

    def _take(self) -> None:
        # This ends when nothing is left to do. What can't be sent to another process, or ends it,
        # this process compiles in the end, and reports why it can't.
        with suppress(Exception):
            while True:
                self._connection.send(self._todo.pop())
                self._connection.recv()


def _serve(connection: Connection) -> None:
    """Compile what comes through the connection, until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process deals with it, and warns
    warnings.simplefilter("ignore")
    with suppress(EOFError):
        while True:
            parts = connection.recv()
            with suppress(Exception):  # the first process meets it, too
                _compile(parts)
            connection.send(None)
    os._exit(0)  # all code is in the cache; Python would take half a second to clear its memory
