"""``ql.export.c(..., proof=True)`` and ``quell export --prove``: what is proved of exported C code."""

from __future__ import annotations

import hashlib
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

import quell as ql
from quell.export.c_files import CSource
from quell.export.c_structure import structure
from quell.export.library.exported import Exported
from quell.export.proof import proof_files, prove, read_findings
from quell.export.separate import separated
from quell.features import Custom

from .cases import cases
from .commands import in_this_process
from .contracts.test_controllers import SEVERAL
from .in_c import needs_gcc
from .setups import TWO_MASS

needs_frama_c = pytest.mark.skipif(
    shutil.which("frama-c") is None,
    reason="frama-c (apt-get install frama-c-base), which proves exported code, is missing",
)
LIMITS = {"u_min": -2.0, "u_max": 3.0, "rate_limit": 60.0}
OBSERVER = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=0.01)
ADRC = ql.ADRC(OBSERVER, 1.5, **LIMITS)
FIRST = ql.ESO.model_free(order=1, b0=1.5, omega_o=12.0, dt=0.01)
NETWORK = ql.learners.MLP(features=ql.features.Bias(), hidden=1)
JOINT = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=12.0, dt=0.01), 1.5)
AXES = ql.Axes([JOINT, JOINT], [[1, 0.3], [0.2, 1]], u_min=-2.0, u_max=3.0, saturation="direction")
PID = ql.baselines.PID(4.0, 2.0, 1.0, tf=0.05, dt=0.01, **LIMITS)


def exported(folder: Path, controller: Any = ADRC, **options: Any) -> Exported:
    """Export a controller as ``servo`` with a proof."""
    return ql.export.c(controller, folder / "out", name="servo", accept=True, proof=True, **options)


@pytest.mark.trial
@needs_frama_c
@pytest.mark.parametrize(
    ("controller", "options"),
    [
        pytest.param(ADRC, {}, id="ADRC"),
        pytest.param(ADRC, {"precision": "single"}, id="ADRC, single"),
        pytest.param(ADRC, {"resolution": 1e-4}, id="ADRC, counts"),
        pytest.param(ql.ADRC(OBSERVER, 1.5), {}, id="without limits"),
        pytest.param(PID, {}, id="PID"),
        pytest.param(ql.ADRC(FIRST, 1.5, learner=NETWORK, **LIMITS), {}, id="a model in a union"),
        pytest.param(ql.controllers.Prefiltered(PID, ql.baselines.ZV(3.0)), {}, id="shaper, with a ring"),
        pytest.param(AXES, {}, id="axes"),
        pytest.param(AXES, {"precision": "single"}, id="axes, single"),
        pytest.param(SEVERAL["StateFeedback"], {}, id="state feedback"),
    ],
)  # fmt: skip
def test_a_controller_is_proved(tmp_path: Path, controller: Any, options: dict[str, Any]) -> None:
    """Without an alarm, with all promises of the contract; the report names the files it is for."""
    done = exported(tmp_path, controller, **options)
    proof = done.proof
    assert proof is not None
    assert proof.proved, proof.text
    assert (proof.alarms, proof.findings.promises) == ((), proof.promised)
    report = (done.folder / "proof/REPORT.md").read_text()
    assert report == proof.text
    assert "Proved: no undefined behaviour" in report
    assert "NOT" not in report
    files = [(done.folder / "src" / name).read_bytes() for name in ("servo.h", "servo.c")]
    assert hashlib.sha256(b"".join(files)).hexdigest() in report


MUTANTS = [
    pytest.param("        applied = limits->high;\n", "", "servo_step", id="no upper limit"),
    pytest.param("applied == applied && ", "", "servo_step", id="no test for NaN"),
    pytest.param("        applied = control_at_rest(limits);\n", "", "servo_step", id="NaN stays"),
    pytest.param("applied < limits->low", "applied > limits->low", "servo_step", id="wrong sign"),
    pytest.param("estimate.x_hat[1] = row[1];", "estimate.x_hat[1] = row[9];", "servo_get_estimate", id="index"),
    pytest.param("for (int i = 0; i < 2; i++) {", "for (int i = 0; i < 40; i++) {", "", id="too many passes"),
    pytest.param("state->estimates, 3);\n    state->loop", "state->estimates, 4);\n    state->loop", "memory_get_all", id="load of one number too many"),
    pytest.param("memory_put_all(image, 0, state->z, 3)", "memory_put_all(image, 0, state->z, 4)", "memory_put_all", id="save of one number too many"),
    pytest.param("    observe(&design->eso, z, ", "    z[3] = before;\n    observe(&design->eso, z, ", "", id="one array into the next"),
    pytest.param("    observe(&design->eso, z, ", "    z[(int)before] = before;\n    observe(&design->eso, z, ", "", id="NaN as an index"),
]  # fmt: skip


@pytest.mark.trial
@needs_frama_c
@pytest.mark.parametrize(("old", "new", "function"), MUTANTS)
def test_the_proof_fails_for_a_wrong_controller(
    tmp_path: Path, old: str, new: str, function: str
) -> None:
    """A limit, a test for NaN or an index is changed: an alarm names file and line, and the report what it means."""
    done = exported(tmp_path)
    code = done.folder / "src/servo.c"
    assert old in code.read_text()
    code.write_text(code.read_text().replace(old, new))
    proof = prove(done.folder, done.source)
    assert not proof.proved
    assert proof.alarms
    assert any(function in alarm.function for alarm in proof.alarms)
    report = (done.folder / "proof/REPORT.md").read_text()
    assert all(f"NOT proved: {alarm.place}" in report for alarm in proof.alarms)
    assert "# Proof of servo\n\nNOT proved" in report


@pytest.mark.trial
@needs_gcc
def test_the_report_tells_the_stack_and_the_code_of_each_function(tmp_path: Path) -> None:
    """The stack of a step is that of ``sizes``; what calls more has more of both."""
    done = exported(tmp_path)
    assert done.proof is not None
    table = done.proof.text.partition("## Stack and code")[2].partition("## ")[0]
    rows = dict(re.findall(r"^\| `servo_(\w+)` \| (\d+ \| \d+) \|$", table, re.MULTILINE))
    assert set(rows) == set(done.source.operations)
    found = {name: tuple(map(int, row.split(" | "))) for name, row in rows.items()}
    assert found["step"][0] == done.sizes().stack
    assert found["track"] > found["step"] > found["status"]
    assert found["start"][1] > 20


@pytest.mark.trial
@needs_frama_c
def test_the_script_comes_to_the_same_result(tmp_path: Path) -> None:
    """It ends with 0 if all is proved; with 1 if something is not, which it prints, or if the code does not compile."""
    done = exported(tmp_path, PID)
    code, script = done.folder / "src/servo.c", done.folder / "proof/prove.sh"
    text = code.read_text()
    for old, new, status, shown in (
        ("", "", 0, "proved: no undefined behaviour"),
        ("        applied = limits->high;\n", "", 1, "servo_step: postcondition: Unknown"),
        (
            "state->x, 3);\n    memory_get_all",
            "state->x, 4);\n    memory_get_all",
            1,
            "memory_get_all: mem_access",
        ),
        ("#include <math.h>", "int x = ;", 1, "NOT proved: Frama-C ended without a result"),
    ):
        code.write_text(text.replace(old, new))
        ran = subprocess.run(["sh", script], capture_output=True, text=True, check=False)
        assert (ran.returncode, shown in ran.stdout) == (status, True), ran.stdout
    code.write_text(text)
    header = done.folder / "src/servo.h"
    header.write_text(header.read_text().replace("double x[3];", "double x[2];"))
    ran = subprocess.run(["sh", script], capture_output=True, text=True, check=False)
    assert (ran.returncode, "is not the header that was exported" in ran.stdout) == (1, True)
    assert "the header is not the one" in prove(done.folder, done.source).summary


HEADER = """typedef struct {
    double low[2];
} a_limits;
typedef struct {
    a_limits limits;
} a_parameters;
typedef struct {
    int place[4]; /* of double old[3]; */
    double P[2][3];
} a_memory;
typedef struct {
    double row[5];
} a_sample;
typedef struct {
    double weights[2];
} a_model;
typedef struct {
    double scale[2];
    union {
        a_model model;
        double flat[2]; /* the same memory */
    } shared;
} a_learner;
typedef struct {
    const a_parameters *parameters;
    double z[3];
    a_memory memory[2];
    a_limits limits;
    a_sample sample;
    a_learner learner;
} a_state;
"""


def test_arrays_of_the_state_become_objects_of_their_own() -> None:
    """With their lengths, also within arrays of structs; not what the parameters, a variable or a union have, too."""
    code = "static void f(void)\n{\n    a_sample sample = {0};\n}\n"
    found = separated(CSource("a", HEADER, code, "double", (), ()))
    left = ("a_learner.shared.flat", "a_limits.low", "a_model.weights", "a_sample.row")
    assert found.left == left
    lines = [line.strip() for line in found.header.splitlines()]
    for line in ("double (*z);", "a_memory (*memory);", "int (*place); /* of double old[3]; */", "double (*P)[3];",
                 "double low[2];", "double row[5];", "static double separate_0[3];",
                 "static a_memory separate_1[2];", "separate_1[1].P = separate_5;",
                 "(void)(memset)(place->P, 0, 6 * sizeof(double));", "double weights[2];", "double flat[2]; /* the same memory */",
                 "(void)(memset)(&place->shared, 0, sizeof place->shared);"):  # fmt: skip
        assert line in lines, line
    assert found.number == 7


@pytest.mark.trial
@needs_frama_c
def test_an_analysis_that_does_not_end_proves_nothing(tmp_path: Path) -> None:
    """After the time that it has, or with code that is no C, the report says NOT."""
    done = exported(tmp_path)
    assert "did not end in 0.01 s" in prove(done.folder, done.source, longest=0.01).summary
    (done.folder / "src/servo.c").write_text("int x = ;\n")
    proof = prove(done.folder, done.source)
    assert (proof.proved, proof.summary.startswith("NOT proved: frama-c ended")) == (False, True)


@pytest.mark.trial
def test_without_frama_c_nothing_is_proved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All files are written; command and report say NOT and how to install it; the exit code is 5."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", "")
    Path("setup.toml").write_text(TWO_MASS)
    arguments = ("export", "setup.toml", "--out", "out", "--name", "servo")
    assert in_this_process(arguments, monkeypatch, capsys).code == 0
    assert not Path("out/proof").exists()
    shown = in_this_process((*arguments, "--prove", "--overwrite"), monkeypatch, capsys)
    assert shown.code == 5
    assert "NOT proved: there is no frama-c here" in shown.out
    assert "Stable: the loop with two-mass-spring in double precision" in shown.out
    assert "Rounding changes u by at most" in shown.out
    report = Path("out/proof/REPORT.md").read_text()
    assert "apt-get install frama-c-base" in report
    assert "NOT measured: there is no gcc here" in report
    names = {path.name for path in Path("out/proof").iterdir()}
    headers = {"servo_contract.h", "servo_separate.h", "servo_exported.h"}
    assert names == headers | {"servo_proof.c", "prove.sh", "REPORT.md"}
    fmu = in_this_process((*arguments, "--to", "fmu", "--prove"), monkeypatch, capsys)
    assert (fmu.code, "--prove: only with --to c" in fmu.err) == (2, True)
    alone = in_this_process((*arguments, "--spread", "0.1"), monkeypatch, capsys)
    assert (alone.code, "--spread: goes with --prove" in alone.err) == (2, True)


@pytest.mark.trial
def test_the_contract_of_several_signals_has_each_actuator() -> None:
    """Each u is a number within its own limits, for arrays of the right lengths."""
    text = proof_files(AXES, ql.export.c_source(AXES, "servo"))["proof/servo_contract.h"]
    for k in (0, 1):
        assert f"\\is_finite(u[{k}]);" in text
        assert f"limits.low[{k}] <= u[{k}] <= state->parameters->limits.high[{k}];" in text
    assert "\\valid_read(y + (0 .. 1)) && \\valid(u + (0 .. 1));" in text
    assert text.count("ensures") == 4


@pytest.mark.trial
def test_the_program_of_the_proof_calls_everything(tmp_path: Path) -> None:
    """Each function of the header is in it, so the proof is for all of them."""
    move = ql.controllers.ProfileGenerator(0.5, 2.0, 5.0)
    moving = ql.controllers.Prefiltered(ql.ADRC(OBSERVER, 1.5, feedforward=True, **LIMITS), move)
    for controller, resolution in ((moving, None), (ADRC, 1e-4)):
        source = ql.export.c_source(controller, "servo", resolution=resolution)
        text = ql.export.proof.proof_files(controller, source)["proof/servo_proof.c"]
        assert all(f"servo_{operation}(" in text for operation in source.operations)


@pytest.mark.trial
def test_a_function_in_c_can_not_be_proved(tmp_path: Path) -> None:
    """Nobody knows what it does: nothing is written."""
    feature = Custom(lambda x, u: (x[0] * x[1],), ["product"], c_function="product")
    learner = ql.learners.RLS(feature)
    with pytest.raises(ValueError, match="proof = True: the controller calls product"):
        exported(tmp_path, ql.ADRC(OBSERVER, 1.5, learner=learner, guard=ql.Guard(), **LIMITS))
    assert not any(tmp_path.iterdir())


HEAD = "directory\tfile\tline\tfunction\tproperty kind\tstatus\tproperty\n"


def test_the_table_of_frama_c_is_read() -> None:
    """What is not valid is an alarm, what a library function changes is an assumption, and each promise counts once."""
    table = HEAD + "".join(
        "\t".join(row) + "\n"
        for row in (
            ("../src", "a.c", "7", "f", "index_bound", "Unknown", "i < 3"),
            (".", "a.h", "2", "a_step", "postcondition", "Valid", "a_number: \\is_finite(\\result)"),
            (".", "a.h", "3", "a_step", "postcondition", "Unknown", "within_limits: low <= \\result"),
            ("FRAMAC_SHARE/libc", "math.h", "9", "tanh", "assigns clause", "Unknown", "assigns \\nothing;"),
            ("FRAMAC_SHARE/libc", "math.h", "9", "log2", "precondition", "Unknown", "finite_arg"),
        )
    )  # fmt: skip
    log = "by the Eva analyzer:      0 errors    0 warnings\n[eva] using specification for function tanh\n"
    found = read_findings("25.0", 1.0, log, table)
    assert [alarm.kind for alarm in found.alarms] == [
        "index_bound",
        "postcondition",
        "precondition",
    ]
    assert found.alarms[0].place == "a.c:7"
    assert (found.promises, found.assumed, found.failure) == (1, ("tanh",), "")
    failed = read_findings("25.0", 1.0, "by the Eva analyzer:      2 errors    0 warnings\n", table)
    assert "2 errors of the Eva analyzer" in failed.failure


LOOPS = """static const int ROWS = 3;

static double inner(double a)
{
    for (int i = 0; i < ROWS; i++) {
        a += 1.0;
    }
    return a;
}

/* for (;;) in a comment is none. */
double a_step(a_state *state, double r)
{
    for (int i = 4 - 1; i > -1; i--) {
        for (int j = 0; j < i + 1; j++) {
            r = inner(r);
        }
    }
    for (int k = 0, end = minimum_int(truncated(r), 7); k < end; k += 2) {
        r = fabs(r);
    }
    return r;
}
"""


def test_the_passes_of_loops_are_counted() -> None:
    """4 of a loop, each with 4 at most of the next, each with 3 of a function's; and 4 of one to a smaller end."""
    found = structure(LOOPS, "a_step")
    assert found.problems == []
    assert found.passes == {"inner": 3, "a_step": 4 + 16 + 48 + 4}
    assert found.library == {"fabs", "minimum_int", "truncated"}
    open_end = structure(LOOPS.replace("minimum_int(truncated(r), 7)", "truncated(r)"), "a_step")
    assert open_end.passes["a_step"] is None
    assert [each.partition(":")[0] for each in open_end.by_data] == ["19"]
    header = "int k = 0, end = minimum_int(truncated(r), 7); k < end; k += 2"
    between = "int k = minimum_int(2, 5) + 1; k < maximum_int(2, 5) + 1; k++"  # 3, 4, 5
    joints = structure(LOOPS.replace(header, between), "a_step")
    assert joints.problems == []
    assert joints.passes["a_step"] == 4 + 16 + 48 + 3


def test_an_index_beyond_an_array_that_is_an_argument_is_named() -> None:
    """Also where the place is within the state, so that Eva has no alarm; rows and columns alike."""
    code = (
        "static const int MOST = 3;\n\n"
        "static void fill(double z[3], double rows[2][4])\n{{\n"
        "    for (int i = 0; i < {passes}; i++) {{\n        z[i] = 0.0;\n"
        "        for (int j = 0; j < 4; j++) {{\n            rows[{row}][j] = z[{index}];\n"
        "        }}\n    }}\n}}\n\nvoid servo_step(void)\n{{\n    fill(a, b);\n}}\n"
    )
    good = {"passes": "MOST", "row": "1", "index": "2"}
    for change, expected in (
        ({}, []),
        ({"index": "unknown"}, []),
        ({"index": "2 + (i < 1 ? i : 0)"}, []),
        ({"passes": "MOST + 1"}, ["fill uses z[i], of 3 entries"]),
        ({"row": "i"}, ["fill uses rows[i][j], of 2 entries"]),
        ({"index": "i - 1"}, ["fill uses z[i - 1], of 3 entries"]),
    ):
        found = structure(code.format(**good | change), "servo_step")
        assert found.problems == expected


def test_an_argument_that_the_call_tells_is_counted() -> None:
    """A function whose loop ends at its argument has as many passes as each call gives it."""
    text = LOOPS.replace("inner(double a)", "inner(double a, int count)").replace(
        "ROWS; i++", "count; i++"
    )
    found = structure(text.replace("inner(r)", "inner(r, i + 2)"), "a_step")
    assert found.passes["inner"] is None
    assert found.passes["a_step"] == 4 + 16 + 16 * 5 + 4


@cases(
    ("old", "new", "problem"),
    [
        ("a += 1.0;", "a_step(state, a);", "recursion is possible"),
        ("a += 1.0;", "while (a < 3.0) { a += 1.0; }", "inner has 'while'"),
        ("a += 1.0;", "i = 0;", "inner changes i in its loop, line 5"),
        ("k += 2) {", "k += 2) {\\n        end++;", "a_step changes end"),
        ("a += 1.0;", "a += *(double *)malloc(8);", "malloc is called"),
        ("for (int i = 0; i < ROWS; i++)", "for (;;)", "no range of integers"),
    ],
)
def test_code_that_is_not_as_claimed_is_named(old: str, new: str, problem: str) -> None:
    """Recursion, other loops, a loop whose end moves, memory that is allocated."""
    found = structure(LOOPS.replace(old, new), "a_step")
    assert any(problem in each for each in found.problems), found.problems
