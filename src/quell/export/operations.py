"""Operations of the exported controller besides a step, as kernels that are translated to C.

Each is the method of the same name of a controller in Python. Where that raises an error for a
value that is no number, the exported function ignores the value, and the status says so.
"""

from __future__ import annotations

from typing import Any

from quell.controllers.adrc.handover import change_design, start_at_rest
from quell.controllers.adrc.law import AdrcDesign, AdrcState
from quell.controllers.bad_samples import is_usable
from quell.controllers.base import control, set_applied_control
from quell.controllers.linear.linear import LinearDesign, LinearState
from quell.controllers.prefilters.prefilter import (
    PrefilteredDesign,
    PrefilteredState,
    settle,
    stopping_point,
)
from quell.kernels.dispatch import generic
from quell.types import Status

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


@add_flag.register(PrefilteredDesign)
def _add_flag_inside(design: PrefilteredDesign, state: PrefilteredState, flag: int) -> None:
    add_flag(design.controller, state.controller, flag)


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
        start(design, state, samples, y, u, y)
        add_flag(design, state, _REFERENCE_HELD)


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


@generic
def move_origin(design: Any, state: Any, distance: float) -> None:
    """Count y and r from a point that is ``distance`` further on."""
    raise TypeError


@move_origin.register(AdrcDesign)
def _move_origin(design: AdrcDesign, state: AdrcState, distance: float) -> None:
    loop = state.loop[0]
    state.z[0] -= distance
    state.seen[0] -= distance
    loop.y -= distance
    loop.r -= distance


def stop_of_move(design: PrefilteredDesign, state: PrefilteredState) -> float:
    """Return where the reference comes to rest soonest: as r of a step it stops there."""
    return stopping_point(design.prefilter, state.prefilter)


@generic
def retune(old: Any, new: Any, state: Any) -> None:
    """Continue with other parameters of the same structure, without a jump of u."""
    raise TypeError


@retune.register(AdrcDesign)
def _retune(old: AdrcDesign, new: AdrcDesign, state: AdrcState) -> None:
    change_design(old, new, state)


@retune.register(PrefilteredDesign)
def _retune_inside(old: PrefilteredDesign, new: PrefilteredDesign, state: PrefilteredState) -> None:
    retune(old.controller, new.controller, state.controller)


@retune.register(LinearDesign)
def _keep_state(old: LinearDesign, new: LinearDesign, state: LinearState) -> None:
    """Change nothing: the state of a linear law has the same meaning with other limits."""
