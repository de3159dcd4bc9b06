"""Numbers that a device of several axes gives beside y: what is held, and others."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.realtime import CsvSink, Safety, TwinDevice, load, replay, run_rig
from quell.realtime.channels import checked_channels
from quell.realtime.recordings import Event
from quell.setup import made

from .cases import cases
from .commands import Shown
from .rig_bench import PlainRig
from .scripted import PLANT as ONE
from .scripted import adrc, run
from .scripted_axes import DT, PLANT, THREE, Outcome, axis, gantry
from .test_rig_axes import slow_gantry
from .test_rig_compensators import compensated

SAMPLES = 260
NAMES = ("load", "x.held", "y.wear")


def rows(*columns: Any) -> Any:
    """Return channels of each sample."""
    return np.column_stack([np.broadcast_to(each, (SAMPLES,)) for each in columns])


def held_until(k: int, *missing: int) -> Any:
    """Return what says that an axis is held before sample k, with samples that are missing."""
    says = np.where(np.arange(SAMPLES) < k, 1.0, 0.0)
    says[list(missing)] = math.nan
    return says


def flags(found: Outcome, name: str) -> list[bool]:
    """Return in which samples an axis counts as held."""
    return ((found.run[f"{name}.status"].astype(int) & ql.Status.HELD) != 0).tolist()


def ran(channels: Any, names: tuple[str, ...], controller: Any = None, **options: Any) -> Outcome:
    """Return a loop around a twin with these channels."""
    return Outcome(TwinDevice(PLANT, DT, channels=channels), controller, names=names, **options)


def test_an_axis_is_held_by_its_own_channel() -> None:
    """The others are free; what is missing keeps its state for ``hold`` samples, here four."""
    found = ran(rows(7.0, held_until(60, *range(40, 52)), 0.3), NAMES)
    assert flags(found, "x")[:80] == [True] * 44 + [False] * 8 + [True] * 8 + [False] * 20
    assert not any(flags(found, "y"))
    missing = (found.run["events"].astype(int) & Event.CHANNEL) != 0
    assert np.flatnonzero(missing).tolist() == [*range(40, 52)]
    assert set(found.run["load"].tolist()) == {7.0}
    assert set(found.run["y.wear"].tolist()) == {0.3}


def test_one_channel_holds_all_axes() -> None:
    """Together with that of one: an axis is held if either says so."""
    found = ran(rows(held_until(30), held_until(60)), ("held", "y.held"))
    assert flags(found, "x")[:80] == [True] * 30 + [False] * 50
    assert flags(found, "y")[:80] == [True] * 60 + [False] * 20


def test_one_axis_is_held_as_a_controller_of_one_signal_is() -> None:
    """The same u in each sample, with measurements of the same plant."""
    says = held_until(60, 45, 46, 47, 48, 49, 50, 51)
    single = run(
        TwinDevice(ONE, DT, channels=rows(says)), adrc(), 1.0, 2.0, channels=("held",), hold=4
    )
    axes = ql.Axes({"x": axis()}, [[1.5]], u_min=-3.0, u_max=3.0)
    several = Scripted(TwinDevice(ONE, DT, channels=rows(says)))
    found = Outcome(several, axes, (1.0,), duration=2.0, names=("x.held",))
    count = min(len(single.rows), len(found.rows))
    np.testing.assert_allclose(found.run["u"][:count], single["U"][:count], atol=1e-12)


class Scripted:
    """A twin of one y that gives lists, with its channels."""

    signal_counts = (1, 1)

    def __init__(self, twin: TwinDevice) -> None:
        self.twin = twin

    def read(self) -> list[float]:
        """Measure."""
        return [self.twin.read()]

    def read_channels(self) -> list[float]:
        """Return the channels."""
        return self.twin.read_channels()

    def write(self, u: Any) -> None:
        """Apply."""
        self.twin.write(float(u[0]))

    def close(self) -> None:
        """Do nothing."""


@pytest.mark.trial
@pytest.mark.parametrize(("make", "most"), [(gantry, 1e-12), (compensated, 0.2)])
def test_after_a_brake_an_axis_moves_as_after_a_start(make: Any, most: float) -> None:
    """Neither observer nor drive winds up under a channel; without one they do.

    The filter of a drive has followed the step of the reference meanwhile.
    """
    free = Outcome(None, make(), (1.0, 0.0), duration=6.0).run["y"][10:410]
    told, untold = (
        Outcome(Braked(), make(), (1.0, 0.0), duration=8.0, names=names).run["y"][300:700]
        for names in (("x.held",), ())
    )
    apart = [np.max(np.abs(each - free)) for each in (told, untold)]
    assert apart[0] < most
    assert apart[1] > 0.35


class Braked:
    """A twin whose first axis is held by a brake for 3 s, and says so."""

    signal_counts = (2, 2)

    def __init__(self) -> None:
        self.twin, self.count = TwinDevice(PLANT, DT), 0

    @property
    def held(self) -> bool:
        """Whether the brake is closed."""
        return self.count < 300

    def read(self) -> Any:
        """Measure."""
        return self.twin.read()

    def read_channels(self) -> list[float]:
        """Return whether the brake was closed until now."""
        return [float(self.count <= 300)]

    def write(self, u: Any) -> None:
        """Apply; a closed brake keeps the axis where it is."""
        self.twin.write(u)
        if self.held:
            self.twin._handle.x[:2] = 0.0
        self.count += 1

    def close(self) -> None:
        """Do nothing."""


def test_a_replay_uses_the_channels_of_a_recording(tmp_path: Path) -> None:
    """Bit by bit; each axis has its own and those of the machine in its record."""
    found = ran(rows(7.0, held_until(60, 45), 0.3), NAMES)
    sink = CsvSink(tmp_path / "run.csv")
    sink.open(found.header)
    sink.write(found.rows)
    sink.close()
    record = load(tmp_path / "run.csv")
    back = replay(record, gantry(), channels=NAMES)
    for name in ("x.x_hat", "y.x_hat", "x.status"):
        np.testing.assert_array_equal(back[name][:200], found.run[name][:200], err_msg=name)
    x, y = record.axis("x"), record.axis("y")
    assert x["load"][0] == y["load"][0] == 7.0
    np.testing.assert_array_equal(x["held"], record["x.held"])
    assert "held" not in y.names
    assert set(y["wear"].tolist()) == {0.3}
    with pytest.raises(ValueError, match=r"the run has no y\.held"):
        replay(record, gantry(), channels=["y.held"])


@cases(
    ("names", "message"),
    [
        (("z.held",), "'z.held' must be small .*it may be an axis and a dot, x.held"),
        (("x.",), "'x.' must be small letters"),
        (("x.Held",), "'x.Held' must be small letters"),
        (("x.y",), "'x.y' is the name of another column"),
        (("x.x_hat",), "'x.x_hat' is the name of another column"),
        (("v",), "'v' is the name of another column"),
        (("held", "held"), "'held' is the name of another column"),
        ((3,), "3 must be small letters"),
    ],
)
def test_names_that_can_not_be_are_refused(names: Any, message: str) -> None:
    """Before the device is touched."""
    with pytest.raises(ValueError, match=message):
        checked_channels(gantry(), names)
    with pytest.raises(ValueError, match=message):
        run_rig(TwinDevice(PLANT, DT), gantry(), (0.0, 0.0), duration=0.1, channels=names)


def test_an_axis_that_does_not_know_its_rest_can_not_be_held() -> None:
    """The message names it; another axis may be held."""
    observer = ql.ESO.model_based(([1.0, 2.0], [1.0, 3.0, 2.0, 0.0]), omega_o=12.0, dt=DT)
    pair = {"x": axis(), "y": ql.ADRC(observer, omega_c=1.5)}
    controller = ql.Axes(pair, u_min=-3.0, u_max=3.0)
    assert checked_channels(controller, ["x.held"]) == ("x.held",)
    for name in ("held", "y.held"):
        with pytest.raises(ValueError, match=f"{name}' says nothing to axis y, a ADRC"):
            checked_channels(controller, [name])


# ---- Over a wire, in a run and in a file ----


@pytest.mark.parametrize("link", ["udp", "serial"])
def test_channels_come_with_the_measurements_over_a_wire(
    bench: Callable[..., Any], link: str
) -> None:
    """Of the same tick, beside three measurements; one that is not finite is missing."""
    found = bench(link, kind=PlainRig, plant=THREE, channels=(0.25, 7.0))
    device = found.open(signals=(3, 3))
    device.write([0.0] * 3)
    found.await_frame()
    for k in range(10):
        found.rig.channels[0] = float(k)
        found.cycle(device, lambda y: [0.0] * 3)
        assert device.read_channels()[:2] == [float(k), 7.0]
    found.rig.channels[0] = math.inf
    found.cycle(device, lambda y: [0.0] * 3)
    assert math.isnan(device.read_channels()[0])
    assert device.counters["malformed"] == device.counters["kind"] == 0


def test_a_run_takes_its_channels_and_waits_for_them() -> None:
    """The first values come before it begins; a note counts those that were missing."""
    patient = Safety(settle=5, hold=10_000, most_overruns=10_000, ramp=10)
    how: dict[str, Any] = {"safety": patient, "priority": 0, "duration": 0.3, "approach": 0.0}
    twin = TwinDevice(PLANT, DT, channels=rows(7.0, held_until(10, 20), 0.3))
    found = run_rig(twin, gantry(), (0.1, 0.0), channels=NAMES, **how)
    assert found.completed
    assert "channels: in 1 samples under control" in found.text()
    assert found.trajectory.axis("x")["load"][0] == 7.0
    with pytest.raises(ConnectionError, match=r"'x\.held' .number 1. has not come"):
        run_rig(TwinDevice(PLANT, DT), gantry(), 0.0, channels=NAMES, **how)


def test_a_setup_of_axes_names_its_channels(quell: Callable[..., Shown]) -> None:
    """In ``[rig]``; what the device does not give is one plain line."""
    text = slow_gantry(channels=["x.held"])
    Path("gantry.toml").write_text(text, encoding="utf-8")
    assert made("gantry.toml", tomllib.loads(text)).needed("rig")["channels"] == ("x.held",)
    shown = quell("run-rig", "gantry.toml", "--no-figures")
    assert shown.code == 2
    assert "the channel 'x.held' (number 0) has not come" in shown.err
    Path("gantry.toml").write_text(text.replace("x.held", "z.held"), encoding="utf-8")
    shown = quell("run-rig", "gantry.toml", "--no-figures")
    assert (shown.code, "rig.channels: 'z.held' must be small" in shown.err) == (2, True)
    assert "Traceback" not in shown.err
