"""The two C files of several axes, and their operations besides a step as kernels.

As for one axis (``c_files.py``), an operation does what the method of this name does in Python;
where that raises an error for a value that is no number, the exported function ignores the value,
and the status says so. Arrays are those of the caller: the code keeps none of them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

from quell.controllers.allocation import CutEach, FunctionGain
from quell.controllers.axes import (
    Axes,
    AxesDesign,
    AxesState,
    AxisDesigns,
    AxisStates,
    NoAxis,
    apply_to_axes,
    begin_manual,
    end_manual,
    hand_over_all,
    start_all,
    tell_applied,
)
from quell.controllers.base import (
    change_parameters,
    is_usable,
    reset_loop,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.compensator import change_design, samples_to_settle
from quell.controllers.held import rests_at_y
from quell.controllers.memory import images_of, learned_state
from quell.controllers.several import control_all
from quell.controllers.single import single_design, single_state
from quell.export.c_files import CFiles, CSource, check_parts, translated
from quell.export.estimates import enums, estimate_lines, estimate_struct
from quell.export.translate.structs import Findings, ascii_text
from quell.export.translate.text import (
    Array,
    Number,
    TranslationError,
    Value,
    checked_name,
    identifier,
    unique,
    wrapped,
)
from quell.kernels.dispatch import generic
from quell.types import Channels, Status, Vector

# ---- Operations besides a step ----

_CONTROL_HELD = int(Status.CONTROL_HELD)
_REFERENCE_HELD = int(Status.REFERENCE_HELD)


def add_flag_of_axes(design: AxesDesign, state: AxesState, flag: int) -> None:
    """Add a flag to the status of the last sample."""
    state.loop[0].status = int(state.loop[0].status) | flag


def set_applied_controls(design: AxesDesign, state: AxesState, u: Vector) -> None:
    """Set the control signals that were really applied; those that are no numbers are ignored."""
    for k in range(u.size):
        if is_usable(u[k]):
            state.u[k] = u[k]
        else:
            add_flag_of_axes(design, state, _CONTROL_HELD)
    tell_applied(design, state)


def start_axes_from(
    design: AxesDesign, state: AxesState, samples: Any, y: Vector, u: Vector, r: Vector
) -> None:
    """Start at a machine that rests at y under u; nothing happens where one is no number.

    An r that is no number is y.
    """
    usable = True
    for i in range(y.size):
        usable = usable and is_usable(y[i])
    for k in range(u.size):
        usable = usable and is_usable(u[k])
    if not usable:
        add_flag_of_axes(design, state, _CONTROL_HELD)
        return
    start_all(design, state, samples, y, u, r)
    for i in range(r.size):
        if not is_usable(r[i]):
            add_flag_of_axes(design, state, _REFERENCE_HELD)


def track_axes(
    design: AxesDesign, state: AxesState, r: Vector, y: Vector, u: Vector, unused: Vector
) -> None:
    """Take one sample in manual operation: u is applied, unlimited, until the next sample.

    One that is no number is the one before.
    """
    missing = 0
    for k in range(u.size):
        if is_usable(u[k]):
            state.u[k] = u[k]
        else:
            missing = _CONTROL_HELD
    apply_to_axes(state.gain, state.u, state.v)
    begin_manual(design, state)
    control_all(design, state, r, y, unused)
    end_manual(design, state)
    tell_applied(design, state)
    state.loop[0].started = 1.0
    add_flag_of_axes(design, state, missing)


@generic
def set_axis_held(axes: Any, states: Any, i: int, axis: int, held: bool) -> None:
    """Set whether an axis is held: its v does not act until it is not."""
    raise TypeError


@set_axis_held.register(NoAxis)
def _set_none_held(axes: NoAxis, states: Any, i: int, axis: int, held: bool) -> None:
    pass


@set_axis_held.register(AxisDesigns)
def _set_axis_held(axes: AxisDesigns, states: AxisStates, i: int, axis: int, held: bool) -> None:
    if axis == i:
        states.axis.loop[0].held = 1.0 if held else 0.0
    set_axis_held(axes.others, states.others, i + 1, axis, held)


def set_held_of_axes(design: AxesDesign, state: AxesState, axis: int, held: bool) -> None:
    """Set whether an axis is held."""
    set_axis_held(design.axes, state.axes, 0, axis, held)


@change_parameters.register(NoAxis)
def _retune_none(old: NoAxis, new: NoAxis, state: Any) -> None:
    pass


@change_parameters.register(AxisDesigns)
def _retune_axis(old: AxisDesigns, new: AxisDesigns, state: AxisStates) -> None:
    change_design(old.axis, new.axis, state.axis)
    change_parameters(old.others, new.others, state.others)


@change_parameters.register(AxesDesign)
def _retune_axes(old: AxesDesign, new: AxesDesign, state: AxesState) -> None:
    change_parameters(old.axes, new.axes, state.axes)


# ---- The two C files ----


class AxesParts(NamedTuple):
    """What is exported: parameters, and the state before the first sample, in a precision."""

    parameters: Any
    state: Any


def parts_of_axes(controller: Axes, single: bool) -> AxesParts:
    """Return parameters and state with what was learned, in double or single precision.

    Raises
    ------
    TranslationError
        for what single precision can not do.
    """
    if controller.references != controller.outputs:
        raise TranslationError(
            f"{controller.inputs} control signals u_0 for {controller.outputs} axes: compensators "
            "with more actuators than axes are NOT exported yet; simulate them, or export each "
            "axis as a Compensator"
        )
    state = learned_state(controller)
    if not single:
        return AxesParts(controller.parameters, state)
    design = controller.parameters
    if isinstance(design.gain, FunctionGain):
        raise TranslationError(
            "precision = 'single': B0 or M is a function, which is compiled in double precision; "
            "export in double, or take a constant matrix"
        )
    if isinstance(design.rule, CutEach) and controller.inputs > controller.outputs:
        raise TranslationError(
            f"precision = 'single': {controller.inputs} actuators for {controller.outputs} axes "
            "with saturation = 'each' need least squares with a weight of 1e8, for which single "
            "precision has too few digits; take saturation = 'direction' or the axes in the order "
            "of their priority, or export in double"
        )
    rounded = single_design(design)
    return AxesParts(rounded, single_state(rounded, state))


def names_in_c(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of axes as members of a struct in C, in their order."""
    taken, found = {"v", "status"}, []
    for i, name in enumerate(names):
        plain = re.sub(r"\W+", "_", ascii_text(name)).strip("_")
        usable = re.fullmatch(r"[A-Za-z]\w*", plain) is not None
        found.append(identifier(unique(plain if usable else f"axis{i + 1}", taken)))
    return tuple(found)


def source_of_axes(controller: Axes, name: str = "controller", single: bool = False) -> CSource:
    """Return the C code of several axes, translated from the kernels that simulate them.

    Parameters
    ----------
    controller
        the axes; what they have learned is exported, too.
    name
        begins all public names.
    single
        whether real numbers are ``float``.

    Raises
    ------
    TranslationError
        naming a kernel, a part of the parameters, or a function B0 that has no counterpart in C.
    """
    checked_name(name)
    check_parts(controller)
    parts = parts_of_axes(controller, single)
    return translated(lambda findings: _Writer(controller, parts, name, findings).write())


_OF_COMPENSATORS = (
    "",
    "The axes are compensators: r are the control signals u_0 of the drives above them [u-unit].",
)


class _Writer:
    """Writer of the public functions of several axes."""

    def __init__(self, controller: Axes, parts: AxesParts, name: str, findings: Findings) -> None:
        self.controller, self.name = controller, name
        self.files = CFiles(name, parts.parameters, parts.state, findings)
        self.images = images_of(parts.parameters, parts.state, float(controller.dt))
        self.real = self.files.real
        self.state = f"{name}_state *state"
        self.n, self.m = controller.outputs, controller.inputs
        self.members = names_in_c(controller.names)
        self.derivatives = max(controller.derivatives)
        further = (f"r{i + 1}" for i in range(self.derivatives))
        self.more = "".join(f", const {self.real} {each}[{self.n}]" for each in further)

    def write(self) -> CSource:
        """Return the files."""
        files = self.files
        files.add_init()
        self._add_step()
        self._add_start()
        self._add_manual_operation()
        if all(rests_at_y(axis.observer) for axis in self.controller.axes):
            self._add_held()
        self._add_retune()
        self._add_reset()
        files.add_memory(self.images, files.call(reset_loop, *files.both))
        self._add_estimate()
        own = [tuple(each for each in axis.channels if each[1]) for axis in self.controller.axes]
        files.enums += enums(self.name, tuple(each for channels in own for each in channels))
        files.enums += self._enum_of_axes()
        files.structs += self._structs(own)
        channels = [("v", self.n) if self.n > 1 else ("v[0]", 1), ("status", 1)]
        for member, each in zip(self.members, own, strict=True):
            channels += [(f"{member}.{channel}", width) for channel, width in each]
        source = files.write(self._title(), tuple(channels), self._defines(), self.derivatives)
        return replace(source, axes=self.members, actuators=self.m)

    def _title(self) -> list[str]:
        dt, name = repr(float(self.controller.dt)), self.name
        precision = "float" if self.files.single else "double"
        return [
            f"Controller {name}: {self.n} axes with {self.m} actuators in {precision}, one sample "
            f"every {dt} s.",
            "",
            f"Call {name}_init once, then {name}_step every {dt} s. Several controllers may be",
            "linked into one program, and one controller may have several states. Arrays are the",
            "caller's: r and y have a number for each axis [y-unit of the axis], u one for each",
            "actuator [u-unit]; r, y and u must be different arrays. Generated by quell from the",
            "kernels that simulate it.",
            *(_OF_COMPENSATORS if self.controller.takes_u_0 and not self.controller.drives else ()),
        ]

    def _defines(self) -> list[str]:
        upper = self.name.upper()
        return [
            f"#define {upper}_SAMPLE_TIME {float(self.controller.dt)!r} /* [s] */",
            f"#define {upper}_MEMORY_SIZE {self.images.size} /* [bytes] */",
            f"#define {upper}_AXES {self.n} /* numbers in r and y */",
            f"#define {upper}_ACTUATORS {self.m} /* numbers in u */",
        ]

    def _enum_of_axes(self) -> list[str]:
        upper = self.name.upper()
        places = ", ".join(
            f"{upper}_AXIS_{member.upper()} = {i}" for i, member in enumerate(self.members)
        )
        lines = ["", "/* Places of the axes in r, y and v. */"]
        return [*lines, *wrapped(f"enum {self.name}_axis {{ {places} }};")]

    # ---- Values ----

    def _array(self, name: str, size: int, mutable: bool = False) -> Value:
        return Value(Array((size,), Number.REAL), name, root=name, mutable=mutable)

    def _parameter(self, name: str, size: int) -> str:
        return f"const {self.real} {name}[{size}]"

    def _axes(self) -> Iterator[tuple[Value, Value]]:
        """Yield parameters and state of each axis."""
        structs = self.files.program.structs
        inner = [structs.field(each, "axes") for each in self.files.both]
        for _ in range(self.n):
            design, state = (structs.field(_known(each), "axis") for each in inner)
            yield _known(design), _known(state)
            inner = [structs.field(_known(each), "others") for each in inner]

    def _derivatives(self) -> list[str]:
        """Return the lines that hand derivatives of the references over."""
        lines = []
        for i, (design, state) in enumerate(self._axes()):
            count = self.controller.axes[i].derivatives
            if count:
                name = f"derivatives_{i + 1}"
                call = self.files.call(
                    set_reference_derivatives, design, state, self._array(name, count)
                )
                values = ", ".join(f"r{k + 1}[{i}]" for k in range(count))
                lines.append(f"    const {self.real} {name}[{count}] = {{{values}}};")
                lines.append(f"    {call};")
        declared = [line for line in lines if line.startswith("    const")]
        return [*declared, *(line for line in lines if line not in declared)]

    def _about_derivatives(self) -> str:
        if not self.derivatives:
            return ""
        primes = ", ".join("r" + "'" * (i + 1) for i in range(self.derivatives))
        names = ", ".join(f"r{i + 1}" for i in range(self.derivatives))
        return f"{names} are {primes} of each axis at this sample, fed forward.\n"

    # ---- Functions ----

    def _add_step(self) -> None:
        files, both, n, m = self.files, self.files.both, self.n, self.m
        given = (self._array("r", n), self._array("y", n), self._array("u", m, mutable=True))
        files.add(
            "step",
            f"void NAME({self.state}, {self._parameter('r', n)}, {self._parameter('y', n)}"
            f"{self.more}, {self.real} u[{m}])",
            "Take one sample: write the control signals u for references r and measurements y.\n\n"
            f"{self._about_derivatives()}"
            "A value that is not finite is replaced; the status says so. The controller assumes\n"
            "that u is applied until the next sample.",
            *self._derivatives(),
            f"    {files.call(control_all, *both, *given)};",
        )
        files.add(
            "applied",
            f"void NAME({self.state}, {self._parameter('u', m)})",
            "Set the control signals that were really applied since the last step.\n\n"
            "One that is not finite is ignored; the status says so, until the next step.",
            f"    {files.call(set_applied_controls, *both, self._array('u', m))};",
        )

    def _add_start(self) -> None:
        files, n, m = self.files, self.n, self.m
        counts = [samples_to_settle(axis.observer) for axis in self.controller.axes]
        samples = Value(Array((n,), Number.INT), "samples", root="samples")
        given = (self._array("y", n), self._array("u", m), self._array("r", n))
        files.add(
            "start",
            f"void NAME({self.state}, {self._parameter('y', n)}, {self._parameter('u', m)}, "
            f"{self._parameter('r', n)})",
            "Start at a machine that rests at y under u: the next step continues from u.\n\n"
            "r are the references of the next step. What was learned is kept. The observers take\n"
            f"{2 * sum(counts)} samples to settle: do not call this in an interrupt. If a y or\n"
            "a u is not finite nothing changes but the status; an r that is not finite is y.",
            f"    static const int samples[{n}] = {{{', '.join(map(str, counts))}}};",
            "",
            f"    {files.call(start_axes_from, *files.both, samples, *given)};",
        )

    def _add_manual_operation(self) -> None:
        files, n, m = self.files, self.n, self.m
        unused = self._array("unused", m, mutable=True)
        given = (self._array("r", n), self._array("y", n), self._array("u", m), unused)
        call = files.call(track_axes, *files.both, *given)
        files.add(
            "track",
            f"void NAME({self.state}, {self._parameter('r', n)}, {self._parameter('y', n)}"
            f"{self.more}, {self._parameter('u', m)})",
            "Take one sample in manual operation: u is applied, unlimited, until the next sample."
            "\n\nA u that is not finite is the one before; the status says so.",
            *([f"    {self.real} unused[{m}];"] if "unused" in call else []),
            *self._derivatives(),
            f"    {call};",
        )
        files.add(
            "hand_over",
            f"bool NAME({self.state})",
            "End manual operation: the next step continues from the u of the last one.\n\n"
            "Return false before the first sample: then nothing has changed.",
            f"    return {files.call(hand_over_all, *files.both)};",
        )

    def _add_held(self) -> None:
        files = self.files
        which, held = Value(Number.INT, "axis"), Value(Number.BOOL, "held")
        files.add(
            "set_held",
            f"void NAME({self.state}, int axis, bool held)",
            "Set whether an axis is held, by a brake for instance: its v does not act until it is "
            f"not.\n\naxis is its place, see enum {self.name}_axis; there is no other effect of "
            "another\nnumber. Call it when that changes. While it is held nothing winds up.",
            f"    {files.call(set_held_of_axes, *files.both, which, held)};",
        )

    def _add_retune(self) -> None:
        files = self.files
        new = Value(files.design.kind, "parameters", root="new")
        call = files.call(change_parameters, files.design, new, files.memory)
        files.add(
            "retune",
            f"void NAME({self.state}, const {self.name}_parameters *parameters)",
            "Continue with other parameters of the same structure, without a jump of what the axes "
            "ask for.\n\nThey must stay in memory. To change a limit, copy the default parameters. "
            "B0 stays.",
            f"    {call};",
            "    state->parameters = parameters;",
        )

    def _add_reset(self) -> None:
        files = self.files
        files.add(
            "reset",
            f"void NAME({self.state})",
            "Start from rest at the next sample; what was learned is kept.",
            f"    {files.call(reset_loop, *files.both)};",
        )
        files.add(
            "status",
            f"int NAME(const {self.state})",
            "Return the flags of the last sample, of all axes and actuators, see enum "
            f"{self.name}_flag.",
            f"    return {files.call(status_flags, *files.both)};",
        )

    def _add_estimate(self) -> None:
        files, name, lines = self.files, self.name, []
        widest = 0
        for (design, state), axis, member in zip(
            self._axes(), self.controller.axes, self.members, strict=True
        ):
            channels = tuple(each for each in axis.channels if each[1])
            total = sum(width for _, width in channels)
            widest = max(widest, total)
            row = self._array("row", total, mutable=True)
            lines.append(f"    {files.call(write_row, design, state, row)};")
            lines += estimate_lines(files, f"estimate.{member}", channels)
        v = _known(files.program.structs.field(files.memory, "v"))
        lines += [f"    estimate.v[{i}] = {v.code}[{i}];" for i in range(self.n)]
        lines.append(f"    estimate.status = {name}_status(state);")
        files.add(
            "get_estimate",
            f"{name}_estimate NAME(const {self.state})",
            "Return what the controller knows after the last sample.",
            f"    {self.real} row[{widest}] = {{0}};",
            f"    {name}_estimate estimate;",
            *lines,
            "    return estimate;",
        )

    def _structs(self, own: list[Channels]) -> list[str]:
        """Return the lines of the structs of the estimates."""
        kinds: dict[Channels, str] = {}
        lines: list[str] = []
        for channels in own:
            if channels not in kinds:
                number = f"_{len(kinds) + 1}" if kinds else ""
                kinds[channels] = f"{self.name}_axis_estimate{number}"
                doc = "What is known of an axis after a sample."
                lines += estimate_struct(kinds[channels], channels, self.real, doc)
        lines += ["", "/* What the controller knows after a sample. */", "typedef struct {"]
        lines += [
            f"    {kinds[channels]} {member};"
            for member, channels in zip(self.members, own, strict=True)
        ]
        lines.append(f"    {self.real} v[{self.n}]; /* B0 u as it was applied */")
        lines.append("    int status; /* flags of the last sample, of all axes and actuators */")
        return [*lines, f"}} {self.name}_estimate;"]


def _known(value: Value | None) -> Value:
    if value is None:
        raise AssertionError
    return value
