"""What the tests take: a budget for each, parts of about equal length, and what to expect in all.

A test that is no trial takes at most ``BUDGET`` seconds of processor time, its processes included.
One that takes longer runs again at once, twice at most, since the first run may have imported,
compiled or filled a cache; if the last run takes longer, too, it fails. On a slower or busy machine it has longer:
``_slowness`` measures how much, where it matters.

``seconds.json`` has the processor time of each file, of its trials and of its other tests. It is
written by ``pytest -m "" --write-seconds``; parts and the announcement are made of it, and no
verdict.
"""

from __future__ import annotations

import ast
import json
import os
import re
import resource
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _pytest.runner import runtestprotocol

BUDGET = 0.5  # [s]
HERE = Path(__file__).parent
TABLE = HERE / "seconds.json"
# Processor time of the two works of ``_slowness`` on a quiet core of the machine on which the tests were shared out.
_REFERENCES = 0.024, 0.024
# Runs of a test that takes too long, of which the last one counts: what it needs is there by then.
_RUNS = 3
# What the processes of a run need before the first test: imports, and reading the test files [s].
_START = 12.0


def add_options(parser: pytest.Parser) -> None:
    """Add the options of these tests."""
    group = parser.getgroup("quell")
    group.addoption("--part", metavar="K/N", help="only the K-th of N parts, which take as long")
    group.addoption("--no-budget", action="store_true", help="tests may take as long as they want")
    group.addoption("--write-seconds", action="store_true", help="write what each file took")


def processor_time() -> float:
    """Return the processor time of this process and of its children that have ended [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def _slowness(seconds: float) -> float:
    """Return how much slower than the reference this machine is at the moment, at least 1.

    The slower of a loop and of work on many small objects, as compilation is: beside other work
    the second may suffer twice as much. It is looked at only where a test has taken so many
    seconds that it matters.
    """
    if seconds <= BUDGET:
        return 1.0
    source = "x = (a + b) * f(c, d[e])\n" * 150
    taken = []
    for _ in range(3):
        start, total = time.process_time(), 0.0
        for i in range(500_000):
            total += i * 0.5
        middle = time.process_time()
        for _ in range(5):
            ast.unparse(ast.parse(source))
        taken.append((middle - start, time.process_time() - middle))
    return max(1.0, *(np.min(taken, axis=0) / _REFERENCES))


def _watched() -> bool:
    """Return whether a debugger or coverage follows each line, which takes time of its own."""
    coverage = sys.modules.get("coverage")  # which Numba imports, too
    measures = coverage is not None and coverage.Coverage.current() is not None
    return measures or sys.gettrace() is not None


class Budget:
    """Runs each test within its budget, and adds up what the files take."""

    def __init__(self, config: pytest.Config) -> None:
        """Look up what is asked for."""
        if config.option.part is not None:
            files_of_part(config.option.part, [])  # here, where a mistake is one line
        self.limited = not config.option.no_budget
        self.spent: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
        self.config = config

    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> bool:
        """Run a test; again, where it has passed but took too long."""
        log = item.ihook
        log.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        trial = item.get_closest_marker("trial") is not None
        before = processor_time()
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
        taken = processor_time() - before
        self.spent[_file_of(item)][trial] += taken
        limited = self.limited and not trial and not _watched()
        for _ in range(_RUNS - 1):
            passed = all(each.passed for each in reports)
            if not limited or not passed or taken <= BUDGET * _slowness(taken):
                break
            item._initrequest()  # type: ignore[attr-defined]
            before = processor_time()
            reports = runtestprotocol(item, log=False, nextitem=nextitem)
            taken = processor_time() - before
        else:
            passed = all(each.passed for each in reports)
            if passed and taken > BUDGET * _slowness(taken):
                call = next(each for each in reports if each.when == "call")
                call.outcome = "failed"
                call.longrepr = (
                    f"{item.nodeid} took {taken:.2f} s of processor time: a test may take {BUDGET} "
                    "s. Make it shorter (fewer samples, an interpreted loop in place of a compiled "
                    "one, or the other way round), or mark it trial"
                )
        for each in reports:
            log.pytest_runtest_logreport(report=each)
        log.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Hand what the files took to the process that started the workers, or write it."""
        if hasattr(self.config, "workeroutput"):
            self.config.workeroutput["seconds"] = dict(self.spent)
        elif self.config.option.write_seconds:
            write(self.spent)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any, error: Any) -> None:
        """Add what a worker has spent."""
        for file, spent in getattr(node, "workeroutput", {}).get("seconds", {}).items():
            for trial in (0, 1):
                self.spent[file][trial] += spent[trial]


def _file_of(item: pytest.Item) -> str:
    """Return the file of a test, relative to the folder of the tests."""
    return item.path.relative_to(HERE).as_posix()


def table() -> dict[str, list[float]]:
    """Return the processor time of each file: of its tests, and of its trials [s]."""
    return json.loads(TABLE.read_text(encoding="utf-8")) if TABLE.exists() else {}


def write(spent: dict[str, list[float]]) -> None:
    """Write the table; what has not run, a file or its trials, keeps what it had."""
    known = {file: taken for file, taken in table().items() if (HERE / file).exists()}
    for file, taken in spent.items():
        before = known.get(file, [0.0, 0.0])
        known[file] = [round(now, 1) or old for now, old in zip(taken, before, strict=True)]
    lines = [f'  "{file}": {json.dumps(taken)}' for file, taken in sorted(known.items())]
    TABLE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def choose(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave the tests of one part, and take the mark from cases that are no trials."""
    for item in items:
        for mark in [each for each in item.own_markers if each.name == "trial"]:
            cases = mark.kwargs.get("cases")
            if cases is not None and not re.search(cases, item.name):
                item.own_markers.remove(mark)
    if config.option.part is None:
        return
    mine = files_of_part(config.option.part, sorted({_file_of(item) for item in items}))
    left_out = [item for item in items if _file_of(item) not in mine]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if _file_of(item) in mine]


def files_of_part(part: str, files: list[str]) -> set[str]:
    """Return the files of the part that ``--part`` names."""
    asked = re.fullmatch(r"(\d+)/(\d+)", part)
    if asked is None or not 1 <= int(asked[1]) <= int(asked[2]):
        raise pytest.UsageError(f"--part {part}: give K/N with K from 1 to N")
    return parts(files, int(asked[2]))[int(asked[1]) - 1]


def parts(files: list[str], count: int) -> list[set[str]]:
    """Return the files in so many parts whose trials take about as long."""
    known = table()
    made: list[tuple[float, set[str]]] = [(0.0, set()) for _ in range(count)]
    # A file that has not been measured, or has no trials, counts as well: parts hold all files.
    weights = {file: max(known.get(file, [0.0, 0.0])[1], 0.1) for file in files}
    for file in sorted(files, key=lambda file: (-weights[file], file)):
        i = min(range(count), key=lambda i: (made[i][0], i))
        made[i] = (made[i][0] + weights[file], made[i][1] | {file})
    return [files for _, files in made]


def is_whole(config: pytest.Config) -> bool:
    """Return whether a run is of all files."""
    return all(Path(each).resolve() in (HERE, HERE.parent) for each in config.args)


def announcement(config: pytest.Config) -> str | None:
    """Return how long the run will take on a quiet machine, for a run of many files."""
    marks = config.option.markexpr
    columns = {"": (0, 1), "not trial": (0,), "trial": (1,)}.get(marks)
    if columns is None or not is_whole(config) or config.option.keyword or not table():
        return None
    known, part = table(), config.option.part
    files = known if part is None else files_of_part(part, sorted(known))
    workers = max(1, min(config.option.numprocesses or 1, os.cpu_count() or 1))
    seconds = _START + sum(known[file][i] for file in files for i in columns) / workers
    said = f"about {60 * round(seconds / 60)} s" if seconds > 600 else f"about {seconds:.0f} s"
    return f"{said} on {workers} quiet cores, more beside other work"
