"""The figures of README and of the pages are those of their sources, and ``docs/check_figures.py`` finds those that are not."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).parents[1] / "docs"
pytestmark = pytest.mark.skipif(
    not DOCS.is_dir(), reason="the pages are in the repository, not in what is built of it"
)
PAGE = """# Page

With noise of 1e-6 the error is 0.47 (`python benchmarks/trial.py`):

| load | error |
|---|---|
| 3 rad/s | 4.2e-7, 12 400 |

Not cited: 99.
"""
ENTRIES = """[[block]]
begins = "With noise"
source = "trial"
numbers = ["=1e-6", "error.0"]

[[block]]
begins = "| load"
source = "trial"
numbers = ["=3", ["late / 10", "trial:share * 100"]]
"""
FIGURES = {"error": [0.4712], "late": 4.18e-6, "share": 123.96}


@pytest.fixture(scope="module")
def check_figures() -> Any:
    """The module of the script."""
    spec = importlib.util.spec_from_file_location("check_figures", DOCS / "check_figures.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["check_figures"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A repository with one page, its entries, one source and its benchmark."""
    (tmp_path / "docs/figures").mkdir(parents=True)
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "README.md").write_text("# Readme\n", encoding="utf-8")
    (tmp_path / "benchmarks/trial.py").write_text("", encoding="utf-8")
    (tmp_path / "docs/page.md").write_text(PAGE, encoding="utf-8")
    (tmp_path / "docs/figures/page.toml").write_text(ENTRIES, encoding="utf-8")
    put_source(tmp_path)
    return tmp_path


def put_source(root: Path, **more: Any) -> None:
    """Write the source."""
    content = {"command": "python benchmarks/trial.py", "date": "2026-11-28", "figures": FIGURES}
    path = root / "docs/figures/trial.json"
    path.write_text(json.dumps(content | more), encoding="utf-8")


def changed(path: Path, old: str, new: str) -> None:
    """Replace a text that is there once."""
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")


@pytest.mark.trial
def test_the_figures_of_readme_and_pages_are_those_of_their_sources(check_figures: Any) -> None:
    """No number that stands beside a benchmark is without a source, and none differs from it."""
    problems, _ = check_figures.check_all()
    assert problems == []


def test_a_page_whose_numbers_are_those_of_the_sources_has_no_problem(
    check_figures: Any, root: Path
) -> None:
    """Settings stand as they are; figures are rounded, and computed from several."""
    problems, sentence = check_figures.check_all(root)
    assert problems == []
    assert sentence.startswith("3 numbers on 2 pages from 1 sources, of which 1 were run")


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("docs/page.md", "is 0.47", "is 0.48", "says 0.48, error.0 of trial is 0.4712"),
        ("docs/page.md", "12 400", "12 500", "says 12 500"),
        ("docs/page.md", "is 0.47", "is 0.47, not 0.5", "without a source: 0.5"),
        ("docs/page.md", "noise of 1e-6", "noise of 1e-5", "number 1 is 1e-5"),
        ("docs/page.md", "is 0.47", "is a half", "has 1 numbers, its entry has 2"),
        ("docs/page.md", "With noise", "Under noise", "no block begins with 'With noise'"),
        ("docs/page.md", "cited: 99.", "known (`benchmarks/trial.py`): 99.", "source: 99;"),
        ("docs/figures/trial.json", '"late"', '"early"', "has no number 'late'"),
        ("docs/figures/page.toml", '"trial:share', '"other:share', "other.json does not exist"),
        ("docs/figures/trial.json", "benchmarks/trial.py", "benchmarks/none.py", "any more"),
        ("docs/figures/trial.json", '"date"', '"day"', "needs a date, or 'transcribed'"),
    ],
)
def test_what_is_not_as_its_source_says_is_named(
    check_figures: Any, root: Path, file: str, old: str, new: str, said: str
) -> None:
    """A changed figure or setting, a new one, and a source that lacks what is cited."""
    changed(root / file, old, new)
    problems, _ = check_figures.check_all(root)
    assert any(said in problem for problem in problems), problems


def test_figures_of_a_newer_source_are_written_into_the_page(
    check_figures: Any, root: Path
) -> None:
    """With as many digits as before, and in the same form."""
    put_source(root, figures={"error": [0.5249], "late": 2.96e-7, "share": 98.764})
    problems, _ = check_figures.check_all(root, write=True)
    assert problems == []
    text = (root / "docs/page.md").read_text(encoding="utf-8")
    assert text == PAGE.replace("0.47", "0.52").replace("4.2e-7", "3.0e-8").replace(
        "12 400", "9880"
    )


@pytest.mark.parametrize(
    ("shown", "value", "same"),
    [
        ("0.47", 0.4749, True),
        ("0.47", 0.4751, False),
        ("4800", 4849.0, True),
        ("4800", 4851.0, False),
        ("100", 104.0, True),
        ("2·10⁵", 2.4e5, True),
        ("10⁴", 1e4, True),
        ("−1.98", -1.984, True),
        ("-2.000", 2.0, False),
    ],
)
def test_a_figure_agrees_if_it_rounds_to_the_digits_that_are_shown(
    check_figures: Any, shown: str, value: float, same: bool
) -> None:
    """Zeros at the end of a whole number are digits as far as the second one."""
    assert check_figures.agrees(shown, value) is same


def test_a_source_that_is_run_again_may_differ_in_times_alone(check_figures: Any) -> None:
    """By a factor of two; other figures by a thousandth, and none may be missing."""
    old = {"timings": ["speed"], "figures": {"speed": {"a": 1.0}, "error": 1.0, "gone": 2.0}}
    new = {"figures": {"speed": {"a": 1.9}, "error": 1.002}}
    assert check_figures.differences(old, new) == [
        "error was 1 and is 1.002",
        "gone is not measured any more",
    ]
    new["figures"] = {"speed": {"a": 0.4}, "error": 1.0005, "gone": 2.0}
    assert check_figures.differences(old, new) == ["speed.a was 1 and is 0.4"]
