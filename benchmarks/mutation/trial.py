"""The mutation trial: it counts the one-line changes of the source that the tests notice.

    python benchmarks/mutation/trial.py [--count 300] [--seed 1] [--areas law,guard] [--json FILE]

Each mutant runs, in a copy of the repository, the tests that execute its line, the quickest first,
until one fails. The tests run interpreted (``interpret_all.py``), so that nothing is compiled for a
mutant; tests that take too long that way run compiled, for the mutants that have survived. Mutants
in ``equivalent.toml`` are known not to change anything that a caller can observe; each has its
reason there.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import itertools
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import tomllib
import xml.etree.ElementTree as ET
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

from coverage import CoverageData
from mutants import Mutant, draw
from rich.console import Console
from rich.progress import track
from rich.table import Table

REPOSITORY = Path(__file__).parents[2]
# Tests of commands, of processes and threads, of adapters, of compilation itself and of published
# figures take seconds each, and are not about these areas.
LEFT_OUT = [
    *("adapter_faults", "adapters", "api_page", "batch", "cache", "cli", "cli_rig", "cli_run"),
    *("cobs", "dispatch", "faults", "fault_injection", "frames", "function_pointers", "histogram"),
    *("hostile_files", "live", "loop", "ni", "replay", "rig", "ring", "run_rig", "scalars"),
    *(
        "security",
        "serial_device",
        "serial_line",
        "shared_memory",
        "stress",
        "telemetry",
        "torsional",
    ),
    *("twin", "wire"),
]
AREAS = {
    "law": ("controllers/adrc/law.py", "controllers/bad_samples.py"),
    "hand-over": ("controllers/adrc/handover.py", "controllers/stateful.py"),
    "guard": ("guard/*.py",),
    "learners": ("learners/*.py", "learners/kalman/*.py", "learners/regression/*.py"),
    "gradient learners": ("learners/gradient/*.py", "learners/online/*.py"),
    "observers": ("observers/*.py",),
    "limits": ("controllers/limits.py",),
    "supervisor": ("realtime/loop/supervisor.py", "realtime/loop/direction.py"),
    "metrics": ("records/metrics.py",),
    "margins": ("analysis/margins.py",),
}
# CPU time of a test under interpretation [s]: the quickest four fifths of the tests take less.
LIMIT = 3.0
# CPU time of the tests that one mutant runs [s]; more tests of the same line rarely find more.
BUDGET = 60.0


class Tests(NamedTuple):
    """The tests that pass under interpretation."""

    seconds: dict[str, float]
    of_line: dict[tuple[str, int], set[str]]  # by file and line
    slow: dict[str, list[str]]  # tests that need compiled code, by file


class Verdict(NamedTuple):
    """The result of one mutant."""

    area: str
    mutant: Mutant
    killed: bool
    reason: str


def main() -> None:
    """Run the trial and print what survived."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300, help="mutants to draw")
    parser.add_argument("--seed", type=int, default=1, help="seed of the draw")
    parser.add_argument("--areas", default=",".join(AREAS), help="areas, separated by commas")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--json", type=Path, help="write the verdicts to this file")
    parser.add_argument("--baseline", type=Path, help="folder that keeps the unchanged run")
    options = parser.parse_args()
    console = Console()
    areas = options.areas.split(",")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        baseline = options.baseline or work / "baseline"
        tests = unchanged_run(baseline, options.workers)
        area_of = {path: area for area in areas for path in _files(area)}
        drawn = draw(REPOSITORY, area_of, options.count, options.seed)
        copies: queue.Queue[Path] = queue.Queue()
        for i in range(options.workers):
            copies.put(_copy(work / f"copy{i}"))

        def judge(mutant: Mutant) -> Verdict:
            copy = copies.get()
            try:
                return Verdict(area_of[mutant.path], mutant, *_judge(mutant, copy, tests))
            finally:
                copies.put(copy)

        with concurrent.futures.ThreadPoolExecutor(options.workers) as pool:
            verdicts = []
            for verdict in track(pool.map(judge, drawn), total=len(drawn), console=console):
                verdicts.append(verdict)
                if not verdict.killed:
                    v = verdict.mutant
                    text = f"survived, line {v.line} ({verdict.reason}): {v.name}"
                    console.print(text, markup=False, soft_wrap=True)
    console.print(_table(verdicts))
    if options.json:
        rows = [
            {"area": v.area, "mutant": v.mutant.name, "line": v.mutant.line}
            | {"killed": v.killed, "reason": v.reason}
            for v in verdicts
        ]
        options.json.write_text(json.dumps(rows, indent=1, ensure_ascii=False), encoding="utf-8")


def unchanged_run(folder: Path, workers: int) -> Tests:
    """Run all tests interpreted, with coverage by test, unless ``folder`` has that run already."""
    report, data = folder / "report.xml", folder / "coverage"
    if not report.exists():
        copy = _copy(folder / "copy")
        names = [
            path
            for path in _test_files()
            if Path(path).stem.removeprefix("test_") not in LEFT_OUT and "/published/" not in path
        ]
        _pytest(
            copy,
            [*names, f"-n{workers}", f"--junitxml={report}", "--cov", "--cov-context=test"],
            {"COVERAGE_FILE": str(data)},
        )
    seconds, slow = {}, defaultdict(list)
    for case in ET.parse(report).iter("testcase"):
        path = case.attrib["classname"].replace(".", "/") + ".py"
        name = f"{path}::{case.attrib['name']}"
        if case.find("failure") is None and case.find("error") is None:
            seconds[name] = float(case.attrib["time"])
        else:
            slow[path].append(name)
    covered = CoverageData(str(data))
    covered.read()
    of_line: dict[tuple[str, int], set[str]] = defaultdict(set)
    for file in covered.measured_files():
        path = file[file.index("src/quell") :]
        for line, contexts in covered.contexts_by_lineno(file).items():
            names = {context.rpartition("|")[0] for context in contexts}
            of_line[path, line] |= names & seconds.keys()
    return Tests(seconds, of_line, slow)


def _judge(mutant: Mutant, copy: Path, tests: Tests) -> tuple[bool, str]:
    """Return whether a test notices the mutant, and which, or why not."""
    if (reason := _equivalents().get(mutant.name)) is not None:
        return False, f"equivalent: {reason}"
    chosen = sorted(tests.of_line[mutant.path, mutant.line], key=tests.seconds.__getitem__)
    spent = itertools.accumulate(tests.seconds[name] for name in chosen)
    chosen = [name for name, total in zip(chosen, spent, strict=True) if total <= BUDGET]
    changed = copy / mutant.path
    original = changed.read_text(encoding="utf-8")
    changed.write_text(mutant.source, encoding="utf-8")
    try:
        found = _failure(copy, chosen, interpret=True)
        if found is None:
            files = {name.partition("::")[0] for name in chosen}
            found = _failure(copy, [n for f in sorted(files) for n in tests.slow[f]], False)
    finally:
        changed.write_text(original, encoding="utf-8")
    return (True, found) if found else (False, f"{len(chosen)} tests pass")


def _failure(copy: Path, tests: list[str], interpret: bool) -> str | None:
    """Return the test that fails; None if all pass."""
    for part in (tests[i : i + 200] for i in range(0, len(tests), 200)):
        done = _pytest(copy, ["-x", "-n0", "--no-header", *part], interpret=interpret)
        if done.returncode not in (0, 5):
            lines = [x for x in done.stdout.splitlines() if x.startswith(("FAILED", "ERROR"))]
            return lines[0] if lines else f"exit code {done.returncode}"
    return None


def _pytest(
    copy: Path, arguments: list[str], extra: dict[str, str] | None = None, interpret: bool = True
) -> subprocess.CompletedProcess[str]:
    path = f"{copy / 'src'}{os.pathsep}{Path(__file__).parent}"
    environment = os.environ | {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(copy / "cache")}
    plugin = ["-p", "interpret_all", f"--cpu-limit={LIMIT}"] if interpret else []
    command = [sys.executable, "-B", "-m", "pytest", "-q", "-p", "no:cacheprovider", "--tb=no"]
    return subprocess.run(
        [*command, *plugin, *arguments],
        cwd=copy,
        env=environment | (extra or {}),
        capture_output=True,
        text=True,
        check=False,
    )


def _copy(target: Path) -> Path:
    """Copy what the tests need."""
    target.mkdir(parents=True)
    for name in ("src", "tests", "docs", "benchmarks"):
        shutil.copytree(REPOSITORY / name, target / name)
    for name in ("pyproject.toml", "README.md", "CHANGELOG.md", "CONTRIBUTING.md"):
        shutil.copy(REPOSITORY / name, target / name)
    return target


def _files(area: str) -> list[str]:
    source = REPOSITORY / "src/quell"
    found = [path for pattern in AREAS[area] for path in source.glob(pattern)]
    return [str(path.relative_to(REPOSITORY)) for path in found]


def _test_files() -> list[str]:
    found = (REPOSITORY / "tests").rglob("test_*.py")
    return sorted(str(path.relative_to(REPOSITORY)) for path in found)


def _equivalents() -> dict[str, str]:
    """Return the reasons of mutants that change nothing, by name."""
    text = Path(__file__).with_name("equivalent.toml").read_text(encoding="utf-8")
    return {entry["mutant"]: entry["reason"] for entry in tomllib.loads(text).get("known", [])}


def _table(verdicts: list[Verdict]) -> Table:
    table = Table("area", "mutants", "killed", "equivalent", "survived", "killed of the rest")
    groups = {area: [v for v in verdicts if v.area == area] for area in AREAS}
    for area, group in (*groups.items(), ("all", verdicts)):
        killed = sum(v.killed for v in group)
        same = sum(v.reason.startswith("equivalent") for v in group)
        if group:
            share = f"{killed / max(len(group) - same, 1):.1%}"
            counts = (len(group), killed, same, len(group) - killed - same)
            table.add_row(area, *map(str, counts), share)
    return table


if __name__ == "__main__":
    main()
