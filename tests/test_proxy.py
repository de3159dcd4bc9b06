"""A compensator between a host and a drive: two wires, one tick after the other."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from threading import Event, Thread
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import quell as ql
from quell.realtime import CompensatedDrive, TwinDevice, wire
from quell.realtime.devices import read_channels, read_measurement, write_command
from quell.realtime.rig import Rig
from quell.types import Vector

from .commands import Shown
from .rig_bench import TIME, Bench, PlainRig

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


class ScriptedHandle(NamedTuple):
    """A drive that gives the next y of a list in each tick, and takes commands or does not."""

    y: Vector
    place: NDArray[np.int64]
    fault: int


@read_measurement.register(ScriptedHandle)
def _read_scripted(handle: ScriptedHandle, clock: Any, until: int) -> tuple[float, int]:
    handle.place[0] += 1
    return handle.y[min(handle.place[0], handle.y.size) - 1], 0


@read_channels.register(ScriptedHandle)
def _read_scripted_channels(handle: ScriptedHandle, values: Vector) -> None:
    values[:] = 0.25


@write_command.register(ScriptedHandle)
def _write_scripted(handle: ScriptedHandle, u: float) -> int:
    return handle.fault


class Scripted(TwinDevice):
    """A drive with that handle."""

    def __init__(self, y: list[float], fault: int = 0) -> None:
        super().__init__(loaded_drive(), DT)
        self.handle: Any = ScriptedHandle(np.array(y), np.zeros(1, dtype=np.int64), fault)

    def read(self) -> float:
        """Take none of the list: it is for the ticks."""
        return 0.0


def proxy_of(bench: Callable[..., Bench], drive: Any, **settings: Any) -> tuple[Any, Rig]:
    """Return the proxy of a drive, and its rig, which ticks as plain Python."""
    proxy = CompensatedDrive(drive, ql.Compensator(OBSERVER, **LIMITS), **settings)
    return proxy, bench("udp", kind=PlainRig, plant=proxy).rig


def test_one_missing_measurement_is_bridged_and_no_second_one(bench: Callable[..., Bench]) -> None:
    """Nor one before the first; and the channels of a silent drive are missing as well."""
    y = [np.nan, np.nan, 1.0, np.nan, np.nan, np.nan, 2.0]
    proxy, rig = proxy_of(bench, Scripted(y), channels=["temperature"])
    seen, channels = [], []
    for _ in y:
        rig.tick()
        seen.append(float(rig.model.y[0]))
        channels.append(float(rig.channels[0]))
    np.testing.assert_array_equal(seen, [np.nan, np.nan, 1.0, 1.0, np.nan, np.nan, 2.0])
    np.testing.assert_array_equal(channels, [0.25, np.nan, 0.25, 0.25, np.nan, np.nan, 0.25])
    assert proxy.counters == {"missing": 5, "unsent": 0}
    assert not proxy.fault


def test_a_drive_that_takes_no_command_is_lost(bench: Callable[..., Bench]) -> None:
    """More than ``Safety.hold`` in a row can't be sent: the rig ends, however many ticks it has."""
    proxy, rig = proxy_of(bench, Scripted([0.0], wire.COMMAND_NOT_SENT))
    rig.tick(5)
    assert (proxy.fault, proxy.counters["unsent"]) == ("", 5)
    rig.tick(100)
    assert (proxy.fault, proxy.counters["unsent"]) == ("commands could not be sent any more", 6)


def tried(stack: ExitStack, several: bool) -> tuple[Bench, Any, Bench, Any, Any]:
    """Return a drive, its proxy, the rig of that, a host and its u after five good ticks."""
    signals, u = ((2, 2), [0.3, 0.2]) if several else (None, 0.3)
    drive = Bench(stack, plant=ARM if several else loaded_drive())
    compensator = compensators() if several else ql.Compensator(OBSERVER, **LIMITS)
    proxy = CompensatedDrive(drive.open(signals=signals), compensator)
    outer = Bench(stack, plant=proxy)
    host = outer.open(meanwhile=drive.rig.tick, signals=signals)
    for _ in range(5):
        drive.rig.tick()
        outer.rig.tick()
        assert np.isfinite(outer.catch_up(host)).all()
        host.write(u)
    return drive, proxy, outer, host, u


@pytest.mark.parametrize("several", [False, True])
def test_the_host_sees_that_a_drive_has_died(several: bool) -> None:
    """One sample is bridged; then there is no measurement, and after a second no session."""
    with ExitStack() as stack:
        _, proxy, outer, host, u = tried(stack, several)
        seen = []
        for _ in range(12):
            outer.rig.tick()
            seen.append(host.read())
            host.write(u)
        assert np.isfinite(seen[0]).all()
        assert np.isnan(seen[1:]).all()
        assert proxy.fault == "no measurement has come for 12 ticks, 0.12 s"
        assert outer.rig.state == "live"
        for _ in range(89):
            assert not host.lost
            outer.rig.tick()
            host.read()
            if outer.rig.state == "live":
                host.write(u)
        assert (outer.rig.state, host.lost) == ("idle", True)
        assert proxy.fault == "no measurement has come for 101 ticks, 1.01 s"


def test_one_dead_sensor_is_named_and_missing_for_the_host() -> None:
    """The other axis is measured on."""
    with ExitStack() as stack:
        drive, proxy, outer, host, u = tried(stack, True)
        model, values, seen = drive.rig.model, np.array([np.nan, 0.15]), []
        for _ in range(40):
            wire.write_next_numbers(model.outbox, model.endpoint, wire.MEASUREMENT, TIME, values, 0)
            wire.send(model.transport, model.outbox)
            outer.rig.tick()
            seen.append(host.read())
            host.write(u)
        assert np.isnan(np.array(seen)[1:, 0]).all()
        np.testing.assert_array_equal(np.array(seen)[:, 1], 0.15)
        assert proxy.fault == "no measurement of x has come for 40 ticks, 0.4 s"


def test_a_drive_that_has_tripped_ends_the_session_of_the_host() -> None:
    """It sends measurements on, but its u is zero: the host must not go on."""
    with ExitStack() as stack:
        drive, proxy, outer, host, _ = tried(stack, False)
        drive.rig.tick(30)
        assert drive.rig.state == "tripped"
        outer.rig.tick(5)
        host.read()
        assert (outer.rig.state, host.lost) == ("idle", True)
        assert proxy.fault.startswith("its watchdog has set u to zero")


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


PROXY = """
dt = 0.01
[observer]
kind = "model-based"
omega_o = 30.0
plant = {kind = "linear", num = [12.0], den = [1.0, 12.0, 0.0]}
[controller]
kind = "compensator"
u_min = -3.0
u_max = 3.0
[rig]
device = "URL"
"""


def test_the_command_says_that_the_drive_is_lost_and_ends_with_code_3(
    quell: Callable[..., Shown],
) -> None:
    """The drive says goodbye after a while: one line, which begins with NOT, says how it ended."""
    with ExitStack() as stack:
        drive, over = Bench(stack, plant=loaded_drive(), kind=PlainRig), Event()
        file = Path("drive.toml")
        file.write_text(PROXY.replace("URL", drive.url), encoding="utf-8")

        def work() -> None:
            while drive.rig.state != "live" and not over.wait(DT):
                drive.rig.tick()
            while not over.wait(DT) and drive.rig.counters["accepted"] < 20:
                drive.rig.tick()
            drive.rig._end_session()

        thread = Thread(target=work)
        thread.start()
        shown = quell(
            *("proxy", str(file), "--host", "udp://127.0.0.1:0", "--priority", "0"),
            *("--seconds", "60"),
        )
        over.set()
        thread.join()
        drive.rig.tick()
    last = shown.out.splitlines()[-1]
    assert last.startswith(f"NOT connected to the drive at {drive.url}: it has ended the session")
    assert (shown.code, shown.err) == (3, "")
