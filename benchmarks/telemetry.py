"""Cost of telemetry: writing a row, the delay of a loop in Python, and the loss after a kill.

    python benchmarks/telemetry.py [SECONDS]

A loop in Python shares the interpreter with the writer's thread, a compiled loop does not. The
benchmark measures the first, which is the worse case.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from measured import options_of, parser_of, write

from quell.realtime import CsvSink, LiveSink, McapSink
from quell.realtime.recordings import Header, MemorySink, file_sink, load, row_channels
from quell.realtime.telemetry import TelemetryWriter, push

CHANNELS = row_channels(
    (("x_hat", 4), ("f_residual", 1), ("f_learned", 1), ("status", 1), ("theta", 9))
)


def rows_like_a_loops(count: int) -> np.ndarray:
    """Return random rows; the numbers have all their digits, like estimates."""
    rows = np.random.default_rng(1).standard_normal((count, sum(width for _, width in CHANNELS)))
    rows[:, 0] = np.arange(count)
    rows[:, 3:5] = 0.0
    return rows


def cost(folder: Path) -> dict[str, Any]:
    """Print and return the processor time of the writer for each row."""
    figures: dict[str, Any] = {}
    rows = rows_like_a_loops(20_000)
    for sink in (
        MemorySink(),
        CsvSink(folder / "cost.csv"),
        McapSink(folder / "cost.mcap"),
        LiveSink(0),
    ):
        sink.open(Header(CHANNELS, 1e-3))
        started = time.process_time()
        for first in range(0, len(rows), 10):
            sink.write(rows[first : first + 10])
        sink.flush()
        took = time.process_time() - started
        sink.close()
        size = sink.path.stat().st_size / len(rows) if hasattr(sink, "path") else 0
        print(
            f"{type(sink).__name__:10s} {took / len(rows) * 1e6:6.2f} µs a row of "
            f"{rows.shape[1]}, {size:4.0f} bytes"
        )
        figures[type(sink).__name__] = {"a row [us]": took / len(rows) * 1e6, "bytes": size}
    return figures


def lateness(folder: Path, seconds: float) -> dict[str, Any]:
    """Print and return the lateness of a loop in Python at 1 kHz, without and with telemetry."""
    header = Header(CHANNELS, 1e-3)
    rows = rows_like_a_loops(round(seconds * 1000))
    kinds = {
        "no sink": [],
        "csv": [CsvSink(folder / "late.csv")],
        "mcap": [McapSink(folder / "late.mcap")],
        "csv, mcap, live": [
            CsvSink(folder / "all.csv"),
            McapSink(folder / "all.mcap"),
            LiveSink(0),
        ],
    }
    figures: dict[str, Any] = {}
    for name, sinks in kinds.items():
        late = np.empty(len(rows))
        with TelemetryWriter(header, sinks, urgent=True) as telemetry:
            in_front(True)
            start = time.perf_counter() + 0.01
            for k, row in enumerate(rows):
                time.sleep(max(start + k * 1e-3 - time.perf_counter(), 0.0))
                late[k] = time.perf_counter() - start - k * 1e-3
                push(telemetry.ring, row)
            in_front(False)
        shares = np.percentile(late, [50, 99, 99.9, 100]) * 1e6
        print(
            f"{name:16s} lateness p50 {shares[0]:.0f}, p99 {shares[1]:.0f}, p99.9 "
            f"{shares[2]:.0f}, max {shares[3]:.0f} µs"
        )
        figures[name] = dict(zip(("p50", "p99", "p99.9", "max"), shares, strict=True))
    return figures


def in_front(wanted: bool) -> None:
    """Set or reset the real-time priority of the loop's thread, if this is permitted."""
    policy, priority = (os.SCHED_FIFO, 50) if wanted else (os.SCHED_OTHER, 0)
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except OSError as error:
        print(f"no real-time priority ({error.strerror}): other processes affect the results")


def produce(dt: float, *paths: str) -> None:
    """Push rows until the process is killed, and write the index of each to the standard output."""
    telemetry = TelemetryWriter(Header(CHANNELS, dt), [file_sink(path) for path in paths])
    telemetry.start()
    row, start = np.zeros(telemetry.header.width), time.monotonic()
    for k in range(10**9):
        time.sleep(max(start + k * dt - time.monotonic(), 0.0))
        row[0] = k
        push(telemetry.ring, row)
        os.write(1, k.to_bytes(8, "little"))


def killed(folder: Path, trials: int) -> dict[str, Any]:
    """Print and return the largest and mean loss after ``kill -9``."""
    rng, figures = np.random.default_rng(2), dict[str, Any]()
    for dt in (1e-3, 0.1):
        lost: dict[str, list[float]] = {".csv": [], ".mcap": []}
        for trial in range(trials):
            paths = [folder / f"killed-{dt}-{trial}{suffix}" for suffix in lost]
            process = subprocess.Popen(
                [sys.executable, __file__, "produce", str(dt), *map(str, paths)],
                stdout=subprocess.PIPE,
            )
            assert process.stdout is not None
            process.stdout.read(8)
            time.sleep(1.5 + rng.random())
            process.send_signal(signal.SIGKILL)
            said = process.stdout.read()
            process.wait()
            last = int.from_bytes(said[len(said) // 8 * 8 - 8 :][:8], "little")
            for path in paths:
                lost[path.suffix].append((last - load(path)["k"][-1]) * dt)
        for suffix, seconds in lost.items():
            print(
                f"killed at {1 / dt:g} Hz: {suffix[1:]} lost {max(seconds):.3f} s at most, "
                f"{np.mean(seconds):.3f} s on average of {trials}"
            )
            figures[f"{suffix[1:]} at {1 / dt:g} Hz"] = {
                "lost at most [s]": max(seconds),
                "on average [s]": np.mean(seconds),
            }
    return figures


def main() -> None:
    """Measure all three."""
    parser = parser_of(__doc__)
    parser.add_argument("seconds", type=float, nargs="?", default=10.0, help="of each loop")
    parser.add_argument("--trials", type=int, default=8, help="processes to kill")
    options = options_of(parser, seconds=0.3, trials=1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        figures = {
            "cost": cost(folder),
            "lateness [us]": lateness(folder, options.seconds),
            "killed": killed(folder, options.trials),
        }
    write(options, figures)


if __name__ == "__main__":
    if sys.argv[1:2] == ["produce"]:
        produce(float(sys.argv[2]), *sys.argv[3:])
    main()
