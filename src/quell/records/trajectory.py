"""The record of one run."""

from __future__ import annotations

import math
import os
from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from quell.quantities import UNKNOWN, Signals
from quell.reading import MAX_SIZE
from quell.records.measures import MEASURES, Metrics, Window, measured
from quell.records.metrics import SETTLING_BAND
from quell.records.netcdf import Stored, load_record
from quell.records.record import Record
from quell.types import Channels, Matrix, Status

if TYPE_CHECKING:
    import xarray

# Times the largest of 1 and the reference: a loop may well reach a limit below it, for example by
# its overshoot. Chosen by hand.
_NEAR = 10.0


@dataclass(frozen=True, eq=False)
class Trajectory(Record):
    """The record of one run.

    ``run["y"]`` is a channel: (samples,), or (samples, width) for ``w``, ``x``, ``x_hat`` and
    ``theta``; ``run.t`` are its times [s]. ``f_hat = f_learned + f_residual`` is computed.

    ``status`` has all flags that any step reported, and ``DIVERGED`` if the run ended early;
    ``message`` explains them. ``controller.read(run.final_state)`` explains the controller's state
    at the end.
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
    signals: Signals = UNKNOWN  #: names and units of y, u and disturbances
    u_limits: tuple[float, float] = (-math.inf, math.inf)  #: limits of the controller [u-unit]

    @property
    def diverged(self) -> bool:
        """True if the run ended early."""
        return Status.DIVERGED in self.status

    @property
    def message(self) -> str:
        """All that the run reported, with times, and what to do."""
        if not self.diverged:
            return self.status.message
        what = f"|y| went beyond limit = {self.limit:.3g}, or was no number, at {self.ended:.6g} s"
        if Status.POORLY_INTEGRATED in self.status or not self._limit_is_near:
            return f"{what}. {self.status.message}"
        others = self.status & ~Status.DIVERGED
        more = f" {others.message}" if others else ""
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

    def metrics(
        self,
        start: float = 0.0,
        stop: float | None = None,
        *,
        target: float | None = None,
        band: float = SETTLING_BAND,
    ) -> Metrics:
        """Return measures of the response in ``[start, stop)`` [s], as a step from its first y.

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
            before the window (zero before the run); if the reference steps once in the window, and
            from there on, or ``target`` is given, also ``overshoot`` (fraction of the step),
            ``settling_time`` and ``rise_time`` [s], NaN if y does not reach the target. Its
            ``missing`` has the reason for each of these that does not exist. If the run diverged in
            the window, there is no step, and the others are those of the samples up to there.

        Raises
        ------
        ValueError
            if the window has no sample, for instance because the run ended before it.
        """
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
            and one more for the error; a new figure by default.

        Returns
        -------
        numpy.ndarray
            the axes in this order; in a new figure the error is drawn below the output.
        """
        from quell.records.plotting import given_axes, plot_run

        return plot_run(self, self.ended if self.diverged else None, given_axes(axes, ax))

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame`` with a row for each sample; needs the extra ``pandas``.

        The entries of vector channels are columns of their own, ``x[0]`` and ``theta[x1]``; its
        ``attrs["units"]`` has the unit of each column.
        """
        from quell.records.table import to_pandas

        return to_pandas(self)

    def to_csv(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write all channels as CSV, a line for each sample, with units in the line of names.

        A ``ValueError`` says that the file exists, unless ``overwrite`` allows to replace it.
        """
        from quell.records.table import write_csv

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
