"""Common part of the records of one run and of a batch: channels, times, NetCDF files."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from quell import checks
from quell.files import check_writable, written_atomically
from quell.quantities import Signals
from quell.records.channels import (
    columns_of,
    describe,
    is_vector,
    readable_names,
    units_of,
)
from quell.records.sample_times import first_sample_at
from quell.types import Channels, Matrix, Vector

if TYPE_CHECKING:
    import xarray


class Record:
    """A log: channels side by side along its last axis, samples along the last but one."""

    log: Matrix
    channels: Channels
    dt: float
    every: int
    features: tuple[str, ...]
    signals: Signals

    @property
    def t(self) -> Vector:
        """Times of the samples [s]."""
        return np.arange(self.log.shape[-2], dtype=np.float64) * (self.every * self.dt)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return readable_names(self.channels)

    def __getitem__(self, name: str) -> Vector:
        """Return a channel; a ``ValueError`` lists the channels there are."""
        if checks.one_of("channel", name, self.names) == "f_hat":
            return self["f_learned"] + self["f_residual"]
        columns = columns_of(self.channels, name)
        vector = is_vector(name, columns.stop - columns.start)
        return self.log[..., columns] if vector else self.log[..., columns.start]

    def window(self, start: float, stop: float) -> slice:
        """Return the samples with ``start <= t < stop`` as a slice."""
        samples, step = self.log.shape[-2], self.every * self.dt
        return slice(first_sample_at(start, step, samples), first_sample_at(stop, step, samples))

    def to_xarray(self) -> xarray.Dataset:
        """Return an ``xarray.Dataset`` over ``time``, with units and descriptions as attributes."""
        raise NotImplementedError

    def save(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write the record to a NetCDF file, whole or not at all; ``load`` reads it.

        A ``ValueError`` says that the file exists, unless ``overwrite`` allows to replace it.
        """
        check_writable(path, overwrite)
        image = _netcdf(self.to_xarray())
        with written_atomically(path, overwrite) as part:
            part.write_bytes(image)

    def _dataset(self, axes: tuple[str, ...], attributes: dict[str, Any]) -> xarray.Dataset:
        """Return the channels over ``axes``, with more ``attributes`` of the dataset."""
        from quell.records.dataset import RecordDataset

        variables: dict[str, Any] = {}
        coordinates: dict[str, Any] = {"time": ("time", self.t, {"units": "s"})}
        for name in self.names:
            values = np.ascontiguousarray(self[name])
            about, unit = describe(name, self.signals)
            of_channel = axes
            if values.ndim > len(axes):
                axis = f"{name}_index"
                labels: list[Any] = list(self.features) if name == "theta" else []
                coordinates[axis] = (axis, labels or list(range(1, values.shape[-1] + 1)), {})
                of_channel = (*axes, axis)
                units = units_of(name, values.shape[-1], self.signals)
                unit = units[0] if len(set(units)) == 1 else ", ".join(units)
            variables[name] = (of_channel, values, {"long_name": about, "units": unit})
        attributes = {"dt": self.dt, "every": self.every, **attributes}
        if self.signals.known:
            attributes["signals"] = json.dumps(self.signals.texts())
        return RecordDataset(variables, coordinates, attrs=attributes)


def _netcdf(dataset: xarray.Dataset) -> bytes:
    """Return a dataset as a NetCDF file in memory."""
    from xarray.backends import H5NetCDFStore

    return _image(lambda netcdf: dataset.dump_to_store(H5NetCDFStore(netcdf)))


def netcdf_of(
    sizes: Mapping[str, int],
    variables: Mapping[str, tuple[str, Any, Mapping[str, Any]]],
    attributes: Mapping[str, Any],
) -> bytes:
    """Return variables over one dimension each as a NetCDF file in memory, without xarray.

    ``variables`` has dimension, values and attributes; values are an array or a list of texts.
    """

    def write(netcdf: Any) -> None:
        import h5py

        netcdf.dimensions = dict(sizes)
        netcdf.attrs.update(attributes)
        for name, (dimension, values, about) in variables.items():
            kind = h5py.string_dtype() if isinstance(values, list) else values.dtype
            stored = netcdf.create_variable(name, (dimension,), kind)
            if len(values):
                stored[:] = np.array(values, dtype=object) if isinstance(values, list) else values
            stored.attrs.update(about)

    return _image(write)


def _image(write: Callable[[Any], None]) -> bytes:
    """Return the NetCDF file that ``write`` makes, in memory.

    HDF5 must not write to the disk itself: when that is full, it leaves objects behind that end the
    process as soon as they are collected.
    """
    import h5netcdf
    import h5py

    memory = {"driver": "core", "backing_store": False, "track_order": True}
    with h5py.File("in memory", "w", **memory) as file:
        with h5netcdf.File(file, "w") as netcdf:
            write(netcdf)
        file.flush()
        return bytes(file.id.get_file_image())
