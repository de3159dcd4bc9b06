"""Exported C under sanitizers in hostile programs, its style, and wrong versions that are found."""

from __future__ import annotations

import dataclasses
import random
import shutil
from pathlib import Path
from typing import Any

import pytest

import quell as ql

from .benchmark_module import BENCHMARKS, benchmark
from .in_c import needs_gcc

LIMITS = {"u_min": -2.0, "u_max": 3.0, "rate_limit": 60.0}
OBSERVER = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=0.01)
ADRC = ql.ADRC(OBSERVER, 1.5, **LIMITS)
LEARNING = ql.ADRC(
    OBSERVER, 1.5, learner=ql.learners.Kalman(), guard=ql.Guard(), feedforward=True, **LIMITS
)
MOVING = ql.controllers.Prefiltered(
    ql.ADRC(OBSERVER, 1.5, feedforward=True, **LIMITS),
    ql.controllers.ProfileGenerator(0.5, 2.0, 5.0),
)
SEARCHING = ql.ADRC(
    OBSERVER, 1.5, learner=ql.learners.Harmonic(search=True), guard=ql.Guard(), **LIMITS
)


@pytest.fixture
def hostile() -> Any:
    """The benchmark of hostile programs."""
    return benchmark("hostile_exports")


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize("single", [False, True], ids=["double", "single"])
@pytest.mark.parametrize(
    "controller",
    [
        pytest.param(ADRC, id="ADRC, counts"),
        pytest.param(LEARNING, id="Kalman, feedforward"),
        pytest.param(MOVING, id="moves"),
        pytest.param(SEARCHING, id="Harmonic, search"),
        pytest.param(ql.baselines.PID(4.0, 2.0, 1.0, tf=0.05, dt=0.01, **LIMITS), id="PID"),
    ],
)
def test_any_calls_with_any_bits_leave_u_a_number_within_its_limits(
    tmp_path: Path, hostile: Any, controller: Any, single: bool
) -> None:
    """200 000 calls of all functions by chance; no sanitizer reports anything."""
    shown, source = hostile.exported_source(controller, single)
    assert hostile.run(hostile.built(tmp_path, shown, source), 2e5) == ("0", "0", "0")


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize("single", [False, True], ids=["double", "single"])
def test_any_calls_of_axes_leave_all_u_numbers_within_their_limits(
    tmp_path: Path, hostile: Any, single: bool
) -> None:
    """Two axes with a learner and three actuators."""
    axes, observer = benchmark("hostile_axes"), ql.ESO.model_free(2, 1.0, 30.0, 0.01)
    learning = ql.ADRC(observer, 5.0, learner=ql.learners.RLS(), guard=ql.Guard())
    wide, limits = [[1.0, 0.3, 0.2], [0.2, 1.0, -0.3]], {"u_min": -5.0, "u_max": 5.0}
    rule = "direction" if single else "each"
    controller = ql.Axes([learning, ql.ADRC(observer, 5.0)], wide, saturation=rule, **limits)
    source = ql.export.c_source(controller, "robot", precision="single" if single else "double")
    program = axes.hostile_program(source, 1)
    made = hostile.compiled(tmp_path, source, program, "address")
    assert hostile.run(made, 1e5) == ("0", "0", "0")


WRONG = [
    pytest.param({"        applied = limits->high;\n": ""}, ("0", "0", 1), id="no upper limit"),
    pytest.param({
        "return fabs(value) <= LARGEST_SIGNAL;": "return value == value;",
        "if (!(applied == applied && applied >= -DBL_MAX && applied <= DBL_MAX)) {": "if (false) {",
        "if (!is_usable_control(&design->limits, unlimited)) {": "if (false) {",
    }, ("0", 1, "0"), id="no tests for NaN"),
    pytest.param({"    state->z[0] -= distance;": "    state->z[(int)distance] -= distance;"},
                 ("1: ", "", ""), id="index"),
]  # fmt: skip


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize(("changes", "expected"), WRONG)
def test_a_hostile_program_finds_what_is_wrong(
    tmp_path: Path, hostile: Any, changes: dict[str, str], expected: tuple[Any, ...]
) -> None:
    """A limit, the tests for NaN or an index that is missing, in the generated code."""
    shown, source = hostile.exported_source(ADRC, False)
    code = source.source
    for old, new in changes.items():
        assert old in code
        code = code.replace(old, new)
    wrong = dataclasses.replace(source, source=code)
    for found, wanted in zip(
        hostile.run(hostile.built(tmp_path, shown, wrong), 2e5), expected, strict=True
    ):
        assert int(found) >= wanted if isinstance(wanted, int) else found.startswith(wanted)


def test_the_program_calls_every_function(hostile: Any) -> None:
    """It is refused for a function that it does not know, so none is forgotten."""
    source = ql.export.c_source(ADRC, "servo", resolution=1e-4)
    text = hostile.hostile_program(ADRC, source)
    assert all(f"servo_{operation}(" in text for operation in source.operations)
    more = dataclasses.replace(source, operations=(*source.operations, "explode"))
    with pytest.raises(ValueError, match="explode"):
        hostile.hostile_program(ADRC, more)


KINDS = ("NaN", "copy", "fields", "image", "index", "limit", "rate", "reset")


def test_wrong_versions_of_all_kinds_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many of each; each is another text that differs in the line, or the two lines, that it names."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    mutants = benchmark("mutated_exports")
    text = ql.export.c_source(ADRC, "servo").source
    found = mutants.drawn({"ADRC": text}, 3 * len(KINDS), random.Random(7))
    assert [each.kind for each in found] == [*KINDS] * 3
    for mutant in found:
        lines = mutants.changed(text, mutant).splitlines()
        count, at = mutant.before.count("\n") + 1, mutant.line - 1
        assert lines[:at] == text.splitlines()[:at]
        assert lines[at + count :] == text.splitlines()[at + count :]
        assert lines[at : at + count] != text.splitlines()[at : at + count]


def test_two_lines_are_exchanged_where_both_are_of_one_form(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is written into an image, or what is assigned; not a line and another kind of line."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    exchanges = benchmark("mutated_exports").exchanges
    first, second = "    memory_put(image, 6, state->r);", "    memory_put(image, 7, state->y);"
    assert [*exchanges(first, second)] == [
        "    memory_put(image, 6, state->y);\n    memory_put(image, 7, state->r);"
    ]
    first, second = "    state->r = memory_get(image, 6);", "    state->y = memory_get(image, 7);"
    assert [*exchanges(first, second)] == [
        "    state->y = memory_get(image, 6);\n    state->r = memory_get(image, 7);"
    ]
    assert [*exchanges(first, "    memory_put(image, 7, state->y);")] == []


@pytest.mark.trial
def test_drawn_controllers_are_those_of_their_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each has a name of its own, and is exported in both precisions."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    proofs = benchmark("proofs")
    found = dict(proofs.drawn(4, 7))
    assert len(found) == 4
    assert [*found] == [name for name, _ in proofs.drawn(4, 7)]
    assert not {*found} & {name for name, _ in proofs.drawn(4, 8)}
    for controller in found.values():
        for precision in ("double", "single"):
            assert (
                "servo_step" in ql.export.c_source(controller, "servo", precision=precision).source
            )


@pytest.mark.trial
@needs_gcc
@pytest.mark.skipif(shutil.which("cppcheck") is None, reason="cppcheck is missing")
@pytest.mark.parametrize("controller", [ADRC, LEARNING, MOVING], ids=["ADRC", "Kalman", "moves"])
def test_exported_code_breaks_no_rule_but_the_listed_ones(
    monkeypatch: pytest.MonkeyPatch, hostile: Any, controller: Any
) -> None:
    """Of MISRA C:2012, as far as cppcheck knows them; the analyser of gcc has nothing to report."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    style = benchmark("exported_style")
    _, source = hostile.exported_source(controller, True)
    found = style.style_of(source)
    assert style.unexplained(found) == []
    assert found["8.14"] > 0  # cppcheck has looked


def test_the_deviations_of_the_documentation_are_those_of_the_benchmark(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The table in docs/target_faults has each rule with its reason."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    page = (BENCHMARKS.parent / "docs/target_faults.md").read_text(encoding="utf-8")
    for rule, reason in benchmark("exported_style").DEVIATIONS.items():
        kind, colon, text = reason.partition(": ")
        row = f"| {rule} | {kind} | {text} |" if colon else f"| `{rule}` | | {reason} |"
        assert row in page, row
