"""Test of the real-time loop with random faults: frames on the wire, stalls and kills of processes.

    python benchmarks/faults.py                # 200 trials over UDP, on an idle machine: 15 minutes
    python benchmarks/faults.py --trials 20 --seed 7 --json faults.json

Each trial runs a loop in one process, a twin in another, and a relay between them. It checks:

* the wire: every command in the rig's log is finite and within the limits;
* the loop: after more than ``hold`` deadlines in a row without a good sample, or another violation
  of its rules, u goes to zero in ``ramp`` samples and stays there; otherwise the loop runs to its
  end. The record is checked here independently of the supervisor;
* the rig: when the loop is killed, or silent for ``watchdog`` ticks, u is zero from that tick on;
  at the end it is always zero;
* telemetry: after a kill both files are readable and lack at most the last second; otherwise they
  are complete.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

import quell as ql
from quell.files import nonfinite_to_none, write_json
from quell.realtime import Safety, load, open_device, run_rig
from quell.realtime.loop.modes import Cause, Mode
from quell.realtime.loop.supervisor import FLUSH
from quell.realtime.rig.fault_injection import KINDS, Fault, Relay
from quell.realtime.rig.kernel import LIVE, LOG

DT, WATCHDOG, LIMIT = 1e-3, 20, 5.0
SECONDS = 1.5
SAFETY = Safety(hold=5, ramp=50, settle=100, most_error=3.0)
TROUBLES = (
    *KINDS,
    "stall the loop",
    "stall the rig",
    "kill the loop",
    "kill the rig",
    "interrupt the loop",
)


def controller() -> ql.ADRC:
    """Return an L-ESO that is often at its limits, because the reference is too fast for it."""
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=40.0, dt=DT)
    return ql.ADRC(
        observer,
        omega_c=4.0,
        learner=ql.learners.Kalman(),
        guard=ql.Guard(),
        u_min=-LIMIT,
        u_max=LIMIT,
    )


class RigProcess:
    """The twin in its own process, with its log. It serves all trials until it is killed."""

    def __init__(self, folder: Path, number: int) -> None:
        self.log = folder / f"rig-{number}.csv"
        command = [
            sys.executable,
            "-m",
            "quell",
            "rig",
            "--device",
            "udp://127.0.0.1:0",
            "--plant",
            "two-mass",
            "--dt",
            str(DT),
        ]
        self.process = subprocess.Popen(
            [*command, "--watchdog", str(WATCHDOG), "--log", str(self.log)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().partition(" at ")[2].partition(": ")[0]
        self._seen = 0

    def rows(self) -> np.ndarray:
        """Return the rows of the log since the last call, with the columns of ``LOG``."""
        time.sleep(0.2)  # the log is written every 50 ms
        with self.log.open(encoding="utf-8") as file:
            file.seek(self._seen)
            text = file.read()
        whole = text[: text.rfind("\n") + 1]
        self._seen += len(whole.encode())
        return np.array(
            [
                [float(part) for part in line.split(",")]
                for line in whole.splitlines()
                if line[0].isdigit()
            ]
        ).reshape(-1, len(LOG))

    def end(self) -> None:
        """Stop the process."""
        self.process.terminate()
        self.process.wait()


def loop(url: str, folder: Path) -> None:
    """Run the loop and write its results; this is the child process of a trial."""
    device = open_device(url, DT)
    files = [folder / "run.csv", folder / "run.mcap"]
    run = run_rig(
        device,
        controller(),
        ql.signals.Sinusoid(omega=3.0),
        duration=SECONDS,
        safety=SAFETY,
        approach=0.2,
        telemetry=files,
    )
    told = {
        "changes": [(change.t, change.mode, change.cause) for change in run.changes],
        "tally": run.tally._asdict(),
    }
    write_json(
        folder / "run.json",
        told | {"completed": run.completed, "verdict": run.verdict, "notes": list(run.notes)},
    )


def warm_up(url: str) -> None:
    """Compile or load the loop once; the trials are forked from this process."""
    run_rig(
        open_device(url, DT),
        controller(),
        ql.signals.Sinusoid(omega=3.0),
        duration=0.2,
        safety=SAFETY,
        approach=0.2,
    )


def trial(number: int, rig: RigProcess, folder: Path, draw: random.Random) -> dict[str, Any]:
    """Run and check one trial."""
    kind = draw.choice(TROUBLES)
    first, many = draw.randint(150, 1200), max(round(500 ** draw.random()), 1)
    towards, late = draw.choice(("loop", "rig")), draw.randint(1, 10)
    faults = [Fault(kind, towards, first, many, late)] if kind in KINDS else []
    about = {
        "trial": number,
        "kind": kind,
        "towards": towards if faults else "",
        "at": first,
        "length": many,
    }
    rig.rows()
    with Relay("udp://127.0.0.1:0", rig.url, faults, seed=number) as relay:
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                loop(relay.url, folder)
                code = 0
            except BaseException as error:
                (folder / "error.txt").write_text(repr(error), encoding="utf-8")
            finally:
                os._exit(code)
        killed = disturb(kind, pid, rig, relay, first, many)
        _, status = os.waitpid(pid, 0)
    log = rig.rows()
    dead_rig = rig.process.poll() is not None
    return about | judged(
        folder, log, loop_killed=killed and os.WIFSIGNALED(status), rig_killed=dead_rig
    )


def disturb(kind: str, pid: int, rig: RigProcess, relay: Relay, first: int, many: int) -> bool:
    """Stall, kill or interrupt a process; return whether the loop was killed."""
    if kind in KINDS:
        return False
    deadline = time.monotonic() + 20.0
    # Wait until ``first`` commands have passed.
    while relay.passed["rig"] < first and time.monotonic() < deadline:
        time.sleep(0.001)
    whom = rig.process.pid if kind.endswith("the rig") else pid
    if kind.startswith("stall"):
        os.kill(whom, signal.SIGSTOP)
        time.sleep(many * 1e-3)
        os.kill(whom, signal.SIGCONT)
    elif kind.startswith("kill"):
        os.kill(whom, signal.SIGKILL)
        if whom != pid:
            rig.process.wait()
    else:
        os.kill(whom, signal.SIGINT)
    return kind == "kill the loop"


def judged(folder: Path, log: np.ndarray, *, loop_killed: bool, rig_killed: bool) -> dict[str, Any]:
    """Return the errors found and how the trial ended."""
    wrong = judge_wire(log, rig_killed)
    found: dict[str, Any] = {"ended": "the loop was killed", "wrong": wrong}
    files = [folder / "run.csv", folder / "run.mcap"]
    if loop_killed:
        found["lost"] = [judge_loss(path, log, wrong) for path in files]
    elif (folder / "error.txt").exists():
        wrong.append(f"the loop raised {(folder / 'error.txt').read_text(encoding='utf-8')}")
    else:
        told = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        found["ended"] = (
            Cause(told["changes"][-2][2]).name
            if len(told["changes"]) > 1
            else Cause(told["changes"][-1][2]).name
        )
        for path in files:
            judge_record(path, told, wrong)
    return found


def judge_wire(log: np.ndarray, rig_killed: bool) -> list[str]:
    """Return the errors in the rig's log."""
    wrong: list[str] = []
    state, u, command = (log[:, LOG.index(name)] for name in ("state", "u", "command"))
    came = command[np.isfinite(command)]
    if came.size == 0:
        wrong.append("no command arrived")
    if np.any(np.abs(came) > LIMIT) or np.any(np.abs(u) > LIMIT) or not np.all(np.isfinite(u)):
        wrong.append(
            f"u of {max(np.max(np.abs(came), initial=0.0), np.max(np.abs(u))):g} on the wire"
        )
    if np.any(u[state != LIVE] != 0.0):
        wrong.append("u was not zero without a live session")
    silent = 0
    for k in range(log.shape[0]):
        silent = 0 if np.isfinite(command[k]) else silent + 1
        if silent >= WATCHDOG and u[k] != 0.0:
            wrong.append(f"u = {u[k]:g} after {silent} ticks without a command")
            break
    if not rig_killed and (log.shape[0] == 0 or u[-1] != 0.0 or state[-1] == LIVE):
        wrong.append("u did not end at zero")
    session = log[:, LOG.index("session")]
    if any(
        np.any(np.diff(state[(session == one) & (state >= LIVE)]) < 0) for one in np.unique(session)
    ):
        wrong.append("a tripped session became live again")
    return wrong


def judge_loss(path: Path, log: np.ndarray, wrong: list[str]) -> float:
    """Return the time that is missing at the end of a killed loop's record [s]."""
    command = log[:, LOG.index("command")]
    commands = int(
        np.flatnonzero(np.isfinite(command))[-1] - np.flatnonzero(np.isfinite(command))[0]
    )
    try:
        last = load(path)["k"][-1]
    except ValueError as error:
        if "has no row" not in str(error):
            wrong.append(f"{path.name} cannot be read: {error}")
            return math.nan
        last = -1.0  # killed before the first row was written: the whole record is lost
    lost = (commands - last) * DT
    if lost > 1.0:
        wrong.append(f"{path.name} lacks the last {lost:.2f} s")
    return float(lost)


def judge_record(path: Path, told: dict[str, Any], wrong: list[str]) -> None:
    """Check a complete record against the rules, independently of the supervisor."""
    record = load(path)
    mode, u, good = record["mode"].astype(int), record["u"], np.isfinite(record["y_measured"])
    if np.any(np.abs(u) > LIMIT) or not np.all(np.isfinite(u)):
        wrong.append(f"{path.name}: u beyond its limits")
    if mode[-1] != Mode.STOPPED or u[-1] != 0.0:
        wrong.append(f"{path.name}: u did not end at zero")
    if (
        len(record) - np.count_nonzero(record["events"].astype(int) >> 16 & 1)
        != told["tally"]["cycles"]
    ):
        wrong.append(
            f"{path.name}: {told['tally']['cycles']} cycles, {len(record)} rows with gaps filled"
        )
    blind = 0
    for k in range(len(record)):
        blind = 0 if good[k] else blind + 1
        if blind > SAFETY.hold + 1 and mode[k] < Mode.RAMP and not record["events"][k] >= 1 << 16:
            wrong.append(f"{path.name}: {blind} samples without a measurement, and no ramp")
            break
    down = np.flatnonzero(mode >= Mode.RAMP)
    if np.any(np.diff(mode[down]) < 0) or np.any(mode[down[0] :] < Mode.RAMP):
        wrong.append(f"{path.name}: the run continued after the ramp began")
    if down.size > SAFETY.ramp + FLUSH + 1 + np.count_nonzero(
        record["events"][down].astype(int) >> 16 & 1
    ):
        wrong.append(f"{path.name}: the loop took {down.size} samples to stop")
    if np.any(np.diff(np.abs(u[down])) > 1e-12):
        wrong.append(f"{path.name}: |u| increased during the ramp")


def main() -> None:
    """Run the trials and print how they ended."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    draw = random.Random(options.seed)
    results = []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        rigs = 0
        rig = RigProcess(folder, rigs)
        try:
            warm_up(rig.url)
            for number in range(options.trials):
                if rig.process.poll() is not None:
                    rigs += 1
                    rig = RigProcess(folder, rigs)
                own = folder / str(number)
                own.mkdir()
                found = trial(number, rig, own, draw)
                results.append(found)
                if found["wrong"]:
                    print(f"{found}", flush=True)
        finally:
            rig.end()
    print(f"{'fault':<20} {'trials':>6}  ended")
    for kind in TROUBLES:
        mine = [found for found in results if found["kind"] == kind]
        ends = ", ".join(
            f"{name} {count}"
            for name, count in Counter(found["ended"] for found in mine).most_common()
        )
        print(f"{kind:<20} {len(mine):>6}  {ends}")
    lost = [part for found in results for part in found.get("lost", ())]
    if lost:
        print(f"telemetry lost by a killed loop: at most {np.nanmax(lost):.3f} s")
    bad = sum(bool(found["wrong"]) for found in results)
    print(f"{len(results)} trials, {bad} with errors")
    if options.json is not None:
        write_json(options.json, nonfinite_to_none(results))
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
