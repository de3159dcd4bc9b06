"""The two C files of a controller: the translated kernels and the functions around them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from quell.controllers.adrc.adrc import ADRC
from quell.controllers.adrc.handover import samples_to_settle
from quell.controllers.base import (
    control,
    reset_loop,
    set_applied_control,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.prefilters.prefilter import Prefiltered, without_prefilters
from quell.controllers.single.single import SinglePrecision
from quell.export import operations
from quell.export.translate.initial import initial_lines
from quell.export.translate.layout import comment_block, wrapped
from quell.export.translate.program import Program
from quell.export.translate.structs import arrays_of
from quell.export.translate.values import Array, Number, Struct, TranslationError, Value
from quell.guard import Reason
from quell.types import Status

# Channels that hold integers.
_WHOLE = ("status", "reason")


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
        names and widths of the estimate.
    operations
        names of the functions, without the prefix.
    """

    name: str
    header: str
    source: str
    precision: str
    channels: tuple[tuple[str, int], ...]
    operations: tuple[str, ...]

    @property
    def real(self) -> str:
        """The C type of real numbers."""
        return "float" if self.precision == "single" else "double"


class ControllerSource:
    """Writer of the files of one controller; see ``c_source``."""

    def __init__(self, controller: Any, name: str, varying: set[tuple[str, str]]) -> None:
        self.controller, self.name = controller, name
        self.parameters, self.state = controller.parameters, controller.initial_state()
        self.described = controller  # the controller in double precision
        if isinstance(controller, SinglePrecision):
            self.described = controller.controller
            self.parameters = self.parameters.controller
        precisions = {array.dtype for array in arrays_of(self.state) if array.dtype.kind == "f"}
        self.single = np.dtype(np.float32) in precisions
        self.program = Program(name, self.single, varying)
        self.real = self.program.literals.real
        structs = self.program.structs
        design = structs.rename(_struct(structs.of(self.parameters)), f"{name}_parameters")
        state = structs.rename(_struct(structs.of(self.state)), f"{name}_state")
        self.design = Value(design, "state->parameters", root="parameters")
        self.memory = Value(state, "state", root="state", mutable=True)
        self.prototypes: list[str] = []
        self.definitions: list[str] = []
        self.operations: list[str] = []

    def _real(self, code: str) -> Value:
        return Value(Number.REAL, code)

    def _translated(self, kernel: Any, *arguments: Value) -> str:
        """Return the code of a call of a kernel with these arguments."""
        head: Any = arguments[0].kind
        table = getattr(kernel, "implementations", None)
        function: Callable[..., Any] = kernel
        if table is not None:
            function = table.get(head.python) or table[object]
        body = self.program.entry_expressions()
        found = self.program.function(function, list(arguments), kernel.__name__)
        value = found.call(body, list(arguments))
        self.roots.update(body.pending)
        return value.code or "".join(body.pending)

    roots: set[str]

    def _add(self, name: str, head: str, doc: str, *body: str) -> None:
        """Add a public function."""
        self.operations.append(name)
        head = head.replace("NAME", f"{self.name}_{name}")
        self.prototypes += ["", *comment_block(doc), *wrapped(f"{head};")]
        self.definitions += ["", *wrapped(head), "{", *body, "}"]

    def write(self) -> CSource:
        """Return the files."""
        self.roots = set()
        real, name, inner = self.real, self.name, without_prefilters(self.described)
        state, both = f"{name}_state *state", (self.design, self.memory)
        r, y, u = self._real("r"), self._real("y"), self._real("u")
        tables: list[str] = []
        initial = initial_lines(self.program.structs, self.memory, self.state, tables)
        self._add("init", f"void NAME({state})",
                  "Set the state before the first sample, with the default parameters.",
                  "    memset(state, 0, sizeof *state);",
                  f"    state->parameters = &{name}_default_parameters;",
                  *initial)  # fmt: skip
        self._add("step", f"{real} NAME({state}, {real} r, {real} y)",
                  "Take one sample: return the control signal u for reference r and measurement y."
                  "\n\nA value that is not finite is replaced; the status says so. The controller "
                  "assumes that u is\napplied until the next sample.",
                  f"    return {self._translated(control, *both, r, y)};")  # fmt: skip
        self._add("applied", f"void NAME({state}, {real} u)",
                  "Set the control signal that was really applied since the last step.",
                  f"    {self._translated(set_applied_control, *both, u)};")  # fmt: skip
        self._derivatives(both, state)
        if isinstance(inner, ADRC):
            self._hand_over(both, state, inner, (r, y, u))
        self._retuning(state)
        self._add("reset", f"void NAME({state})",
                  "Start from rest at the next sample; what was learned is kept.",
                  f"    {self._translated(reset_loop, *both)};")  # fmt: skip
        constant_state = f"const {name}_state *state"
        self._add("status", f"int NAME({constant_state})",
                  f"Return the flags of the last sample, see enum {name}_flag.",
                  f"    return {self._translated(status_flags, *both)};")  # fmt: skip
        channels = self._estimate(both)
        source = self._source(tables)
        return CSource(
            name,
            self._header(channels),
            source,
            "single" if self.single else "double",
            channels,
            tuple(self.operations),
        )

    def _derivatives(self, both: tuple[Value, Value], state: str) -> None:
        count = int(getattr(self.controller, "derivatives", 0))
        if count == 0 or isinstance(self.described, Prefiltered):
            return
        given = Value(Array((count,), Number.REAL), "derivatives", root="derivatives")
        self._add("set_derivatives", f"void NAME({state}, const {self.real} derivatives[{count}])",
                  "Set r', r'', ... for the next step; what is not finite counts as zero.",
                  f"    {self._translated(set_reference_derivatives, *both, given)};")  # fmt: skip

    def _hand_over(
        self, both: tuple[Value, Value], state: str, inner: Any, signals: tuple[Value, ...]
    ) -> None:
        r, y, u = signals
        real, samples = self.real, samples_to_settle(inner.observer)
        count = Value(Number.INT, str(samples))
        call = self._translated(operations.start, *both, count, y, u, r)
        self._add("start", f"void NAME({state}, {real} y, {real} u, {real} r)",
                  "Start at a plant that rests at y under u: the next step continues from u."
                  "\n\nr is the reference of the next step. What was learned is kept. The observer "
                  f"takes {2 * samples}\nsamples to settle: do not call this in an interrupt.",
                  f"    {call};")  # fmt: skip
        call = self._translated(operations.track, *both, r, y, u)
        self._add("track", f"{real} NAME({state}, {real} r, {real} y, {real} u)",
                  "Take one sample in manual operation: u is applied, unlimited, until the next "
                  "sample.\n\nReturn the control signal that the controller would have applied.",
                  f"    return {call};")  # fmt: skip
        call = self._translated(operations.hand_over, *both)
        self._add("hand_over", f"bool NAME({state})",
                  "End manual operation: the next step continues from the u of the last one."
                  "\n\nReturn false before the first sample: then nothing has changed.",
                  f"    return {call};")  # fmt: skip

    def _retuning(self, state: str) -> None:
        new = Value(self.design.kind, "parameters", root="new")
        call = self._translated(operations.retune, self.design, new, self.memory)
        lines = [f"    {call};"] if call else []
        self._add("retune", f"void NAME({state}, const {self.name}_parameters *parameters)",
                  "Continue with other parameters of the same structure, without a jump of u."
                  "\n\nThey must stay in memory. To change a limit, copy the default parameters.",
                  *lines, "    state->parameters = parameters;")  # fmt: skip

    def _estimate(self, both: tuple[Value, Value]) -> tuple[tuple[str, int], ...]:
        channels = tuple((name, width) for name, width in self.controller.channels if width)
        total, name, real = sum(width for _, width in channels), self.name, self.real
        row = Value(Array((total,), Number.REAL), "row", root="row", mutable=True)
        call = self._translated(write_row, *both, row)
        lines, at = [f"    {real} row[{total}];", f"    {name}_estimate estimate;"], 0
        lines.append(f"    {call};")
        for channel, width in channels:
            for i in range(width):
                place = f"[{i}]" if width > 1 else ""
                cast = "(int)" if channel in _WHOLE else ""
                lines.append(f"    estimate.{channel}{place} = {cast}row[{at}];")
                at += 1
        if {"f_residual", "f_learned"} <= {channel for channel, _ in channels}:
            lines.append("    estimate.f = estimate.f_residual + estimate.f_learned;")
        self._add("get_estimate",
                  f"{name}_estimate NAME(const {name}_state *state)",
                  "Return what the controller knows after the last sample.",
                  *lines, "    return estimate;")  # fmt: skip
        return channels

    def _estimate_struct(self, channels: tuple[tuple[str, int], ...]) -> list[str]:
        docs = {
            "x_hat": "y and its derivatives",
            "f_residual": "the observer's share of f",
            "f_learned": "the learner's share of f",
            "status": "flags of the last sample",
            "authority": "share of its output that the guard allows the learner",
            "error_plain": "RMS error in f of an ESO without learner",
            "error_learned": "the same for the learner with full authority",
            "reason": "for the authority",
            "theta": "the learner's coefficients",
            "r_shaped": "reference behind the prefilter",
            "u_unlimited": "control signal before limits",
        }
        lines = ["", "/* What a controller knows after a sample. */", "typedef struct {"]
        for channel, width in channels:
            kind = "int" if channel in _WHOLE else self.real
            shape = f"[{width}]" if width > 1 else ""
            doc = f" /* {docs[channel]} */" if channel in docs else ""
            lines.append(f"    {kind} {channel}{shape};{doc}")
        if {"f_residual", "f_learned"} <= {channel for channel, _ in channels}:
            lines.append(f"    {self.real} f; /* total disturbance: f_residual + f_learned */")
        return [*lines, f"}} {self.name}_estimate;"]

    def _header(self, channels: tuple[tuple[str, int], ...]) -> str:
        name, upper = self.name, self.name.upper()
        structs = self.program.structs
        dt = self.program.literals.write(float(self.controller.dt))
        flags = ", ".join(f"{upper}_{flag.name} = {int(flag)}" for flag in Status if flag.name)
        reasons = ", ".join(f"{upper}_{reason.name} = {int(reason)}" for reason in Reason)
        lines = [
            f"/* Controller {name}: {type(self.described).__name__}, in "
            f"{'single' if self.single else 'double'} precision, one sample every {dt} s.",
            " *",
            f" * Call {name}_init once, then {name}_step every {dt} s. Several controllers may be "
            "linked into one",
            " * program, and one controller may have several states. Generated by quell. */",
            f"#ifndef {upper}_H",
            f"#define {upper}_H",
            "",
            "#include <stdbool.h>",
            "",
            "#ifdef __cplusplus",
            'extern "C" {',
            "#endif",
            "",
            f"#define {upper}_SAMPLE_TIME {dt} /* [s] */",
            "",
            "/* Flags of a sample, combined by |. */",
            *wrapped(f"enum {name}_flag {{ {flags} }};"),
        ]
        if "reason" in dict(channels):
            lines += ["", "/* Reasons of the guard for the learner's authority. */",
                      *wrapped(f"enum {name}_reason {{ {reasons} }};")]  # fmt: skip
        for layout in list(structs.layouts.values()):
            if layout.members:
                first = ""
                if layout.struct == self.memory.kind:
                    first = f"const {name}_parameters *parameters;"
                lines += ["", *(line for each in structs.definition(layout.struct, first)
                                for line in wrapped(each))]  # fmt: skip
        lines += self._estimate_struct(channels)
        lines += ["", f"extern const {name}_parameters {name}_default_parameters;"]
        lines += [*self.prototypes, "", "#ifdef __cplusplus", "}", "#endif", "", "#endif", ""]
        return "\n".join(lines)

    def _source(self, tables: list[str]) -> str:
        structs, name = self.program.structs, self.name
        kernels = self.program.kernel_lines("\n".join(self.definitions))
        structs.keep_used("\n".join([*kernels, *self.definitions]))
        values = structs.initialiser(self.design.kind, self.parameters, 0)
        lines = [
            f'#include "{name}.h"',
            "",
            "#include <float.h>",
            "#include <math.h>",
            "#include <string.h>",
            *kernels,
            "",
            f"const {name}_parameters {name}_default_parameters =",
            *(line for each in values for line in wrapped(each)),
        ]
        lines[-1] += ";"
        for table in tables:
            lines += ["", *wrapped(table)]
        return "\n".join([*lines, *self.definitions, ""])


def _struct(kind: Any) -> Struct:
    if not isinstance(kind, Struct):
        raise TypeError
    return kind


def check_parts(controller: Any) -> None:
    """Raise a ``TranslationError`` if a part of a controller calls Python."""
    parts = [(type(controller).__name__, controller.parameters)]
    while parts:
        name, value = parts.pop()
        if type(value).__module__.startswith("quell.learners.adapters"):
            raise TranslationError(
                f"{name} = {type(value).__name__}: this learner calls Python at each sample, which "
                "C can not; use Kalman, RLS, NLMS, MLP or GaussianProcess, or a model whose "
                "functions Numba compiles (docs/extend)"
            )
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            parts += zip(value._fields, value, strict=True)


def c_source(controller: Any, name: str = "controller") -> CSource:
    """Return the C code of a controller, translated from the kernels that simulate it.

    Parameters
    ----------
    controller
        any controller whose kernels are compiled; its parameters and its state before the first
        sample are written. The state's arrays decide about ``float`` or ``double``.
    name
        begins all public names.

    Raises
    ------
    TranslationError
        naming a kernel, or a part of the parameters, that has no counterpart in C.
    """
    check_parts(controller)
    varying: set[tuple[str, str]] = set()
    while True:
        writer = ControllerSource(controller, name, varying)
        found = writer.write()
        if not writer.program.structs.found_varying:
            return found
