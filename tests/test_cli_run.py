"""``quell run``, ``run-rig`` and ``replay``: setup files from the command line."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.cli.exit_codes import ExitCode
from quell.cli.report import windowed_metrics
from quell.cli.rig import exit_code
from quell.realtime import CsvSink
from quell.realtime import load as load_recording
from quell.realtime.recordings import Event
from quell.realtime.run import ModeChange, RigRun
from quell.realtime.supervisor import Cause, Mode
from quell.records.metrics import MEASURES, STEP_MEASURES
from quell.setup import EXAMPLES, load

from .commands import Shown
from .setups import TWO_MASS

SHORT = (
    'title = "A short run"'
    + TWO_MASS
    + """\
[scenario]
reference = 1.0
duration = 12.0
disturbances = [0.0, { kind = "step", height = 0.05, at = 8.0 }]
[[metrics]]
stop = 8.0
[[metrics]]
start = 8.0
"""
)


@pytest.mark.trial
def test_a_setup_is_simulated_printed_written_drawn_and_saved(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """What is written is what ``simulate`` gives for what the file describes."""
    (tmp_path / "short.toml").write_text(SHORT)
    shown = quell(
        "run", "short.toml", "--json", "out.json", "--figures", "pictures", "--save", "run.nc"
    )
    assert shown.code == 0, shown.err
    assert "A short run: two-mass-spring, dt = 0.01 s" in shown.out
    setup = load(tmp_path / "short.toml")
    run = ql.simulate(setup.plant, setup.controller, setup.scenario)
    saved = ql.Trajectory.load(tmp_path / "run.nc")
    assert (saved.log == run.log).all()
    result = json.loads((tmp_path / "out.json").read_text())
    assert [(score["start"], score["stop"]) for score in result["metrics"]] == [
        (0.0, 8.0),
        (8.0, 12.0),
    ]
    assert result["metrics"][1]["rms"] == run.metrics(8.0)["rms"]
    assert result["setup"]["observer"]["omega_o"] == 10.0
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {
        "short.png",
        "short.svg",
        "short.pdf",
    }


# A load with a period of 2 s, and a learner that waits for one with another period.
WRONG_PERIOD = """
dt = 0.02
plant = {kind = "linear", num = [1.0], den = [1.0, 0.4, 0.0]}
observer = {kind = "model-free", order = 2, b0 = 1.0, omega_o = 10.0}
controller = {omega_c = 4.0}
learner = {kind = "repetitive", period = 1.7}
[scenario]
duration = 12.0
disturbances = [{kind = "sinusoid", omega = 3.1416}]
[[metrics]]
start = 6.0
"""
WRONG_AXES = """
dt = 0.02
plant = {kind = "linear", A = [[0, 1, 0, 0], [0, -0.4, 0, 0], [0, 0, 0, 1], [0, 0, 0, -1]], B = [[0, 0], [1, 0], [0, 0], [0, 1]], E = [[0, 0], [1, 0], [0, 0], [0, 1]], C = [[1, 0, 0, 0], [0, 0, 1, 0]]}
axes = {B0 = "plant"}
scenario = {duration = 12.0, disturbances = [{kind = "sinusoid", omega = 3.1416}, {kind = "sinusoid", omega = 3.1416}]}
[[axis]]
name = "x"
observer = {kind = "model-free", order = 2, omega_o = 10.0}
controller = {omega_c = 4.0}
learner = {kind = "repetitive", period = 1.7}
[[axis]]
name = "y"
observer = {kind = "model-free", order = 2, omega_o = 10.0}
controller = {omega_c = 4.0}
learner = {kind = "harmonic", omegas = [3.1416]}
guard = {}
[[metrics]]
start = 6.0
"""


def run_of(quell: Callable[..., Shown], text: str, folder: Path) -> tuple[str, dict[str, Any]]:
    """Return what ``quell run`` prints for a setup, in one line, and its results."""
    (folder / "setup.toml").write_text(text)
    shown = quell("run", "setup.toml", "--json", "out.json", "--no-figures", "--overwrite")
    return " ".join(shown.out.split()), json.loads((folder / "out.json").read_text())


@pytest.mark.trial
def test_a_learner_without_guard_that_makes_the_error_worse_is_said(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """With the RMS of the last window, and that of the same run without learner."""
    said, result = run_of(quell, WRONG_PERIOD, tmp_path)
    plain = run_of(quell, WRONG_PERIOD.replace("learner =", "# learner ="), tmp_path)[1]
    pair = result["without_learner"]["y"]
    assert pair["rms"] == result["metrics"][-1]["rms"] > 1.2 * pair["rms_without"]
    assert pair["rms_without"] == plain["metrics"][-1]["rms"]
    assert f"RMS of r − y is {pair['rms']:.4g} in the last window" in said
    assert f"{pair['rms_without']:.4g} without; give it a guard" in said
    guarded, result = run_of(
        quell, WRONG_PERIOD.replace("[scenario]", "guard = {}\n[scenario]"), tmp_path
    )
    assert "NOT" not in guarded
    assert "without_learner" not in result
    right, result = run_of(quell, WRONG_PERIOD.replace("1.7", "2.0"), tmp_path)
    assert "NOT" not in right
    assert result["without_learner"]["y"]["rms"] < result["without_learner"]["y"]["rms_without"]


@pytest.mark.trial
def test_of_several_axes_the_one_is_named_whose_learner_makes_it_worse(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """All learners are left out of the run beside it."""
    said, result = run_of(quell, WRONG_AXES, tmp_path)
    assert "NOT better than without a learner: the RMS of r − y of x is" in said
    assert "r − y of y is" not in said
    assert set(result["without_learner"]) == {"x", "y"}


@pytest.mark.trial
def test_a_run_that_is_lost_with_a_learner_alone_says_so(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """Algorithm 1 with a rate that is far too large."""
    text = WRONG_PERIOD.replace(
        '{kind = "repetitive", period = 1.7}', '{kind = "batch-gradient", rate = 0.1}'
    )
    said, result = run_of(quell, text, tmp_path)
    assert result["diverged"]
    assert "NOT with this learner: without it the run goes on to its end" in said


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("[guard]\nbond = 1.0", "quell: wrong.toml: guard.bond: unknown; did you mean bound?"),
        (
            "[guard]\nbound = 'x'\n[learner]\nkind = 'kallman'",
            "quell: wrong.toml: learner.kind = 'kallman': unknown; did you mean kalman?",
        ),
        ("[guard", "quell: wrong.toml: not TOML"),
        (
            "[[metrics]]\nstart = 30.0",
            "quell: wrong.toml: metrics[2].start = 30: must be less than the scenario's duration, "
            "12 s",
        ),
    ],
)
def test_each_mistake_gives_a_line_and_exit_code_two(
    more: str, message: str, quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """No traceback, no figure, no file."""
    (tmp_path / "wrong.toml").write_text(SHORT + more)
    shown = quell("run", "wrong.toml", "--json", "out.json")
    assert shown.code == 2
    assert all(line.startswith("quell: wrong.toml: ") for line in shown.err.strip().splitlines())
    assert message in shown.err
    assert [path.name for path in tmp_path.iterdir()] == ["wrong.toml"]


@pytest.mark.trial
def test_a_run_that_diverges_has_its_own_exit_code_and_no_metrics(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """Not in the window in which it diverged, nor after; those before are whole, and all is written."""
    text = SHORT.replace("b0 = 1.0", "b0 = -1.0").replace("stop = 8.0", "stop = 2.0")
    (tmp_path / "wild.toml").write_text(
        text.replace("start = 8.0", "start = 2.0\n[[metrics]]\nstart = 11.5")
    )
    shown = quell("run", "wild.toml", "--json", "out.json", "--save", "run.nc", "--no-figures")
    assert (shown.code, shown.err) == (4, "")
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["diverged"]
    whole, partly, after = result["metrics"]
    assert whole["rms"] > 0.0
    for window, where in ((partly, "in"), (after, "before")):
        assert set(window) == {"start", "stop", "settling_band", "missing"}
        told = f"the run diverged at {ended(tmp_path / 'run.nc'):g} s, {where} the window"
        assert set(window["missing"].values()) == {told}
        assert set(window["missing"]) == set(MEASURES)
        assert told in shown.out
    assert "nan" not in shown.out.lower()


def ended(record: Path) -> float:
    """When a saved run ended [s]."""
    return ql.Trajectory.load(record).ended


def test_dashes_have_their_reason_and_the_band_is_printed(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """On 80 columns: a trapezoid without a target, with one and a wider band, and a load."""
    trapezoid = "reference = { kind = 'trapezoid', distance = 1.0, duration = 3.0 }"
    text = SHORT.replace("reference = 1.0", trapezoid)
    (tmp_path / "move.toml").write_text(
        text + "[[metrics]]\nstop = 8.0\ntarget = 1.0\nband = 0.1\n"
    )
    shown = quell("run", "move.toml", "--json", "out.json", "--no-figures")
    assert shown.code == 0, shown.err
    assert "Settling band: row by row ±2 %, ±2 %, ±10 % of the step." in shown.out
    assert (
        "– in 0 … 8 s (overshoot, settling time, rise time): r changes within the window: give "
        "target to judge it as a move to there.\n" in shown.out
    )
    assert "– in 8 … 12 s (overshoot, settling time, rise time): r does not step" in shown.out
    assert "…  " not in shown.out, "a column is cut"
    windows = json.loads((tmp_path / "out.json").read_text())["metrics"]
    assert [window["settling_band"] for window in windows] == [0.02, 0.02, 0.1]
    # In the third window y comes into the wide band, but still rises at the end.
    missing = [set(window["missing"]) for window in windows]
    assert missing == [set(STEP_MEASURES)] * 2 + [{"overshoot"}]
    assert windows[2]["settling_time"] > 0.0
    assert windows[0]["total_variation"] >= windows[0]["control_variation"]


def test_a_run_that_was_ended_at_a_rig_has_no_settling_time() -> None:
    """Its errors are those up to the end; a window after it has nothing, one before it all."""
    setup = SimpleNamespace(
        scenario=ql.Scenario(1.0, duration=1.0),
        windows=({"start": 0.0}, {"start": 0.0, "stop": 0.3}, {"start": 0.6}),
    )
    log = np.column_stack([np.ones(6), [0.0, 0.5, 1.0, 1.0, 1.0, 1.0], np.zeros(6)])
    run = ql.Trajectory(log, (("r", 1), ("y", 1), ("u", 1)), dt=0.1, ended=0.5)
    cut, whole, after = windowed_metrics(run, setup)  # type: ignore[arg-type]
    assert (cut["start"], cut["stop"]) == (0.0, 0.5)
    assert cut["missing"] == dict.fromkeys(STEP_MEASURES, "the run ended at 0.5 s, in the window")
    assert cut["peak_error"] == 1.0
    assert "overshoot" not in cut
    assert (whole["settling_time"], whole["missing"]) == (0.2, {})
    assert after["missing"] == dict.fromkeys(MEASURES, "the run ended at 0.5 s, before the window")
    complete = replace(run, ended=0.95)  # of a scenario of 1 s: the last sample may be before it
    setup.windows = ({"start": 0.0}, {"start": 0.21, "stop": 0.29})
    all_of_it, between = windowed_metrics(complete, setup)  # type: ignore[arg-type]
    assert all_of_it["settling_time"] == 0.2
    told = "no sample is in the window, they are 0.1 s apart"
    assert between["missing"] == dict.fromkeys(MEASURES, told)


def test_a_window_after_the_end_of_a_rig_run_has_the_cause_of_the_end() -> None:
    """Not only that there is no sample; for a run to its end the window itself is wrong."""
    log = np.column_stack([np.ones(6), [0.0, 0.5, 1.0, 1.0, 1.0, 1.0], np.zeros(6)])
    record = ql.Trajectory(log, (("r", 1), ("y", 1), ("u", 1)), dt=0.1, ended=0.5)
    parts = dict.fromkeys(("record", "timing", "tally", "counters", "notes", "rules"))
    ends = {
        "went beyond most_error": (Mode.RAMP, Cause.TRACKING_ERROR),
        "": (Mode.RAMP, Cause.COMPLETED),
    }
    for told, (mode, cause) in ends.items():
        run = RigRun(trajectory=record, changes=(ModeChange(1.2, mode, cause),), **parts)  # type: ignore[arg-type]
        assert run.metrics()["peak_error"] == 1.0
        with pytest.raises(ValueError, match="the record ends at 0.5 s") as raised:
            run.metrics(0.7)
        assert told in str(raised.value)
        assert ("ended early" in str(raised.value)) == bool(told)


def test_all_exit_codes_are_in_one_table_that_a_command_shows(quell: Callable[..., Shown]) -> None:
    """Each with its meaning; commands that use one name it."""
    codes = {code.name: code.value for code in ExitCode}
    assert codes == {
        "DONE": 0, "INTERNAL": 1, "ERROR": 2, "ENDED_BY_SAFETY": 3, "DIVERGED": 4, "NOT_PROVED": 5,
        "ALARM": 6, "BROKEN": 7, "RUNS_FAILED": 8, "NOT_VALID": 9, "INTERRUPTED": 130, "TERMINATED": 143,
    }  # fmt: skip
    told = quell("help", "exit-codes").out
    assert all(f"{code.value:>3}  {code.about}\n" in told for code in ExitCode)
    assert "quell help exit-codes" in quell("--help").out
    for command in ("run", "compare", "run-rig", "watch", "doctor"):
        assert "exit code" in quell(command, "--help").out


RIG = """
dt = 0.01
[rig]
device = "twin:two-mass"
priority = 0
approach = 0.0
safety = { settle = 10, ramp = 10, hold = 100000, most_overruns = 100000 }
[observer]
kind = "model-free"
order = 4
b0 = 1.0
omega_o = 10.0
[controller]
omega_c = 1.0
u_min = -2.0
u_max = 2.0
[scenario]
reference = 0.1
duration = 0.5
"""


@pytest.mark.trial
def test_a_rig_is_run_recorded_and_replayed(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """From a twin in this process to tables, JSON, figures and a recording, and from that through the controller once more."""
    (tmp_path / "rig.toml").write_text(RIG)
    places = (
        "--json",
        "out.json",
        "--figures",
        "pictures",
        "--mcap",
        "run.mcap",
        "--csv",
        "run.csv",
        "--save",
        "run.nc",
    )
    shown = quell("run-rig", "rig.toml", "--seconds", "0.3", "--omega-c", "1.5", *places)
    assert shown.code == 0, shown.err
    for told in (
        "the scenario is over",
        "Safety: u from -2 to 2, y from -4.95062 to 5.05062, first motion checked, settle 10 samples (0.1 s)",
        "p99.9",
        "lateness",
        "overruns",
        "ordinary scheduling, as asked for by priority 0",
    ):
        assert told in shown.out
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["completed"]
    assert result["setup"]["controller"]["omega_c"] == 1.5
    assert result["tally"]["cycles"] > 40
    assert set(result["timing"]["lateness"]) == {"p50", "p99", "p99.9", "max"}
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {
        f"{n}.{s}" for n in ("rig", "timing") for s in ("png", "svg", "pdf")
    }
    run = ql.Trajectory.load(tmp_path / "run.nc")
    assert run.ended == pytest.approx(0.3)
    again = quell("replay", "run.mcap", "rig.toml", "--json", "replay.json", "--no-figures")
    assert again.code == 0, again.err
    replayed = json.loads((tmp_path / "replay.json").read_text())
    assert set(replayed["scores"]) == {"recorded", "replayed"}
    assert quell("replay", "run.mcap", "rig.toml", "--no-figures").out.startswith(
        again.out.split("Results")[0]
    )
    twice = quell("run-rig", "rig.toml", "--mcap", "run.mcap")
    assert (twice.code, twice.err) == (
        2,
        "quell: path = 'run.mcap': the file exists; choose another name, or ask to replace it "
        "(--overwrite on the command line, overwrite=True in Python)\n",
    )


def test_a_full_disk_is_told_once_and_ends_neither_run_nor_exit_code(
    quell: Callable[..., Shown],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The other recording is complete; a trip is told though its results can't be written."""

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(CsvSink, "write", full)
    (tmp_path / "rig.toml").write_text(RIG)
    places = ("--csv", "run.csv", "--mcap", "run.mcap", "--no-figures", "--json", "out.json")
    shown = quell("run-rig", "rig.toml", "--seconds", "0.1", *places)
    assert shown.code == 0, shown.err
    assert (shown.out + shown.err + caplog.text).count("No space left on device") == 1
    cycles = json.loads((tmp_path / "out.json").read_text())["tally"]["cycles"]
    events = load_recording(tmp_path / "run.mcap")["events"].astype(int)
    # On a busy machine deadlines are skipped; their samples are filled in.
    assert np.count_nonzero(events & Event.GAP == 0) == cycles
    (tmp_path / "trip.toml").write_text(
        RIG.replace("settle = 10", "most_error = 0.05, settle = 10")
    )
    monkeypatch.setattr("quell.files.write_json", full)
    shown = quell("run-rig", "trip.toml", "--no-figures", "--json", "other.json")
    assert shown.code == 3
    assert shown.err.count("No space left on device") == 1


def test_a_shorter_run_at_a_rig_has_no_window_after_its_end(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """And a longer one has those that the duration of the file leaves out."""
    text = RIG + "[[metrics]]\nstart = 0.3\n"
    (tmp_path / "rig.toml").write_text(text)
    shown = quell("run-rig", "rig.toml", "--seconds", "0.1", "--no-figures")
    assert shown.code == 0, shown.err
    (tmp_path / "late.toml").write_text(text.replace("duration = 0.5", "duration = 0.2"))
    shown = quell("run-rig", "late.toml", "--seconds", "0.5", "--no-figures")
    assert shown.code == 0, shown.err
    shown = quell("run-rig", "late.toml", "--no-figures")
    assert shown.code == 2
    assert "metrics[0].start = 0.3: must be less than the scenario's duration" in shown.err


def test_a_trip_is_told_by_exit_code_three(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """What tripped is in the record; the metrics are of as far as it came."""
    (tmp_path / "rig.toml").write_text(RIG.replace("settle = 10", "most_error = 0.05, settle = 10"))
    shown = quell("run-rig", "rig.toml", "--json", "out.json", "--no-figures")
    assert shown.code == 3, shown.err
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["exit_code"] == 3
    assert not result["completed"]
    assert "went beyond most_error" in result["verdict"]
    assert "went beyond most_error" in shown.out


def test_each_way_to_end_has_its_exit_code() -> None:
    """0 for a run to its end, 130 where it was asked to stop, by whatever signal, 3 for all else."""

    def ended(cause: Cause) -> int:
        run = SimpleNamespace(
            completed=cause is Cause.COMPLETED,
            changes=(SimpleNamespace(cause=cause), SimpleNamespace(cause=Cause.RAMPED)),
        )
        return exit_code(run)  # type: ignore[arg-type]

    assert ended(Cause.COMPLETED) == 0
    assert {ended(cause) for cause in (Cause.STOP_REQUESTED, Cause.ZERO_REQUESTED)} == {130}
    assert {
        ended(cause)
        for cause in (
            Cause.LOST,
            Cause.STALLED,
            Cause.TRACKING_ERROR,
            Cause.F_HAT,
            Cause.NO_MEASUREMENT,
            Cause.WATCHDOG,
        )
    } == {3}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "settle = 10",
            "settle = 0",
            "rig.safety.settle = 0: must be a whole number of at least 1",
        ),
        ("settle = 10", "setle = 10", "rig.safety.setle: unknown; did you mean settle?"),
        (
            "twin:two-mass",
            "twin:two-masses",
            "rig.device = 'two-masses': must be one of torsional, torsional-identified, two-mass",
        ),
        ("twin:two-mass", "tcp://x", "rig.device = 'tcp://x': must be like udp://"),
        (
            "priority = 0",
            "priority = 100",
            "rig.priority = 100: must be a whole number from 0 to 99",
        ),
        ("u_max = 2.0", "", "rig: u_min = -2.0, u_max = inf: must be finite for a real device"),
        ("[scenario]", "[prefilter]\nkind = 'zv'\n[scenario]", "prefilter.omega: missing"),
        (
            "duration = 0.5",
            "duration = 0.5\nrest_at = [0.2]",
            "rig: rest_at = (0.2,): a real plant can't be put back to rest",
        ),
    ],
)
def test_what_no_rig_can_be_run_with_is_told(
    old: str, new: str, message: str, quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """Before the loop begins, with the file and the key in front."""
    (tmp_path / "rig.toml").write_text(RIG.replace(old, new))
    shown = quell("run-rig", "rig.toml", "--no-figures")
    assert shown.code == 2
    assert shown.err.startswith(f"quell: rig.toml: {message}")
    assert len(shown.err.splitlines()) == 1


def test_the_examples_are_printed_and_can_be_used(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """To be changed and run; without a file there is nothing to simulate."""
    for command, name in (("run", "two_mass.toml"), ("run-rig", "torsional_rig.toml")):
        assert quell(command, "--example").out == (EXAMPLES / name).read_text()
    assert load(EXAMPLES / "torsional_rig.toml").rig["device"] == "udp://127.0.0.1:5005"
    assert (
        quell("run").err
        == "quell: setup: missing; must be a TOML file, and quell run --example prints one\n"
    )
    (tmp_path / "short.toml").write_text(SHORT)
    assert (
        quell("run-rig", "short.toml").err
        == "quell: short.toml: rig: missing; give a table [rig], rig = {device = 'twin:'}\n"
    )


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_that_is_ended_while_it_is_compiled_gives_the_device_free(
    number: int,
    code: int,
    quell: Callable[..., Shown],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At once, with a line; what stood before minds the signal again."""
    closed: list[bool] = []
    device = SimpleNamespace(close=lambda: closed.append(True))
    monkeypatch.setattr("quell.realtime.open_device", lambda url, dt, *rest: device)
    monkeypatch.setattr(
        "quell.realtime.run_rig",
        lambda *arguments, **options: os.kill(os.getpid(), number),
    )
    monkeypatch.setattr("quell.cli.exit_codes.os._exit", sys.exit)  # which would end this process
    before = signal.getsignal(number)
    (tmp_path / "rig.toml").write_text(RIG)
    shown = quell("run-rig", "rig.toml", "--no-figures")
    assert (shown.code, shown.err) == (code, "quell: interrupted\n")
    assert closed == [True]
    assert signal.getsignal(number) is before


def test_an_extra_that_is_not_installed_is_named_in_a_line(
    quell: Callable[..., Shown], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With what to install, and no traceback."""
    monkeypatch.setitem(sys.modules, "serial", None)
    tried = quell("run-rig", "--device", "serial:///dev/none", "--no-figures")
    assert tried.code == 2
    assert tried.err.startswith("quell: a serial line needs serial, which")
    assert tried.err.count("\n") == 1
    assert "quell-control[serial]" in tried.err
