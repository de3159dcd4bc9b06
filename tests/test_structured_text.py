"""``ql.export.st``: controllers in Structured Text have the bits of their C code."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.export import TranslationError, c_source, st_source
from quell.export.structured_text.c_reader import CFile
from quell.export.structured_text.places import Node, Whole
from quell.export.structured_text.translator import Translator

from .cases import cases
from .commands import Shown, in_this_process
from .in_c import InC, needs_gcc
from .setups import TWO_MASS
from .st_in_python import FunctionBlock

DT = 1e-3
LIMITS = {"u_min": -2.0, "u_max": 3.0, "rate_limit": 60.0}


def adrc(order: int = 2, **parts: Any) -> ql.ADRC:
    """Return an ADRC with an observer without model."""
    return ql.ADRC(ql.ESO.model_free(order, 1.5, 20.0, DT), 4.0, **LIMITS, **parts)


RAMPS = ql.ADRC(ql.ESO.model_free(2, 1.5, 20.0, DT, disturbance_order=2), 4.0, **LIMITS)
DELAYED = ql.ADRC(ql.ESO.model_free(2, 1.5, 20.0, DT, delay=3 * DT), 4.0, **LIMITS)
CASCADE = ql.ADRC(ql.ESO.cascade(2, 1.5, 20.0, DT), 4.0, **LIMITS)
PID = ql.baselines.PID(4.0, 2.0, 1.0, tf=0.05, dt=DT, **LIMITS)
COMPENSATOR = ql.Compensator(ql.ESO.model_free(2, 1.5, 20.0, DT), **LIMITS)
WIDE = {"u_min": -2.0, "u_max": 3.0}  # no limit of the rate, which is infinite in C
PPI = ql.baselines.PPI(2.0, 3.0, 1.0, dt=DT, **WIDE)
FOLLOWING = ql.controllers.Prefiltered(
    ql.ADRC(ql.ESO.model_free(2, 1.5, 20.0, DT), 4.0, **LIMITS), ql.controllers.ReferenceModel(2.0)
)
COMPENSATED = ql.controllers.Compensated(PID, COMPENSATOR)
CONTROLLERS = {
    "PPI, without a limit of its rate": PPI,
    "reference model": FOLLOWING,
    "PID with a compensator": COMPENSATED,
    "order 1": adrc(1),
    "order 2": adrc(),
    "order 4": adrc(4),
    "f and f'": RAMPS,
    "feedforward": adrc(feedforward=True),
    "delay": DELAYED,
    "cascade": CASCADE,
    "PID": PID,
    "compensator": COMPENSATOR,
}


QUICK = ("order 2", "PID")
ROWS = [
    pytest.param(each, precision, id=f"{name}, {precision}",
                 marks=() if name in QUICK and precision == "double" else pytest.mark.trial)
    for name, each in CONTROLLERS.items() for precision in ("double", "single")
]  # fmt: skip


def samples(count: int, further: int) -> Any:
    """Yield inputs: noise, NaN, absurd numbers, limits, manual operation, other u, a restart."""
    random = np.random.default_rng(3)
    y = v = u = 0.0
    for k in range(count):
        measured = (
            math.nan if k % 71 == 70 else 1e70 if k % 93 == 92 else y + 1e-3 * random.normal()
        )
        r = math.nan if k < 20 else 1.0 if k < 300 else -5.0 if k < 600 else 0.1 * random.normal()
        r = 50.0 if 100 <= k < 160 else r  # a compensator, too, comes to a limit of u
        u = yield {
            "r": r, "y": measured, "manual": 400 <= k < 460,
            "u_manual": math.nan if k % 50 == 49 else 0.3,
            "limited": k > 350 and k % 3 == 0, "restart": k == 700,
            "u_limited": math.nan if k % 40 == 39 else 0.1 * random.normal(),
            "further": [0.01 * r] * further,
        }  # fmt: skip
        v += 0.02 * (1.5 * u - 3.0 * y - 0.5 * v)
        y = 1e9 if k % 190 == 189 else 0.0 if k % 190 == 0 else y + 0.02 * v


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize(("controller", "precision"), ROWS)
def test_the_text_read_as_python_has_the_bits_of_the_c_code(
    tmp_path: Path, controller: Any, precision: str
) -> None:
    """900 cycles with all inputs; a reader of 130 lines takes the place of a PLC."""
    single = precision == "single"
    shown = ql.controllers.in_single_precision(controller) if single else controller
    source = c_source(shown, "axis")
    own, block = InC(source, tmp_path), FunctionBlock(st_source(controller, "axis", precision))
    has_manual, was_manual = "track" in source.operations, False
    given = "u_0" if controller is COMPENSATOR else "r"
    run = samples(900, len(source.further))
    now, flags, before = next(run), 0, 0.0
    for k in range(900):
        inputs = {
            given: now["r"],
            "y": now["y"],
            **dict(zip(source.further, now["further"], strict=True)),
        }
        inputs |= {name: now[name] for name in ("limited", "u_limited", "restart")}
        if has_manual:
            inputs |= {"manual": now["manual"], "u_manual": now["u_manual"]}
        block.call(**inputs)
        if now["limited"]:
            own.run("applied", now["u_limited"])
            usable = math.isfinite(now["u_limited"])
            before = float(source_real(source)(now["u_limited"])) if usable else before
        if now["restart"]:
            own.run("reset")
            before = 0.0
        if has_manual and now["manual"]:
            own.run("track", now["r"], now["y"], now["u_manual"], *now["further"])
            usable = math.isfinite(now["u_manual"])
            u = float(source_real(source)(now["u_manual"])) if usable else before
        else:
            if has_manual and was_manual:
                own.run("hand_over")
            u = own.run("step", now["r"], now["y"], *now["further"])
        was_manual, before = now["manual"], u
        found = float(block.v["u"])
        assert found.hex() == u.hex(), f"sample {k}: {found!r}, must be {u!r}"
        flags |= block.v["status"]
        now = run.send(0.0 if math.isnan(u) else u) if k < 899 else now
    assert flags & 0x7 == 0x7  # missing numbers, and a u at its limit
    assert not has_manual or flags & 0x400


def source_real(source: Any) -> Any:
    """Return the type of real numbers of a C code."""
    return np.float32 if source.precision == "single" else float


# ---- By a compiler ----

IEC2C = shutil.which("iec2c")
LIBRARY = Path(IEC2C).resolve().parent / "lib" if IEC2C else Path("lib")
needs_matiec = pytest.mark.skipif(
    IEC2C is None or not (LIBRARY / "C").is_dir() or shutil.which("gcc") is None,
    reason="iec2c, of MATIEC, with its folder lib beside it, or gcc is missing",
)
_DRIVER = """
#include "iec_std_lib.h"
#include "POUS.h"
#include "POUS.c"
#include "axis.h"
#include <string.h>
#include <stdio.h>
#include <math.h>
typedef axis_real real;
TIME __CURRENT_TIME;
BOOL __DEBUG;
static unsigned seed = 1;
static real noise(void) { seed = seed * 1103515245u + 12345u; return (real)((double)(seed >> 16) / 65536.0 - 0.5); }
int main(void)
{
    static AXIS block;
    static axis_state own;
    real y = 0, v = 0, before = 0;
    int was = 0;
    AXIS_init__(&block, 0);
    axis_init(&own);
    for (int k = 0; k < 6000; k++) {
        const real measured = k % 701 == 700 ? (real)NAN : k % 903 == 902 ? (real)1e38 : y + (real)1e-3 * noise();
        const real r = k < 100 ? (real)NAN : k < 2000 ? 1 : k < 3500 ? (real)-5 : (real)0.5 * noise();
        const real um = k % 50 == 49 ? (real)NAN : (real)0.3, ul = k % 40 == 39 ? (real)NAN : (real)0.1 * noise();
        const int manual = MANUAL && k >= 2500 && k < 2800, limited = k > 1000 && k % 3 == 0, restart = k == 4000;
        real u, found;
        block.GIVEN.value = r;
        block.Y.value = measured;
        block.LIMITED.value = limited;
        block.U_LIMITED.value = ul;
        block.RESTART.value = restart;
        if (limited) { axis_applied(&own, ul); if (ul == ul) before = ul; }
        if (restart) { axis_reset(&own); before = 0; }
#if MANUAL
        block.MANUAL_.value = manual;
        block.U_MANUAL.value = um;
        if (manual) { axis_track(&own, r, measured, um FURTHER); u = um == um ? um : before; }
        else { if (was) axis_hand_over(&own); u = axis_step(&own, r, measured FURTHER); }
        was = manual;
#else
        u = axis_step(&own, r, measured FURTHER);
#endif
        INPUTS
        AXIS_body__(&block);
        found = block.U.value;
        before = u;
        if (memcmp(&found, &u, sizeof u) || block.STATUS.value != (unsigned)axis_status(&own)) {
            printf("sample %d: %.17g, must be %.17g\\n", k, (double)found, (double)u);
            return 1;
        }
        if (k % 900 == 899) y = 1e9; else if (k % 900 == 0) y = 0;
        if (!(u == u)) u = 0;
        v += (real)1e-3 * ((real)1.5 * u - 3 * y - (real)0.5 * v);
        y += (real)1e-3 * v;
    }
    return 0;
}
"""


@needs_matiec
@pytest.mark.parametrize(("controller", "precision"), ROWS)
def test_the_text_compiled_by_matiec_has_the_bits_of_the_c_code(
    tmp_path: Path, controller: Any, precision: str
) -> None:
    """6000 cycles with noise, NaN, absurd numbers, limits, manual operation, other u and a restart."""
    single = precision == "single"
    source = c_source(
        ql.controllers.in_single_precision(controller) if single else controller, "axis"
    )
    (tmp_path / "axis.h").write_text(source.header)
    (tmp_path / "axis.c").write_text(source.source)
    (tmp_path / "axis.st").write_text(st_source(controller, "axis", precision))
    driver = _DRIVER.replace("MANUAL_.", "MANUAL_IN.").replace(
        "GIVEN", "U_0" if controller is COMPENSATOR else "R"
    )
    driver = re.sub(r"\bMANUAL\b", str(int("track" in source.operations)), driver).replace(
        "MANUAL_IN.", "MANUAL."
    )
    driver = driver.replace("FURTHER", ", (real)0.01 * r" * len(source.further))
    inputs = "".join(f"block.{each.upper()}.value = (real)0.01 * r;" for each in source.further)
    (tmp_path / "driver.c").write_text(driver.replace("INPUTS", inputs))
    for command in (
        [IEC2C, "-I", LIBRARY, "-T", tmp_path, tmp_path / "axis.st"],
        ["gcc", "-w", "-std=gnu99", "-O1", "-ffp-contract=off", "-I", tmp_path, "-I", LIBRARY / "C",
         tmp_path / "driver.c", tmp_path / "axis.c", "-o", tmp_path / "driver", "-lm"],
        [tmp_path / "driver"],
    ):  # fmt: skip
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


# ---- What is written, and what is refused ----


@pytest.mark.trial
def test_the_files_have_no_placeholder_and_names_are_those_of_the_standard(tmp_path: Path) -> None:
    """No name has two _ in a row or one at its end; the README names every input."""
    files, comparison = ql.export.st(adrc(feedforward=True), tmp_path / "out", name="axis")
    assert comparison is None
    assert [path.name for path in files] == ["axis.st", "README.md"]
    text, readme = (path.read_text() for path in files)
    assert text.isascii()
    assert not re.search(r"\w__|_\b", re.sub(r"END_\w+|VAR_\w+", "", text))
    inputs = re.findall(r"(\w+) :", text[text.index("VAR_INPUT") : text.index("END_VAR")])
    assert all(f"`{name}`" in readme for name in (*inputs, "u", "status"))
    assert not re.search(r"@\w+@", readme)


@pytest.mark.trial
@cases(
    ("controller", "name", "rule"),
    [
        (
            adrc(learner=ql.learners.Kalman()),
            "axis",
            "learner = Kalman: learners have no Structured",
        ),
        (
            ql.ADRC(ql.ESO.nonlinear(2, 1.5, 20.0, DT, delta=0.05), 4.0, **LIMITS),
            "axis",
            "copysign",
        ),
        (
            ql.ADRC(ql.ESO.model_free(2, 1.5, 20.0, DT), 4.0),
            "axis",
            "give the controller both limits",
        ),
        (ql.ADRC(ql.ESO.model_free(2, 1.5, 20.0, DT), 4.0, u_max=1.0), "axis", "u_min = -inf"),
        (
            ql.Axes([ql.ADRC(ql.ESO.model_free(2, 1.0, 20.0, DT), 4.0)]),
            "axis",
            "each axis by itself",
        ),
        (adrc(), "axis__1", "single _"),
        (adrc(), "axis_", "single _"),
        (adrc(), "Program", "is a keyword of Structured Text"),
        (42, "axis", "controller = 42"),
    ],
)
def test_what_has_no_text_is_refused_and_nothing_is_written(
    tmp_path: Path, controller: Any, name: str, rule: str
) -> None:
    """The message names the part and says what to do."""
    with pytest.raises(ValueError, match=re.escape(rule)):
        ql.export.st(controller, tmp_path / "out", name=name)
    assert not any(tmp_path.iterdir())


FUNCTIONS = """
static double sq(double a)
{
    return a * a;
}
static double add(double a, double b)
{
    return a + b;
}
static double twice(double a)
{
    double b = sq(a + 1.0);
    return b + b;
}
double f(double x, double y, double z)
{
    return EXPRESSION;
}
"""


@cases(
    ("expression", "value"),
    [
        ("sq(x + y) + sq(x - y)", 50.0),
        ("add(x + 1.0, add(y + 1.0, z))", 18.0),
        ("add(add(x + 1.0, y), add(y + 1.0, z))", 22.0),
        ("twice(x + 0.5) - sq(twice(y) - sq(z + 1.0))", -2459.5),
        ("x > y ? sq(y + z) : sq(x + z)", 144.0),
    ],
)
def test_calls_of_small_functions_in_one_expression_keep_their_arguments(
    expression: str, value: float
) -> None:
    """Each call has its own, also where calls are arguments of calls."""
    writer = Translator(CFile("", FUNCTIONS.replace("EXPRESSION", expression)), False, ("u",))
    given = [writer.variable(each, "real", "state") for each in "xyz"]
    found = writer.call(writer.file.function("f"), given)
    assert isinstance(found, Node)
    writer.assign(Node("real", lambda: "u", 9, True), found)
    declared = "".join(
        f"{each.name} : LREAL;\n" for section in writer.variables.values() for each in section
    )
    block = FunctionBlock(f"VAR\nu : LREAL;\n{declared}END_VAR\n\n{writer.text()}")
    block.call(x=3.0, y=4.0, z=9.0)
    assert block.v["u"] == value


@cases(("text", "number"), [("0x1F", 31), ("0xfU", 15), ("31UL", 31), ("0", 0), ("1", 1)])
def test_whole_numbers_are_read_with_their_base(text: str, number: int) -> None:
    """Hexadecimal ones, too."""
    writer = Translator(CFile("", f"int f(int x)\n{{\n    return {text};\n}}\n"), False, ())
    found = writer.call(writer.file.function("f"), [Node(Whole(), lambda: "x")])
    assert isinstance(found, Node)
    assert found.text() == str(number)


@cases("text", ["017", "0x1.8p3", "12ab", "1.5x", "0b11", "0x"])
def test_numbers_that_have_no_text_are_refused(text: str) -> None:
    """Octal and binary ones, and what is no number."""
    file = CFile("", f"double f(double x)\n{{\n    return {text};\n}}\n")
    writer = Translator(file, False, ())
    with pytest.raises(TranslationError, match=r"C code|number 017 of C"):
        writer.call(file.function("f"), [Node("real", lambda: "x")])


@pytest.mark.parametrize(
    ("body", "rule"),
    [
        ("    while (x > 0.0) {\n    }\n", "C code with while"),
        ("    x = y ^ 1;\n", "C code '^ 1"),
        ("    goto end;\n", "C code with goto"),
    ],
)
def test_c_that_the_reader_does_not_know_is_refused(body: str, rule: str) -> None:
    """It never becomes another program silently."""
    file = CFile("", f"void f(double x)\n{{\n{body}}}\n")
    with pytest.raises(TranslationError, match=re.escape(rule)):
        file.function("f")


@pytest.mark.trial
def test_the_command_writes_the_block_and_compares_single_precision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As for C; it says NOT, because no PLC has tried it."""
    monkeypatch.chdir(tmp_path)
    arguments = ("export", "servo.toml", "--to", "st", "--out", "out", "--name", "axis")

    def export(scenario: str, *options: str) -> Shown:
        Path("servo.toml").write_text(f"{TWO_MASS}u_min = -1.0\nu_max = 1.0\n{scenario}")
        return in_this_process((*arguments, *options), monkeypatch, capsys)

    for scenario, options, rule in (
        ("", ("--prove",), "--prove: only with --to c"),
        ("", ("--accept",), "--accept: goes with --precision single"),
        ("", ("--precision", "single"), "scenario: missing"),
        ("scenario = 3", ("--precision", "single"), "scenario"),
        (FAR, ("--precision", "single"), "changes u by"),
    ):
        shown = export(scenario, *options)
        assert (shown.code, rule in " ".join(shown.err.split())) == (2, True), shown
        assert not Path("out").exists()
    shown = export("[scenario]\nduration = 2.0\n", "--precision", "single")
    assert shown.code == 0, shown
    assert "Single precision changes u by" in shown.out
    assert "NOT tried on a PLC" in shown.out
    assert " : REAL;" in Path("out/axis.st").read_text()
    shown = export(FAR, "--precision", "single", "--accept", "--overwrite")
    assert shown.code == 0, shown


FAR = """
[scenario]
duration = 2.0
x0 = [1000.0, 1000.0, 0.0, 0.0]
reference = 1000.1
"""
