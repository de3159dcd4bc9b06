"""The mutation trial: it counts the one-line changes of the source that the tests notice.

    python benchmarks/mutation/trial.py [--count 300] [--seed 1] [--areas law,guard] [--json FILE]
    python benchmarks/mutation/trial.py --since REVISION    # only lines that are newer

Each mutant runs, in a copy of the repository, the tests that execute its statement, the quickest
first, until one fails. The tests run interpreted (``interpret_all.py``), so that nothing is
compiled for a mutant; tests that take longer than ``LIMIT`` that way are left out. A test that
fails without the mutant, too, does not count. Mutants in ``equivalent.toml`` are known not to
change anything that a caller can observe; each has its reason there.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import functools
import json
import multiprocessing
import os
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Callable
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
        "stress",
        "telemetry",
        "torsional",
    ),
    *("twin", "wire"),
]
AREAS = {
    "law": ("controllers/law.py", "controllers/base.py"),
    "hand-over": ("controllers/adrc.py", "controllers/stateful.py"),
    "guard": ("guard/*.py",),
    "learners": (
        *("learners/base.py", "learners/kalman.py", "learners/oscillators.py"),
        *("learners/frequency_search.py", "learners/regression.py", "learners/rls.py"),
        "learners/repetitive.py",
    ),
    "gradient learners": (
        *("learners/batch_gradient.py", "learners/online.py", "learners/gaussian_process.py"),
        "learners/python_model.py",
    ),
    "observers": ("observers/*.py", "lti/models.py"),
    "precision": ("kernels/single.py", "controllers/single.py"),
    "limits": ("controllers/base.py",),
    "supervisor": ("realtime/supervisor.py", "realtime/safety.py"),
    "metrics": ("records/metrics.py",),
    "margins": ("analysis/margins.py",),
}
# The files of tests that run first: to collect all takes seconds, and most mutants fail in these.
NEAR = {
    "law": ("law", "adrc", "nonlinear_feedback"),
    "hand-over": ("handover", "law", "contracts/test_controllers"),
    "guard": ("guard", "law"),
    "learners": (
        *("kalman", "kalman_equations", "learner_equations", "harmonic", "regression", "recovery"),
        *("repetitive", "lag", "bad_learners", "law", "contracts/test_contracts"),
    ),
    "gradient learners": (
        *("batch_gradient", "online", "learner_equations", "recovery"),
        "contracts/test_contracts",
    ),
    "observers": ("observers", "observer_forms", "lag", "lti_canonical", "handover"),
    "precision": ("single_precision", "contracts/test_single_precision"),
    "limits": ("limits", "law"),
    "supervisor": ("supervisor", "supervisor_rules", "safety"),
    "metrics": ("metrics",),
    "margins": ("analysis_margins", "analysis_loop", "advice"),
}
# What takes longest to import, and is the same for all mutants: imported once.
PRELOADED = [
    *("__main__", "pytest", "numba", "scipy.linalg", "scipy.optimize", "scipy.signal", "control"),
    *("h5netcdf", "xarray"),
]
# CPU time of a test under interpretation [s]: the quickest four fifths of the tests take less.
LIMIT = 3.0
# Without coverage the tests are quicker than in the unchanged run: who passed there has time.
OPTIONS = [
    *("-q", "--tb=no", "-p", "no:cacheprovider", "-p", "interpret_all", f"--cpu-limit={LIMIT}")
]
# CPU time of the tests that one mutant runs [s]; more tests of the same line rarely find more.
BUDGET = 60.0
# A statement that fewer tests execute themselves may run in a fixture, at import or in a cache, for
# tests that come later.
FEW = 10
# Exit code of a run that was ended, as that of ``timeout``.
TIMED_OUT = 124


class Tests(NamedTuple):
    """The tests, and what they execute."""

    seconds: dict[str, float]  # of those that pass under interpretation
    of_line: dict[tuple[str, int], set[str]]  # by file and line
    of_file: dict[str, set[str]]


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
    parser.add_argument("--since", help="revision after which the changed lines were written")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--json", type=Path, help="write the verdicts to this file")
    parser.add_argument("--baseline", type=Path, help="folder that keeps the unchanged run")
    options = parser.parse_args()
    os.environ["PYTHONPATH"] = str(Path(__file__).parent)  # for what is preloaded
    console = Console()
    areas = options.areas.split(",")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        baseline = options.baseline or work / "baseline"
        tests = unchanged_run(baseline, options.workers)
        area_of = {path: area for area in areas for path in _files(area)}
        drawn = draw(REPOSITORY, area_of, options.count, options.seed, _newer(options.since))
        passing: set[str] = set()
        copies: queue.Queue[Path] = queue.Queue()
        for i in range(options.workers):
            copies.put(_copy(work / f"copy{i}"))

        def judge(mutant: Mutant) -> Verdict:
            copy = copies.get()
            try:
                area = area_of[mutant.path]
                return Verdict(area, mutant, *_judge(mutant, area, copy, tests, passing))
            finally:
                copies.put(copy)

        with concurrent.futures.ThreadPoolExecutor(options.workers) as pool:
            verdicts = []
            jobs = concurrent.futures.as_completed([pool.submit(judge, each) for each in drawn])
            for job in track(jobs, total=len(drawn), console=console):
                verdicts.append(job.result())
                if not verdicts[-1].killed:
                    v = verdicts[-1].mutant
                    text = f"survived, line {v.line} ({verdicts[-1].reason}): {v.name}"
                    console.print(text, markup=False, soft_wrap=True)
                if options.json:
                    options.json.write_text(_rows(verdicts), encoding="utf-8")
    console.print(_table(verdicts))


def _newer(revision: str | None) -> Callable[[Mutant], bool]:
    """Return whether a mutant's line is newer than a revision; lines that moved are not."""

    @functools.cache
    def lines(path: str) -> set[int]:
        command = ["git", "blame", "-M", "-C", "-C", "--incremental", f"{revision}..", "--", path]
        shown = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
        newer, these = set(), range(0)
        for line in shown.stdout.splitlines():
            if match := re.fullmatch(r"[0-9a-f]{40} \d+ (\d+) (\d+)", line):
                these = range(int(match[1]), int(match[1]) + int(match[2]))
                newer.update(these)
            elif line == "boundary":
                newer.difference_update(these)
        return newer

    return lambda mutant: revision is None or mutant.line in lines(mutant.path)


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
        options = [f"-n{workers}", f"--junitxml={report}", "--cov", "--cov-context=test"]
        subprocess.run(
            [sys.executable, "-B", "-m", "pytest", *OPTIONS, *names, *options],
            cwd=copy,
            env=os.environ | _environment(copy) | {"COVERAGE_FILE": str(data)},
            capture_output=True,
            check=False,
        )
    seconds = {}
    for case in ET.parse(report).iter("testcase"):
        if not any(case.find(kind) is not None for kind in ("failure", "error", "skipped")):
            path = case.attrib["classname"].replace(".", "/") + ".py"
            seconds[f"{path}::{case.attrib['name']}"] = float(case.attrib["time"])
    covered = CoverageData(str(data))
    covered.read()
    of_line: dict[tuple[str, int], set[str]] = defaultdict(set)
    of_file: dict[str, set[str]] = defaultdict(set)
    for file in covered.measured_files():
        path = file[file.index("src/quell") :]
        for line, contexts in covered.contexts_by_lineno(file).items():
            names = {context.rpartition("|")[0] for context in contexts} - {""}
            of_line[path, line] |= names
            of_file[path] |= names
    return Tests(seconds, of_line, of_file)


def _judge(
    mutant: Mutant, area: str, copy: Path, tests: Tests, passing: set[str]
) -> tuple[bool, str]:
    """Return whether a test notices the mutant, and which, or why not.

    ``passing`` collects the tests that were seen to pass alone and without a mutant.
    """
    if (reason := _equivalents().get(mutant.name)) is not None:
        return False, f"equivalent: {reason}"
    executing = set().union(*(tests.of_line[mutant.path, line] for line in mutant.statement))
    files = {f"tests/{name if '/' in name else f'test_{name}'}.py" for name in NEAR[area]}
    near = {name for name in executing if name.partition("::")[0] in files}
    near = _quickest(near, tests, 0.5 * BUDGET)
    far = _quickest(executing - set(near), tests, 0.5 * BUDGET)
    if len(executing) < FEW:
        far += _quickest(tests.of_file[mutant.path] - executing, tests, 0.5 * BUDGET)
    tested = len(near) + len(far)
    changed = copy / mutant.path
    original = changed.read_text(encoding="utf-8")
    for left in (near, far):
        while left:
            changed.write_text(mutant.source, encoding="utf-8")
            try:
                found, line = _failure(copy, left)
            finally:
                changed.write_text(original, encoding="utf-8")
            if found is None:
                break
            if found not in passing and _passes(copy, found):
                passing.add(found)
            if found in passing:
                return True, line
            left.remove(found)  # it fails anyway, for example alone or on a busy machine
            tested -= 1
    return False, f"{tested} tests pass"


def _quickest(names: set[str], tests: Tests, budget: float) -> list[str]:
    """Return the quickest tests that run interpreted, of ``budget`` seconds in all."""
    chosen, spent = [], 0.0
    for name in sorted(names & tests.seconds.keys(), key=lambda each: (tests.seconds[each], each)):
        spent += tests.seconds[name]
        if spent > budget:
            break
        chosen.append(name)
    return chosen


def _failure(copy: Path, tests: list[str]) -> tuple[str | None, str]:
    """Return the first test that fails, None if all pass, and pytest's line about it."""
    for part in (tests[i : i + 200] for i in range(0, len(tests), 200)):
        code, shown = _pytest(copy, ["-x", *part])
        lines = [x for x in shown.splitlines() if x.startswith(("FAILED", "ERROR"))]
        if lines:
            named = lines[0].split(" ", 1)[1]
            found = [x for x in part if named.startswith(x)]
            if found:
                return max(found, key=len), lines[0]
            # An error of collection names a file.
            return next((x for x in part if x.startswith(named.split(" ")[0])), part[0]), lines[0]
        if code not in (0, 5, TIMED_OUT):
            return part[0], f"exit code {code}"
    return None, ""


def _passes(copy: Path, test: str) -> bool:
    """Return whether a test passes alone and without a mutant."""
    return _pytest(copy, [test])[0] == 0


def _pytest(copy: Path, arguments: list[str]) -> tuple[int, str]:
    """Return exit code and output of pytest in a copy, in a process of its own."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    output = copy / "output"
    output.unlink(missing_ok=True)
    process = context.Process(target=_run_pytest, args=(copy, ["-n0", *arguments], output))
    process.start()
    process.join(4.0 * BUDGET)
    if process.is_alive():
        process.kill()
        process.join()
        return TIMED_OUT, ""
    if not output.exists():
        raise RuntimeError("a process for tests did not start; its error is above")
    return process.exitcode or 0, output.read_text(encoding="utf-8", errors="replace")


def _run_pytest(copy: Path, arguments: list[str], output: Path) -> None:
    import pytest

    with output.open("w", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.chdir(copy)
    os.environ |= _environment(copy)
    sys.path[:0] = os.environ["PYTHONPATH"].split(os.pathsep)
    sys.dont_write_bytecode = True
    code = pytest.main([*OPTIONS, *arguments])
    sys.stdout.flush()
    os._exit(code)


def _environment(copy: Path) -> dict[str, str]:
    path = f"{copy / 'src'}{os.pathsep}{Path(__file__).parent}"
    return {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(copy / "cache"), "OPENBLAS_NUM_THREADS": "1"}


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


def _rows(verdicts: list[Verdict]) -> str:
    """Return the verdicts as JSON."""
    rows = [
        {"area": v.area, "mutant": v.mutant.name, "line": v.mutant.line}
        | {"killed": v.killed, "reason": v.reason}
        for v in verdicts
    ]
    return json.dumps(rows, indent=1, ensure_ascii=False)


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
