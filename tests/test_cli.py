"""The command line and what importing costs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cyclopts
import matplotlib.pyplot as plt
import pytest

from quell import experiments
from quell.experiments.common import save_figure
from quell.identification import Identified
from quell.kernels.cache import compile_time

from .commands import Shown, run_python


def test_help_and_version_answer(quell: Callable[..., Shown]) -> None:
    """The commands are listed; the help comes at once, as commands import what they need when they run."""
    command = [sys.executable, "-X", "importtime", "-m", "quell", "--help"]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "quell COMMAND" in ended.stdout
    assert "reproduce" in ended.stdout
    imported = {line.rpartition("|")[2].strip() for line in ended.stderr.splitlines()}
    assert "quell.cli.app" in imported
    assert not imported & {"numpy", "numba", "scipy", "matplotlib"}
    assert "two-mass" in quell("reproduce", "--help").out
    assert quell("--version").out.strip() == __import__("quell").__version__


@pytest.mark.trial
@pytest.mark.compiled
def test_the_study_is_printed_written_and_drawn(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """Tables, JSON in its fixed form, figures as PNG, SVG and PDF; without a terminal."""
    places = ("--json", "out.json", "--figures", "pictures")
    shown = quell("reproduce", "two-mass", "--dt", "0.01", *places)
    assert shown.code == 0, shown.err
    assert "Claims of section IV" in shown.out
    assert "nan" not in shown.out.lower()
    result = json.loads((tmp_path / "out.json").read_text())
    assert set(result) >= {"settings", "controllers", "claims"}
    assert list(result["controllers"]) == [
        "MF-ESO", "MB-ESO", "L-ESO", "L-ESO (Algorithm 1)", "MF-ESO (3x bandwidth)", "MB-ESO (3x bandwidth)",
        "MF-ESO m = 2", "MB-ESO m = 2", "L-ESO, guarded",
    ]  # fmt: skip
    assert "ranges" not in result
    for scores in result["controllers"].values():
        assert set(scores) >= {
            "overshoot",
            "settling_time",
            "disturbance_peak",
            "disturbance_rms",
            "control_variation",
        }
        assert all(isinstance(value, float) for value in scores.values())
    for claim in result["claims"]:
        assert set(claim) >= {"claim", "paper", "measured", "holds"}
    assert result["settings"]["dt"] == 0.01
    names = {"position", "control", "learning", "algorithm-1"}
    assert {p.name for p in (tmp_path / "pictures").iterdir()} == {
        f"{n}.{s}" for n in names for s in ("png", "svg", "pdf")
    }


def test_the_torsional_experiment_has_a_longest_sample_time(quell: Callable[..., Shown]) -> None:
    """The message says why; ``.ci/run`` judges what the command prints, writes and draws."""
    wrong = quell("reproduce", "torsional", "--dt", "0.01")
    assert wrong.code == 2
    assert (
        wrong.err.strip()
        == "quell: dt = 0.01: must be from 0.0001 to 0.002 s, as the loops have up to 90 rad/s"
    )


@pytest.mark.trial
@pytest.mark.compiled
def test_the_guards_trial_is_printed_written_and_drawn(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """A table a line a kind, bars, JSON, and a figure as PNG, SVG and PDF; without a terminal.

    The turncoat of this seed is compiled in the guard's own tests.
    """
    shown = quell(
        "stress",
        "--runs",
        "12",
        "--honest",
        "2",
        "--seed",
        "6",
        "--json",
        "out.json",
        "--figures",
        "pictures",
    )
    assert shown.code == 0, shown.err
    assert all(
        kind in shown.out for kind in ("opposite sign", "turncoat", "all adversaries", "honest")
    )
    assert "…" not in shown.out, "a column is cut"
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["settings"]["seed"] == 6
    assert result["hostile"]["lost"] == 0
    assert "Honest loops, minute of load: 0.00 % have a mean ratio above 1.05" in shown.out
    assert "means over 4 draws" in " ".join(shown.out.split())
    assert {p.name for p in (tmp_path / "pictures").iterdir()} == {
        "stress.png",
        "stress.svg",
        "stress.pdf",
    }
    wrong = quell("stress", "--runs", "-3")
    assert wrong.code == 2
    assert wrong.err.strip() == "quell: runs = -3: must be a whole number from 0 to 1000000"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--dt", "-1"), "dt = -1.0: must be finite and greater than zero"),
        (("--dt", "nan"), "dt = nan: must be finite and greater than zero"),
        (("--omega-o", "0"), "omega_o = 0.0: must be finite and greater than zero"),
        (("--seed", "-1"), "seed = -1: must be a whole number"),
        (("--seed", "1.5"), "--seed = '1.5': must be a whole number"),
        (("--dt", "fast"), "dt"),
        (("--json", "nowhere/out.json"), "the folder 'nowhere' must exist"),
        (("--colour", "red"), "colour"),
    ],
)
def test_a_mistake_gives_one_line_and_exit_code_two(
    arguments: tuple[str, ...], message: str, quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """No traceback, nothing written."""
    shown = quell("reproduce", "two-mass", *arguments)
    assert shown.code == 2
    assert message in shown.err
    assert shown.err.startswith("quell: ")
    assert len(shown.err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("seconds", "lines"), [(12.3, 1), (0.2, 0)])
def test_a_command_says_how_long_it_compiled(
    quell: Callable[..., Shown],
    monkeypatch: pytest.MonkeyPatch,
    seconds: float,
    lines: int,
) -> None:
    """One line at the end, if it took long enough to be noticed."""

    def compiling(self: object, arguments: list[str]) -> None:
        compile_time.seconds += seconds

    monkeypatch.setattr(cyclopts.App, "__call__", compiling)
    shown = quell("run")
    assert shown.err.count("compiled code for 12.3 s; later runs load it") == lines


def test_an_old_result_outlives_a_run_that_fails(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """What can't be written is said before the work is done, and nothing is overwritten until it is."""
    (tmp_path / "keep.json").write_text("old")
    (tmp_path / "file").write_text("")
    shown = quell("reproduce", "two-mass", "--json", "keep.json", "--figures", "file")
    assert shown.code == 2
    assert "figures = 'file': must be a folder that can be made" in shown.err
    assert (tmp_path / "keep.json").read_text() == "old"


EXISTING = [
    ("reproduce two-mass", "position.svg"),
    ("reproduce torsional", "torsional-control.png"),
    ("reproduce acc", "acc-spread.png"),
    ("stress", "stress.png"),
    ("compare", "compare.svg"),
    ("run setup.toml", "setup.png"),
    ("run-rig --device twin:torsional", "timing.svg"),
    ("replay run.csv", "run-replayed.png"),
    ("identify data.csv", "identified.png"),
]


@pytest.mark.parametrize(("command", "figure"), EXISTING, ids=lambda text: text.partition(".")[0])
def test_no_command_replaces_a_file_unless_asked(
    command: str, figure: str, quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """It refuses before the work, in one line."""
    from quell.setup import EXAMPLES

    (tmp_path / "setup.toml").write_text((EXAMPLES / "two_mass.toml").read_text())
    (tmp_path / "data.csv").write_text(
        "t,u,y\n" + "".join(f"{0.1 * i:.1f},0,{i % 2}\n" for i in range(99))
    )
    (tmp_path / "pictures").mkdir()
    old = [tmp_path / "out.json", tmp_path / "pictures" / figure]
    for path in old:
        path.write_text("precious")
    for place in ("--json out.json", "--figures pictures"):
        shown = quell(*command.split(), *place.split())
        assert (shown.code, shown.out) == (2, "")
        assert (
            "the file exists; choose another name, or ask to replace it (--overwrite" in shown.err
        )
        assert len(shown.err.splitlines()) == 1
    assert [path.read_text() for path in old] == ["precious"] * 2
    assert len(list((tmp_path / "pictures").iterdir())) == 1
    assert not (tmp_path / "quell-figures").exists()


def test_two_outputs_have_two_files(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """Otherwise the second would replace the first."""
    from quell.setup import EXAMPLES

    (tmp_path / "setup.toml").write_text((EXAMPLES / "two_mass.toml").read_text())
    shown = quell("run", "setup.toml", "--json", "out.nc", "--save", "out.nc")
    assert shown.code == 2
    assert "out.nc': must be a file for one output, is for two" in shown.err


@pytest.mark.parametrize("name", ["x.mat", "x.xyz", "x"])
def test_a_record_is_saved_as_what_its_name_says(
    name: str, quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """Only NetCDF and CSV are written; another ending is refused before the run."""
    from quell.setup import EXAMPLES

    (tmp_path / "setup.toml").write_text((EXAMPLES / "two_mass.toml").read_text())
    shown = quell("run", "setup.toml", "--no-figures", "--save", name)
    assert shown.code == 2
    assert f"--save = '{name}': must end in .nc, for NetCDF, or in .csv" in shown.err
    assert not (tmp_path / name).exists()


def test_a_figure_is_written_as_png_svg_and_pdf(tmp_path: Path) -> None:
    """With all that is in it, TrueType fonts in the PDF, and the same bytes each time; commands in these tests write theirs without the axes."""
    figure = plt.figure()
    figure.subplots().plot([0.0, 1.0], [0.0, 1.0], gid="the-line")
    png, svg, pdf = save_figure(figure, tmp_path / "pictures", "step")
    assert (png.name, svg.name, pdf.name) == ("step.png", "step.svg", "step.pdf")
    assert b"/Type /Font /Subtype /Type0" in pdf.read_bytes()
    assert b"CreationDate" not in pdf.read_bytes()
    assert plt.imread(png).min() == 0.0
    assert "the-line" in svg.read_text(encoding="utf-8")


@pytest.mark.trial
@pytest.mark.compiled
def test_a_command_can_be_run_twice_and_replaces_where_asked(
    quell: Callable[..., Shown], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Figures get a folder with a number; other files want --overwrite."""
    light = staticmethod(lambda: plt.figure().subplots(1, 1, squeeze=False)[0])
    monkeypatch.setattr(Identified, "plot", light)  # seven axes take a second to write
    rows = "".join(f"{0.1 * i:.1f},{(i // 7) % 2},{(i // 7) % 2}\n" for i in range(200))
    (tmp_path / "data.csv").write_text("t,u,y\n" + rows)
    identify = ("identify", "data.csv", "--order", "1", "--integrators", "0", "--json", "out.json")
    first = quell(*identify)
    assert first.code == 0, first.err
    assert "in quell-figures/" in first.out
    assert quell(*identify).code == 2
    second = quell(*identify, "--overwrite")
    assert second.code == 0, second.err
    assert "in quell-figures-2/" in second.out
    for folder in ("quell-figures", "quell-figures-2"):
        assert (tmp_path / folder / "identified.png").stat().st_size > 1000
    assert quell("excite", "u.csv").code == 0
    old = (tmp_path / "u.csv").read_bytes()
    assert "the file exists" in quell("excite", "u.csv", "--seed", "1").err
    assert (tmp_path / "u.csv").read_bytes() == old
    assert quell("excite", "u.csv", "--seed", "1", "--overwrite").code == 0
    assert (tmp_path / "u.csv").read_bytes() != old


@pytest.mark.trial
def test_neither_importing_quell_nor_simulating_imports_what_it_does_not_need() -> None:
    """Numba, scipy, xarray, matplotlib and python-control come when they are used; plots and files cost a second."""
    code = (
        "import sys, quell as ql\n"
        "heavy = {'numba', 'scipy', 'xarray', 'matplotlib', 'control', 'numpy'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
        "ql.ADRC(ql.ESO.model_free(2, 1.0, 10.0, 0.01), 1.0); ql.Trajectory; ql.simulate\n"
        "unused = {'xarray', 'matplotlib', 'control', 'rich', 'pydantic'}\n"
        "print(sorted(unused & set(sys.modules)), 'numba' in sys.modules)\n"
    )
    ended = run_python(code)
    assert ended.stdout.splitlines() == ["[]", "[] True"]


@pytest.mark.trial
def test_an_experiment_does_not_wait_for_the_others() -> None:
    """Neither theirs nor what they import is loaded; each is found as an attribute."""
    code = (
        "import sys, quell as ql, quell.experiments.two_mass_spring\n"
        "others = ('quell.experiments.acc', 'quell.experiments.stress', 'quell.setup', 'quell.tuning')\n"
        "print([name for name in sys.modules if name.startswith(others)], end=' ')\n"
        "print(*(getattr(ql.experiments, name).__name__ for name in ql.experiments.__all__))\n"
    )
    ended = run_python(code)
    names = ("acc", "compare", "over_seeds", "stress", "torsional", "two_mass_spring")
    assert ended.stdout.split() == ["[]", *(f"quell.experiments.{name}" for name in names)]
    with pytest.raises(AttributeError, match="has no attribute 'three_masses'"):
        experiments.three_masses  # noqa: B018


@pytest.mark.parametrize(
    ("ending", "code"),
    [("pass", 0), ("sys.exit(4)", 4), ("sys.exit(None)", 0), ("1 / 0", 1)],
)
def test_the_process_ends_when_all_is_written_and_closed(ending: str, code: int) -> None:
    """Exit code, output and handlers are those of Python; only the memory is not cleared first."""
    script = f"""
import atexit, sys
import quell.cli
from quell.__main__ import run

class Memory:
    def __del__(self): print("cleared", flush=True)

def main():
    sys.memory = Memory()
    atexit.register(print, "closed")
    print("result")
    {ending}

quell.cli.main = main
run()
"""
    ended = run_python(script, check=False)
    assert ended.returncode == code
    assert ended.stdout.split() == ["result", "closed"]
    assert ("ZeroDivisionError" in ended.stderr) == (code == 1)


@pytest.mark.trial
def test_a_command_whose_reader_has_ended_does_its_work(tmp_path: Path) -> None:
    """As after ``| head``: the file is written, nothing is printed as an error, and the code is 0."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "quell", "excite", "u.csv"]
    ended = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    os.close(writing)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert (tmp_path / "u.csv").stat().st_size > 1000


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, a full disk")
def test_output_that_can_not_be_written_is_an_error_at_the_end_too() -> None:
    """What is in the buffer when a command has done its work is not lost without a word."""
    script = (
        "import quell.cli as cli; cli.main = lambda: print(1); import quell.__main__ as m; m.run()"
    )
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-c", script]
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert ended.returncode != 0
    assert "No space left" in ended.stderr


def test_every_public_name_can_be_had() -> None:
    """The table of contents is true."""
    import quell as ql

    for name in ql.__all__:
        assert getattr(ql, name) is not None
    assert set(ql.__all__) <= set(dir(ql))
    assert all(name in ql.__all__ or name.startswith("__") for name in dir(ql))
    with pytest.raises(AttributeError, match="has no attribute 'PID2'"):
        ql.PID2  # noqa: B018
