"""What the records of one run and of many have in common: channels by name, times, files."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quell import checks
from quell.files import written_atomically
from quell.types import Matrix, Vector

if TYPE_CHECKING:
    import xarray

# Channels of several values a sample, be it only one.
_VECTORS = ("w", "x", "x_hat", "theta")
_MEANINGS = {
    "r": ("reference", "y-unit"),
    "r_shaped": ("reference behind the prefilter", "y-unit"),
    "y": ("output", "y-unit"),
    "y_measured": ("output as measured, with noise", "y-unit"),
    "u": ("control signal as applied", "u-unit"),
    "u_wished": ("control signal before limits", "u-unit"),
    "w": ("disturbances", "w-unit"),
    "x": ("state of the plant", "state-unit"),
    "x_hat": ("estimated output and its derivatives", "y-unit/s^i"),
    "f_residual": ("residual total disturbance estimated by the observer", "y-unit/s^n"),
    "f_learned": ("total disturbance fed forward by the learner", "y-unit/s^n"),
    "f_hat": ("estimated total disturbance", "y-unit/s^n"),
    "authority": ("share of its output that the guard lets the learner have", "1"),
    "error_plain": ("RMS of what an ESO without learner would have missed of f", "y-unit/s^n"),
    "error_learned": (
        "RMS of what would be missed with the learner at full authority",
        "y-unit/s^n",
    ),
    "reason": ("why the authority is what it is (quell.guard.Reason)", "1"),
    "status": ("status flags of the step", "1"),
    "theta": ("coefficients of the learner", "y-unit/s^n per feature-unit"),
    "k": ("index of the deadline", "1"),
    "lateness": ("wake-up behind the deadline", "s"),
    "step_time": ("from the wake-up until u was written", "s"),
    "mode": ("state of the supervisor", "1"),
    "events": ("what befell the cycle (quell.realtime.telemetry.channels.Event)", "1"),
}


class Record:
    """A log whose last axis has the channels side by side, and whose last but one is time."""

    log: Matrix
    channels: tuple[tuple[str, int], ...]
    dt: float
    every: int
    features: tuple[str, ...]

    @property
    def t(self) -> Vector:
        """Times of the samples [s]."""
        return np.arange(self.log.shape[-2], dtype=np.float64) * (self.every * self.dt)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return names_of(self.channels)

    def __getitem__(self, name: str) -> Vector:
        """Return a channel; a ``ValueError`` lists the channels there are."""
        if checks.one_of("channel", name, self.names) == "f_hat":
            return self["f_learned"] + self["f_residual"]
        columns = columns_of(self.channels, name)
        return (
            self.log[..., columns]
            if is_vector(name, columns.stop - columns.start)
            else self.log[..., columns.start]
        )

    def window(self, start: float, stop: float) -> slice:
        """Return the samples with ``start <= t < stop`` as a slice."""
        samples = self.log.shape[-2]
        first, last = (
            first_sample_at(time, self.every * self.dt, samples) for time in (start, stop)
        )
        return slice(first, last)

    def to_xarray(self) -> xarray.Dataset:
        """Return the record as an ``xarray.Dataset`` over ``time``, with units and descriptions as attributes."""
        raise NotImplementedError

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the record to a NetCDF file, whole or not at all; ``load`` or any NetCDF reader opens it."""
        dataset = self.to_xarray()
        with written_atomically(path) as part:
            dataset.to_netcdf(part, engine="h5netcdf")

    def _dataset(self, axes: tuple[str, ...], about: dict[str, Any]) -> xarray.Dataset:
        """Return the channels over ``axes``, what is ``about`` them as attributes."""
        import xarray

        labels: dict[str, Sequence[Any]] = {"theta": self.features}
        variables: dict[str, Any] = {}
        coordinates: dict[str, Any] = {"time": ("time", self.t, {"units": "s"})}
        for name in self.names:
            values = np.ascontiguousarray(self[name])
            told, unit = meaning(name)
            attributes = {"long_name": told, "units": unit}
            if values.ndim > len(axes):
                axis = f"{name}_index"
                coordinates[axis] = (
                    axis,
                    list(labels.get(name) or range(1, values.shape[-1] + 1)),
                    {},
                )
                variables[name] = ((*axes, axis), values, attributes)
            else:
                variables[name] = (axes, values, attributes)
        return xarray.Dataset(
            variables, coordinates, attrs={"dt": self.dt, "every": self.every, **about}
        )


def meaning(name: str) -> tuple[str, str]:
    """Return what a channel is, in words, and its unit."""
    return _MEANINGS.get(name, (name, "1"))


def is_vector(name: str, width: int) -> bool:
    """Say whether a channel has several values a sample, be it that in this run it is only one."""
    return width > 1 or name in _VECTORS


def names_of(channels: tuple[tuple[str, int], ...]) -> tuple[str, ...]:
    """Return the names of the channels that can be read."""
    recorded = tuple(name for name, width in channels if width)
    return (*recorded, "f_hat") if {"f_learned", "f_residual"} <= set(recorded) else recorded


def columns_of(channels: tuple[tuple[str, int], ...], name: str) -> slice:
    """Return the columns of a log in which a channel is."""
    start = 0
    for channel, width in channels:
        if channel == name:
            return slice(start, start + width)
        start += width
    raise KeyError(name)


def read_dataset(
    path: str | os.PathLike[str], writer: str, axes: tuple[str, ...], needed: set[str]
) -> xarray.Dataset:
    """Return what ``writer`` wrote to a NetCDF file: channels over ``axes``, with the attributes or variables ``needed``.

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
        raise ValueError(
            f"path = {os.fspath(path)!r}: must be a NetCDF file written by {writer} ({error})"
        ) from None
    missing = needed - set(data.attrs) - set(map(str, data.variables))
    if missing:
        raise ValueError(
            f"path = {os.fspath(path)!r}: has no {', '.join(sorted(missing))}: it was not written by {writer}"
        )
    if "time" not in data.sizes or any(
        data[name].dims[: len(axes)] != axes for name in data.data_vars
    ):
        raise ValueError(
            f"path = {os.fspath(path)!r}: has channels that are not over {' and '.join(axes)}: it was not written by {writer}"
        )
    return data


def channels_in(data: xarray.Dataset, axes: int) -> dict[str, Any]:
    """Return log, channels and what else ``Record`` has of a dataset whose channels have so many axes, besides one within the channel."""
    names = [name for name in map(str, data.data_vars) if name != "f_hat"]
    columns = [
        data[name].values[..., None] if data[name].ndim == axes else data[name].values
        for name in names
    ]
    return {
        "log": np.concatenate(columns, axis=-1),
        "channels": tuple(
            (name, column.shape[-1]) for name, column in zip(names, columns, strict=True)
        ),
        "dt": float(data.attrs["dt"]),
        "every": int(data.attrs["every"]),
        "plant": str(data.attrs["plant"]),
        "features": tuple(map(str, data["theta_index"].values))
        if "theta_index" in data.coords
        else (),
    }


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
