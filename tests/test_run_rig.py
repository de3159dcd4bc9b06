"""``run_rig`` from end to end, in real time; results do not depend on punctuality."""

from __future__ import annotations

import gc
import math
import os
import re
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.realtime import Safety, TwinDevice, load, run_rig
from quell.realtime.recordings import MemorySink
from quell.realtime.run import ModeChange
from quell.realtime.supervisor import Cause, Mode
from quell.realtime.system import checked_cpu, enter_real_time, real_time_process

from .cases import cases
from .scripted import DT, PLANT, adrc

# A machine that is busy with other things may make the loop as late as it likes.
PATIENT = Safety(settle=5, hold=10_000, most_overruns=10_000, ramp=10)


class Rig:
    """A device with the three required methods only."""

    def __init__(self) -> None:
        self.twin = TwinDevice(PLANT, DT)
        self.written: list[float] = []
        self.closed = 0
        self.counters = {"written": 0}

    def read(self) -> float:
        """Measure."""
        return self.twin.read()

    def write(self, u: float) -> None:
        """Apply."""
        self.written.append(u)
        self.counters["written"] += 1
        self.twin.write(u)

    def close(self) -> None:
        """Set u to zero."""
        self.closed += 1


def short(device: Any, duration: float = 0.1, **options: Any) -> Any:
    """Run a short scenario."""
    return run_rig(
        device,
        adrc(),
        1.0,
        duration=duration,
        **{"safety": PATIENT, "priority": 0, "approach": 0.0} | options,
    )


def test_a_run_from_end_to_end(tmp_path: Path) -> None:
    """Trajectory, record, files and counters agree; the device is closed."""
    device, reported = Rig(), list[ModeChange]()
    paths = [tmp_path / "run.csv", tmp_path / "run.mcap"]
    run = short(device, 0.3, telemetry=paths, on_change=reported.append)
    assert run.completed
    assert [change.mode for change in run.changes] == [Mode.RUN, Mode.RAMP, Mode.STOPPED]
    assert tuple(reported) == run.changes
    assert run.verdict.endswith("RAMP: the scenario is over")
    assert device.closed >= 1
    assert device.written[-1] == 0.0
    assert run.tally.cycles == len(run.timing.lateness) == len(run.timing.step)
    assert len(device.written) == run.counters["written"] == 1 + run.tally.cycles
    assert run.tally[3:] == (0, 0, 0, 0)
    # Deadlines that were skipped are filled in, so that time is time.
    assert len(run.trajectory) == 31
    assert run.trajectory.ended == pytest.approx(0.3)
    assert run.trajectory["r"].tolist() == [1.0] * 31
    began = round(run.changes[0].t / DT)
    first = began - int(run.record["k"][0])
    assert len(run.record) >= first + 31 + 10 + 3
    np.testing.assert_array_equal(run.trajectory["u"], run.record["u"][first : first + 31])
    assert run.metrics()["peak_error"] == 1.0
    for path in paths:
        np.testing.assert_array_equal(load(path).log, run.record.log)
    text = run.text()
    for part in (
        "RUN: enough good samples",
        "0 missed",
        f"device: {run.tally.cycles + 1} written",
        "lateness: p50",
        "step time: p50",
        "ordinary",
    ):
        assert part in text


def test_ctrl_c_ramps_down_and_handlers_are_restored() -> None:
    """A signal ends the run with a ramp and a record; handlers and collector are restored."""
    before, device = signal.getsignal(signal.SIGINT), Rig()
    collecting = gc.isenabled()

    def interrupt(change: ModeChange) -> None:
        if change.mode is Mode.RUN:
            os.kill(os.getpid(), signal.SIGINT)

    run = short(device, 60.0, on_change=interrupt)
    assert not run.completed
    assert [change.cause for change in run.changes][-2:] == [Cause.STOP_REQUESTED, Cause.RAMPED]
    assert device.written[-1] == 0.0
    assert signal.getsignal(signal.SIGINT) is before
    assert gc.isenabled() == collecting


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no terminals that can be closed")
def test_a_terminal_that_is_closed_ramps_down_unless_ignored() -> None:
    """SIGHUP acts as Ctrl-C; if it is ignored, as by nohup, it stays ignored."""

    def close_terminal(change: ModeChange) -> None:
        if change.mode is Mode.RUN:
            os.kill(os.getpid(), signal.SIGHUP)

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert short(Rig(), on_change=close_terminal).completed
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        run = short(Rig(), 60.0, on_change=close_terminal)
        assert Cause.STOP_REQUESTED in [change.cause for change in run.changes]
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_second_ctrl_c_is_zero_at_once() -> None:
    """The ramp, which would take minutes, is cut short."""
    device = Rig()

    def interrupt(change: ModeChange) -> None:
        if change.mode in (Mode.RUN, Mode.RAMP):
            os.kill(os.getpid(), signal.SIGTERM)

    run = short(
        device,
        60.0,
        on_change=interrupt,
        safety=Safety(settle=5, hold=10_000, most_overruns=10_000, ramp=100_000),
    )
    assert [change.cause for change in run.changes][-2:] == [
        Cause.STOP_REQUESTED,
        Cause.ZERO_REQUESTED,
    ]
    assert device.written[-4:] == [0.0] * 4
    assert device.written[-5] != 0.0


def test_ctrl_c_after_the_run_loses_nothing_of_the_record(tmp_path: Path) -> None:
    """Ctrl-C while the last rows are written changes nothing: the run is over."""

    class Slow(MemorySink):
        def close(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.1)

    run = short(Rig(), telemetry=[Slow(), tmp_path / "run.csv"])
    assert run.completed
    assert len(load(tmp_path / "run.csv")) == len(run.record)


def test_a_disk_without_room_for_a_record_is_named_before_the_loop_begins() -> None:
    """In a line; the device is closed, and nothing was written to it."""

    class Full(MemorySink):
        name = "run.csv"

        def open(self, header: Any) -> None:
            raise OSError(28, "No space left on device")

    device = Rig()
    expected = r"telemetry = 'run.csv': can't be written \(No space left on device\)"
    with pytest.raises(ValueError, match=expected):
        short(device, telemetry=[Full()])
    assert not device.written
    assert device.closed


def test_nothing_is_written_to_a_device_before_the_loop_can_go_on() -> None:
    """The first write may start a watchdog: it comes after compiling and opening files."""
    happened: list[str] = []

    class Watched(Rig):
        def write(self, u: float) -> None:
            happened.append("written")
            super().write(u)

    class Slow(MemorySink):
        def open(self, header: Any) -> None:
            happened.append("opened")
            super().open(header)

    short(Watched(), telemetry=[Slow()])
    assert happened[:2] == ["opened", "written"]


def test_a_driver_that_fails_leads_to_the_safe_action() -> None:
    """An error in read or write ends the run with a ramp; the notes name it."""

    class Failing(Rig):
        def read(self) -> float:
            if len(self.written) > 20:
                raise RuntimeError("cable out")
            return super().read()

    device = Failing()
    run = short(device, 60.0, safety=Safety(settle=5, hold=3, most_overruns=10_000, ramp=10))
    assert run.changes[-2].cause in (Cause.LOST, Cause.STALLED)
    assert any("'cable out'" in note for note in run.notes)
    assert device.written[-1] == 0.0


@pytest.mark.parametrize(
    ("counted", "said"),
    [
        ({}, "the device gave no measurement, or none that is a number, for 0."),
        ({"not_finite": 0, "stale": 2}, "no packet of the device came in time for 0."),
        ({"not_finite": 7, "stale": 0}, "7 packets of the run had a value that is not finite"),
    ],
)
def test_a_run_that_ends_without_measurements_says_what_came(
    counted: dict[str, int], said: str
) -> None:
    """Silence for 20 samples is no wrong value; counters of before the run do not count."""

    class Silent(Rig):
        def __init__(self) -> None:
            super().__init__()
            self.counters |= dict.fromkeys(counted, 5)

        def read(self) -> float:
            y = super().read()
            if 30 <= len(self.written) < 50:
                for name, count in counted.items():
                    self.counters[name] = 5 + count
                return math.nan
            return y

    safety = Safety(settle=5, hold=3, most_overruns=10_000, ramp=10)
    run = short(Silent(), 60.0, safety=safety)
    assert run.changes[-2].cause in (Cause.LOST, Cause.STALLED)
    (note,) = (each for each in run.notes if said in each)
    found = re.search(r"\((\d+) samples\)", note)
    assert found is not None
    assert 4 <= int(found[1]) <= 60


def test_a_driver_that_hangs_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """A call that does not return: the device is closed by the main thread."""
    monkeypatch.setattr("quell.realtime.run._HUNG", 0.2)
    monkeypatch.setattr("quell.realtime.run._HUNG_SAMPLES", 1.0)
    release = threading.Event()

    class Hanging(Rig):
        def read(self) -> float:
            if len(self.written) > 20:
                release.wait(60.0)
            return super().read()

    device = Hanging()
    with pytest.raises(ConnectionError, match=r"device: read\(\) or write\(\) did not return for"):
        short(device, 60.0)
    assert device.closed >= 1
    release.set()


def test_an_error_in_on_change_ends_the_run_safely() -> None:
    """The loop ramps down and the device is closed before the error is passed on."""
    device = Rig()

    def listen(change: ModeChange) -> None:
        raise BrokenPipeError("nobody reads")

    with pytest.raises(BrokenPipeError, match="nobody reads"):
        short(device, 60.0, on_change=listen)
    assert device.closed >= 1
    assert device.written[-1] == 0.0


def test_an_error_in_the_loops_thread_comes_out_of_it() -> None:
    """An error other than the driver's is raised in the main thread; the device is closed."""

    class Exiting(Rig):
        def read(self) -> float:
            if len(self.written) > 10:
                raise SystemExit(3)
            return super().read()

    device = Exiting()
    with pytest.raises(SystemExit):
        short(device, 60.0)
    assert device.closed >= 1


def test_a_run_may_be_made_from_another_thread() -> None:
    """Signals are not handled there; everything else is the same."""
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.append(short(Rig())))
    thread.start()
    thread.join()
    assert found[0].completed


@cases(
    ("options", "message"),
    [
        ({"priority": 100}, "priority = 100: must be a whole number from 0 to 99"),
        ({"cpu": 10_000}, "cpu = 10000: must be one of"),
        ({"spin": -1.0}, "spin = -1.0"),
        ({"approach": math.nan}, "approach = nan"),
        ({"duration": None}, "duration = None"),
        ({"telemetry": ["run.txt"]}, "must end in .csv or .mcap"),
        ({"telemetry": "run.csv"}, "telemetry = 'run.csv': must be a list"),
    ],
)
def test_what_is_out_of_range_is_named_and_the_device_closed(
    options: dict[str, Any], message: str
) -> None:
    """Nothing is written, and the caller need not clean up."""
    device = Rig()
    with pytest.raises(ValueError, match=message):
        short(device, **options)
    assert not any(device.written)
    assert device.closed == 1


def test_a_device_of_another_sample_time_is_refused() -> None:
    """So are objects that are not a device or not a controller."""
    with pytest.raises(
        ValueError, match=r"device has dt = 0.02 s, the controller 0.01 s: must be the same"
    ):
        short(TwinDevice(PLANT, 0.02))
    with pytest.raises(
        ValueError, match=r"device = 3: must have read\(\), write\(u\) and close\(\)"
    ):
        short(3)
    with pytest.raises(ValueError, match="controller = 3: must be a controller"):
        run_rig(Rig(), 3, 1.0, duration=1.0)


def test_the_scenarios_own_disturbances_are_left_to_the_rig() -> None:
    """A scenario made for simulation can be run; a note says what is ignored."""
    scenario = ql.Scenario(
        1.0, 0.1, disturbances=(1.0,), noise=ql.signals.BandLimitedNoise(1e-6, DT)
    )
    run = run_rig(Rig(), adrc(), scenario, safety=PATIENT, priority=0)
    assert any("the rig has its own" in note for note in run.notes)


def test_real_time_scheduling_that_is_not_permitted_is_noted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One note for each refusal, with a remedy; the run goes on."""

    def refuse(*_: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    monkeypatch.setattr("quell.realtime.system._mlockall", lambda flags: -1)
    monkeypatch.setattr("quell.realtime.system._LATENCY", "/dev/no such file")
    interval = sys.getswitchinterval()
    with real_time_process(50, interpreted=True) as notes:
        assert sys.getswitchinterval() < interval
        assert not gc.isenabled()
        enter_real_time(50, 0, notes)
    assert sys.getswitchinterval() == pytest.approx(interval)
    assert gc.isenabled()
    assert [note.split(" ", 2)[0] for note in notes] == ["memory", "processors", "the", "priority"]
    assert "run as root, or raise ulimit -r to 50" in notes[3]
    assert checked_cpu(None) is None
