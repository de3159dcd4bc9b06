"""The rig, step by step."""

from __future__ import annotations

import resource
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.kernels.dispatch import interpreted
from quell.realtime.devices import TwinDevice, ask
from quell.realtime.registry import listen
from quell.realtime.rig import Rig, serve
from quell.realtime.system import virtual_clock

from .cases import cases
from .rig_bench import DT, PLANT, Bench, law, url_of


def test_ticks_that_were_slept_over_are_caught_up(bench: Callable[..., Bench]) -> None:
    """The motion depends on the commands at the ticks, not on when they happen; none is skipped."""
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


def test_a_rig_that_waits_moves_as_in_the_simulation_however_late_its_loop_is(
    bench: Callable[..., Bench],
) -> None:
    """Bit for bit; the rig ticks as fast as it can on a thread of its own."""
    here = bench("udp", wait=30.0)
    device = here.open()
    twin = TwinDevice(ql.plants.delayed(PLANT, DT, DT), DT)
    thread = threading.Thread(target=lambda: here.rig.tick(60))
    (y,) = here.cycle(device, law)
    thread.start()
    for k in range(60):
        assert y == twin.read()
        twin.write(law(y))
        y = device.read()
        if k % 20 == 0:
            time.sleep(0.01)
        device.write(law(y))
    thread.join()
    assert here.rig.counters["accepted"] == 60
    assert here.rig.counters["skipped"] == 0


def test_a_rig_that_waits_trips_if_no_command_comes(bench: Callable[..., Bench]) -> None:
    """Each tick waits for its time only."""
    here = bench("udp", wait=1e-3, watchdog=5)
    device = here.open()
    here.cycle(device, law, 3)
    here.rig.tick(7)
    assert (here.rig.state, here.applied) == ("tripped", 0.0)


def test_the_watchdog_waits_for_the_first_command(bench: Callable[..., Bench]) -> None:
    """Until then u is zero anyway, and the loop may have to be compiled."""
    here = bench("udp", watchdog=5)
    device = here.open()
    here.rig.tick(200)
    assert here.rig.state == "waiting"
    here.catch_up(device)
    ask(device.handle)
    here.cycle(device, law, 2)
    assert here.rig.state == "live"


def test_a_session_that_never_begins_gives_way(bench: Callable[..., Bench]) -> None:
    """After a minute of ticks; before that a second hello is refused."""
    here = bench("udp")
    here.open()
    here.rig.tick(int(30.0 / DT))
    with pytest.raises(ConnectionError, match="another session"):
        here.open(timeout=0.2)
    here.rig.tick(int(30.0 / DT))
    here.cycle(here.open(), law, 2)
    assert here.rig.state == "live"


def test_a_rig_that_ends_says_so_at_once(bench: Callable[..., Bench]) -> None:
    """Not only when it is closed, which may take its time."""
    here = bench("udp")
    device = here.open()
    here.rig.run(5 * DT)
    device.read()
    assert device.lost


def test_a_rig_with_long_ticks_need_not_be_waited_for(bench: Callable[..., Bench]) -> None:
    """To be told to stop it does not wait for the next tick."""
    with closing(listen(url_of("udp"))) as listener, Rig(PLANT, 100.0, listener) as rig:
        rig.prepare()
        thread = threading.Thread(target=rig.run)
        thread.start()
        while rig.counters["ticks"] == 0:
            thread.join(0.01)
        rig.stop()
        thread.join(50.0)
        assert not thread.is_alive()


def test_a_rig_goes_on_without_its_log_where_the_disk_is_full(tmp_path: Path) -> None:
    """It says so, counts the ticks that are not in the log, and leaves no half line."""
    log = tmp_path / "log.csv"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with (
        closing(listen(url_of("udp"))) as listener,
        Rig(PLANT, DT, listener, log=log) as rig,
    ):
        resource.setrlimit(resource.RLIMIT_FSIZE, (130, before[1]))
        try:
            notes = rig.run(20 * DT)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert rig.counters["ticks"] == 20
    text = log.read_text()
    assert "the log was given up: File too large" in notes
    assert text.endswith("\n")
    assert 0 < rig.unlogged == 20 - (text.count("\n") - 1) < 20


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a disk that is full")
def test_no_rig_starts_with_a_log_that_can_not_be_written() -> None:
    """As a recording."""
    with (
        closing(listen(url_of("udp"))) as listener,
        pytest.raises(ValueError, match="/dev/full': can't be written .No space left on device"),
    ):
        Rig(PLANT, DT, listener, log="/dev/full")


def test_a_rig_replaces_a_log_only_where_asked(tmp_path: Path) -> None:
    """As all outputs."""
    log = tmp_path / "log.csv"
    log.write_text("precious")
    with closing(listen(url_of("udp"))) as listener:
        with pytest.raises(ValueError, match="log.csv': the file exists; choose another name"):
            Rig(PLANT, DT, listener, log=log)
        assert log.read_text() == "precious"
        Rig(PLANT, DT, listener, log=log, overwrite=True).close()
    assert log.read_text().startswith("tick,t,")


def test_a_rig_does_not_hide_what_went_wrong_on_its_thread(
    bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It comes out of run."""
    here = bench("udp")

    def serve(most: int, paced: bool) -> None:
        if paced:
            raise RuntimeError("broken")

    monkeypatch.setattr(here.rig, "_serve", serve)
    with pytest.raises(RuntimeError, match="broken"):
        here.rig.run(1.0)
    with pytest.raises(ValueError, match="seconds = 1e\\+300: must be at most 1e\\+09 s"):
        here.rig.run(1e300)


def test_what_is_no_number_is_not_applied_nor_a_sign_of_life(bench: Callable[..., Bench]) -> None:
    """The last u holds until the watchdog trips."""
    here = bench("udp", watchdog=4)
    device = here.open()
    here.cycle(device, lambda y: 1.5, 2)
    here.cycle(device, lambda y: np.nan, 3)
    assert here.applied == 1.5
    here.cycle(device, lambda y: np.inf)
    assert (here.rig.state, here.applied) == ("live", 1.5)
    here.rig.tick()
    assert (here.rig.state, here.applied) == ("tripped", 0.0)
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
    here = bench("udp", rest=rest)
    device = here.open()
    here.cycle(device, law, 100)
    device.close()
    here.rig.tick()
    assert here.rig.state == "idle"
    assert here.applied == 0.0
    again = here.open()
    (y,) = here.cycle(again, law)
    assert (y == 0.0) == rest


@pytest.mark.parametrize("rest", [True, False])
@pytest.mark.parametrize("value", [np.nan, np.inf, -1.1e9, 0.9e9])
def test_a_destroyed_plant_comes_back_to_rest_for_the_next_session(
    value: float, rest: bool, bench: Callable[..., Bench]
) -> None:
    """Not finite, or beyond any motion; a large but possible state is kept if it is to be."""
    here = bench("udp", rest=rest, x0=[0.1, 0.0, 0.2, 0.0])
    device = here.open()
    here.rig.model.x[3] = value
    device.close()
    destroyed = not abs(value) < 1e9
    here.rig.tick()
    here.open()
    back = abs(here.rig.x[3]) < 1.0
    assert back == (rest or destroyed)
    assert here.rig.counters["restored"] == destroyed


@cases(
    ("settings", "message"),
    [
        ({"watchdog": 0}, "watchdog = 0"),
        ({"u_max": -1.0}, "u_max"),
        ({"u_max": float("nan")}, "u_max"),
        ({"x0": [1.0]}, "x0"),
        ({"log": "/nowhere/x.csv"}, "log = '/nowhere/x.csv'"),
        ({"rest": 1}, "rest"),
        ({"wait": -1.0}, "wait"),
        ({"wait": 1e6}, "wait = 1000000.0 s: must be at most 100 s"),
        ({"dt": 1e-9}, "dt = 1e-09 s: must be from 1e-06 to 100 s"),
        ({"dt": 1e300}, "must be from 1e-06 to 100 s"),
        ({"watchdog": 10**20}, "watchdog = 1.*: must be a whole number from 1 to 1000000"),
    ],
)
def test_a_rig_says_what_is_wrong_with_its_settings(settings: dict[str, Any], message: str) -> None:
    """By name."""
    listener = listen(url_of("udp"))
    with closing(listener), pytest.raises(ValueError, match=message):
        Rig(PLANT, **{"dt": DT, "listener": listener} | settings)
