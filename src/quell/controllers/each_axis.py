"""Work that a controller of several axes does for each: the axes are a tuple, as their states.

The name of a function of one axis is in the singular, that of the function of all in the plural.
"""

from __future__ import annotations

from typing import Any

from quell.controllers.base import (
    bumpless_transfer,
    control,
    is_usable,
    reset_loop,
    set_applied_control,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.bumpless import start_at_rest
from quell.kernels.dispatch import for_each
from quell.types import Matrix, Vector


def ask_axis(
    axis: Any, state: Any, i: int, flags: int, r: Vector, y: Vector, v: Vector, x: Matrix
) -> int:
    """Run an axis: write v and the estimates x; return the flags."""
    v[i] = control(axis, state, r[i], y[i])
    for j in range(axis.law.size):
        x[i, j] = state.estimates[j]
    return flags | status_flags(axis, state)


def tell_axis(axis: Any, state: Any, i: int, v: Vector) -> None:
    """Tell an axis what was applied."""
    set_applied_control(axis, state, v[i])


def write_axis(axis: Any, state: Any, i: int, at: int, widths: Any, row: Vector) -> int:
    """Write the ``widths[i]`` channels of an axis into ``row`` from ``at`` on; return their end."""
    write_row(axis, state, row[at : at + widths[i]])
    return at + widths[i]


def write_motion(axis: Any, state: Any, i: int, v: Vector, row: Vector) -> None:
    """Write what the input v of an axis does to it, ``b0 v``, into ``row``."""
    row[i] = axis.b0 * v[i]


def set_axis_derivatives(
    axis: Any, state: Any, i: int, at: int, counts: Any, values: Vector
) -> int:
    """Set the derivatives of an axis's reference.

    They are in ``values`` from ``at`` on; return their end.
    """
    if counts[i] > 0:
        set_reference_derivatives(axis, state, values[at : at + counts[i]])
    return at + counts[i]


def start_axis(
    axis: Any, state: Any, i: int, samples: Any, y: Vector, v: Vector, r: Vector
) -> None:
    """Start an axis at rest; see ``start_at_rest``.

    A reference that is no number is y.
    """
    goal = r[i] if is_usable(r[i]) else y[i]
    start_at_rest(axis, state, samples[i], y[i], v[i], goal)


def count_started(axis: Any, state: Any, i: int, count: int) -> int:
    """Return the count of axes with a measurement or a start, this one included."""
    return count + (1 if state.loop[0].started != 0.0 else 0)


def continue_axis(axis: Any, state: Any, i: int) -> None:
    """Let the next sample of an axis continue from what was applied."""
    state.loop[0].bumpless = 1.0


def set_axis_manual(axis: Any, state: Any, i: int, manual: float, v: Vector) -> None:
    """Begin or end manual operation of an axis under v."""
    state.loop[0].manual, state.loop[0].u_manual = manual, v[i]


def hold_axis(axis: Any, state: Any, i: int, which: int, held: bool) -> None:
    """Set whether the axis ``which`` is held."""
    if which == i:
        state.loop[0].held = 1.0 if held else 0.0


ask_axes = for_each("ask_axes", ask_axis)
tell_axes = for_each("tell_axes", tell_axis)
reset_axes = for_each("reset_axes", reset_loop)
write_axes = for_each("write_axes", write_axis)
write_motions = for_each("write_motions", write_motion)
set_axes_derivatives = for_each("set_axes_derivatives", set_axis_derivatives)
start_axes = for_each("start_axes", start_axis)
axes_started = for_each("axes_started", count_started)
continue_axes = for_each("continue_axes", continue_axis)
transfer_axes = for_each("transfer_axes", bumpless_transfer)
set_axes_manual = for_each("set_axes_manual", set_axis_manual)
hold_axes = for_each("hold_axes", hold_axis)
