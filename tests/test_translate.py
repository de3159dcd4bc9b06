"""Kernels become C functions that calculate the same, bit for bit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from quell.export.c_files import CFiles, translated
from quell.export.translate.program import Program
from quell.export.translate.structs import Findings, ascii_text, whole_kind
from quell.export.translate.text import TranslationError, function_name
from quell.kernels.dispatch import generic, kernel
from quell.kernels.sized import Flag, Scalars, Scratch, Size, clear
from quell.types import Matrix, Vector

from .cases import cases
from .in_c import InC, needs_gcc

NUMBERS = (0.0, -0.0, 1.0, -2.5, 1e300, 1e-300, math.inf, -math.inf, math.nan)

_LIMIT = 3.5
_ROWS = 3


class Count(Scalars):
    """Numbers of a state."""

    total: float
    seen: float  # 1 after the first sample
    never: float  # always zero
    kind: float


class Design(NamedTuple):
    """Parameters."""

    gain: Vector
    size: Size
    fancy: Flag
    low: float
    rows: int


class State(NamedTuple):
    """State."""

    x: Vector
    table: Matrix
    count: NDArray[Count]


def source_of(function: Callable[..., Any], design: Design, state: Any) -> Any:
    """Return the C files with ``function(design, state, a, b)`` as the operation ``run``."""

    def write(findings: Findings) -> Any:
        files = CFiles("t", design, state, findings)
        files.add_init()
        call = files.call(function, *files.both, files.number("a"), files.number("b"))
        files.add(
            "run", "double NAME(t_state *state, double a, double b)", "Run.", f"    return {call};"
        )
        return files.write(["Test."], (), [])

    return translated(write)


def compiled(tmp_path: Path, function: Callable[..., Any], design: Design) -> Any:
    """Return a function that runs ``function`` in C, from a fresh state on."""
    in_c = InC(source_of(function, design, new_state()), tmp_path)
    return lambda a, b: in_c.run("run", a, b)


def new_design(**changes: Any) -> Design:
    """Return parameters."""
    return Design(np.array([0.5, -2.0, 3.0]), 3, False, -1.0, 2)._replace(**changes)


def new_state() -> State:
    """Return a state."""
    return State(np.zeros(3), np.arange(6.0).reshape(3, 2), Count.zeros())


def check_equal(tmp_path: Path, function: Callable[..., Any], **changes: Any) -> None:
    """Check that a function gives in C what it gives in Python, for all pairs of numbers."""
    design = new_design(**changes)
    in_c, state = compiled(tmp_path, function, design), new_state()
    with np.errstate(all="ignore"):
        for a, b in itertools.product(NUMBERS, NUMBERS):
            expected = float(function(design, state, np.float64(a), np.float64(b)))
            found = in_c(a, b)
            assert found == expected or (found != found and expected != expected), (a, b)


class WithScratch(NamedTuple):
    """A state with an array that only one call needs."""

    x: Vector
    scratch: Scratch


@kernel
def swapped(state: WithScratch, a: float) -> float:
    """Exchange the halves of x, by way of the scratch array."""
    x, scratch = state.x, state.scratch
    for i in range(4):
        scratch[i] = x[(i + 2) % 4] + a
    for i in range(4):
        x[i] = scratch[i]
    return x[0]


def run_swapped(design: Design, state: WithScratch, a: float, b: float) -> float:
    """Return an entry of x, and clear the scratch array."""
    found = swapped(state, a)
    for i in range(4):
        state.scratch[i] = 0.0
    return found + b


def with_scratch() -> WithScratch:
    """Return a state."""
    return WithScratch(np.arange(4.0), np.zeros(4))


@needs_gcc
def test_a_scratch_array_is_a_local_variable_in_c(tmp_path: Path) -> None:
    """It is no part of the C state; a kernel that reads it without a name is refused."""
    source = source_of(run_swapped, new_design(), with_scratch())
    assert "scratch" not in source.header
    assert "double scratch[4];" in source.source
    in_c, state = InC(source, tmp_path), with_scratch()
    for a in (1.0, 2.5, -3.0):
        assert in_c.run("run", a, 0.5) == run_swapped(new_design(), state, a, 0.5)

    def unnamed(design: Design, state: WithScratch, a: float, b: float) -> float:
        return state.scratch[0] + a

    with pytest.raises(TranslationError, match="annotated with Scratch needs a name"):
        source_of(unnamed, new_design(), with_scratch())


@kernel
def two(a: float, b: float) -> tuple[float, int]:
    """Return two numbers."""
    if a > b:
        return a, 1
    return b, 2


@kernel
def fill(x: Vector, value: float) -> None:
    """Write a number to all entries."""
    for i in range(x.size):
        x[i] = value + i


def extremes(design: Design, state: State, a: float, b: float) -> float:
    """Use min and max in Python's order, for numbers that are not comparable, too."""
    return min(a, b) + 10.0 * max(a, b, 1.0) - min(max(a, design.low), 7.0)


def branches(design: Design, state: State, a: float, b: float) -> float:
    """Use branches, chained comparisons and conditions."""
    result = 0
    if -1.0 <= a < b or a != b:
        result |= 4
    elif abs(a) > _LIMIT and b != 0.0:
        result = 9
    else:
        result += 1
    extra = a if result & 4 != 0 else b
    return extra + result


def loops(design: Design, state: State, a: float, b: float) -> float:
    """Use loops, slices, rows and several targets."""
    fill(state.x[1:], a)
    total = 0.0
    for i in range(design.size - 1, -1, -1):
        total = 0.5 * total + design.gain[i] * state.x[i]
        if i == design.rows:
            continue
        for j in range(state.table.shape[1]):
            state.table[i, j] = state.table[i, j] * 0.5 + b
    row = state.table[int(min(max(a, 0.0), 2.0)) if a == a else 0]
    state.x[0] = state.x[2] = row[0] - row[1]
    low, high = row[0], row[1]
    low, high = high, low
    return total + low - 2.0 * high + state.x[-1]


def numbers(design: Design, state: State, a: float, b: float) -> float:
    """Use powers, remainders and integers."""
    bounded = min(max(a, -50.0), 50.0) if a == a else 0.0
    whole = int(bounded)
    part = (whole - 7) % 5 + (whole - 7) // 5 + bounded % 3.0
    value, kind = two(a, b)
    return (
        part + kind * 0.5 + bounded**2 + math.copysign(1.0, b) + (value if value == value else 0.0)
    )


def states(design: Design, state: State, a: float, b: float) -> float:
    """Use numbers of a record: one that never changes, a flag, one with integers."""
    count = state.count[0]
    if count.seen == 0.0:
        count.seen = 1.0
        count.total = b
    count.never = 0.0
    count.kind = 3 if a > b else 1
    count.total += 0.25 * count.kind + count.never
    if count.kind == 3.0 and a == 1.0:
        clear(state.count)
    return count.total if count.total == count.total else count.seen


@kernel
def added(state: State, a: float) -> float:
    """Add to an entry of x, and return it."""
    state.x[0] += a if a == a else 1.0
    return state.x[0]


def unread(design: Design, state: State, a: float, b: float) -> float:
    """Combine results of kernels that nobody reads: what the kernels change stays."""
    lost = 2.0 * added(state, a) + (added(state, b) + 0.5)
    lost = added(state, 0.25)
    lost = 0.0
    return state.x[0] + lost


@needs_gcc
@cases("function", [extremes, branches, loops, numbers, states, unread])
def test_a_kernel_calculates_the_same_in_c(tmp_path: Path, function: Callable[..., Any]) -> None:
    """For all pairs of ordinary and of extreme numbers, bit for bit."""
    check_equal(tmp_path, function)


def chooses(design: Design, state: State, a: float, b: float) -> float:
    """Return what depends on constants."""
    if design.fancy:
        fill(state.x, a)
        return state.x[0]
    for i in range(state.x.size - 3):
        a += state.x[i]
    return a if state.table.shape[0] == _ROWS else b


def test_what_is_never_reached_does_not_exist_in_c() -> None:
    """Branches on flags and shapes, empty loops, functions and fields that only these use."""
    plain = source_of(chooses, new_design(), new_state())
    assert "fill" not in plain.source
    assert "for (" not in plain.source.partition("static double chooses")[2].partition("\n}")[0]
    assert "fancy" not in plain.header
    assert "table" not in plain.header
    fancy = source_of(chooses, new_design(fancy=True), new_state())
    assert "fill" in fancy.source


def test_numbers_that_never_change_are_constants_and_flags_are_bool() -> None:
    """A field that is only set to its initial value vanishes."""
    header = source_of(states, new_design(), new_state()).header
    assert "never" not in header
    assert "bool seen; /* 1 after the first sample */" in header
    assert "int kind;" in header
    assert "double total;" in header


def test_the_c_code_reads_like_the_kernel() -> None:
    """Names, docstrings, comments and else-if are those of Python."""
    text = source_of(branches, new_design(), new_state()).source
    assert "/* Use branches, chained comparisons and conditions." in text
    assert "    } else if (fabs(a) > LIMIT && b != 0.0) {" in text
    assert "static const double LIMIT = 3.5;" in text
    assert "From test_translate.branches. */" in text.replace("tests.", "")
    assert text.isascii()


def test_constants_of_one_name_in_several_modules_are_kept_apart() -> None:
    """Also where the modules have one name, and where the numbers are equal but of another type."""
    program = Program("t", False, Findings())
    asked = [
        ("_LARGEST", 30.0, "quell.a.kernels"),
        ("_LARGEST", 40.0, "quell.b.kernels"),
        ("_LARGEST", 50.0, "quell.c.kernels"),
        ("_LARGEST", 30, "quell.d.kernels"),
        ("LARGEST", 30.0, "quell.e.other"),
    ]
    names = [program.named_constant(*each) for each in asked]
    assert len(set(names)) == 4
    assert names[4] == names[0] == "LARGEST"
    lines = "\n".join(program.constant_lines())
    for name, (_, value, _) in zip(names, asked, strict=True):
        assert f"{'int' if isinstance(value, int) else 'double'} {name} = {value};" in lines


def recursive(design: Design, state: State, a: float, b: float) -> float:
    """Use a loop that has no counterpart."""
    while a > b:
        a -= 1.0
    return a


def lists(design: Design, state: State, a: float, b: float) -> float:
    """Use a list."""
    return [a, b][0]


def changed(design: Design, state: State, a: float, b: float) -> float:
    """Change a parameter."""
    design.gain[0] = a
    return b


def unknown_slice(design: Design, state: State, a: float, b: float) -> float:
    """Use a slice of unknown length."""
    fill(state.x[design.rows :], a)
    return b


@generic
def measured(design: Any, a: float) -> float:
    """Return a number, for a type without implementation."""
    raise TypeError


def unregistered(design: Design, state: State, a: float, b: float) -> float:
    """Call a generic function without implementation."""
    return measured(design, a)


@cases(
    ("function", "rule"),
    [
        (recursive, "while a > b"),
        (lists, r"\[a, b\]"),
        (changed, "design.gain.0.: parameters can not be changed"),
        (unknown_slice, "the length of a slice must be known"),
        (unregistered, "measured.*has no implementation"),
    ],
)
def test_what_has_no_counterpart_is_named(function: Callable[..., Any], rule: str) -> None:
    """The error names the kernel and its line."""
    with pytest.raises(TranslationError, match=rf"{function.__name__}: .*{rule}|{rule}"):
        source_of(function, new_design(), new_state())


def test_symbols_become_words() -> None:
    """Comments are in ASCII."""
    assert ascii_text("Φ z + Γ_u u ≤ 2⁻⁴⁰, x̂_1, β̄ → √λ") == (
        "Phi z + Gamma_u u <= 2^-40, x_hat_1, beta_bar -> sqrt lamda"
    )


def test_names_of_functions_are_none_that_c_reserves() -> None:
    """A name with an underscore at its start is reserved at file scope, and keywords are taken."""
    assert function_name("_advance") == "advance"
    assert function_name("__advance") == "advance"
    assert function_name("_while") == "while_"


def test_whole_numbers_are_integers_as_far_as_every_int_of_c_holds_them() -> None:
    """``int`` may have 16 bits; 0 and 1 may be truth values."""
    kinds = [whole_kind(value).name for value in (0.0, 1.0, 2.0, 32767.0, -32767.0)]
    assert kinds == ["BOOL", "BOOL", "INT", "INT", "INT"]
    assert {whole_kind(value).name for value in (0.5, 32768.0, -32768.0)} == {"REAL"}
