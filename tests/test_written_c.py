"""Lines of C and text that exports write, from parts that stand for controllers; runs of other programs."""

from __future__ import annotations

import importlib
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from quell.export import image_code, proof, separate
from quell.export.controller_source import _Writer
from quell.export.fmi.parts import Bandwidths, Variable, constant_of, ordered, several, tuning_lines
from quell.export.library import exported
from quell.export.proof import Alarm, Findings
from quell.export.translate.expressions import _with_numbers
from quell.export.translate.structs import _array_lines
from quell.export.translate.text import Array, Number, Value

from .cases import cases

# The package has the function of the same name.
fmu: Any = importlib.import_module("quell.export.fmi.fmu")

# ---- initial values


def lines_of(array: Any, tables: list[str] | None = None) -> list[str]:
    """Return the statements that set an array ``s->x``."""
    literals = SimpleNamespace(write=lambda number: f"{float(number):g}")
    structs = SimpleNamespace(literals=literals, number=lambda kind: "float")
    value = Value(Array(np.shape(array), Number.REAL), "s->x")
    return _array_lines(
        structs, value, np.asarray(array, dtype=float), [] if tables is None else tables
    )  # type: ignore[arg-type]


def test_an_array_of_one_number_is_set_in_loops() -> None:
    """From five entries on; one for each dimension."""
    assert lines_of([2.0] * 5) == [
        "    for (int i = 0; i < 5; i++) {",
        "        s->x[i] = 2;",
        "    }",
    ]
    assert lines_of(np.full((2, 3), 7.0)) == [
        "    for (int i = 0; i < 2; i++) {",
        "        for (int j = 0; j < 3; j++) {",
        "            s->x[i][j] = 7;",
        "        }",
        "    }",
    ]
    assert lines_of([2.0] * 4) == [f"    s->x[{i}] = 2;" for i in range(4)]


def test_a_multiple_of_the_unit_matrix_is_set_along_its_diagonal() -> None:
    """From five rows on; else by a statement for each number, or from a table."""
    assert lines_of(3.0 * np.eye(5)) == [
        "    for (int i = 0; i < 5; i++) {",
        "        s->x[i][i] = 3;",
        "    }",
    ]
    assert lines_of(3.0 * np.eye(4)) == [f"    s->x[{i}][{i}] = 3;" for i in range(4)]
    tables: list[str] = []
    assert lines_of(np.diag([1.0, 2.0, 3.0, 4.0, 5.0]), tables) == [
        "    (void)memcpy(s->x, initial_1, sizeof initial_1);"
    ]
    numbers = ", ".join(f"{x:g}" for x in np.diag([1.0, 2.0, 3.0, 4.0, 5.0]).ravel())
    assert tables == [f"static const float initial_1[25] = {{{numbers}}}; /* s->x */"]
    assert lines_of([0.0, 1.0, 0.0, 2.0, 3.0, 0.0, 4.0]) == [
        "    s->x[1] = 1;", "    s->x[3] = 2;", "    s->x[4] = 3;", "    s->x[6] = 4;",
    ]  # fmt: skip
    assert lines_of([1.0, 2.0, 3.0, 4.0, 5.0], tables)[0].startswith(
        "    (void)memcpy(s->x, initial_2,"
    )


def test_numbers_of_a_function_take_the_place_of_the_array_of_all() -> None:
    """A number, a vector and a matrix from place 4 on; the last argument, or the one before it."""
    array = Value(Array((20,), Number.REAL), "p->numbers", root="p")
    first, out = Value(Number.REAL, "t"), Value(Array((2,), Number.REAL), "out", root="out")
    shapes = ((), (3,), (2, 3))
    found = _with_numbers([first, array], (4, shapes), True, "float")
    assert [value.code for value in found] == [
        "t", "p->numbers[4]", "&p->numbers[5]", "(const float (*)[3])&p->numbers[8]",
    ]  # fmt: skip
    assert [value.kind for value in found[1:]] == [
        Number.REAL, Array((3,), Number.REAL), Array((2, 3), Number.REAL),
    ]  # fmt: skip
    assert all(value.root == "p" for value in found[1:])
    found = _with_numbers([first, array, out], (0, ((),)), False, "double")
    assert [value.code for value in found] == ["t", "p->numbers[0]", "out"]


# ---- FMUs


def source_of(**more: Any) -> Any:
    """Return what stands for C code."""
    parts = {"name": "servo", "real": "double", "sizes": None, "derivatives": 0, "signals": 0,
             "further": (), "channels": (("f_hat", 1), ("status", 1))}  # fmt: skip
    return SimpleNamespace(**{**parts, **more})


def controller_of(source: Any = None, **more: Any) -> Any:
    """Return what stands for a controller in C."""
    parts = {"source": source or source_of(), "limits_path": "limits", "bandwidths": None, "tunables": [],
             "can_be_held": False, "channels": (), "outputs": ()}  # fmt: skip
    return SimpleNamespace(**{**parts, **more})


def test_limits_and_bandwidths_that_are_set_act_with_the_next_parameters() -> None:
    """Checked, then written over those of the export; of several signals for each."""
    lines = tuning_lines(controller_of())
    assert lines == [
        "if (!(m->real[AT_U_MIN] < m->real[AT_U_MAX])) {",
        '    return "u_min must be less than u_max";',
        "}",
        "servo_parameters *next = &m->parameters[1 - m->acting];",
        "*next = servo_default_parameters;",
        "next->limits.low = m->real[AT_U_MIN];",
        "next->limits.high = m->real[AT_U_MAX];",
        "servo_retune(&m->controller, next);",
        "m->acting = 1 - m->acting;",
        "return NULL;",
    ]
    both = tuning_lines(controller_of(source_of(real="float", sizes=(2, 2, 2))))
    assert "if (!(m->real[AT_U_MIN_2] < m->real[AT_U_MAX_2])) {" in both
    assert both[8:12] == [
        "next->limits.low[0] = (float)m->real[AT_U_MIN_1];",
        "next->limits.high[0] = (float)m->real[AT_U_MAX_1];",
        "next->limits.low[1] = (float)m->real[AT_U_MIN_2];",
        "next->limits.high[1] = (float)m->real[AT_U_MAX_2];",
    ]


def test_a_bandwidth_that_is_set_changes_the_gains_by_their_closed_forms() -> None:
    """ω_c in the law and the guard, ω_o as a polynomial; else the numbers of the export."""
    known = Bandwidths("inner.", 0.01, 20.0, np.array([1.0, 2.0]), 2, 90.0,
                       np.array([[0.0, 3.0, 1.0], [0.0, 0.0, 5.0]]))  # fmt: skip
    tunables = [Variable("omega_c", "tunable", "", 20.0, "rad/s"), Variable("u_max", "tunable", "")]
    lines = tuning_lines(controller_of(bandwidths=known, tunables=tunables))
    assert lines[3:6] == [
        "if (!(m->real[AT_OMEGA_C] > 0.0 && isfinite(m->real[AT_OMEGA_C]))) {",
        '    return "omega_c must be finite and greater than zero";',
        "}",
    ]
    at = lines.index("if (m->real[AT_OMEGA_C] != 20.0) { /* else the numbers of the export */")
    assert lines[at + 1 : at + 10] == [
        "    static const double weights[2] = {1.0, 2.0};",
        "    const double omega_c = m->real[AT_OMEGA_C];",
        "    for (int i = 0; i < 2; i++) {",
        "        next->inner.law[i] = (weights[i] * pow(omega_c, 2 - i));",
        "    }",
        "    next->inner.fade = exp(-omega_c * 0.01);",
        "    const double omega_g = pow(weights[0] * pow(omega_c, 2), 0.5);",
        "    next->inner.guard.respond = -expm1(-omega_g * 0.01);",
        "}",
    ]
    at = lines.index("if (m->real[AT_OMEGA_O] != 90.0) { /* else the numbers of the export */")
    assert lines[at + 1 : at + 14] == [
        "    static const double coefficients[2][3] = {",
        "        {0.0, 3.0, 1.0},",
        "        {0.0, 0.0, 5.0},",
        "    };",
        "    const double omega = -expm1(-m->real[AT_OMEGA_O] * 0.01);",
        "    for (int i = 0; i < 2; i++) {",
        "        double gain = 0.0;",
        "        for (int k = 2; k >= 0; k--) {",
        "            gain = gain * omega + coefficients[i][k];",
        "        }",
        "        next->inner.eso.gain[i] = gain;",
        "    }",
        "}",
    ]
    without = tuning_lines(
        controller_of(bandwidths=known._replace(weights=None, coefficients=None))
    )
    assert not any("pow" in line for line in without)
    single = tuning_lines(controller_of(source_of(real="float"), bandwidths=known))
    assert "        next->inner.law[i] = (float)(weights[i] * pow(omega_c, 2 - i));" in single
    assert "        next->inner.eso.gain[i] = (float)gain;" in single


def sample_of(controller: Any, plant: Any = None) -> list[str]:
    """Return the lines of a sample of an FMU."""
    stands: Any = SimpleNamespace(controller=controller, plant=plant)
    return fmu.Model._sample_lines(stands)


def test_a_sample_of_an_fmu_is_a_step_of_the_controller() -> None:
    """With derivatives, signals, a hold; in single precision with casts; behind a plant with its y."""
    assert sample_of(controller_of()) == [
        "(void)t;",
        "m->real[AT_U] = servo_step(&m->controller, m->real[AT_R], m->real[AT_Y]);",
    ]
    more = controller_of(source_of(real="float", derivatives=2, signals=1), can_be_held=True)
    assert sample_of(more) == [
        "(void)t;",
        "servo_set_held(&m->controller, m->flag[AT_HELD - MODEL_REALS - MODEL_INTEGERS]);",
        "m->real[AT_U] = servo_step(&m->controller, (float)m->real[AT_R], (float)(m->real[AT_Y]), "
        "(float)m->real[AT_R_DERIVATIVE_1], (float)m->real[AT_R_DERIVATIVE_2], "
        "(float)m->real[AT_SIGNAL_1]);",
    ]
    plant = SimpleNamespace(source=SimpleNamespace(name="arm"), disturbances=1)
    assert sample_of(controller_of(), plant) == [
        "const double y = arm_measure(&m->plant);",
        "m->real[AT_U] = servo_step(&m->controller, m->real[AT_R], y + m->real[AT_NOISE]);",
        "arm_advance(&m->plant, t, m->real[AT_U], &m->real[AT_W_1]);",
    ]
    alone = SimpleNamespace(source=SimpleNamespace(name="arm"), disturbances=0)
    assert sample_of(None, alone) == ["arm_advance(&m->plant, t, m->real[AT_U]);"]


def test_a_sample_of_several_signals_takes_arrays() -> None:
    """References, measurements, derivatives where an axis has them, holds, and controls."""
    names = [["r[1] derivative"], []]
    several_ = controller_of(
        source_of(real="float", sizes=(2, 2, 1), derivatives=1, further=("r1",)),
        references=("r[1]", "r[2]"), measurements=("y[1]", "y[2]"), controls=("u[1]",),
        derivatives=names, derivatives_of=lambda i: names[i], held=("held[1]",),
    )  # fmt: skip
    assert sample_of(several_) == [
        "(void)t;",
        "const float r[] = {(float)m->real[AT_R_1], (float)m->real[AT_R_2]};",
        "const float y[] = {(float)m->real[AT_Y_1], (float)m->real[AT_Y_2]};",
        "const float r1[] = {(float)m->real[AT_R_1_DERIVATIVE], 0};",
        "float u[1];",
        "servo_set_held(&m->controller, 0, m->flag[AT_HELD_1 - MODEL_REALS - MODEL_INTEGERS]);",
        "servo_step(&m->controller, r, y, r1, u);",
        "m->real[AT_U_1] = u[0];",
    ]


def test_what_a_controller_knows_is_copied_to_the_outputs() -> None:
    """Numbers, entries of arrays, and the status as a whole number."""
    outputs = [Variable("f", "output", ""), *several("x_hat", 2, "output", "state {i}"),
               Variable("status", "output", "", whole=True)]  # fmt: skip
    channels = (("f_hat", 1), ("x_hat", 2), ("status", 1))
    text = fmu._estimate_function(controller_of(outputs=outputs, channels=channels))
    assert text == (
        "\n/* Copy what the controller knows to the outputs. */\nstatic void set_estimate(model *m)\n{\n"
        "    const servo_estimate estimate = servo_get_estimate(&m->controller);\n"
        "    m->real[AT_F] = estimate.f;\n"
        "    m->real[AT_X_HAT_1] = estimate.x_hat[0];\n"
        "    m->real[AT_X_HAT_2] = estimate.x_hat[1];\n"
        "    m->integer[AT_STATUS - MODEL_REALS] = estimate.status;\n}\n"
    )
    bare = source_of(channels=(("f_hat", 1),))
    other = fmu._estimate_function(
        controller_of(bare, outputs=outputs[-1:], channels=channels[-1:])
    )
    assert "m->integer[AT_STATUS - MODEL_REALS] = servo_status(&m->controller);" in other


def test_variables_have_constants_and_an_order() -> None:
    """The time first, then numbers, integers and flags."""
    assert [constant_of(name) for name in ("x_hat[1]", "u", "der(r)")] == [
        "AT_X_HAT_1",
        "AT_U",
        "AT_DER_R",
    ]
    flag, whole, real = (Variable("a", "input", "", flag=True), Variable("b", "output", "", whole=True),
                         Variable("c", "input", ""))  # fmt: skip
    assert [each.name for each in ordered([flag, whole, real])] == ["time", "c", "b", "a"]
    two = several("x", 2, "output", "state {i}", [0.5, 0.7], True)
    assert [(each.name, each.description, each.start, each.held) for each in two] == [
        ("x[1]", "state 1", 0.5, True), ("x[2]", "state 2", 0.7, True),
    ]  # fmt: skip
    assert [each.start for each in several("x", 2, "output", "")] == [0.0, 0.0]


# ---- steps with derivatives and signals


@cases(
    ("derivatives", "signals", "one", "text"),
    [
        (0, 0, True, ""),
        (1, 0, True, "a is the derivative r' at this sample, fed forward.\n"),
        (2, 0, False, "a, b are the derivatives r', r'' of each axis at this sample, fed forward.\n"),
        (0, 1, True, "a is the signal that the gains follow.\n"),
        (1, 2, True, "a is the derivative r' at this sample, fed forward.\nb, c are the signals that the gains "
                     "follow.\n"),
    ],
)  # fmt: skip
def test_further_arguments_of_a_step_are_said(
    derivatives: int, signals: int, one: bool, text: str
) -> None:
    """Singular and plural; of each axis."""
    names = ["a", "b", "c"][: derivatives + signals]
    stands = SimpleNamespace(
        names=names, derivatives=derivatives, signals=signals, one=one, moves=False
    )
    assert _Writer._about_derivatives(stands) == text  # type: ignore[arg-type]
    assert _Writer._about_target(stands) == ""  # type: ignore[arg-type]
    moving = _Writer._about_target(SimpleNamespace(moves=True, one=one))  # type: ignore[arg-type]
    begin = "r is the target of a move within the limits of speed, acceleration and jerk in\n"
    of_axes = "r of an axis with a profile generator is the target of a move within the limits\n"
    assert moving.startswith(begin if one else of_axes)


# ---- other programs


def test_instructions_are_counted_by_function() -> None:
    """Of a listing; words and bytes of data are none."""
    listing = (
        "a.o:     file format\n\n0000 <servo_step>:\n   0:\tpush\t{r4}\n   2:\tbl\t0 <helper>\n"
        "   6:\t.word\t0x1\n\n0010 <helper>:\n  10:\tbx\tlr\n  12:\t.short\t0\n  14:\t.byte\t1\n"
    )
    assert exported._instructions(listing) == {"servo_step": 2, "helper": 1}


def test_what_a_function_takes_has_all_that_it_calls() -> None:
    """Instructions of each function that is reached, once; with the flags that were used."""
    listing = "".join(f"0000 <{name}>:\n" + "   0:\tnop\n" * n for name, n in
                      (("s_step", 3), ("s_init", 5), ("a", 7), ("b", 11)))  # fmt: skip
    edges = {"s_step": {"a"}, "a": {"b"}, "b": {"a"}}
    commands: list[tuple[str, ...]] = []

    def run(folder: Path, *command: str) -> str:
        commands.append(command)
        (folder / "s.ci").write_text("calls")
        return listing

    with (
        patch.object(exported, "_run", run),
        patch.object(exported, "_compiler", lambda precision: ("chip", "arm-", ("-mthumb",))),
        patch.object(exported.shutil, "which", lambda name: name),
        patch.object(exported, "_edges", lambda calls: edges),
        patch.object(exported, "stack_of", lambda name, calls: len(name)),
    ):
        text, found = exported.function_sizes("s", "h", "c", "single", ["step", "init"])
        assert text.startswith("chip, arm-gcc ")
        assert [(each.name, each.stack, each.instructions) for each in found] == [
            ("s_step", 6, 21), ("s_init", 6, 5),
        ]  # fmt: skip
        assert commands[0][0] == "arm-gcc"
        assert commands[0][-2:] == ("-c", "s.c")
        assert commands[1] == ("arm-objdump", "-d", "--no-show-raw-insn", "s.o")
        with (
            patch.object(exported.shutil, "which", lambda name: None),
            pytest.raises(exported.NoCompilerError, match="there is no arm-objdump here"),
        ):
            exported.function_sizes("s", "h", "c", "single", ["step"])


def test_a_compiler_that_fails_says_why(tmp_path: Path) -> None:
    """Its first line with "undefined", else with "error", else all."""

    def done(code: int, text: str) -> Any:
        return lambda command, **_: subprocess.CompletedProcess(command, code, "", text)

    with patch.object(fmu, "compiler", lambda: "cc"):
        for text, said in (
            ("a\nx: error: b\ny: undefined c\n", "y: undefined c"),
            ("a\nx: error: b\n", "x: error: b"),
            ("crash", "crash"),
        ):
            with (
                patch.object(fmu.subprocess, "run", done(1, text)),
                pytest.raises(ValueError, match=f"^binary = True: cc failed: {said}$"),
            ):
                fmu.compiled(tmp_path, ["a.c"], "m")
        (tmp_path / "m.library").write_bytes(b"code")
        with patch.object(fmu.subprocess, "run", done(0, "")):
            assert fmu.compiled(tmp_path, ["a.c"], "m") == b"code"


def proved(tmp_path: Path, runs: Any) -> Findings:
    """Return what ``frama_c`` finds where a run returns code, log and table."""
    (tmp_path / proof.FOLDER).mkdir(exist_ok=True)

    def run(command: Any, *, cwd: Path, stdout: Any, timeout: float, **_: Any) -> Any:
        table = (
            proof.PROPERTIES
            if proof.PROPERTIES in command[-1] or len(calls) == 0
            else proof.SEPARATE
        )
        calls.append((table, timeout))
        code, log, text = runs[len(calls) - 1]
        if log is None:
            raise subprocess.TimeoutExpired(command, timeout)
        stdout.write(log)
        if text is not None:
            (cwd / table).write_text(text)
        return SimpleNamespace(returncode=code)

    calls: list[Any] = []
    with (
        patch.object(proof.shutil, "which", lambda name: "frama-c"),
        patch.object(proof, "_output", lambda *_: "30.0"),
        patch.object(proof.subprocess, "run", run),
        patch.object(proof, "read_findings", lambda version, seconds, log, table: Findings(
            version, seconds, tuple(Alarm(*each.split(",")) for each in table.split()), 3)),
    ):  # fmt: skip
        found = proof.frama_c(tmp_path, "servo", 60.0)
    assert len(calls) <= 2
    return found


def test_a_proof_is_run_with_arrays_in_their_structs_and_separate(tmp_path: Path) -> None:
    """Alarms of both, each once; why there is no result."""
    fields = len(Alarm._fields)
    one, two = (",".join([name] * fields) for name in ("a", "b"))
    good = "x\n[eva:summary] y"
    found = proved(tmp_path, [(0, good, one), (0, good, f"{one} {two}")])
    assert [each[0] for each in found.alarms] == ["a", "b"]
    assert (found.version, found.promises, found.failure) == ("30.0", 3, "")
    failed = proved(tmp_path, [(1, "u\nlast words", one)])
    assert failed.failure == "frama-c ended with 1: last words"
    assert proved(tmp_path, [(0, "no summary", one)]).failure == "frama-c ended with 0: no summary"
    assert proved(tmp_path, [(0, good, None)]).failure.startswith(
        "frama-c ended with 0: [eva:summary] y"
    )
    assert proved(tmp_path, [(2, "", None)]).failure == "frama-c ended with 2: no output"
    assert proved(tmp_path, [(0, None, None)]).failure == "the analysis did not end in 60 s"
    second = proved(tmp_path, [(0, good, one), (3, "bad", None)])
    assert second.failure == "with separate arrays frama-c ended with 3: bad"
    with patch.object(proof.shutil, "which", lambda name: None):
        assert proof.frama_c(tmp_path, "servo", 60.0).failure == proof.INSTALL


# ---- images of a memory


def image_of(width: int = 8, has_origin: bool = False, zeros: Any = ()) -> Any:
    """Return the code for images of a layout of numbers, without any."""
    known = SimpleNamespace(width=width, size=32 + 5 * width + 8, layout=0x1122334455667788,
                            design=0x99AABBCCDDEEFF01, numbers=5, zeros=zeros)  # fmt: skip
    code: Any = object.__new__(image_code.ImageCode)
    literals = SimpleNamespace(real="double" if width == 8 else "float",
                               math_function=lambda name: name if width == 8 else f"{name}f",
                               write_real=lambda x: f"{float(x):g}")  # fmt: skip
    code.known, code.structs = known, SimpleNamespace(literals=literals, prefix="servo_")
    code.has_origin, code.write = has_origin, literals.write_real
    code.save, code.load, code._ranges = [], [], []
    return code


def test_the_head_of_an_image_has_its_kind_size_layout_and_design() -> None:
    """In words of 32 bits, low ones first; the origin, and the check of 64 bits at the end."""
    code = image_of()
    magic = int.from_bytes(image_code.MAGIC, "little")
    assert code.save_lines() == [
        f"    memory_put_word(image, 0, {magic:#x}U);",
        f"    memory_put_word(image, 4, {(8 << 16) | image_code.VERSION:#x}U);",
        "    memory_put_word(image, 8, 0x50U);",
        "    memory_put_word(image, 16, 0x55667788U);",
        "    memory_put_word(image, 20, 0x11223344U);",
        "    memory_put_word(image, 24, 0xddeeff01U);",
        "    memory_put_word(image, 28, 0x99aabbccU);",
        "    memory_put_word(image, 12, 0U);",
        "    check = memory_check(image);",
        "    memory_put_word(image, 72, (uint32_t)(check & 0xffffffffU));",
        "    memory_put_word(image, 76, (uint32_t)(check >> 32));",
    ]
    counted = image_of(has_origin=True)
    assert "    memory_put_word(image, 12, (uint32_t)state->origin);" in counted.save_lines()
    assert counted.load_lines() == ["    state->origin = (int32_t)memory_get_word(image, 12);"]
    assert code.load_lines() == []


def test_numbers_of_an_image_are_written_and_read_by_their_kind() -> None:
    """Arrays whole, constants checked, integers and flags within their range, zeros set."""
    code = image_of(zeros=(9,))

    def add(at: int, values: Any, value: Any) -> None:
        code._add(at, image_code._Part(np.array(values, dtype=float), value))

    add(0, [1.0, 2.0], Value(Array((1, 2), Number.REAL), "s->x"))
    add(2, [3.0], Value(Number.REAL, "s->a"))
    add(3, [4.0], Value(Number.INT, "s->n"))
    add(4, [1.0], Value(Number.BOOL, "s->on"))
    add(5, [7.0], Value(Number.REAL, "s->c", constant=7.0))
    add(6, [8.0], None)
    add(9, [5.0], Value(Number.BOOL, "s->z"))
    largest = image_code._LARGEST_INTEGER
    assert code.save == [
        "    memory_put_all(image, 0, s->x[0], 2);",
        "    memory_put(image, 2, s->a);",
        "    memory_put(image, 3, (double)s->n);",
        "    memory_put(image, 4, s->on ? 1 : 0);",
        "    memory_put(image, 5, 7);",
        "    memory_put(image, 6, 8);",
        "    memory_put(image, 9, 5);",
    ]
    assert code.load == [
        "    memory_get_all(image, 0, s->x[0], 2);",
        "    s->a = memory_get(image, 2);",
        "    s->n = memory_whole(memory_get(image, 3));",
        "    s->on = memory_get(image, 4) != 0;",
        "    s->z = false;",
    ]
    assert code._ranges == [
        (3, -float(largest), float(largest)), (4, 0.0, 1.0), (5, 7.0, 7.0), (9, 5.0, 5.0),
    ]  # fmt: skip
    text = "\n".join(code.functions())
    assert "memory_ranges[4] = {" in text
    assert "{3, " in text
    assert "for (int i = 0; i < 4; i++) {" in text
    assert "for (int k = 0; k < 5; k++) {" in text
    assert "for (int at = 0; at < 72; at += 4) {" in text
    assert (
        "memory_get_word(image, 12) != 0U || memory_get_long(image, 24) != 0x99aabbccddeeff01ULL"
        in text
    )
    assert "memory_get_long(image, 16) != 0x1122334455667788ULL" in text
    assert "    memory_put_word(image, 36 + 8 * k, (uint32_t)(bits >> 32));" in text
    assert "const uint64_t bits = memory_get_long(image, 32 + 8 * k);" in text


def test_images_of_single_precision_have_one_word_for_a_number() -> None:
    """And no code for integers or arrays where there are none."""
    code = image_of(4, has_origin=True)
    code._add(0, image_code._Part(np.array([1.0]), Value(Number.REAL, "s->a")))
    text = "\n".join(code.functions())
    assert "memory_put_word(image, 32 + 4 * k, bits);" in text
    assert "const uint32_t bits = memory_get_word(image, 32 + 4 * k);" in text
    assert "fabsf(x) <= FLT_MAX" in text
    assert "memory_whole" not in text
    assert "memory_put_all" not in text
    assert "memory_ranges" not in text
    assert "memory_get_word(image, 12) != 0U" not in text
    assert text.endswith("return true;\n}")


def test_properties_that_are_not_proved_are_alarms_and_valid_promises_count() -> None:
    """But for assumptions of the C library, and dead ones of the separate arrays' header."""
    assumed = sorted(proof._ASSUMED)[0]
    proved_as = sorted(proof._PROVED)[0]
    rows = [
        ("src", "a/servo.c", "12", "step", "division_by_zero", "Unknown", "x != 0"),
        ("src", "a/servo.c", "13", "step", "overflow", proved_as, "fits"),
        ("FRAMAC_SHARE/libc", "math.h", "5", "sqrt", assumed, "Unknown", "x >= 0"),
        ("FRAMAC_SHARE/libc", "math.h", "6", "sqrt", "division_by_zero", "Unknown", "y"),
        ("src", "a/servo.c", "14", "step", assumed, "Unknown", "z"),
        ("src", f"a/servo_{separate.HEADER}", "15", "step", "overflow", "Dead", "w"),
        ("src", "a/servo.c", "16", "step", "overflow", "Dead", "w"),
        ("src", "c.h", "20", "step", "postcondition", "Valid", "a_number: ok"),
        ("src", "c.h", "21", "step", "postcondition", "Valid", "within_limits: ok"),
        ("src", "c.h", "22", "step", "postcondition", "Valid", "other: ok"),
        ("src", "c.h", "23", "step", "assertion", "Valid", "a_number: ok"),
        ("src", "c.h", "24", "step", "precondition", "Valid", "a_number: ok"),
    ]
    table = "\n".join(["head", *("\t".join(row) for row in rows)])
    log = (
        "3 functions analyzed (out of 5)\n10 statements reached (out of 11)\n"
        "using specification for function sqrt\nusing specification for function fabs\n"
    )
    found = proof.read_findings("30.0", 2.0, log, table)
    valid = "Valid" in proof._PROVED
    own = [each.line for each in found.alarms if each.line < 20]
    assert own == [12, 6, 14, 16]
    assert valid
    assert found.alarms[0] == Alarm("servo.c", 12, "step", "division_by_zero", "Unknown", "x != 0")
    assert (found.promises, found.functions, found.statements) == (2, "3 of 5", "10 of 11")
    assert (found.assumed, found.failure) == (("fabs", "sqrt"), "")
    failed = proof.read_findings("30.0", 2.0, "by the Frama-C kernel: 12 errors", table)
    assert failed.failure == "12 errors of the Frama-C kernel, see eva.log"
    assert failed.functions == "unknown"
    recursive = proof.read_findings("30.0", 2.0, "recursive call", table)
    assert recursive.failure == "the analysis found a recursive call, see eva.log"
