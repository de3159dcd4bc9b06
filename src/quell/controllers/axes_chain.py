"""Several axes, one inside of the other, so that each may be of another kind.

A tuple of all axes would do, but compiled code cannot go through a tuple of different types. Each
function does its work for one axis, and calls itself for those behind it; its declaration is what
it does behind the last one, for ``NoAxis``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from quell.controllers.base import (
    control,
    is_usable,
    reset_loop,
    set_applied_control,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.compensator import start_at_rest
from quell.controllers.safe_axes import add_axes_flags, write_axes_bounds
from quell.controllers.safe_set import write_bounds
from quell.kernels.dispatch import generic_with_default
from quell.types import Matrix, Vector

# ---- The axes, one inside of the other ----


class NoAxis(NamedTuple):
    """The end of the axes."""


class NoAxisMemory(NamedTuple):
    """The end of the axes' states."""

    nothing: Vector  # (0,)


class AxisDesigns(NamedTuple):
    """Parameters of an axis, and of those behind it."""

    axis: Any
    others: Any


class AxisStates(NamedTuple):
    """State of an axis, and of those behind it."""

    axis: Any
    others: Any


# ---- What is done for each axis ----


@generic_with_default
def ask_axes(axes: Any, states: Any, i: int, r: Vector, y: Vector, v: Vector, x: Matrix) -> int:
    """Run the axes from the i-th on: write v and the estimates x; return the flags."""
    return 0


@generic_with_default
def tell_axes(axes: Any, states: Any, i: int, v: Vector) -> None:
    """Tell the axes from the i-th on what was applied."""


@generic_with_default
def reset_axes(axes: Any, states: Any) -> None:
    """Start the axes from rest at the next sample."""


@generic_with_default
def write_axes(axes: Any, states: Any, widths: Any, i: int, row: Vector) -> None:
    """Write the channels of the axes from the i-th on into ``row``; ``widths`` has their number."""


@generic_with_default
def set_axes_derivatives(axes: Any, states: Any, counts: Any, i: int, values: Vector) -> None:
    """Set the derivatives of the references of the axes from the i-th on."""


@generic_with_default
def start_axes(
    axes: Any, states: Any, samples: Any, i: int, y: Vector, v: Vector, r: Vector
) -> None:
    """Start the axes from the i-th on at rest; see ``start_at_rest``.

    A reference that is no number is y.
    """


@generic_with_default
def have_started(axes: Any, states: Any) -> bool:
    """Return whether all axes had a measurement or a start."""
    return True


@generic_with_default
def continue_axes(axes: Any, states: Any) -> None:
    """Let the next sample of each axis continue from what was applied."""


@generic_with_default
def set_axes_manual(axes: Any, states: Any, manual: float, i: int, v: Vector) -> None:
    """Begin or end manual operation under v of the axes from the i-th on."""


@generic_with_default
def hold_axis(axes: Any, states: Any, i: int, axis: int, held: bool) -> None:
    """Set whether an axis, of those from the i-th on, is held."""


@ask_axes.register(AxisDesigns)
def _ask(
    axes: AxisDesigns, states: AxisStates, i: int, r: Vector, y: Vector, v: Vector, x: Matrix
) -> int:
    v[i] = control(axes.axis, states.axis, r[i], y[i])
    for j in range(axes.axis.law.size):
        x[i, j] = states.axis.estimates[j]
    flags = status_flags(axes.axis, states.axis)
    return flags | ask_axes(axes.others, states.others, i + 1, r, y, v, x)


@tell_axes.register(AxisDesigns)
def _tell(axes: AxisDesigns, states: AxisStates, i: int, v: Vector) -> None:
    set_applied_control(axes.axis, states.axis, v[i])
    tell_axes(axes.others, states.others, i + 1, v)


@reset_axes.register(AxisDesigns)
def _reset(axes: AxisDesigns, states: AxisStates) -> None:
    reset_loop(axes.axis, states.axis)
    reset_axes(axes.others, states.others)


@write_axes.register(AxisDesigns)
def _write(axes: AxisDesigns, states: AxisStates, widths: Any, i: int, row: Vector) -> None:
    write_row(axes.axis, states.axis, row[: widths[i]])
    write_axes(axes.others, states.others, widths, i + 1, row[widths[i] :])


@set_axes_derivatives.register(AxisDesigns)
def _derivatives(
    axes: AxisDesigns, states: AxisStates, counts: Any, i: int, values: Vector
) -> None:
    if counts[i] > 0:
        set_reference_derivatives(axes.axis, states.axis, values[: counts[i]])
    set_axes_derivatives(axes.others, states.others, counts, i + 1, values[counts[i] :])


@start_axes.register(AxisDesigns)
def _start(
    axes: AxisDesigns, states: AxisStates, samples: Any, i: int, y: Vector, v: Vector, r: Vector
) -> None:
    goal = r[i] if is_usable(r[i]) else y[i]
    start_at_rest(axes.axis, states.axis, samples[i], y[i], v[i], goal)
    start_axes(axes.others, states.others, samples, i + 1, y, v, r)


@have_started.register(AxisDesigns)
def _have_started(axes: AxisDesigns, states: AxisStates) -> bool:
    if states.axis.loop[0].started == 0.0:
        return False
    return have_started(axes.others, states.others)


@continue_axes.register(AxisDesigns)
def _continue(axes: AxisDesigns, states: AxisStates) -> None:
    states.axis.loop[0].bumpless = 1.0
    continue_axes(axes.others, states.others)


@set_axes_manual.register(AxisDesigns)
def _set_manual(axes: AxisDesigns, states: AxisStates, manual: float, i: int, v: Vector) -> None:
    states.axis.loop[0].manual, states.axis.loop[0].u_manual = manual, v[i]
    set_axes_manual(axes.others, states.others, manual, i + 1, v)


@hold_axis.register(AxisDesigns)
def _hold_axis(axes: AxisDesigns, states: AxisStates, i: int, axis: int, held: bool) -> None:
    if axis == i:
        states.axis.loop[0].held = 1.0 if held else 0.0
    hold_axis(axes.others, states.others, i + 1, axis, held)


@write_axes_bounds.register(AxisDesigns)
def _write_bounds(axes: AxisDesigns, states: AxisStates, i: int, bounds: Matrix) -> None:
    write_bounds(axes.axis.safe_set, states.axis.safe_set, bounds[i])
    write_axes_bounds(axes.others, states.others, i + 1, bounds)


@add_axes_flags.register(AxisDesigns)
def _add_flags(axes: AxisDesigns, states: AxisStates, i: int, flags: Vector) -> None:
    own = states.axis.loop[0]
    own.status = int(own.status) | int(flags[i])
    add_axes_flags(axes.others, states.others, i + 1, flags)
