"""Timing of the real-time loop at 1 kHz, and the effect of the wire on the control performance.

    python benchmarks/rig.py                              # 60 s over UDP, on an idle machine
    python benchmarks/rig.py --seconds 10 --spin 0.0001
    python benchmarks/rig.py --load 4                     # beside four programs that compute
    python benchmarks/rig.py --load 4 --wait 0.1          # the rig waits for late commands

The twin runs in another process. A C program that only sleeps until each deadline (``wakeup.c``)
runs before the loop and shows the limit of the machine. On a virtual machine whose host takes the
processors away for milliseconds both are late.

The second part prints the metrics of the same scenario over the wire and in ``simulate``, with the
same delay of one sample. A device holds the last u if a command is late; ``--wait`` shows what a
simulated one gains by waiting.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from measured import options_of, parser_of, write

import quell as ql
from quell.realtime import Device, RigRun, Safety, open_device, run_rig

DT = 1e-3
# A machine of which the host takes the processors away for tenths of a second must not end the run:
# it is to show what the run is worth then. The rig's watchdog has twice this number of ticks.
HOLD = 250
PLANT = ql.plants.two_mass_spring()


def controller() -> ql.ADRC:
    """Return an L-ESO for the two-mass-spring system, as in the paper's simulation."""
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=DT)
    return ql.ADRC(
        observer,
        omega_c=1.0,
        learner=ql.learners.Kalman(),
        guard=ql.Guard(),
        u_min=-20.0,
        u_max=20.0,
    )


@contextlib.contextmanager
def rig(priority: int, wait: float) -> Iterator[str]:
    """Start ``quell rig`` in its own process; yield its URL, and print its output at the end."""
    url = "udp://127.0.0.1:0"
    command = [
        sys.executable,
        "-m",
        "quell",
        "rig",
        "--device",
        url,
        "--plant",
        "two-mass",
        "--dt",
        str(DT),
    ]
    process = subprocess.Popen(
        [
            *command,
            *("--priority", str(priority), "--wait", str(wait), "--watchdog", str(2 * HOLD)),
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        first = process.stdout.readline()
        yield first.partition(" at ")[2].partition(": ")[0]
    finally:
        process.terminate()
        print("output of the rig:", *process.stdout.read().splitlines(), sep="\n  ")
        process.wait()


def opened(url: str) -> Device:
    """Open the device; a rig on a busy machine may take seconds until it ticks."""
    for _ in range(20):
        with contextlib.suppress(ConnectionError):
            return open_device(url, DT)
    return open_device(url, DT)


def over_the_wire(
    url: str, reference: ql.signals.Signal, seconds: float, options: argparse.Namespace
) -> RigRun:
    """Run the controller over the wire."""
    return run_rig(
        *(opened(url), controller(), reference),
        duration=seconds,
        approach=0.0,
        safety=Safety(settle=500, hold=HOLD),
        spin=options.spin,
        priority=options.priority,
        on_change=lambda change: print(change, flush=True),
    )


@contextlib.contextmanager
def load(programs: int) -> Iterator[None]:
    """Keep the machine busy with programs that compute."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(programs)]
    try:
        yield
    finally:
        for program in busy:
            program.kill()
            program.wait()


def floor(seconds: float) -> np.ndarray | None:
    """Return the lateness of ``wakeup.c``, which only sleeps [s]; None without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        program = f"{folder}/wakeup"
        subprocess.run(
            [compiler, "-O2", "-o", program, str(Path(__file__).with_name("wakeup.c"))], check=True
        )
        run = subprocess.run(
            [program, str(round(1e9 * DT)), str(round(seconds / DT))],
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    return 1e-9 * np.array(run.stdout.split(), dtype=float)


def main() -> None:
    """Print histograms, counts and metrics."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--spin", type=float, default=0.0)
    parser.add_argument("--priority", type=int, default=50)
    parser.add_argument("--load", type=int, default=0, help="programs that compute meanwhile")
    parser.add_argument("--wait", type=float, default=0.0, help="quell rig --wait [s]")
    options = options_of(parser, seconds=2.0)
    reference = ql.signals.Sinusoid().until(
        0.5 * options.seconds, then=ql.signals.Step(at=0.5 * options.seconds)
    )
    with load(options.load):
        late = floor(min(options.seconds, 20.0))
        with rig(options.priority, options.wait) as url:
            run = over_the_wire(url, reference, options.seconds, options)
    print(run.text())
    print(
        f"\nno overrun: {run.overruns == 0}; p99.9 of the lateness "
        f"{1e6 * run.timing.lateness.p999:.0f} µs (limit 500)"
    )
    figures: dict[str, Any] = {
        "cycles": run.tally.cycles,
        "overruns": run.overruns,
        "lateness, p99.9 [us]": 1e6 * run.timing.lateness.p999,
        "limit of the machine": "NOT measured: no compiler",
        "metrics": "NOT compared: the run was ended early",
    }
    if late is not None:
        p50, p999 = np.percentile(late, [50.0, 99.9])
        a_minute = 60.0 / DT * np.mean(late > DT)
        print(
            f"limit of the machine (C): p50 {1e6 * p50:.0f} µs, p99.9 {1e6 * p999:.0f} µs, "
            f"max {1e6 * np.max(late):.0f} µs,",
            end=" ",
        )
        print(
            f"{a_minute:.0f} a minute later than a sample; p99.9 of the loop over that "
            f"{run.timing.lateness.p999 / p999:.2f}"
        )
        figures["limit of the machine"] = {
            "p50 [us]": 1e6 * p50,
            "p99.9 [us]": 1e6 * p999,
            "max [us]": 1e6 * np.max(late),
            "a minute later than a sample": a_minute,
            "p99.9 of the loop over p99.9": run.timing.lateness.p999 / p999,
        }
    print()
    delayed = ql.plants.delayed(PLANT, delay=DT, dt=DT)
    plain = ql.simulate(delayed, controller(), ql.Scenario(reference, options.seconds))
    if run.completed:
        step = 0.5 * options.seconds
        print(f"{'metric':<20} {'in process':>12} {'over udp':>12} {'difference':>11}")
        wire = run.metrics(step)
        figures["metrics"] = {}
        for name, value in plain.metrics(step).items():
            difference = abs(wire[name] - value) / abs(value) if value else abs(wire[name])
            print(f"{name:<20} {value:12.6g} {wire[name]:12.6g} {100 * difference:9.4f} %")
            figures["metrics"][name] = {
                where: each if np.isfinite(each) else "not reached"
                for where, each in (("in process", value), ("over udp", wire[name]))
            }
    write(options, figures)


if __name__ == "__main__":
    main()
