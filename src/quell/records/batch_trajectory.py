"""What a batch of runs returns."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.records.record import Record, channels_in, read_dataset
from quell.records.trajectory import Trajectory
from quell.types import Matrix, Status, Vector

if TYPE_CHECKING:
    import xarray

# What each run has one value of, as the file calls it.
_PER_RUN = {
    "lengths": ("number of samples recorded", "1"),
    "run_status": ("all status flags of the run (quell.Status)", "1"),
    "ended": ("when the run ended", "s"),
    "limit": ("the |y| at which it would have been ended", "y-unit"),
}


@dataclass(frozen=True, eq=False)
class BatchTrajectory(Record):
    """The record of a batch of runs.

    ``runs["y"]`` is a channel: (runs, samples), or (runs, samples, width) for ``w``, ``x``, ``x_hat`` and ``theta``; ``runs.t`` are their
    times [s]. After the end of a run that diverged its samples are NaN; ``runs.run(i)`` is the i-th run as a ``Trajectory``.

    Attributes
    ----------
    log : (runs, samples, columns) array
        the recorded channels side by side.
    channels : tuple of (name, width)
        what the columns are, in order.
    dt : float
        sample time of the runs [s]; recorded was every ``every``-th sample.
    lengths : (runs,) array
        how many samples of each run were recorded.
    status : (runs,) array
        all ``Status`` flags that any step of a run reported, and ``DIVERGED`` where it ended early; ``message`` sums them up.
    ended : (runs,) array
        when each run ended [s].
    limit : (runs,) array
        the ``|y|`` at which it would have been ended [y-unit].
    plant : str
        name of the plants.
    parameters : dict of (runs,) arrays
        in which the plants differ.
    features : tuple of str
        what the entries of ``theta`` multiply.
    final_states : tuple
        the controllers' states at the end; ``controller.read(runs.final_states[i])`` puts one in words.
    """

    log: Matrix
    channels: tuple[tuple[str, int], ...]
    dt: float
    every: int
    lengths: NDArray[np.int64]
    status: NDArray[np.int64]
    ended: Vector
    limit: Vector
    plant: str = ""
    parameters: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    features: tuple[str, ...] = ()
    final_states: tuple[Any, ...] = ()

    @property
    def diverged(self) -> NDArray[np.bool_]:
        """Which runs ended early: (runs,)."""
        return (self.status & int(Status.DIVERGED)) != 0

    @property
    def message(self) -> str:
        """How many runs reported what, and when the first diverged."""
        counts = {flag: int(np.count_nonzero(self.status & int(flag))) for flag in Status if flag}
        told = [
            f"{count} of {len(self)} runs: {flag.message}"
            for flag, count in counts.items()
            if count
        ]
        if np.any(self.diverged):
            first = int(np.argmin(np.where(self.diverged, self.ended, np.inf)))
            told.append(f"The first to diverge was run {first}, at {self.ended[first]:.6g} s.")
        return " ".join(told) or f"All is well in all {len(self)} runs."

    def __len__(self) -> int:
        """Return the number of runs."""
        return int(self.log.shape[0])

    def run(self, i: int) -> Trajectory:
        """Return the i-th run, as far as it went, with the channels that were recorded."""
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
        )

    def metrics(
        self,
        start: float = 0.0,
        stop: float | None = None,
        *,
        target: float | None = None,
        band: float = 0.002,
    ) -> dict[str, Vector]:
        """Judge each run in the window ``[start, stop)`` [s] as ``Trajectory.metrics`` does.

        A run that diverged within the window is judged by what there is of it; ``diverged`` says which. One that ended before the window is
        NaN throughout. So is whatever is not defined in a run while it is in others.

        Parameters
        ----------
        start, stop
            the window [s]; to the end of the record by default.
        target
            where y should go [y-unit]; each run's reference at the end of the window by default.
        band
            half width of the settling band, as a fraction of the move.

        Returns
        -------
        dict
            of arrays (runs,), by the names and in the units of ``Trajectory.metrics``: ``peak_error`` and ``rms`` [y-unit], ``iae``
            [y-unit s], ``ise`` [y-unit² s], ``itae`` [y-unit s²], ``control_variation`` [u-unit]; for a step ``overshoot`` (fraction of the
            move), ``settling_time`` and ``rise_time`` [s].

        Raises
        ------
        ValueError
            as ``Trajectory.metrics``; where runs ended before the window, only if all did.
        """
        window = self.window(start, np.inf if stop is None else stop)
        there = np.flatnonzero((self.lengths > window.start) | ~self.diverged)
        judged = {
            int(i): self.run(int(i)).metrics(start, stop, target=target, band=band)
            for i in (there if there.size else [0])
        }
        names = list(dict.fromkeys(name for found in judged.values() for name in found))
        nothing: dict[str, float] = {}
        return {
            name: np.array([judged.get(i, nothing).get(name, np.nan) for i in range(len(self))])
            for name in names
        }

    def plot(self, axes: Any = None) -> Any:
        """Draw output and control signal: the median, where half, nine tenths and all of the runs lie, and when others diverged.

        Parameters
        ----------
        axes
            two matplotlib axes to draw into; a new figure by default.
        """
        from quell.records.plotting import plot_batch

        return plot_batch(self, axes)

    def to_xarray(self) -> xarray.Dataset:
        """Return the record as an ``xarray.Dataset`` over ``run`` and ``time``, with the plants' parameters as coordinates of ``run``.

        A parameter that is called as a channel is, is the coordinate ``plant_<name>``.
        """
        data = self._dataset(("run", "time"), {"plant": self.plant, "message": self.message})
        taken = {*map(str, data.variables), *map(str, data.dims), *_PER_RUN}
        per_run = zip(
            _PER_RUN.items(), (self.lengths, self.status, self.ended, self.limit), strict=True
        )
        coordinates: dict[str, Any] = {"run": ("run", np.arange(len(self)))}
        coordinates |= {
            name: ("run", values, {"long_name": about, "units": unit})
            for (name, (about, unit)), values in per_run
        }
        for name, values in self.parameters.items():
            coordinates[f"plant_{name}" if name in taken else name] = (
                "run",
                values,
                {"parameter": name},
            )
        return data.assign_coords(coordinates)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> BatchTrajectory:
        """Read back what ``save`` wrote (all but ``final_states``).

        Raises
        ------
        ValueError
            where the file is not such a record.
        """
        data = read_dataset(
            path, "BatchTrajectory.save", ("run", "time"), {"dt", "every", "plant", *_PER_RUN}
        )
        return cls(
            **channels_in(data, axes=2),
            lengths=data["lengths"].values,
            status=data["run_status"].values,
            ended=data["ended"].values,
            limit=data["limit"].values,
            parameters={
                str(c.attrs["parameter"]): c.values
                for c in data.coords.values()
                if "parameter" in c.attrs
            },
        )
