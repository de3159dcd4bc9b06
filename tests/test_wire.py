"""Both ends of a wire, step by step: no test here knows what time it is."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import quell as ql
from quell.kernels.dispatch import call_specialised, compiled
from quell.realtime import wire as frames
from quell.realtime import wire_device
from quell.realtime.devices import TwinDevice, read_measurement
from quell.realtime.registry import listen
from quell.realtime.system import system_clock
from quell.realtime.transports import UdpDevice, UdpTransport
from quell.realtime.wire import (
    connect_to_sender,
    is_from_other_side,
    receive,
    reply,
    send,
    wait_for_frame,
)

from .benchmark_module import benchmark
from .cases import cases
from .rig_bench import DT, PLANT, WIRES, Bench, connect, law, packed

HOSTILE = Path(__file__).parents[1] / "benchmarks" / "hostile_wire.py"


@pytest.mark.parametrize("wire", WIRES)
def test_a_wire_is_a_delay_of_one_sample(wire: str, bench: Callable[..., Bench]) -> None:
    """Bit for bit, if no frame is late: a twin of ``delayed(plant, dt, dt)``."""
    here = bench(wire)
    device = here.open()
    assert device.paced
    twin = TwinDevice(ql.plants.delayed(PLANT, DT, DT), DT)
    for _ in range(500):
        (y,) = here.cycle(device, law)
        assert y == twin.read()
        twin.write(law(y))
    assert abs(y) > 0.1
    counted = here.rig.counters
    assert counted["accepted"] == 499
    assert counted["skipped"] == counted["stale"] == device.counters["stale"] == 0


def test_a_controller_over_the_wire_does_as_in_the_simulation(bench: Callable[..., Bench]) -> None:
    """To the last digits: they hang on how the controller was compiled."""
    here = bench("udp")
    device = here.open()
    controller = ql.ADRC(
        ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=DT), omega_c=1.0, u_min=-3.0, u_max=3.0
    )
    run = ql.simulate(
        ql.plants.delayed(PLANT, DT, DT), controller, ql.Scenario(reference=1.0, duration=5.0)
    )
    measured = here.cycle(device, lambda y: controller.step(1.0, y), run["y"].size)
    assert np.max(np.abs(run["y"])) > 0.3
    np.testing.assert_allclose(measured, run["y"], atol=1e-10)


@pytest.mark.parametrize("wire", WIRES)
def test_the_watchdog_sets_u_to_zero_for_good(wire: str, bench: Callable[..., Bench]) -> None:
    """On the tick after so many without a command; only a new session ends it."""
    here = bench(wire, watchdog=5)
    device = here.open()
    here.cycle(device, lambda y: 2.0, 3)
    applied = []
    for _ in range(8):
        here.rig.tick()
        applied.append(here.applied)
    assert applied == [2.0, 2.0, 2.0, 2.0, 2.0, 0.0, 0.0, 0.0]
    assert here.rig.state == "tripped"
    assert not device.lost
    assert np.isfinite(here.catch_up(device))
    assert device.lost
    with pytest.raises(ConnectionError, match="watchdog"):
        device.write(2.0)
    here.rig.tick(3)
    assert here.rig.state == "tripped"
    assert here.applied == 0.0
    device.close()
    again = here.open()
    here.cycle(again, lambda y: 2.0, 2)
    assert here.rig.state == "live"
    assert here.applied == 2.0
    assert here.rig.counters["watchdog"] == 1


@pytest.mark.parametrize("wire", WIRES)
def test_a_loop_may_begin_anew_though_its_goodbye_is_lost(
    wire: str, bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be lost, or replaced by the hello: it is sent again."""
    here = bench(wire)
    device, sent = here.open(), []
    send = device._send

    def lossy(kind: int, value: float, session: int) -> None:
        sent.append(kind)
        if sent.count(frames.GOODBYE) != 1 or kind != frames.GOODBYE:
            send(kind, value, session)

    monkeypatch.setattr(device, "_send", lossy)
    here.tick_during(device.restart_session)
    assert here.rig.state == "waiting"
    assert here.rig.counters["sessions"] == 2
    assert sent.count(frames.GOODBYE) >= 2
    here.rig.tick()
    assert (
        here.rig.model.endpoint.numbers[frames.SESSION]
        == device.handle.endpoint.numbers[frames.SESSION]
    )


@pytest.mark.parametrize("wire", WIRES)
def test_a_hello_that_is_heard_when_its_loop_has_gone_begins_nothing(
    wire: str, bench: Callable[..., Bench]
) -> None:
    """The rig was not ready yet, the loop gave up: the next one finds the rig free."""
    here = bench(wire)
    with pytest.raises(ConnectionError, match="no device answers"):
        connect(here.url, DT, 0.1)
    here.rig.tick(3)
    assert here.rig.state == "idle"


def test_the_rigs_end_is_told(bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch) -> None:
    """Its goodbye, where it can say one: a serial line hangs up with it."""
    here = bench("udp")
    device = here.open()
    here.cycle(device, law, 2)
    here.rig.close()
    monkeypatch.setattr(wire_device, "_MOST_AGE", 10)  # how long it waits for a measurement
    assert np.isnan(device.read())
    assert device.lost
    with pytest.raises(ConnectionError):
        device.write(0.0)
    device.close()
    with pytest.raises(ValueError, match="closed"):
        device.read()


def test_where_nobody_answers_it_says_what_to_start() -> None:
    """In a line."""
    url = "udp://127.0.0.1:9"
    with pytest.raises(ConnectionError, match=f"start one with: quell rig --device {url}"):
        connect(url, DT, 0.1)


def test_a_port_that_is_taken_is_refused(bench: Callable[..., Bench]) -> None:
    """In a line."""
    with pytest.raises(ValueError, match="can't listen there"):
        listen(bench("udp").url)


@compiled
def _taken_on(transport: UdpTransport, frame: frames.Buffer) -> tuple[int, bool, int, bool]:
    size = receive(transport, frame)
    stranger = not is_from_other_side(transport)
    failed = reply(transport, frame)
    connect_to_sender(transport)
    return size, stranger, failed + send(transport, frame), is_from_other_side(transport)


@pytest.mark.compiled
def test_compiled_code_answers_whoever_sent_and_knows_him_again() -> None:
    """What a rig does at its port with a hello; a rig itself is compiled for one wire only."""
    host = "127.0.0.1"
    with (
        closing(listen(f"udp://{host}:0")) as here,
        socket.socket(type=socket.SOCK_DGRAM) as there,
        socket.socket(type=socket.SOCK_DGRAM) as stranger,
    ):
        there.settimeout(5.0)
        hello, port = packed(frames.HELLO, 0, 0, DT), here.socket.getsockname()[1]
        there.sendto(hello, (host, port))
        frame = frames.buffer()
        wait_for_frame(here.transport, 10**9)
        done = call_specialised(_taken_on, here.transport, frame)
        assert done == (len(hello), True, 0, True)
        assert [there.recv(100), there.recv(100)] == [hello, hello]
        stranger.sendto(hello, (host, port))
        wait_for_frame(here.transport, 10**9)
        assert call_specialised(_taken_on, here.transport, frame)[:2] == (len(hello), True)


def test_an_address_that_cannot_be_reached_is_named() -> None:
    """Not only its error."""
    with pytest.raises(ConnectionError, match="udp://255.255.255.255:5005: can't be reached"):
        UdpDevice("udp://255.255.255.255:5005", DT)
    with pytest.raises(ValueError, match="the host 'a{70}.com' is unknown"):
        listen(f"udp://{70 * 'a'}.com:5005")


def test_garbage_is_counted_and_changes_nothing(
    bench: Callable[..., Bench], rng: np.random.Generator
) -> None:
    """At the rig, from real sockets: the loop does not notice."""
    here = bench("udp")
    device = here.open()
    twin = TwinDevice(ql.plants.delayed(PLANT, DT, DT), DT)
    host, _, port = here.url.removeprefix("udp://").partition(":")
    good = packed(frames.COMMAND, 1, 1, 9.9)
    other = packed(frames.COMMAND, 1, 1, 9.9, session=77)
    foreign = [rng.bytes(int(rng.integers(0, 200))) for _ in range(20)] + [
        b"",
        good[:39],
        good + b"x",
        other,
        packed(9, 1, 1, 0.0, session=77),
    ]
    foreign += [
        packed(frames.GOODBYE, 0, 0, 0.0, session=77),
        packed(frames.HELLO, 0, 0, DT, session=0),
        packed(1, 1, 1, 0.0, version=3),
    ]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for _ in range(5):
            for data in foreign:
                stranger.sendto(data, (host, int(port)))
            (y,) = here.cycle(device, law)
            assert y == twin.read()
            twin.write(law(y))
    counted = here.rig.counters
    assert here.rig.state == "live"
    assert counted["malformed"] == 5 * 23
    assert counted["session"] == 5 * 3
    assert counted["kind"] == 5 * 1
    assert counted["version"] == 5
    assert counted["accepted"] == 4


class Stranger:
    """A program at another port of this computer."""

    def __init__(self, url: str) -> None:
        host, _, port = url.removeprefix("udp://").partition(":")
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.rig = (host, int(port))

    def send(self, *datagrams: bytes) -> None:
        """Send to the rig."""
        for data in datagrams:
            self.socket.sendto(data, self.rig)

    def received(self) -> list[int]:
        """Return the kinds of all frames that have come."""
        kinds = []
        with contextlib.suppress(BlockingIOError):
            while True:
                kinds.append(self.socket.recv(100)[3])
        return kinds

    def __enter__(self) -> Stranger:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()


def test_a_stranger_who_knows_the_session_can_not_use_it(bench: Callable[..., Bench]) -> None:
    """Commands, a goodbye and a hello with all the right numbers, from another address."""
    here = bench("udp")
    device = here.open()
    here.cycle(device, lambda y: 1.0, 3)
    numbers = here.rig.model.endpoint.numbers
    session, sent = int(numbers[frames.SESSION]), int(numbers[frames.SENT])
    with Stranger(here.url) as stranger:
        stranger.send(
            packed(frames.COMMAND, 1000, sent, 9.9, session=session),
            packed(frames.GOODBYE, 0, 0, 0.0, session=session),
            packed(frames.HELLO, 0, 0, DT, session=session),
        )
        here.rig.tick(3)
        assert stranger.received() == []
    assert here.rig.counters["address"] == 3
    assert (here.rig.state, here.applied) == ("live", 1.0)
    here.cycle(device, lambda y: 2.0, 2)
    assert here.applied == 2.0
    assert here.rig.largest == 2.0


@pytest.mark.skipif(not HOSTILE.exists(), reason="the trial is in the repository only")
@cases("several", [False, True])
@cases("wire", WIRES)
def test_hostile_packets_bytes_and_files_do_nothing(wire: str, several: bool) -> None:
    """The trial of ``benchmarks/hostile_wire.py``, six hundred attacks; with three signals, too."""
    if wire == "serial":
        pytest.importorskip("serial")
    trial = benchmark("hostile_wire")
    found = trial.trial(wire, 600, 60.0, seed=5, several=several)
    assert found["attacks"] >= 600
    assert found["wrong"] == []
    assert found["files"] == 0
    assert found["returned"] <= 3 * found["sent"]


def test_a_packet_is_answered_by_three_times_its_bytes_at_most(bench: Callable[..., Bench]) -> None:
    """A hello may have a forged sender: a second one asks for more, a silent sender gets none."""
    here = bench("udp")
    with Stranger(here.url) as stranger:
        hello = packed(frames.HELLO, 0, 0, DT)
        stranger.send(hello)
        here.rig.tick(500)
        first = [frames.WELCOME, frames.MEASUREMENT, frames.MEASUREMENT]
        assert stranger.received() == first
        stranger.send(hello, hello)
        here.rig.tick(500)
        assert sorted(stranger.received()) == sorted([frames.WELCOME, *first])
        stranger.send(packed(frames.HELLO, 0, 0, DT, session=77))
        here.rig.tick(500)
        assert stranger.received() == [frames.WELCOME]
        assert here.rig.state == "waiting"


def test_a_rig_is_silent_when_its_loop_is(bench: Callable[..., Bench]) -> None:
    """Some ticks after the watchdog; the loop has then been told that it has tripped."""
    here = bench("udp", watchdog=5)
    device = here.open()
    here.cycle(device, law, 3)
    sent = int(here.rig.model.endpoint.numbers[frames.SENT])
    here.rig.tick(1000)
    assert here.rig.state == "tripped"
    assert here.rig.model.endpoint.numbers[frames.SENT] - sent < 5 + 12
    here.catch_up(device)
    assert device.lost


def test_measurements_may_be_read_without_commands(bench: Callable[..., Bench]) -> None:
    """The device asks for them."""
    here = bench("udp")
    device, read = here.open(), list[float]()
    here.rig.tick(500)
    here.catch_up(device)

    def read_some() -> None:
        read.extend(device.read() for _ in range(20))

    here.tick_during(read_some)
    assert np.all(np.isfinite(read))
    assert here.rig.state == "waiting"


def test_a_session_that_is_over_does_not_come_back(bench: Callable[..., Bench]) -> None:
    """A hello or a command of it that was late on its way is counted, and u stays zero."""
    here = bench("udp")
    device = here.open()
    session = int(device.handle.endpoint.numbers[frames.SESSION])
    here.cycle(device, law, 3)
    device.close()
    here.rig.tick()
    host, _, port = here.url.removeprefix("udp://").partition(":")
    before = here.rig.counters["session"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
        for data in (
            packed(frames.HELLO, 0, 0, DT, session=session),
            packed(frames.COMMAND, 9, 3, 5.0, session=session),
        ):
            late.sendto(data, (host, int(port)))
    here.rig.tick()
    assert here.rig.state == "idle"
    assert here.applied == 0.0
    assert here.rig.counters["session"] == before + 2


def test_what_waited_behind_many_others_is_not_taken_for_new(bench: Callable[..., Bench]) -> None:
    """A queue that was full has lost its end; the next measurement is one again."""
    here = bench("udp", watchdog=100)
    device = here.open()
    here.cycle(device, law, 2)
    here.rig.tick(60)
    assert np.isnan(read_measurement(device.handle, system_clock(), 0)[0])
    assert device.counters["stale"] == 1
    here.rig.tick()
    assert np.isfinite(device.read())
