"""``sweep``: many runs on many cores or machines, and their results.

``sweep``: many runs over parameters, on many cores or machines.

The results of a sweep as one ``xarray.Dataset`` that reads its files when values are needed.

Figures of a sweep: failure rate and quantiles of the measures over a parameter.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.parallel import Where, check_sendable, completed, executor_on, result_of
from quell.plants.base import signals_of
from quell.quantities import UNKNOWN, Signals
from quell.records.trajectory import Trajectory
from quell.simulation.simulate import simulate
from quell.sweeping.measures import as_measures, describe_measures
from quell.sweeping.runs import (
    ERROR,
    Job,
    Parts,
    Plan,
    Store,
    built,
    check_draws,
    existing_store,
    hash_of,
    name_of,
    new_store,
    open_store,
    parameter_variable,
    probe,
    run_part,
)
from quell.types import LOST, DesignWarning, Status, Vector, called_by_quell, warn

if TYPE_CHECKING:
    import xarray

# ---- The results of a sweep as one xarray.Dataset that reads its files when values are needed ----

NOT_DONE = -2
"""Status of a run that the sweep has not done yet."""
# Failed runs that a warning names. Chosen by hand.
_SAID = 3


def lazy_dataset(store: Store) -> xarray.Dataset:
    """Return the dataset of a sweep over ``run``; values are read when they are used."""
    import xarray

    def over_runs(stored: str, dtype: Any, fill: Any, attributes: Any, read: Any = None) -> Any:
        array = _array(store, stored, np.dtype(dtype), fill, read)
        return xarray.Variable("run", array, attributes)

    variables = {
        name: over_runs(name, np.float64, np.nan, about) for name, about in store.measures.items()
    }
    about = "all status flags of the run (quell.Status); -1 for an error, -2 if it is not done"
    variables["status"] = over_runs("status", np.int32, NOT_DONE, {"long_name": about})
    variables["ended"] = over_runs(
        "ended", np.float64, np.nan, {"long_name": "when the run ended", "units": "s"}
    )
    variables["seed"] = over_runs("seed", np.int64, 0, {"long_name": "seed of the run"})
    about = "why the run has the status -1"
    variables["message"] = over_runs("error", object, "", {"long_name": about}, _messages)
    coordinates = {}
    for name, texts in store.labels.items():
        stored, key = (
            parameter_variable(name),
            name if name not in variables else f"parameter_{name}",
        )
        if texts is None:
            coordinates[key] = over_runs(stored, np.float64, np.nan, {"parameter": name})
        else:
            width = f"<U{max(map(len, texts))}"
            coordinates[key] = over_runs(stored, width, "", {"parameter": name}, _texts(texts))
    return xarray.Dataset(variables, coordinates, {"runs": store.runs, "folder": str(store.folder)})


def _array(store: Store, name: str, dtype: Any, fill: Any, read: Any) -> Any:
    from xarray.backends import BackendArray
    from xarray.core import indexing

    class OverRuns(BackendArray):
        """A variable of all files of a sweep, read when it is indexed."""

        shape = (store.runs,)

        def __init__(self) -> None:
            self.dtype = dtype

        def __getitem__(self, key: Any) -> Any:
            support = indexing.IndexingSupport.BASIC
            return indexing.explicit_indexing_adapter(key, self.shape, support, self._values)

        def _values(self, key: tuple[Any, ...]) -> Any:
            return _read(store, name, dtype, fill, read or _numbers, key[0])

    # As those of xarray.open_dataset, values that were read stay in memory.
    cached: Any = indexing.MemoryCachedArray
    return cached(indexing.LazilyIndexedArray(OverRuns()))


def _read(
    store: Store,
    name: str,
    dtype: np.dtype[Any],
    fill: Any,
    read: Callable[..., NDArray[Any]],
    key: slice | int,
) -> Any:
    """Return the values of some runs."""
    import h5py

    wanted = np.arange(store.runs)[key]
    if wanted.size == 0:
        return np.empty(wanted.shape, dtype)
    low, high = int(np.min(wanted)), int(np.max(wanted)) + 1
    found = np.full(high - low, fill, dtype)
    for first, last in store.parts():
        if first >= high or last <= low or not store.file(first).exists():
            continue
        path = store.file(first)
        try:
            with h5py.File(path, "r") as file:
                values = read(file, name, first, last)
        except Exception as error:  # whatever HDF5 raises, the file is damaged or none of quell's
            why = " ".join(str(error).split())
            rule = "remove it, and the sweep does its runs again"
            raise ValueError(f"path = {str(path)!r}: can't be read ({why}); {rule}") from None
        begin, end = max(first, low), min(last, high)
        found[begin - low : end - low] = values[begin - first : end - first]
    return found[wanted - low]


def _numbers(file: Any, name: str, first: int, last: int) -> NDArray[Any]:
    stored = file[name]
    if stored.shape != (last - first,) or stored.dtype.kind not in "fi":
        raise ValueError(f"{name} has shape {stored.shape}: must be ({last - first},) numbers")
    return np.asarray(stored[()])


def _messages(file: Any, name: str, first: int, last: int) -> NDArray[Any]:
    found = np.full(last - first, "", object)
    places = np.asarray(file["error_run"][()]) - first
    if places.size > found.size or np.any((places < 0) | (places >= found.size)):
        raise ValueError("error_run has runs of another file")
    found[places] = file[name].asstr()[()] if places.size else ()
    return found


def _texts(texts: list[str]) -> Callable[..., NDArray[Any]]:
    def read(file: Any, name: str, first: int, last: int) -> NDArray[Any]:
        codes = _numbers(file, name, first, last)
        if np.any((codes < 0) | (codes >= len(texts))):
            raise ValueError(f"{name} has places outside of its list")
        return np.array(texts)[codes]

    return read


# ---- Confidence intervals of shares, such as failure rates ----

_CONFIDENCE = 0.95


def share_interval(found: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Clopper & Pearson, *Biometrika* 26, 1934).

    Of nothing it is 0 to 1.
    """
    from scipy.stats import binomtest

    if count == 0:
        return 0.0, 1.0
    ends = binomtest(found, count).proportion_ci(_CONFIDENCE, method="exact")
    return float(ends.low), float(ends.high)


# ---- Figures of a sweep ----

QUANTILES = (0.05, 0.5, 0.95)
# Groups of values of a parameter: enough to show a shape, few enough that each has runs. By hand.
_MOST_GROUPS = 20
# So many values are groups of their own even where fewer groups are asked for. By hand.
_FEW = 6
# Colours of the lines of several groups, which readers with any colour vision tell apart.
_COLORS = ("#2a6f97", "#c1440e", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
# Quantiles that go beyond so many times the median are drawn on a logarithmic scale. By hand.
_WIDE = 50.0


class Groups(NamedTuple):
    """Runs in groups of near values of a parameter."""

    centres: Vector  # (groups,)
    texts: list[str] | None  # of values that are no numbers
    members: list[NDArray[np.int64]]

    def labels(self, parameter: str) -> list[str]:
        """Return a label for each group: the text, or the value in the middle."""
        if self.texts is not None:
            return [f"{parameter} = {text}" for text in self.texts]
        return [f"{parameter} = {centre:.3g}" for centre in self.centres.tolist()]


def groups_of(
    values: NDArray[Any], texts: list[str] | None, done: NDArray[np.bool_], most: int = _MOST_GROUPS
) -> Groups:
    """Return the runs that are done by the value of a parameter, which may be one of some texts.

    More values than ``most``, and than six, form ``most`` groups of about as many runs each.
    """
    runs = np.flatnonzero(done)
    if texts is not None:
        members = [runs[values[runs] == text] for text in texts]
        return Groups(np.arange(len(texts), dtype=np.float64), texts, members)
    order = runs[np.argsort(values[runs], kind="stable")]
    distinct = np.unique(values[runs])
    if distinct.size <= _FEW or distinct.size <= most:
        return Groups(distinct, None, [runs[values[runs] == each] for each in distinct])
    members = [each for each in np.array_split(order, most) if each.size]
    return Groups(np.array([np.median(values[each]) for each in members]), None, members)


def plot_over(
    parameter: str,
    lines: Mapping[str, Groups],
    failed: NDArray[np.bool_],
    measures: Mapping[str, Vector],
    figure: Any = None,
    ax: Any = None,
) -> Any:
    """Draw failure rate and quantiles of each measure over a parameter; return the axes.

    ``lines`` has the groups of runs of each line by its label.
    """
    axes = _new_axes(len(measures), figure) if ax is None else np.ravel(ax)
    if axes.size < 1 + len(measures):
        raise ValueError(f"ax: must be {1 + len(measures)} matplotlib axes, got {axes.size}")
    colors = [_COLORS[i % len(_COLORS)] for i in range(len(lines))]
    shown = ["#c1440e"] if len(lines) == 1 else colors
    for color, (label, groups) in zip(shown, lines.items(), strict=True):
        _plot_failures(axes[0], failed, groups, color, label)
    for axis, (name, values) in zip(axes[1:], measures.items(), strict=False):
        for color, groups in zip(colors, lines.values(), strict=True):
            _plot_quantiles(axis, values, groups, color)
        axis.set_title(name)
    if len(lines) > 1:
        axes[0].legend(fontsize="small")
    groups = next(iter(lines.values()))
    for axis in axes[1 + len(measures) :]:
        axis.set_axis_off()
    for axis in axes[: 1 + len(measures)]:
        axis.set_xlabel(parameter)
        axis.tick_params(labelbottom=True)
        axis.grid(alpha=0.3)
        if groups.texts is not None:
            axis.set_xticks(groups.centres, groups.texts)
            axis.set_xlim(-0.5, len(groups.texts) - 0.5)
    return axes[: 1 + len(measures)]


def _new_axes(measures: int, figure: Any) -> Any:
    """Return axes for the failures and for so many measures, in a figure or in a new one."""
    columns = 2 if measures == 3 else min(3, 1 + measures)
    rows = -(-(1 + measures) // columns)
    if figure is None:
        import matplotlib.pyplot as plt

        figure = plt.figure(figsize=(3.6 * columns, 2.9 * rows), layout="constrained")
    figure.suptitle("failures; median and 5 to 95 % of the runs that did not diverge", fontsize=10)
    return figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()


def _plot_failures(
    axis: Any, failed: NDArray[np.bool_], groups: Groups, color: str, label: str
) -> None:
    counts = [(int(np.sum(failed[each])), each.size) for each in groups.members]
    rates = np.array([100.0 * failures / max(runs, 1) for failures, runs in counts])
    low, high = 100.0 * np.array([share_interval(*each) for each in counts]).T
    reach = np.maximum([rates - low, high - rates], 0.0)
    style: dict[str, Any] = {"fmt": "o", "markersize": 3, "capsize": 2, "color": color}
    axis.errorbar(groups.centres, rates, reach, label=label or None, **style)
    axis.set_title("failure rate [%], 95 % interval")
    axis.set_ylim(bottom=0.0)


def _plot_quantiles(axis: Any, values: Vector, groups: Groups, color: str) -> None:
    found = np.full((len(QUANTILES), len(groups.members)), np.nan)
    for i, members in enumerate(groups.members):
        there = values[members][np.isfinite(values[members])]
        if there.size:
            found[:, i] = np.quantile(there, QUANTILES)
    low, median, high = found
    known = found[np.isfinite(found)]
    if known.size and np.min(known) > 0.0 and np.max(known) > _WIDE * np.nanmedian(median):
        axis.set_yscale("log")  # a few runs near divergence would hide all others
    if groups.texts is None:
        axis.fill_between(groups.centres, low, high, color=color, alpha=0.25, linewidth=0)
        axis.plot(groups.centres, median, color=color)
    else:
        reach = np.maximum([median - low, high - median], 0.0)
        axis.errorbar(groups.centres, median, reach, fmt="o", capsize=3, color=color)


# ---- The results of a sweep ----


@dataclass(frozen=True, eq=False)
class Sweep:
    """The results of a sweep, on disk.

    ``dataset`` has a variable over ``run`` for each measure, ``status``, ``ended``, ``seed`` and
    ``message``; the parameters are its coordinates. Values are read from the disk when they are
    used. ``Sweep.open(folder)`` gives the results of a sweep that another program ran or runs.
    """

    store: Store = field(repr=False)
    plan: Plan | None = field(default=None, repr=False)  #: None if it was opened
    job: Job | None = field(default=None, repr=False)  #: None if it was opened

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Sweep:
        """Return the results in a folder, also of a sweep that is not complete.

        Raises
        ------
        ValueError
            if the folder holds no sweep.
        """
        return cls(open_store(folder))

    @cached_property
    def dataset(self) -> xarray.Dataset:
        """Measures, status and parameters over ``run``."""
        return lazy_dataset(self.store)

    @property
    def limits(self) -> Mapping[str, float]:
        """Largest value of measures of a run that does not fail."""
        return dict(self.store.about.get("limits", {}))

    @property
    def missing(self) -> int:
        """Number of runs that are not done."""
        return sum(last - first for first, last in self.store.missing())

    @property
    def done(self) -> NDArray[np.bool_]:
        """True for runs that are done (runs,)."""
        return np.asarray(self.dataset["status"].values != NOT_DONE)

    @property
    def failed(self) -> NDArray[np.bool_]:
        """True for runs with an error, that diverged, or with a measure beyond its limit (runs,).

        So is a run whose y ran away from r. A measure that does not exist is beyond its limit, the
        settling time of a run that does not settle for example.
        """
        found = ~self.complete
        for name, limit in self.limits.items():
            found |= ~(self.dataset[name].values <= limit)
        return np.asarray(found & self.done)

    @property
    def complete(self) -> NDArray[np.bool_]:
        """True for runs to their end, that did not diverge and whose y did not run away (runs,)."""
        status = self.dataset["status"].values
        return np.asarray((status >= 0) & ((status & int(LOST)) == 0))

    @property
    def errors(self) -> NDArray[np.int64]:
        """Runs that could not be built, simulated or judged; ``reason`` says why."""
        return np.flatnonzero(self.dataset["status"].values == ERROR)

    def fault(self, run: int) -> str:
        """Return the name of a run, with its parameters, and why it failed."""
        return f"{self.describe(run)}: {self.reason(run)}"

    def reason(self, run: int) -> str:
        """Return why a run failed; empty if it did not."""
        checks.whole("run", run, 0, self.store.runs - 1)
        one = self.dataset.isel(run=run)
        status = int(one["status"].item())
        if status == NOT_DONE:
            return ""
        if status == ERROR:
            return str(one["message"].item())
        if status & int(LOST):
            ended = "diverged" if status & int(Status.DIVERGED) else "y ran away from r, seen"
            return f"{ended} at {one['ended'].item():.6g} s"
        beyond = [
            f"{name} = {value:.6g}, beyond {limit:g}" if value == value else f"no {name}"
            for name, limit in self.limits.items()
            if not (value := float(one[name].item())) <= limit
        ]
        return "; ".join(beyond)

    def worst(self, metric: str | None = None, count: int = 5) -> list[int]:
        """Return the runs with the largest values of a measure, by default the first one.

        Runs without a value, with an error, or that diverged come before all others.
        """
        checks.whole("count", count, 1)
        name = metric or next(iter(self.store.measures))
        checks.one_of("metric", name, tuple(self.store.measures))
        values = self.dataset[name].values
        values = np.where(np.isnan(values) | ~self.complete, np.inf, values)
        values[~self.done] = -np.inf
        order = np.argsort(-values, kind="stable")[:count]
        return [int(i) for i in order if values[i] > -np.inf]

    def describe(self, run: int) -> str:
        """Return the name of a run: its number, its parameters, its seed."""
        checks.whole("run", run, 0, self.store.runs - 1)
        values = {name: self.parameter(name)[run].item() for name in self.store.labels}
        return name_of(run, values, self.dataset["seed"][run].item())

    def parameter(self, name: str) -> xarray.DataArray:
        """Return a parameter over ``run``, a coordinate of the dataset."""
        checks.one_of("parameter", name, tuple(self.store.labels))
        found = (c for c in self.dataset.coords.values() if c.attrs["parameter"] == name)
        return next(found)

    def parts(self, run: int) -> Parts:
        """Return plant, controller and scenario of a run, of a sweep that ``sweep`` returned."""
        checks.whole("run", run, 0, self.store.runs - 1)
        if self.plan is None or self.job is None:
            rule = "an opened sweep can't repeat a run; call sweep again with the same arguments"
            raise ValueError(f"run = {run}: {rule}, which returns at once if it is complete")
        return built(self.job, self.plan.part(run, run + 1), run)

    def repeat(self, run: int) -> Trajectory:
        """Simulate a run again, alone, and return its whole record.

        Raises
        ------
        ValueError
            if the run can't be built or simulated, or the sweep was opened.
        """
        return simulate(*self.parts(run))

    @cached_property
    def signals(self) -> Signals:
        """Names and units of the plant of the first run; unknown if the sweep was opened."""
        with suppress(Exception):  # of the user's function that makes the plant
            return signals_of(self.parts(0).plant)
        return UNKNOWN

    def label(self, measure: str) -> str:
        """Return the name of a measure with its unit: ``rms [m]``."""
        unit = self.signals.unit(self.store.measures[measure].get("units", "1"))
        return measure if unit == "1" else f"{measure} [{unit}]"

    def plot(
        self, parameter: str, figure: Any = None, *, by: str | None = None, ax: Any = None
    ) -> Any:
        """Draw failure rate and quantiles of each measure over a parameter; return the axes.

        The quantiles are those of runs that did not diverge.

        Parameters
        ----------
        parameter
            name of the parameter.
        figure
            a matplotlib figure; a new one by default.
        by
            name of another parameter: a line for each of its values or, of many, for each third
            of them.
        ax
            axes to draw into: one for the failures, then one for each measure.

        Raises
        ------
        ValueError
            for an unknown parameter, and for ``by`` the same one.
        """
        values, texts = self.parameter(parameter).values, self.store.labels[parameter]
        measures = {}
        for name in self.store.measures:
            measures[self.label(name)] = np.where(self.complete, self.dataset[name].values, np.nan)
        if by is None:
            lines = {"": groups_of(values, texts, self.done)}
        elif by == parameter:
            raise ValueError(f"by = {by!r}: must be another parameter than the one of the axis")
        else:
            others = groups_of(self.parameter(by).values, self.store.labels[by], self.done, most=3)
            lines = {
                label: groups_of(values, texts, np.isin(np.arange(self.done.size), members))
                for label, members in zip(others.labels(by), others.members, strict=True)
            }
        return plot_over(parameter, lines, self.failed, measures, figure, ax)


# ---- sweep ----

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
        cluster, or a ``concurrent.futures.Executor`` (``quell.parallel.executor_on``). The results
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
        for arguments out of range, a parameter that ``build`` does not have, several draws of runs
        in which nothing is drawn or random, the folder of another
        sweep, a scheduler that does not answer, or if none of the runs that are tried first can be
        done; nothing is written then.
    ChildProcessError
        if a worker process was ended, for instance because memory ran out.

    Warns
    -----
    RuntimeWarning
        that names runs with an error, that diverged, or whose y ran away.
    """
    plan = Plan(parameters, draws, sampling, seed)
    measures = as_measures(metrics)
    checked = _checked_limits(limits or {}, list(measures))
    takes_seed = _takes_seed(build, plan)
    job = Job(build, measures, tuple(record), takes_seed)
    check_draws(plan, job)
    checks.optional(checks.whole, "runs_per_file", runs_per_file, 1)
    if executor == "processes":
        check_sendable("build and functions in metrics", job)
    about = _about(plan, job, checked)
    store = existing_store(folder, about)
    if store is None or store.missing():
        with executor_on(executor, workers) as pool, _without_design_warnings():
            if store is None:
                size = _runs_per_file(pool, plan, job, runs_per_file)
                store = new_store(folder, plan, size, about, measures)
            else:
                _check_unchanged(pool, plan, job, store)
            _do(pool, plan, job, store, progress)
    found = Sweep(store, plan, job)
    if (lost := np.flatnonzero(~found.complete)).size and not called_by_quell(1):
        few = "; ".join(found.fault(run) for run in lost[:_SAID].tolist())
        more = f"; {lost.size - _SAID} more" if lost.size > _SAID else ""
        warn(f"{lost.size} of {plan.runs} runs failed: {few}{more}", RuntimeWarning)
    return found


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
