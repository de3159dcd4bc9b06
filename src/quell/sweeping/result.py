"""The results of a sweep."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.plants.labelled import signals_of
from quell.quantities import UNKNOWN, Signals
from quell.records.trajectory import Trajectory
from quell.simulation.simulate import simulate
from quell.sweeping.lazy import NOT_DONE, lazy_dataset
from quell.sweeping.plan import Plan, name_of
from quell.sweeping.runs import Job, Parts, built
from quell.sweeping.store import Store, open_store
from quell.types import Status

if TYPE_CHECKING:
    import xarray


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

        A measure that does not exist is beyond its limit, the settling time of a run that does not
        settle for example.
        """
        found = ~self.complete
        for name, limit in self.limits.items():
            found |= ~(self.dataset[name].values <= limit)
        return np.asarray(found & self.done)

    @property
    def complete(self) -> NDArray[np.bool_]:
        """True for runs that were simulated to their end, without divergence (runs,)."""
        status = self.dataset["status"].values
        return np.asarray((status >= 0) & ((status & int(Status.DIVERGED)) == 0))

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
        from quell.sweeping.figures import groups_of, plot_over

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
