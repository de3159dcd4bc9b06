"""Control signals u_0 in the place of references: axes that are compensators on top of drives.

As a ``Compensator`` of one axis is, each axis is observer, learner and guard without a law, and
asks for what cancels its total disturbance f̂_i beside what u_0 does to it::

    v_0 = B0 u_0,      v_i = v_0,i − f̂_i,      u = sat( u_0 + B0⁺ (v − v_0) ) = sat( u_0 − B0⁺ f̂ )

u_0 (m,) comes from outside, or from controllers in the loop, one for each actuator: the k-th takes
r_k and y_k. Every observer receives (B0 u)_i with the u that was applied, so it does not matter to
an axis which part of u a limit has taken.

*Limits* are those of the sum. Rules for limits (``controllers/allocation.py``) work on u − u_0 in
the range that u_0 leaves: with ``"direction"`` and with an order of axes, u_0 stays as far as the
limits allow, and the rest is for the compensation. With more actuators than axes u is the one that
is nearest to u_0. A B0 that is a function of the estimates is in v_0 that of the sample before, and
in the change of u that of this sample.

*A controller* is told that it applied ``u − B0⁺ (v_∞ − v_0)``, with the v_∞ of the axes before
limits and bands: its u_0 less what those took, so its integrator does not wind up. While its axis
is held, as by a brake, the integrator stays as it is. Where a measurement is missing, it receives
the one that the observer of its axis expects, as ``Compensated`` has it.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.allocation import (
    ActuatorLimits,
    GainMemory,
    RangeMemory,
    allocate,
    apply_to_axes,
    set_range,
)
from quell.controllers.base import (
    check_controller,
    control,
    hold_integrators,
    is_usable,
    reset_loop,
    set_applied_control,
    status_flags,
)
from quell.controllers.compensated import (
    check_takes_compensator,
    measured_or_expected,
    takes_control,
)
from quell.controllers.compensator import Compensator
from quell.controllers.law import unlimited_control
from quell.kernels.dispatch import for_each, generic, generic_with_default, kernel
from quell.kernels.sized import Work
from quell.types import Status, Vector

_REFERENCE_HELD = int(Status.REFERENCE_HELD)
_HELD = int(Status.HELD)
ANY_CUT = int(Status.SATURATED | Status.RATE_LIMITED | Status.SAFE_SET_ACTED)

# ---- The controllers that give u_0 ----


class FromOutside(NamedTuple):
    """U_0 takes the place of the references."""


def ask_drive(drive: Any, state: Any, i: int, flags: int, r: Vector, y: Vector, u_0: Vector) -> int:
    """Write the u_0 of a drive; return the flags."""
    u_0[i] = control(drive, state, r[i], y[i])
    return flags | int(status_flags(drive, state))


def tell_drive(drive: Any, state: Any, i: int, u: Vector, held: Vector, undoes: bool) -> None:
    """Tell a drive what was applied.

    The integrator of one whose axis is held stays as it is: what the last sample has added to it is
    undone if ``undoes``.
    """
    if held[i] == 0.0:
        set_applied_control(drive, state, u[i])
    elif undoes:
        hold_integrators(drive, state, u[i])


_ask_each = for_each("ask_each_drive", ask_drive)
_tell_each = for_each("tell_each_drive", tell_drive)
_reset_each = for_each("reset_each_drive", reset_loop)


@generic
def ask_drives(drives: Any, states: Any, r: Vector, y: Vector, u_0: Vector) -> int:
    """Write the u_0 of all drives; return the flags."""
    raise TypeError


@ask_drives.register(FromOutside)
def _from_outside(drives: FromOutside, states: Any, r: Vector, y: Vector, u_0: Vector) -> int:
    flags = 0
    for i in range(u_0.size):
        if is_usable(r[i]):
            u_0[i] = r[i]
        else:
            flags = _REFERENCE_HELD
    return flags


@ask_drives.register(tuple)
def _ask(drives: Any, states: Any, r: Vector, y: Vector, u_0: Vector) -> int:
    return _ask_each(drives, states, 0, r, y, u_0)


@generic_with_default
def tell_drives(drives: Any, states: Any, u: Vector, held: Vector, undoes: bool) -> None:
    """Tell all drives what was applied."""


@tell_drives.register(tuple)
def _tell(drives: Any, states: Any, u: Vector, held: Vector, undoes: bool) -> None:
    _tell_each(drives, states, u, held, undoes)


@generic_with_default
def reset_drives(drives: Any, states: Any) -> None:
    """Start the drives from rest."""


@reset_drives.register(tuple)
def _reset_drives(drives: Any, states: Any) -> None:
    _reset_each(drives, states)


# ---- What axes are asked for, and what they are given ----


class References(NamedTuple):
    """The axes follow references."""


class NoGivenMemory(NamedTuple):
    """The room that references do not need."""

    nothing: Work  # (0,)


class GivenControls(NamedTuple):
    """The axes are compensators on top of u_0."""

    drives: Any


class LimitsOfChange(NamedTuple):
    """Limits that the actuators leave beside u_0, as ``ActuatorLimits``."""

    low: Work
    high: Work
    most_change: Work
    least_change: Work


class GivenMemory(NamedTuple):
    """State of the control signals that are given."""

    drives: Any
    u_0: Vector  # the last one (m,)
    v_0: Work  # what it does to the axes (n,)
    free: Work  # v that the axes ask for before limits and bands (n,)
    before: Work  # last u less u_0 (m,)
    told: Vector  # what the drives were told (m,)
    held: Work  # 1 for axes that are held, else 0 (m,)
    y: Work  # what the drives receive: measured, or expected by the observers (n,)
    limits: Any  # LimitsOfChange, in the place of ActuatorLimits


def write_unlimited_of_axis(axis: Any, state: Any, i: int, v: Vector, held: Vector) -> None:
    """Write what an axis asks for before limits and bands, and whether it is held."""
    loop = state.loop[0]
    held[i] = loop.held
    v[i] = unlimited_control(axis, state, loop.constant, loop.slope) + loop.offset


def write_expected_of_axis(axis: Any, state: Any, i: int, y: Vector, expected: Vector) -> None:
    """Write the measurement of an axis, or what its observer expects."""
    expected[i] = measured_or_expected(axis, state, y[i])


write_unlimited = for_each("write_unlimited", write_unlimited_of_axis)
write_expected = for_each("write_expected", write_expected_of_axis)


@generic_with_default
def take_references(
    given: Any,
    memory: Any,
    axes: Any,
    states: Any,
    gain: GainMemory,
    r: Vector,
    y: Vector,
    wish: Vector,
) -> int:
    """Write what each axis is asked for, a reference or v_0; return the flags."""
    for i in range(wish.size):
        wish[i] = r[i]
    return 0


@take_references.register(GivenControls)
def _take_controls(
    given: GivenControls,
    memory: GivenMemory,
    axes: Any,
    states: Any,
    gain: GainMemory,
    r: Vector,
    y: Vector,
    wish: Vector,
) -> int:
    write_expected(axes, states, y, memory.y)
    flags = ask_drives(given.drives, memory.drives, r, memory.y, memory.u_0)
    _act(gain, memory, wish)
    return flags


@kernel
def _act(gain: GainMemory, memory: GivenMemory, wish: Vector) -> None:
    """Write ``B0 u_0``."""
    apply_to_axes(gain, memory.u_0, memory.v_0)
    for i in range(wish.size):
        wish[i] = memory.v_0[i]


@generic_with_default
def allocate_given(
    given: Any,
    memory: Any,
    rule: Any,
    limits: ActuatorLimits,
    gain: GainMemory,
    within: RangeMemory,
    v: Vector,
    before: Vector,
    u: Vector,
) -> int:
    """Write the control signals ``u`` (m,) for ``v`` (n,) after ``before``; return the flags."""
    return allocate(rule, limits, gain, within, v, before, u)


@allocate_given.register(GivenControls)
def _allocate_beside(
    given: GivenControls,
    memory: GivenMemory,
    rule: Any,
    limits: ActuatorLimits,
    gain: GainMemory,
    within: RangeMemory,
    v: Vector,
    before: Vector,
    u: Vector,
) -> int:
    left, u_0 = memory.limits, memory.u_0
    for i in range(v.size):
        v[i] -= memory.v_0[i]
    for k in range(u.size):
        left.low[k], left.high[k] = limits.low[k] - u_0[k], limits.high[k] - u_0[k]
        left.most_change[k], left.least_change[k] = limits.most_change[k], limits.least_change[k]
        memory.before[k] = before[k] - u_0[k]
    flags = allocate(rule, left, gain, within, v, memory.before, u)
    set_range(limits, before, within)
    for k in range(u.size):
        u[k] = min(max(u_0[k] + u[k], within.low[k]), within.high[k])
    return flags


@generic_with_default
def tell_given(
    given: Any, memory: Any, axes: Any, states: Any, gain: GainMemory, u: Vector, flags: int
) -> None:
    """Tell the drives what was applied of their u_0, where the flags say that it is not all."""


@tell_given.register(GivenControls)
def _tell_given(
    given: GivenControls,
    memory: GivenMemory,
    axes: Any,
    states: Any,
    gain: GainMemory,
    u: Vector,
    flags: int,
) -> None:
    n, m = gain.B.shape
    if flags & (ANY_CUT | _HELD) == 0:
        for k in range(m):
            memory.told[k] = memory.u_0[k]
        return
    write_unlimited(axes, states, memory.free, memory.held)
    for k in range(m):
        if memory.held[k] == 0.0:
            memory.told[k] = u[k]
            for i in range(n):
                memory.told[k] -= gain.inverse[k, i] * (memory.free[i] - memory.v_0[i])
    undoes = flags & _HELD != 0
    tell_drives(given.drives, memory.drives, memory.told, memory.held, undoes)


@generic_with_default
def reset_given(given: Any, memory: Any) -> None:
    """Start from rest."""


@reset_given.register(GivenControls)
def _reset_given(given: GivenControls, memory: GivenMemory) -> None:
    reset_drives(given.drives, memory.drives)
    for k in range(memory.u_0.size):
        memory.u_0[k] = memory.told[k] = 0.0


@generic_with_default
def start_given(
    given: Any, memory: Any, gain: GainMemory, y: Vector, u: Vector, r: Vector, wish: Vector
) -> None:
    """Write what each axis is asked for in the sample after a start at rest at y under u."""
    for i in range(wish.size):
        wish[i] = r[i]


@start_given.register(GivenControls)
def _start_given(
    given: GivenControls,
    memory: GivenMemory,
    gain: GainMemory,
    y: Vector,
    u: Vector,
    r: Vector,
    wish: Vector,
) -> None:
    for k in range(u.size):
        memory.u_0[k] = u[k]
    _act(gain, memory, wish)


@generic_with_default
def write_given(given: Any, memory: Any, at: int, row: Vector) -> None:
    """Write the shaped references that the axes followed into a row from ``at`` on."""


# ---- What users give, checked ----


def check_axes(axes: Sequence[Any], names: Sequence[str]) -> None:
    """Check that these can be the axes of a controller."""
    if len(axes) < 1:
        raise ValueError("axes has no entries: give an ADRC for each axis")
    for name, axis in zip(names, axes, strict=True):
        if not isinstance(name, str) or not name or "." in name:
            raise ValueError(f"axes: name {name!r} must be a text without a dot")
        checks.printable("axes", name)
        if not isinstance(axis, Compensator):
            raise ValueError(
                f"axes: {name} = {axis!r:.60}: must be an ADRC, which may have one prefilter, or a "
                "Compensator"
            )
        check_controller(axis, f"axes: {name}")
        if takes_control(axis) != takes_control(axes[0]):
            raise ValueError(
                f"axes: {name} is of another kind than {names[0]}: all must be ADRCs, or all "
                "compensators; give an axis without drive an ADRC"
            )
        if axis.dt != axes[0].dt:
            raise ValueError(
                f"axes: {name} has dt = {axis.dt!r} s, {names[0]} {axes[0].dt!r} s: must be one dt"
            )
        limits = axis.limits
        if any(map(np.isfinite, limits)):
            raise ValueError(
                f"axes: {name} has limits of u: must have none, give u_min, u_max and rate_limit "
                "of the actuators to Axes"
            )
        if axis.schedule is not None:
            raise ValueError(
                f"axes: {name} has a schedule: must have none; make B0 a function of the estimates"
            )


def check_compensates(compensates: bool, drives: Any, wished: Any) -> None:
    """Check that what is given has a use with these axes, which are compensators or ADRCs."""
    if drives is not None and not compensates:
        raise ValueError(
            "drives: the axes are ADRCs, which have laws of their own; give a quell.Compensator "
            "for each axis, or no drives"
        )
    if wished is not None and compensates:
        raise ValueError(
            f"wished = {wished!r}: u is the one nearest to u_0 where axes are compensators; leave "
            "it out"
        )


def checked_drives(drives: Any, names: Sequence[str], inputs: int, dt: float) -> tuple[Any, ...]:
    """Return copies of the controllers that give u_0; none if it comes from outside.

    Raises
    ------
    ValueError
        unless there is one for each axis and each actuator, with the axes' dt, without an observer
        and without limits of its own.
    """
    if drives is None:
        return ()
    rule = "must be a controller for each axis, in a list, each for the actuator of its place"
    if not isinstance(drives, Sequence) or len(drives) != len(names):
        raise ValueError(f"drives = {drives!r:.60}: {rule}")
    if inputs != len(names):
        raise ValueError(
            f"drives: there are {inputs} actuators for {len(names)} axes: {rule}; give u_0 from "
            "outside, without drives"
        )
    for name, drive in zip(names, drives, strict=True):
        check_controller(drive, f"drives: {name}")
        try:
            check_takes_compensator(drive)
        except ValueError as error:
            raise ValueError(f"drives: {name}: {error}") from None
        if float(drive.dt) != dt:
            raise ValueError(
                f"drives: {name} has dt = {float(drive.dt)!r} s, the axes {dt!r} s: must be one dt"
            )
        if any(map(np.isfinite, getattr(drive, "limits", None) or ())):
            raise ValueError(
                f"drives: {name} has limits of u: must have none, give u_min, u_max and rate_limit "
                "of the sum to Axes"
            )
        if getattr(drive, "derivatives", 0):
            raise ValueError(
                f"drives: {name} feeds derivatives of the reference forward: NOT possible below "
                "axes; take one without"
            )
    return tuple(copy.copy(drive) for drive in drives)


def given_design(drives: Sequence[Any]) -> GivenControls:
    """Return the parameters of control signals in the place of references."""
    if not drives:
        return GivenControls(FromOutside())
    return GivenControls(tuple(drive.parameters for drive in drives))


def given_memory(drives: Sequence[Any], n: int, m: int) -> GivenMemory:
    """Return the state before the first sample, for n axes and m actuators."""
    states = tuple(drive.initial_state() for drive in drives)
    limits = LimitsOfChange(*(np.zeros(m) for _ in range(4)))
    u_0, before, told, held = (np.zeros(m) for _ in range(4))
    v_0, free, y = (np.zeros(n) for _ in range(3))
    return GivenMemory(states, u_0, v_0, free, before, told, held, y, limits)
