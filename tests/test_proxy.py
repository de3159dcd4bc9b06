"""A compensator between a host and a drive: two wires, one tick after the other."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.realtime import CompensatedDrive, TwinDevice, wire

from .commands import Shown
from .rig_bench import TIME, Bench

DT = 0.01
DRIVE = ([12.0], [1.0, 12.0, 0.0])
"""A closed drive that takes commands of speed; y is the position."""
LIMITS = {"u_min": -3.0, "u_max": 3.0}
OBSERVER = ql.ESO.model_based(DRIVE, omega_o=40.0, dt=DT)


def loaded_drive() -> Any:
    """Return the drive with a constant load, by a disturbance of the plant's own."""

    def motion(t: float, x: Any, u: float, w: Any) -> tuple[float, float]:
        return x[1], 12.0 * (u - x[1]) - 6.0

    return ql.plants.NonlinearPlant(motion, order=2, disturbances=0, substeps=1)


@pytest.mark.parametrize("with_proxy", [True, False])
def test_the_host_sees_a_drive_that_the_load_does_not_move(with_proxy: bool) -> None:
    """A host with a P controller holds a loaded drive; without the proxy it is off by load/gain."""
    with ExitStack() as stack:
        drive = Bench(stack, plant=loaded_drive())
        outer = drive
        if with_proxy:
            proxy = CompensatedDrive(drive.open(), ql.Compensator(OBSERVER, **LIMITS))
            outer = Bench(stack, plant=proxy)
        host = outer.open(meanwhile=drive.rig.tick if with_proxy else lambda: None)
        y = 0.0
        for _ in range(600):
            host.write(2.0 * (1.0 - y))
            outer.rig.tick()
            if with_proxy:
                drive.rig.tick()
            y = host.read()
        if with_proxy:
            assert 1.0 - y == pytest.approx(0.0, abs=2e-3)
            assert proxy.estimate.f == pytest.approx(-6.0, abs=0.05)
            proxy.close()
            drive.rig.tick()
            assert drive.rig.state == "idle"
        else:
            assert 1.0 - y == pytest.approx(6.0 / 12.0 / 2.0, abs=0.01)


def test_a_host_that_stops_leaves_the_drive_where_it_is() -> None:
    """After the watchdog's ticks u_0 is zero: the speed that is commanded is what holds the load."""
    device = TwinDevice(loaded_drive(), DT)
    with ExitStack() as stack:
        proxy = CompensatedDrive(device, ql.Compensator(OBSERVER, **LIMITS))
        outer = Bench(stack, plant=proxy, watchdog=5)
        host = outer.open()
        outer.cycle(host, lambda y: 0.3, count=300)
        outer.rig.tick(200)
        assert outer.rig.state == "tripped"
        before = device.read()
        outer.rig.tick(200)
        assert device.read() == pytest.approx(before, abs=1e-3)
        assert proxy.estimate.u == pytest.approx(0.5, abs=1e-3)


B0 = [[2.0, 0.5], [0.4, 3.0]]


ARM = ql.plants.MultivariableLinearPlant(
    [[0, 1, 0, 0, 0], [0, -4, 0, 0, -1], [0, 0, 0, 1, 0], [0, 0, 0, -5, 0], [0] * 5],
    [[0, 0], B0[0], [0, 0], B0[1], [0, 0]],
    [[1, 0, 0, 0, 0], [0, 0, 1, 0, 0]],
)
"""Two coupled drives that take commands of speed; the last state is a load on the first axis."""
LOADED = [0.0, 0.0, 0.0, 0.0, 1.0]


def compensators(**limits: Any) -> ql.Axes:
    """Return compensators of two axes for commands of a host."""
    both = [
        ql.Compensator(ql.ESO.model_based(([1.0], [1.0, pole, 0.0]), omega_o=40.0, dt=DT))
        for pole in (4.0, 5.0)
    ]
    return ql.Axes(dict(zip("xy", both, strict=True)), B0, **(LIMITS | limits))


def test_drives_of_several_axes_get_the_u_of_their_compensators() -> None:
    """In each tick that of ``Axes.step`` with the u_0 and the y of this tick, bit by bit."""
    axes, beside = compensators(), TwinDevice(ARM, DT, x0=LOADED)
    with ExitStack() as stack:
        device = TwinDevice(ARM, DT, x0=LOADED)
        proxy = CompensatedDrive(device, compensators())
        outer = Bench(stack, plant=proxy)
        host = outer.open(signals=(2, 2))
        for _ in range(outer.rig.counters["ticks"]):
            beside.write(axes.step([0.0, 0.0], beside.read()))
        for k in range(200):
            u_0 = np.array([0.5, -0.3]) * np.sin(0.05 * k)
            host.write(u_0)
            outer.rig.tick()
            y = beside.read()
            assert host.read().tolist() == y.tolist()
            beside.write(axes.step(u_0, y))
            np.testing.assert_array_equal(device.x, beside.x)
        assert proxy.estimate["x"].f == axes.estimates["x"].f
        assert abs(proxy.estimate["x"].f + 1.0) < 0.1


def test_a_host_holds_two_drives_against_a_load_over_two_wires() -> None:
    """It has P controllers; without the compensators the first axis is off by load and gain."""
    off = []
    for with_proxy in (True, False):
        with ExitStack() as stack:
            drive = Bench(stack, plant=ARM, x0=LOADED)
            outer = drive
            if with_proxy:
                proxy = CompensatedDrive(drive.open(signals=(2, 2)), compensators())
                outer = Bench(stack, plant=proxy)
            meanwhile = drive.rig.tick if with_proxy else lambda: None
            host = outer.open(meanwhile=meanwhile, signals=(2, 2))
            y = np.zeros(2)
            for _ in range(800):
                host.write(np.linalg.solve(B0, 6.0 * (np.array([1.0, -0.5]) - y)))
                outer.rig.tick()
                if with_proxy:
                    drive.rig.tick()
                y = host.read()
            off.append(np.abs(np.array([1.0, -0.5]) - y))
            if with_proxy:
                proxy.close()
                drive.rig.tick()
                assert drive.rig.state == "idle"
    assert np.all(off[0] < 2e-3)
    assert off[1][0] == pytest.approx(1.0 / 6.0, rel=0.01)


def test_one_missing_measurement_is_missing_for_its_axis() -> None:
    """Its observer goes on by its model, and the host gets the last one; the other is measured."""
    with ExitStack() as stack:
        drive = Bench(stack, plant=ARM, x0=[0.2, 0.0, 0.1, 0.0, 0.0])
        proxy = CompensatedDrive(drive.open(signals=(2, 2)), compensators())
        outer = Bench(stack, plant=proxy)
        host = outer.open(meanwhile=drive.rig.tick, signals=(2, 2))
        drive.rig.tick()
        outer.rig.tick()
        model = drive.rig.model
        values = np.array([np.nan, 0.15])
        wire.write_next_numbers(model.outbox, model.endpoint, wire.MEASUREMENT, TIME, values, 0)
        wire.send(model.transport, model.outbox)
        outer.rig.tick()
        assert host.read().tolist() == [0.2, 0.15]
        assert ql.Status.MEASUREMENT_HELD in proxy.estimate["x"].status
        assert ql.Status.MEASUREMENT_HELD not in proxy.estimate["y"].status


def test_what_does_not_fit_is_refused() -> None:
    """Another controller, no limits, another sample time, a device in Python, other signals."""
    twin, compensator = TwinDevice(loaded_drive(), DT), ql.Compensator(OBSERVER, **LIMITS)

    class InPython:
        """A device of a user's own."""

        def read(self) -> float:
            """Return y."""
            return 0.0

        def write(self, u: float) -> None:
            """Apply u."""

        def close(self) -> None:
            """Do nothing."""

    with pytest.raises(ValueError, match="the host has the controller"):
        CompensatedDrive(twin, ql.ADRC(OBSERVER, 3.0, **LIMITS))
    with pytest.raises(ValueError, match="give it u_min and u_max"):
        CompensatedDrive(twin, ql.Compensator(OBSERVER))
    with pytest.raises(ValueError, match="must be the same"):
        CompensatedDrive(TwinDevice(loaded_drive(), 0.02), compensator)
    with pytest.raises(ValueError, match="compiled code can use"):
        CompensatedDrive(InPython(), compensator)
    assert np.isfinite(CompensatedDrive(twin, compensator).estimate.u)
    arm = TwinDevice(ARM, DT)
    with pytest.raises(ValueError, match="TwinDevice: has 2 measurements .* the controller one"):
        CompensatedDrive(arm, compensator)
    with pytest.raises(ValueError, match="has one measurement .* the controller 2 measurements"):
        CompensatedDrive(twin, compensators())
    with pytest.raises(ValueError, match="give it u_min and u_max"):
        CompensatedDrive(arm, compensators(u_min=-np.inf))
    drives = [ql.baselines.PID(kp=1.0, dt=DT)] * 2
    own = ql.Axes(compensators().axes, B0, drives=drives, **LIMITS)
    with pytest.raises(ValueError, match="= Axes: must be .*without drives; the host has"):
        CompensatedDrive(arm, own)


PROXY_OF_AXES = """
dt = 0.02
plant = { kind = "multivariable-linear", A = [[0, 1, 0, 0], [0, -4, 0, 0], [0, 0, 0, 1], [0, 0, 0, -5]], B = [[0, 0], [2, 0.5], [0, 0], [0.4, 3]], C = [[1, 0, 0, 0], [0, 0, 1, 0]] }
axes = { B0 = "plant", u_max = 3.0, u_min = -3.0 }
rig = { device = "twin:" }
[[axis]]
name = "x"
observer = { kind = "model-free", order = 2, omega_o = 15.0 }
compensator = {}
[[axis]]
name = "y"
observer = { kind = "model-free", order = 2, omega_o = 15.0 }
compensator = {}
"""


def test_the_command_takes_a_setup_of_several_axes(quell: Callable[..., Shown]) -> None:
    """It says how many signals there are, and what each axis estimates at the end."""
    Path("axes.toml").write_text(PROXY_OF_AXES, encoding="utf-8")
    arguments = ("--host", "udp://127.0.0.1:0", "--seconds", "0.2", "--priority", "0")
    shown = quell("proxy", "axes.toml", *arguments, "--log", "log.csv")
    assert shown.code == 0, shown.err
    assert "2 measurements and 2 control signals" in shown.out
    assert "last tick: x: v = 0, f = 0" in shown.out
    assert "last tick: y: v = 0, f = 0" in shown.out
    first = Path("log.csv").read_text(encoding="utf-8").splitlines()[0]
    assert first.endswith("y[0],y[1],u[0],u[1],command[0],command[1]")
    text = PROXY_OF_AXES.replace("compensator = {}", "controller = { omega_c = 2.0 }")
    Path("adrc.toml").write_text(text, encoding="utf-8")
    shown = quell("proxy", "adrc.toml", *arguments)
    assert (shown.code, "the host has the controller" in shown.err) == (2, True)
