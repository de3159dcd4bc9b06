"""Run the steps of the gate beside each other, and say at the end what each one took and found.

    python3 .ci/gate.py [STEP …]

A step is a program ``.ci/steps/NAME.sh``. The comments at its head say what it shows
(``# shows:``), which steps it needs (``# after:``), how many cores it uses (``# cores:``, else 1)
and after how many minutes it is ended (``# minutes:``, else 15). It runs with ``bash -euo
pipefail`` in the root of the repository, with these variables:

``WORK``
    a folder for all steps: ``$WORK/dist`` has the wheel, ``$WORK/venv`` the environment with all
    that tests need, ``$WORK/plain`` the one with the wheel alone;
``OWN``
    an empty folder of the step's own;
``TURN``
    the number in ``.ci/turn``, which each landing raises: what is too long to run at each landing
    runs in parts that take turns by it, so that none is left out;
``SEED``
    a number from the commit, for what is drawn;
``DAY``
    the day of the year: what no change of the code can break takes turns by it.

All steps run, whatever fails: only those that need a failed one are left out. The exit code is 0 if
every step has passed.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
STEPS = Path(__file__).resolve().parent / "steps"
CORES = os.cpu_count() or 1
SHOWN, SHOWN_OF_FAILED = 3, 80  # last lines of a step's output


@dataclass
class Step:
    """A step, and how it went."""

    name: str
    shows: str = ""
    after: tuple[str, ...] = ()
    cores: int = 1
    minutes: float = 15.0
    verdict: str = ""  # empty while it waits or runs
    seconds: float = 0.0
    processor: float = 0.0  # its processor time, that of its processes included [s]
    log: Path = Path()
    process: subprocess.Popen[bytes] | None = None
    began: float = field(default=0.0, repr=False)


def read(path: Path) -> Step:
    """Return the step that the head of its program describes."""
    said = dict(re.findall(r"^# (\w+): (.*)$", path.read_text(encoding="utf-8"), re.M))
    return Step(
        path.stem,
        said["shows"],
        tuple(said.get("after", "").split()),
        min(int(said.get("cores", 1)), CORES),
        float(said.get("minutes", 15)),
    )


def chosen(names: list[str]) -> dict[str, Step]:
    """Return the named steps with those that they need, or all; a step stands behind its needs."""
    steps = {path.stem: read(path) for path in sorted(STEPS.glob("*.sh"))}
    unknown = {each for step in steps.values() for each in step.after} | {*names}
    if unknown := unknown - {*steps}:
        sys.exit(f"there is no step {', '.join(sorted(unknown))}: steps are {', '.join(steps)}")
    ordered: dict[str, Step] = {}

    def add(name: str) -> None:
        for each in steps[name].after:
            add(each)
        ordered.setdefault(name, steps[name])

    for name in names or steps:
        add(name)
    return ordered


def turn() -> int:
    """Return the number in ``.ci/turn``."""
    file = ROOT / ".ci" / "turn"
    text = file.read_text(encoding="utf-8").strip() if file.exists() else ""
    if re.fullmatch("[0-9]+", text) is None:
        sys.exit(f".ci/turn has {text!r}: it must have a whole number, as 12")
    return int(text)


def environment(work: Path) -> dict[str, str]:
    """Return the variables of all steps."""
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout
    return os.environ | {
        "WORK": str(work),
        "ROOT": str(ROOT),
        "TURN": str(turn()),
        "SEED": str(int(commit[:8], 16) if commit.strip() else 0),
        "DAY": f"{datetime.now(UTC):%-j}",
        "PATH": f"{work / 'venv' / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "NUMBA_CACHE_DIR": str(work / "cache"),
        "MPLBACKEND": "agg",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONUNBUFFERED": "1",
    }


def start(step: Step, work: Path, variables: dict[str, str]) -> None:
    """Start a step in a process group of its own."""
    own = work / "steps" / step.name
    own.mkdir(parents=True)
    step.log = work / "logs" / f"{step.name}.log"
    step.log.parent.mkdir(exist_ok=True)
    step.began = time.monotonic()
    with step.log.open("wb") as log:
        step.process = subprocess.Popen(
            ["bash", "-euo", "pipefail", str(STEPS / f"{step.name}.sh")],
            cwd=ROOT,
            env=variables | {"OWN": str(own)},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    print(f"-- {step.name}: {step.shows}", flush=True)


def ended(step: Step) -> bool:
    """Return whether a step that runs has ended by now, and note how it went."""
    assert step.process is not None
    step.seconds = time.monotonic() - step.began
    pid, status, used = os.wait4(step.process.pid, os.WNOHANG)
    late = not pid and step.seconds > 60.0 * step.minutes
    if not pid and not late:
        return False
    kill(step)  # all of it, or what it has left running
    if late:
        _, status, used = os.wait4(step.process.pid, 0)
    step.process.returncode = code = os.waitstatus_to_exitcode(status)
    step.processor = used.ru_utime + used.ru_stime
    if late:
        step.verdict = f"FAILED: not finished after {step.minutes:g} minutes"
    else:
        step.verdict = "passed" if code == 0 else f"FAILED: exit code {code}"
    lines = step.log.read_text(encoding="utf-8", errors="replace").splitlines()
    last = lines[-(SHOWN if step.verdict == "passed" else SHOWN_OF_FAILED) :]
    print(f"\n== {step.name}: {step.verdict}, {step.seconds:.0f} s")
    print("\n".join(f"   {line}" for line in last), flush=True)
    return True


def kill(step: Step) -> None:
    """End all processes of a step."""
    assert step.process is not None
    with contextlib.suppress(ProcessLookupError):
        os.killpg(step.process.pid, signal.SIGKILL)


def run(steps: dict[str, Step], work: Path) -> None:
    """Run as many steps at a time as there are cores; those that may take longest begin first."""
    variables, running = environment(work), []
    waiting = sorted(steps.values(), key=lambda step: -step.minutes)
    while waiting or running:
        for step in [*waiting]:
            before = [steps[name] for name in step.after]
            if failed := [each.name for each in before if each.verdict.startswith(("F", "not"))]:
                step.verdict = f"not run: {', '.join(failed)} failed"
                waiting.remove(step)
            elif all(each.verdict for each in before):
                if step.cores + sum(each.cores for each in running) > CORES:
                    # A step that needs all cores is not overtaken for ever.
                    if step.cores > 1:
                        break
                    continue
                start(step, work, variables)
                running.append(step)
                waiting.remove(step)
        time.sleep(0.2)
        running = [step for step in running if not ended(step)]


def main() -> int:
    """Run the gate and print its table."""
    steps, began = chosen(sys.argv[1:]), time.monotonic()
    work = Path(tempfile.mkdtemp(prefix="quell-gate-"))
    try:
        run(steps, work)
    finally:
        for step in steps.values():
            if step.process is not None:
                kill(step)
        shutil.rmtree(work, ignore_errors=True)
    width = max(map(len, steps))
    print(f"\n{'step':{width}}  seconds  processor  verdict")
    for step in steps.values():
        print(f"{step.name:{width}}  {step.seconds:7.0f}  {step.processor:9.0f}  {step.verdict}")
    failed = [step.name for step in steps.values() if step.verdict != "passed"]
    spent = sum(step.processor for step in steps.values())
    print(f"{'all':{width}}  {time.monotonic() - began:7.0f}  {spent:9.0f}  ", end="")
    print(f"{len(failed)} FAILED: {', '.join(failed)}" if failed else "passed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
