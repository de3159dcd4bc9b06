"""All programs of ``benchmarks`` can be started by the gate: ``--quick``, and a file of figures."""

from __future__ import annotations

import argparse
import json
import math
import re
from pathlib import Path

import pytest

from .benchmark_module import BENCHMARKS, benchmark

PROGRAMS = sorted(
    path
    for path in BENCHMARKS.glob("*.py")
    if 'if __name__ == "__main__":' in path.read_text(encoding="utf-8")
)


def fault_of(path: Path) -> str:
    """Return what a program does not share with the others, or nothing."""
    text = path.read_text(encoding="utf-8")
    if "from measured import" not in text:
        return f"{path.name} does not import measured.py"
    missing = [
        name for name in ("parser_of", "write") if not re.search(rf"(?<![.\w]){name}\(", text)
    ]
    if missing:
        return f"{path.name} does not call {' and '.join(missing)} of measured.py"
    return f"{path.name} makes a parser of its own" if "ArgumentParser(" in text else ""


def test_each_benchmark_has_the_shared_options_and_writes_its_figures() -> None:
    """``.ci/checks/benchmarks.py`` starts each with them."""
    assert not [fault for path in PROGRAMS if (fault := fault_of(path))]


def test_there_are_as_many_programs_as_the_gate_starts() -> None:
    """Modules that only others import are none."""
    names = {path.stem for path in PROGRAMS}
    assert {"batch", "faults"} <= names
    assert not names & {"measured", "fault_judges", "hostile_configurations"}


def options(tmp_path: Path, *arguments: str) -> argparse.Namespace:
    """Return the options of a benchmark with a file for its figures."""
    parser = benchmark("measured").parser_of("What it measures.")
    found: argparse.Namespace = parser.parse_args(
        ["--json", str(tmp_path / "figures.json"), *arguments]
    )
    return found


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_figure_that_is_not_finite_is_an_error_and_no_file(tmp_path: Path, value: float) -> None:
    """Also at depth; the error names the figure."""
    given = options(tmp_path)
    with pytest.raises(ValueError, match=r"table\[1\].ratio"):
        benchmark("measured").write(given, {"runs": 3, "table": [{"ratio": 1.0}, {"ratio": value}]})
    assert not given.json.exists()


def test_texts_and_flags_alone_are_no_figures(tmp_path: Path) -> None:
    """A benchmark that has measured nothing says so."""
    with pytest.raises(ValueError, match="no number"):
        benchmark("measured").write(options(tmp_path), {"ratio": "not measured", "good": True})


def test_figures_are_written_with_their_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the file went is no part of the command."""
    given = options(tmp_path)
    monkeypatch.setattr("sys.argv", ["benchmarks/x.py", "--json", "here", "--runs", "3"])
    benchmark("measured").write(given, {"runs": 3, "why": "no gcc"})
    found = json.loads(given.json.read_text(encoding="utf-8"))
    assert found["figures"] == {"runs": 3, "why": "no gcc"}
    assert found["command"] == "python benchmarks/x.py --runs 3"


def test_quick_changes_defaults_and_not_what_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    """An option on the command line stands."""
    measured = benchmark("measured")

    def read(*arguments: str) -> tuple[int, int]:
        monkeypatch.setattr("sys.argv", ["x.py", *arguments])
        parser = measured.parser_of("What it measures.")
        parser.add_argument("--runs", type=int, default=1000)
        parser.add_argument("--trials", type=int, default=5)
        found = measured.options_of(parser, runs=2, trials=1)
        return found.runs, found.trials

    assert read() == (1000, 5)
    assert read("--quick") == (2, 1)
    assert read("--quick", "--runs", "7") == (7, 1)


@pytest.mark.parametrize(("arguments", "code"), [((), 1), (("--quick",), 0)])
def test_a_missing_tool_is_named_and_fails_a_full_run(
    tmp_path: Path, arguments: tuple[str, ...], code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """The gate takes the line for a verdict on machines without the tool."""
    with pytest.raises(SystemExit) as ended:
        benchmark("measured").check_present(
            options(tmp_path, *arguments), tools=["no-such-compiler"], files=[tmp_path / "map.csv"]
        )
    assert ended.value.code == code
    said = capsys.readouterr().out
    assert said.startswith("NOT run: no-such-compiler, ")
    assert "map.csv" in said
