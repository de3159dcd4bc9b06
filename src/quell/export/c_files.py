"""A pair of C files around translated kernels: structs, public functions, default parameters."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from quell.export.translate.blocks import words
from quell.export.translate.calls import implementation_of
from quell.export.translate.findings import Findings
from quell.export.translate.initial import initial_lines
from quell.export.translate.layout import comment_block, wrapped
from quell.export.translate.naming import checked_name
from quell.export.translate.program import Program
from quell.export.translate.structs import arrays_of
from quell.export.translate.values import Number, Struct, Value

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


# Stands for the lines of ``init``, which are known when all others are.
_INITIAL = "    initial"


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
    """

    name: str
    header: str
    source: str
    precision: str
    channels: tuple[tuple[str, int], ...]
    operations: tuple[str, ...]
    derivatives: int = 0
    externals: tuple[str, ...] = ()

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

    def write(
        self,
        title: list[str],
        channels: tuple[tuple[str, int], ...],
        defines: list[str],
        derivatives: int = 0,
    ) -> CSource:
        """Return the files."""
        source = self._source()
        header = self._header(title, defines)
        precision = "single" if self.single else "double"
        operations, externals = tuple(self.operations), tuple(self.program.externals)
        return CSource(
            self.name, header, source, precision, channels, operations, derivatives, externals
        )

    def _header(self, title: list[str], defines: list[str]) -> str:
        name, upper, structs = self.name, self.name.upper(), self.program.structs
        lines = [
            *comment_block("\n".join(title)),
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
        return "\n".join([*lines, *self._definitions, ""])


def _struct(kind: Any) -> Struct:
    if not isinstance(kind, Struct):
        raise TypeError
    return kind


def translated(write: Callable[[Findings], CSource]) -> CSource:
    """Return the files that ``write`` makes, when it finds nothing more that is not constant."""
    findings = Findings()
    while True:
        findings.is_new = False
        source = write(findings)
        if not findings.is_new:
            return source
