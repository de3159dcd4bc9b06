"""Numbers that a device gives beside y: signals of a schedule, a plant that is held, and others."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers import in_single_precision
from quell.controllers.baselines import PID, ZV
from quell.realtime import (
    CompensatedDrive,
    CsvSink,
    Safety,
    TwinDevice,
    load,
    replay,
    run_rig,
)
from quell.realtime.channels import checked_channels
from quell.realtime.devices import ask
from quell.realtime.recordings import Event, Header, row_channels
from quell.realtime.registry import listen
from quell.realtime.rig import LAST_WORDS, Rig
from quell.realtime.wire import MOST_CHANNELS
from quell.records.record import columns_of

from .cases import cases
from .rig_bench import Bench, PlainRig, packed
from .scripted import DT, PLANT, adrc, run

TABLE = ql.Schedule(points=(0.0, 1.0), b0=(3.0, 0.75))
PATIENT = Safety(settle=5, hold=10_000, most_overruns=10_000, ramp=10)
SAMPLES = 200


def scheduled(**options: Any) -> ql.ADRC:
    """Return an ADRC whose b0 follows an external signal."""
    return adrc(schedule=TABLE, **options)


def rows(*columns: Any) -> Any:
    """Return channels of each sample."""
    return np.column_stack([np.broadcast_to(each, (SAMPLES,)) for each in columns])


def ran(controller: Any, channels: Any = (), names: tuple[str, ...] = (), **options: Any) -> Any:
    """Return the rows of a scripted loop around the twin, with these channels."""
    twin = TwinDevice(PLANT, DT, channels=channels)
    return run(twin, controller, duration=1.0, interpret=True, channels=names, **options)


def test_a_schedule_follows_a_channel_of_the_device() -> None:
    """At a constant value as the controller at this point; also behind a prefilter and in single."""
    expected = ran(scheduled().at(0.25))
    found = ran(scheduled(), rows(7.0, 0.25)[:, ::-1], ("load", "other"))
    np.testing.assert_allclose(found["U"], expected["U"], rtol=1e-9, atol=1e-12)
    assert found.rows[:, -2:].tolist() == [[0.25, 7.0]] * len(found.rows)
    outside = ran(scheduled().at(0.9))
    assert np.max(np.abs(outside["U"] - expected["U"])) > 0.05
    for wrap in (in_single_precision, lambda inner: ql.controllers.Prefiltered(inner, ZV(5.0))):
        found = ran(wrap(scheduled()), rows(0.25), ("load",))
        expected = ran(wrap(scheduled().at(0.25)))
        np.testing.assert_allclose(found["U"], expected["U"], rtol=2e-4, atol=1e-5)


def test_a_missing_signal_is_held_and_flagged() -> None:
    """Its last value stays, and the rows have the event; before the first value the observer's b0."""
    signal = np.where(np.arange(SAMPLES) < 80, 0.25, math.nan)
    found = ran(scheduled(), rows(signal), ("load",))
    np.testing.assert_array_equal(found["U"], ran(scheduled(), rows(0.25), ("load",))["U"])
    missing = (found["EVENTS"].astype(int) & Event.CHANNEL) != 0
    np.testing.assert_array_equal(missing, np.isnan(found.rows[:, -1]))
    assert np.sum(missing) == len(found.rows) - 80
    flags = found.rows[:, _column(scheduled(), "status")].astype(int)
    np.testing.assert_array_equal((flags & ql.Status.SCHEDULE_HELD) != 0, missing)
    never = ran(scheduled(), rows(math.nan), ("load",))
    np.testing.assert_allclose(never["U"], ran(adrc())["U"], rtol=1e-9, atol=1e-12)


def _column(controller: Any, name: str) -> int:
    return columns_of(row_channels(controller.channels), name).start


def test_a_channel_tells_that_the_plant_is_held() -> None:
    """Missing, it stays for ``hold`` samples, and then the plant counts as free."""
    held = np.where(np.arange(SAMPLES) < 60, 1.0, 0.0)
    held[40:52] = math.nan
    found = ran(adrc(), rows(held), ("held",), hold=5)
    flags = found.rows[:, _column(adrc(), "status")].astype(int)
    shown = ((flags & ql.Status.HELD) != 0)[:80].tolist()
    assert shown == [True] * 45 + [False] * 7 + [True] * 8 + [False] * 20
    for controller in (in_single_precision(adrc()), ql.controllers.Prefiltered(adrc(), ZV(5.0))):
        found = ran(controller, rows(held), ("held",), hold=5)
        flags = found.rows[:, _column(controller, "status")].astype(int)
        assert ((flags & ql.Status.HELD) != 0)[:80].tolist() == shown


def test_b0_is_looked_at_by_a_channel_of_a_recording(quell: Callable[..., Any]) -> None:
    """In the samples under control; a column that is not there is one error that names the others."""
    signal = np.repeat([0.0, 1.0], SAMPLES // 2)
    found = ran(scheduled(), rows(signal), ("load",))
    sink = CsvSink("run.csv")
    sink.open(Header(row_channels(scheduled().channels, ("load",)), DT))
    sink.write(found.rows)
    sink.close()
    shown = quell("b0", "run.csv", "--order", "2", "--by", "load", "--bins", "2")
    assert shown.code == 0, shown.err
    assert "by load" in shown.out
    shown = quell("b0", "run.csv", "--order", "2", "--by", "mass")
    assert shown.code == 2
    assert "by = 'mass': must be a channel of run.csv, one of k, " in shown.err


@cases(
    ("controller", "names", "message"),
    [
        (scheduled(), (), "follows 1 external signal; name the device's channels"),
        (scheduled(), ("held",), "follows 1 external signal"),
        (adrc(), "load", "must be a list of names"),
        (adrc(), ("Load",), "must be small letters"),
        (adrc(), ("u",), "'u' is the name of another column"),
        (adrc(), ("x_hat",), "is the name of another column"),
        (adrc(), ("a", "a"), "is the name of another column"),
        (PID(1.0, dt=DT, u_min=-1.0, u_max=1.0), ("held",), "says nothing to a PID"),
    ],
)
def test_names_that_can_not_be_are_refused(controller: Any, names: Any, message: str) -> None:
    """Before the device is touched."""
    with pytest.raises(ValueError, match=message):
        checked_channels(controller, names)
    with pytest.raises(ValueError, match=message):
        run_rig(TwinDevice(PLANT, DT), controller, 1.0, duration=0.1, channels=names)


class InPython:
    """A device that only Python can use, whose channel fails when it is asked to."""

    def __init__(self, value: float = 0.25) -> None:
        self.twin, self.value, self.count, self.fails_at = TwinDevice(PLANT, DT), value, 0, -1

    def read(self) -> float:
        """Measure."""
        self.count += 1
        return self.twin.read()

    def read_channels(self) -> list[float]:
        """Return the load."""
        if self.count == self.fails_at:
            raise OSError("the cell is gone")
        return [self.value]

    def write(self, u: float) -> None:
        """Apply."""
        self.twin.write(u)

    def close(self) -> None:
        """Do nothing."""


@pytest.mark.trial
@pytest.mark.compiled
def test_a_run_records_its_channels_and_a_replay_uses_them(tmp_path: Path) -> None:
    """With a device in Python: what fails there is a missing value, and the run says so."""
    device = InPython()
    device.fails_at = 15
    how: dict[str, Any] = {"safety": PATIENT, "priority": 0, "approach": 0.0, "channels": ["load"]}
    found = run_rig(device, scheduled(), 1.0, duration=0.3, telemetry=[tmp_path / "run.csv"], **how)
    assert found.completed
    assert "channels: in 1 samples under control" in found.text()
    assert "the cell is gone" in found.text()
    record = load(tmp_path / "run.csv")
    assert np.sum(np.isnan(record["load"])) == 1
    assert np.nanmax(np.abs(record["load"] - 0.25)) == 0.0
    again = replay(record, scheduled(), channels=["load"])
    at = np.flatnonzero(record["mode"] == 1)
    np.testing.assert_allclose(again["u_wished"][at], record["u"][at], rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match="follows 1 external signal"):
        replay(record, scheduled())
    with pytest.raises(ValueError, match="the run has no mass"):
        replay(record, scheduled(), channels=["mass"])


def test_a_run_does_not_begin_before_its_channels_have_come() -> None:
    """A device without channels, one that gives fewer, and one whose value is not finite."""
    plain = type("Plain", (), {k: v for k, v in vars(InPython).items() if k != "read_channels"})
    for device, kind, message in (
        (plain(), ValueError, "gives y only"),
        (TwinDevice(PLANT, DT), ConnectionError, "'load' .number 0. has not come"),
        (InPython(math.nan), ConnectionError, "'load' .number 0. has not come"),
    ):
        with pytest.raises(kind, match=message):
            run_rig(device, scheduled(), 1.0, duration=0.1, channels=["load"])


# ---- Over a wire ----


@pytest.mark.parametrize("wire", ["udp", "serial"])
def test_channels_come_with_the_measurement_over_a_wire(
    wire: str, bench: Callable[..., Bench]
) -> None:
    """Of the same tick; a value that is not finite is missing."""
    here = bench(wire, kind=PlainRig, channels=(0.25, 7.0))
    device = here.open()
    device.write(0.0)
    here.await_frame()
    for k in range(20):
        here.rig.channels[0] = float(k)
        here.cycle(device, lambda y: 0.0)
        assert device.read_channels()[:2] == [float(k), 7.0]
    assert all(map(math.isnan, device.read_channels()[2:]))
    here.rig.channels[0] = math.inf
    here.cycle(device, lambda y: 0.0)
    assert math.isnan(device.read_channels()[0])
    counters = device.counters
    assert counters["kind"] == counters["skipped"] == counters["malformed"] == 0


def test_a_channel_that_is_not_sent_any_more_is_missing_after_fifty_ticks(
    bench: Callable[..., Bench],
) -> None:
    """Until then its last value holds. Older ones and unknown numbers change nothing."""
    here = bench("udp", kind=PlainRig)
    device = here.open()
    own = here.rig.model.endpoint.numbers

    def send(number: int, value: float, place: int = 0) -> None:
        frame = packed(6, number, 0, value, session=int(own[0]), state=place)
        listener: Any = here.rig.listener
        listener.socket.sendto(frame, ("127.0.0.1", _port(device)))

    device.write(0.0)
    here.cycle(device, lambda y: 0.0, count=3)
    send(int(own[1]) + 1, 0.5)
    send(int(own[1]), 0.75)  # of the tick before
    send(int(own[1]) + 1, 9.0, place=MOST_CHANNELS)
    send(int(own[1]) + 1000, 9.0, place=1)
    last = []
    for _ in range(60):
        here.cycle(device, lambda y: 0.0)
        last.append(device.read_channels()[0])
    assert last[:50] == [0.5] * 50
    assert all(map(math.isnan, last[51:]))
    assert math.isnan(device.read_channels()[1])


def _port(device: Any) -> int:
    import socket

    with socket.socket(fileno=__import__("os").dup(device.handle.transport.socket.fd)) as own:
        port: int = own.getsockname()[1]
    return port


def test_before_the_first_command_a_hello_is_worth_two_frames_with_channels_too(
    bench: Callable[..., Bench],
) -> None:
    """A channel in turn and a measurement: nobody can make the rig send more than without."""
    here = bench("udp", kind=PlainRig, channels=(1.0, 2.0, 3.0))
    device = here.open()
    before = here.rig.counters["ticks"]
    seen = set()
    for _ in range(6):
        ask(device.handle)
        here.rig.tick(5)
        here.catch_up(device)
        seen |= {value for value in device.read_channels() if value == value}
    assert seen == {1.0, 2.0, 3.0}
    assert here.rig.counters["ticks"] > before
    sent = here.rig.model.endpoint.numbers[1]
    assert sent <= 2 * 8
    device.write(0.0)
    here.rig.tick(20 + LAST_WORDS)
    assert here.rig.state in ("live", "tripped")


def test_the_proxy_hands_the_channels_of_the_drive_on(bench: Callable[..., Bench]) -> None:
    """To its compensator, whose schedule follows the first one, and to the host."""
    drive = TwinDevice(PLANT, DT, channels=(0.25, 0.0))
    observer = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=DT)
    compensator = ql.Compensator(observer, schedule=TABLE, u_min=-3.0, u_max=3.0)
    with pytest.raises(ValueError, match="follows 1 external signal"):
        CompensatedDrive(drive, compensator)
    proxy = CompensatedDrive(drive, compensator, channels=["load", "held"])
    here = bench("udp", kind=PlainRig, plant=proxy)
    host = here.open()
    here.cycle(host, lambda y: 0.2, count=20)
    assert host.read_channels()[:2] == [0.25, 0.0]
    assert not proxy.estimate.status & ql.Status.SCHEDULE_HELD
    assert proxy._state.schedule.loop[0].b0 == pytest.approx(compensator.at(0.25).observer.b0)


def test_a_rig_sends_eight_channels_at_most() -> None:
    """More, or what is no number, is refused, as it is by a twin."""
    with closing(listen("udp://127.0.0.1:0")) as listener:
        for channels in (range(9), "x", [[1.0]]):
            with pytest.raises(ValueError, match="channels = .*: must be at most 8 numbers"):
                Rig(PLANT, DT, listener, channels=channels)
        Rig(PLANT, DT, listener, channels=range(8)).close()
    with pytest.raises(ValueError, match="channels = 'x': must be numbers"):
        TwinDevice(PLANT, DT, channels="x")
