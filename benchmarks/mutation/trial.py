"""The mutation trial: it counts the one-line changes of the source that the tests notice.

    python benchmarks/mutation/trial.py [--count 300] [--seed 1] [--areas law,guard] [--near]
    python benchmarks/mutation/trial.py --since REVISION    # only lines that are newer

Each mutant runs, in a copy of the repository, the tests (those that are no trials) that execute its
statement, the quickest first, until one fails. The tests run interpreted (``interpret_all.py``), so
that nothing is compiled for a mutant; tests that take longer than ``LIMIT`` that way are left out.
A test that fails without the mutant, too, does not count. With ``--baseline FOLDER`` the run that
tells what each test executes is made once; new and changed files of tests are added to it. Mutants
in ``equivalent.toml`` are known not to change anything that a caller can observe; each has its
reason there.
"""

from __future__ import annotations

import compileall
import concurrent.futures
import functools
import hashlib
import json
import multiprocessing
import os
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.progress import track
from rich.table import Table
from waiting import waited

try:
    from coverage import CoverageData
    from mutants import Mutant, draw
except ModuleNotFoundError as error:
    missing: str | None = f"{error}: it comes with the extra mutation"
else:
    missing = None

REPOSITORY = Path(__file__).resolve().parents[2]
# Tests of commands, of processes and threads, of adapters, of compilation itself and of published
# figures take seconds each; only the areas that name them (``NEAR``) need them.
LEFT_OUT = [
    *("adapter_faults", "adapters", "api_page", "batch", "cache", "cli", "cli_rig", "cli_run"),
    *("cobs", "dispatch", "faults", "fault_injection", "frames", "function_pointers", "histogram"),
    *("hostile_files", "live", "loop", "ni", "replay", "rig", "ring", "run_rig", "scalars"),
    *("security", "serial_device", "serial_line", "stress", "telemetry", "torsional", "twin"),
    "wire",
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
    **{
        name: (f"{name}/**/*.py",)
        for name in ("identification", "tuning", "export", "realtime", "setup")
    },
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
    "identification": (
        *("acceptance_parts", "alternatives", "awkward_records", "commissioning"),
        *("drawn_results", "excitation", "free_swing", "frequencies", "frequency_fits"),
        *("frequency_tables", "hostile_files", "identification", "identification_parts"),
        *("identification_search", "input_gain", "input_gain_matrix", "layouts_of_records"),
        *(
            "rank",
            "record_faults",
            "record_file",
            "refused_arguments",
            "rows_of_b0",
            "running_loop_parts",
        ),
        *("saturated_records", "short_records", "small_identifications", "spectral_parts"),
        *("step_records", "tests_of_errors", "times_of_records", "published/test_identification"),
    ),
    "tuning": (
        *("acceptance_parts", "at_limits", "cli_tune", "compensator", "drawn_results"),
        *("feedforward", "from_pid", "generalised", "over_seeds", "p_pi", "reduction"),
        *("refused_arguments", "schedule", "schedule_of_loads", "small_schedules"),
        *("tuned_designs", "tuned_files", "tuned_limits", "tuned_loops", "tuning", "tuning_axes"),
        *("tuning_choice", "tuning_damping", "tuning_lqg", "tuning_parts", "tuning_search"),
        *("tuning_simulated", "tuning_structures", "written_loop", "published/test_tuning"),
    ),
    "export": (
        *("axes_export", "axes_in_single", "export", "exported_text", "fmu_export"),
        *("hostile_exports", "packages"),
        *("plants_in_c", "profile", "proof", "ros2", "structured_text", "target", "translate"),
        *("recorded_targets", "untranslatable", "written_c", "contracts/test_exported_options"),
    ),
    "realtime": (
        *("axes_channels", "cli_rig", "cobs", "device_channels", "fault_injection", "frames"),
        *("histogram", "live", "loop", "memory_file", "ni", "proxy", "recorded_targets", "replay"),
        *("rig", "rig_axes"),
        *("rig_compensators", "ring", "run_rig", "safety", "security", "serial_device"),
        *("serial_line", "setup_rules", "supervisor", "supervisor_rules", "target", "telemetry"),
        *(
            "system_calls",
            "twin",
            "watch",
            "wire",
            "contracts/test_devices",
            "contracts/test_memory",
        ),
    ),
    "setup": (
        *("axes_channels", "cli", "cli_run", "compare", "fuzzed", "hostile_files"),
        *("points_of_axes", "security", "setup", "setup_axes", "setup_rules", "setup_schema"),
        *("sweep", "sweep_axes", "tuned_files", "contracts/test_described"),
    ),
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
    *("-q", "--tb=no", "-p", "no:cacheprovider", "-p", "interpret_all", f"--cpu-limit={LIMIT}"),
    "--no-budget",
]
# CPU time of the tests that one mutant runs [s]; more tests of the same line rarely find more.
BUDGET = 60.0
# Files of tests that the unchanged run takes at a time: what has run is kept.
FILES = 12
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
    sys.path.append(str(Path(__file__).resolve().parents[1]))
    # It imports the package. The processes that run the tests, in which this file is imported, must
    # not have it: they would keep it instead of the changed one.
    from measured import not_run, options_of, parser_of, write

    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=300, help="mutants to draw")
    parser.add_argument("--seed", type=int, default=1, help="seed of the draw")
    parser.add_argument("--areas", default=",".join(AREAS), help="areas, separated by commas")
    parser.add_argument("--since", help="revision after which the changed lines were written")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--near", action="store_true", help="only the tests of an area's own files")
    parser.add_argument("--baseline", type=Path, help="folder that keeps the unchanged run")
    parser.add_argument(
        "--budget", type=float, default=BUDGET, help="CPU time of the tests of a mutant [s]"
    )
    options = options_of(parser, count=1, areas="metrics", near=True, workers=1)
    if missing is not None:
        not_run(options, missing)
    areas = options.areas.split(",")
    if unknown := [each for each in areas if each not in AREAS]:
        parser.error(f"--areas {','.join(unknown)}: there are {', '.join(AREAS)}")
    os.environ["PYTHONPATH"] = str(Path(__file__).parent)  # for what is preloaded
    console = Console()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        baseline = options.baseline or work / "baseline"
        area_of = {path: area for area in areas for path in _files(area)}
        tests = unchanged_run(baseline, options.workers, _chosen(areas, options.near), area_of)
        drawn = draw(REPOSITORY, area_of, options.count, options.seed, _newer(options.since))
        passing: set[str] = set()
        copies: queue.Queue[Path] = queue.Queue()
        for i in range(options.workers):
            copies.put(_copy(work / f"copy{i}"))

        def judge(mutant: Mutant) -> Verdict:
            copy = copies.get()
            try:
                area = area_of[mutant.path]
                found = _judge(mutant, area, copy, tests, passing, options.budget)
                return Verdict(area, mutant, *found)
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
                write(options, _figures(verdicts, len(tests.seconds)))  # so far
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


def _chosen(areas: list[str], near: bool) -> list[str]:
    """Return the files of tests that may notice a mutant of the areas."""
    own = {_near(each) for area in areas for each in NEAR[area]}
    if near:
        return sorted(own)
    return [
        path
        for path in _test_files()
        if path in own
        or (Path(path).stem.removeprefix("test_") not in LEFT_OUT and "/published/" not in path)
    ]


def unchanged_run(folder: Path, workers: int, names: list[str], sources: Iterable[str]) -> Tests:
    """Run files of tests interpreted, with coverage by test; ``folder`` keeps what has run.

    Parameters
    ----------
    folder
        Where results are kept. Only files of tests that are new or have changed since run.
    workers
        Number of processes.
    names
        The files of tests, relative to the repository.
    sources
        Files of the package of which the coverage is wanted, in the same way.

    Raises
    ------
    SystemExit
        If ``folder`` holds a run of other sources, or tests cannot be collected.
    """
    state, data = folder / "ran.json", folder / "coverage"
    package = _digest(*sorted((REPOSITORY / "src").rglob("*.py")))
    known: dict[str, Any] = {"package": package, "sources": sorted(sources), "tests": {}}
    if state.exists():
        known = json.loads(state.read_text(encoding="utf-8"))
        if known["package"] != package or not set(sources) <= set(known["sources"]):
            sys.exit(f"--baseline {folder}: it is of other sources; name an empty folder")
    digests = {name: _digest(REPOSITORY / name) for name in names}
    left = [name for name in names if known["tests"].get(name) != digests[name]]
    with tempfile.TemporaryDirectory() as temporary:
        copy = _copy(Path(temporary) / "copy") if left else Path()
        for part in (left[i : i + FILES] for i in range(0, len(left), FILES)):
            folder.mkdir(parents=True, exist_ok=True)
            report = folder.resolve() / f"report{len([*folder.glob('report*.xml')]):03}.xml"
            measured = copy / "coveragerc"
            measured.write_text("[run]\ninclude =\n    " + "\n    ".join(known["sources"]) + "\n")
            options = [
                *(f"-n{workers}", f"--junitxml={report}", "--cov"),  # with -n0 all has one context
                *(f"--cov-config={measured}", "--cov-append", "--cov-context=test"),
                "--cov-report=",
            ]
            ran = subprocess.run(
                [sys.executable, "-m", "pytest", *OPTIONS, *part, *options],
                cwd=copy,
                env=os.environ | _environment(copy) | {"COVERAGE_FILE": str(data.resolve())},
                capture_output=True,
                encoding="utf-8",
                check=False,
            )
            if ran.returncode not in (0, 1, 5):  # all passed, some failed, there are only trials
                report.unlink(missing_ok=True)
                sys.exit(f"the unchanged run ended with {ran.returncode}: {ran.stdout}{ran.stderr}")
            known["tests"] |= {name: digests[name] for name in part}
            state.write_text(json.dumps(known, indent=1), encoding="utf-8")
    seconds: dict[str, float] = {}
    for report in sorted(folder.glob("report*.xml")):
        for case in ET.parse(report).iter("testcase"):
            # tests.contracts.test_x.TestY; an error of collection has no such name
            named = re.fullmatch(r"((?:\w+\.)*?)(test_\w+)((?:\.\w+)*)", case.attrib["classname"])
            if named is None:
                continue
            path = f"{named[1].replace('.', '/')}{named[2]}.py"
            test = "::".join([path, *named[3].split(".")[1:], case.attrib["name"]])
            used = case.find("properties/property[@name='cpu']")
            bad = any(case.find(kind) is not None for kind in ("failure", "error", "skipped"))
            if bad or used is None or path not in digests:
                seconds.pop(test, None)
            else:
                seconds[test] = float(used.attrib["value"])
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
    if not of_file.keys() & set(sources) or not any(of_file.values()):
        sys.exit(f"{folder}: the unchanged run has no coverage by test; every mutant would survive")
    return Tests(seconds, of_line, of_file)


def _judge(
    mutant: Mutant, area: str, copy: Path, tests: Tests, passing: set[str], budget: float
) -> tuple[bool, str]:
    """Return whether a test notices the mutant, and which, or why not.

    ``passing`` collects the tests that were seen to pass alone and without a mutant.
    """
    if (reason := _equivalents().get(mutant.name)) is not None:
        return False, f"equivalent: {reason}"
    executing = set().union(*(tests.of_line[mutant.path, line] for line in mutant.statement))
    files = {_near(name) for name in NEAR[area]}
    near = {name for name in executing if name.partition("::")[0] in files}
    near = _quickest(near, tests, 0.5 * budget)
    far = _quickest(executing - set(near), tests, 0.5 * budget)
    if len(executing) < FEW:
        far += _quickest(tests.of_file[mutant.path] - executing, tests, 0.5 * budget)
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
    began = time.monotonic()
    while process.is_alive():
        process.join(1.0)
        if time.monotonic() - began - waited(process.pid or "self") > 4.0 * BUDGET:
            process.kill()
            process.join()
            return TIMED_OUT, ""
    if not output.exists():
        raise RuntimeError("a process for tests did not start; its error is above")
    return process.exitcode or 0, output.read_text(encoding="utf-8", errors="replace")


def _run_pytest(copy: Path, arguments: list[str], output: Path) -> None:
    import pytest

    if "quell" in sys.modules:
        raise RuntimeError("the package is imported before the copy's is: no mutant would run")
    with output.open("w", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.chdir(copy)
    os.environ |= _environment(copy)
    sys.path[:0] = os.environ["PYTHONPATH"].split(os.pathsep)
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
    compileall.compile_dir(target / "src", quiet=1)  # once, not for each mutant
    return target


def _digest(*paths: Path) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def _files(area: str) -> list[str]:
    source = REPOSITORY / "src/quell"
    found = [path for pattern in AREAS[area] for path in source.glob(pattern)]
    return [str(path.relative_to(REPOSITORY)) for path in found]


def _near(name: str) -> str:
    """Return the path of a file of tests that ``NEAR`` names."""
    return f"tests/{name if '/' in name else f'test_{name}'}.py"


def _test_files() -> list[str]:
    found = (REPOSITORY / "tests").rglob("test_*.py")
    return sorted(str(path.relative_to(REPOSITORY)) for path in found)


def _equivalents() -> dict[str, str]:
    """Return the reasons of mutants that change nothing, by name."""
    text = Path(__file__).with_name("equivalent.toml").read_text(encoding="utf-8")
    return {entry["mutant"]: entry["reason"] for entry in tomllib.loads(text).get("known", [])}


def _figures(verdicts: list[Verdict], tests: int) -> dict[str, Any]:
    """Return counts and verdicts for the file of figures."""
    rows = [
        {"area": v.area, "mutant": v.mutant.name, "line": v.mutant.line}
        | {"killed": v.killed, "reason": v.reason}
        for v in verdicts
    ]
    killed = sum(v.killed for v in verdicts)
    same = sum(v.reason.startswith("equivalent") for v in verdicts)
    counts = {"mutants": len(verdicts), "killed": killed, "equivalent": same}
    return {**counts, "tests": tests, "rows": rows}


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
