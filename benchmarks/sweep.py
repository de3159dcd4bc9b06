"""Time and memory of a sweep, and a sweep on a cluster that loses a worker.

    python benchmarks/sweep.py [--runs 1000000] [--workers 2] [--executor processes]
    python benchmarks/sweep.py --cluster [--runs 10000]

Each run has 3000 samples: an ADRC with a model-free ESO of the fourth order on a two-mass-spring
system with random masses and stiffness, a step of the reference and a load; three measures of it
are stored. ``--noise`` adds measurement noise, drawn anew for each run. Memory is that of the
process and its workers together: PSS counts a page that several of them share once, RSS once for
each.

With ``--cluster`` a Dask scheduler and two worker processes are started as docs/scale_cluster does
it by hand. One of them is killed (SIGKILL) after a quarter of the runs. The results must be those
of this machine's processes, bit for bit.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from measured import options_of, parser_of, write

from quell.setup import made
from quell.setup.sweeps import sweep_of
from quell.sweeping import Sweep, sweep

SETUP = {
    "dt": 0.01,
    "plant": {"kind": "two-mass"},
    "observer": {"kind": "model-free", "order": 4, "b0": 1.5, "omega_o": 10.0},
    "controller": {"omega_c": 1.0},
    "scenario": {
        "duration": 29.99,
        "reference": 1.0,
        "disturbances": [0.0, {"kind": "step", "height": 0.1, "at": 15.0}],
    },
    "sweep": {
        "seed": 1,
        "metrics": ["peak_error", "iae", "control_variation"],
        "parameters": {
            "plant.m1": {"low": 0.6, "high": 1.4},
            "plant.m2": {"low": 0.6, "high": 1.4},
            "plant.k": {"low": 0.8, "high": 1.25, "log": True},
        },
    },
}
NOISE = {"kind": "noise", "power": 1e-12, "sample_time": 0.01}


class Memory(threading.Thread):
    """A thread that watches the memory of this process and its children [MB]."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.pss = self.rss = 0.0

    def run(self) -> None:
        """Watch twice a second."""
        while True:
            found = [self._of(pid) for pid in (os.getpid(), *self._children())]
            self.pss = max(self.pss, sum(pss for pss, _ in found))
            self.rss = max(self.rss, sum(rss for _, rss in found))
            time.sleep(0.5)

    @staticmethod
    def _children() -> list[int]:
        listed = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
        return [int(pid) for pid in listed]

    @staticmethod
    def _of(pid: int) -> tuple[float, float]:
        try:
            text = Path(f"/proc/{pid}/smaps_rollup").read_text()
        except OSError:  # it has just ended
            return 0.0, 0.0
        kilobytes = dict(re.findall(r"^(Pss|Rss):\s+(\d+) kB", text, re.MULTILINE))
        return int(kilobytes.get("Pss", 0)) / 1024.0, int(kilobytes.get("Rss", 0)) / 1024.0


def arguments(runs: int, noise: bool) -> dict[str, object]:
    """Return the arguments of the sweep."""
    scenario = SETUP["scenario"] | ({"noise": NOISE} if noise else {})
    table = SETUP["sweep"] | {"draws": runs}
    return sweep_of(made("sweep.toml", SETUP | {"scenario": scenario, "sweep": table}))


def timed(options: argparse.Namespace, folder: Path) -> dict[str, object]:
    """Do a sweep, print and return its time and memory."""
    watch = Memory()
    watch.start()
    before, began = os.times(), time.perf_counter()
    given = arguments(options.runs, options.noise)
    result = sweep(**given, folder=folder, executor=options.executor, workers=options.workers)
    elapsed, after = time.perf_counter() - began, os.times()
    pss, rss = watch.pss, watch.rss
    used = sum(after[:4]) - sum(before[:4])
    failures = int(np.sum(result.dataset["status"].values != 0))
    files = [path.stat().st_size for path in folder.iterdir()]
    print(f"{options.runs} runs on {options.workers} {options.executor}: {failures} with flags")
    print(f"time      {elapsed:8.1f} s, {options.runs / elapsed:.0f} runs/s")
    print(f"processor {used:8.1f} s, {1e3 * used / options.runs:.3f} ms a run")
    print(f"memory    {pss:8.0f} MB (PSS), {rss:.0f} MB (RSS)")
    print(f"disk      {sum(files) / 1e6:8.1f} MB in {len(files)} files")
    for run in np.random.default_rng(0).integers(0, options.runs, 20).tolist():
        alone = result.repeat(run).metrics()
        stored = result.dataset.isel(run=run)
        same = all(stored[name].item() == alone[name] for name in result.store.measures)
        assert same, f"run {run} differs from the run alone"
    return {
        "runs": options.runs,
        "with flags": failures,
        "seconds": elapsed,
        "runs a second": options.runs / elapsed,
        "processor time of a run [ms]": 1e3 * used / options.runs,
        "PSS [MB]": pss,
        "RSS [MB]": rss,
        "disk [MB]": sum(files) / 1e6,
    }


def on_cluster(options: argparse.Namespace, folder: Path) -> dict[str, object]:
    """Do a sweep here and on two workers, one of which is killed, and compare all bits."""
    given = arguments(options.runs, options.noise)
    local = sweep(**given, folder=folder / "here", executor="processes", workers=2)
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker"]
    address = f"tcp://127.0.0.1:{options.port}"
    where = ["--host", "127.0.0.1", "--no-dashboard"]
    local_folder = ["--local-directory", str(folder), "--no-dashboard"]
    each = [*worker, address, "--nthreads", "1", "--no-nanny", *where[:2], *local_folder]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
    processes = [subprocess.Popen([*dask, "--port", str(options.port), *where], **quiet)]
    time.sleep(5.0)
    processes += [subprocess.Popen(each, **quiet) for _ in range(2)]
    killed: list[int] = []

    def kill(share: float) -> None:
        if share > 0.25 and not killed:
            killed.append(processes[1].pid)
            os.kill(killed[0], signal.SIGKILL)
            print(f"worker {killed[0]} killed after {100.0 * share:.0f} % of the runs")

    try:
        began = time.perf_counter()
        remote = sweep(**given, folder=folder / "there", executor=address, progress=kill)
        took = time.perf_counter() - began
        print(f"{options.runs} runs on the cluster: {took:.1f} s")
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait()
    assert killed
    assert remote.missing == 0
    compare(local, remote)
    return {"runs": options.runs, "seconds": took, "missing": remote.missing}


def compare(one: Sweep, other: Sweep) -> None:
    """Print whether two sweeps have the same bits."""
    names = [str(name) for name in one.dataset.variables if name != "message"]
    same = {
        name: one.dataset[name].values.tobytes() == other.dataset[name].values.tobytes()
        for name in names
    }
    print(f"equal bit for bit: {all(same.values())} ({', '.join(names)})")
    assert all(same.values()), same


def main() -> None:
    """Do what the options say."""
    parser = parser_of(__doc__)
    parser.add_argument("--runs", type=int)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--executor", default="processes", choices=["processes", "threads"])
    parser.add_argument("--noise", action="store_true")
    parser.add_argument("--cluster", action="store_true")
    parser.add_argument("--port", type=int, default=8786)
    options = options_of(parser, runs=100, workers=1, executor="threads")
    options.runs = options.runs or (10_000 if options.cluster else 1_000_000)
    with tempfile.TemporaryDirectory() as folder:
        if options.cluster:
            figures = on_cluster(options, Path(folder))
        else:
            figures = timed(options, Path(folder) / "runs")
    write(options, figures)


if __name__ == "__main__":
    main()
