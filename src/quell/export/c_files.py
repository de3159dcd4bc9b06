"""C files around translated kernels: the pair of files, those of a plant, operations beside a step.

A pair of C files around translated kernels: structs, public functions, default parameters.

Operations of the exported controller besides a step, as kernels that are translated to C.

Each is the method of the same name of a controller in Python. Where that raises an error for a
value that is no number, the exported function ignores the value, and the status says so.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.base import control, is_usable, reset_loop, set_applied_control
from quell.controllers.baselines.adaptive_notch import NotchDesign, NotchState
from quell.controllers.bumpless import start_at_rest
from quell.controllers.compensated import CompensatedDesign, CompensatedState
from quell.controllers.law import AdrcDesign, AdrcState, has_reference_at_start
from quell.controllers.linear import LinearDesign, LinearState
from quell.controllers.memory import Layout
from quell.controllers.prefilters import PrefilteredDesign, PrefilteredState, settle, stopping_point
from quell.export.image_code import ImageCode
from quell.export.translate.expressions import implementation_of
from quell.export.translate.program import Program
from quell.export.translate.structs import Findings, arrays_of, initial_lines
from quell.export.translate.text import (
    Array,
    Number,
    Struct,
    TranslationError,
    Value,
    checked_name,
    comment_block,
    words,
    wrapped,
)
from quell.kernels.dispatch import generic, generic_with_default
from quell.plants.base import Plant, advance, check_one_input, check_plant, measure
from quell.plants.fmu import FMU
from quell.types import Status, Vector

# ---- A pair of C files around translated kernels ----

# Compilers for small processors have a double of four bytes.
_DOUBLE = [
    "#if DBL_MANT_DIG < 53",
    '#error "double has less than 53 bits here: export in single precision"',
    "#endif",
]


# C++ and Microsoft's C know the word with underscores.
_RESTRICT = [
    "#if defined(__cplusplus) || defined(_MSC_VER)",
    "#define restrict __restrict",
    "#endif",
]


# GCC turns loops of few passes into vectors, which wait for numbers that have just been stored one
# by one, and it wants more registers than there are: at -O3 a step with ``Kalman`` of order 4 took
# 1.2 times as long. Loops of 15 passes and more gain from vectors.
_MOST_PASSES = 8
_WITHOUT_VECTORS = [
    "/* Vectors of so few numbers wait for those that have just been stored one by one. */",
    "#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)",
    '#pragma GCC optimize("no-tree-vectorize", "no-gcse")',
    "#endif",
    "",
]


# What whoever passes the code on keeps with it; the folder has the text of the licence.
_LICENCE = """

SPDX-License-Identifier: Apache-2.0. Copyright the quell developers, for the parts that are quell's.
Licensed under the Apache License, Version 2.0, http://www.apache.org/licenses/LICENSE-2.0, and
distributed on an "AS IS" basis, without warranties or conditions of any kind."""


# Stand for the lines of ``init``, ``save`` and ``load``, which are known when all others are.
_INITIAL, _SAVE, _LOAD = "    initial", "    save", "    load"


@dataclass(frozen=True)
class CSource:
    """The text of the two files.

    Attributes
    ----------
    name
        begins all public names, and the names of the files.
    header, source
        the text of ``name.h`` and ``name.c``.
    precision
        ``"double"`` or ``"single"``.
    channels
        names and widths of the estimate; none for a plant.
    operations
        names of the functions, without the prefix.
    derivatives
        number of derivatives of the reference that ``step`` takes as its last arguments.
    externals
        names of functions in C that the user has to link.
    signals
        number of signals of a schedule, which ``step`` takes behind the derivatives.
    axes
        names of several axes in C.
    sizes
        numbers of r, y and u where they are arrays, and ``derivatives``, too; None for one of each.
    given
        what ``step`` takes before y: ``"r"``, or ``"u_0"``, control signals of other controllers.
    """

    name: str
    header: str = field(repr=False)
    source: str = field(repr=False)
    precision: str
    channels: tuple[tuple[str, int], ...]
    operations: tuple[str, ...]
    derivatives: int = 0
    externals: tuple[str, ...] = ()
    signals: int = 0
    axes: tuple[str, ...] = ()
    sizes: tuple[int, int, int] | None = None
    given: str = "r"

    @property
    def further(self) -> tuple[str, ...]:
        """Names of the last arguments of ``step``, behind r and y."""
        derivatives = (f"r{i + 1}" for i in range(self.derivatives))
        return (*derivatives, *(f"signal_{i + 1}" for i in range(self.signals)))

    @property
    def real(self) -> str:
        """The C type of real numbers."""
        return "float" if self.precision == "single" else "double"


class CFiles:
    """Writer of the files for parameters and a state, with the findings of earlier translations."""

    def __init__(self, name: str, parameters: Any, state: Any, findings: Findings) -> None:
        self.name, self.parameters, self.state = checked_name(name), parameters, state
        precisions = {array.dtype for array in arrays_of(state) if array.dtype.kind == "f"}
        self.single = np.dtype(np.float32) in precisions
        self.program = Program(name, self.single, findings)
        self.real = self.program.literals.real
        structs = self.program.structs
        design = structs.rename(_struct(structs.of(parameters)), f"{name}_parameters")
        memory = structs.rename(_struct(structs.of(state)), f"{name}_state")
        self.design = Value(design, "state->parameters", root="parameters")
        self.memory = Value(memory, "state", root="state", mutable=True)
        self.operations: list[str] = []
        self.structs: list[str] = []  # further lines of the header, after the structs
        self.members: list[str] = []  # of the state, besides those of the kernels
        self.enums: list[str] = []  # the same, before the structs
        self.includes = ["#include <stdbool.h>"]  # of the header
        self._prototypes: list[str] = []
        self._definitions: list[str] = []
        self._step = ""  # code of the operation of each sample
        self._images: Layout | None = None

    @property
    def both(self) -> tuple[Value, Value]:
        """The first arguments of most kernels."""
        return self.design, self.memory

    def number(self, code: str) -> Value:
        """Return a real number as an argument of a kernel."""
        return Value(Number.REAL, code)

    def call(self, kernel: Any, *arguments: Value) -> str:
        """Return the code of a call of a kernel, or of the implementation for its arguments."""
        function = kernel
        if hasattr(kernel, "implementations"):
            function = implementation_of(kernel, arguments[0])
        body = self.program.entry_expressions()
        found = self.program.function(function, list(arguments), kernel)
        value = found.call(body, list(arguments))
        return value.code or "".join(body.pending)

    def add(self, name: str, head: str, doc: str, *body: str) -> None:
        """Add a public function; ``NAME`` in its head becomes its name."""
        self.operations.append(name)
        head = head.replace("NAME", f"{self.name}_{name}")
        given = re.findall(r"(\w+)(?:\[\d+\])?[,)]", head)
        used = words("\n".join(body)) | ({"state"} if _INITIAL in body else set())
        used |= {"state", "image"} if _SAVE in body or _LOAD in body else set()
        body = (*(f"    (void){each};" for each in given if each not in used), *body)
        self._prototypes += ["", *comment_block(doc), *wrapped(f"{head};")]
        self._definitions += ["", *wrapped(head), "{", *body, "}"]
        if name == "step":
            self._step = "\n".join(body)

    def add_init(self) -> None:
        """Add the function that sets the state before the first sample."""
        self.add(
            "init",
            f"void NAME({self.name}_state *state)",
            "Set the state before the first sample, with the default parameters.",
            _INITIAL,
        )

    def add_memory(self, images: Layout, reset: str) -> None:
        """Add the functions of the memory image; ``reset`` is the code that starts from rest."""
        self._images = images
        size = f"{self.name.upper()}_MEMORY_SIZE"
        self.includes.append("#include <stddef.h>")
        self.add(
            "save",
            f"void NAME(const {self.name}_state *state, unsigned char *image)",
            f"Write the whole state, with what was learned, as {size} bytes.\n\n"
            "The bytes are those of controller.memory() in quell. To save while a timer interrupt\n"
            "steps the controller, copy the state with the interrupt masked, and save the copy.",
            "    uint64_t check;",
            "",
            _SAVE,
        )
        self.add(
            "load",
            f"bool NAME({self.name}_state *state, const unsigned char *image, size_t length, "
            "bool resume)",
            "Take over what is in an image; return false, with nothing changed, if it does not\n"
            "fit: if it is cut, damaged, of another controller, or has numbers that are not finite."
            "\n\nWith resume the running loop continues at its next sample; that needs all\n"
            "parameters of the controller that was saved, but for the limits. Without it the loop\n"
            "starts from rest with what was learned, as after the power was off. The state must\n"
            f"have been set by {self.name}_init before.",
            "    if (!memory_fits(image, length, resume)) {",
            "        return false;",
            "    }",
            _LOAD,
            "    if (!resume) {",
            f"        {reset};",
            "    }",
            "    return true;",
        )

    def write(
        self,
        title: list[str],
        channels: tuple[tuple[str, int], ...],
        defines: list[str],
        derivatives: int = 0,
        signals: int = 0,
    ) -> CSource:
        """Return the files."""
        source = self._source()
        header = self._header(title, defines)
        precision = "single" if self.single else "double"
        operations, externals = tuple(self.operations), tuple(self.program.externals)
        return CSource(
            *(self.name, header, source, precision, channels, operations),
            *(derivatives, externals, signals),
        )

    def _header(self, title: list[str], defines: list[str]) -> str:
        name, upper, structs = self.name, self.name.upper(), self.program.structs
        lines = [
            *comment_block("\n".join(title) + _LICENCE),
            f"#ifndef {upper}_H",
            f"#define {upper}_H",
            "",
            *self.includes,
            "",
            "#ifdef __cplusplus",
            'extern "C" {',
            "#endif",
            "",
            *defines,
            "",
            f"typedef {self.real} {name}_real;",
            *self.enums,
        ]
        for layout in list(structs.layouts.values()):
            first = ""
            if layout.struct == self.memory.kind:
                first = "\n    ".join([f"const {name}_parameters *parameters;", *self.members])
            elif layout.struct == self.design.kind and not layout.members:
                first = "bool unused; /* there are no parameters */"
            if layout.members or first:
                lines += ["", *(line for each in structs.definition(layout.struct, first)
                                for line in wrapped(each))]  # fmt: skip
        lines += [*self.structs, ""]
        lines += [f"extern const {name}_parameters {name}_default_parameters;"]
        lines += [*self._prototypes, "", "#ifdef __cplusplus", "}", "#endif", "", "#endif", ""]
        return "\n".join(lines)

    def _source(self) -> str:
        structs, name = self.program.structs, self.name
        kernels = self.program.kernel_lines("\n".join(self._definitions), self._step)
        structs.keep_used("\n".join([*kernels, *self._definitions]))
        tables: list[str] = []
        image = self._write_image_code()
        place = self._definitions.index(_INITIAL)
        self._definitions[place : place + 1] = [
            "    (void)memset(state, 0, sizeof *state);",
            f"    state->parameters = &{name}_default_parameters;",
            *initial_lines(structs, self.memory, self.state, tables),
        ]
        arrays = arrays_of((self.parameters, self.state))
        has_long_loops = any(max(array.shape, default=0) > _MOST_PASSES for array in arrays)
        values = structs.initialiser(self.design.kind, self.parameters, 0)
        values = ["{ false }"] if len(values) == 2 else values
        lines = [
            f'#include "{name}.h"',
            "",
            "#include <float.h>",
            "#include <math.h>",
            *(["#include <stdint.h>"] if self._images else []),
            "#include <string.h>",
            "",
            "#ifdef __FAST_MATH__",
            '#error "-ffast-math removes the tests for NaN and the compensated sums"',
            "#endif",
            *([] if self.single else _DOUBLE),
            "",
            *([] if has_long_loops else _WITHOUT_VECTORS),
            *_RESTRICT,
            *kernels,
            "",
            f"const {name}_parameters {name}_default_parameters =",
            *(line for each in values for line in wrapped(each)),
        ]
        lines[-1] += ";"
        for table in tables:
            lines += ["", *wrapped(table)]
        return "\n".join([*lines, *image, *self._definitions, ""])

    def _write_image_code(self) -> list[str]:
        """Write the lines of ``save`` and ``load``; return the functions behind them."""
        if self._images is None:
            return []
        has_origin = any("origin;" in member for member in self.members)
        structs = self.program.structs
        code = ImageCode(self._images, self.state, structs, self.memory, has_origin)
        for mark, lines in ((_SAVE, code.save_lines()), (_LOAD, code.load_lines())):
            place = self._definitions.index(mark)
            self._definitions[place : place + 1] = lines
        return code.functions()


def _struct(kind: Any) -> Struct:
    if not isinstance(kind, Struct):
        raise TypeError
    return kind


def check_parts(controller: Any) -> None:
    """Raise a ``TranslationError`` if a part of a controller calls Python."""
    parts = [(type(controller).__name__, controller.parameters)]
    while parts:
        name, value = parts.pop()
        if type(value).__module__.startswith("quell.learners.python_model"):
            raise TranslationError(
                f"{name} = {type(value).__name__}: this learner calls Python at each sample, which "
                "C can not; use Kalman, RLS, NLMS, MLP or GaussianProcess, or a model whose "
                "functions Numba compiles (docs/extend)"
            )
        if isinstance(value, tuple):
            parts += zip(getattr(value, "_fields", [name] * len(value)), value, strict=True)


def translated(write: Callable[[Findings], CSource]) -> CSource:
    """Return the files that ``write`` makes, when it finds nothing more that is not constant."""
    findings = Findings()
    while True:
        findings.is_new = False
        source = write(findings)
        if not findings.is_new:
            return source


# ---- The two C files of a plant ----


class PlantState(NamedTuple):
    """State of a plant of n states."""

    x: Vector  # state of the plant (n,)
    scratch: Vector  # work space (6 n,)


def plant_source(plant: Plant, dt: float, name: str = "plant", x0: Any = None) -> CSource:
    """Return the C code of a plant, translated from the kernels that simulate it.

    The functions are ``name_init``, ``name_measure``, which returns y, and ``name_advance``, which
    takes the plant through a sample under a held u and held disturbances.

    Parameters
    ----------
    plant
        any plant whose kernels are compiled.
    dt
        sample time [s].
    name
        begins all public names.
    x0
        initial state (n,); zero by default.

    Raises
    ------
    ValueError
        for what is no plant, an x0 of another length, and a name that C can not have.
    TranslationError
        naming what has no counterpart in C.
    """
    check_plant(plant)
    check_one_input(plant, "NOT exported to C yet")
    inner: Any = plant
    while hasattr(inner, "plant"):
        inner = inner.plant
    if isinstance(inner, FMU) or not plant.compiled:
        called = "an FMU" if isinstance(inner, FMU) else "Python"
        raise TranslationError(f"{plant.name}: it calls {called} at each sample, which C can not")
    parameters = plant.sampled(dt)
    x = np.zeros(plant.order) if x0 is None else checks.vector("x0", x0, plant.order)

    def write(findings: Findings) -> CSource:
        state = PlantState(x, np.zeros(6 * plant.order))
        files = CFiles(name, parameters, state, findings)
        _add_functions(files, plant)
        title = [
            f"Plant {name}: {plant.name}, one sample every {dt!r} s.",
            "",
            f"Call {name}_init once, then {name}_measure and {name}_advance for each sample.",
            "Generated by quell from the kernels that simulate it.",
        ]
        defines = [
            f"#define {name.upper()}_SAMPLE_TIME {dt!r} /* [s] */",
            f"#define {name.upper()}_ORDER {plant.order}",
            f"#define {name.upper()}_DISTURBANCES {plant.disturbances}",
        ]
        return files.write(title, (), defines)

    return translated(write)


def _add_functions(files: CFiles, plant: Plant) -> None:
    name, real, structs = files.name, files.real, files.program.structs
    x, scratch = structs.field(files.memory, "x"), structs.field(files.memory, "scratch")
    if x is None or scratch is None:
        raise AssertionError
    files.add_init()
    files.add(
        "measure",
        f"{real} NAME(const {name}_state *state)",
        "Return the output y.",
        f"    return {files.call(measure, files.design, x)};",
    )
    w = Value(Array((plant.disturbances,), Number.REAL), "w", root="w")
    inputs = f", const {real} w[{plant.disturbances}]" if plant.disturbances else ""
    call = files.call(advance, files.design, x, scratch, files.number("t"), files.number("u"), w)
    files.add(
        "advance",
        f"void NAME({name}_state *state, {real} t, {real} u{inputs})",
        "Take the state through a sample that begins at the time t [s], with held u and w.",
        f"    {call};",
    )


# ---- Operations of the exported controller besides a step ----

_CONTROL_HELD = int(Status.CONTROL_HELD)
_REFERENCE_HELD = int(Status.REFERENCE_HELD)


@generic
def add_flag(design: Any, state: Any, flag: int) -> None:
    """Add a flag to the status of the last sample."""
    raise TypeError


@add_flag.register(AdrcDesign)
def _add_flag(design: AdrcDesign, state: AdrcState, flag: int) -> None:
    state.loop[0].status = int(state.loop[0].status) | flag


@add_flag.register(LinearDesign)
def _add_flag_to_linear(design: LinearDesign, state: LinearState, flag: int) -> None:
    state.loop[0].status = int(state.loop[0].status) | flag


@add_flag.register(NotchDesign)
def _add_flag_to_notch(design: NotchDesign, state: NotchState, flag: int) -> None:
    state.loop[0].status = int(state.loop[0].status) | flag


@add_flag.register(PrefilteredDesign)
def _add_flag_inside(design: PrefilteredDesign, state: PrefilteredState, flag: int) -> None:
    add_flag(design.controller, state.controller, flag)


@add_flag.register(CompensatedDesign)
def _add_flag_to_compensator(design: CompensatedDesign, state: CompensatedState, flag: int) -> None:
    add_flag(design.compensator, state.compensator, flag)


def set_applied(design: Any, state: Any, u: float) -> None:
    """Set the control signal that was really applied; what is no number is ignored."""
    if is_usable(u):
        set_applied_control(design, state, u)
    else:
        add_flag(design, state, _CONTROL_HELD)


def start_from(design: Any, state: Any, samples: int, y: float, u: float, r: float) -> None:
    """Start at a plant that rests at y under u; nothing happens where one of them is no number.

    An r that is no number is y.
    """
    if not (is_usable(y) and is_usable(u)):
        add_flag(design, state, _CONTROL_HELD)
    elif is_usable(r):
        start(design, state, samples, y, u, r)
    else:
        start(design, state, samples, y, u, usual_reference(design, y, u))
        add_flag(design, state, _REFERENCE_HELD)


@generic_with_default
def usual_reference(design: Any, y: float, u: float) -> float:
    """Return the reference of a controller that rests at y under u; u_0 of a compensator."""
    return y


@usual_reference.register(AdrcDesign)
def _usual_reference(design: AdrcDesign, y: float, u: float) -> float:
    return u if has_reference_at_start(design.feedforward) != 0.0 else y


@generic
def start(design: Any, state: Any, samples: int, y: float, u: float, r: float) -> None:
    """Start at a plant that rests at y under u: the next step continues from u.

    r is the reference of the next step. What was learned is kept. The observer takes as many
    samples as it needs to settle: do not call this in an interrupt.
    """
    raise TypeError


@start.register(AdrcDesign)
def _start_adrc(
    design: AdrcDesign, state: AdrcState, samples: int, y: float, u: float, r: float
) -> None:
    start_at_rest(design, state, samples, y, u, r)


@start.register(PrefilteredDesign)
def _start_prefiltered(
    design: PrefilteredDesign, state: PrefilteredState, samples: int, y: float, u: float, r: float
) -> None:
    start(design.controller, state.controller, samples, y, u, r)
    settle(design.prefilter, state.prefilter, y)
    loop = state.loop[0]
    loop.started = loop.has_reference = 1.0
    loop.r = r


@start.register(CompensatedDesign)
def _start_compensated(
    design: CompensatedDesign, state: CompensatedState, samples: int, y: float, u: float, r: float
) -> None:
    reset_loop(design.controller, state.controller)
    start(design.compensator, state.compensator, samples, y, u, 0.0)


@generic
def set_manual(design: Any, state: Any, manual: bool, u: float) -> None:
    """Begin manual operation, or end it. A u that is no number is the one before."""
    raise TypeError


@set_manual.register(AdrcDesign)
def _set_manual(design: AdrcDesign, state: AdrcState, manual: bool, u: float) -> None:
    loop = state.loop[0]
    loop.manual = 1.0 if manual else 0.0
    loop.u_manual = u if is_usable(u) else loop.u


@set_manual.register(PrefilteredDesign)
def _set_manual_inside(
    design: PrefilteredDesign, state: PrefilteredState, manual: bool, u: float
) -> None:
    set_manual(design.controller, state.controller, manual, u)


@set_manual.register(CompensatedDesign)
def _set_manual_of_both(
    design: CompensatedDesign, state: CompensatedState, manual: bool, u: float
) -> None:
    set_manual(design.compensator, state.compensator, manual, u)


@generic
def control_of_law(design: Any, state: Any) -> float:
    """Return the control signal that the law would have applied in the last sample."""
    raise TypeError


@control_of_law.register(AdrcDesign)
def _control_of_law(design: AdrcDesign, state: AdrcState) -> float:
    return state.loop[0].u_limited


@control_of_law.register(PrefilteredDesign)
def _control_of_inner_law(design: PrefilteredDesign, state: PrefilteredState) -> float:
    return control_of_law(design.controller, state.controller)


@control_of_law.register(CompensatedDesign)
def _control_of_both(design: CompensatedDesign, state: CompensatedState) -> float:
    return control_of_law(design.compensator, state.compensator)


def track(design: Any, state: Any, r: float, y: float, u: float) -> float:
    """Take one sample in manual operation: u is applied, unlimited, until the next sample.

    Return the control signal that the controller would have applied. A u that is no number is the
    one before.
    """
    set_manual(design, state, True, u)
    control(design, state, r, y)
    set_manual(design, state, False, u)
    if not is_usable(u):
        add_flag(design, state, _CONTROL_HELD)
    return control_of_law(design, state)


@generic
def hand_over(design: Any, state: Any) -> bool:
    """End manual operation: the next step continues from the u of the last one.

    Return false before the first sample: then nothing has changed.
    """
    raise TypeError


@hand_over.register(AdrcDesign)
def _hand_over(design: AdrcDesign, state: AdrcState) -> bool:
    loop = state.loop[0]
    if loop.started == 0.0:
        return False
    loop.bumpless = 1.0
    return True


@hand_over.register(PrefilteredDesign)
def _hand_over_inside(design: PrefilteredDesign, state: PrefilteredState) -> bool:
    return hand_over(design.controller, state.controller)


@hand_over.register(CompensatedDesign)
def _hand_over_both(design: CompensatedDesign, state: CompensatedState) -> bool:
    return hand_over(design.compensator, state.compensator)


@generic
def move_origin(design: Any, state: Any, distance: float) -> None:
    """Count y and r from a point that is ``distance`` further on."""
    raise TypeError


@move_origin.register(AdrcDesign)
def _move_origin(design: AdrcDesign, state: AdrcState, distance: float) -> None:
    loop = state.loop[0]
    state.z[0] -= distance
    state.estimates[0] -= distance
    loop.y -= distance
    loop.r -= distance


def stop_of_move(design: PrefilteredDesign, state: PrefilteredState) -> float:
    """Return where the reference comes to rest soonest: as r of a step it stops there."""
    return stopping_point(design.prefilter, state.prefilter)
