"""The rig as a process of its own, as ``quell rig`` starts it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quell.cli.rig import rig as run_rig
from quell.realtime import wire_device
from quell.realtime.registry import listen, open_device

from .cases import cases
from .commands import Shown
from .rig_bench import connect

# A tick so long that a machine with much else to do still keeps the session alive.
DT = 0.01
SETTINGS = {"dt": DT, "watchdog": 20, "u_max": 1.0, "rest": True}


@contextmanager
def rig(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a rig that runs as plain Python; yield it and what it says when it is ready."""
    command = [
        sys.executable,
        "-m",
        "quell",
        "rig",
        "--plant",
        "two-mass",
        "--dt",
        str(DT),
        "--priority",
        "0",
        *arguments,
    ]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
    ) as process:
        try:
            yield process, str(process.stdout and process.stdout.readline())
        finally:
            process.kill()


def exchanged(device: Any, count: int) -> list[float]:
    """Return what was measured in some samples, each answered."""
    measured = []
    for _ in range(count):
        measured.append(device.read())
        device.write(1.0)
    return measured


def free_port() -> int:
    """Return a UDP port that is free now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@pytest.mark.trial
def test_a_rig_that_is_killed_is_noticed_and_its_successor_runs_until_it_is_told_to_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loop gets no more numbers, and nothing stays in the way of the next rig.

    That one prints a line when it is ready and its counts at the end, with exit code 0; each tick is
    in the log.
    """
    url = f"udp://127.0.0.1:{free_port()}"
    with rig("--device", url, "--watchdog", "200") as (process, _), open_device(url, DT) as device:
        exchanged(device, 3)
        process.kill()
        process.wait()
        monkeypatch.setattr(wire_device, "_MOST_AGE", 10)  # how long it waits for a measurement
        device.read()
        assert np.isnan(device.read())
    with pytest.raises(ConnectionError, match="start one with: quell rig"):
        connect(url, timeout=0.3)
    log = tmp_path / "wire.csv"
    settings = ("--log", str(log), "--u-max", "0.5", "--watchdog", "200")
    with rig("--device", url, *settings) as (process, ready):
        assert ready.startswith(f"two-mass at {url}: a tick every 0.01 s")
        with open_device(url, DT) as device:
            assert np.isfinite(exchanged(device, 20)).all()
        process.send_signal(signal.SIGTERM)
        said, errors = process.communicate(timeout=60)
        assert process.returncode == 0
    assert errors == ""
    assert "sessions: 1" in said
    assert "largest |u| 1, cut to the limit: 1" in said
    assert "frames that were not accepted:" in said
    rows = np.genfromtxt(log, delimiter=",", names=True)
    assert np.array_equal(rows["tick"], np.arange(rows.size))
    assert f"ticks: {rows.size}" in said
    assert np.nanmax(rows["u"]) == 0.5
    assert np.nanmax(rows["command"]) == 1.0


@pytest.mark.trial
def test_a_loop_that_is_killed_leaves_u_at_zero(tmp_path: Path) -> None:
    """The watchdog sees to it, within the ticks it was given; the next loop is served."""
    log = tmp_path / "wire.csv"
    with rig("--device", "udp://127.0.0.1:0", "--log", str(log), "--watchdog", "30") as (
        process,
        ready,
    ):
        assert ready.startswith("two-mass at udp://127.0.0.1:")
        url = ready.split()[2].rstrip(":")
        loop = f"""
import os, signal
from quell.realtime import open_device
device = open_device({url!r}, {DT})
for _ in range(5):
    device.read()
    device.write(1.0)
os.kill(os.getpid(), signal.SIGKILL)
"""
        plain = os.environ | {"NUMBA_DISABLE_JIT": "1"}
        ended = subprocess.run([sys.executable, "-c", loop], check=False, env=plain)
        assert ended.returncode == -signal.SIGKILL
        with open_device(url, DT) as device:
            exchanged(device, 3)
        process.send_signal(signal.SIGINT)
        assert "ended by the watchdog: 1" in process.communicate(timeout=60)[0]
        assert process.returncode == 0
    rows = np.genfromtxt(log, delimiter=",", names=True)
    last = np.flatnonzero(
        np.isfinite(rows["command"]) & (rows["session"] == rows["session"][rows["session"] > 0][0])
    )[-1]
    assert np.all(rows["u"][last : last + 30] == 1.0)
    assert rows["u"][last + 30] == 0.0
    assert rows["state"][last + 30] == 3


def test_bad_input_is_a_line_and_exit_code_2(quell: Callable[..., Shown]) -> None:
    """Before anything is opened."""
    shown = quell("rig", "--plant", "two-mass", "--dt", "0.01", "--device", "udp://127.0.0.1")
    assert (shown.out, shown.code, shown.err.count("\n")) == ("", 2, 1)
    assert "must be udp://HOST:PORT" in shown.err


@cases(
    ("changed", "message"),
    [
        ({"device": "tcp://x"}, "must be like udp://"),
        ({"plant": "moon"}, "--plant = 'moon'"),
        ({"log": Path("/nowhere/x.csv")}, "log = '/nowhere/x.csv': can't be written"),
        ({"seconds": -1.0}, "--seconds = -1.0"),
        ({"priority": 100}, "priority = 100"),
        ({"dt": 0.0}, "dt = 0.0"),
        ({"watchdog": 0}, "watchdog = 0"),
    ],
)
def test_what_is_wrong_is_named(
    changed: dict[str, Any], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is printed that would look like a rig."""
    given = {
        "device": "udp://127.0.0.1:0",
        "plant": "two-mass",
        "seconds": 1.0,
        "priority": 0,
    }
    with pytest.raises(ValueError) as raised:
        run_rig(**{**given, **SETTINGS, **changed})
    assert message in str(raised.value)
    assert capsys.readouterr().out == ""


def test_a_port_that_is_taken_is_named() -> None:
    """The second rig does not start."""
    with (
        closing(listen("udp://127.0.0.1:0")) as first,
        pytest.raises(ValueError, match="can't listen there"),
    ):
        run_rig(device=first.url, plant="two-mass", seconds=1.0, priority=0, **SETTINGS)
