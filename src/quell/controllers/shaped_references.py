"""Prefilters of the references of several axes: each axis follows its own shaped reference.

The reference r_i passes through the prefilter of its axis before the axis is asked for v_i, as
``Prefiltered`` has it for a controller of one signal: it starts at rest at the first finite
measurement, gives the axis the derivatives that its feedforward takes, and starts again from an
absurd reference. An axis without a prefilter follows r_i itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers import given_controls
from quell.controllers.allocation import GainMemory
from quell.controllers.base import is_usable
from quell.controllers.prefilters import (
    Prefiltered,
    PrefilteredLoop,
    prefilter_memory,
    settle,
    shaped_reference,
    stopping_point,
)
from quell.kernels.dispatch import for_each, generic_with_default, is_finite
from quell.kernels.sized import Work, clear
from quell.types import Vector

# ---- A sample of the prefilter of an axis ----


class NoPrefilter(NamedTuple):
    """An axis follows its reference itself."""


class AxisPrefilter(NamedTuple):
    """The prefilter of an axis."""

    prefilter: Any


class NoPrefilterMemory(NamedTuple):
    """The room that no prefilter needs."""

    nothing: Work  # (0,)


class AxisPrefilterMemory(NamedTuple):
    """State of the prefilter of an axis; see ``PrefilteredState``."""

    prefilter: Any
    derivatives: Vector
    used: Work
    loop: NDArray[PrefilteredLoop]  # (1,)


@generic_with_default
def shape_reference(
    shaper: Any, memory: Any, axis: Any, state: Any, i: int, flags: int, r: Vector, y: Vector,
    wish: Vector, shown: Vector,
) -> int:  # fmt: skip
    """Write the reference that an axis follows, for it and as a channel; return the flags."""
    wish[i] = shown[i] = r[i]
    return flags


@shape_reference.register(AxisPrefilter)
def _shape(
    shaper: AxisPrefilter, memory: AxisPrefilterMemory, axis: Any, state: Any, i: int, flags: int,
    r: Vector, y: Vector, wish: Vector, shown: Vector,
) -> int:  # fmt: skip
    wish[i] = shaped_reference(shaper, memory, axis, state, r[i], y[i])
    shown[i] = memory.loop[0].r_shaped
    return flags | int(memory.loop[0].status)


@generic_with_default
def start_shaping(shaper: Any, memory: Any, i: int, y: Vector, r: Vector) -> None:
    """Start the prefilter of an axis at rest at y, with r as the last reference."""


@start_shaping.register(AxisPrefilter)
def _start(
    shaper: AxisPrefilter, memory: AxisPrefilterMemory, i: int, y: Vector, r: Vector
) -> None:
    settle(shaper.prefilter, memory.prefilter, y[i])
    loop = memory.loop[0]
    loop.started = loop.has_reference = 1.0
    loop.r = r[i] if is_usable(r[i]) else y[i]


@generic_with_default
def reset_shaping(shaper: Any, memory: Any, i: int) -> None:
    """Start the prefilter of an axis from rest at the next measurement."""


@reset_shaping.register(AxisPrefilter)
def _reset(shaper: AxisPrefilter, memory: AxisPrefilterMemory, i: int) -> None:
    clear(memory.loop)


@generic_with_default
def stop_shaping(shaper: Any, memory: Any, i: int, shown: Vector, r: Vector) -> None:
    """Write where the reference of an axis rests soonest; the last one where none is planned."""
    r[i] = shown[i]


@stop_shaping.register(AxisPrefilter)
def _stop(
    shaper: AxisPrefilter, memory: AxisPrefilterMemory, i: int, shown: Vector, r: Vector
) -> None:
    at = stopping_point(shaper.prefilter, memory.prefilter)
    r[i] = at if is_finite(at) else shown[i]


# ---- Those of all axes ----


class ShapedReferences(NamedTuple):
    """The axes follow references that prefilters have shaped."""

    shapers: tuple[Any, ...]  # ``AxisPrefilter`` or ``NoPrefilter`` of each axis


class ShapedMemory(NamedTuple):
    """State of the prefilters."""

    shapers: tuple[Any, ...]
    r: Vector  # references that the axes followed in the last sample (n,)


_shape_all = for_each("shape_references", shape_reference, tuples=4)
_start_all = for_each("start_shapings", start_shaping)
_reset_all = for_each("reset_shapings", reset_shaping)


_stop_all = for_each("stop_shapings", stop_shaping)


def stop_of_moves(design: Any, state: Any, r: Vector) -> None:
    """Write where the references of axes come to rest soonest: as r of the next steps they stop.

    ``design`` and ``state`` are those of axes with prefilters.
    """
    _stop_all(design.given.shapers, state.given.shapers, state.given.r, r)


@given_controls.take_references.register(ShapedReferences)
def _take_references(
    given: ShapedReferences,
    memory: ShapedMemory,
    axes: Any,
    states: Any,
    gain: GainMemory,
    r: Vector,
    y: Vector,
    wish: Vector,
) -> int:
    return _shape_all(given.shapers, memory.shapers, axes, states, 0, r, y, wish, memory.r)


@given_controls.start_given.register(ShapedReferences)
def _start_given(
    given: ShapedReferences,
    memory: ShapedMemory,
    gain: GainMemory,
    y: Vector,
    u: Vector,
    r: Vector,
    wish: Vector,
) -> None:
    _start_all(given.shapers, memory.shapers, y, r)
    for i in range(wish.size):
        wish[i] = r[i]


@given_controls.reset_given.register(ShapedReferences)
def _reset_given(given: ShapedReferences, memory: ShapedMemory) -> None:
    _reset_all(given.shapers, memory.shapers)
    for i in range(memory.r.size):
        memory.r[i] = 0.0


@given_controls.write_given.register(ShapedReferences)
def _write_given(given: ShapedReferences, memory: ShapedMemory, at: int, row: Vector) -> None:
    for i in range(memory.r.size):
        row[at + i] = memory.r[i]


# ---- What users give ----


def without_prefilter(axis: Any) -> tuple[Any, Any]:
    """Return the controller of an axis and its prefilter, which is None for one without."""
    return (axis.controller, axis.prefilter) if isinstance(axis, Prefiltered) else (axis, None)


def with_prefilter(axis: Any, prefilter: Any) -> Any:
    """Return the controller of an axis behind its prefilter, or itself if that is None."""
    return axis if prefilter is None else Prefiltered(axis, prefilter)


def are_shaped(prefilters: Sequence[Any]) -> bool:
    """Return whether one of the axes has a prefilter."""
    return any(each is not None for each in prefilters)


def shaped_design(
    prefilters: Sequence[Any], dt: float
) -> ShapedReferences | given_controls.References:
    """Return the parameters of the prefilters of the axes; ``References`` without any."""
    if not are_shaped(prefilters):
        return given_controls.References()
    return ShapedReferences(
        tuple(NoPrefilter() if p is None else AxisPrefilter(p.design(dt)) for p in prefilters)
    )


def shaped_memory(
    design: ShapedReferences | given_controls.References,
    prefilters: Sequence[Any],
    axes: Sequence[Any],
) -> ShapedMemory | given_controls.NoGivenMemory:
    """Return the state before the first sample."""
    if isinstance(design, given_controls.References):
        return given_controls.NoGivenMemory(np.zeros(0))
    parts: list[Any] = []
    for part, prefilter, axis in zip(design.shapers, prefilters, axes, strict=True):
        if prefilter is None:
            parts.append(NoPrefilterMemory(np.zeros(0)))
        else:
            made = prefilter_memory(prefilter, part.prefilter, axis.derivatives)
            parts.append(AxisPrefilterMemory(*made))
    return ShapedMemory(tuple(parts), np.zeros(len(axes)))


def plan_stops(design: Any) -> bool:
    """Return whether one of the prefilters of ``ShapedReferences`` plans a stop."""
    shapers = getattr(design, "shapers", ())
    known = stopping_point.implementations
    return any(type(getattr(each, "prefilter", None)) in known for each in shapers)
