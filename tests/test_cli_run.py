"""``quell run``, ``run-rig`` and ``replay``: setup files from the command line."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

import quell as ql
from quell import cli
from quell.setup import load

SHORT = """
title = "A short run"
dt = 0.01
[plant]
kind = "two-mass"
[observer]
kind = "model-free"
order = 4
b0 = 1.0
omega_o = 10.0
[controller]
omega_c = 1.0
[scenario]
reference = 1.0
duration = 12.0
disturbances = [0.0, { kind = "step", height = 0.05, at = 8.0 }]
[[metrics]]
stop = 8.0
[[metrics]]
start = 8.0
"""


class Shown(NamedTuple):
    """What a command did."""

    code: int
    out: str
    err: str


@pytest.fixture
def quell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Shown]:
    """Run the command in this process, in a folder of its own."""

    def run(*arguments: str) -> Shown:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["quell", *arguments])
        monkeypatch.setenv("COLUMNS", "100")
        code = 0
        try:
            cli.main()
        except SystemExit as ended:
            code = int(ended.code or 0)
        return Shown(code, *capsys.readouterr())

    return run


def test_a_setup_is_simulated_printed_written_drawn_and_saved(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """What is written is what ``simulate`` gives for what the file describes."""
    (tmp_path / "short.toml").write_text(SHORT)
    shown = quell("run", "short.toml", "--json", "out.json", "--figures", "pictures", "--save", "run.nc")
    assert shown.code == 0, shown.err
    assert "A short run: two-mass-spring, dt = 0.01 s" in shown.out
    setup = load(tmp_path / "short.toml")
    run = ql.simulate(setup.plant, setup.controller, setup.scenario)
    saved = ql.Trajectory.load(tmp_path / "run.nc")
    assert (saved.log == run.log).all()
    result = json.loads((tmp_path / "out.json").read_text())
    assert [(score["start"], score["stop"]) for score in result["metrics"]] == [(0.0, 8.0), (8.0, 12.0)]
    assert result["metrics"][1]["rms"] == run.metrics(8.0)["rms"]
    assert result["setup"]["observer"]["omega_o"] == 10.0
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {"short.png", "short.svg"}


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("[guard]\nbond = 1.0", "quell: wrong.toml: guard.bond: unknown; did you mean bound?"),
        ("[guard]\nbound = 'x'\n[learner]\nkind = 'kallman'", "quell: wrong.toml: learner.kind = 'kallman': unknown; did you mean kalman?"),
        ("[guard", "quell: wrong.toml: not TOML"),
    ],
)
def test_each_mistake_gives_a_line_and_exit_code_two(more: str, message: str, quell: Callable[..., Shown], tmp_path: Path) -> None:
    """No traceback, no figure, no file."""
    (tmp_path / "wrong.toml").write_text(SHORT + more)
    shown = quell("run", "wrong.toml", "--json", "out.json")
    assert shown.code == 2
    assert all(line.startswith("quell: wrong.toml: ") for line in shown.err.strip().splitlines())
    assert message in shown.err
    assert [path.name for path in tmp_path.iterdir()] == ["wrong.toml"]


def test_a_run_that_diverges_says_so(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """Windows that it did not reach have no metrics; it is no mistake in the file, and the exit code is zero."""
    (tmp_path / "wild.toml").write_text(SHORT.replace("b0 = 1.0", "b0 = -1.0").replace("start = 8.0", "start = 11.5"))
    shown = quell("run", "wild.toml", "--json", "out.json", "--no-figures")
    assert shown.code == 0, shown.err
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["diverged"]
    assert "rms" not in result["metrics"][1]
    assert "nan" not in shown.out.lower()
