"""``sweep``: many runs over parameters, on many cores or machines."""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing, contextmanager
from functools import partial
from typing import Any

import numpy as np

from quell import checks
from quell.executors import Where, check_sendable, completed, executor_on, result_of
from quell.sweeping.measures import as_measures
from quell.sweeping.plan import Plan
from quell.sweeping.result import Sweep
from quell.sweeping.runs import Job, Parts, built, probe, run_part
from quell.sweeping.store import Store, describe_measures, existing_store, hash_of, new_store
from quell.types import DesignWarning

# Runs from all over the sweep that are tried first. If none of them works, the plan is wrong.
_TRIED = 8
# Runs whose time is that of one run: two batches. By hand.
_TIMED = 512
# A file's runs take two seconds, so that handing them out costs nothing beside them, and more if
# the sweep had more files than these otherwise. Chosen by hand.
_SECONDS_PER_FILE, _MOST_FILES = 2.0, 2000
_MOST_PER_FILE = 100_000


def sweep(
    build: Callable[..., Any],
    parameters: Mapping[str, Any],
    *,
    folder: str | os.PathLike[str],
    metrics: Any = ("peak_error", "iae", "control_variation"),
    limits: Mapping[str, float] | None = None,
    draws: int = 1,
    sampling: str = "latin-hypercube",
    seed: int = 0,
    record: Sequence[str] = ("r", "y", "u"),
    executor: Where = None,
    workers: int | None = None,
    runs_per_file: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Sweep:
    """Do many runs over parameters, and store their measures in a folder.

    A sweep that was interrupted or killed goes on where it stopped if it is called again. A run
    that fails is recorded with its status and message, and the sweep goes on.

    Parameters
    ----------
    build
        function of the parameters, by name, that returns plant, controller and scenario, or a
        ``quell.setup.Setup``. What does not depend on the parameters is best made outside of it,
        once. If it has a parameter ``seed``, it gets the seed of the run; otherwise the scenario
        gets it.
    parameters, draws, sampling, seed
        which runs, as those of ``quell.sweeping.Plan``: each draw of the distributions
        (``quell.sweeping.Range`` and ``Normal``) is combined with all values of all lists.
    folder
        where the results are; it must not exist, be empty, or hold the same sweep. Besides all
        arguments, name and source of ``build`` must be the same.
    metrics
        names of measures of ``Trajectory.metrics``; or for each name a measure, a
        ``quell.sweeping.Measure`` in a window of time, or a function of the ``Trajectory`` that
        returns a number.
    limits
        largest value of some measures, by name; a run with more fails.
    record
        channels that functions in ``metrics`` use.
    executor
        where runs are done: None for threads, ``"processes"``, ``"tcp://HOST:PORT"`` for a Dask
        cluster, or a ``concurrent.futures.Executor`` (``quell.executors.executor_on``). The results
        are the same, bit for bit.
    workers
        number of threads or processes; the number of cores by default.
    runs_per_file
        runs of a task, and of a file; by default those of about two seconds.
    progress
        called with the share done, 0 to 1.

    Returns
    -------
    Sweep
        the results; ``Sweep.dataset`` is an ``xarray.Dataset`` over ``run``.

    Raises
    ------
    ValueError
        for arguments out of range, a parameter that ``build`` does not have, the folder of another
        sweep, a scheduler that does not answer, or if none of the runs that are tried first can be
        done; nothing is written then.
    ChildProcessError
        if a worker process was ended, for instance because memory ran out.
    """
    plan = Plan(parameters, draws, sampling, seed)
    measures = as_measures(metrics)
    checked = _checked_limits(limits or {}, list(measures))
    takes_seed = _takes_seed(build, plan)
    job = Job(build, measures, tuple(record), takes_seed)
    checks.optional(checks.whole, "runs_per_file", runs_per_file, 1)
    if executor == "processes":
        check_sendable("build and functions in metrics", job)
    about = _about(plan, job, checked)
    store = existing_store(folder, about)
    if store is not None and not store.missing():
        return Sweep(store, plan, job)
    with executor_on(executor, workers) as pool, _without_design_warnings():
        if store is None:
            size = _runs_per_file(pool, plan, job, runs_per_file)
            store = new_store(folder, plan, size, about, measures)
        else:
            _check_unchanged(pool, plan, job, store)
        _do(pool, plan, job, store, progress)
    return Sweep(store, plan, job)


def parts_of(run: int, arguments: Mapping[str, Any]) -> tuple[str, Parts]:
    """Return name and parts of a run; ``arguments`` are those of ``sweep``, without the folder."""
    plan = Plan(**{key: arguments[key] for key in ("parameters", "draws", "sampling", "seed")})
    checks.whole("run", run, 0, plan.runs - 1)
    build = arguments["build"]
    job = Job(build, {}, (), _takes_seed(build, plan))
    return plan.describe(run), built(job, plan.part(run, run + 1), run)


def _do(
    pool: Executor, plan: Plan, job: Job, store: Store, progress: Callable[[float], None] | None
) -> None:
    """Do the runs that are missing, and write the file of each part as soon as it is done."""
    missing = store.missing()
    left = sum(last - first for first, last in missing)
    report = progress or (lambda share: None)
    report(1.0 - left / plan.runs)
    tasks = (plan.part(first, last) for first, last in missing)
    # Closed as soon as an error or Ctrl-C ends the loop, so that tasks not begun are dropped.
    with closing(completed(pool, partial(run_part, job), tasks)) as results:
        for part, outcome in results:
            store.write(part, outcome)
            left -= part.last - part.first
            report(1.0 - left / plan.runs)


def _runs_per_file(pool: Executor, plan: Plan, job: Job, given: int | None) -> int:
    """Try some runs; return the number of runs in a file."""
    tried = np.unique(np.linspace(0, plan.runs - 1, min(_TRIED, plan.runs)).astype(int)).tolist()
    parts = [plan.part(run, run + 1) for run in tried]
    more = plan.part(0, min(_TIMED, plan.runs))
    seconds, outcome = result_of(pool.submit(probe, job, parts, more))
    if len(outcome.messages) == len(parts):
        raise ValueError(f"none of {len(parts)} runs that were tried works: {outcome.messages[0]}")
    if given is not None:
        return given
    most = max(_SECONDS_PER_FILE, seconds * plan.runs / _MOST_FILES)
    return int(np.clip(most / max(seconds, 1e-9), 1, min(_MOST_PER_FILE, plan.runs)))


def _check_unchanged(pool: Executor, plan: Plan, job: Job, store: Store) -> None:
    """Check that a run that is done gives the numbers that are stored.

    Whatever ``build`` uses may have changed since.
    """
    missing = {first for first, _ in store.missing()}
    done = next((first for first, _ in store.parts() if first not in missing), None)
    if done is None:
        return
    again = result_of(pool.submit(run_part, job, plan.part(done, done + 1)))
    stored = Sweep(store).dataset.isel(run=done)
    for name, values in again.measures.items():
        if not np.array_equal(values[0], stored[name].item(), equal_nan=True):
            raise ValueError(
                f"folder = {str(store.folder)!r}: run {done} has {name} = {values[0]!r} now, "
                f"{stored[name].item()!r} is stored: what build uses has changed since; "
                "choose another folder"
            )


def _about(plan: Plan, job: Job, limits: Mapping[str, float]) -> dict[str, Any]:
    """Return what makes a sweep this one, for ``sweep.json``."""
    values = {name: repr(given)[:1000] for name, given in plan.parameters.items()}
    functions = {name: _identity(each) for name, each in job.measures.items() if callable(each)}
    about = {
        "parameters": values,
        "draws": plan.draws,
        "sampling": plan.sampling,
        "seed": plan.seed,
        "values of the parameters": plan.digest()[:16],
        "metrics": describe_measures(job.measures) | functions,
        "record": list(job.record),
        "limits": dict(limits),
        "build": _identity(job.build),
    }
    return dict(json.loads(json.dumps(about)))  # as it is read again


def _identity(function: Any) -> Any:
    """Return name and hash of the source of a function; of an object its ``identity``."""
    if hasattr(function, "identity"):
        return function.identity
    if isinstance(function, partial):
        arguments = repr((function.args, sorted(function.keywords.items())))
        return [_identity(function.func), hash_of(arguments)]
    try:
        source = inspect.getsource(function)
    except (OSError, TypeError):
        source = repr(getattr(getattr(function, "__code__", None), "co_code", ""))
    name = getattr(function, "__qualname__", type(function).__qualname__)
    return f"{name} {hashlib.sha256(source.encode()).hexdigest()[:16]}"


def _takes_seed(build: Any, plan: Plan) -> bool:
    """Check the names of the parameters; return whether the build function gets the seed."""
    if not callable(build):
        rule = "must be a function that returns (plant, controller, scenario)"
        raise ValueError(f"build = {build!r:.60}: {rule}")
    try:
        signature = inspect.signature(build)
    except (TypeError, ValueError):
        return False
    takes = signature.parameters
    if any(each.kind is each.VAR_KEYWORD for each in takes.values()):
        return "seed" in takes and "seed" not in plan.parameters
    for name in plan.parameters:
        if name not in takes:
            hint = checks.nearest(name, [*takes]) if takes else "it has none"
            raise ValueError(f"parameters[{name!r}]: build has no such parameter, {hint}")
    own = "seed" in takes and "seed" not in plan.parameters
    try:
        signature.bind(**dict.fromkeys([*plan.parameters, *(["seed"] if own else [])]))
    except TypeError as error:
        raise ValueError(f"parameters: build can't be called with them: {error}") from None
    return own


def _checked_limits(limits: Mapping[str, float], names: Sequence[str]) -> dict[str, float]:
    for name, value in limits.items():
        if name not in names:
            hint = checks.nearest(name, names)
            raise ValueError(f"limits[{name!r}]: is none of the metrics, {hint}")
        checks.finite(f"limits[{name!r}]", value)
    return {name: float(value) for name, value in limits.items()}


@contextmanager
def _without_design_warnings() -> Iterator[None]:
    """Ignore warnings about designs: there would be one for many runs; the status has them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DesignWarning)
        yield
