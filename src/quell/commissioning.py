"""From a rig to a tuned controller: records, an experiment within limits, a verifying step.

The limits of an experiment at a rig.

Records from files: tables in text, recordings of ``quell run-rig``, and saved runs.

An experiment at a rig: from limits to a record that a model can be identified from.

All parts run in the loop of ``run_rig``, with its safe actions: beyond the limits of y, after
missed samples and on Ctrl-C, u is ramped to zero.

1. *Listen*: u is at the operating point, to see y at rest and its noise.
2. *Probe*: a step of u of part of its range, until y has moved by part of its room or the time is
   over. It shows the sign of the gain, the speed, and whether y settles or drifts.
3. *Excite*: where y settles, a PRBS of u around the operating point, as large as the limits of y
   allow. Where y drifts, a relay with a linear zone that keeps y within its limits, ``u = sat(k_p
   (r − y) − k_d y')``, with r a PRBS between two values of y: the switching excites the plant
   (Åström & Hägglund, *Automatica* 20, 1984), and the limits hold in spite of the drift.

A verifying step: the tuned loop at the rig beside its prediction from the identified model.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.base import Controller
from quell.controllers.baselines.pid import PID
from quell.controllers.linear import LinearController, LinearLaw
from quell.files import MAX_SIZE, nonfinite_to_none
from quell.identification import Measured, excitation
from quell.identification.record_file import in_common_units
from quell.identification.result import Identified, simulated_plant
from quell.identification.validation import nrmse
from quell.realtime.devices import Device, TwinDevice
from quell.realtime.recordings import Event, check_one, is_recording, load
from quell.realtime.run import RigRun, run_rig
from quell.realtime.safety import Safety
from quell.realtime.supervisor import Cause
from quell.records.gains import OneGain, gain_factor, one_gain, with_gain
from quell.records.plotting import given_axes, grid_of_axes, new_figure
from quell.records.trajectory import Trajectory
from quell.records.units import runs_in_common_units
from quell.signals import Signal, Step
from quell.simulation.scenario import Scenario
from quell.simulation.simulate import simulate
from quell.types import Matrix, Vector, warn

# ---- The limits of an experiment at a rig ----


@dataclass(frozen=True)
class Limits:
    """Limits of an experiment; beyond those of y, u is ramped to zero.

    Parameters
    ----------
    u_min, u_max
        limits of u, with zero, the safe u, between them [u-unit].
    y_min, y_max
        limits of y [y-unit].
    duration
        time of the whole experiment under control, without the waiting before each part [s].
    u_rest
        u at the operating point, within its limits [u-unit].

    Raises
    ------
    ValueError
        for numbers out of range.
    """

    u_min: float
    u_max: float
    y_min: float
    y_max: float
    duration: float
    u_rest: float = 0.0

    def __post_init__(self) -> None:
        for low, high in (("u_min", "u_max"), ("y_min", "y_max")):
            values = checks.interval(low, getattr(self, low), high, getattr(self, high))
            if not all(map(math.isfinite, values)):
                raise ValueError(f"{low}, {high} = {values}: must be finite for an experiment")
        if not self.u_min <= 0.0 <= self.u_max:
            raise ValueError(
                f"u_min = {self.u_min!r}, u_max = {self.u_max!r}: must have zero, the safe u, "
                "between them"
            )
        checks.positive("duration", self.duration, "s")
        if not self.u_min < checks.finite("u_rest", self.u_rest) < self.u_max:
            raise ValueError(f"u_rest = {self.u_rest!r}: must be between u_min and u_max")

    @property
    def of_u(self) -> dict[str, Any]:
        """``u_min`` and ``u_max``, as arguments of controllers and of ``Safety``."""
        return {"u_min": self.u_min, "u_max": self.u_max}

    @property
    def u_room(self) -> float:
        """Amplitude of u around the operating point that both limits leave [u-unit]."""
        return min(self.u_max - self.u_rest, self.u_rest - self.u_min) or max(
            self.u_max - self.u_rest, self.u_rest - self.u_min
        )

    def y_room(self, y: float) -> float:
        """Return the distance of ``y`` to its nearer limit [y-unit], negative outside."""
        return min(self.y_max - y, y - self.y_min)

    def __str__(self) -> str:
        """Return the limits as text."""
        return (
            f"u from {self.u_min:g} to {self.u_max:g}, y from {self.y_min:g} to {self.y_max:g}, "
            f"{self.duration:g} s"
        )


# ---- Records from files ----

# Sample times of records that are one experiment's may differ by this share: by a clock's drift and
# the rounding of times. Over 1000 samples that is one sample. Chosen by hand.
_SAME = 1e-3


def is_record(path: Path) -> bool:
    """Return whether a file is a record by its name: any that is no setup, in .toml."""
    return path.suffix.lower() != ".toml"


def measured(
    path: Path,
    columns: str = "",
    dt: float | None = None,
    time_unit: str | None = None,
    max_size: float = MAX_SIZE,
    *,
    reference: bool = False,
) -> Measured:
    """Read input and output from a file of any kind that quell knows.

    A NetCDF file is a run that ``Trajectory.save`` wrote; a MCAP file, or a CSV file with the
    first line of a recording or its header beside it, is a recording of ``quell run-rig``; another
    file is a table in text, for which ``columns``, ``dt`` and ``time_unit`` are those of
    ``read_record``; with ``reference`` a column r belongs to the usual ones.

    Raises
    ------
    ValueError
        as ``read_record``; and if the file is a setup.
    """
    from quell.identification import read_record

    run = recorded_run(path, columns, dt, time_unit, max_size)
    if run is not None:
        return measured_run(run)
    default = (*(() if dt is not None else ("t",)), "u", "y", *(("r",) if reference else ()))
    names = tuple(name.strip() for name in columns.split(",")) if columns else default
    return read_record(path, names, dt, time_unit=time_unit, max_size=max_size)


class MeasuredAxes(NamedTuple):
    """An evenly sampled record with several u and y."""

    u: Matrix  #: (N, m)
    y: Matrix  #: (N, n)
    dt: float  #: [s]
    axes: tuple[str, ...]  #: names of the y
    actuators: tuple[str, ...]  #: names of the u


def measured_axes(
    path: Path,
    axes: Sequence[str] | None = None,
    actuators: Sequence[str] | None = None,
    columns: str = "",
    dt: float | None = None,
    time_unit: str | None = None,
    max_size: float = MAX_SIZE,
) -> MeasuredAxes:
    """Read the inputs and outputs of several axes from a table in text, or a run of them.

    A run is a file that ``Trajectory.save`` wrote, or a recording of ``quell run-rig``.

    Parameters
    ----------
    path
        the file.
    axes, actuators
        columns of the y and of the u of a table; names of the axes of a run, which has all u.
    columns
        column of its times; t by default. There is none with ``dt``.
    dt, time_unit, max_size
        as for ``measured``.

    Raises
    ------
    ValueError
        as ``measured``; and for a table without names of both.
    """
    given = actuators or columns or dt or time_unit
    if path.suffix.lower() == ".nc" or (not given and is_recording(path)):
        return _of_run(path, axes, given, max_size)
    for name, value in (("axes", axes), ("actuators", actuators)):
        if not value:
            signals = "y of each axis" if name == "axes" else "u of each actuator"
            raise ValueError(f"{name}: missing; give the column of the {signals}, by commas")
    if path.suffix.lower() == ".mcap":
        raise ValueError(
            f"{path.name} is no table in text; several axes are read from a table, or from a saved "
            "run of quell.Axes"
        )
    if "," in columns:
        rule = "must be the column of times only, as axes and actuators name the others"
        raise ValueError(f"columns = {columns!r}: {rule}")
    time = () if dt is not None else (columns or "t",)
    if dt is not None and columns:
        raise ValueError(f"columns = {columns!r}: there are no times, as dt is given; leave it out")
    us, ys = list(actuators or ()), list(axes or ())
    repeated = sorted({name for name in (*us, *ys) if (*us, *ys).count(name) > 1})
    if repeated:
        raise ValueError(f"axes, actuators: {', '.join(repeated)} is there twice; give each once")
    count = max(len(us), len(ys))
    pairs = [(us[min(i, len(us) - 1)], ys[min(i, len(ys) - 1)]) for i in range(count)]
    read = [measured(path, ",".join((*time, *pair)), dt, time_unit, max_size) for pair in pairs]
    u = np.column_stack([read[i].u for i in range(len(us))])
    y = np.column_stack([read[i].y for i in range(len(ys))])
    return MeasuredAxes(u, y, read[0].dt, tuple(ys), tuple(us))


def _of_run(path: Path, axes: Sequence[str] | None, given: Any, max_size: float) -> MeasuredAxes:
    """Return the signals of a saved run of several axes."""
    if given:
        raise ValueError(
            "actuators, columns, dt, time_unit: have no effect on a saved run, which has times and "
            "all u; give its axes only"
        )
    if path.suffix.lower() == ".nc":
        run = Trajectory.load(path, max_size)
    else:
        run = load(path, max_size)
        run = replace(run, log=np.ascontiguousarray(run.log[controlled(run)]))
    if not run.axis_names:
        raise ValueError(
            f"{path.name} has one y and one u: must be a run of several axes; leave --axes out"
        )
    wanted = run.axis_names if axes is None else tuple(axes)
    places = [run.axis_names.index(checks.one_of("axes", name, run.axis_names)) for name in wanted]
    u, y = run["u"].copy(), run["y_measured"][:, places].copy()
    return MeasuredAxes(
        u, y, run.every * run.dt, wanted, tuple(f"u{k + 1}" for k in range(u.shape[1]))
    )


def run_in(
    path: Path, columns: str, dt: float | None, time_unit: str | None, max_size: float
) -> Trajectory | None:
    """Return the run in a file that quell wrote; None for a table in text."""
    if columns or dt is not None or time_unit is not None:
        return None
    if path.suffix.lower() == ".nc":
        return Trajectory.load(path, max_size)
    return load(path, max_size) if is_recording(path) else None


def recorded_run(
    path: Path, columns: str, dt: float | None, time_unit: str | None, max_size: float
) -> Trajectory | None:
    """Return a run as ``run_in`` does; a ``ValueError`` refuses one of several axes."""
    run = run_in(path, columns, dt, time_unit, max_size)
    return None if run is None else check_one(run, f"path = {os.fspath(path)!r}")


def by_axis(run: Trajectory) -> dict[str, Trajectory]:
    """Return the run of each axis by its name, whose u is v, or the only one without a name."""
    return {name: run.axis(name) for name in run.axis_names} or {"": run}


def with_one_gain(runs: Mapping[str, Trajectory]) -> tuple[dict[str, Trajectory], OneGain]:
    """Return runs by name whose v, of several axes, can be compared, and how.

    Of runs of several axes only the samples under control are left, in the units of the first; a
    ``UserWarning`` says what was converted.

    Raises
    ------
    ValueError
        for runs with different numbers of actuators, units that do not convert, and as
        ``quell.records.gains.one_gain``.
    """
    several = {
        name: replace(run, log=np.ascontiguousarray(run.log[controlled(run)]))
        for name, run in runs.items()
        if run.several
    }
    counts = {name: run["u"].shape[1] for name, run in several.items()}
    if len(set(counts.values())) > 1:
        texts = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise ValueError(f"numbers of actuators: {texts}: must be those of one machine")
    if not several:
        return dict(runs), OneGain(None, True)
    if len({run.axis_names for run in several.values()}) == 1:
        several, notes = runs_in_common_units(several)
        for note in notes:
            warn(note, UserWarning)
    factors = {name: gain_factor(run) for name, run in several.items()}
    found = one_gain(factors, next(iter(counts.values())))
    if found.B is not None:
        several = {name: with_gain(run, found.B) for name, run in several.items()}
    return {**runs, **several}, found


def are_channels(
    paths: Sequence[Path], columns: str, dt: float | None, max_size: float = MAX_SIZE
) -> bool:
    """Return whether two files have a channel each, as an oscilloscope's, of one record."""
    from quell.identification.record_file import is_one_channel

    asked = columns or dt is not None
    return len(paths) == 2 and not asked and all(is_one_channel(path, max_size) for path in paths)


def measured_records(
    paths: Sequence[Path],
    columns: str = "",
    dt: float | None = None,
    time_unit: str | None = None,
    max_size: float = MAX_SIZE,
) -> list[Measured]:
    """Read several records of one plant, as ``measured`` does; all have the same sample time.

    Sample times that differ by rounding or drift are replaced by their mean, by samples. Units that
    differ are converted to those of the first record that has some, and a ``UserWarning`` says so.
    Two tables of times and one other column, without ``columns`` and ``dt``, are u and y of one
    record.

    Raises
    ------
    ValueError
        as ``measured``; and if there is no file, or two files have different sample times, or units
        that do not convert.
    """
    from quell.identification import read_record

    if not paths:
        raise ValueError("data: missing; give a file of a record")
    if are_channels(paths, columns, dt, max_size):
        return [read_record(paths, time_unit=time_unit, max_size=max_size)]
    each = [measured(path, columns, dt, time_unit, max_size) for path in paths]
    again = [list(paths[:i]).count(path) for i, path in enumerate(paths)]
    names = [f"{path} ({k + 1})" if k else f"{path}" for path, k in zip(paths, again, strict=True)]
    alike, notes = in_common_units(dict(zip(names, each, strict=True)))
    for note in notes:
        warn(note, UserWarning)
    records = [*alike.values()]
    first = records[0]
    for path, record in zip(paths, records, strict=True):
        if abs(record.dt - first.dt) > _SAME * first.dt:
            raise ValueError(
                f"data = {str(path)!r}: dt = {record.dt:g} s: must be that of {str(paths[0])!r}, "
                f"{first.dt:g} s; identify them one by one, or resample one of them"
            )
    if len({record.dt for record in records}) == 1:
        return records
    total = sum(record.y.size for record in records)
    mean = sum(record.dt * record.y.size for record in records) / total
    return [record._replace(dt=mean) for record in records]


def controlled(run: Trajectory) -> slice:
    """Return the samples in which the loop ran; all of a run without modes."""
    from quell.realtime.supervisor import Mode

    if "mode" in run.names and np.any(run["mode"] == Mode.RUN):
        running = np.flatnonzero(run["mode"] == Mode.RUN)
        return slice(int(running[0]), int(running[-1]) + 1)
    return slice(0, len(run))


def measured_run(run: Trajectory) -> Measured:
    """Return the samples of a run under control, with held measurements where one is missing."""
    u, r = run["u"], run["r"]
    y = np.where(np.isfinite(run["y_measured"]), run["y_measured"], run["y"])
    part = controlled(run)
    known = run.every * run.dt, r[part].copy(), run.signals
    return Measured(u[part].copy(), y[part].copy(), *known)


# ---- An experiment at a rig ----

# Shares of the duration for listening and probing, and least samples of listening. The probe's
# steps, of which the second is taken if y hardly follows the first, as parts of the room of u, and
# the part of y's room that they may use; the part that a PRBS may fill, which the probe only
# estimates; and the part of the room between the two references of the relay. Chosen by hand.
_LISTEN, _LEAST, _PROBE = 0.04, 20, 0.2
_PROBE_STEPS, _PROBE_ROOM, _FILL, _RELAY_ROOM = (0.05, 0.4), 0.3, 0.6, 0.5
# y settles if its mean speed in the last third of the probe is below this share of that of the
# whole probe: 0.2 for a time constant of a third of the probe. Chosen by hand.
_SETTLES = 0.4
# Band of the excitation relative to the speed that the probe has shown, and its top relative to
# π/dt at most. A PRBS needs some periods of its lowest frequency. Chosen by hand.
_BAND, _MOST_TOP, _PERIODS = (0.2, 10.0), 0.3, 6.0
# Relay: error that puts u to its limit, as a share of the room; lead and filter relative to the
# time in which the probe moved y. By trial on plants of order 1 to 3 (tests/test_commissioning.py).
_ZONE, _LEAD, _FILTER = 0.25, 0.9, 0.05
# y has moved if by more than so many times its noise, and this part of its room.
_MOVED, _VISIBLE = 6.0, 0.02

Open = Callable[[], Device]


@dataclass(frozen=True, eq=False)
class Experiment:
    """The record of an experiment."""

    kind: str  #: ``"prbs"`` or ``"relay"``
    measured: Measured  #: u, y, dt and None
    runs: tuple[RigRun, ...]  #: the parts: listening, probe, excitation
    y_rest: float  #: y at the operating point before the experiment [y-unit]
    noise: float  #: standard deviation of y there [y-unit]
    sign: float  #: sign of the gain from u to y

    def describe(self) -> str:
        """Return the parts and how each of them ended, as text."""
        names = ("listen", "probe", f"excite ({self.kind})")
        lines = [f"{name}: {run.verdict}" for name, run in zip(names, self.runs, strict=False)]
        return "\n".join([*lines, f"y at rest {self.y_rest:.4g}, its noise {self.noise:.2g} RMS"])


def experiment(
    open_device: Open,
    dt: float,
    limits: Limits,
    *,
    kind: str = "auto",
    seed: int = 0,
    **options: Any,
) -> Experiment:
    """Run an experiment at a rig within limits.

    Parameters
    ----------
    open_device
        called for each part; returns the device.
    dt
        sample time [s].
    limits
        of u, y and time, and the operating point.
    kind
        ``"prbs"``, ``"relay"``, or ``"auto"``: a relay if the plant drifts.
    seed
        of the PRBS.
    **options
        of ``run_rig``, and ``safety``, a dictionary of further arguments of ``Safety``.

    Raises
    ------
    ValueError
        for arguments out of range, y outside of its limits at rest, a y that u does not move, and
        an experiment that a fault or the user stopped, or a limit of y before it was half over.
    """
    dt = checks.positive("dt", dt, "s")
    checks.one_of("kind", kind, ("auto", "prbs", "relay"))
    rig = _Rig(open_device, dt, limits, dict(options.pop("safety", {})), options)
    u_rest = limits.u_rest
    listened = rig.held(Step(u_rest), max(_LISTEN * limits.duration, _LEAST * dt))
    rest = _settled_part(samples_of(listened, rig.has_no_clock)[1], _LEAST)
    y_rest, noise = float(np.mean(rest)), float(np.std(rest))
    room = limits.y_room(y_rest)
    if room <= 0.0:
        rule = "must be within y_min and y_max, with room on both sides"
        raise ValueError(f"y = {y_rest:.4g} at rest: {rule}")
    probed, shown = _probe(rig, y_rest, noise, room)
    relay = kind == "relay" or (kind == "auto" and shown.drifts)
    run = (_relay if relay else _prbs)(rig, shown, y_rest, room, seed)
    if not relay and kind == "auto" and not _is_long(run, limits):
        relay, run = True, _relay(rig, shown, y_rest, room, seed)
    if not _is_long(run, limits):
        raise ValueError(
            f"the experiment was stopped early: {run.verdict}; lower u_min and u_max, or widen the "
            "limits of y"
        )
    u, y = samples_of(run, rig.has_no_clock)
    name, runs = "relay" if relay else "prbs", (listened, probed, run)
    return Experiment(
        name, Measured(u, y, dt, None, run.record.signals), runs, y_rest, noise, shown.sign
    )


@dataclass(frozen=True)
class _Shown:
    """Results of the probe."""

    sign: float
    time: float  # in which y moved [s]
    change: float  # of y for a step of 1 in u, at the probe's end [y-unit/u-unit]
    drifts: bool


class _Rig:
    """A rig and what all parts of an experiment have in common."""

    def __init__(
        self,
        open_device: Open,
        dt: float,
        limits: Limits,
        safety: dict[str, Any],
        options: dict[str, Any],
    ) -> None:
        self.open, self.dt, self.limits = open_device, dt, limits
        self.safety, self.options = safety, {"approach": 0.0} | options
        self.has_no_clock = False  # whether the plant stands still while deadlines are skipped

    def run(
        self, controller: Any, reference: Signal, duration: float, y_min: float, y_max: float
    ) -> RigRun:
        """Run a part with limits of y."""
        own = self.limits.of_u | {"y_min": y_min, "y_max": y_max}
        safety = Safety(**(self.safety | own))
        options: dict[str, Any] = {"duration": duration, "safety": safety} | self.options
        device = self.open()
        self.has_no_clock = isinstance(device, TwinDevice)
        run = run_rig(device, controller, reference, **options)
        # Limits of y are part of the plan; a fault, or somebody who stops it, ends the experiment.
        if not run.completed and all(one.cause is not Cause.IMPLAUSIBLE for one in run.changes):
            raise ValueError(f"the experiment was stopped: {run.verdict}")
        return run

    def held(self, u: Signal, duration: float, room: tuple[float, float] | None = None) -> RigRun:
        """Apply u as it is, from the first sample on."""
        none = np.zeros(0)
        law = LinearLaw(np.zeros((0, 0)), none, none, none, none, 1.0, 0.0)  # u = r
        controller = LinearController(law, self.dt, name="excitation", **self.limits.of_u)
        low, high = room or (self.limits.y_min, self.limits.y_max)
        return self.run(controller, u, duration, low, high)


def samples_of(run: RigRun, has_no_clock: bool) -> tuple[Vector, Vector]:
    """Return u and the measured y of the scenario, the last good y where none came.

    Skipped deadlines are filled in, but for a twin, which stands still meanwhile.
    """
    part = run.trajectory
    if len(part) == 0:
        raise ValueError(f"the run did not begin: {run.verdict}")
    y = np.where(np.isfinite(part["y_measured"]), part["y_measured"], part["y"])
    gaps = part["events"].astype(np.int64) & int(Event.GAP)
    kept = gaps == 0 if has_no_clock else np.ones(y.size, dtype=bool)
    return part["u"][kept], y[kept]


def _settled_part(y: Vector, least: int) -> Vector:
    """Return the last half of the samples, ``least`` of them if there are."""
    return y[-max(y.size // 2, min(least, y.size)) :]


def _is_long(run: RigRun, limits: Limits) -> bool:
    return len(run.trajectory) * run.trajectory.dt > 0.35 * limits.duration


def _probe(rig: _Rig, y_rest: float, noise: float, room: float) -> tuple[RigRun, _Shown]:
    """Apply a step of u; return the run and what it shows."""
    limits, duration = rig.limits, _PROBE * rig.limits.duration / len(_PROBE_STEPS)
    near = (y_rest - _PROBE_ROOM * room, y_rest + _PROBE_ROOM * room)
    visible = max(_MOVED * noise, _VISIBLE * room)
    for step in limits.u_room * np.array(_PROBE_STEPS):
        run = rig.held(Step(step) + Step(limits.u_rest), duration, near)
        y = samples_of(run, rig.has_no_clock)[1] - y_rest
        change = float(np.mean(y[-3:]))
        if abs(change) > visible:
            break
    else:
        raise ValueError(
            f"y moved by {change:.3g} after a step of {step:.3g} in u; {visible:.2g} would be "
            "clear of its noise: u does not act, or its limits are too narrow"
        )
    third = y.size // 3
    late = float(y[-1] - y[-third - 1]) / max(third, 1)
    drifts = not run.completed or abs(late) > _SETTLES * abs(change) / y.size
    # The time of 63 % of the change of a lag; of a drift, the time in which it passed.
    beyond = np.flatnonzero(np.abs(y) >= 0.63 * abs(change))
    time = (y.size if drifts else int(beyond[0]) + 1) * rig.dt
    return run, _Shown(float(np.sign(change)), max(time, rig.dt), change / step, drifts)


def _band(rig: _Rig, time: float, duration: float) -> tuple[float, float]:
    """Return the band of the excitation [rad/s]."""
    top = min(_BAND[1] / time, _MOST_TOP * np.pi / rig.dt)
    low = max(_BAND[0] / time, _PERIODS * 2.0 * np.pi / duration)
    return min(low, 0.3 * top), top


def _rest_of(rig: _Rig) -> float:
    """Return the time that is left for the excitation [s]."""
    return (1.0 - _LISTEN - _PROBE) * rig.limits.duration


def _prbs(rig: _Rig, shown: _Shown, y_rest: float, room: float, seed: int) -> RigRun:
    """Excite u around the operating point."""
    limits, duration = rig.limits, _rest_of(rig)
    size = min(limits.u_room, _FILL * room / abs(shown.change))
    band = _band(rig, shown.time, duration)
    low, high = limits.u_rest - size, limits.u_rest + size
    low, high = max(low, limits.u_min), min(high, limits.u_max)
    design = excitation("prbs", band, duration, rig.dt, low, high, seed=seed)
    return rig.held(design.signal, duration)


def _relay(rig: _Rig, shown: _Shown, y_rest: float, room: float, seed: int) -> RigRun:
    """Excite the reference of a relay with a linear zone around the point of rest."""
    limits, duration = rig.limits, _rest_of(rig)
    kp = shown.sign * limits.u_room / (_ZONE * room)
    lead, filtered = _LEAD * shown.time, max(_FILTER * shown.time, 2.0 * rig.dt)
    gains: dict[str, Any] = {"kp": kp, "kd": kp * lead, "tf": filtered, "c": 0.0}
    controller = PID(**gains, dt=rig.dt, **limits.of_u)
    _, top = _band(rig, shown.time, duration)
    low = max(0.1 / shown.time, _PERIODS * 2.0 * np.pi / duration)
    # The loop itself switches fast; its reference moves at the speed of the probe.
    band = (min(low, 0.3 / shown.time), min(2.0 / shown.time, top))
    half = 0.5 * _RELAY_ROOM * room
    ends = (y_rest - half, y_rest + half)
    design = excitation("prbs", band, duration, rig.dt, *ends, seed=seed)
    return rig.run(controller, design.signal, duration, limits.y_min, limits.y_max)


# ---- A verifying step ----

# Share of the run before the step, in which the loop settles. Chosen by hand.
_BEFORE = 0.25
# The step, as a share of y's room, and of the y that u can hold at rest. Chosen by hand.
_STEP, _HELD = 0.4, 0.5


@dataclass(frozen=True, eq=False)
class Verification:
    """A step of the tuned loop, measured and predicted, relative to where y was before it."""

    run: RigRun  #: the measured run
    predicted: Trajectory  #: the simulated one
    height: float  #: of the step [y-unit]
    at: float  #: time of the step [s]
    y: Vector  #: measured y, from the value before the step on (N,)
    u: Vector  #: u, the same (N,)

    @property
    def fit(self) -> float:
        """Fit of the prediction to the measured y from the step on, NRMSE in %."""
        begin = round(self.at / self.predicted.dt)
        size = min(self.y.size, len(self.predicted))
        return nrmse(self.y[begin:size], self.predicted["y"][begin:size])

    def describe(self) -> str:
        """Return how the run ended, and both steps in numbers."""
        rows = [f"verifying step of {self.height:.4g}: {self.run.verdict}"]
        for name, record in (("measured", self.run.trajectory), ("predicted", self.predicted)):
            found = record.metrics(start=self.at)
            settling = found.get("settling_time", math.nan)
            overshoot = 100.0 * found.get("overshoot", math.nan)
            beyond = f"overshoot {overshoot:.1f} %" if overshoot < math.inf else "no rest there"
            settled = f"settling time {settling:.3g} s" if settling < math.inf else "not settled"
            rows.append(f"{name}: {beyond}, {settled}")
        return "\n".join([*rows, f"fit of the prediction {self.fit:.1f} %"])

    def to_json(self) -> dict[str, Any]:
        """Return numbers of both steps for JSON."""
        runs = {"measured": self.run.trajectory, "predicted": self.predicted}
        scores = {name: dict(record.metrics(start=self.at)) for name, record in runs.items()}
        about: dict[str, Any] = {"height": self.height, "at": self.at, "fit": self.fit}
        about |= {"completed": self.run.completed, "verdict": self.run.verdict}
        return dict(nonfinite_to_none(about | scores))

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw y and u, measured and predicted, into two axes; return them."""
        make = partial(new_figure, 8.0, 6.0)
        axes = grid_of_axes(given_axes(axes, ax), make, 2, sharex=True)[:, 0]
        t = np.arange(self.y.size) * self.predicted.dt
        reference = np.where(t >= self.at, self.height, 0.0)
        axes[0].plot(t, reference, color="0.6", linewidth=1.0, label="reference")
        signals = self.run.trajectory.signals
        for name, each, value, known in (
            ("y", axes[0], self.y, signals.y),
            ("u", axes[1], self.u, signals.u),
        ):
            each.plot(t, value, label="measured")
            each.plot(self.predicted.t, self.predicted[name], "--", label="predicted")
            each.set_ylabel(f"{known.label(name)}\nfrom its value before the step on")
            each.grid(alpha=0.3)
        axes[0].legend()
        axes[1].set_xlabel("time [s]")
        return axes


def verify(
    open_device: Open,
    controller: Controller,
    model: Identified,
    limits: Limits,
    y_start: float,
    duration: float,
    **options: Any,
) -> Verification:
    """Run a step of the tuned loop at the rig, and simulate the same with the model.

    The reference first stays at ``y_start``, then steps to the side with more room, by a part of
    that room or of what u can hold. The model is simulated without its constant force, relative to
    the state before the step.

    Parameters
    ----------
    open_device
        returns the device.
    controller
        the tuned controller.
    model
        the identified model.
    limits
        of u and y, and the operating point.
    y_start
        where y is [y-unit].
    duration
        of the run [s].
    **options
        of ``run_rig``, and ``safety``, a dictionary of further arguments of ``Safety``.

    Raises
    ------
    ValueError
        for a run that was stopped before the step.
    """
    dt, duration = controller.dt, checks.positive("duration", duration, "s")
    up = limits.y_max - y_start >= y_start - limits.y_min
    room = (limits.y_max - y_start) if up else (y_start - limits.y_min)
    if room <= 0.0:
        raise ValueError(f"y_start = {y_start!r}: must be between y_min and y_max")
    height = _STEP * room
    if model.integrators == 0:
        gain = abs(float(model.num[-1] / model.den[-1]))
        height = min(height, _HELD * gain * limits.u_room)
    height = height if up else -height
    at = round(_BEFORE * duration / dt) * dt
    safety: dict[str, Any] = {"y_min": limits.y_min, "y_max": limits.y_max}
    safety |= limits.of_u | dict(options.pop("safety", {}))
    reference = Step(y_start) + Step(height, at=at)
    given: dict[str, Any] = {"duration": duration, "safety": Safety(**safety), "approach": 0.5 * at}
    given |= options
    run = run_rig(open_device(), controller, reference, **given)
    part = run.trajectory
    before = round(at / dt)
    if len(part) <= before + 1:
        raise ValueError(f"the verifying step was not reached: {run.verdict}")
    scenario = Scenario(reference=Step(height, at=at), duration=(len(part) - 1) * dt)
    predicted = simulate(simulated_plant(model), controller, scenario)
    few = slice(max(before - max(before // 5, 1), 0), before)
    y, u = part["y"] - y_start, part["u"] - float(np.mean(part["u"][few]))
    return Verification(run, predicted, height, at, y, u)


__all__ = ["Experiment", "Limits", "Verification", "experiment", "verify"]
