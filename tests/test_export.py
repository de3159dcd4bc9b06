"""``ql.export.c`` and ``quell export``: a controller as a library in C."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.base import control, status_flags
from quell.export import c_files
from quell.export.library.exported import stack_of
from quell.export.library.precision import Comparison, compared
from quell.export.library.vectors import filled, golden_vectors
from quell.features import Periodic, State
from quell.kernels import dispatch
from quell.kernels.dispatch import as_python
from quell.types import Status

from .cases import cases
from .commands import in_this_process
from .contracts.python_models import python_learners
from .in_c import EXACT, built, needs_gcc
from .setups import TWO_MASS

GCC, GPP = shutil.which("gcc"), shutil.which("g++")

DT = 0.01
LIMITS = {"u_min": -2.0, "u_max": 3.0, "rate_limit": 60.0}
OBSERVER = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=DT)
ADRC = ql.ADRC(OBSERVER, 1.5, **LIMITS)
PID = ql.baselines.PID(4.0, 2.0, 1.0, tf=0.05, dt=DT, **LIMITS)
LEARNING = ql.ADRC(OBSERVER, 1.5, learner=ql.learners.Kalman(), guard=ql.Guard(), **LIMITS)
HAN = ql.controllers.Prefiltered(
    ql.ADRC(OBSERVER, 1.5, feedforward=True, **LIMITS), ql.controllers.TrackingDifferentiator(2.0)
)
CHAIN = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [1.0, 0.0])
SCENARIO = ql.Scenario(
    reference=ql.signals.Sinusoid(omega=1.5),
    noise=ql.signals.BandLimitedNoise(1e-8, 0.01),
    duration=3.0,
)


def exported(
    folder: Path, controller: Any = ADRC, precision: str = "double", **options: Any
) -> Any:
    """Export a controller as ``servo``, in single precision without comparison."""
    given = {"name": "servo", "accept": True} | options
    return ql.export.c(controller, folder / "out", precision=precision, **given)


def golden_test(folder: Path) -> Path:
    """Compile the test with golden vectors; return the program."""
    source = folder / "out/src"
    sources = (folder / "out/test_servo.c", source / "servo.c")
    return built(folder / "test_servo", sources, "-I", source)


def outcome(program: Path, *arguments: str) -> tuple[int, str]:
    """Run a program; return its exit code and output."""
    done = subprocess.run([program, *arguments], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout


RLS = ql.ADRC(OBSERVER, 1.5, learner=ql.learners.RLS(State() + Periodic(highest=2)), **LIMITS)
MOVING = ql.ADRC(
    OBSERVER, 1.5, learner=ql.learners.Kalman(), guard=ql.Guard(), feedforward=True, **LIMITS
)
BY_MODEL = ql.ADRC(
    ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=DT, delay=DT),
    1.5,
    feedforward=ql.Feedforward((0.3, 0.1, 0.7), coulomb=0.2, coulomb_speed=0.5, constant=-0.1),
    **LIMITS,
)
RAMPS = ql.ADRC(ql.ESO.model_free(2, 1.5, 12.0, DT, disturbance_order=2), 1.5, **LIMITS)
PARABOLAS = ql.ADRC(ql.ESO.cascade(2, 1.5, 12.0, DT, disturbance_order=3), 1.5, **LIMITS)
NONLINEAR = ql.ADRC(ql.ESO.nonlinear(2, 1.5, 12.0, DT, delta=0.05), 1.5)


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize(
    ("controller", "precision"),
    [
        pytest.param(PID, "double", id="PID"),
        pytest.param(PID, "single", id="PID, single"),
        pytest.param(LEARNING, "double", id="Kalman and guard"),
        pytest.param(LEARNING, "single", id="Kalman and guard, single"),
        pytest.param(HAN, "double", id="prefilter"),
        pytest.param(NONLINEAR, "single", id="nonlinear observer, single"),
        pytest.param(RLS, "single", id="RLS, single"),
        pytest.param(MOVING, "double", id="feedforward"),
        pytest.param(MOVING, "single", id="feedforward, learner and guard, single"),
        pytest.param(RAMPS, "single", id="two extended states, single"),
        pytest.param(PARABOLAS, "double", id="cascade of three extended states"),
        pytest.param(BY_MODEL, "double", id="feedforward by a model"),
        pytest.param(BY_MODEL, "single", id="feedforward by a model, single"),
    ],
)
def test_the_c_code_repeats_the_kernels_bit_for_bit(
    tmp_path: Path, controller: Any, precision: str
) -> None:
    """With noise, NaN, saturation, manual operation, retuning and restarts; no warning in C99."""
    exported(tmp_path, controller, precision)
    code, text = outcome(golden_test(tmp_path), "0")
    assert code == 0, text
    assert "largest difference 0 ulp" in text


def test_the_run_of_the_golden_vectors_has_what_can_happen() -> None:
    """Held values, both limits, u beside manual operation, and a continuation without a jump."""
    vectors = golden_vectors(ADRC, ql.export.c_source(ADRC))
    flags = Status(int(np.bitwise_or.reduce([row.status for row in vectors.rows])))
    held = Status.MEASUREMENT_HELD | Status.REFERENCE_HELD
    u = Status.SATURATED | Status.RATE_LIMITED | Status.CONTROL_HELD
    assert flags == held | u | Status.HELD
    names = [row.action.name for row in vectors.rows]
    assert set(names) == {
        "STEP",
        "APPLIED",
        "TRACK",
        "HAND_OVER",
        "LIMIT",
        "FREE",
        "RESET",
        "START",
        "HELD",
        "RELEASED",
    }
    for name in ("HAND_OVER", "START"):
        at = names.index(name)
        before = vectors.rows[at - 1].given if name == "HAND_OVER" else vectors.rows[at].given
        assert vectors.rows[at].u == pytest.approx(before, rel=1e-6)
    limited = vectors.rows[names.index("LIMIT") : names.index("FREE")]
    assert max(row.u for row in limited) == vectors.limit < 3.0


@cases("controller", [ADRC, PID, HAN], ids=["ADRC", "PID", "prefilter"])
@cases("value", [math.nan, math.inf, -1e300])
def test_no_function_of_the_export_takes_a_u_that_is_no_number(
    controller: Any, value: float
) -> None:
    """It is ignored and flagged, and each later u is a number within the limits: as the C does, which is translated from this."""
    design, state = controller.parameters, controller.initial_state()
    with as_python():
        for _ in range(3):
            last = control(design, state, 1.0, 0.0)
        c_files.set_applied(design, state, value)
        assert status_flags(design, state) & Status.CONTROL_HELD
        if controller is not PID:
            c_files.track(design, state, 1.0, 0.0, value)
            assert status_flags(design, state) & Status.CONTROL_HELD
            c_files.start_from(design, state, 50, value, 0.0, 1.0)
            c_files.start_from(design, state, 50, 0.0, value, 1.0)
            assert status_flags(design, state) & Status.CONTROL_HELD
            c_files.start_from(design, state, 50, 0.0, 0.0, value)
            assert status_flags(design, state) & Status.REFERENCE_HELD
        later = [control(design, state, 1.0, 0.0) for _ in range(20)]
    assert math.isfinite(last)
    assert all(-3.0 <= u <= 3.0 for u in later)


@pytest.mark.trial
@needs_gcc
def test_a_step_without_the_derivatives_of_the_reference_does_not_compile(tmp_path: Path) -> None:
    """They are arguments of step and track, as many as are fed forward; none without feedforward."""
    program = tmp_path / "forgets.c"
    for controller, given, fits in (
        (MOVING, "1.0, 0.0", False),
        (MOVING, "1.0, 0.0, 0.1", False),
        (MOVING, "1.0, 0.0, 0.1, 0.2", True),
        (BY_MODEL, "1.0, 0.0, 0.1, 0.2", False),
        (BY_MODEL, "1.0, 0.0, 0.1, 0.2, 0.3", True),
        (ADRC, "1.0, 0.0", True),
    ):
        exported(tmp_path, controller, overwrite=True)
        calls = f"servo_step(s, {given}) + servo_track(s, 1.0, {given});"
        program.write_text(
            f'#include "servo.h"\ndouble u(servo_state *s)\n{{\n    return {calls}\n}}\n'
        )
        command = ["gcc", "-fsyntax-only", "-I", tmp_path / "out/src", program]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (done.returncode == 0) is fits, done.stderr
        assert fits or "too few arguments" in done.stderr


@pytest.mark.trial
@needs_gcc
def test_golden_vectors_find_a_wrong_controller(tmp_path: Path) -> None:
    """Another gain, or a missing test for NaN: the program fails and names the first sample."""
    exported(tmp_path)
    source = tmp_path / "out/src/servo.c"
    text = source.read_text()
    for old, new, first in (
        ("LARGEST_SIGNAL;", "LARGEST_SIGNAL || value != value;", "sample 0:"),
        ("1.5, /* b0 */", "1.5000000001, /* b0 */", "sample 3:"),
    ):
        assert old in text
        source.write_text(text.replace(old, new))
        code, shown = outcome(golden_test(tmp_path))
        assert code == 1
        assert first in shown
        assert "FAILED" in shown


@needs_gcc
def test_fast_math_is_refused(tmp_path: Path) -> None:
    """It would remove the tests for NaN."""
    exported(tmp_path)
    command = ["gcc", "-Ofast", "-fsyntax-only", tmp_path / "out/src/servo.c"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "-ffast-math removes the tests for NaN" in done.stderr


@pytest.mark.trial
@pytest.mark.skipif(GPP is None, reason="g++ is missing")
@pytest.mark.parametrize("precision", ["double", "single"])
def test_everything_compiles_as_cpp_and_the_examples_compile(
    tmp_path: Path, precision: str
) -> None:
    """Source and test as C++, the timer interrupt of README.md as C, the sketch with a stand-in for Arduino."""
    folder = exported(tmp_path, HAN, precision).folder
    (interrupt,) = re.findall(r"```c\n(#include.*?)```", (folder / "README.md").read_text(), re.S)
    (tmp_path / "interrupt.c").write_text(interrupt)
    (tmp_path / "arduino.h").write_text(
        "enum { A0 };\nint analogRead(int), constrain(int, int, int);\n"
        "unsigned long micros(void);\nvoid analogWrite(int, int);\n"
    )
    sketch = folder / "examples/servo/servo.ino"
    warnings = ("-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-I", folder / "src")
    for command in (
        ("g++", "-std=c++11", "-x", "c++", folder / "src/servo.c", folder / "test_servo.c"),
        ("gcc", "-std=c99", tmp_path / "interrupt.c"),
        ("g++", "-std=c++11", "-include", tmp_path / "arduino.h", "-x", "c++", sketch),
    ):
        done = subprocess.run([*command, *warnings], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


def test_the_folder_has_all_files_and_no_placeholder(tmp_path: Path) -> None:
    """A project for CMake and a library for Arduino and PlatformIO; text files of ASCII but for README.md."""
    result = exported(tmp_path)
    names = {str(path.relative_to(result.folder)) for path in result.files}
    found = {str(p.relative_to(result.folder)) for p in result.folder.rglob("*") if p.is_file()}
    assert names == found == {
        "src/servo.h", "src/servo.c", "test_servo.c", "CMakeLists.txt", "README.md",
        "library.properties", "library.json", "idf_component.yml", "keywords.txt", "LICENSE",
        "examples/servo/servo.ino",
    }  # fmt: skip
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    for path in result.files:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"@\w+@", text), path
        assert path.suffix == ".md" or text.isascii(), path
    with pytest.raises(KeyError):
        filled("README.md", {"name": "servo"})


@cases(
    ("name", "rule"),
    [
        ("2fast", "must be a C identifier"),
        ("_servo", "must be a C identifier"),
        ("sérvo", "must be a C identifier"),
        ("a b", "must be a C identifier"),
        ("", "must be a C identifier"),
        ("while", "is a keyword of C or C++"),
        ("class", "is a keyword of C or C++"),
        ("Math", "is a standard header of C, C++ or Arduino"),
        ("x" * 64, "63 characters"),
        ("test", "is a target of CMake itself"),
        ("Install", "is a target of CMake itself"),
    ],
)
def test_a_name_that_c_can_not_use_is_refused(tmp_path: Path, name: str, rule: str) -> None:
    """Nothing is written."""
    with pytest.raises(ValueError, match=re.escape(rule)):
        exported(tmp_path, name=name)
    assert not any(tmp_path.iterdir())


@pytest.mark.trial
def test_a_folder_with_files_is_left_alone_unless_asked(tmp_path: Path) -> None:
    """With overwrite only the files of the export are replaced."""
    folder = tmp_path / "out"
    folder.mkdir()
    exported(tmp_path)  # an empty folder
    (folder / "mine.txt").write_text("mine")
    (folder / "src/servo.h").write_text("old")
    with pytest.raises(ValueError, match=r"the folder has files .*--overwrite"):
        exported(tmp_path)
    assert (folder / "src/servo.h").read_text() == "old"
    exported(tmp_path, overwrite=True)
    assert (folder / "src/servo.h").read_text().startswith("/*")
    assert (folder / "mine.txt").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_place_that_can_not_be_written_is_named(tmp_path: Path) -> None:
    """A file in place of the folder, a missing parent, a folder in place of a file."""
    (tmp_path / "out").write_text("a file")
    with pytest.raises(ValueError, match="must be a folder, is a file"):
        exported(tmp_path)
    with pytest.raises(ValueError, match="must exist"):
        exported(tmp_path / "missing")
    (tmp_path / "out").unlink()
    (tmp_path / "out/src/servo.h").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"servo\.h.*in the way"):
        exported(tmp_path, overwrite=True)
    assert [path.name for path in (tmp_path / "out").rglob("*")] == ["src", "servo.h"]


@cases(
    ("controller", "precision", "rule"),
    [
        (
            ql.ADRC(OBSERVER, 1.5, learner=python_learners()["PythonModel"]),
            "double",
            "calls Python at each",
        ),
        (
            ql.ADRC(ql.ESO.model_free(2, 1e39, 12.0, DT), 1.5),
            "single",
            "b0 = 1e[+]39: above the range of single precision",
        ),
        (42, "double", "controller = 42"),
        (ADRC, "half", "precision = 'half'"),
    ],
)
def test_what_can_not_be_exported_is_named_and_nothing_is_written(
    tmp_path: Path, controller: Any, precision: str, rule: str
) -> None:
    """Python adapters, numbers out of range, what is no controller."""
    with pytest.raises(ValueError, match=rule):
        exported(tmp_path, controller, precision)
    assert not any(tmp_path.iterdir())


@pytest.mark.trial
def test_single_precision_is_compared_and_refused_where_it_differs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Order 4 with a fast observer: the rounding of y times omega_o^5 exceeds u."""
    monkeypatch.setattr(dispatch, "interpret_all", True)  # short runs need no compilation
    loop = {"plant": CHAIN, "scenario": SCENARIO, "accept": False}
    good = exported(tmp_path, ADRC, "single", **loop).comparison
    assert 0.0 < good.u < 1e-4 < good.u_noise
    assert good.y < good.u
    shutil.rmtree(tmp_path / "out")
    hasty = ql.ADRC(ql.ESO.model_free(4, 1.0, 60.0, DT), 2.0, u_min=-90.0, u_max=90.0)
    loop |= {"plant": ql.plants.two_mass_spring(), "scenario": replace(SCENARIO, noise=0.0)}
    with pytest.raises(
        ValueError, match=r"changes u by .* 1 % is the limit, or 5 % .*lower omega_o"
    ):
        exported(tmp_path, hasty, "single", **loop)
    assert not any(tmp_path.iterdir())
    accepted = exported(tmp_path, hasty, "single", **loop | {"accept": True})
    assert accepted.comparison.u > 0.01


def test_what_a_user_sees_decides_whether_single_precision_is_accepted() -> None:
    """The error of y and the activity of u; a count that flips changes u alone."""
    seen = {"error": 0.04, "activity": 0.09}
    Comparison(0.2, 0.01, None, None, False, **seen).check(ADRC)
    for other in ({"error": 0.06}, {"activity": 0.11}):
        worse = Comparison(0.2, 0.01, None, None, False, **seen | other)
        with pytest.raises(
            ValueError, match=r"RMS error of y by \+\d %, the activity of u by \+\d"
        ):
            worse.check(ADRC)
        worse._replace(u=0.01).check(ADRC)
    with pytest.raises(ValueError, match="the run diverges"):
        Comparison(0.2, 0.01, None, None, True, **seen).check(ADRC)


def test_a_flipped_count_of_a_coarse_encoder_does_not_refuse_single_precision(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The runs part after it, so u differs by more than 1 %; error and activity are the same."""
    monkeypatch.setattr(dispatch, "interpret_all", True)
    motor = ql.plants.LinearPlant([[0.0, 1.0], [0.0, -4.0]], [0.0, 50.0], [1.0, 0.0])
    plant = ql.plants.encoded(motor, 400)
    controller = ql.ADRC(ql.ESO.model_free(2, 50.0, 200.0, 2e-3), 20.0, u_min=-10.0, u_max=10.0)
    scenario = ql.Scenario(ql.signals.Sinusoid(1.0, 3.0), 3.0)
    found = compared(plant, controller, scenario)
    assert found.u > 0.01
    assert abs(found.error) < 0.05
    assert abs(found.activity) < 0.1
    found.check(controller)


def saturated(reference: Any, duration: float, **limits: Any) -> tuple[Any, Any, ql.Scenario]:
    """Return a servo whose observer multiplies the rounding of far positions, and a scenario."""
    controller = ql.ADRC(ql.ESO.model_free(2, 5000.0, 300.0, 2.5e-4), 60.0, **limits)
    plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 5000.0], [1.0, 0.0])  # 2e-4 kg m²
    return plant, controller, ql.Scenario(reference=reference, duration=duration)


@pytest.mark.trial
def test_single_precision_is_not_compared_where_u_lies_at_its_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There u is the limit in both. Nothing is written, but when accepted, and the figures are NaN."""
    monkeypatch.setattr(dispatch, "interpret_all", True)
    plant, controller, far = saturated(62_800.0, 0.1, u_min=-1.0, u_max=1.0)
    loop = {"plant": plant, "scenario": far, "accept": False}
    rule = r"NOT compared with double, as u lies at its limits in 100 % .*give a scen.*--accept"
    with pytest.raises(ValueError, match=rule):
        exported(tmp_path, controller, "single", **loop)
    assert not any(tmp_path.iterdir())
    accepted = exported(tmp_path, controller, "single", **loop | {"accept": True}).comparison
    assert math.isnan(accepted.u)
    assert math.isnan(accepted.y)
    assert [each.name for each in accepted.signals if each.single is None] == ["u", "y"]


@pytest.mark.trial(cases=r"20\.0-0\.3-limits0")
@pytest.mark.parametrize(
    ("reference", "duration", "limits"),
    [(20.0, 0.3, {"u_min": -1.0, "u_max": 1.0}), (5.0, 0.2, {"rate_limit": 300.0})],
)
def test_u_is_compared_in_the_samples_off_its_limits(
    reference: float, duration: float, limits: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At limits of u and of its rate it is the same in both, and would make the difference smaller."""
    monkeypatch.setattr(dispatch, "interpret_all", True)
    plant, controller, scenario = saturated(reference, duration, **limits)
    found = compared(plant, controller, scenario)
    assert 0.04 < found.limited < 0.5
    double, single = (ql.simulate(plant, controller, scenario, precision=precision)
                      for precision in ("double", "single"))  # fmt: skip
    cut = int(Status.SATURATED | Status.RATE_LIMITED)
    flags = double["status"].astype(int) | single["status"].astype(int)
    off = (flags & cut) == 0
    change = np.linalg.norm((single["u"] - double["u"])[off]) / np.linalg.norm(double["u"][off])
    assert found.u == pytest.approx(change)
    assert found.u > 1.1 * np.linalg.norm(single["u"] - double["u"]) / np.linalg.norm(double["u"])
    assert found.limited == pytest.approx(1.0 - np.mean(off))


def test_the_refusal_names_what_would_help() -> None:
    """For a process whose points are too close, their distance; else the rounding of y."""
    worse = Comparison(0.2, 0.01, None, None, False, error=0.1, activity=0.2)
    for novelty, remedy in ((0.01, "novelty=0.1 of GaussianProcess"), (0.1, "lower omega_o")):
        learner = ql.learners.GaussianProcess(budget=5, novelty=novelty)
        with pytest.raises(ValueError, match=f"changes u by 20 % RMS.*{remedy}.*or double"):
            worse.check(ql.ADRC(ADRC.observer, 2.0, learner=learner))


@pytest.mark.trial
def test_single_precision_without_a_loop_must_be_accepted(tmp_path: Path) -> None:
    """Nobody has compared it then."""
    with pytest.raises(ValueError, match="needs plant and scenario.*--accept"):
        exported(tmp_path, precision="single", accept=False)
    assert exported(tmp_path, precision="single").comparison is None


@pytest.mark.trial
def test_the_command_exports_and_prints_sizes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The sizes need a compiler; without one the command says so, and writes the same files."""
    monkeypatch.chdir(tmp_path)
    Path("setup.toml").write_text(TWO_MASS)
    arguments = ("export", "setup.toml", "--to", "c", "--name", "servo", "--out")
    shown = in_this_process((*arguments, "firmware"), monkeypatch, capsys)
    assert shown.code == 0, shown.err
    assert "firmware/src/servo.h and .c, in double precision" in shown.out
    if GCC is not None:
        assert re.search(r"code \d+ B, constants \d+ B, state \d+ B, stack \d+ B", shown.out)
    assert in_this_process((*arguments, "firmware"), monkeypatch, capsys).code == 2
    shown = in_this_process((*arguments, "a", "--precision", "single"), monkeypatch, capsys)
    assert (shown.code, "scenario: missing" in shown.err) == (2, True)
    monkeypatch.setenv("PATH", "")
    shown = in_this_process((*arguments, "bare"), monkeypatch, capsys)
    assert (shown.code, "not measured, there is no gcc here" in shown.out) == (0, True)
    for path in Path("firmware").rglob("*.[ch]"):
        assert (Path("bare") / path.relative_to("firmware")).read_text() == path.read_text()
    assert not Path("a").exists()


def test_the_source_leads_compilers_to_a_fast_step() -> None:
    """What a rare operation calls, too, is inline; only long loops may become vectors."""
    short = ql.export.c_source(ADRC).source
    assert "static inline void observe(" in short
    assert "static void predict_state(" in short
    assert "no-tree-vectorize" in short
    long = ql.export.c_source(ql.ADRC(ql.ESO.model_free(8, 1.5, 12.0, DT), 1.5)).source
    assert "no-tree-vectorize" not in long


@pytest.mark.trial
@needs_gcc
def test_sizes_are_those_of_the_structs(tmp_path: Path) -> None:
    """Half of them in single precision, but for the pointer; the deepest path of calls counts."""
    double, single = (
        exported(tmp_path, ADRC, each, overwrite=True).sizes() for each in ("double", "single")
    )
    assert 0.4 < single.parameters / double.parameters < 0.6
    assert single.state < double.state
    assert 0 < single.code < 10_000
    assert 0 < (single.stack or 0) < 1000
    graph = "\n".join(
        f'node: {{ title: "f.c:{name}" label: "{name}\\nf.c:1:1\\n{size} bytes (static)" }}'
        for name, size in (("step", 8), ("a", 16), ("b", 48), ("c", 24))
    ) + "".join(
        f'\nedge: {{ sourcename: "f.c:{one}" targetname: "{two}" label: "f.c:2:2" }}'
        for one, two in (("step", "f.c:a"), ("step", "f.c:b"), ("a", "f.c:c"), ("b", "sinf"))
    )
    assert stack_of("step", graph) == 8 + 48
    assert stack_of("other", graph) is None


COUNTS = """
#include <math.h>
#include <stdio.h>
#include "exact.h"
#include "servo.h"

/* The plant is a chain of four integrators with a spring; the exact controller closes the loop. */
int main(void)
{
    static exact_state exact;
    static servo_state counts, plain;
    const double b0 = 1.0, dt = EXACT_SAMPLE_TIME, resolution = 1e-7;
    const int32_t first = 2147480000; /* the counter overflows soon */
    double x[4] = {0.0}, wrong[2] = {0.0}, size = 0.0;

    exact_init(&exact);
    servo_init(&counts);
    servo_init(&plain);
    for (int k = 0; k < 4000; k++) {
        const int32_t count = (int32_t)floor(x[0] / resolution), goal = k < 100 ? 0 : 10000000;
        const double u = exact_step(&exact, resolution * goal, resolution * count);
        const float one = servo_step_counts(&counts, (int32_t)((uint32_t)first + (uint32_t)goal),
            (int32_t)((uint32_t)first + (uint32_t)count));
        const float two = servo_step(&plain, (float)(resolution * goal), (float)(resolution * count));
        wrong[0] += (one - u) * (one - u);
        wrong[1] += (two - u) * (two - u);
        size += u * u;
        const double snap = b0 * u - x[0] - 0.5 * x[3];
        for (int i = 0; i < 3; i++)
            x[i] += dt * x[i + 1];
        x[3] += dt * snap;
    }
    printf("%g %g %g\\n", sqrt(wrong[0] / size), sqrt(wrong[1] / size), x[0]);
    return 0;
}
"""


@pytest.mark.trial
@needs_gcc
def test_counts_spare_the_rounding_of_the_position(tmp_path: Path) -> None:
    """Order 4 in single precision beside double, in one program; the counter overflows on the way."""
    controller = ql.ADRC(ql.ESO.model_free(4, 1.0, 50.0, 2e-3), 2.0)
    (tmp_path / "a").mkdir()
    exported(tmp_path / "a", controller, name="exact")
    exported(tmp_path, controller, "single", resolution=1e-7)
    assert outcome(golden_test(tmp_path), "0")[0] == 0
    (tmp_path / "main.c").write_text(COUNTS)
    sources = (tmp_path / "main.c", tmp_path / "a/out/src/exact.c", tmp_path / "out/src/servo.c")
    include = ("-I", tmp_path / "a/out/src", "-I", tmp_path / "out/src")
    command = ["gcc", "-std=c99", *EXACT, *include, *sources, "-o", tmp_path / "main", "-lm"]
    subprocess.run(command, check=True)
    counts, plain, y = map(float, outcome(tmp_path / "main")[1].split())
    assert abs(y - 1.0) < 0.02
    assert counts < 2e-4
    assert plain > 20.0 * counts


def test_counts_are_refused_where_the_position_matters(tmp_path: Path) -> None:
    """A learner and a model with a spring know where they are; PID has no origin to move."""
    model = ql.ESO.model_based(([2.0, 0.3], 1.5), omega_o=12.0, dt=DT)
    for controller, rule in (
        (LEARNING, "needs the position itself"),
        (ql.ADRC(model, 1.5), "needs the position itself"),
        (PID, "PID can't take y as counts"),
    ):
        with pytest.raises(ValueError, match=rule):
            exported(tmp_path, controller, resolution=1e-4)
    with pytest.raises(ValueError, match="resolution = -1"):
        exported(tmp_path, resolution=-1.0)
    assert not any(tmp_path.iterdir())
