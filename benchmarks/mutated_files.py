"""Random changes of valid files, given to everything that reads files.

    python benchmarks/mutated_files.py                       # 10 000 files
    python benchmarks/mutated_files.py --seconds 60 --seed 7
    python benchmarks/mutated_files.py --seed 1 --only 1234 --keep case      # one case again

A case is a valid recording (CSV, MCAP), header, record (NetCDF, CSV), file of samples or setup with
one to four random changes (``tests/mutations.py``), and a function or command that reads it. It
must end with a result, or with an error that the function documents, in one line; commands with an
exit code that is documented. Each case runs in a process whose memory is limited and measured; its
processor time, with that of processes it starts and without compilation, is measured, too.

Commands do all that comes before their main work. That itself is shortened: `quell run` simulates
20 samples, `quell run-rig` opens no device, `quell reproduce acc` ends when the samples are plants.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from measured import options_of, parser_of, write

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from quell.kernels.cache import compile_time
from tests.mutations import mutated, write_seeds

MOST_SECONDS, MOST_MB = 10.0, 1000.0
# A case that takes longer than that by the clock is ended: ten times the limit, as the machine may
# be busy.
PATIENCE = 100.0
READERS = {
    "recording in CSV": ("load", "quell replay"),
    "header": ("load",),
    "recording in MCAP": ("load", "load", "quell replay"),
    "NetCDF": ("load",),
    "record": ("load", "quell identify"),
    "samples": ("load", "quell reproduce acc"),
    "setup": ("load", "quell run", "quell run-rig", "quell replay --setup"),
    "setup of axes": ("load", "quell run", "quell run-rig", "quell replay --setup"),
}


def read(kind: str, path: Path) -> None:
    """Read a file with the function for its kind, and look at what it holds."""
    import quell as ql
    from quell.experiments.acc import loops
    from quell.identification import read_record
    from quell.realtime import load
    from quell.records.trajectory import Trajectory
    from quell.setup import load as load_setup

    if kind in ("recording in CSV", "header", "recording in MCAP", "NetCDF"):
        loader: Callable[..., Any] = load
        if kind == "NetCDF":
            loaders = {"runs": ql.BatchTrajectory.load, "axes": Trajectory.load}
            loader = loaders.get(path.stem, ql.Trajectory.load)
        run = loader(path)
        run.to_xarray()
        _ = run.message
        run.metrics()
    elif kind == "record":
        read_record(path)
    elif kind == "samples":
        for row in loops.read(path):
            for cubic in (False, True):
                loops.plant(row, cubic)
    else:
        load_setup(path).as_json()


def command(reader: str, path: Path, valid: Path) -> str:
    """Run a command on a file, and return ``read`` or ``refused``.

    An ``AssertionError`` tells an exit code that is not documented, or a traceback.
    """
    from quell.cli import app as cli
    from quell.cli.exit_codes import ExitCode
    from quell.kernels.dispatch import as_python

    of_axes = path.name.startswith("axes")
    setup, record = ("axes.toml", "axes.csv") if of_axes else ("replay.toml", "run.csv")
    arguments = {
        "quell replay": ["replay", path, "--setup", valid / setup],
        "quell replay --setup": ["replay", valid / record, "--setup", path],
        "quell identify": ["identify", path, "--order", "1"],
        "quell reproduce acc": ["reproduce", "acc", "--samples", path],
        "quell run": ["run", path],
        "quell run-rig": ["run-rig", path],
    }[reader]
    whole, shown, code = cli.app, io.StringIO(), 0
    cli.app = lambda: whole([*map(str, arguments), "--no-figures"])
    try:
        # A setup of axes has types of its own: compiling them is not what is tried.
        how = as_python() if of_axes else contextlib.nullcontext()
        with contextlib.redirect_stderr(shown), contextlib.redirect_stdout(io.StringIO()), how:
            cli.main()
    except SystemExit as ended:
        code = ended.code
    finally:
        cli.app = whole
    assert code in {*ExitCode} - {ExitCode.INTERNAL}, f"exit code {code}"
    assert "Traceback" not in shown.getvalue(), shown.getvalue()
    return "refused" if code == ExitCode.ERROR else "read"


def shorten_commands() -> None:
    """Shorten the main work of the commands, see the module."""
    import quell.cli.reproduce as acc
    import quell.cli.rig as run_rig
    import quell.simulation as simulation

    simulate = simulation.simulate

    def few(plant: Any, controller: Any, scenario: Any, **options: Any) -> Any:
        short = replace(scenario, duration=20.0 * controller.dt, rest_at=())
        return simulate(plant, controller, short, interpret=True, **options)

    def end(*_: Any, **__: Any) -> None:
        sys.exit(0)

    simulation.simulate = few
    run_rig._close_loop = end
    acc.check_outputs = end


def case(
    seeds: dict[str, list[Path]], folder: Path, seed: int, number: int
) -> tuple[str, str, Path]:
    """Write the file of a case; return its kind, who reads it, and its path."""
    random_ = random.Random(f"{seed} {number}")
    kind = random_.choice([*seeds])
    valid = random_.choice(seeds[kind])
    other = random_.choice(seeds[random_.choice([*seeds])]).read_bytes()
    content = mutated(valid.read_bytes(), kind, other, random_)
    path = folder / valid.name
    path.write_bytes(content)
    if kind == "header":
        path = path.with_suffix("")
        path.write_bytes((valid.with_suffix("")).read_bytes())
    elif kind == "recording in CSV" and valid.with_name(valid.name + ".json").exists():
        beside = valid.with_name(valid.name + ".json")
        (folder / beside.name).write_bytes(beside.read_bytes())
    return kind, random_.choice(READERS[kind]), path


def outcome(kind: str, reader: str, path: Path, valid: Path) -> tuple[str, str]:
    """Read a file; return ``read``, ``refused``, ``warned`` or ``FAULT``, and why."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            if reader == "load":
                read(kind, path)
                result = "read", ""
            else:
                result = command(reader, path, valid), ""
        except (ValueError, OSError, MemoryError) as error:
            lines = getattr(error, "mistakes", (str(error),))
            one = all("\n" not in line and line for line in lines)
            documented = not isinstance(error, UnicodeError | MemoryError) and reader == "load"
            result = ("refused", "") if one and documented else ("FAULT", traceback.format_exc())
        except Exception:
            result = "FAULT", traceback.format_exc()
    numeric = [each for each in caught if each.category is RuntimeWarning]
    return (
        ("warned", f"{numeric[0].filename}:{numeric[0].lineno} {numeric[0].message}")
        if (numeric and result[0] != "FAULT")
        else result
    )


def work(folder: Path, seed: int, numbers: Iterator[int]) -> None:
    """Run cases, and print a line of JSON before and after each."""
    told = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    valid = folder / "valid"
    valid.mkdir(exist_ok=True)
    seeds = write_seeds(valid)
    text = (valid / "setup4.toml").read_text().replace("order = 4", "order = 2")
    (valid / "replay.toml").write_text(text)
    shorten_commands()
    import quell.experiments.acc.loops
    import quell.identification
    import quell.realtime  # noqa: F401

    with contextlib.suppress(Exception):  # what is compiled once does not count
        command("quell replay", valid / "run.csv", valid)
        command("quell replay", valid / "axes.csv", valid)
        command("quell identify", valid / "named.csv", valid)
    memory = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (memory + int(2e6 * MOST_MB),) * 2)
    os.chdir(folder)
    for number in numbers:
        for path in folder.iterdir():
            if path.is_file():
                path.unlink()
        kind, reader, path = case(seeds, folder, seed, number)
        print(json.dumps({"number": number, "kind": kind, "reader": reader}), file=told, flush=True)
        Path("/proc/self/clear_refs").write_text("5")  # the peak of memory begins anew
        began, clock = _processor_time(), time.monotonic()
        result, why = outcome(kind, reader, path, valid)
        report = {
            "result": result,
            "why": why,
            "seconds": _processor_time() - began,
            "clock": time.monotonic() - clock,
            "mb": max(_peak(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3),
        }
        print(json.dumps(report), file=told, flush=True)


def _processor_time() -> float:
    """Return the processor time so far, without compilation, which another loop may need.

    Compilation is known by the clock, so that on a busy machine the rest is a lower bound.
    """
    uses = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(use.ru_utime + use.ru_stime for use in uses) - compile_time.seconds


def _peak() -> float:
    status = Path("/proc/self/status").read_text()
    return next(int(line.split()[1]) for line in status.splitlines() if "VmHWM" in line) / 1e3


def run(seed: int, numbers: Iterator[int], until: float) -> list[dict[str, Any]]:
    """Run cases in workers, a new one after each that was lost; return a report of each case."""
    import selectors

    reports: list[dict[str, Any]] = []
    number = next(numbers, None)
    while number is not None and time.monotonic() < until:
        with tempfile.TemporaryDirectory() as folder:
            command_ = [sys.executable, __file__, "--worker", folder, "--seed", str(seed)]
            pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
            # Without buffers, which would hide a second line from the selector.
            worker = subprocess.Popen(command_, bufsize=0, stdin=pipe, stdout=pipe, stderr=nothing)
            assert worker.stdin is not None
            assert worker.stdout is not None
            selector = selectors.DefaultSelector()
            selector.register(worker.stdout, selectors.EVENT_READ)
            while number is not None and time.monotonic() < until:
                worker.stdin.write(f"{number}\n".encode())
                worker.stdin.flush()
                begun = json.loads(worker.stdout.readline() or "{}") | {"number": number}
                ended = selector.select(PATIENCE)
                line = worker.stdout.readline() if ended else b""
                lost = {"result": "FAULT", "why": "the process was lost" if ended else "hangs"}
                lost |= {"seconds": PATIENCE, "clock": PATIENCE, "mb": 0.0}
                report = json.loads(line) if line else lost
                reports.append({"kind": "?", "reader": "?"} | begun | report)
                _show(reports)
                number = next(numbers, None)
                if not line:
                    break
            worker.kill()
            worker.wait()
            selector.close()
            worker.stdin.close()
            worker.stdout.close()
    return reports


def misses(report: dict[str, Any]) -> bool:
    """Return whether a case misses the bar."""
    fault: bool = report["result"] == "FAULT"
    return fault or report["seconds"] > MOST_SECONDS or report["mb"] > MOST_MB


def _show(reports: list[dict[str, Any]]) -> None:
    last = reports[-1]
    if misses(last):
        line = last["why"].strip().splitlines()[-1:]
        print(f"case {last['number']}: {last['kind']}, {last['reader']}: {line}", flush=True)
    if len(reports) % 1000 == 0:
        print(f"{len(reports)} files", file=sys.stderr, flush=True)


def show(reports: list[dict[str, Any]]) -> int:
    """Print the table; return the number of cases that miss the bar."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for report in reports:
        groups[report["kind"], report["reader"]].append(report)
    heading = ("read", "refused", "warned", "faults", "longest [s]", "largest [MB]")
    print(f"{'file':18} {'reader':21} {'files':>6}", *(f"{name:>12}" for name in heading))
    for (kind, reader), found in sorted(groups.items()):
        counts = Counter(report["result"] for report in found)
        numbers = [f"{counts[key]:12}" for key in ("read", "refused", "warned", "FAULT")]
        seconds, mb = (max(report[key] for report in found) for key in ("seconds", "mb"))
        print(f"{kind:18} {reader:21} {len(found):6}", *numbers, f"{seconds:12.2f} {mb:12.0f}")
    missed = [report for report in reports if misses(report)]
    rule = f"a traceback, more than {MOST_SECONDS:g} s of processor time or {MOST_MB:g} MB"
    print(f"{len(reports)} files, {len(missed)} miss the bar: {rule}")
    return len(missed)


def main() -> int:
    """Run the cases and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, help="one case again, with its traceback")
    parser.add_argument("--keep", type=Path, help="folder for the file of that case")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    options = options_of(parser, count=8)
    if options.worker is not None:
        work(options.worker, options.seed, (int(line) for line in sys.stdin))
        return 0
    numbers = iter(range(options.count)) if options.only is None else iter([options.only])
    reports = run(options.seed, numbers, time.monotonic() + options.seconds)
    if options.only is not None:
        print(json.dumps(reports[0], indent=1).replace("\\n", "\n"))
        if options.keep is not None:
            options.keep.mkdir()
            (options.keep / "valid").mkdir()
            case(write_seeds(options.keep / "valid"), options.keep, options.seed, options.only)
    missed = show(reports)
    write(
        options,
        {
            "files": len(reports),
            "miss the bar": missed,
            "results": Counter(report["result"] for report in reports),
            "longest [s]": max(report["seconds"] for report in reports),
            "largest [MB]": max(report["mb"] for report in reports),
        },
    )
    return min(missed, 1)


if __name__ == "__main__":
    sys.exit(main())
