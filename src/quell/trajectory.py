"""What a run returns."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quell import checks, metrics
from quell.files import written_atomically
from quell.types import Matrix, Status, Vector

if TYPE_CHECKING:
    import xarray

# Channels of several values a sample, be it only one.
_VECTORS = ("w", "x", "x_hat", "theta")
_MEANINGS = {
    "r": ("reference", "y-unit"),
    "y": ("output", "y-unit"),
    "y_measured": ("output as measured, with noise", "y-unit"),
    "u": ("control signal as applied", "u-unit"),
    "w": ("disturbances", "w-unit"),
    "x": ("state of the plant", "state-unit"),
    "x_hat": ("estimated output and its derivatives", "y-unit/s^i"),
    "f_residual": ("residual total disturbance estimated by the observer", "y-unit/s^n"),
    "f_learned": ("total disturbance fed forward by the learner", "y-unit/s^n"),
    "f_hat": ("estimated total disturbance", "y-unit/s^n"),
    "authority": ("share of its output that the guard lets the learner have", "1"),
    "error_plain": ("RMS of what an ESO without learner would have missed of f", "y-unit/s^n"),
    "error_learned": ("RMS of what would be missed with the learner at full authority", "y-unit/s^n"),
    "reason": ("why the authority is what it is (quell.guard.Reason)", "1"),
    "status": ("status flags of the step", "1"),
    "theta": ("coefficients of the learner", "y-unit/s^n per feature-unit"),
}


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The record of one run.

    ``run["y"]`` is a channel: (samples,), or (samples, width) for ``w``, ``x``, ``x_hat`` and ``theta``; ``run.t`` are its times [s].
    Besides what was recorded there is ``f_hat = f_learned + f_residual``.

    Attributes
    ----------
    log : (samples, columns) array
        all channels side by side.
    channels : tuple of (name, width)
        what the columns are, in order.
    dt : float
        sample time of the run [s]; recorded was every ``every``-th sample.
    status : Status
        all flags that any step reported, and ``DIVERGED`` where the run ended early; ``message`` puts it in words.
    ended : float
        when the run ended [s].
    limit : float
        the ``|y|`` at which it would have been ended [y-unit].
    plant : str
        its name.
    features : tuple of str
        what the entries of ``theta`` multiply.
    final_state
        the controller's state at the end, a NamedTuple; ``controller.read(run.final_state)`` puts it in words.
    """

    log: Matrix
    channels: tuple[tuple[str, int], ...]
    dt: float
    every: int = 1
    status: Status = Status.OK
    ended: float = 0.0
    limit: float = math.inf
    plant: str = ""
    features: tuple[str, ...] = ()
    final_state: Any = None

    @property
    def diverged(self) -> bool:
        """Whether the run ended early."""
        return Status.DIVERGED in self.status

    @property
    def message(self) -> str:
        """What happened, when, and what to do."""
        if not self.diverged:
            return self.status.message
        return f"|y| went beyond limit = {self.limit:.3g}, or was no number, at {self.ended:.6g} s. {self.status.message}"

    @property
    def t(self) -> Vector:
        """Times of the samples [s]."""
        return np.arange(self.log.shape[0], dtype=np.float64) * (self.every * self.dt)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        recorded = tuple(name for name, width in self.channels if width)
        return (*recorded, "f_hat") if {"f_learned", "f_residual"} <= set(recorded) else recorded

    def __getitem__(self, name: str) -> Vector:
        """Return a channel; a ``ValueError`` lists the channels there are."""
        if checks.one_of("channel", name, self.names) == "f_hat":
            return self["f_learned"] + self["f_residual"]
        start = 0
        for channel, width in self.channels:
            if channel == name:
                break
            start += width
        return self.log[:, start : start + width] if name in _VECTORS else self.log[:, start]

    def __len__(self) -> int:
        """Return the number of samples."""
        return int(self.log.shape[0])

    def window(self, start: float, stop: float) -> slice:
        """Return the samples with ``start <= t < stop`` as a slice."""
        first, last = (first_sample_at(time, self.every * self.dt, len(self)) for time in (start, stop))
        return slice(first, last)

    def metrics(
        self, start: float = 0.0, stop: float | None = None, *, target: float | None = None, band: float = 0.002
    ) -> dict[str, float]:
        """Judge the response in the window ``[start, stop)`` [s] as a step from its first value of y.

        Parameters
        ----------
        start, stop
            the window; to the end of the record by default.
        target
            where y should go; the reference at the end of the window by default.
        band
            half width of the settling band, as a fraction of the move.

        Returns
        -------
        dict
            ``peak_error``, ``rms``, ``iae``, ``ise``, ``itae`` of r − y, and ``control_variation``; and, where the reference steps at the
            start of the window or ``target`` is given: ``overshoot`` (fraction of the move), ``settling_time`` and ``rise_time`` [s]
            (NaN where y does not get there).

        Raises
        ------
        ValueError
            where the window holds no sample: for instance because the run ended before it.
        """
        part = self.window(start, np.inf if stop is None else stop)
        if part.start >= len(self) or part.stop <= part.start:
            raise ValueError(
                f"start = {start!r}, stop = {stop!r}: the record ends at {self.ended:.6g} s ({self.message}); "
                "the window must hold at least one sample"
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
        """Tell whether the reference goes to ``goal`` at the start of a window, give or take a sample, and stays; 0 s is such a start."""
        r = self["r"]
        stays = bool(np.all(r[part.start + 1 : part.stop] == goal))
        return stays and (part.start == 0 or bool(np.any(r[max(part.start - 2, 0) : part.start + 1] != goal)))

    def plot(self, axes: Any = None) -> Any:
        """Draw output and reference, control signal, estimates of f and, where there is a guard, what it did; return the axes.

        Parameters
        ----------
        axes
            three matplotlib axes to draw into, or four for a run with a guard; a new figure by default.
        """
        from quell.plotting import plot_trajectory

        return plot_trajectory(self, axes)

    def to_xarray(self) -> xarray.Dataset:
        """Return the record as an ``xarray.Dataset`` over ``time``, with units and descriptions as attributes."""
        import xarray

        labels: dict[str, Sequence[Any]] = {"theta": self.features}
        variables: dict[str, Any] = {}
        coordinates: dict[str, Any] = {"time": ("time", self.t, {"units": "s"})}
        for name in self.names:
            values = np.ascontiguousarray(self[name])
            meaning, unit = _MEANINGS.get(name, (name, "1"))
            attributes = {"long_name": meaning, "units": unit}
            if values.ndim == 2:
                axis = f"{name}_index"
                coordinates[axis] = (axis, list(labels.get(name) or range(1, values.shape[1] + 1)), {})
                variables[name] = (("time", axis), values, attributes)
            else:
                variables[name] = (("time",), values, attributes)
        about = {
            "plant": self.plant,
            "dt": self.dt,
            "every": self.every,
            "status": int(self.status),
            "ended": self.ended,
            "limit": self.limit,
            "message": self.message,
        }
        return xarray.Dataset(variables, coordinates, attrs=about)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the record to a NetCDF file, whole or not at all; ``Trajectory.load`` or any NetCDF reader opens it."""
        dataset = self.to_xarray()
        with written_atomically(path) as part:
            dataset.to_netcdf(part, engine="h5netcdf")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trajectory:
        """Read back what ``save`` wrote (all but ``final_state``).

        Raises
        ------
        ValueError
            where the file is not such a record.
        """
        import xarray

        try:
            with xarray.open_dataset(Path(path), engine="h5netcdf") as dataset:
                data = dataset.load()
        except (OSError, ValueError) as error:
            if isinstance(error, FileNotFoundError):
                raise
            raise ValueError(f"path = {os.fspath(path)!r}: must be a NetCDF file written by Trajectory.save ({error})") from None
        missing = {"dt", "every", "status", "ended", "plant"} - set(data.attrs)
        if missing:
            raise ValueError(f"path = {os.fspath(path)!r}: has no {', '.join(sorted(missing))}: it was not written by Trajectory.save")
        names = [name for name in map(str, data.data_vars) if name != "f_hat"]
        if "time" not in data.sizes or any(data[name].dims[:1] != ("time",) for name in names):
            raise ValueError(f"path = {os.fspath(path)!r}: has channels that are not over time: it was not written by Trajectory.save")
        columns = [data[name].values[:, None] if data[name].ndim == 1 else data[name].values for name in names]
        return cls(
            log=np.hstack(columns),
            channels=tuple((name, column.shape[1]) for name, column in zip(names, columns, strict=True)),
            dt=float(data.attrs["dt"]),
            every=int(data.attrs["every"]),
            status=Status(int(data.attrs["status"])),
            ended=float(data.attrs["ended"]),
            limit=float(data.attrs.get("limit", math.inf)),
            plant=str(data.attrs["plant"]),
            features=tuple(map(str, data["theta_index"].values)) if "theta_index" in data.coords else (),
        )


def first_sample_at(time: float, step: float, samples: int) -> int:
    """Return the first of ``samples`` samples, ``step`` apart, that is not before ``time``; ``samples`` where none is.

    A time that is a whole number of steps but for rounding belongs to that sample.
    """
    if math.isnan(time):
        raise ValueError(f"time = {time!r}: must be a number")
    return math.ceil(in_steps(min(max(time, 0.0), samples * step), step))


def in_steps(time: float, step: float) -> float:
    """Return ``time / step``, to the nearest whole number where it is one but for rounding."""
    count = time / step
    nearest = float(round(count))
    return nearest if math.isclose(count, nearest, rel_tol=1e-12, abs_tol=1e-9) else count
