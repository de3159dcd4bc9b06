"""The records of one run, and of a batch of runs, of several axes.

*One B for several runs.* The u of an axis is ``v = B0 u``, so v of runs with another B0 is in
another unit: half of B0 halves v of the same motors. What is compared between such runs, an effort
or a load, is that of ``B u`` with one matrix B for all of them, which depends on the actuators
only (``one_gain``). B0 of a run is that of the least squares ``min ‖V − U B0ᵀ‖`` over its samples.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from quell import checks
from quell.files import MAX_SIZE
from quell.quantities import UNKNOWN, AxesSignals, Signals
from quell.records.metrics import SETTLING_BAND, BatchMetrics, Metrics
from quell.records.netcdf import Stored, load_record
from quell.records.record import Record, columns_of
from quell.records.trajectory import BatchTrajectory, Trajectory
from quell.types import LOST, Channels, Matrix, Status, Vector

if TYPE_CHECKING:
    import xarray


# B0 is constant, and one for several runs, if v is B0 u to this share: far above rounding, also of
# single precision, and far below differences that matter. Runs whose B0 follows the state have one
# B0 as far as v shows if one matrix for all of them leaves no more of v than this beyond what one
# for each does. Directions of u count above this share of the largest. All chosen by hand.
_CONSTANT, _SAME, _MOVED = 1e-5, 0.05, 1e-6
# An entry of B0 that makes less than this share of v is zero: that of double precision is 1e-16.
_ROUNDING = 1e-12


class AxesRecord(Record):
    """What records of several axes have in common."""

    axis_names: tuple[str, ...]
    axis_features: tuple[tuple[str, ...], ...]

    def labels(self, name: str, width: int) -> list[str]:
        """Return the names of the entries of a channel; none if they have numbers."""
        axis, _, channel = name.rpartition(".")
        if channel == "theta" and axis in self.axis_names and self.axis_features:
            return list(self.axis_features[self.axis_names.index(axis)])
        if not self.axis_names:
            return []
        of_axes = AxesSignals(self.axis_names, (), ())
        known = self.signals if isinstance(self.signals, AxesSignals) else of_axes
        labels = known.labels(name, width)
        return [] if labels == [str(i) for i in range(width)] else labels

    def _part_of(self, which: int | str) -> tuple[int, list[int], Channels]:
        """Return the number of an axis, its columns and its channels."""
        if not self.axis_names:
            raise ValueError(
                "this record is of one loop with several signals, which has no axes: take columns "
                "of run['y'] and run['u']"
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
        return i, columns, tuple(channels)

    def _features_of(self, i: int) -> tuple[str, ...]:
        return self.axis_features[i] if self.axis_features else ()

    def _signals_of(self, i: int) -> Signals:
        """Return names and units of one axis: its u is v."""
        if not isinstance(self.signals, AxesSignals):
            return UNKNOWN
        return Signals(self.signals.y[i])

    def _names_as_text(self) -> dict[str, str]:
        """Return the names of axes and features as attributes of a file."""
        return {
            "axis_names": json.dumps(self.axis_names),
            "axis_features": json.dumps(self.axis_features),
        }


def _names_from(stored: Stored) -> dict[str, Any]:
    """Return the names of axes and features from the attributes of a file."""
    names = json.loads(stored.attributes["axis_names"])
    features = json.loads(stored.attributes["axis_features"])
    return {
        "axis_names": tuple(map(str, names)),
        "axis_features": tuple(tuple(map(str, each)) for each in features),
    }


@dataclass(frozen=True, eq=False)
class AxesTrajectory(AxesRecord):
    """The record of one run of several axes.

    ``run["y"]`` is a channel: (samples, p); r, y_measured, u, v, w and x likewise; ``run.t`` are
    the times [s]. v is what the axes were given, ``B0 u``. The estimates of an axis are channels
    like ``run["shoulder.x_hat"]``. ``run.axis("shoulder")`` is one axis as a ``Trajectory``, with
    all that such a record can do.

    ``status`` has all flags that any step reported, and ``DIVERGED`` if the run ended early;
    ``message`` explains them.
    """

    log: Matrix  #: all channels side by side (samples, columns)
    channels: Channels  #: name and width of the channels, in the order of the columns
    dt: float  #: sample time of the run [s]
    every: int = 1  #: every ``every``-th sample was recorded
    status: Status = Status.OK
    ended: float = 0.0  #: time at which the run ended [s]
    limit: float = math.inf  #: the ``|y|`` beyond which the run would have been ended [y-unit]
    plant: str = ""  #: name of the plant
    axis_names: tuple[str, ...] = ()
    axis_features: tuple[tuple[str, ...], ...] = ()  #: names of each axis' features
    final_state: Any = None
    signals: Any = UNKNOWN  #: names and units, ``quell.quantities.AxesSignals`` if they are known
    features: tuple[str, ...] = ()

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
        """All that the run reported, and what to do."""
        if not self.diverged:
            return self._explained(self.status)
        return (
            f"An output went beyond limit = {self.limit:.3g}, or was no number, at "
            f"{self.ended:.6g} s, and the run ended there. {self._explained(self.status)}"
        )

    def __len__(self) -> int:
        """Return the number of samples."""
        return int(self.log.shape[0])

    def axis(self, which: int | str) -> Trajectory:
        """Return one axis as a record of its own: its u is v_i [y-unit/s^n].

        What is of the whole machine, as channels of its device, is in the record of each axis.

        Parameters
        ----------
        which
            name or number, from 0.
        """
        i, columns, channels = self._part_of(which)
        return Trajectory(
            log=np.ascontiguousarray(self.log[:, columns]),
            channels=channels,
            dt=self.dt,
            every=self.every,
            status=self.status,
            ended=self.ended,
            limit=self.limit,
            plant=f"{self.plant}, {self.axis_names[i]}",
            signals=self._signals_of(i),
            features=self._features_of(i),
        )

    def metrics(
        self,
        start: float = 0.0,
        stop: float | None = None,
        *,
        band: float = SETTLING_BAND,
    ) -> dict[str, Metrics]:
        """Return the measures of each axis, by its name; see ``Trajectory.metrics``."""
        return {
            name: self.axis(i).metrics(start, stop, band=band)
            for i, name in enumerate(self.axis_names)
        }

    def with_gain(self, B: Any) -> AxesTrajectory:
        """Return the record with ``v = B u`` of another matrix B (axes, actuators)."""
        size = columns_of(self.channels, "v"), columns_of(self.channels, "u")
        n, m = (part.stop - part.start for part in size)
        gain = checks.matrix("B", B, n, m)
        log = self.log.copy()
        log[:, size[0]] = self.log[:, size[1]] @ gain.T
        return replace(self, log=log)

    def gain_factor(self) -> Matrix:
        """Return a triangle that has all of u and v that ``one_gain`` needs (rows, m + n)."""
        u, v = self["u"], self["v"]
        both = np.column_stack([u, v])
        both = both[np.all(np.isfinite(both), axis=1)]
        size = float(np.max(np.abs(both[:, : u.shape[1]]), initial=0.0))
        if size == 0.0:
            return np.zeros((0, both.shape[1]))
        both /= size
        both /= float(np.linalg.norm(both[:, : u.shape[1]]))
        factor: Any = np.linalg.qr(both, mode="r")
        return np.asarray(factor, dtype=np.float64)

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw outputs with references, errors and estimates of each axis, and the actuators.

        Parameters
        ----------
        axes, ax
            matplotlib axes, three for each axis of the machine and one more: rows of output, error
            and estimated f, then all control signals. For a loop without axes three: outputs,
            control signals, estimated disturbances. A new figure by default.

        Returns
        -------
        numpy.ndarray
            the matplotlib axes.
        """
        from quell.records.plotting import given_axes, plot_axes

        return plot_axes(self, given_axes(axes, ax))

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame`` with a row for each sample; needs the extra ``pandas``."""
        from quell.records.record import to_pandas

        return to_pandas(self)

    def to_csv(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write all channels as CSV, a line for each sample; see ``Trajectory.to_csv``."""
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
            **self._names_as_text(),
        }
        return self._dataset(("time",), attributes)

    @classmethod
    def load(cls, path: str | os.PathLike[str], max_size: float = MAX_SIZE) -> AxesTrajectory:
        """Return the record that ``save`` wrote, without ``final_state``; see ``Trajectory``."""

        def made(stored: Stored, found: dict[str, Any]) -> AxesTrajectory:
            known = {each.name for each in fields(cls)}
            return cls(
                **{name: value for name, value in found.items() if name in known},
                status=Status(int(stored.attributes["status"])),
                ended=float(stored.attributes["ended"]),
                limit=float(stored.attributes["limit"]),
                **_names_from(stored),
            )

        attributes = {"dt", "every", "status", "ended", "plant", "axis_names", "axis_features"}
        writer = "AxesTrajectory.save"
        return load_record(path, writer, ("time",), attributes, set(), max_size, made)


class OneGain(NamedTuple):
    """How v of several runs can be compared."""

    B: Matrix | None  #: for v = B u of all runs; None where v can be compared as it is
    constant: bool  #: whether B0 of each run is constant

    def describe(self) -> list[str]:
        """Return lines on the u of an axis: with which B it is, or what is not known of it."""
        if self.B is not None:
            rows = "], [".join(", ".join(f"{each:.4g}" for each in row) for row in self.B)
            return [f"u of an axis is B u with B = [[{rows}]] for all, as their B0 differ"]
        if not self.constant:
            return [
                "NOT protected against another B0: it follows the state here, so v = B0 u, the u "
                "of an axis, can be compared if all had one function for B0 or M; keep it"
            ]
        return []


def one_gain(factors: Mapping[str, Matrix], inputs: int) -> OneGain:
    """Return the one matrix B (axes, actuators) with which v of several runs can be compared.

    It is B0 of the first run in which all actuators that any of them uses have moved.

    Parameters
    ----------
    factors
        ``AxesTrajectory.gain_factor`` of each run, by a name for errors.
    inputs
        number of actuators m of all of them.

    Raises
    ------
    ValueError
        where v can't be compared: B0 differ, and follow the state, or no run shows its own in full.
    """
    rows = np.concatenate([*factors.values()])
    size = np.linalg.norm(rows, axis=0)
    size[size == 0.0] = 1.0
    own = {name: _fitted(factor / size, inputs) for name, factor in factors.items()}
    left = np.stack([each[1] for each in own.values()])  # (runs, n), shares of v
    of_each = np.sqrt(np.sum(left**2, axis=0))
    _, of_all, rank = _fitted(rows / size, inputs)
    constant = bool(np.all(of_each <= _CONSTANT))
    beyond = np.sqrt(np.maximum(of_all**2 - of_each**2, 0.0))
    if np.all(beyond <= (_CONSTANT if constant else _SAME)):
        return OneGain(None, constant)
    full = [name for name, each in own.items() if each[2] == rank]
    if not constant or not full:
        why = "follows the state" if not constant else "can't be seen in full in any of them"
        raise ValueError(
            f"B0 of {', '.join(factors)} is not one, and {why}: v = B0 u is in other units, and "
            "can't be compared; take runs with one B0"
        )
    theta = own[full[0]][0]
    theta[np.abs(theta) < _ROUNDING] = 0.0
    gain: Matrix = (theta * size[inputs:] / size[:inputs, None]).T
    return OneGain(gain, constant)


def _fitted(rows: Matrix, inputs: int) -> tuple[Matrix, Vector, int]:
    """Return B0ᵀ (m, n) by least squares, the rest of v (n,), and the rank of u."""
    u, v = rows[:, :inputs], rows[:, inputs:]
    solved: Any = np.linalg.lstsq(u, v, rcond=_MOVED)
    theta, rank = np.asarray(solved[0], dtype=np.float64), int(solved[2])
    left: Vector = np.linalg.norm(v - u @ theta, axis=0)
    return theta, left, rank


@dataclass(frozen=True, eq=False)
class AxesBatch(AxesRecord, BatchTrajectory):
    """The record of a batch of runs of several axes.

    ``runs["y"]`` is a channel: (runs, samples, p); r, u, v and w likewise. ``runs.run(i)`` is the
    i-th run as an ``AxesTrajectory``, ``runs.axis("elbow")`` one axis of all runs as a
    ``BatchTrajectory``, whose u is v. All else is that of ``BatchTrajectory``.
    """

    axis_names: tuple[str, ...] = ()
    axis_features: tuple[tuple[str, ...], ...] = ()  #: names of each axis' features
    stored_attributes: ClassVar[tuple[str, ...]] = ("axis_names", "axis_features")

    def run(self, i: int) -> AxesTrajectory:  # type: ignore[override]
        """Return the i-th run, to its end, with the channels that were recorded."""
        return AxesTrajectory(
            **self._of_run(i), axis_names=self.axis_names, axis_features=self.axis_features
        )

    def axis(self, which: int | str) -> BatchTrajectory:
        """Return one axis of all runs as a batch of its own: its u is v_i [y-unit/s^n].

        Parameters
        ----------
        which
            name or number, from 0. The channels r, y and v must be recorded.
        """
        i, columns, channels = self._part_of(which)
        return BatchTrajectory(
            log=np.ascontiguousarray(self.log[..., columns]),
            channels=channels,
            dt=self.dt,
            every=self.every,
            lengths=self.lengths,
            status=self.status,
            ended=self.ended,
            limit=self.limit,
            plant=f"{self.plant}, {self.axis_names[i]}",
            parameters=self.parameters,
            features=self._features_of(i),
            signals=self._signals_of(i),
        )

    def metrics(  # type: ignore[override]
        self,
        start: float = 0.0,
        stop: float | None = None,
        *,
        band: float = SETTLING_BAND,
    ) -> dict[str, BatchMetrics]:
        """Return the measures of each axis, by its name; see ``BatchTrajectory.metrics``."""
        return {
            name: self.axis(i).metrics(start, stop, band=band)
            for i, name in enumerate(self.axis_names)
        }

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw output and v of each axis: median, bands of the runs, and when others diverged.

        Parameters
        ----------
        axes, ax
            matplotlib axes, two rows with one for each axis of the machine; a new figure by
            default.
        """
        from quell.records.plotting import given_axes, plot_batch_of_axes

        return plot_batch_of_axes(self, given_axes(axes, ax))

    def _attributes(self) -> dict[str, Any]:
        return super()._attributes() | self._names_as_text()

    @classmethod
    def _read_attributes(cls, stored: Stored) -> dict[str, Any]:
        return _names_from(stored)
