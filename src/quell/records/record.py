"""Records: channels, times, tables, and the common part of one run and of a batch.

Common part of the records of one run and of a batch: channels, times, NetCDF files.

The channels of a record: names, columns, descriptions and units.

A record as a table: a column for each number of a sample, for CSV and data frames.
"""

from __future__ import annotations

import functools
import json
import math
import operator
import os
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.files import check_writable, written_atomically
from quell.hints import Hinted, plain
from quell.quantities import UNKNOWN, AxesSignals, Signals
from quell.records.metrics import MEASURES
from quell.types import Channels, Matrix, Status, Vector

if TYPE_CHECKING:
    import xarray

# ---- The channels of a record ----

# Channels that are vectors even if their width is one.
_VECTORS = ("w", "x", "x_hat", "d_hat", "f_derivatives", "theta")
# Description and unit.
_DESCRIPTIONS = {
    "r": ("reference", "y-unit"),
    "r_shaped": ("reference behind the prefilter", "y-unit"),
    "y": ("output", "y-unit"),
    "y_measured": ("output as measured, with noise", "y-unit"),
    "u": ("control signal as applied", "u-unit"),
    "u_wished": ("control signal before limits", "u-unit"),
    "v": ("B0 u, as applied to the axes", "y-unit/s^n"),
    "w": ("disturbances", "w-unit"),
    "x": ("state of the plant", "state-unit"),
    "x_hat": ("estimated output and its derivatives", "y-unit/s^i"),
    "d_hat": ("estimated disturbances and their derivatives", "1"),
    "f_residual": ("residual total disturbance estimated by the observer", "y-unit/s^n"),
    "f_derivatives": ("estimated derivatives of f, from the first on", "y-unit/s^(n+i)"),
    "u_feedforward": ("feedforward of the model", "u-unit"),
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
    "events": ("events of the cycle (quell.realtime.recordings.Event)", "1"),
}


# The words of descriptions that a signal's name stands for.
_NAMED = {
    "y": "output",
    "y_measured": "output",
    "u": "control signal",
    "u_wished": "control signal",
}


def is_channel(name: str) -> bool:
    """Return whether a channel, or one of an axis, can have this name."""
    return name.rpartition(".")[2] in _DESCRIPTIONS or name == "f_hat"


def describe(name: str, signals: Any = UNKNOWN) -> tuple[str, str]:
    """Return a channel's description and unit, those of the plant's ``signals`` if known.

    Of several axes the unit is that of the first number, in ``units_of`` of each.
    """
    if isinstance(signals, AxesSignals):
        text, unit = describe(name)
        return text, units_of_axes(name, 1, signals)[0] if "." in name else unit
    axis, _, channel = name.rpartition(".")  # an estimate of one of several axes
    if axis and channel in _DESCRIPTIONS:
        text, unit = _DESCRIPTIONS[channel]
        return f"{text}, {axis}", unit
    text, unit = _DESCRIPTIONS.get(name, (name, "1"))
    if name in _NAMED:
        known = signals.y if name.startswith("y") else signals.u
        text = text.replace(_NAMED[name], known.name or _NAMED[name])
    elif name == "w" and any(each.name for each in signals.w):
        text = f"{text}: {', '.join(map(str, signals.w))}"
    return text, signals.unit(unit)


def units_of_axes(name: str, width: int, signals: AxesSignals) -> list[str]:
    """Return the unit of each entry of a channel of several axes."""
    return signals.units(name, describe(name)[1], width)


def units_of(name: str, width: int, signals: Any = UNKNOWN) -> list[str]:
    """Return the unit of each entry of a channel with ``width`` entries."""
    if isinstance(signals, AxesSignals):
        return units_of_axes(name, width, signals)
    if name == "x_hat" and signals.y.unit:
        return [signals.derivative(i) for i in range(width)]
    if name == "w" and len(signals.w) == width:
        return [each.unit or "w-unit" for each in signals.w]
    return [describe(name, signals)[1]] * width


def signals_of_loop(signals: Any, controller: Any) -> Any:
    """Return the plant's signals with the unit of the controller's f, if it has an observer."""
    if isinstance(signals, AxesSignals):
        return signals
    while controller is not None:
        observer = getattr(controller, "observer", None)
        if observer is not None:
            return signals.with_f(getattr(observer, "f_degree", None))
        controller = getattr(controller, "controller", None)
    return signals


def is_vector(name: str, width: int) -> bool:
    """Return whether a channel has an axis for its entries, be it of length 1."""
    return width > 1 or name.rpartition(".")[2] in _VECTORS


def readable_names(channels: Channels) -> tuple[str, ...]:
    """Return the names of the channels that have columns, and ``f_hat`` if it can be computed."""
    recorded = tuple(name for name, width in channels if width)
    return (*recorded, "f_hat") if {"f_learned", "f_residual"} <= set(recorded) else recorded


def flags_of(column: Vector) -> NDArray[np.int64]:
    """Return a channel ``status`` as whole numbers; what is no sum of flags counts as none."""
    known = functools.reduce(operator.or_, Status)
    return np.where((column >= 0.0) & (column <= known), column, 0.0).astype(np.int64)


def columns_of(channels: Channels, name: str) -> slice:
    """Return the columns of a channel in a log."""
    start = 0
    for channel, width in channels:
        if channel == name:
            return slice(start, start + width)
        start += width
    raise KeyError(name)


# ---- Conversion of times to sample numbers, unaffected by rounding ----


def check_times(samples: int, step: float) -> None:
    """Raise a ``ValueError`` if the times of ``samples`` samples are beyond all numbers."""
    if not math.isfinite(samples * step):
        raise ValueError(f"its samples are {step:g} s apart: its times are beyond all numbers")


# Share by which times may differ from the sample time: clocks drift by less. Chosen by hand.
_DRIFT = 1e-3


def check_steps(time: Vector, index: Vector, step: float, known: str) -> None:
    """Raise a ``ValueError`` unless times [s] go on by ``step`` from one index to the next.

    They may be rounded, by a step, and drift, as clocks do. ``known`` says what the step is, and
    where that stands. An index that is no number is not judged here.
    """
    if time.size < 2 or not np.all(np.isfinite(index)):
        return
    with np.errstate(all="ignore"):  # a damaged file may hold any numbers
        passed, meant = time - time[0], (index - index[0]) * step
        wrong = ~(np.abs(passed - meant) <= step + _DRIFT * np.abs(meant))
    if np.any(wrong):
        k = int(np.argmax(wrong))
        if not np.isfinite(time[0]):
            raise ValueError("its first time is not finite; must be a number, in seconds")
        raise ValueError(
            f"its times contradict each other: from k = {index[0]:.0f} to k = {index[k]:.0f} the "
            f"column time goes on by {passed[k]:g} s, by {known} it is {meant[k]:g} s; correct "
            "the one that is wrong"
        )


def first_sample_at(time: float, step: float, samples: int) -> int:
    """Return the first of ``samples`` samples, ``step`` apart, that is not before ``time``.

    Returns ``samples`` if all are. A time that is a whole number of steps but for rounding is at
    that sample.
    """
    if math.isnan(time):
        raise ValueError(f"time = {time!r}: must be a number")
    return math.ceil(in_steps(min(max(time, 0.0), samples * step), step))


def in_steps(time: float, step: float) -> float:
    """Return ``time / step``, rounded to a whole number if it is one but for rounding errors."""
    count = time / step
    nearest = float(round(count))
    # Far above the rounding of a quotient (2e-16), far below any time that is meant to be between
    # samples.
    return nearest if math.isclose(count, nearest, rel_tol=1e-12, abs_tol=1e-9) else count


# ---- Common part of the records of one run and of a batch ----


class Record(Hinted):
    """A log: channels side by side along its last axis, samples along the last but one."""

    log: Matrix
    channels: Channels
    dt: float
    every: int
    features: tuple[str, ...]
    signals: Any  # ``Signals``, of several axes ``AxesSignals`` if they are known
    axis_names: tuple[str, ...]
    axis_features: tuple[tuple[str, ...], ...]

    def _meant(self) -> Mapping[str, str]:
        names = readable_names(vars(self).get("channels", ()))
        channels = {plain(name): f"run[{name!r}]" for name in names}
        measures = {plain(name): f"run.metrics()[{name!r}]" for name in MEASURES}
        return measures | channels | dict.fromkeys(("time", "times"), "run.t")

    @property
    def several(self) -> bool:
        """Whether it is a record of axes with names, or of more than one r, y or u."""
        return bool(self.axis_names) or any(
            width > 1 and name in ("r", "y", "y_measured", "u") for name, width in self.channels
        )

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

    def _explained(self, status: Status) -> str:
        """Return the sentences of the flags, with the share of the samples that have each."""
        failed = self.failed_trials
        if failed and not status:
            return failed
        shares = {}
        if "status" in self.names and self.log.size:
            flags = flags_of(self["status"])
            shares = {one: float(np.mean((flags & int(one)) != 0)) for one in status}
        return " ".join(filter(None, [status.explained(shares), failed]))

    @property
    def failed_trials(self) -> str:
        """Where a guard's trials failed twice, and what to do; empty where none did.

        A sentence for each axis, with the share of the samples, from channels that have
        ``Reason.FAILED`` (docs/theory_guard).
        """
        from quell.guard import Reason

        sentences = []
        for name in self.names:
            axis, _, channel = name.rpartition(".")
            is_reason = channel == "reason" and self.log.size > 0
            share = float(np.mean(self[name] == Reason.FAILED)) if is_reason else 0.0
            if share > 0.0:
                where = f"{axis}: " if axis else ""
                time = f"{100.0 * share:.3g} % of the samples"
                sentences.append(f"{where}{time}: {Reason.FAILED.message}")
        return " ".join(sentences)

    def window(self, start: float, stop: float) -> slice:
        """Return the samples with ``start <= t < stop`` as a slice."""
        samples, step = self.log.shape[-2], self.every * self.dt
        return slice(first_sample_at(start, step, samples), first_sample_at(stop, step, samples))

    def labels(self, name: str, width: int) -> list[str]:
        """Return the names of the entries of a channel; none if they have numbers."""
        axis, _, channel = name.rpartition(".")
        if name == "theta":
            return list(self.features)
        if channel == "theta" and axis in self.axis_names and self.axis_features:
            return list(self.axis_features[self.axis_names.index(axis)])
        if not self.axis_names:
            return []
        of_axes = AxesSignals(self.axis_names, (), ())
        known = self.signals if isinstance(self.signals, AxesSignals) else of_axes
        labels = known.labels(name, width)
        return [] if labels == [str(i) for i in range(width)] else labels

    def _fields_of(self, which: int | str) -> dict[str, Any]:
        """Return what a record of one axis has: its u is v."""
        if not self.axis_names:
            raise ValueError(
                "this record is of one loop, which has no axes: take columns of run['y'] and "
                "run['u']"
            )
        if isinstance(which, str):
            which = self.axis_names.index(checks.one_of("axis", which, self.axis_names))
        i = checks.whole("axis", which, 0, len(self.axis_names) - 1)
        for name in ("r", "y", "v"):
            if name not in self.names:
                raise ValueError(f"axis: channel {name!r} is not recorded; add it to record")
        prefix = f"{self.axis_names[i]}."
        own = [(name.removeprefix(prefix), width, name) for name, width in self.channels]
        own = [each for each in own if each[2].startswith(prefix)]
        apart = {"r", "y", "y_measured", "u", "u_wished", "v", "status", *(each[0] for each in own)}
        whole = [(name, width, name) for name, width in self.channels if "." not in name]
        whole = [each for each in whole if each[0] not in apart]
        usual = (("r", "r"), ("y", "y"), ("y_measured", "y_measured"), ("u", "v"))
        singles = [each for each in usual if each[1] in self.names]
        columns = [columns_of(self.channels, source).start + i for _, source in singles]
        for _, _, source in (*whole, *own):
            columns += range(*columns_of(self.channels, source).indices(self.log.shape[-1]))
        channels = [(name, 1) for name, _ in singles]
        channels += [(name, width) for name, width, _ in (*whole, *own)]
        known = isinstance(self.signals, AxesSignals)
        return {
            "log": np.ascontiguousarray(self.log[..., columns]),
            "channels": tuple(channels),
            "features": self.axis_features[i] if self.axis_features else (),
            "signals": Signals(self.signals.y[i]) if known else UNKNOWN,
            "axis_names": (),
            "axis_features": (),
        }

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
                labels: list[Any] = self.labels(name, values.shape[-1])
                coordinates[axis] = (axis, labels or list(range(1, values.shape[-1] + 1)), {})
                of_channel = (*axes, axis)
                units = units_of(name, values.shape[-1], self.signals)
                unit = units[0] if len(set(units)) == 1 else ", ".join(units)
            variables[name] = (of_channel, values, {"long_name": about, "units": unit})
        attributes = {"dt": self.dt, "every": self.every, **attributes}
        if self.several:
            attributes["axis_names"] = json.dumps(self.axis_names)
            attributes["axis_features"] = json.dumps(self.axis_features)
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


# ---- A record as a table ----

# Rows that are converted to text at once; chosen by hand.
_BLOCK = 10_000


def columns(run: Record) -> tuple[list[str], list[str], Matrix]:
    """Return names, units and numbers (samples, columns) of a run; the first column is the time."""
    names, units, parts = ["time"], ["s"], [run.t[:, None]]
    for name in run.names:
        values = np.asarray(run[name])
        if values.ndim == 1:
            values, own = values[:, None], [name]
        else:
            labels = run.labels(name, values.shape[1])
            entries = range(values.shape[1])
            own = [f"{name}[{labels[i] if i < len(labels) else i}]" for i in entries]
        names += own
        units += units_of(name, len(own), run.signals)
        parts.append(values)
    return names, units, np.hstack(parts)


def to_pandas(run: Record) -> Any:
    """Return a ``pandas.DataFrame`` over the time, with units in ``attrs["units"]``."""
    from quell.checks import import_extra

    pandas = import_extra("pandas", "pandas", "a data frame")
    names, units, values = columns(run)
    index = pandas.Index(values[:, 0], name="time")
    frame = pandas.DataFrame(values[:, 1:], index=index, columns=names[1:])
    frame.attrs["units"] = dict(zip(names[1:], units[1:], strict=True))
    return frame


def write_csv(run: Record, path: str | os.PathLike[str], overwrite: bool) -> None:
    """Write a run as CSV: names, with units where they are known, then a line for each sample."""
    check_writable(path, overwrite)
    names, units, values = columns(run)
    heads = [
        f"{name} [{unit}]" if unit != "1" and "-unit" not in unit else name
        for name, unit in zip(names, units, strict=True)
    ]
    with written_atomically(path, overwrite) as part, part.open("w", encoding="utf-8") as file:
        file.write(",".join(_cell(head) for head in heads) + "\n")
        for first in range(0, len(values), _BLOCK):
            rows = values[first : first + _BLOCK].tolist()
            file.write("".join(",".join(map(repr, row)) + "\n" for row in rows))


def _cell(text: str) -> str:
    quoted = text.replace('"', '""')
    return f'"{quoted}"' if set(text) & set(',"\n') else text
