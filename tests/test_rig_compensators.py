"""The real-time loop of axes that are compensators on top of drives."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.realtime import Safety, TwinDevice, load, replay
from quell.realtime.supervisor import Cause, Mode
from quell.records.trajectory import Trajectory

from .commands import Shown
from .scripted import PLANT as ONE
from .scripted import run
from .scripted_axes import B0, DT, FAST, PLANT, Outcome, Scripted
from .setups import GANTRY


def observer(b0: float = 1.0) -> ql.ESO:
    """Return the observer of an axis."""
    return ql.ESO.model_free(order=2, b0=b0, omega_o=12.0, dt=DT)


def drive(**options: Any) -> ql.baselines.PID:
    """Return a controller of u_0."""
    return ql.baselines.PID(**({"kp": 1.0, "ki": 0.2, "kd": 1.0, "tf": 0.1, "dt": DT} | options))


def compensated(*, learning: bool = False, **options: Any) -> ql.Axes:
    """Return compensators on top of drives for ``PLANT``."""
    learners: tuple[Any, ...] = (None, None)
    if learning:
        learners = ql.learners.Kalman(), ql.learners.Harmonic()
    guards = [None if learner is None else ql.Guard() for learner in learners]
    pair = [
        ql.Compensator(observer(), omega_c=1.5, learner=learner, guard=guard)
        for learner, guard in zip(learners, guards, strict=True)
    ]
    both = dict(zip(("x", "y"), pair, strict=True))
    drives = [drive(), drive(kp=0.7, ki=0.1, kd=0.6)]
    return ql.Axes(both, B0, drives=drives, **({"u_min": -3.0, "u_max": 3.0} | options))


def test_a_run_is_that_of_a_simulation() -> None:
    """From when the controllers take over, bit by bit: at rest nothing has happened before."""
    found = Outcome(controller=compensated())
    simulated = ql.simulate(PLANT, compensated(), ql.Scenario((1.0, -0.5), 2.0))
    ours = found.run.log[10 : 10 + len(simulated)]
    part = Trajectory(ours, found.run.channels, DT, axis_names=("x", "y"))
    for name in ("r", "y", "u", "v", "x.x_hat", "y.f_residual"):
        np.testing.assert_array_equal(part[name], simulated[name], err_msg=name)
    assert found.changes[0][1:3] == (Mode.RUN, Cause.SETTLED)
    assert found.changes[1][1:3] == (Mode.RAMP, Cause.COMPLETED)


@pytest.mark.trial
@pytest.mark.compiled
def test_a_compiled_loop_takes_the_same_steps() -> None:
    """As the one in Python, to rounding."""
    first = Outcome(controller=compensated(), duration=0.5)
    other = Outcome(controller=compensated(), duration=0.5, interpret=True)
    same = [name for name in first.run.names if name not in ("lateness", "step_time")]
    for name in same:
        np.testing.assert_allclose(
            first.run[name], other.run[name], rtol=1e-9, atol=1e-12, err_msg=name
        )


@pytest.mark.trial
def test_the_drives_are_told_what_limits_take() -> None:
    """Of the rules of safety, too: u stays at them, and no integrator winds up meanwhile."""
    limits = Safety(settle=10, ramp=10, u_max=[0.3, 0.2], u_min=[-0.3, -0.2])
    device = TwinDevice(PLANT, DT, x0=[-1.0, 0.0, 0.6, 0.0])
    found = Outcome(device, compensated(), (1.0, 0.0), duration=20.0, safety=limits)
    assert found.loop.controller.supervisor.counters[0].clipped > 50
    assert np.max(np.abs(found.run["u"]), axis=0).tolist() == [0.3, 0.2]
    assert np.all(np.abs(found.run["y"][-30] - [1.0, 0.0]) < 0.1)
    # With the limits in the controller the drives are told by it: the same u, to rounding.
    own = compensated(u_max=[0.3, 0.2], u_min=[-0.3, -0.2])
    device = TwinDevice(PLANT, DT, x0=[-1.0, 0.0, 0.6, 0.0])
    inside = Outcome(device, own, (1.0, 0.0), duration=20.0, safety=FAST)
    np.testing.assert_allclose(found.run["u"], inside.run["u"], atol=1e-9)


@pytest.mark.trial
def test_a_replay_gives_the_estimates_again() -> None:
    """Bit by bit, of learning axes, where a measurement was missing and u was held."""
    missing = {60: (0.0, math.nan), 61: (math.nan, 0.0), 100: (math.nan, math.nan)}
    found = Outcome(Scripted(missing), compensated(learning=True))
    assert Cause.MISSED in [change[2] for change in found.changes]
    back = replay(found.run, compensated(learning=True))
    stop = int(np.argmax(found.run["mode"] == Mode.STOPPED))
    for name, _ in compensated(learning=True).channels:
        np.testing.assert_array_equal(back[name][:stop], found.run[name][:stop], err_msg=name)


class One:
    """A twin of one y in Python, which may give it as a list, with measurements that are missing."""

    def __init__(self, missing: tuple[int, ...], *, listed: bool) -> None:
        self.twin, self.missing, self.count = TwinDevice(ONE, DT), missing, -1
        self.written: list[float] = []
        if listed:
            self.signal_counts = (1, 1)

    def read(self) -> Any:
        """Measure."""
        self.count += 1
        y = math.nan if self.count in self.missing else self.twin.read()
        return [y] if hasattr(self, "signal_counts") else y

    def write(self, u: Any) -> None:
        """Apply."""
        self.written.append(float(np.ravel(u)[0]))
        self.twin.write(self.written[-1])

    def close(self) -> None:
        """Do nothing."""


@pytest.mark.parametrize("missing", [(), (60,), (60, 61, 62, 100)])
def test_one_axis_is_a_compensated_controller(missing: tuple[int, ...]) -> None:
    """Where a measurement is missing, too: the drive gets the one that the observer expects."""
    limits: dict[str, Any] = {"u_min": -1.5, "u_max": 1.5}
    pid = drive(kp=2.0, ki=0.6)
    single = One(missing, listed=False)
    compensator = ql.Compensator(observer(1.5), **limits)
    run(single, ql.Compensated(pid, compensator), 1.0, 2.0, hold=4, ramp=10)
    axes = ql.Axes({"x": ql.Compensator(observer())}, [[1.5]], drives=[pid], **limits)
    several = One(missing, listed=True)
    Outcome(several, axes, (1.0,), duration=2.0)
    assert len(single.written) == len(several.written)
    assert max(single.written) == 1.5
    np.testing.assert_allclose(several.written, single.written, atol=1e-12)


def test_a_setup_with_drives_runs_replays_and_gives_b0(quell: Callable[..., Shown]) -> None:
    """``quell run-rig`` and what reads its record, over the twin of the file."""
    text = GANTRY.replace("dt = 1e-3", "dt = 0.02").replace("omega_o = 60.0", "omega_o = 15.0")
    text = text.replace("sample_time = 1e-3", "sample_time = 0.02")
    on_top = "compensator = { omega_c = 2.0 }\ndrive = { kp = 2.0, ki = 0.2, kd = 1.0, tf = 0.1 }"
    text = text.replace("controller = { omega_c = 8.0 }", on_top)
    text += '\n[rig]\ndevice = "twin:"\npriority = 0\n[rig.safety]\nhold_time = 1.0\n'
    text += "overrun_time = 10.0\nsettle_time = 0.1\ny_min = -5.0\ny_max = 5.0\n"
    Path("drives.toml").write_text(text, encoding="utf-8")
    shown = quell("run-rig", "drives.toml", "--csv", "run.csv", "--no-figures")
    assert shown.code == 0, shown.err + shown.out
    assert "first motion not checked" in shown.out
    assert load("run.csv").axis_names == ("x", "y")
    shown = quell("replay", "run.csv", "drives.toml", "--no-figures")
    assert shown.code == 0, shown.err
    assert "run.csv through drives: y" in shown.out
