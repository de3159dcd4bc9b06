"""The budget of the tests: what takes longer fails, and parts hold each file once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from . import budget

ROOT = Path(__file__).parents[1]
LOOP = """
    end = time.process_time() + {seconds}
    while time.process_time() < end:
        pass
"""


@pytest.mark.trial
def test_a_test_that_takes_longer_than_its_budget_fails_unless_it_is_a_trial(
    tmp_path: Path,
) -> None:
    """Also where only its second run is judged: the first one may compile."""
    folder = ROOT / "tests"
    file = tmp_path / "test_long.py"
    file.write_text(
        "import time\nimport pytest\nruns = []\n\n"
        "def test_long():" + LOOP.format(seconds=20 * budget.BUDGET)
        + "\n@pytest.mark.trial\ndef test_trial():" + LOOP.format(seconds=2 * budget.BUDGET)
        + "\ndef test_once():\n    runs.append(1)\n    if len(runs) > 1:\n        return"
        + LOOP.format(seconds=2 * budget.BUDGET)
    )  # fmt: skip
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-m", "", "-p", "no:cacheprovider"]
    options = [
        "--rootdir",
        str(ROOT),
        "--confcutdir",
        str(folder),
        "-c",
        str(ROOT / "pyproject.toml"),
    ]
    # The plugin alone: conftest.py holds for files of its folder.
    (tmp_path / "conftest.py").write_text(
        "import sys\n"
        f"sys.path.insert(0, {str(ROOT)!r})\n"
        "from tests import budget\n"
        "budget.HERE = __import__('pathlib').Path(__file__).parent\n"
        "def pytest_addoption(parser):\n    budget.add_options(parser)\n"
        "def pytest_configure(config):\n"
        "    config.addinivalue_line('markers', 'trial: long')\n"
        "    config.pluginmanager.register(budget.Budget(config))\n"
    )
    done = subprocess.run(
        [*command, *options, str(file)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert "1 failed, 2 passed" in done.stdout, done.stdout + done.stderr
    assert "of processor time: a test may take 0.5 s" in done.stdout
    assert "FAILED" in done.stdout
    assert "test_long" in done.stdout.split("FAILED")[-1]


def test_parts_hold_each_file_once_and_take_about_as_long() -> None:
    """For any number of parts: none is longer than the shortest by more than the longest file."""
    known = budget.table()
    assert len(known) > 150, "seconds.json lacks files: pytest -m '' --write-seconds"
    assert sum(trials for _, trials in known.values()) > 500.0, "seconds.json has no trials"
    files = sorted(known)
    for count in (1, 2, 3, 7):
        made = budget.parts(files, count)
        assert sorted(file for part in made for file in part) == files
        sums = [sum(known[file][1] for file in part) for part in made]
        assert max(sums) - min(sums) <= max(known[file][1] for file in files) + 20.0


def test_only_the_named_cases_of_a_trial_are_trials() -> None:
    """``trial(cases=…)``: the other cases belong to the default suite."""

    def item(name: str) -> Any:
        return SimpleNamespace(name=name, own_markers=[pytest.mark.trial(cases="long|ros2").mark])

    items = [item("test_a[long]"), item("test_a[short]"), item("test_a[x-ros2]")]
    budget.choose(SimpleNamespace(option=SimpleNamespace(part=None)), items)  # type: ignore[arg-type]
    assert [bool(each.own_markers) for each in items] == [True, False, True]


@pytest.mark.parametrize("part", ["0/3", "4/3", "1", "a/b"])
def test_a_part_that_is_none_is_refused(part: str) -> None:
    """With the rule."""
    config = SimpleNamespace(option=SimpleNamespace(part=part))
    with pytest.raises(pytest.UsageError, match="give K/N with K from 1 to N"):
        budget.choose(config, [])  # type: ignore[arg-type]


def test_coverage_that_is_imported_but_does_not_measure_leaves_the_budget(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Numba imports it wherever it is installed; a budget that ended there was never kept."""
    monkeypatch.setattr(sys, "gettrace", lambda: None)
    for current, watched in ((None, False), (object(), True)):
        coverage = SimpleNamespace(Coverage=SimpleNamespace(current=lambda now=current: now))
        monkeypatch.setitem(sys.modules, "coverage", coverage)
        assert budget._watched() is watched
