"""Texts that are exported, without a compiler: Structured Text has the bits of the controller, and reports say what was found."""

from __future__ import annotations

import ast
import json
import math
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import quell as ql
from quell.export import NoCompilerError, TranslationError, c_source, reserved, ros2, st, st_source
from quell.export.axes_source import names_in_c
from quell.export.c_structure import Structure, structure
from quell.export.controller_source import limits_path
from quell.export.fmi.fmu import build_description
from quell.export.fmi.parts import ControllerPart
from quell.export.library import exported, vectors
from quell.export.proof import Alarm, Findings, Proof, narrower_limits, proof_files, read_findings
from quell.export.ros2 import _class_name, _rate
from quell.export.structured_text import places
from quell.export.structured_text.c_reader import CFile
from quell.export.structured_text.places import Node, Whole
from quell.export.structured_text.translator import Translator
from quell.export.translate.structs import into_procedure, read_function
from quell.types import Status

from .cases import cases
from .st_in_python import FunctionBlock

DT = 0.01
LIMITS = {"u_min": -1.0, "u_max": 1.5}


def eso(order: int = 1, **more: Any) -> ql.ESO:
    """Return an observer without model."""
    return ql.ESO.model_free(order=order, b0=2.0, omega_o=20.0, dt=DT, **more)


def axes() -> ql.Axes:
    """Return two axes."""
    one = ql.ADRC(ql.ESO.model_free(order=1, b0=1.0, omega_o=20.0, dt=DT), 4.0)
    limits = {"u_min": [-1.0, -1.0], "u_max": [1.0, 1.0]}
    return ql.Axes({"slide": one, "arm": one}, B0=[[2.0, 0.5], [0.0, 1.0]], **limits)


MAKERS = {
    "PI": lambda: ql.baselines.PID(kp=2.0, ki=3.0, dt=DT, **LIMITS),
    "PID with a filter and a limited rate": lambda: ql.baselines.PID(
        kp=2.0, ki=3.0, kd=0.2, tf=0.05, dt=DT, rate_limit=20.0, **LIMITS
    ),
    "ADRC": lambda: ql.ADRC(eso(), 4.0, **LIMITS),
    "P-PI": lambda: ql.baselines.PPI(2.0, 3.0, 1.0, dt=DT, **LIMITS),
    "reference model": lambda: ql.controllers.Prefiltered(
        ql.baselines.PID(kp=2.0, ki=3.0, dt=DT, **LIMITS), ql.controllers.ReferenceModel(6.0)
    ),
}


@pytest.mark.parametrize("name", MAKERS)
def test_structured_text_has_the_bits_of_the_interpreted_controller(name: str) -> None:
    """In a loop with NaN in r and y, a u that was not the one applied, limits and a restart."""
    controller = MAKERS[name]()
    block = FunctionBlock(st_source(MAKERS[name](), "axis"))
    rng = np.random.default_rng(4)
    y, seen = 0.0, Status(0)
    for k in range(70):
        r = math.nan if k in (0, 33) else 1.0 if k < 20 else 4.0 if k < 40 else -0.3
        measured = math.nan if k in (11, 12) else y + 1e-3 * rng.standard_normal()
        inputs = {"r": r, "y": measured, "limited": False, "u_limited": 0.0, "restart": k == 55}
        if k % 9 == 8:
            inputs |= {"limited": True, "u_limited": math.nan if k == 26 else 0.4}
            if k != 26:
                controller.applied(inputs["u_limited"])
        if inputs["restart"]:
            controller.reset()
        block.call(**inputs)
        u = controller.step(r, measured)
        assert float(block.v["u"]).hex() == float(u).hex(), k
        status = getattr(controller, "status", None)
        assert status is None or block.v["status"] == int(status), k
        seen |= Status(block.v["status"])
        y += DT * (2.0 * u - 1.5 * y)
    assert Status.MEASUREMENT_HELD | Status.REFERENCE_HELD | Status.SATURATED in seen


def test_the_head_of_a_block_has_its_name_type_and_sample_time() -> None:
    """LREAL in double precision, REAL in single; inputs and outputs in their order."""
    text = st_source(MAKERS["PI"](), "axis")
    assert "FUNCTION_BLOCK axis\n" in text
    assert "one sample every 0.01 s" in text
    assert text.rstrip().endswith("END_FUNCTION_BLOCK")
    inputs = re.search(r"VAR_INPUT\n(.*?)END_VAR", text, re.S)
    assert inputs is not None
    assert re.findall(r"(\w+) : (\w+);", inputs[1]) == [
        ("r", "LREAL"), ("y", "LREAL"), ("limited", "BOOL"), ("u_limited", "LREAL"),
        ("restart", "BOOL"),
    ]  # fmt: skip
    single = st_source(MAKERS["PI"](), "axis", "single")
    assert "LREAL" not in single
    assert "r : REAL;" in single
    assert "law_D_r : REAL := 2.015" in single


def test_a_block_is_written_with_a_readme_that_names_its_inputs(tmp_path: Path) -> None:
    """Two files without a placeholder; a folder with files is left alone."""
    written = st(MAKERS["PI"](), tmp_path / "block", name="servo")
    assert [each.name for each in written.files] == ["servo.st", "README.md"]
    assert written.comparison is None
    readme = (tmp_path / "block" / "README.md").read_text(encoding="utf-8")
    assert not re.search(r"@\w+@", readme)
    assert "0.01 s" in readme
    assert "servo" in readme
    with pytest.raises(ValueError, match=str(tmp_path)):
        st(MAKERS["PI"](), tmp_path / "block", name="servo")


@cases(
    ("make", "name", "message"),
    [
        (lambda: ql.baselines.PID(kp=1.0, dt=DT), "axis", "u_min = -inf, u_max = inf: Structured"),
        (lambda: MAKERS["PI"](), "if", "name"),
        (lambda: MAKERS["PI"](), "2x", "name"),
        (lambda: MAKERS["PI"](), "a__b", "name"),
        (lambda: axes(), "axis", "controller has 2 axes"),
    ],
)
def test_a_controller_without_a_block_is_refused(make: Any, name: str, message: str) -> None:
    """Infinite limits, names of the language, several axes."""
    with pytest.raises(ValueError, match=message):
        st_source(make(), name)


def in_text(body: str, **given: float) -> float:
    """Return what a C function of x, y and z returns after it has become Structured Text."""
    code = f"double f(double x, double y, double z)\n{{\n{body}}}\n"
    writer = Translator(CFile("", code), False, ("u",))
    place = [writer.variable(each, "real", "state") for each in "xyz"]
    found = writer.call(writer.file.function("f"), place)
    assert isinstance(found, Node)
    writer.assign(Node("real", lambda: "u", 9, True), found)
    lines = ["VAR", "u : LREAL;"]
    for section in writer.variables.values():
        for each in section:
            kind = {"real": "LREAL", "bool": "BOOL"}.get(str(each.kind)) or each.kind.name  # type: ignore[union-attr]
            shape = ", ".join(f"0..{size - 1}" for size in each.shape)
            of = f"ARRAY[{shape}] OF " if each.shape else ""
            lines.append(f"{each.name} : {of}{kind};")
    block = FunctionBlock("\n".join([*lines, "END_VAR", "", writer.text()]))
    block.call(**given)
    return float(block.v["u"])


@cases(
    ("body", "value"),
    [
        ("    return x - (y - z);\n", 3.0 - (4.0 - 9.0)),
        ("    return x - y - z;\n", 3.0 - 4.0 - 9.0),
        ("    return x / (y / z);\n", 3.0 / (4.0 / 9.0)),
        ("    return (x + y) * z - -x;\n", 7.0 * 9.0 + 3.0),
        ("    return -(x + y) * z;\n", -63.0),
        ("    return sqrt(z) + fabs(x - y);\n", 3.0 + 1.0),
        ("    return x < y ? (y < z ? 1.0 : 2.0) : 3.0;\n", 1.0),
        ("    return x < y && !(y < z) ? 1.0 : 2.0;\n", 2.0),
        ("    return x > y || y < z ? 1.0 : 2.0;\n", 1.0),
        ("    for (int i = 0; i <= 3; i++) {\n        x += y;\n    }\n    return x;\n", 3.0 + 4 * 4.0),
        ("    for (int i = 0; i < 3; i++) {\n        x += y;\n    }\n    return x;\n", 3.0 + 3 * 4.0),
        ("    for (int i = 4; i >= 2; i--) {\n        x = x * 2.0 - y;\n    }\n    return x;\n", -4.0),
        ("    for (int i = 4; i > 2; i--) {\n        x = x * 2.0 - y;\n    }\n    return x;\n", 0.0),
        (
            "    for (int i = 0; i < 5; i++) {\n        if (x > 10.0) {\n            break;\n        }\n"
            "        x += y;\n    }\n    return x;\n",
            11.0,
        ),
        (
            "    double a[3];\n\n    for (int i = 0; i < 3; i++) {\n        a[i] = x;\n        x = x * 2.0;\n    }\n"
            "    return a[1] + 10.0 * a[2];\n",
            6.0 + 120.0,
        ),
        (
            "    if (x > y) {\n        return 1.0;\n    } else if (y > z) {\n        return 2.0;\n    }\n"
            "    return 3.0;\n",
            3.0,
        ),
        (
            "    double b = 0.0;\n\n    if (x < y) {\n        b = x;\n    } else {\n        b = y;\n    }\n"
            "    b = b * 2.0;\n    return b;\n",
            6.0,
        ),
        (
            "    for (int i = 0; i < 4; i++) {\n        if (i == 2) {\n            return x + y;\n"
            "        }\n    }\n    return z;\n",
            7.0,
        ),
    ],
)  # fmt: skip
def test_c_means_the_same_in_structured_text(body: str, value: float) -> None:
    """Order of operations, choices, loops up and down, breaks, arrays and returns, for 3, 4 and 9."""
    assert in_text(body, x=3.0, y=4.0, z=9.0) == value


def test_an_integer_is_for_flags_or_for_counts() -> None:
    """Both together are refused; what is the same type learns it from each other."""
    one, two, three = Whole(), Whole(), Whole()
    assert one.name == "DINT"
    one.unify(two)
    two.unify(three)
    three.use("DWORD")
    assert (one.name, two.name, three.name) == ("DWORD", "DWORD", "DWORD")
    later = Whole()
    later.unify(one)
    assert later.name == "DWORD"
    first = Whole()
    first.use("DWORD")
    open_one = Whole()
    first.unify(open_one)
    assert open_one.name == "DWORD"
    with pytest.raises(TranslationError, match="an integer for flags and for counts"):
        two.use("DINT")
    assert places.count(3).text() == "3"
    assert [places.real_text(x) for x in (1.0, -0.5, 1e-7, 3e20)] == [
        "1.0",
        "-0.5",
        "1.0E-7",
        "3.0E20",
    ]
    low = Node("real", lambda: "a + b", 6)
    assert places.inside(low, 6) == "a + b"
    assert places.inside(low, 7) == "(a + b)"
    assert places.inside(Node("real", lambda: "-2.0"), 6) == "(-2.0)"
    assert reserved.is_taken_in_st("If")
    assert not reserved.is_taken_in_st("servo")


# ---- ROS


def test_a_package_of_ros_has_rate_interfaces_and_class(tmp_path: Path) -> None:
    """100 Hz for 0.01 s; an estimated disturbance of an ADRC, none of a PID controller."""
    for make, has_f in ((MAKERS["PI"], False), (MAKERS["ADRC"], True)):
        folder = tmp_path / str(has_f)
        files = ros2(make(), folder, name="servo_axis")
        texts = {str(each.relative_to(folder)): each.read_text(encoding="utf-8") for each in files}
        whole = "\n".join(texts.values())
        assert not re.search(r"(?<!\w)@\w+@", whole)
        assert "update_rate: 100" in whole
        assert "ServoAxisController" in texts["servo_axis.xml"]
        assert "<name>servo_axis</name>" in texts["package.xml"]
        assert "u[0] = servo_axis_step(&state_, r[0], y[0])" in whole
        assert ('"_disturbance"' in whole) is has_f
        assert ("joint/position_disturbance` the estimated f" in whole) is has_f
        assert "joint/effort" in whole
        assert ("parameters_.limits.low" in whole) or ("limits.low" in whole)
        assert {"src/servo_axis.h", "src/servo_axis.c", "LICENSE"} <= texts.keys()


@cases(
    ("name", "cls"),
    [
        ("servo_axis", "ServoAxisController"),
        ("servo_axis_controller", "ServoAxisController"),
        ("x1", "X1Controller"),
    ],
)
def test_a_class_is_named_after_its_package(name: str, cls: str) -> None:
    """In capitals, once ``Controller``."""
    assert _class_name(name) == cls


def test_a_rate_is_a_whole_number_of_hertz() -> None:
    """0.003 s is none; the next one is proposed."""
    assert _rate(0.001) == 1000
    assert _rate(1.0) == 1
    assert _rate(1.0 / 3.0) == 3
    with pytest.raises(TranslationError, match=r"1/dt is 333\.333; .* dt = 0\.003003, for"):
        _rate(0.003)
    with pytest.raises(TranslationError, match="whole number of Hz"):
        _rate(2.5)


@cases(
    ("name", "message"),
    [
        ("Servo", "lower-case letters"),
        ("servo__axis", "lower-case letters"),
        ("rclcpp", "is a package that this one needs"),
    ],
)
def test_names_that_ros_does_not_take_are_refused(name: str, message: str) -> None:
    """Before anything is written."""
    with pytest.raises(ValueError, match=message):
        ros2(MAKERS["PI"](), "not_written", name=name)
    assert not Path("not_written").exists()


# ---- proofs


def test_the_contract_of_a_controller_promises_a_number_within_the_limits() -> None:
    """Of each function that returns u; without limits a number alone."""
    pi = MAKERS["PI"]()
    files = proof_files(pi, c_source(pi, "servo"))
    names = ("servo_contract.h", "servo_proof.c", "prove.sh")
    contract, program, script = (files[f"proof/{name}"] for name in names)
    path = limits_path(pi)
    low, high = (f"state->parameters->{path}.{end}" for end in ("low", "high"))
    assert "ensures a_number: \\is_finite(\\result);" in contract
    assert f"ensures within_limits: {low} <= \\result <= {high};" in contract
    assert "double servo_step(servo_state *state, double r, double y);" in contract
    assert "requires a_state: \\valid(state) && \\valid_read(state->parameters);" in contract
    assert "case 0:\n            servo_step(state, any_real, any_real);\n" in program
    for line in (
        "servo_init(&controller);",
        "servo_reset(state);",
        "servo_applied(state, any_real);",
    ):
        assert line in program
    assert f"    narrower.{path}.high = 0.25;" in program  # the middle of −1 and 1.5
    assert "servo_retune(&controller, &narrower);" in program
    assert "@" not in script.replace("$@", "")
    foreign = SimpleNamespace(externals=("table", "lookup"))
    with pytest.raises(
        ValueError, match="proof = True: the controller calls table, lookup, which is"
    ):
        proof_files(pi, foreign)  # type: ignore[arg-type]
    assert "servo" in script


@cases(
    ("limits", "value"),
    [
        ((-1.0, 1.5), 0.25),
        ((2.0, math.inf), 5.0),
        ((-2.0, math.inf), 1.0),
        ((-math.inf, 2.0), -1.0),
        ((-math.inf, math.inf), 1.0),
    ],
)
def test_narrower_limits_lie_within_those_of_the_controller(limits: Any, value: float) -> None:
    """Above the lower one, below the upper one."""
    pi = ql.baselines.PID(kp=1.0, ki=1.0, dt=DT, u_min=limits[0], u_max=limits[1])
    ((place, text),) = narrower_limits(pi, limits_path(pi) or "limits", "double")
    assert place == ""
    assert float(text) == pytest.approx(value)
    assert narrower_limits(pi, "", "double") == []


CODE = """
static const int order = 3;

static void helper(double x[4])
{
    for (int i = 0; i < 4; i++) {
        x[i] = sqrt(x[i]);
    }
}

double servo_step(state *s, double r)
{
    double x[4];

    for (int i = 0; i < order; i++) {
        helper(x);
    }
    return r;
}
"""


def test_the_passes_of_a_step_are_counted_with_those_of_what_it_calls() -> None:
    """Three of its own, and four in each."""
    found = structure(CODE, "servo_step")
    assert found.problems == []
    assert found.passes["helper"] == 4
    assert found.passes["servo_step"] == 3 + 3 * 4
    assert found.library == {"sqrt"}
    assert structure(CODE, "other_step").problems == ["there is no function other_step"]
    called = structure(CODE.replace("sqrt(", "malloc("), "servo_step")
    assert called.problems == ["malloc is called"]
    looping = structure(
        CODE.replace("return r;", "while (r > 0.0) { r -= 1.0; } return r;"), "servo_step"
    )
    assert "servo_step has 'while'" in looping.problems
    changing = structure(CODE.replace("helper(x);", "i = i + 1;"), "servo_step")
    assert any(
        each.startswith("servo_step changes i in its loop, line ") for each in changing.problems
    )


LOG = """[eva] using specification for function sqrt
[eva:summary] ====== ANALYSIS SUMMARY ======
  5 functions analyzed (out of 6): 83% coverage.
  In these functions, 40 statements reached (out of 44): 90% coverage.
  No errors or warnings raised during the analysis.
  0 errors by the Eva analyzer:   0 errors
"""
TABLE = "\n".join([
    "\t".join(["directory", "file", "line", "function", "kind", "status", "property"]),
    "\t".join([".", "servo.c", "12", "servo_step", "index_bound", "Unknown", "i < 3"]),
    "\t".join([".", "servo.c", "14", "servo_step", "shift", "Invalid", "k < 32"]),
    "\t".join([".", "c.h", "3", "servo_step", "postcondition", "Valid", "a_number: \\is_finite(u)"]),
    "\t".join([".", "c.h", "4", "servo_step", "postcondition", "Valid", "within_limits: u <= 1"]),
    "\t".join([".", "c.h", "5", "servo_step", "postcondition", "Valid", "other: 1"]),
    "\t".join(["FRAMAC_SHARE", "math.h", "9", "sqrt", "assigns clause", "Unknown", "nothing"]),
    "\t".join([".", "c.h", "6", "servo_step", "precondition", "Considered valid", "x"]),
])  # fmt: skip


def test_what_frama_c_has_found_is_read_from_its_log_and_table() -> None:
    """Alarms, promises, coverage; what is assumed of the library is none."""
    found = read_findings("27.1", 3.2, LOG, TABLE)
    assert [alarm.place for alarm in found.alarms] == ["servo.c:12", "servo.c:14"]
    assert [alarm.status for alarm in found.alarms] == ["Unknown", "Invalid"]
    assert found.promises == 2
    assert (found.functions, found.statements) == ("5 of 6", "40 of 44")
    assert found.assumed == ("sqrt",)
    assert found.failure == ""
    errors = read_findings("27.1", 3.2, LOG + "by the Eva analyzer:   2 errors", TABLE)
    assert errors.failure == "2 errors of the Eva analyzer, see eva.log"
    recursive = read_findings("27.1", 3.2, LOG + "Recursive call", TABLE)
    assert recursive.failure == "the analysis found a recursive call, see eva.log"
    assert read_findings("27.1", 3.2, "", TABLE).functions == "unknown"


def proof(findings: Findings, **more: Any) -> Proof:
    """Return a proof of a controller with two promises."""
    text = Structure({"sqrt"}, {"servo_step": 15, "servo_start": 4})
    given: dict[str, Any] = {"structure": text, "promised": 2, "promising": ("step", "track")}
    given |= {"digest": "ab12", "limited": True}
    return Proof(Path(), "servo", findings, **{**given, **more})


def test_a_proof_says_what_holds_and_what_is_open() -> None:
    """In a line and as a report; a failure proves nothing."""
    whole = proof(Findings("27.1", 3.2, (), 2, "5 of 6", "40 of 44", ("sqrt",)))
    assert whole.proved
    assert whole.summary == (
        "Proved: no undefined behaviour, u is always a number within its limits (Frama-C 27.1, 3 s)"
    )
    assert "What is proved" in whole.text
    assert "A step has 15 passes of loops at most, `servo_start` 4." in whole.text
    assert "`servo_step` or `servo_track`" in whole.text
    assert "What is open" not in whole.text
    assert not re.search(r"@\w+@", whole.text)
    alarm = Alarm("servo.c", 12, "servo_step", "index_bound", "Unknown", "i < 3")
    few = proof(Findings("27.1", 3.2, (alarm,), 1))
    assert not few.proved
    assert few.alarms == (alarm,)
    assert few.open == (
        "servo.c:12, in servo_step: a place outside of an array may be read or written (i < 3)",
        "1 of 2 promises on u are proved",
    )
    assert few.summary == "NOT proved: 2 properties are open (Frama-C 27.1, 3 s)"
    assert "- NOT proved: 1 of 2 promises on u are proved\n" in few.text
    assert "What holds but for the open properties" in few.text
    wrong = proof(Findings("", 0.0, (alarm._replace(kind="other", status="Invalid"),), 2))
    assert wrong.open == (
        "servo.c:12, in servo_step: 'other' is not excluded, status Invalid (i < 3)",
    )
    none = proof(Findings(failure="there is no frama-c here"))
    assert none.open == ("there is no frama-c here",)
    assert none.summary == "NOT proved: there is no frama-c here"
    assert "What is proved" not in none.text
    by_data = Structure(set(), {"servo_step": None}, ["7: for (k)"], ["x"])
    counted = proof(Findings("27.1", 1.0, (), 2), structure=by_data, limited=False, sizes="| t |")
    assert counted.open == ("x",)
    assert (
        "NOT counted: the passes of a step, as these ends depend on data:\n  - line 7"
        in counted.text
    )
    assert "There are no limits of u." in counted.text
    assert "## Stack and code\n\n| t |" in counted.text


# ---- examples of a library


def example(**changed: Any) -> Any:
    """Return what the examples know of a C source."""
    given = {
        "name": "servo",
        "derivatives": 0,
        "further": (),
        "real": "double",
        "precision": "double",
    }
    return SimpleNamespace(**{**given, "operations": ("step",), **changed})


def test_the_reference_of_an_example_has_its_derivatives() -> None:
    """One number, a move of two derivatives, in single precision with f; signals are further variables."""
    plain = exported._reference_texts(example())
    assert plain["reference"] == "reference"
    assert plain["defined_reference"] == "static double reference = 0.0;"
    assert plain["derivatives"] == ""
    single = exported._reference_texts(example(real="float", precision="single"))
    assert single["defined_reference"] == "static float reference = 0.0f;"
    moving = exported._reference_texts(example(operations=("step", "stopping_point")))
    assert moving["defined_reference"].endswith("= 0.0; /* target of the moves */")
    fed = exported._reference_texts(example(derivatives=2, further=("r1", "r2")))
    assert fed["reference"] == "r[0]"
    assert fed["derivatives"] == ", r[1], r[2]"
    assert fed["declared_reference"] == "extern void next_reference(double r[3]); /* r, r', r'' */"
    assert "for (int i = 0; i <= 2; i++)\n        r[i] = 0.0;" in fed["defined_reference"]
    assert fed["next_reference"] == "    double r[3];\n\n    next_reference(r);\n"
    one = example(derivatives=1, further=("r1", "inertia"))
    found = exported._with_signals(exported._reference_texts(one), one)
    assert found["derivatives"] == ", r[1], inertia"
    assert found["declared_reference"].endswith(
        "\nvolatile double inertia; /* a signal that the gains follow: write it before each step */"
    )
    assert "\nstatic double inertia = 0.0; /* a signal" in found["defined_reference"]
    small = example(real="float", precision="single", further=("inertia",))
    found = exported._with_signals(exported._reference_texts(small), small)
    assert "\nstatic float inertia = 0.0f; /* a signal" in found["defined_reference"]


# ---- sizes

CALLS = (
    'graph: { node: { title: "a.c:step" label: "step\\na.c:1\\n48 bytes (static)" }\n'
    'node: { title: "a.c:inner" label: "inner\\na.c:9\\n16 bytes (static)" }\n'
    'node: { title: "a.c:other" label: "other\\na.c:9\\n80 bytes (static)" }\n'
    'edge: { sourcename: "a.c:step" targetname: "a.c:inner" }\n'
    'edge: { sourcename: "a.c:step" targetname: "a.c:other" }\n'
    'edge: { sourcename: "a.c:inner" targetname: "sqrt" } }'
)


def test_the_stack_of_a_function_is_that_of_its_deepest_calls() -> None:
    """48 and 80 bytes; what other files have counts as zero, what the graph lacks is not known."""
    assert exported.stack_of("step", CALLS) == 128
    assert exported.stack_of("inner", CALLS) == 16
    assert exported.stack_of("sqrt", CALLS) is None
    assert exported._edges(CALLS) == {"step": {"inner", "other"}, "inner": {"sqrt"}}


def test_instructions_are_counted_by_function() -> None:
    """Without words of data in the code."""
    code = (
        "\n00000000 <step>:\n   0:\tpush\t{r4}\n   2:\tbx\tlr\n   4:\t.word\t0x1\n\n"
        "00000008 <inner>:\n   8:\tbx\tlr\n"
    )
    assert exported._instructions(code) == {"step": 2, "inner": 1}
    sections = ".text          100   0\n.text.step      20   0\n.rodata   8  0\n.rodata.c  4 0\n"
    assert exported._sum(sections, ".text") == 120
    assert exported._sum(sections, ".rodata") == 12
    symbols = "00000000 00000058 B of_state\n00000058 00000010 B of_parameters\n"
    assert exported._size_of("of_state", symbols) == 0x58
    with pytest.raises(NoCompilerError, match="the output of nm is not known"):
        exported._size_of("of_none", symbols)


def test_a_compiler_that_fails_is_told_by_its_first_error(tmp_path: Path) -> None:
    """Or by all it said; what it prints without an error is its result."""
    say = "import sys; sys.stderr.write({!r}); sys.exit({})"
    text = "a.c: in f\na.c:1: error: no such type\na.c:2: error: more\n"
    with pytest.raises(NoCompilerError, match=" fails: a.c:1: error: no such type$"):
        exported._run(tmp_path, sys.executable, "-c", say.format(text, 1))
    with pytest.raises(NoCompilerError, match=" fails: nothing works$"):
        exported._run(tmp_path, sys.executable, "-c", say.format("nothing works\n", 2))
    assert exported._run(tmp_path, sys.executable, "-c", "print(3)").strip() == "3"


def test_the_table_of_sizes_has_a_row_for_each_function(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a dash for a stack that is not known; without a compiler it says why."""
    source = c_source(MAKERS["PI"](), "servo")

    def sizes(*_: Any) -> Any:
        rows = (
            exported.FunctionSize("servo_step", 40, 90),
            exported.FunctionSize("servo_x", None, 7),
        )
        return "Cortex, gcc -O2", rows

    monkeypatch.setattr(exported, "function_sizes", sizes)
    table = exported._function_table(source)
    assert table.startswith("For Cortex, gcc -O2. Stack is the most")
    assert table.endswith("|---|---|---|\n| `servo_step` | 40 | 90 |\n| `servo_x` | – | 7 |\n")

    def none(*_: Any) -> Any:
        raise NoCompilerError("there is no gcc here")

    monkeypatch.setattr(exported, "function_sizes", none)
    assert exported._function_table(source) == "NOT measured: there is no gcc here.\n"


# ---- golden vectors


def test_the_loop_of_the_golden_vectors_is_a_chain_with_the_gains_of_the_law() -> None:
    """Euler steps of ``x'' = v − k_1 x − k_2 x'``; r is a triangle, y has noise of 2⁻²⁷ of it."""
    inner = ql.ADRC(eso(2), 4.0)
    plant = vectors.plant_of(inner, 3.0, float)
    assert plant.gains == pytest.approx((16.0, 8.0))
    assert (plant.dt, plant.amplitude) == (DT, 3.0)
    assert plant.noise == 3.0 / 2.0**27
    moving = vectors.Loop(plant._replace(samples=16), float, seed=1)
    r = []
    x = [0.0, 0.0]
    for _ in range(20):
        now, y = moving.measure()
        r.append(now)
        assert y == pytest.approx(x[0], abs=3.0 * 2.0**-11)
        moving.advance(0.5)
        x = [x[0] + DT * x[1], x[1] + DT * (0.5 - 16.0 * x[0] - 8.0 * x[1])]
        assert moving.x == pytest.approx(x)
    triangle = [0.0, 1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0]
    assert r == pytest.approx([3.0 * each / 4.0 for each in (triangle * 3)[:20]])
    # The random integers are those of the linear congruence.
    seed = (1 * vectors.MULTIPLIER + vectors.INCREMENT) & 0x7FFFFFFF
    again = vectors.Loop(plant._replace(samples=16), float, seed=1)
    assert again.measure()[1] == plant.noise * ((seed >> 15) - 32768)


# ---- axes


def test_axes_in_c_have_names_and_places(tmp_path: Path) -> None:
    """Letters, digits and one underscore; each in the header, with its estimate."""
    assert names_in_c(("x", "X", "2 nd", "größe", "v")) == names_in_c(
        ("x", "X", "2 nd", "größe", "v")
    )
    found = names_in_c(("x", "X", "2 nd", "v"))
    assert found[0] == "x"
    assert found[2] == "axis3"
    assert len({each.upper() for each in found} | {"V"}) == 5
    controller = axes()
    source = c_source(controller, "machine")
    assert source.axes == ("slide", "arm")
    assert source.sizes == (2, 2, 2)
    header = source.header
    assert "enum machine_axis { MACHINE_AXIS_SLIDE = 0, MACHINE_AXIS_ARM = 1 };" in header
    assert "machine_axis_estimate slide;" in header
    assert "machine_axis_estimate arm;" in header
    assert "double v[2]; /* B0 u as it was applied */" in header
    contract = proof_files(controller, source)["proof/machine_contract.h"]
    for k in (0, 1):
        limits = "state->parameters->limits"
        assert (
            f"ensures within_limits: {limits}.low[{k}] <= u[{k}] <= {limits}.high[{k}];" in contract
        )
    assert "\\valid(u + (0 .. 1))" in contract
    declared = "void machine_step(machine_state *state, const double r[2], const double y[2], double u[2]);"
    assert declared in contract
    part = ControllerPart.of(controller, source)
    assert part.references == ["r.slide", "r.arm"]
    assert part.measurements == ["y.slide", "y.arm"]
    assert part.controls == ["u[1]", "u[2]"]
    assert part.held == ["held.slide", "held.arm"]
    assert [each.name for each in part.inputs] == ["r.slide", "r.arm", "held.slide", "held.arm"]
    assert [each.name for each in part.tunables] == ["u_min[1]", "u_min[2]", "u_max[1]", "u_max[2]"]
    assert [each.start for each in part.tunables] == [-1.0, -1.0, 1.0, 1.0]
    names = [each.name for each in part.outputs]
    assert {"slide.f_hat", "arm.f_hat", "v[1]", "v[2]", "status"} <= set(names)
    texts = exported._texts_of_several(controller, source)
    assert texts["title"] == "Controller of 2 axes with 2 actuators"
    assert "The places of the axes in `r`, `y` and `v`: 0 `slide`, 1 `arm`." in texts["places"]
    assert (texts["r_size"], texts["y_size"]) == ("MACHINE_AXES", "MACHINE_AXES")
    assert texts["further"] == texts["about_further"] == ""
    assert json.dumps(source.sizes) == "[2, 2, 2]"


def test_the_run_of_the_golden_vectors_is_that_of_the_controller() -> None:
    """Steps, another u that was applied, manual operation, a lower limit and a restart, by its own methods."""
    player, own = vectors.Player(MAKERS["ADRC"]()), MAKERS["ADRC"]()
    act = vectors.Action

    def played(action: Any, r: float, y: float, given: float = 0.0) -> float:
        return float(player.play(action, r, y, given)[0])

    assert played(act.STEP, 1.0, 0.2) == own.step(1.0, 0.2)
    assert played(act.STEP, 1.0, 0.3) == own.step(1.0, 0.3)
    own.applied(0.1)
    assert played(act.APPLIED, 1.0, 0.35, 0.1) == own.step(1.0, 0.35)
    assert played(act.TRACK, 1.0, 0.4, 0.25) == own.track(1.0, 0.4, 0.25)
    own.hand_over()
    assert played(act.HAND_OVER, 1.0, 0.4) == own.step(1.0, 0.4)
    own.reset()
    assert played(act.RESET, 1.0, 0.5) == own.step(1.0, 0.5)
    player.limit_at(
        "limits" if hasattr(player.default, "limits") else limits_path(own), np.array([0.05])
    )
    low = played(act.LIMIT, 5.0, 0.0)
    assert low == 0.05
    assert played(act.FREE, 5.0, 0.0) > 0.05
    last = player.rows[-1]
    assert (last.action, last.r[0], last.y[0]) == (act.FREE, 5.0, 0.0)
    assert len(player.rows) == 8


def test_the_run_of_axes_is_that_of_their_own_methods() -> None:
    """Steps, applied u with a NaN, manual operation, its end, a start under load: each u."""
    player, own, act = vectors.Player(axes()), axes(), vectors.Action
    r, y = np.array([1.0, -0.5]), np.array([0.2, 0.1])

    def played(action: Any, given: Any = (0.0, 0.0)) -> list[float]:
        return player.play(action, r, y, np.array(given)).tolist()  # type: ignore[no-any-return]

    assert played(act.STEP) == own.step(r, y).tolist()
    own.applied([0.1, -0.2])
    assert played(act.APPLIED, (0.1, -0.2)) == own.step(r, y).tolist()
    own.track(r, y, [0.3, 0.4])
    assert played(act.TRACK, (0.3, 0.4)) == [0.0, 0.0]
    own.hand_over()
    assert played(act.HAND_OVER) == own.step(r, y).tolist()
    own.reset()
    assert played(act.RESET) == own.step(r, y).tolist()
    # What is no number changes nothing but the status.
    before = own.step(r, y).tolist()
    assert played(act.APPLIED, (math.nan, math.nan)) == pytest.approx(before)
    own.start(y, u=[0.2, -0.1], r=r)
    assert played(act.START, (0.2, -0.1)) == own.step(r, y).tolist()
    ignored = played(act.START, (math.nan, 0.0))
    assert ignored == own.step(r, y).tolist()


# ---- functions of users


def two_numbers(x: float, y: float) -> Any:
    """Return two numbers."""
    if x < 0.0:
        return 0.0, y
    return x + y, 2.0 * x


def nested(x: float) -> Any:
    """Return a matrix."""
    return (x, 1.0), (2.0, x * x)


def an_array(x: float) -> Any:
    """Return an array."""
    return np.array([x, 3.0 - x])


def filled(x: float) -> Any:
    """Return an array that it has filled."""
    a = np.zeros((2, 2))
    for i in range(2):
        a[i, 1] = x + i
    return a


@cases(
    ("function", "arguments", "shape"),
    [
        (two_numbers, (1.5, 4.0), (2,)),
        (two_numbers, (-1.5, 4.0), (2,)),
        (nested, (3.0,), (2, 2)),
        (an_array, (0.5,), (2,)),
        (filled, (0.5,), (2, 2)),
    ],
)
def test_a_function_that_returns_numbers_writes_them_into_an_array(
    function: Any, arguments: Any, shape: Any
) -> None:
    """Run as Python it writes what the function returns, and returns nothing."""
    source = into_procedure(read_function(function), len(shape))
    names = dict(source.names)
    tree = ast.Module([source.tree], [])
    exec(compile(ast.fix_missing_locations(tree), "<procedure>", "exec"), names)
    out = np.full(shape, math.nan)
    assert names[function.__name__](*arguments, out) is None
    np.testing.assert_array_equal(out, np.array(function(*arguments)))


def one_number(x: float) -> Any:
    """Return one number."""
    return x


def test_a_function_that_returns_no_tuple_is_named() -> None:
    """With what it must return."""
    with pytest.raises(
        TranslationError, match=r"one_number: must return a tuple of numbers, written"
    ):
        into_procedure(read_function(one_number))
    with pytest.raises(TranslationError, match="must return a matrix written as nested tuples"):
        into_procedure(read_function(two_numbers), 2)
    with pytest.raises(TranslationError, match="its source is not in a file"):
        read_function(len)
    double = read_function(lambda z: 2.0 * z)
    assert ast.unparse(double.tree.body[0]) == "return 2.0 * z"


# ---- FMUs


def test_the_variables_of_an_fmu_are_those_of_its_controller() -> None:
    """Inputs, outputs, limits and bandwidths of an ADRC; a PID controller has no bandwidths."""
    adrc = MAKERS["ADRC"]()
    part = ControllerPart.of(adrc, c_source(adrc, "servo"))
    assert (part.references, part.measurements, part.controls) == (["r"], ["y"], ["u"])
    assert part.can_be_held
    assert part.held == ["held"]
    assert [(each.name, each.flag) for each in part.inputs] == [("r", False), ("held", True)]
    names = [each.name for each in part.outputs]
    assert {"f_hat", "f_residual", "f_learned", "status", "x_hat[1]"} <= set(names)
    (status,) = [each for each in part.outputs if each.name == "status"]
    assert status.whole
    assert [(each.name, each.start) for each in part.tunables] == [
        ("u_min", -1.0), ("u_max", 1.5), ("omega_c", 4.0), ("omega_o", 20.0),
    ]  # fmt: skip
    assert part.fixed == ""
    pid = MAKERS["PI"]()
    plain = ControllerPart.of(pid, c_source(pid, "servo"))
    assert not plain.can_be_held
    assert [each.name for each in plain.inputs] == ["r"]
    assert [each.name for each in plain.tunables] == ["u_min", "u_max"]
    assert plain.derivatives_of(0) == []


def test_the_description_of_the_sources_names_all_files_and_the_library() -> None:
    """In C99, with libm, which Linux needs."""
    root = ElementTree.fromstring(build_description("model", ["fmi3.c", "model.c"]))
    (configuration,) = root
    assert (root.tag, root.attrib["fmiVersion"]) == ("fmiBuildDescription", "3.0")
    assert configuration.attrib == {"modelIdentifier": "model"}
    sources, library = configuration
    assert sources.attrib == {"language": "C99"}
    assert [each.attrib["name"] for each in sources] == ["fmi3.c", "model.c"]
    assert (library.tag, library.attrib["name"]) == ("Library", "m")
