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
from quell.kernels.dispatch import as_python
from quell.realtime import CompensatedDrive, Safety, TwinDevice, wire
from quell.realtime.devices import read_channels, read_measurement, write_signals
from quell.realtime.rig import Rig
from quell.realtime.supervisor import FLUSH, Cause, Mode
from quell.types import Vector

from .commands import Shown
from .rig_bench import TIME, Bench, PlainRig

DT = 0.01
DRIVE = ([12.0], [1.0, 12.0, 0.0])
"""A closed drive that takes commands of speed; y is the position."""
LIMITS = {"u_min": -3.0, "u_max": 3.0}
OBSERVER = ql.ESO.model_based(DRIVE, omega_o=40.0, dt=DT)
AT_ONCE = Safety(settle=1)
"""The compensator takes over with the first command of a host."""


def loaded_drive() -> Any:
    """Return the drive with a constant load, by a disturbance of the plant's own."""

    def motion(t: float, x: Any, u: float, w: Any) -> tuple[float, float]:
        return x[1], 12.0 * (u - x[1]) - 6.0

    return ql.plants.NonlinearPlant(motion, order=2, disturbances=0, substeps=1)


@pytest.mark.trial
@pytest.mark.parametrize("with_proxy", [True, False])
def test_the_host_sees_a_drive_that_the_load_does_not_move(with_proxy: bool) -> None:
    """A host with a P controller holds a loaded drive; without the proxy it is off by load/gain."""
    with ExitStack() as stack:
        drive = Bench(stack, plant=loaded_drive())
        outer = drive
        if with_proxy:
            compensator = ql.Compensator(OBSERVER, **LIMITS)
            proxy = CompensatedDrive(drive.open(), compensator, safety=AT_ONCE)
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


B0 = [[2.0, 0.5], [0.4, 3.0]]


ARM = ql.plants.LinearPlant(
    [[0, 1, 0, 0, 0], [0, -4, 0, 0, -1], [0, 0, 0, 1, 0], [0, 0, 0, -5, 0], [0] * 5],
    [[0, 0], B0[0], [0, 0], B0[1], [0, 0]],
    [[1, 0, 0, 0, 0], [0, 0, 1, 0, 0]],
)
"""Two coupled drives that take commands of speed; the last state is a load on the first axis."""
LOADED = [0.0, 0.0, 0.0, 0.0, 1.0]


def compensators(scale: float = 1.0, **limits: Any) -> ql.Axes:
    """Return compensators of two axes for commands of a host; B0 is wrong by ``scale``."""
    both = [
        ql.Compensator(ql.ESO.model_based(([1.0], [1.0, pole, 0.0]), omega_o=40.0, dt=DT))
        for pole in (4.0, 5.0)
    ]
    b0 = (scale * np.array(B0)).tolist()
    return ql.Axes(dict(zip("xy", both, strict=True)), b0, **(LIMITS | limits))


def test_drives_of_several_axes_get_the_u_of_their_compensators() -> None:
    """In each tick that of ``Axes.step`` with the u_0 and the y of this tick, bit by bit."""
    axes, beside = compensators(0.8), TwinDevice(ARM, DT)
    with ExitStack() as stack:
        device = TwinDevice(ARM, DT)
        proxy = CompensatedDrive(device, compensators(0.8), safety=AT_ONCE)
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
        assert abs(proxy.estimate["x"].f) > 0.02


@pytest.mark.trial
def test_a_host_holds_two_drives_against_a_load_over_two_wires() -> None:
    """It has P controllers; without the compensators the first axis is off by load and gain."""
    off = []
    for with_proxy in (True, False):
        with ExitStack() as stack:
            drive = Bench(stack, plant=ARM, x0=LOADED)
            outer = drive
            if with_proxy:
                behind = drive.open(signals=(2, 2))
                proxy = CompensatedDrive(behind, compensators(), safety=AT_ONCE)
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


@write_signals.register(ScriptedHandle)
def _write_scripted(handle: ScriptedHandle, u: Vector) -> int:
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
    rig.tick(6)
    assert (proxy.fault, proxy.counters["unsent"]) == ("", 6)
    rig.tick(100)
    assert (proxy.fault, proxy.counters["unsent"]) == (Cause.UNREACHABLE.text, 7 + FLUSH + 1)


def test_a_drive_that_never_answers_is_given_up(bench: Callable[..., Bench]) -> None:
    """It has two seconds for its first measurement."""
    proxy, rig = proxy_of(bench, Scripted([np.nan]))
    rig.tick(200)
    assert proxy.fault == ""
    rig.tick(100)
    assert proxy.fault == Cause.NO_MEASUREMENT.text
    assert rig.counters["ticks"] == 201 + FLUSH


def tried(stack: ExitStack, several: bool) -> tuple[Bench, Any, Bench, Any, Any]:
    """Return a drive, its proxy, the rig of that, a host and its u after five good ticks."""
    signals, u = ((2, 2), [0.3, 0.2]) if several else (None, 0.3)
    drive = Bench(stack, plant=ARM if several else loaded_drive(), kind=PlainRig)
    compensator = compensators() if several else ql.Compensator(OBSERVER, **LIMITS)
    proxy = CompensatedDrive(drive.open(signals=signals), compensator, safety=AT_ONCE)
    outer = Bench(stack, plant=proxy, kind=PlainRig)
    host = outer.open(meanwhile=drive.rig.tick, signals=signals)
    for _ in range(5):
        drive.rig.tick()
        outer.rig.tick()
        assert np.isfinite(outer.catch_up(host)).all()
        host.write(u)
    return drive, proxy, outer, host, u


@pytest.mark.parametrize("several", [False, True])
def test_the_host_sees_that_a_drive_has_died(several: bool) -> None:
    """One sample is bridged; then there is no measurement, and after ``hold`` and ramp no session."""
    with ExitStack() as stack:
        _, proxy, outer, host, u = tried(stack, several)
        assert proxy.mode is Mode.RUN
        seen, sent = [], []
        for _ in range(5 + 1 + 10 + FLUSH):
            assert not host.lost
            outer.rig.tick()
            seen.append(host.read())
            sent.append(np.abs(proxy.u).max())
            if outer.rig.state == "live":
                host.write(u)
        assert np.isfinite(seen[0]).all()
        assert np.isnan(seen[1:]).all()
        assert sent[:5] == [sent[0]] * 5  # held
        assert sent[0] > 0.2
        assert np.all(np.diff(sent[4:15]) < 0.0)
        assert sent[15:] == [0.0] * (len(sent) - 15)
        host.read()
        assert (outer.rig.state, host.lost) == ("idle", True)
        assert proxy.fault == Cause.LOST.text


def test_one_dead_sensor_is_named_and_missing_for_the_host() -> None:
    """The other axis is measured on until u is zero: that of both."""
    with ExitStack() as stack:
        drive, proxy, outer, host, u = tried(stack, True)
        model, values, seen = drive.rig.model, np.array([np.nan, 0.15]), []
        for _ in range(12):
            wire.write_next_numbers(model.outbox, model.endpoint, wire.MEASUREMENT, TIME, values, 0)
            wire.send(model.transport, model.outbox)
            outer.rig.tick()
            seen.append(host.read())
            host.write(u)
        assert np.isnan(np.array(seen)[1:, 0]).all()
        np.testing.assert_array_equal(np.array(seen)[:, 1], 0.15)
        assert proxy.fault == f"x: {Cause.LOST.text}"


def test_a_drive_that_has_tripped_ends_the_session_of_the_host() -> None:
    """It sends measurements on, but its u is zero: the host must not go on."""
    with ExitStack() as stack:
        drive, proxy, outer, host, _ = tried(stack, False)
        drive.rig.tick(30)
        assert drive.rig.state == "tripped"
        outer.rig.tick(20)
        host.read()
        assert (outer.rig.state, host.lost) == ("idle", True)
        assert proxy.fault == Cause.WATCHDOG.text


# ---- The host is gone, or b0 has the wrong sign ----


class Servo:
    """Axes of 50/(s (s + 1)) behind a proxy with |u| <= 2, and a host with PD controllers.

    ``sign`` is that of b0 of the first axis.
    """

    def __init__(self, stack: ExitStack, axes: int, sign: float, **settings: Any) -> None:
        observer = {"order": 2, "omega_o": 30.0, "dt": DT}
        limits = {"u_min": -2.0, "u_max": 2.0}
        plant: Any = ql.plants.LinearPlant.of(([50.0], [1.0, 1.0, 0.0]))
        compensator: Any = ql.Compensator(ql.ESO.model_free(b0=50.0 * sign, **observer), **limits)
        if axes > 1:
            a, b, c = np.array([[0.0, 1.0], [0.0, -1.0]]), np.array([[0.0], [50.0]]), [[1.0, 0.0]]
            blocks = [np.kron(np.eye(axes), block) for block in (a, b, np.array(c))]
            plant = ql.plants.LinearPlant(*(block.tolist() for block in blocks))
            each = {
                f"q{i}": ql.Compensator(ql.ESO.model_free(b0=1.0, **observer)) for i in range(axes)
            }
            gains = np.diag([50.0 * sign, *[50.0] * (axes - 1)])
            compensator = ql.Axes(each, gains.tolist(), **limits)
        self.device = TwinDevice(plant, DT)
        self.proxy = CompensatedDrive(self.device, compensator, **settings)
        self.outer = Bench(stack, plant=self.proxy, kind=PlainRig)
        self.signals = None if axes == 1 else (axes, axes)
        self.host = self.outer.open(signals=self.signals)
        self.y, self.k = np.zeros(axes), 0
        while self.proxy._supervisor.memory[0].samples < 20 and self.k < 40:
            self.run(1, rest=True)

    def run(self, ticks: int, rest: bool = False) -> float:
        """Let the host command for some ticks; return the largest |u| that the drive got."""
        most = 0.0
        for _ in range(ticks):
            if self.host.lost:
                break
            before, y = self.y, np.atleast_1d(self.host.read())
            self.y = np.where(np.isfinite(y), y, before)
            self.k += 1
            r = np.zeros(self.y.size) if rest else np.full(self.y.size, np.sin(3.0 * DT * self.k))
            u_0 = np.clip(0.7 * (r - self.y) - 0.24 * (self.y - before) / DT, -2.0, 2.0)
            if not self.host.lost:  # the proxy may have ended with this measurement
                self.host.write(u_0 if self.signals else float(u_0[0]))
            self.outer.rig.tick()
            most = max(most, float(np.abs(self.proxy.u).max()))
        return most

    def alone(self, ticks: int) -> list[float]:
        """Let the host be silent for some ticks; return the largest |u| in each."""
        sent = []
        for _ in range(ticks):
            self.outer.rig.tick()
            sent.append(float(np.abs(self.proxy.u).max()))
        return sent


@pytest.mark.parametrize(("axes", "sign"), [(1, 1.0), (1, -1.0), (3, 1.0), (3, -1.0)])
def test_u_as_a_whole_goes_to_zero_when_the_host_falls_silent(axes: int, sign: float) -> None:
    """Within ``hold`` samples and the ramp, at any instant, with each sign of b0; then it ends."""
    for ticks in (4, 17, 31):
        with ExitStack() as stack:
            servo = Servo(stack, axes, sign)
            assert servo.run(ticks) > 0.1
            sent = servo.alone(5 + 10 + FLUSH)
            assert sent[5] > 0.0
            assert sent[15:] == [0.0] * FLUSH
            servo.outer.rig.tick(10)
            assert servo.proxy.fault == Cause.HOST_LOST.text
            assert (servo.proxy.mode, servo.outer.rig.state) == (Mode.STOPPED, "idle")
            y = np.array(servo.device.read())
            assert np.all(np.abs(y) < 100.0)


@pytest.mark.trial
@pytest.mark.parametrize("axes", [1, 3])
def test_a_wrong_sign_of_b0_ends_the_run_however_long_the_host_goes_on(axes: int) -> None:
    """At its limits u drives y the other way, again and again, until it is ramped to zero."""
    with ExitStack() as stack:
        servo = Servo(stack, axes, -1.0)
        servo.run(450)
        signal = "q0: " if axes > 1 else ""
        assert servo.proxy.fault == f"{signal}{Cause.WRONG_WAY.text}"
        assert np.all(np.asarray(servo.proxy.u) == 0.0)
        right = Servo(stack, axes, 1.0)
        right.run(100)
        assert (right.proxy.fault, right.proxy.mode) == ("", Mode.RUN)


def test_the_check_of_the_sign_can_be_left_out_and_bounds_of_y_hold_then() -> None:
    """``check_direction`` and ``y_max`` are those of ``run_rig``; so is the time at a limit."""
    with ExitStack() as stack:
        rules = Safety(check_direction=False, y_min=-5.0, y_max=5.0)
        servo = Servo(stack, 1, -1.0, safety=rules)
        servo.run(200)
        assert servo.proxy.fault == Cause.IMPLAUSIBLE.text
        servo = Servo(stack, 1, -1.0, safety=Safety(check_direction=False, saturated_time=0.2))
        servo.run(200)
        assert servo.proxy.fault == Cause.SATURATED.text


def test_a_host_that_comes_back_changes_nothing_until_the_proxy_is_started_again() -> None:
    """Neither its late commands nor a new session of another host within the ramp."""
    with ExitStack() as stack:
        servo = Servo(stack, 1, 1.0)
        servo.run(20)
        servo.alone(8)
        assert servo.proxy.mode is Mode.RAMP
        sent = []
        for _ in range(20):
            servo.host.write(1.5)
            servo.outer.rig.tick()
            sent.append(abs(servo.proxy.u))
        assert sent[8:] == [0.0] * 12
        assert servo.proxy.fault == Cause.HOST_LOST.text
        servo.outer.rig.tick(1)
        assert servo.proxy.u == 0.0


def test_a_host_that_ends_its_session_leaves_a_drive_at_rest_for_the_next_one() -> None:
    """U goes to zero in the ramp; the next host finds it in START and takes over."""
    with ExitStack() as stack:
        servo = Servo(stack, 1, 1.0)
        servo.run(20)
        servo.host.close()
        sent = servo.alone(14)
        assert sent[0] > 0.0
        assert sent[10:] == [0.0] * 4
        servo.alone(4)
        assert (servo.proxy.mode, servo.proxy.fault) == (Mode.START, "")
        servo.host = servo.outer.open()
        assert servo.run(10, rest=True) == 0.0  # it observes for ``settle`` samples first
        servo.run(40)
        assert servo.proxy.mode is Mode.RUN
        causes = [change.cause for change in servo.proxy.changes()]
        assert causes == [
            *(Cause.SETTLED, Cause.HOST_LEFT, Cause.RAMPED),
            *(Cause.WAITING, Cause.SETTLED),
        ]


def test_without_a_host_u_is_zero_and_a_request_ends_the_proxy() -> None:
    """However long it waits; ``Rig.stop`` brings u to zero in a ramp first."""
    device = TwinDevice(loaded_drive(), DT)
    with ExitStack() as stack:
        proxy = CompensatedDrive(device, ql.Compensator(OBSERVER, **LIMITS))
        rig = Bench(stack, plant=proxy, kind=PlainRig).rig
        rig.tick(300)
        assert (proxy.mode, proxy.u) == (Mode.START, 0.0)
        with as_python():
            rig.run(0.05)
        assert (proxy.mode, proxy.fault) == (Mode.STOPPED, "")
        assert [change.cause for change in proxy.changes()] == [Cause.STOP_REQUESTED, Cause.RAMPED]


@pytest.mark.trial
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
    with pytest.raises(ValueError, match="most_error = 1.0: has no effect here"):
        CompensatedDrive(twin, compensator, safety=Safety(most_error=1.0))
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
    assert first.endswith("command[0],command[1],mode,u_drive[0],u_drive[1]")
    text = PROXY_OF_AXES.replace("compensator = {}", "controller = { omega_c = 2.0 }")
    Path("adrc.toml").write_text(text, encoding="utf-8")
    shown = quell("proxy", "adrc.toml", *arguments)
    assert (shown.code, "the host has the controller" in shown.err) == (2, True)
    text = PROXY_OF_AXES.replace('"twin:"', '"twin:", spin = 1e-4')
    Path("spin.toml").write_text(text, encoding="utf-8")
    shown = quell("proxy", "spin.toml", *arguments)
    assert (shown.code, "rig.spin: has no effect in quell proxy" in shown.err) == (2, True)


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
        rules = "safety = { hold = 2000, most_overruns = 2000 }\n"  # a busy machine stops nothing
        file.write_text(PROXY.replace("URL", drive.url) + rules, encoding="utf-8")

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
    assert last.startswith(f"NOT driving {drive.url} any more: {Cause.WATCHDOG.text}. u was ramped")
    assert (shown.code, shown.err) == (3, "")
