"""Test of the real-time loop with random faults: on the wire, of processes, disks and clients.

    python benchmarks/faults.py                # 1000 trials over both wires: about an hour
    python benchmarks/faults.py --trials 30 --seed 7 --wires udp --results faults.json

With ``--results`` the file is written after each trial; trials that it has already are not
repeated, so the same command goes on where it was stopped.

Each trial runs a loop in one process, a twin in another, and a relay between them. It checks:

* the wire: every command in the rig's log is finite and within the limits;
* the loop: after more than ``hold`` deadlines in a row without a good sample, or another violation
  of its rules, u goes to zero in ``ramp`` samples and stays there; otherwise the loop runs to its
  end. The record is checked here independently of the supervisor;
* the rig: when the loop is killed, or silent for ``watchdog`` ticks, u is zero from that tick on;
  at the end it is always zero;
* telemetry: after a kill both files are readable and lack at most the last second; on a full disk
  they are readable, and the run goes on and says so; otherwise they are complete, whatever idle or
  slow clients of the live port do.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from fault_judges import DELAY, DT, LIMIT, SAFETY, WATCHDOG, judged
from fault_relay import WIRES, relay, rig_url
from frame_faults import KINDS, Fault
from measured import options_of, parser_of, write

import quell as ql
from quell.files import nonfinite_to_none, write_json
from quell.kernels import dispatch
from quell.realtime import LiveSink, open_device, run_rig
from quell.realtime.rig import LOG
from quell.realtime.supervisor import Cause

SECONDS = 0.7
DISK_KIB = 256  # size of the disk that is full
OWN = ("stall the loop", "stall the rig", "kill the loop", "kill the rig", "interrupt the loop")
OTHERS = ("disk full", "live clients")
# Ends that a busy machine causes as well.
BY_MACHINE = (Cause.LOST, Cause.STALLED, Cause.OVERRUN, Cause.WATCHDOG, Cause.UNSETTLED)
BY_MACHINE += (Cause.NO_MEASUREMENT,)
# A request to open a WebSocket (RFC 6455, section 1.3) with Foxglove's protocol.
UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
)
TROUBLES = (*KINDS, *OWN, *OTHERS)


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

    def __init__(self, folder: Path, number: int, wire: str) -> None:
        self.log = folder / f"rig-{number}.csv"
        command = [sys.executable, "-m", "quell", "rig", "--device", rig_url(wire)]
        command += ["--plant", "two-mass", "--dt", str(DT), "--watchdog", str(WATCHDOG)]
        self.process = subprocess.Popen(
            [*command, "--log", str(self.log)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert self.process.stdout is not None
        # Lines before that with the URL tell that something is compiled.
        said = next((line for line in self.process.stdout if "://" in line), "")
        self.url = said.partition(" at ")[2].partition(": ")[0]
        self._seen = 0
        deadline = time.monotonic() + 60.0
        while self.log.read_text("utf-8").count("\n") < 2 and time.monotonic() < deadline:
            time.sleep(0.05)  # until it ticks

    def rows(self) -> np.ndarray:
        """Return the rows of the log since the last call, with the columns of ``LOG``."""
        time.sleep(0.12)  # the log is written every 50 ms
        with self.log.open(encoding="utf-8") as file:
            file.seek(self._seen)
            text = file.read()
        whole = text[: text.rfind("\n") + 1]
        self._seen += len(whole.encode())
        lines = [line.split(",") for line in whole.splitlines() if line[0].isdigit()]
        return np.array(lines, dtype=float).reshape(-1, len(LOG))

    def end(self) -> None:
        """Stop the process."""
        self.process.terminate()
        self.process.wait()


def loop(url: str, folder: Path, files: list[Path], port: int | None) -> None:
    """Run the loop and write its results; this is the child process of a trial."""
    live = [] if port is None else [LiveSink(port)]
    run = close_loop(url, SECONDS, [*live, *files])
    told = {
        "changes": [(change.t, change.mode, change.cause) for change in run.changes],
        "tally": run.tally._asdict(),
        "completed": run.completed,
        "verdict": run.verdict,
        "notes": list(run.notes),
        "blamed_on_machine": any(change.cause in BY_MACHINE for change in run.changes),
    }
    write_json(folder / "run.json", told)


def close_loop(url: str, seconds: float, telemetry: list[Any]) -> Any:
    """Run the loop of a trial."""
    return run_rig(
        *(open_device(url, DT), controller(), ql.signals.Sinusoid(omega=3.0)),
        duration=seconds,
        safety=SAFETY,
        approach=0.2,
        telemetry=telemetry,
    )


def possible(kinds: Sequence[str], wire: str, disk: Path) -> list[str]:
    """Return the kinds of faults that this wire and this user allow."""
    left_out = [] if os.path.ismount(disk) else ["disk full"]
    return [kind for kind in kinds if kind not in left_out]


def trial(
    number: int, wire: str, kind: str, rig: RigProcess, folder: Path, draw: random.Random
) -> dict[str, Any]:
    """Run and check one trial."""
    first, many = draw.randint(120, 600), max(round(500 ** draw.random()), 1)
    towards, late = draw.choice(("loop", "rig")), draw.randint(1, DELAY)
    faults = [Fault(kind, towards, first, many, late)] if kind in KINDS else []
    about = {"trial": number, "wire": wire, "kind": kind, "at": first, "length": many}
    about["towards"] = towards if faults else ""
    rig.rows()
    files, port = [folder / "run.csv", folder / "run.mcap"], None
    if kind == "disk full":
        files = fill_disk(folder.parent / "full", draw.randint(1, 60))
    if kind == "live clients":
        port = free_port()
    with contextlib.ExitStack() as stack:
        between = stack.enter_context(relay(rig.url, faults, number))
        pid = os.fork()
        if pid == 0:
            in_child(folder, lambda: loop(between.url, folder, files, port))
        if port is not None:
            stack.enter_context(clients(port, draw))
        killed = disturb(kind, pid, rig, between, first, many)
        _, status = os.waitpid(pid, 0)
    log = rig.rows()
    code = rig.process.poll()
    killed &= os.WIFSIGNALED(status)
    found = judged(
        *(folder, log),
        loop_killed=killed,
        rig_killed=code is not None,
        disk_full=kind == "disk full",
    )
    if os.WIFSIGNALED(status) and not killed:
        found["wrong"].append(f"the loop was ended by signal {os.WTERMSIG(status)}")
    if code is not None and kind != "kill the rig":
        found["wrong"].append(f"the rig ended with code {code}")
    return about | found


def in_child(folder: Path, work: Any) -> None:
    """Do the work and end the process; an exception goes into a file."""
    code = 1
    try:
        work()
        code = 0
    except BaseException as error:
        (folder / "error.txt").write_text(repr(error), encoding="utf-8")
    finally:
        os._exit(code)


def disturb(kind: str, pid: int, rig: RigProcess, between: Any, first: int, many: int) -> bool:
    """Stall, kill or interrupt a process; return whether the loop was killed."""
    if kind in (*KINDS, *OTHERS):
        return False
    deadline = time.monotonic() + 20.0
    # Wait until ``first`` commands have passed.
    while between.passed["rig"] < first and time.monotonic() < deadline:
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


def free_port() -> int:
    """Return a TCP port that is free now."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@contextlib.contextmanager
def clients(port: int, draw: random.Random) -> Iterator[None]:
    """Connect up to thirty clients that say nothing, half of a request, or never read."""
    begins = (b"", b"GET / HTTP/1.1\r\nHost: x\r\n", UPGRADE)
    opened = []
    deadline = time.monotonic() + 20.0
    while not opened and time.monotonic() < deadline:
        with contextlib.suppress(OSError):
            opened.append(socket.create_connection(("127.0.0.1", port), timeout=1.0))
    for _ in range(draw.randint(0, 29)):
        with contextlib.suppress(OSError):
            one = socket.create_connection(("127.0.0.1", port), timeout=1.0)
            opened.append(one)
            one.sendall(draw.choice(begins))
    try:
        yield
    finally:
        for one in opened:
            one.close()


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """Mount a small disk at ``folder`` if this user may."""
    folder.mkdir()
    options = ["-t", "tmpfs", "-o", f"size={DISK_KIB}k", "none", str(folder)]
    try:
        mounted = subprocess.run(["mount", *options], capture_output=True, check=False)
        if mounted.returncode:
            print("no trials with a full disk: to mount one needs root", flush=True)
        yield
    finally:
        subprocess.run(["umount", str(folder)], capture_output=True, check=False)


def fill_disk(folder: Path, free: int) -> list[Path]:
    """Leave so many KiB free on the small disk; return the files for the record."""
    for path in folder.iterdir():
        path.unlink()
    (folder / "filler").write_bytes(bytes(1024 * (DISK_KIB - free)))
    return [folder / "run.csv", folder / "run.mcap"]


def main() -> None:
    """Run the trials and print how they ended."""
    parser = parser_of(__doc__)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--wires", nargs="+", choices=WIRES, default=WIRES)
    parser.add_argument("--kinds", nargs="+", choices=TROUBLES, default=TROUBLES)
    parser.add_argument("--minutes", type=float, default=60.0, help="longest time for a wire")
    parser.add_argument("--results", type=Path, help="file of trials that are done")
    options = options_of(parser, trials=1, wires=["udp"])
    if options.quick:  # a trial is quicker interpreted than to compile, the rig's process as well
        dispatch.interpret_all, os.environ["NUMBA_DISABLE_JIT"] = True, "1"
    results: list[dict[str, Any]] = []
    if options.results is not None and options.results.exists():
        results = json.loads(options.results.read_text("utf-8"))
    with tempfile.TemporaryDirectory() as place, small_disk(Path(place) / "full"):
        for i, wire in enumerate(options.wires):
            done = {found["trial"] for found in results if found["wire"] == wire}
            count = (options.trials + i) // len(options.wires)
            numbers = [number for number in range(count) if number not in done]
            kinds = possible(options.kinds, wire, Path(place) / "full")
            found = trials(wire, numbers, kinds, Path(place), options.seed, 60.0 * options.minutes)
            for one in found:
                results.append(one)
                if options.results is not None:
                    write_json(options.results, nonfinite_to_none(results), overwrite=True)
    figures = print_table(results)
    write(options, figures)
    sys.exit(1 if figures["with errors"] else 0)


def trials(
    wire: str, numbers: list[int], kinds: list[str], folder: Path, seed: int, seconds: float
) -> Iterator[dict[str, Any]]:
    """Run the trials over one wire, as many as fit into the time; print those with errors."""
    if not numbers:
        return
    end = time.monotonic() + seconds
    rig = RigProcess(folder, 0, wire)
    try:
        # Compile and import once: the trials are forked from this process.
        close_loop(rig.url, 0.2, [folder / f"{wire}.csv", folder / f"{wire}.mcap"])
        for number in numbers:
            if time.monotonic() > end:
                break
            if rig.process.poll() is not None:
                rig.log.unlink()
                rig = RigProcess(folder, number + 1, wire)
            own = folder / f"{wire}-{number}"
            own.mkdir()
            draw = random.Random(f"{seed} {wire} {number}")
            found = trial(number, wire, draw.choice(kinds), rig, own, draw)
            if found["wrong"]:
                print(f"{found}", flush=True)
            yield found
            shutil.rmtree(own)
            if any(math.isnan(part) for part in found.get("lost", ())):
                rig.end()  # no command ended the killed loop's session: it would last for a minute
            if number % 50 == 49:
                print(f"{wire}: {number + 1} trials done", file=sys.stderr, flush=True)
    finally:
        rig.end()


def print_table(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Print how the trials ended; return the numbers."""
    counts = Counter(found["wire"] for found in results)
    print(", ".join(f"{wire}: {count} trials" for wire, count in counts.items()))
    figures: dict[str, Any] = {"trials": len(results), "by wire": counts, "kinds": {}}
    print(f"{'fault':<24} {'trials':>6} {'errors':>6}  ended")
    for kind in TROUBLES:
        mine = [found for found in results if found["kind"] == kind]
        ends = Counter(found["ended"] for found in mine).most_common()
        wrong = sum(bool(found["wrong"]) for found in mine)
        text = ", ".join(f"{name} {count}" for name, count in ends)
        figures["kinds"][kind] = {"trials": len(mine), "with errors": wrong}
        print(f"{kind:<24} {len(mine):>6} {wrong:>6}  {text}")
    lost = [part for found in results for part in found.get("lost", ())]
    lost = [part for part in lost if part is not None and math.isfinite(part)]
    figures["lost by a killed loop [s]"] = max(lost, default="no loop was killed")
    if lost:
        most = max(lost)
        print(f"telemetry lost by a killed loop: at most {most:.3f} s")
    bad = sum(bool(found["wrong"]) for found in results)
    print(f"{len(results)} trials, {bad} with errors")
    return figures | {"with errors": bad}


if __name__ == "__main__":
    main()
