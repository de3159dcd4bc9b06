"""The record of one run."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.files import MAX_SIZE
from quell.quantities import UNKNOWN
from quell.records.metrics import MEASURES, SETTLING_BAND, BatchMetrics, Metrics, Window, measured
from quell.records.netcdf import Stored, load_record
from quell.records.notebook import InNotebook
from quell.records.record import Record, is_channel
from quell.types import LOST, Channels, Matrix, Status, Vector

if TYPE_CHECKING:
    import xarray

# Times the largest of 1 and the reference: a loop may well reach a limit below it, for example by
# its overshoot. Chosen by hand.
_NEAR = 10.0
_NO_LIMITS = (-math.inf, math.inf)


def check_no_target(target: float | None) -> None:
    """Raise a ``ValueError`` for a target of several axes."""
    if target is not None:
        raise ValueError(
            f"target = {target!r}: is of one axis; take run.axis(name).metrics(target=…)"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Record, InNotebook):
    """The record of one run.

    ``run["y"]`` is a channel: (samples,), or (samples, width) for ``w``, ``x``, ``x_hat`` and
    ``theta``; ``run.t`` are its times [s]. ``f_hat = f_learned + f_residual`` is computed.

    ``status`` has all flags that any step reported, ``DIVERGED`` if the run ended early, and
    ``RAN_AWAY`` if y ran away from r instead (``quell.records.metrics.runs_away``); ``message``
    explains them. ``controller.read(run.final_state)`` explains the controller's state
    at the end.

    Of several axes r, y, y_measured, u, v, w and x are (samples, width). v is what the axes were
    given, ``B0 u``. The estimates of an axis are channels like ``run["shoulder.x_hat"]``.
    ``run.axis("shoulder")`` is one axis as a record of its own.
    """

    log: Matrix  #: all channels side by side (samples, columns)
    channels: Channels  #: name and width of the channels, in the order of the columns
    dt: float  #: sample time of the run [s]
    every: int = 1  #: every ``every``-th sample was recorded
    status: Status = Status.OK
    ended: float = 0.0  #: time at which the run ended [s]
    limit: float = math.inf  #: the ``|y|`` beyond which the run would have been ended [y-unit]
    plant: str = ""  #: name of the plant
    features: tuple[str, ...] = ()  #: names of the features that the entries of ``theta`` multiply
    final_state: Any = None
    #: names and units of y, u and disturbances; of several axes ``quell.quantities.AxesSignals``
    signals: Any = UNKNOWN
    u_limits: tuple[float, float] = _NO_LIMITS  #: limits of the controller [u-unit]
    axis_names: tuple[str, ...] = ()  #: names of several axes
    axis_features: tuple[tuple[str, ...], ...] = ()  #: names of each axis' features

    def __repr__(self) -> str:
        size = f"{len(self)} samples, {self.every * self.dt:g} s apart, to {self.ended:g} s"
        return f"Trajectory({self.plant!r}: {size}; {', '.join(self.names)}; {self.status.name})"

    def _draw_small(self, figure: Any) -> None:
        from quell.records.plotting import draw_loop

        draw_loop(self, figure.subplots(2, 1, sharex=True))

    @property
    def diverged(self) -> bool:
        """True if the run ended early."""
        return Status.DIVERGED in self.status

    @property
    def lost(self) -> bool:
        """True if the run ended early, or an output ran away from its reference."""
        return bool(self.status & LOST)

    @property
    def message(self) -> str:
        """All that the run reported, with times, and what to do."""
        if not self.diverged:
            return self._explained(self.status)
        what = f"|y| went beyond limit = {self.limit:.3g}, or was no number, at {self.ended:.6g} s"
        if Status.POORLY_INTEGRATED in self.status or not self._limit_is_near:
            return f"{what}. {self._explained(self.status)}"
        others = self.status & ~Status.DIVERGED
        more = f" {self._explained(others)}" if others else ""
        meaning = "So near to the reference that need not mean that the loop is unstable"
        return f"{what}, and the run ended there. {meaning}.{more}"

    @property
    def _limit_is_near(self) -> bool:
        """Whether a stable loop may reach the limit."""
        largest = np.max(np.abs(self["r"]), initial=1.0) if "r" in self.names else 0.0
        return self.limit < _NEAR * float(largest)

    def __len__(self) -> int:
        """Return the number of samples."""
        return int(self.log.shape[0])

    def axis(self, which: int | str) -> Trajectory:
        """Return one of several axes as a record of its own: its u is v_i [y-unit/s^n].

        What is of the whole machine, as channels of its device, is in the record of each axis.

        Parameters
        ----------
        which
            name or number, from 0.

        Raises
        ------
        ValueError
            for a record without axes, an axis that it does not have, and missing channels.
        """
        own = self._fields_of(which)
        name = which if isinstance(which, str) else self.axis_names[which]
        plant = f"{self.plant}, {name}"
        return replace(self, **own, plant=plant, final_state=None, u_limits=_NO_LIMITS)

    def metrics(
        self,
        start: float = 0.0,
        stop: float | None = None,
        *,
        target: float | None = None,
        band: float = SETTLING_BAND,
    ) -> Any:
        """Return measures of the response in ``[start, stop)`` [s], as a step from its first y.

        Of several axes they are a dictionary with those of each axis by its name.

        Parameters
        ----------
        start, stop
            the window [s]; to the end of the record by default.
        target
            final value that y should reach; the reference at the end of the window by default.
        band
            half width of the settling band, as a fraction of the step.

        Returns
        -------
        Metrics
            a dictionary with ``peak_error``, ``rms``, ``iae``, ``ise``, ``itae`` of r − y,
            ``control_variation`` and ``total_variation`` of u, which also has the jump from the u
            before the window (zero before the run), and ``control_energy``, ∫u² dt with u held
            between samples; if the reference steps once in the window, and
            from there on, or ``target`` is given, also ``overshoot`` (fraction of the step),
            ``settling_time`` and ``rise_time`` [s], NaN if y does not come to rest there. Its
            ``missing`` has the reason for each of these that does not exist. If the run diverged in
            the window, there is no step, and the others are those of the samples up to there.

        Raises
        ------
        ValueError
            if the window has no sample, for instance because the run ended before it; for a
            ``target`` of several axes.
        """
        if self.several:
            check_no_target(target)
            return {
                name: self.axis(name).metrics(start, stop, band=band) for name in self.axis_names
            }
        return self.metrics_of(MEASURES, start, stop, target, band)

    def metrics_of(
        self,
        names: Collection[str],
        start: float = 0.0,
        stop: float | None = None,
        target: float | None = None,
        band: float = SETTLING_BAND,
    ) -> Metrics:
        """Return some of the measures of ``metrics``, which has all of them."""
        part = self._part(start, stop)
        before = slice(max(part.start - 2, 0), part.start)
        r, u = self["r"], self["u"]
        window = Window(
            t=self.t[part],
            r=r[part],
            y=self["y"][part],
            u=u[part],
            r_before=r[before],
            u_before=float(u[part.start - 1]) if part.start else 0.0,
        )
        cut_off = self.diverged and (stop is None or stop > self.ended)
        fault = f"the run diverged at {self.ended:.6g} s, in the window" if cut_off else None
        return measured(window, target, band, fault, names)

    def _part(self, start: float, stop: float | None) -> slice:
        """Return the samples in ``[start, stop)``; raise a ``ValueError`` if there are none."""
        given: Any = start
        if isinstance(given, str):
            raise ValueError(
                f"start = {given!r}: must be a time [s]; a measure is run.metrics()[name]"
            )
        part = self.window(start, np.inf if stop is None else stop)
        window = f"start = {start!r}, stop = {stop!r}"
        if stop is not None and not start < stop:
            raise ValueError(f"{window}: start must be less than stop")
        if part.start >= len(self):
            end = f"ends at {self.ended:.6g} s" if len(self) else "has no sample"
            why = f" ({self.message})" if self.diverged else ""
            raise ValueError(
                f"{window}: the record {end}{why}; the window must hold at least one sample"
            )
        if part.stop <= part.start:
            raise ValueError(
                f"{window}: must hold at least one sample; they are {self.every * self.dt:g} s "
                "apart, from 0 s on"
            )
        return part

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw output, control signal with its limits, estimates of f, guard, and the error.

        Estimates are drawn if there are any, the learned share if there is a learner, the authority
        if there is a guard. Samples at a limit of u are marked.

        Parameters
        ----------
        axes, ax
            matplotlib axes: three (output, control signal, estimates), four for a run with a guard,
            and one more for the error. Of several axes three for each and one more: rows of
            outputs, errors and estimates of f, then all control signals; for a loop of several
            signals without axes three: outputs, control signals, estimated disturbances. A new
            figure by default.

        Returns
        -------
        numpy.ndarray
            the axes in this order; in a new figure the error is drawn below the output.
        """
        from quell.records.plotting import given_axes, plot_axes, plot_run

        if self.several:
            return plot_axes(self, given_axes(axes, ax))
        return plot_run(self, self.ended if self.diverged else None, given_axes(axes, ax))

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame`` with a row for each sample; needs the extra ``pandas``.

        The entries of vector channels are columns of their own, ``x[0]`` and ``theta[x1]``; its
        ``attrs["units"]`` has the unit of each column.
        """
        from quell.records.record import to_pandas

        return to_pandas(self)

    def to_csv(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write all channels as CSV, a line for each sample, with units in the line of names.

        A ``ValueError`` says that the file exists, unless ``overwrite`` allows to replace it.
        """
        from quell.records.record import write_csv

        write_csv(self, path, overwrite)

    def to_xarray(self) -> xarray.Dataset:
        """Return an ``xarray.Dataset`` over ``time``, with units and descriptions as attributes."""
        attributes = {
            "plant": self.plant,
            "status": int(self.status),
            "ended": self.ended,
            "limit": self.limit,
            "message": self.message,
        }
        for name, limit in zip(("u_min", "u_max"), self.u_limits, strict=True):
            if math.isfinite(limit):
                attributes[name] = limit
        return self._dataset(("time",), attributes)

    @classmethod
    def load(cls, path: str | os.PathLike[str], max_size: float = MAX_SIZE) -> Trajectory:
        """Return the record that ``save`` wrote, without ``final_state``.

        A process with limits of time and memory reads the file.

        Parameters
        ----------
        path
            the file.
        max_size
            limit of what the file may unpack to [MB].

        Raises
        ------
        FileNotFoundError
            if there is no such file.
        ValueError
            if the file is not such a record, unpacks to more than ``max_size``, or takes too long.
        """

        def made(stored: Stored, fields: dict[str, Any]) -> Trajectory:
            return cls(
                **fields,
                status=Status(int(stored.attributes["status"])),
                ended=float(stored.attributes["ended"]),
                limit=float(stored.attributes.get("limit", math.inf)),
                u_limits=(
                    float(stored.attributes.get("u_min", -math.inf)),
                    float(stored.attributes.get("u_max", math.inf)),
                ),
            )

        attributes = {"dt", "every", "status", "ended", "plant"}
        return load_record(path, "Trajectory.save", ("time",), attributes, set(), max_size, made)


# Name, description and unit in a file of the values that each run has one of.
_PER_RUN = {
    "lengths": ("number of samples recorded", "1"),
    "run_status": ("all status flags of the run (quell.Status)", "1"),
    "ended": ("when the run ended", "s"),
    "limit": ("the |y| at which it would have been ended", "y-unit"),
}


@dataclass(frozen=True, eq=False, repr=False)
class BatchTrajectory(Record, InNotebook):
    """The record of a batch of runs.

    ``runs["y"]`` is a channel: (runs, samples), or (runs, samples, width) for ``w``, ``x``,
    ``x_hat`` and ``theta``; ``runs.t`` are their times [s]. After the end of a run that diverged,
    its samples are NaN. ``runs.run(i)`` is the i-th run as a ``Trajectory``.

    ``status`` has all ``Status`` flags that any step of a run reported, ``DIVERGED`` if it ended
    early, and ``RAN_AWAY`` if y ran away from r; ``message`` is their summary.
    ``controller.read(runs.final_states[i])`` explains the state of a controller at the end.

    Of several axes channels are (runs, samples, width), and ``runs.axis("elbow")`` is one axis of
    all runs.
    """

    log: Matrix  #: the recorded channels side by side (runs, samples, columns)
    channels: Channels  #: name and width of the channels, in the order of the columns
    dt: float  #: sample time of the runs [s]
    every: int  #: every ``every``-th sample was recorded
    lengths: NDArray[np.int64]  #: number of recorded samples of each run (runs,)
    status: NDArray[np.int64]  #: flags of each run (runs,)
    ended: Vector  #: time at which each run ended [s] (runs,)
    limit: Vector  #: the ``|y|`` beyond which a run would have been ended [y-unit] (runs,)
    plant: str = ""  #: name of the plants
    #: the parameters in which the plants differ, by name (runs,)
    parameters: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    features: tuple[str, ...] = ()  #: names of the features that the entries of ``theta`` multiply
    final_states: tuple[Any, ...] = ()
    signals: Any = UNKNOWN  #: names and units, as those of a ``Trajectory``
    axis_names: tuple[str, ...] = ()  #: names of several axes
    axis_features: tuple[tuple[str, ...], ...] = ()  #: names of each axis' features

    def __repr__(self) -> str:
        step = self.every * self.dt
        size = f"{len(self.ended)} runs of {self.log.shape[1]} samples, {step:g} s apart"
        lost = f"{int(np.sum(self.lost))} diverged or ran away"
        return f"BatchTrajectory({self.plant!r}: {size}; {', '.join(self.names)}; {lost})"

    def _draw_small(self, figure: Any) -> None:
        rows = 2 * max(len(self.axis_names), 1)
        self.plot(figure.subplots(2, rows // 2, sharex=True).ravel())

    @property
    def diverged(self) -> NDArray[np.bool_]:
        """True for the runs that ended early (runs,)."""
        return (self.status & int(Status.DIVERGED)) != 0

    @property
    def lost(self) -> NDArray[np.bool_]:
        """True for the runs that ended early, or whose y ran away from r (runs,)."""
        return (self.status & int(LOST)) != 0

    @property
    def message(self) -> str:
        """The number of runs that reported each flag, and the time at which the first diverged."""
        runs, integration = len(self), Status.DIVERGED | Status.POORLY_INTEGRATED
        causes = (self.status & int(integration)) == int(integration)
        own = np.where(causes, self.status & ~int(integration), self.status)
        counts = [(np.count_nonzero(own & int(flag)), flag.message) for flag in Status]
        counts.append((np.count_nonzero(causes), integration.message))
        sentences = [f"{count} of {runs} runs: {message}" for count, message in counts if count]
        if self.failed_trials:
            sentences.append(self.failed_trials)
        if np.any(self.diverged):
            first = int(np.argmin(np.where(self.diverged, self.ended, np.inf)))
            sentences.append(f"The first to diverge was run {first}, at {self.ended[first]:.6g} s.")
        return " ".join(sentences) or f"No step reported a problem in any of {len(self)} runs."

    def __getitem__(self, name: Any) -> Vector:
        """Return a channel; a ``ValueError`` says which there are, and how to record more."""
        if isinstance(name, int | np.integer):
            raise ValueError(
                f"channel = {name!r}: must be a name, as runs['y']; run number {name} is "
                f"runs.run({name})"
            )
        if isinstance(name, str) and name not in self.names and is_channel(name):
            raise ValueError(
                f"channel = {name!r}: was not recorded; a batch records r, y and u, and with "
                f"simulate(…, record='all') or record=('r', 'y', 'u', {name!r}) more"
            )
        return super().__getitem__(name)

    def __len__(self) -> int:
        """Return the number of runs."""
        return int(self.log.shape[0])

    def run(self, i: int) -> Trajectory:
        """Return the i-th run, to its end, with the channels that were recorded."""
        checks.whole("i", i, 0, len(self) - 1)
        return Trajectory(
            log=self.log[i, : self.lengths[i]],
            channels=self.channels,
            dt=self.dt,
            every=self.every,
            status=Status(int(self.status[i])),
            ended=float(self.ended[i]),
            limit=float(self.limit[i]),
            plant=self.plant,
            features=self.features,
            final_state=self.final_states[i] if self.final_states else None,
            signals=self.signals,
            axis_names=self.axis_names,
            axis_features=self.axis_features,
        )

    def axis(self, which: int | str) -> BatchTrajectory:
        """Return one axis of all runs as a batch of its own: its u is v_i [y-unit/s^n].

        Parameters
        ----------
        which
            name or number, from 0. The channels r, y and v must be recorded.
        """
        own = self._fields_of(which)
        name = which if isinstance(which, str) else self.axis_names[which]
        return replace(self, **own, plant=f"{self.plant}, {name}", final_states=())

    def metrics(
        self,
        start: float = 0.0,
        stop: float | None = None,
        *,
        target: float | None = None,
        band: float = SETTLING_BAND,
    ) -> Any:
        """Return measures of each run in ``[start, stop)`` [s], as ``Trajectory.metrics`` does.

        Of several axes they are a dictionary with those of each axis by its name.

        For a run that diverged within the window, its samples up to there count; see ``diverged``.
        All measures of a run that ended before the window are NaN, and so are those that are
        defined for other runs only.

        Parameters
        ----------
        start, stop, target, band
            as those of ``Trajectory.metrics``.

        Returns
        -------
        BatchMetrics
            a dictionary of arrays (runs,): ``peak_error`` and ``rms`` [y-unit], ``iae`` [y-unit s],
            ``ise`` [y-unit² s], ``itae`` [y-unit s²], ``control_variation`` and
            ``total_variation`` [u-unit], ``control_energy`` [u-unit² s]; for a step ``overshoot``
            (fraction of the step), ``settling_time`` and ``rise_time`` [s]. Its ``missing[name]``
            has the reason for each run that does not have a measure.

        Raises
        ------
        ValueError
            as ``Trajectory.metrics``, but for runs that ended before the window only if all did.
        """
        if self.several:
            check_no_target(target)
            return {
                name: self.axis(name).metrics(start, stop, band=band) for name in self.axis_names
            }
        window = self.window(start, np.inf if stop is None else stop)
        reached = np.flatnonzero((self.lengths > window.start) | ~self.diverged).tolist()
        found: dict[str, Vector] = {}
        missing: dict[str, dict[int, str]] = {}
        for i in reached or [0]:  # if no run reached the window, the first one raises the error
            measures = self.run(i).metrics(start, stop, target=target, band=band)
            for name, value in measures.items():
                found.setdefault(name, np.full(len(self), np.nan))[i] = value
            for name, reason in measures.missing.items():
                missing.setdefault(name, {})[i] = reason
        for i in sorted(set(range(len(self))) - set(reached)):
            reason = f"the run diverged at {self.ended[i]:.6g} s, before the window"
            for name in found:
                missing.setdefault(name, {})[i] = reason
        return BatchMetrics(found, missing, band)

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw output and control signal: median, bands of the runs, and when others diverged.

        Parameters
        ----------
        axes, ax
            two matplotlib axes, of several axes two rows with one for each; a new figure by
            default.
        """
        from quell.records.plotting import given_axes, plot_batch, plot_batch_of_axes

        if self.several:
            return plot_batch_of_axes(self, given_axes(axes, ax))
        return plot_batch(self, self.diverged, self.ended, given_axes(axes, ax))

    def to_xarray(self) -> xarray.Dataset:
        """Return the record as an ``xarray.Dataset`` over ``run`` and ``time``.

        The plants' parameters are coordinates of ``run``; one that has a channel's name is the
        coordinate ``plant_<name>``.
        """
        attributes = {"plant": self.plant, "message": self.message}
        data = self._dataset(("run", "time"), attributes)
        taken = {*map(str, data.variables), *map(str, data.dims), *_PER_RUN}
        values_per_run = (self.lengths, self.status, self.ended, self.limit)
        coordinates: dict[str, Any] = {"run": ("run", np.arange(len(self)))}
        for (name, (about, unit)), values in zip(_PER_RUN.items(), values_per_run, strict=True):
            coordinates[name] = ("run", values, {"long_name": about, "units": unit})
        for name, values in self.parameters.items():
            key = f"plant_{name}" if name in taken else name
            coordinates[key] = ("run", values, {"parameter": name})
        return data.assign_coords(coordinates)

    @classmethod
    def load(cls, path: str | os.PathLike[str], max_size: float = MAX_SIZE) -> Self:
        """Return the record that ``save`` wrote, without ``final_states``.

        Parameters
        ----------
        path, max_size
            as those of ``Trajectory.load``.

        Raises
        ------
        FileNotFoundError, ValueError
            as ``Trajectory.load``.
        """

        def made(stored: Stored, fields: dict[str, Any]) -> Any:
            runs, samples, _ = fields["log"].shape
            values = {name: stored.values[name] for name in (*_PER_RUN, *stored.parameters)}
            lengths = values["lengths"]
            if any(each.shape != (runs,) for each in values.values()):
                raise ValueError("must have one value of each parameter for each run")
            if np.any((lengths < 0) | (lengths > samples)):
                raise ValueError(f"lengths must be from 0 to {samples}")
            return cls(
                **fields,
                lengths=lengths.astype(np.int64),
                status=values["run_status"].astype(np.int64),
                ended=values["ended"],
                limit=values["limit"],
                parameters={called: values[name] for name, called in stored.parameters.items()},
            )

        axes, variables = ("run", "time"), set(_PER_RUN)
        attributes = {"dt", "every", "plant"}
        writer = "BatchTrajectory.save"
        found: Self = load_record(path, writer, axes, attributes, variables, max_size, made)
        return found
