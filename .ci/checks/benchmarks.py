"""Start each benchmark with ``--quick`` and look whether it works and its figures are numbers.

    python .ci/checks/benchmarks.py [--jobs 2] [--part K/N] [--only NAME ...]

A program is a file that can be started on its own (``if __name__ == "__main__"``), in one of the
places of ``PLACES``. It must end with exit code 0 within the time limit, and write a file of
figures (``benchmarks/measured.py``) in which every number is finite. Where it needs what is not on
this machine, it prints a line that begins with "NOT run: " instead, and no figures.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from measured import numbers_of, part_of

ROOT = Path(__file__).resolve().parents[2]
# Where programs with --quick and --json are.
PLACES = ("benchmarks/*.py", "benchmarks/mutation/trial.py")
SKIPPED = "NOT run: "


class Verdict(NamedTuple):
    """What became of a program."""

    name: str
    cpu: float  # [s], with its child processes
    good: bool
    text: str
    output: str  # the end of what it printed


def commands() -> dict[str, list[str]]:
    """Return the arguments for Python of each program, by its path in the repository."""
    found = {}
    for place in PLACES:
        for path in sorted(ROOT.glob(place)):
            if 'if __name__ == "__main__":' in path.read_text(encoding="utf-8"):
                found[str(path.relative_to(ROOT))] = [str(path), "--quick"]
    return found


def run(name: str, command: list[str], limit: float) -> Verdict:
    """Start a program with ``--json`` and judge it."""
    with tempfile.TemporaryDirectory() as place:
        figures, said = Path(place) / "figures.json", Path(place) / "output.txt"
        with said.open("wb") as output:
            process = subprocess.Popen(
                [sys.executable, *command, "--json", str(figures)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=place,
                env={"MPLBACKEND": "agg"} | os.environ,
                start_new_session=True,  # so that its children end with it
            )
            late = threading.Event()

            def end() -> None:
                late.set()
                os.killpg(process.pid, signal.SIGKILL)

            timer = threading.Timer(limit, end)
            timer.start()
            _, status, usage = os.wait4(process.pid, 0)
            timer.cancel()
            process.returncode = os.waitstatus_to_exitcode(status)
        text = said.read_text(encoding="utf-8", errors="replace")
        if late.is_set():
            good, verdict = False, f"not ready after {limit:g} s"
        elif process.returncode:
            good, verdict = False, f"exit code {process.returncode}"
        else:
            good, verdict = judged(figures, text)
        return Verdict(name, usage.ru_utime + usage.ru_stime, good, verdict, text[-3000:])


def judged(figures: Path, output: str) -> tuple[bool, str]:
    """Return whether the file of figures is good, and what it has."""
    skipped = [line for line in output.splitlines() if line.startswith(SKIPPED)]
    if not figures.exists():
        return (True, skipped[-1]) if skipped else (False, "no figures were written")
    try:
        written = json.loads(figures.read_text(encoding="utf-8"))
        found = [value for _, value in numbers_of(written["figures"])]
    except (ValueError, KeyError, TypeError) as error:
        return False, f"the file of figures can't be read: {error!r}"
    if not found:
        return False, "no figure is a number"
    if not all(map(math.isfinite, found)):
        return False, "a figure is not finite"
    return True, f"{len(found)} numbers"


def main() -> None:
    """Start the programs and print a row for each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, default=2, help="programs at once")
    parser.add_argument("--limit", type=float, default=1200.0, help="time of a program [s]")
    parser.add_argument(
        "--part", type=part_of, default="1/1", help="K/N: each N-th program from the K-th on"
    )
    parser.add_argument("--only", nargs="+", help="these programs, by name without suffix")
    options = parser.parse_args()
    chosen = commands()
    if options.only:
        missing = set(options.only) - {Path(name).stem for name in chosen}
        if missing:
            parser.error(f"--only {' '.join(sorted(missing))}: no such program")
        chosen = {name: each for name, each in chosen.items() if Path(name).stem in options.only}
    chosen = dict(list(chosen.items())[options.part])
    print(f"{len(chosen)} programs; CPU [s], verdict")
    bad = []
    with ThreadPoolExecutor(options.jobs) as pool:
        jobs = [pool.submit(run, name, each, options.limit) for name, each in chosen.items()]
        for job in jobs:
            one = job.result()
            print(f"{one.name:40} {one.cpu:7.1f}  {one.text}", flush=True)
            if not one.good:
                bad.append(one)
    for one in bad:
        print(f"\n---- {one.name}: {one.text}\n{one.output}")
    print(f"{len(bad)} of {len(chosen)} programs failed" if bad else "all are good")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
