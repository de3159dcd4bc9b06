"""An experiment at a rig: from limits to a record that a model can be identified from.

All parts run in the loop of ``run_rig``, with its safe actions: beyond the limits of y, after
missed samples and on Ctrl-C, u is ramped to zero.

1. *Listen*: u is at the operating point, to see y at rest and its noise.
2. *Probe*: a step of u of part of its range, until y has moved by part of its room or the time is
   over. It shows the sign of the gain, the speed, and whether y settles or drifts.
3. *Excite*: where y settles, a PRBS of u around the operating point, as large as the limits of y
   allow. Where y drifts, a relay with a linear zone that keeps y within its limits, ``u = sat(k_p
   (r − y) − k_d y')``, with r a PRBS between two values of y: the switching excites the plant
   (Åström & Hägglund, *Automatica* 20, 1984), and the limits hold in spite of the drift.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from quell import checks
from quell.commissioning.limits import Limits
from quell.controllers.baselines.pid import PID
from quell.controllers.linear.law import LinearLaw
from quell.controllers.linear.linear import LinearController
from quell.identification import Measured, excitation
from quell.realtime.devices.base import Device
from quell.realtime.devices.twin import TwinDevice
from quell.realtime.loop.modes import Cause
from quell.realtime.loop.result import RigRun
from quell.realtime.loop.run import run_rig
from quell.realtime.loop.safety import Safety
from quell.realtime.telemetry.channels import Event
from quell.signals import Signal, Step
from quell.types import Vector

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
