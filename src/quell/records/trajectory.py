"""The record of one run."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from quell import checks
from quell.records import metrics
from quell.records.record import Record, read_dataset, record_fields
from quell.types import Channels, Matrix, Status

if TYPE_CHECKING:
    import xarray


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

    @property
    def diverged(self) -> bool:
        """True if the run ended early."""
        return Status.DIVERGED in self.status

    @property
    def message(self) -> str:
        """All that the run reported, with times, and what to do."""
        if not self.diverged:
            return self.status.message
        return (
            f"|y| went beyond limit = {self.limit:.3g}, or was no number, at {self.ended:.6g} s. "
            f"{self.status.message}"
        )

    def __len__(self) -> int:
        """Return the number of samples."""
        return int(self.log.shape[0])

    def metrics(
        self,
        start: float = 0.0,
        stop: float | None = None,
        *,
        target: float | None = None,
        band: float = 0.002,
    ) -> dict[str, float]:
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
        dict
            ``peak_error``, ``rms``, ``iae``, ``ise``, ``itae`` of r − y, and ``control_variation``;
            if the reference steps at the start of the window or ``target`` is given, also
            ``overshoot`` (fraction of the step), ``settling_time`` and ``rise_time`` [s], NaN if y
            does not reach the target.

        Raises
        ------
        ValueError
            if the window has no sample, for instance because the run ended before it.
        """
        part = self.window(start, np.inf if stop is None else stop)
        if part.start >= len(self) or part.stop <= part.start:
            raise ValueError(
                f"start = {start!r}, stop = {stop!r}: the record ends at {self.ended:.6g} s "
                f"({self.message}); the window must hold at least one sample"
            )
        t, y, u = self.t[part], self["y"][part], self["u"][part]
        error = self["r"][part] - y
        goal = float(self["r"][part][-1]) if target is None else checks.finite("target", target)
        initial = float(y[0])
        found: dict[str, float] = {}
        if goal != initial and (target is not None or self._steps_at(part, goal)):
            found |= {
                "overshoot": metrics.overshoot(y, goal, initial),
                "settling_time": metrics.settling_time(t, y, goal, band, initial),
                "rise_time": metrics.rise_time(t, y, goal, initial),
            }
        return found | {
            "peak_error": metrics.peak(error),
            "rms": metrics.rms(error),
            "iae": metrics.iae(t, error),
            "ise": metrics.ise(t, error),
            "itae": metrics.itae(t, error),
            "control_variation": metrics.control_variation(u),
        }

    def _steps_at(self, part: slice, goal: float) -> bool:
        """Return whether the reference steps to ``goal`` at the start of a window and stays there.

        The step may be a sample off; at 0 s there always is one.
        """
        r = self["r"]
        stays = bool(np.all(r[part.start + 1 : part.stop] == goal))
        return stays and (
            part.start == 0 or bool(np.any(r[max(part.start - 2, 0) : part.start + 1] != goal))
        )

    def plot(self, axes: Any = None) -> Any:
        """Draw output, control signal, estimates of f and, with a guard, its authority.

        Parameters
        ----------
        axes
            three matplotlib axes, or four for a run with a guard; a new figure by default.
        """
        from quell.records.plotting import plot_run

        return plot_run(self, self.ended if self.diverged else None, axes)

    def to_xarray(self) -> xarray.Dataset:
        """Return an ``xarray.Dataset`` over ``time``, with units and descriptions as attributes."""
        attributes = {
            "plant": self.plant,
            "status": int(self.status),
            "ended": self.ended,
            "limit": self.limit,
            "message": self.message,
        }
        return self._dataset(("time",), attributes)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trajectory:
        """Return the record that ``save`` wrote, without ``final_state``.

        Raises
        ------
        ValueError
            if the file is not such a record.
        """
        required = {"dt", "every", "status", "ended", "plant"}
        data = read_dataset(path, "Trajectory.save", ("time",), required)
        return cls(
            **record_fields(data, axes=1),
            status=Status(int(data.attrs["status"])),
            ended=float(data.attrs["ended"]),
            limit=float(data.attrs.get("limit", math.inf)),
        )
