"""``quell tune``: transfer functions, setup files, outputs, errors."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

import quell as ql
from quell.cli import output
from quell.setup import load
from quell.tuning import STRUCTURES
from tests.commands import Shown, in_this_process

LAG = ("tune", "--num", "1", "--den", "1,1", "--dt", "0.1", "--structure", "pi")
SETUP = """
dt = 0.02
plant = {{ kind = "linear", num = [1.0], den = [1.0, 1.0], uncertain = {{ {range} }} }}

[tune]
structure = "pi"
m_s = 1.5
compare = []
samples = 3
check_samples = 20
"""


@pytest.fixture
def quell(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> object:
    """Return the function that runs a command here."""
    return lambda *arguments: in_this_process(arguments, monkeypatch, capsys)


@pytest.mark.trial
def test_a_transfer_function_is_tuned_and_written_as_a_setup(quell: object, tmp_path: Path) -> None:
    """With the references in the JSON file; nothing that exists is replaced."""
    out, results = tmp_path / "tuned.toml", tmp_path / "tuned.json"
    more = ("--out", str(out), "--json", str(results), "--no-figures")
    shown: Shown = quell(*LAG, *more)  # type: ignore[operator]
    assert shown.code == 0, shown.err
    assert "active: M_s = 1.6" in shown.out
    assert load(out).controller.dt == 0.1
    read = json.loads(results.read_text(encoding="utf-8"))
    assert read["design"]["k_i"] == pytest.approx(read["designs"]["pi"]["k_i"])
    assert {"pid", "poles", "bandwidths"} <= read["designs"].keys()
    again: Shown = quell(*LAG, *more)  # type: ignore[operator]
    assert again.code == 2
    assert "exists" in again.err


@pytest.mark.trial
def test_a_setup_with_ranges_is_tuned_for_them(quell: object, tmp_path: Path) -> None:
    """And checked on fresh samples; the result keeps plant, ranges, [tune] and feedforward."""
    path, out = tmp_path / "lag.toml", tmp_path / "tuned.toml"
    path.write_text(SETUP.format(range="friction = [0.5, 2.0]"), encoding="utf-8")
    shown: Shown = quell("tune", str(path), "--no-figures")  # type: ignore[operator]
    assert shown.code == 2
    assert "plant.friction" in shown.err
    text = SETUP.format(range="k = [0.9, 1.1]").replace(
        'kind = "linear", num = [1.0], den = [1.0, 1.0]', 'kind = "lagged-two-mass"'
    )
    text = text.replace("lagged-two-mass", "two-mass").replace('"pi"', '"bandwidths"')
    text = text.replace("m_s = 1.5", "m_s = 2.5\nm_t = 2.5\nm_ks = 3000.0\norder = 4")
    text += '[observer]\nkind = "model-free"\n[controller]\nfeedforward = true\nomega_c = 1.0\n'
    path.write_text(text, encoding="utf-8")
    shown = quell("tune", str(path), "--out", str(out), "--no-figures")  # type: ignore[operator]
    assert shown.code == 0, shown.err
    assert "20 fresh samples" in shown.out
    setup = load(out)
    assert setup.description.plant.uncertain == {"k": (0.9, 1.1)}
    assert setup.controller.observer.order == 4
    assert setup.controller.feedforward


def test_the_help_names_all_structures(quell: object) -> None:
    """As the registry has them."""
    shown: Shown = quell("tune", "--help")  # type: ignore[operator]
    words = shown.out.replace(",", " ").replace(";", " ").split()
    assert set(STRUCTURES) <= set(words)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("tune",), "setup: missing"),
        (("tune", "--num", "1", "--den", "1,x", "--dt", "0.1"), "den = '1,x'"),
        ((*LAG, "--m-s", "0.9"), "m_s = 0.9: must be above 1"),
        (("tune", "--num", "1,0", "--den", "1,3,3", "--dt", "0.1"), "zero at s = 0"),
    ],
)
def test_a_wrong_call_is_one_clear_error(
    quell: object, arguments: tuple[str, ...], message: str
) -> None:
    """With exit code 2."""
    shown: Shown = quell(*arguments, "--no-figures")  # type: ignore[operator]
    assert shown.code == 2
    assert message in shown.err


def test_a_journal_without_trials_is_refused(quell: object, tmp_path: Path) -> None:
    """It is the journal of a tuning by simulation, which ``trials`` or --trials make."""
    file = tmp_path / "lag.toml"
    plant = 'plant = { kind = "linear", num = [1.0], den = [1.0, 1.0] }'
    file.write_text(f'dt = 0.1\n{plant}\n[tune]\nstorage = "x.log"\n', encoding="utf-8")
    shown: Shown = quell("tune", str(file), "--no-figures")  # type: ignore[operator]
    assert shown.code == 2
    assert "tune.storage = 'x.log': has no effect without trials; give them" in shown.err


POINTS = """
dt = 0.01
plant = {{ kind = "linear", num = [4.0], den = [1.0, 1.0] }}
controller = {{ u_min = -5.0, u_max = 5.0 }}

[tune]
delay = 0.02
noise_std = 1e-3
{options}
[tune.schedule]
{more}
"""
TABLES = "points = [{at = 2.0, plant = {num = [1.0]}}, {at = 0.0, plant = {num = [4.0]}}]"
VALUES = 'parameter = "plant.num"\npoints = [4.0, 1.0]'
MASSES = """
dt = 0.01
plant = {{ kind = "two-mass", m1 = 1.0, k = 900.0 }}
controller = {{ u_min = -50.0, u_max = 50.0 }}
[tune]
m_ks = 3000.0
order = 2
[tune.schedule]
parameter = "plant.{key}"
points = [1.0, 2.0]
"""


def _tuned(quell: object, path: Path, text: str, *more: str) -> tuple[Shown, Any]:
    """Return what ``quell tune`` shows of a setup, and its JSON file; it writes ``tuned.toml``."""
    path.write_text(text, encoding="utf-8")
    files = ("--out", str(path.with_name("tuned.toml")), "--json", str(path.with_suffix(".json")))
    shown: Shown = quell("tune", str(path), *files, "--no-figures", *more)  # type: ignore[operator]
    assert shown.code == 0, shown.err
    return shown, json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))


@pytest.mark.trial
def test_operating_points_of_a_setup_become_a_schedule(quell: object, tmp_path: Path) -> None:
    """With the delay in its plant. The tuned file runs, and tuned again it gives the same."""
    text = POINTS.format(options="", more=TABLES)
    shown, found = _tuned(quell, tmp_path / "points.toml", text, "--m-s", "1.5")
    assert "NOT known between the points" in shown.out
    assert found["m_s"] == pytest.approx(1.5, rel=2e-3)
    schedule = found["schedule"]
    assert schedule["points"] == [0.0, 2.0]
    assert schedule["b0"][0] == pytest.approx(4.0 * schedule["b0"][1])
    setup = load(tmp_path / "tuned.toml")
    assert list(setup.controller.schedule.b0) == schedule["b0"]
    assert setup.scenario.schedule == (2.0,)
    ran = ql.simulate(setup.plant, setup.controller, setup.scenario, interpret=True)
    assert not ran.diverged
    again = (tmp_path / "tuned.toml").read_text(encoding="utf-8")
    (tmp_path / "tuned.toml").unlink()
    _, same = _tuned(quell, tmp_path / "again.toml", again, "--m-s", "1.5")
    pairs = zip(found["loops"], same["loops"], strict=True)
    assert all(one["iae"] == pytest.approx(other["iae"], rel=1e-6) for one, other in pairs)


@pytest.mark.trial
def test_the_example_of_an_extending_axis_keeps_its_bounds(quell: object, tmp_path: Path) -> None:
    """``examples/extending_axis.toml``, as docs/schedule shows it."""
    example = Path(__file__).parents[1] / "examples" / "extending_axis.toml"
    _, found = _tuned(quell, tmp_path / "axis.toml", example.read_text(encoding="utf-8"))
    assert max(each["m_s"] for each in found["loops"]) < 1.6 * 1.001
    assert found["worst_ratio"] < 1.05
    assert load(tmp_path / "tuned.toml").controller.external_signals == 1


@pytest.mark.trial
def test_points_that_are_values_of_a_parameter_are_judged_in_between(
    quell: object, tmp_path: Path
) -> None:
    """The plant is known there. The scenario's own signals, and with them the plant, stay."""
    text = MASSES.format(key="m1")
    text += "[scenario]\nduration = 0.1\nreference = 1.0\nschedule = [1.25]\n"
    shown, found = _tuned(quell, tmp_path / "masses.toml", text)
    assert "NOT known between" not in shown.out
    assert [each["of_table"] for each in found["loops"]] == [True, False, True]
    read = load(tmp_path / "tuned.toml")
    assert read.description.plant.m1 == 1.0
    assert read.scenario.schedule == (1.25,)


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        (POINTS.format(options="", more=VALUES), (), "increasing numbers"),
        (POINTS.format(options="", more="points = [1.0]"), (), "must be tables with at and plant"),
        (POINTS.format(options="", more="points = []"), (), "points is empty"),
        (
            POINTS.format(options="", more=TABLES.replace("2.0", "0.0")),
            (),
            "each must have its own",
        ),
        (POINTS.format(options="", more=f"between = 2\n{TABLES}"), (), "between = 2: of points"),
        (POINTS.format(options="", more=TABLES.replace("num", "nun")), (), "points[1]: plant.nun"),
        (POINTS.format(options="compare = []", more=TABLES), (), "tune.compare: a schedule is"),
        (POINTS.format(options="", more=TABLES), ("--trials", "3"), "tune.trials: is for a tuning"),
        (POINTS.format(options="", more=TABLES), ("--structure", "pid"), "structure = 'pid'"),
        (POINTS.format(options="", more=TABLES), ("--u-rest", "1"), "--u-rest: is the operating"),
        (MASSES.format(key="m7"), (), "tune.schedule, at 1: plant.m7: unknown"),
        (MASSES.format(key="m1").replace("plant.m1", "m1"), (), "must be a key of [plant]"),
        (MASSES.format(key="m1").replace("[1.0, 2.0]", "[2.0, 1.0]"), (), "increasing numbers"),
        (
            MASSES.format(key="m1").replace(
                "k = 900.0", "k = 900.0, uncertain = {m2 = [1.0, 2.0]}"
            ),
            (),
            "plant.uncertain: is for plants with ranges",
        ),
    ],
)
def test_operating_points_that_can_not_be_are_one_clear_error(
    quell: object, tmp_path: Path, text: str, arguments: tuple[str, ...], message: str
) -> None:
    """Before the tuning begins."""
    (tmp_path / "points.toml").write_text(text, encoding="utf-8")
    call = ("tune", str(tmp_path / "points.toml"), "--no-figures", *arguments)
    shown: Shown = quell(*call)  # type: ignore[operator]
    assert shown.code == 2
    assert message in shown.err


def test_in_a_pipe_a_line_says_every_few_seconds_how_far_the_work_is(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It goes to stderr, with the time that is left at the pace so far; none before it is due."""
    console = output.Console(file=io.StringIO())
    line, printed = r"^tuning pi, 25 %, \d+ s, about \d+ s left$", ""
    with patch.object(output, "_EVERY", 1e-3), output.progress_bar(console, "tuning") as report:
        report("tuning pi", 0.25)
        while not re.search(line, printed, re.M) and len(printed) < 1e5:
            printed += capsys.readouterr().err
    assert re.search(line, printed, re.M)
    capsys.readouterr()
    with output.progress_bar(console, "tuning") as report:
        report("tuning pi", 0.25)
    assert capsys.readouterr().err == ""
