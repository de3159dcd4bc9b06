"""Devices and the rig at their other end, step by step: no test here knows what time it is."""

from __future__ import annotations

import socket
import struct
import threading
import uuid
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.kernels.dispatch import interpreted
from quell.realtime.devices.base import (
    Device,
    PythonHandle,
    handle_of,
    read_measurement,
    write_command,
)
from quell.realtime.devices.registry import listen, open_device
from quell.realtime.devices.twin import TwinDevice
from quell.realtime.rig.fault_injection import KINDS, Fault, FaultInjector, Relay, random_faults
from quell.realtime.rig.kernel import serve
from quell.realtime.rig.server import Rig
from quell.realtime.system.clock import system_clock, virtual_clock
from quell.realtime.wire import frames
from quell.realtime.wire.shared_memory import SharedMemoryDevice
from quell.realtime.wire.udp import UdpDevice

DT = 0.01
PLANT = ql.plants.two_mass_spring()
WIRES = ("udp", "shm")


def url_of(wire: str) -> str:
    """Return where a rig can listen."""
    return "udp://127.0.0.1:0" if wire == "udp" else f"shm://test-{uuid.uuid4().hex}"


def packed(
    kind: int,
    number: int,
    answers: int,
    value: float,
    *,
    session: int = 0x5EED0001,
    version: int = 1,
) -> bytes:
    """Return a frame, made without the package."""
    head = struct.pack("<2sBBIIIqdI", b"QL", version, kind, session, number, answers, 0, value, 0)
    return head + struct.pack("<I", zlib.crc32(head))


class Bench:
    """A rig that ticks when it is told to, and the devices that are opened on it."""

    def __init__(self, stack: ExitStack, wire: str = "udp", url: str = "", **settings: Any) -> None:
        self._stack = stack
        self.rig = stack.enter_context(Rig(PLANT, DT, listen(url or url_of(wire)), **settings))
        self.rig.prepare()
        self.url = self.rig.listener.url

    def open(
        self,
        url: str = "",
        dt: float = DT,
        timeout: float = 30.0,
        meanwhile: Callable[[], Any] = lambda: None,
    ) -> Any:
        """Return a device; the rig ticks until it is open, or has failed."""
        made: list[Any] = []

        def work() -> None:
            try:
                made.append(
                    (UdpDevice if self.url.startswith("udp") else SharedMemoryDevice)(
                        url or self.url, dt, timeout
                    )
                )
            except Exception as error:
                made.append(error)

        thread = threading.Thread(target=work)
        thread.start()
        while thread.is_alive():
            self.rig.tick()
            meanwhile()
            thread.join(0.002)
        if isinstance(made[0], Exception):
            raise made[0]
        self._stack.callback(made[0].close)
        read_all(made[0])
        return made[0]

    def cycle(self, device: Any, law: Callable[[float], float], count: int = 1) -> list[float]:
        """Let ``count`` ticks pass, each answered; return what was measured."""
        measured = []
        for _ in range(count):
            self.rig.tick()
            measured.append(device.read())
            device.write(law(measured[-1]))
        return measured


def read_all(device: Any) -> None:
    """Take what has come so far."""
    read_measurement(device.handle, system_clock(), 0)


def law(y: float) -> float:
    """Return some u."""
    return 1.0 - 0.7 * y


@pytest.fixture
def bench() -> Iterator[Callable[..., Bench]]:
    """Make benches; at the end all that is open is closed."""
    with ExitStack() as stack:
        yield lambda *where, **settings: Bench(stack, *where, **settings)


# In process ---------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "plant", [PLANT, ql.plants.delayed(PLANT, 2 * DT, DT)], ids=lambda plant: plant.name
)
def test_the_twin_in_process_is_the_simulated_plant(plant: Any) -> None:
    """Bit for bit: what it measures is what the simulation has measured under the same u."""
    controller = ql.ADRC(
        ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=DT), omega_c=1.0, u_min=-3.0, u_max=3.0
    )
    run = ql.simulate(plant, controller, ql.Scenario(reference=1.0, duration=5.0))
    twin = TwinDevice(plant, DT)
    assert isinstance(twin, Device)
    assert not twin.paced
    for y, u in zip(run["y"], run["u"], strict=True):
        assert twin.read() == y
        twin.write(u)
    assert twin.counters["written"] == run["y"].size


def test_a_twin_of_a_plant_in_python_is_used_through_python() -> None:
    """It has no line of its own."""

    class Slow:
        order, disturbances, compiled, name = PLANT.order, PLANT.disturbances, False, "slow"

        def sampled(self, dt: float, interpret: bool = False) -> Any:
            assert interpret
            return PLANT.sampled(dt)

    slow, quick = (
        TwinDevice(Slow(), DT, x0=[0.1, 0.2, 0.0, 0.0]),
        TwinDevice(PLANT, DT, x0=[0.1, 0.2, 0.0, 0.0]),
    )
    assert isinstance(handle_of(slow), PythonHandle)
    for _ in range(20):
        assert slow.read() == pytest.approx(quick.read(), rel=1e-12)
        slow.write(1.0)
        quick.write(1.0)


def test_a_device_that_raises_gives_no_number_and_says_so() -> None:
    """The loop goes on to its safe action; what was raised is kept."""

    class Broken:
        def read(self) -> float:
            raise OSError("cable")

        def write(self, u: float) -> None:
            raise OSError("cable")

        def close(self) -> None:
            pass

    handle = handle_of(Broken())
    assert np.isnan(read_measurement(handle, system_clock(), 0)[0])
    assert write_command(handle, 1.0) != 0
    assert handle.faults[0] == 2
    assert str(handle.errors[0]) == "cable"


# Over a wire --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wire", WIRES)
def test_a_wire_is_a_delay_of_one_sample(wire: str, bench: Callable[..., Bench]) -> None:
    """Bit for bit, where no frame is late: a twin behind ``delayed(plant, dt, dt)``, and so the simulation."""
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


def test_ticks_that_were_slept_over_are_caught_up(bench: Callable[..., Bench]) -> None:
    """Where the plant goes depends on the commands at the ticks, not on how late those were; and none is skipped."""
    positions = []
    for late in ([0], [0, 0, 0, 70_500_000, 0]):
        here = bench("udp")
        device = here.open()
        here.cycle(device, law, 3)
        ticks = here.rig.counters["ticks"]
        interpreted(serve)(here.rig.model, virtual_clock(late), 12, True)
        assert here.rig.counters["ticks"] == ticks + 12
        positions.append(here.rig.x)
    assert here.rig.counters["caught_up"] == 7
    assert here.rig.lateness.max == pytest.approx(0.0705)
    assert np.array_equal(*positions)


@pytest.mark.parametrize("wire", WIRES)
def test_the_watchdog_sets_u_to_zero_for_good(wire: str, bench: Callable[..., Bench]) -> None:
    """After so many ticks without a command, on that very tick; commands that come later change nothing, a new session does."""
    here = bench(wire, watchdog=5)
    device = here.open()
    here.cycle(device, lambda y: 2.0, 3)
    applied = []
    for _ in range(8):
        here.rig.tick()
        applied.append(float(here.rig.model.signals[0]))
    assert applied == [2.0, 2.0, 2.0, 2.0, 2.0, 0.0, 0.0, 0.0]
    assert here.rig.state == "tripped"
    assert not device.lost
    assert np.isfinite(device.read())
    assert device.lost
    with pytest.raises(ConnectionError, match="watchdog"):
        device.write(2.0)
    here.rig.tick(3)
    assert here.rig.state == "tripped"
    assert here.rig.model.signals[0] == 0.0
    device.close()
    again = here.open()
    here.cycle(again, lambda y: 2.0, 2)
    assert here.rig.state == "live"
    assert here.rig.model.signals[0] == 2.0
    assert here.rig.counters["watchdog"] == 1


def test_the_watchdog_waits_for_the_first_command(bench: Callable[..., Bench]) -> None:
    """Until then u is zero anyway, and the loop may have to be compiled."""
    here = bench("udp", watchdog=5)
    device = here.open()
    here.rig.tick(200)
    assert here.rig.state == "waiting"
    read_all(device)
    here.cycle(device, law, 2)
    assert here.rig.state == "live"


def test_a_session_that_never_begins_gives_way(bench: Callable[..., Bench]) -> None:
    """After a minute of ticks; before that a second hello is refused, however long the first takes."""
    here = bench("udp")
    here.open()
    here.rig.tick(int(30.0 / DT))
    with pytest.raises(ConnectionError, match="another session"):
        here.open(timeout=0.2)
    here.rig.tick(int(30.0 / DT))
    here.cycle(here.open(), law, 2)
    assert here.rig.state == "live"


@pytest.mark.parametrize("wire", WIRES)
def test_a_loop_may_begin_anew_though_its_goodbye_is_lost(
    wire: str, bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over UDP a frame may not arrive, in shared memory the hello may take its place: the goodbye is said again, and the rig serves."""
    here = bench(wire)
    device, said = here.open(), []
    say = device._send

    def lossy(kind: int, value: float, session: int) -> None:
        said.append(kind)
        if said.count(frames.GOODBYE) != 1 or kind != frames.GOODBYE:
            say(kind, value, session)

    monkeypatch.setattr(device, "_send", lossy)
    thread = threading.Thread(target=device.restart_session)
    thread.start()
    while thread.is_alive():
        here.rig.tick()
        thread.join(0.002)
    assert here.rig.state == "waiting"
    assert here.rig.counters["sessions"] == 2
    assert said.count(frames.GOODBYE) >= 2
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
        (UdpDevice if wire == "udp" else SharedMemoryDevice)(here.url, DT, 0.1)
    here.rig.tick(3)
    assert here.rig.state == "idle"


def test_a_rig_that_ends_says_so_at_once(bench: Callable[..., Bench]) -> None:
    """Not only when it is closed, which may take its time."""
    here = bench("shm")
    device = here.open()
    here.rig.run(5 * DT)
    device.read()
    assert device.lost


def test_a_rig_with_long_ticks_need_not_be_waited_for(bench: Callable[..., Bench]) -> None:
    """To be told to stop it does not wait for the next tick."""
    with closing(listen(url_of("shm"))) as listener, Rig(PLANT, 100.0, listener) as rig:
        rig.prepare()
        thread = threading.Thread(target=rig.run)
        thread.start()
        while rig.counters["ticks"] == 0:
            thread.join(0.01)
        rig.stop()
        thread.join(50.0)
        assert not thread.is_alive()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a disk that is full")
def test_a_rig_goes_on_without_its_log_where_the_disk_is_full() -> None:
    """And says so."""
    with (
        closing(listen(url_of("shm"))) as listener,
        Rig(PLANT, DT, listener, log="/dev/full") as rig,
    ):
        notes = rig.run(10 * DT)
        assert rig.counters["ticks"] == 10
    assert "the log was given up: No space left on device" in notes


def test_a_rig_does_not_hide_what_went_wrong_on_its_thread(
    bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It comes out of run."""
    here = bench("shm")

    def serve(most: int, paced: bool) -> None:
        if paced:
            raise RuntimeError("broken")

    monkeypatch.setattr(here.rig, "_serve", serve)
    with pytest.raises(RuntimeError, match="broken"):
        here.rig.run(1.0)
    with pytest.raises(ValueError, match="seconds = 1e\\+300: must be at most 1e\\+09 s"):
        here.rig.run(1e300)


def test_an_address_that_cannot_be_reached_is_named() -> None:
    """Not only its error."""
    with pytest.raises(ConnectionError, match="udp://255.255.255.255:5005: can't be reached"):
        UdpDevice("udp://255.255.255.255:5005", DT)
    with pytest.raises(ValueError, match="the host 'a{70}.com' is unknown"):
        listen(f"udp://{70 * 'a'}.com:5005")


def test_what_is_no_number_is_not_applied_nor_a_sign_of_life(bench: Callable[..., Bench]) -> None:
    """The last u holds until the watchdog trips."""
    here = bench("udp", watchdog=4)
    device = here.open()
    here.cycle(device, lambda y: 1.5, 2)
    here.cycle(device, lambda y: np.nan, 3)
    assert here.rig.model.signals[0] == 1.5
    here.cycle(device, lambda y: np.inf)
    assert (here.rig.state, here.rig.model.signals[0]) == ("live", 1.5)
    here.rig.tick()
    assert (here.rig.state, here.rig.model.signals[0]) == ("tripped", 0.0)
    assert here.rig.counters["not_finite"] == 4


def test_the_rig_has_a_limit_of_its_own(bench: Callable[..., Bench], tmp_path: Path) -> None:
    """What was on the wire is in the log, beside what was applied."""
    log = tmp_path / "wire.csv"
    here = bench("udp", u_max=2.0, log=log)
    device = here.open()
    here.cycle(device, lambda y: -7.0, 3)
    here.rig.tick(2)
    assert here.rig.counters["clipped"] == 3
    assert here.rig.largest == 7.0
    here.rig.close()
    rows = np.genfromtxt(log, delimiter=",", names=True)
    assert rows["u"][-4:].tolist() == [-2.0] * 4
    assert rows["command"][-4:-2].tolist() == [-7.0, -7.0]
    assert np.isnan(rows["command"][-1])
    assert np.array_equal(rows["tick"], np.arange(rows.size))


@pytest.mark.parametrize("rest", [True, False])
def test_a_session_starts_from_rest_or_where_the_last_one_ended(
    rest: bool, bench: Callable[..., Bench]
) -> None:
    """As was asked for."""
    here = bench("shm", rest=rest)
    device = here.open()
    here.cycle(device, law, 100)
    device.close()
    here.rig.tick()
    assert here.rig.state == "idle"
    assert here.rig.model.signals[0] == 0.0
    again = here.open()
    (y,) = here.cycle(again, law)
    assert (y == 0.0) == rest


@pytest.mark.parametrize("wire", WIRES)
def test_a_rig_serves_one_session_at_a_time(wire: str, bench: Callable[..., Bench]) -> None:
    """The second is told so, and the first does not notice."""
    here = bench(wire)
    device = here.open()
    here.cycle(device, law, 3)
    with pytest.raises(ConnectionError, match="another session is active"):
        here.open(timeout=0.3, meanwhile=lambda: device.write(law(device.read())))
    here.cycle(device, law, 3)
    assert here.rig.state == "live"


@pytest.mark.parametrize("wire", WIRES)
def test_both_ends_must_have_one_sample_time(wire: str, bench: Callable[..., Bench]) -> None:
    """The message has both."""
    here = bench(wire)
    with pytest.raises(ValueError, match=r"dt = 0.02 s: the device at .* ticks every 0.01 s"):
        here.open(dt=0.02)
    assert here.rig.counters["refused"] >= 1
    assert here.rig.state == "idle"


@pytest.mark.parametrize("wire", WIRES)
def test_the_rigs_end_is_told(wire: str, bench: Callable[..., Bench]) -> None:
    """Its goodbye, where it can say one."""
    here = bench(wire)
    device = here.open()
    here.cycle(device, law, 2)
    here.rig.close()
    assert np.isnan(device.read())
    assert device.lost
    with pytest.raises(ConnectionError):
        device.write(0.0)
    device.close()
    with pytest.raises(ValueError, match="closed"):
        device.read()


@pytest.mark.parametrize("url", ["udp://127.0.0.1:9", "shm://nobody"])
def test_where_nobody_answers_it_says_what_to_start(url: str) -> None:
    """In a line."""
    with pytest.raises(ConnectionError, match=f"start one with: quell rig --device {url}"):
        (UdpDevice if url.startswith("udp") else SharedMemoryDevice)(url, DT, 0.1)


@pytest.mark.parametrize(
    "url",
    ["", "foo", "tcp://127.0.0.1:5", "udp://127.0.0.1", "udp://:5", "udp://127.0.0.1:70000", "udp://127.0.0.1:5/x", "udp://127.0.0.1:0", "shm://",
     "shm://a/b", "twin:nothing"],
)  # fmt: skip
def test_a_url_that_is_none_is_refused_in_a_line(url: str) -> None:
    """Before anything is opened."""
    with pytest.raises(ValueError, match=r"^device = .*must"):
        open_device(url, DT)
    if url not in ("udp://127.0.0.1:0",):
        with pytest.raises(ValueError, match=r"^device = .*must"):
            listen(url)


def test_devices_by_their_url() -> None:
    """And devices that are some already."""
    twin = open_device("twin:two-mass", DT)
    assert isinstance(twin, TwinDevice)
    assert open_device(twin, DT) is twin
    with pytest.raises(ValueError, match="must have read"):
        open_device(3, DT)
    with pytest.raises(ValueError, match="dt = -1"):
        open_device("twin:torsional", -1)


def test_a_port_that_is_taken_is_refused(bench: Callable[..., Bench]) -> None:
    """And a name in shared memory that another rig has."""
    for wire in WIRES:
        with pytest.raises(ValueError, match=r"can't listen there|another rig has this name"):
            listen(bench(wire).url)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"watchdog": 0}, "watchdog = 0"),
        ({"u_max": -1.0}, "u_max"),
        ({"u_max": float("nan")}, "u_max"),
        ({"x0": [1.0]}, "x0"),
        ({"log": "/nowhere/x.csv"}, "log = '/nowhere/x.csv'"),
        ({"rest": 1}, "rest"),
        ({"dt": 1e-9}, "dt = 1e-09 s: must be from 1e-06 to 100 s"),
        ({"dt": 1e300}, "must be from 1e-06 to 100 s"),
        ({"watchdog": 10**20}, "watchdog = 1.*: must be a whole number from 1 to 1000000"),
    ],
)
def test_a_rig_says_what_is_wrong_with_its_settings(settings: dict[str, Any], message: str) -> None:
    """By name."""
    listener = listen(url_of("shm"))
    with closing(listener), pytest.raises(ValueError, match=message):
        Rig(PLANT, **{"dt": DT, "listener": listener} | settings)


# What goes wrong ----------------------------------------------------------------------------------------------------------------------


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
    assert here.rig.model.signals[0] == 0.0
    assert here.rig.counters["session"] == before + 2


def test_what_waited_behind_many_others_is_not_taken_for_new(bench: Callable[..., Bench]) -> None:
    """A queue that was full has lost its end; the next measurement is one again."""
    here = bench("udp")
    device = here.open()
    here.cycle(device, law, 2)
    here.rig.tick(60)
    assert np.isnan(read_measurement(device.handle, system_clock(), 0)[0])
    assert device.counters["stale"] == 1
    here.rig.tick()
    assert np.isfinite(device.read())


def test_a_rig_that_was_killed_leaves_nothing_in_the_way(bench: Callable[..., Bench]) -> None:
    """Its mailboxes are taken over, and a loop that was killed at writing does not stop the next."""
    url = url_of("shm")
    dead = listen(url)
    dead.transport.own[:] = 7
    dead.transport.others[:] = 7
    for box in dead._boxes:
        box.close()  # as the system does
    here = bench(url=url)
    device = here.open()
    here.cycle(device, law, 3)
    assert here.rig.state == "live"
    here.rig.close()
    assert not list(Path("/dev/shm").glob(f"quell-{url.removeprefix('shm://')}*"))


# Faults by a plan ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (Fault("drop", "rig", 1, 2), [1, 4, 5, 6]),
        (Fault("burst", "rig", 1, 2), [1, 2, 3, 4, 5, 6]),
        (Fault("duplicate", "rig", 1, 2), [1, 2, 2, 3, 3, 4, 5, 6]),
        (Fault("delay", "rig", 1, 1, late=2), [1, 3, 4, 2, 5, 6]),
        (Fault("drop", "loop", 1, 2), [1, 2, 3, 4, 5, 6]),
    ],
)
def test_a_fault_does_what_its_name_says(fault: Fault, expected: list[int]) -> None:
    """Frames one to six go in; hello passes, and is not counted."""
    spoiler = FaultInjector([fault], "rig")
    assert spoiler.frames(packed(frames.HELLO, 0, 0, DT)) == [packed(frames.HELLO, 0, 0, DT)]
    out = [
        frame for k in range(1, 7) for frame in spoiler.frames(packed(frames.COMMAND, k, k, 0.0))
    ]
    assert [struct.unpack_from("<I", frame, 8)[0] for frame in out] == expected


@pytest.mark.parametrize(
    ("kind", "rule"),
    [
        ("nan", "not_finite"),
        ("flip", "malformed"),
        ("short", "malformed"),
        ("long", "malformed"),
        ("foreign", "session"),
        ("version", "version"),
    ],
)
def test_spoiled_frames_break_the_rule_they_are_meant_to(kind: str, rule: str) -> None:
    """Each time."""
    spoiler = FaultInjector([Fault(kind, "rig", 0, 50)], "rig")
    own = frames.endpoint(frames.COMMAND, 0x5EED0001, 20)
    for k in range(1, 51):
        (data,) = spoiler.frames(packed(frames.COMMAND, k, 0, 1.0))
        frame = frames.buffer()
        frame.bytes[: len(data)] = np.frombuffer(data[:48], dtype=np.uint8)[: frame.bytes.size]
        if frames.is_well_formed(frame, min(len(data), 48), own.counters):
            frames.accept(frame, own)
    assert frames.counts_by_name(own.counters)[rule] == 50


def test_random_plans_have_all_kinds_and_are_the_same_again() -> None:
    """For a seed."""
    plan = random_faults(300, 10_000, seed=4)
    assert plan == random_faults(300, 10_000, seed=4)
    assert plan != random_faults(300, 10_000, seed=5)
    assert {fault.kind for fault in plan} == set(KINDS)


def test_through_a_relay_every_fault_is_counted_and_no_wrong_number_gets_through(
    bench: Callable[..., Bench],
) -> None:
    """Both ways; what was lost is missed, what was spoiled is refused, and the rig applies nothing that was not commanded."""
    here = bench("udp", watchdog=30)
    plan = [
        Fault("nan", "rig", 10, 2),
        Fault("flip", "rig", 20, 3),
        Fault("duplicate", "rig", 30, 4),
        Fault("delay", "rig", 40, 1),
        Fault("foreign", "loop", 45, 1),
        Fault("drop", "loop", 50, 2),
        Fault("short", "loop", 60, 1),
    ]
    with Relay("udp://127.0.0.1:0", here.url, plan) as relay:
        device = here.open(relay.url)
        sent, applied = {0.0}, set()
        for k in range(100):
            here.rig.tick()
            applied.add(float(here.rig.model.signals[0]))
            y = device.read()
            u = 0.01 * k
            sent.add(u)
            device.write(u)
            assert np.isnan(y) or abs(y) < 10.0
        assert applied <= sent
        assert relay.done["rig"]["nan"] == 2
        device.close()
    theirs, ours = here.rig.counters, device.counters
    assert (theirs["not_finite"], theirs["malformed"]) == (2, 3)
    assert theirs["duplicated"] == 4
    assert theirs["reordered"] == 1
    assert (ours["session"], ours["malformed"]) == (1, 1)
