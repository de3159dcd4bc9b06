"""Operations of several signals besides a step as kernels; names and estimates of axes in C.

As for one axis (``c_files.py``), an operation does what the method of this name does in Python;
where that raises an error for a value that is no number, the exported function ignores the value,
and the status says so. Arrays are those of the caller: the code keeps none of them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from quell.controllers.allocation import apply_to_axes
from quell.controllers.axes import AxesDesign, AxesState, begin_manual, end_manual
from quell.controllers.base import change_parameters, is_usable, write_row
from quell.controllers.bumpless import change_design
from quell.controllers.several import control_all, start_all, tell_applied
from quell.export.c_files import CFiles
from quell.export.estimates import estimate_lines, estimate_struct
from quell.export.translate.structs import ascii_text
from quell.export.translate.text import Array, Number, Value, identifier, unique, wrapped
from quell.kernels.dispatch import for_each, is_finite, kernel
from quell.types import Channels, Status, Vector

# ---- Operations besides a step ----

_CONTROL_HELD = int(Status.CONTROL_HELD)
_REFERENCE_HELD = int(Status.REFERENCE_HELD)


def add_flag_of_axes(design: Any, state: Any, flag: int) -> None:
    """Add a flag to the status of the last sample."""
    state.loop[0].status = int(state.loop[0].status) | flag


@kernel
def as_number(value: float) -> float:
    """Return a value that has been tested, so that a proof sees that it is a number."""
    if not is_finite(value):
        value = 0.0
    return value


def set_applied_controls(design: Any, state: Any, u: Vector) -> None:
    """Set the control signals that were really applied; those that are no numbers are ignored."""
    for k in range(u.size):
        if is_usable(u[k]):
            state.u[k] = as_number(u[k])
        else:
            add_flag_of_axes(design, state, _CONTROL_HELD)
    tell_applied(design, state)


def start_axes_from(design: Any, state: Any, samples: Any, y: Vector, u: Vector, r: Vector) -> None:
    """Start at a machine that rests at y under u; nothing happens where one is no number.

    For an r that is no number see ``start_all``.
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
    for k in range(u.size):
        state.u[k] = as_number(u[k])
    for i in range(r.size):
        if not is_usable(r[i]):
            add_flag_of_axes(design, state, _REFERENCE_HELD)


def track_axes(design: AxesDesign, state: AxesState, r: Vector, y: Vector, u: Vector) -> None:
    """Take one sample in manual operation: u is applied, unlimited, until the next sample.

    One that is no number is the one before.
    """
    missing = 0
    for k in range(u.size):
        if is_usable(u[k]):
            state.u[k] = as_number(u[k])
        else:
            missing = _CONTROL_HELD
    apply_to_axes(state.gain, state.u, state.v)
    begin_manual(design, state)
    control_all(design, state, r, y, state.u_limited)  # which manual operation leaves
    end_manual(design, state)
    tell_applied(design, state)
    state.loop[0].started = 1.0
    add_flag_of_axes(design, state, missing)


def retune_axis(old: Any, new: Any, state: Any, i: int) -> None:
    """Continue an axis with other parameters."""
    change_design(old, new, state)


retune_axes = for_each("retune_axes", retune_axis, tuples=3)


@change_parameters.register(AxesDesign)
def _retune_axes(old: AxesDesign, new: AxesDesign, state: AxesState) -> None:
    retune_axes(old.axes, new.axes, state.axes)


# ---- Names of axes in C, and what is known of each ----


def names_in_c(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of axes as members of a struct in C, in their order.

    They differ in more than capitals, because constants are named after them.
    """
    taken, found = {"V", "STATUS"}, []
    for i, name in enumerate(names):
        plain = re.sub(r"\W+", "_", ascii_text(name)).strip("_")
        usable = re.fullmatch(r"[A-Za-z]\w*", plain) is not None
        own = plain if usable else f"axis{i + 1}"
        found.append(identifier(own + unique(own.upper(), taken)[len(own) :]))
    return tuple(found)


def each_axis(files: CFiles, count: int) -> Iterator[tuple[Value, Value]]:
    """Yield parameters and state of each axis as arguments of kernels."""
    structs = files.program.structs
    design, state = (_known(structs.field(each, "axes")) for each in files.both)
    for i in range(count):
        yield structs.entry(design, i), structs.entry(state, i)


def places_of_axes(name: str, members: tuple[str, ...]) -> list[str]:
    """Return the lines of the enum with the places of the axes."""
    upper = name.upper()
    places = ", ".join(f"{upper}_AXIS_{each.upper()} = {i}" for i, each in enumerate(members))
    return ["", "/* Places of the axes in r, y and v. */",
            *wrapped(f"enum {name}_axis {{ {places} }};")]  # fmt: skip


def estimate_structs_of_axes(
    name: str, members: tuple[str, ...], own: list[Channels], real: str, shaped: bool
) -> list[str]:
    """Return the lines of the structs of the estimates; ``own`` are the channels of each axis.

    ``shaped`` says whether references pass through prefilters.
    """
    kinds: dict[Channels, str] = {}
    lines: list[str] = []
    for channels in own:
        if channels not in kinds:
            number = f"_{len(kinds) + 1}" if kinds else ""
            kinds[channels] = f"{name}_axis_estimate{number}"
            doc = "What is known of an axis after a sample."
            lines += estimate_struct(kinds[channels], channels, real, doc)
    lines += ["", "/* What the controller knows after a sample. */", "typedef struct {"]
    lines += [f"    {kinds[each]} {member};" for member, each in zip(members, own, strict=True)]
    lines.append(f"    {real} v[{len(own)}]; /* B0 u as it was applied */")
    if shaped:
        lines.append(f"    {real} r_shaped[{len(own)}]; /* references that the axes follow */")
    lines.append("    int status; /* flags of the last sample, of all axes and actuators */")
    return [*lines, f"}} {name}_estimate;"]


def estimate_lines_of_axes(
    files: CFiles, members: tuple[str, ...], own: list[Channels], shaped: bool
) -> tuple[int, list[str]]:
    """Return the numbers of the longest row, and the statements that set all estimates."""
    lines, widest = [], 0
    for (design, state), channels, member in zip(
        each_axis(files, len(own)), own, members, strict=True
    ):
        total = sum(width for _, width in channels)
        widest = max(widest, total)
        row = Value(Array((total,), Number.REAL), "row", root="row", mutable=True)
        lines.append(f"    {files.call(write_row, design, state, row)};")
        lines += estimate_lines(files, f"estimate.{member}", channels)
    structs = files.program.structs
    arrays = {"v": _known(structs.field(files.memory, "v"))}
    if shaped:
        given = _known(structs.field(files.memory, "given"))
        arrays["r_shaped"] = _known(structs.field(given, "r"))
    for array, value in arrays.items():
        lines += [f"    estimate.{array}[{i}] = {value.code}[{i}];" for i in range(len(own))]
    return widest, [*lines, f"    estimate.status = {files.name}_status(state);"]


def _known(value: Value | None) -> Value:
    if value is None:
        raise AssertionError
    return value
