"""The supervisor of several axes: the states and causes of one, with limits for each signal.

A sample is good if all measurements came: if one did not, all u are held, and the observers of the
other axes go on with their own. After a fault all u go to zero together, each in a straight line,
because a machine of which one axis is still driven is no safer than one that is not. The cause
names the signal to which it is due: ``Memory.culprit``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers.axes import AxesDesign, AxesState
from quell.controllers.base import bumpless_transfer
from quell.controllers.several import tell_applied
from quell.kernels.dispatch import for_each, is_finite, kernel
from quell.kernels.sized import Work
from quell.realtime.supervisor import (
    AxesLimits,
    Cause,
    Memory,
    Mode,
    SupervisorState,
    begin_watch,
    change_mode,
    choose_mode,
    is_opposed,
    runs_away,
    widen_rest,
)
from quell.types import Vector

# ---- What the loop tells several axes ----


def transfer_axis(axis: Any, state: Any, i: int) -> None:
    """Continue an axis from what was applied, as if it had been at rest until now."""
    bumpless_transfer(axis, state)


transfer_axes = for_each("transfer_axes", transfer_axis)


@kernel
def set_applied_controls(design: AxesDesign, state: AxesState, u: Vector) -> None:
    """Set the control signals that were applied since the last sample (m,)."""
    for k in range(u.size):
        state.u[k] = u[k]
    tell_applied(design, state)


@bumpless_transfer.register(AxesDesign)
def _bumpless_transfer(design: AxesDesign, state: AxesState) -> None:
    transfer_axes(design.axes, state.axes)


# ---- The supervisor ----


class AxesMemory(NamedTuple):
    """The signals of several axes from one cycle to the next; make it with ``axes_memory``."""

    y: Vector  #: as measured in this sample; NaN for what has not come (n,)
    good: Vector  #: last good measurements (n,)
    measured: Vector  #: what the controller gets: NaN in a sample that was skipped (n,)
    r: Vector  #: references of this sample (n,)
    f_hat: Vector  #: estimates after it; zero without (n,)
    offset: Vector  #: distances from the references to y at the scenario's first sample (n,)
    wished: Vector  #: the controller's u (m,)
    u: Vector  #: as applied (m,)
    acting: Vector  #: what acts at a device with a clock of its own (m,)
    next: Work  #: u of this sample, before it is applied (m,)
    ramp_start: Vector  #: u at the beginning of the ramp (m,)
    at_limit: NDArray[np.int64]  #: samples in a row with u at a limit (m,)
    watched: NDArray[Memory]
    """Of each axis what its first motion is judged by; its u is v, the share of all u (n,)."""


def axes_memory(outputs: int, inputs: int) -> AxesMemory:
    """Return the memory before the first cycle."""
    watched = np.zeros(outputs, Memory.zeros().dtype)
    for each in watched:
        each.y_rest_low, each.y_rest_high = np.inf, -np.inf
    return AxesMemory(
        y=np.full(outputs, np.nan),
        good=np.full(outputs, np.nan),
        measured=np.full(outputs, np.nan),
        r=np.zeros(outputs),
        f_hat=np.zeros(outputs),
        offset=np.zeros(outputs),
        wished=np.zeros(inputs),
        u=np.zeros(inputs),
        acting=np.zeros(inputs),
        next=np.zeros(inputs),
        ramp_start=np.zeros(inputs),
        at_limit=np.zeros(inputs, dtype=np.int64),
        watched=watched,
    )


class MotionRules(NamedTuple):
    """The rules of ``runs_away`` for one axis, as ``Rules`` has them."""

    low: float
    high: float
    direction: float
    reach: float


@kernel
def update_axes_mode(
    rules: AxesLimits, state: SupervisorState, axes: AxesMemory, k: int, samples: int
) -> None:
    """Choose the mode of cycle ``k`` before the controller's step; see ``update_mode``."""
    memory, count = state.memory[0], axes.y.size
    settling = memory.mode == Mode.START
    missing, last, outside = 0, 0, 0
    for i in range(count):
        if is_finite(axes.y[i]):
            axes.good[i] = axes.y[i]
        else:
            missing, last = missing + 1, i + 1
        if outside == 0 and (axes.good[i] < rules.y_low[i] or axes.good[i] > rules.y_high[i]):
            outside = i + 1
    memory.culprit = 0 if missing == count else last
    choose_mode(rules, state, k, missing == 0, outside, samples)
    memory.culprit = 0
    memory.y = axes.good[0]
    if settling and memory.mode == Mode.RUN:
        for c in range(axes.at_limit.size):
            axes.at_limit[c] = 0
        for i in range(count):
            begin_watch(axes.watched[i], axes.y[i], rules.direction[i])
    elif settling and missing == 0 and memory.mode == Mode.START:
        for i in range(count):
            widen_rest(axes.watched[i], axes.y[i])


@kernel
def all_measured(axes: AxesMemory) -> bool:
    """Return whether each measurement has come once."""
    missing = 0
    for i in range(axes.good.size):
        missing += 0 if is_finite(axes.good[i]) else 1
    return missing == 0


@kernel
def supervise_outputs(rules: AxesLimits, state: SupervisorState, axes: AxesMemory, k: int) -> None:
    """Write the u to apply in cycle ``k``; in RUN, end the run if a limit is exceeded.

    See ``supervised_output``.
    """
    memory, u = state.memory[0], axes.next
    for c in range(u.size):
        u[c] = axes.u[c] if memory.mode == Mode.HOLD else 0.0
    if memory.mode == Mode.RUN:
        _oppose(rules, axes)
        _limit(rules, axes)
        _end_by_limits(rules, state, axes, k)
    if memory.mode == Mode.RAMP:
        _ramp(rules, state, axes, k)
    elif memory.mode == Mode.STOPPED:
        memory.samples += 1
    for c in range(u.size):
        axes.u[c] = u[c]
    memory.u = u[0]


@kernel
def _oppose(rules: AxesLimits, axes: AxesMemory) -> None:
    """Update the scores of the checks of B0, as ``is_opposed`` does."""
    at_limit = False
    for c in range(axes.at_limit.size):
        at_limit |= axes.at_limit[c] > 0
    for i in range(axes.watched.size):
        watched = axes.watched[i]
        most, push = rules.most_opposed[i], rules.push[i]
        is_opposed(watched, most, watched.u, axes.f_hat[i], push, at_limit)


@kernel
def _limit(rules: AxesLimits, axes: AxesMemory) -> None:
    """Write the controller's u within the limits, and count the samples at one."""
    for c in range(axes.next.size):
        u = min(max(axes.wished[c], rules.low[c]), rules.high[c])
        axes.next[c] = u
        at_limit = u == rules.low[c] or u == rules.high[c]
        axes.at_limit[c] = axes.at_limit[c] + 1 if at_limit else 0


@kernel
def _end_by_limits(rules: AxesLimits, state: SupervisorState, axes: AxesMemory, k: int) -> None:
    """Change the mode to RAMP if a limit is exceeded, and keep the signal that did."""
    memory, cause, culprit = state.memory[0], Cause.NONE, 0
    for i in range(axes.watched.size):  # the later ones of these rules go first
        watched = axes.watched[i]
        watched.y = axes.good[i]
        own = MotionRules(-rules.push[i], rules.push[i], rules.direction[i], rules.reach[i])
        against = runs_away(own, watched, axes.r[i])
        if against or watched.opposed > rules.most_opposed[i]:
            cause, culprit = Cause.WRONG_WAY, i + 1
    for c in range(axes.u.size):
        if axes.at_limit[c] > rules.most_saturated:
            cause, culprit = Cause.SATURATED, c + 1
    for i in range(axes.watched.size):
        if not abs(axes.f_hat[i]) <= rules.most_f[i]:
            cause, culprit = Cause.F_HAT, i + 1
    for i in range(axes.watched.size):
        if not abs(axes.r[i] - axes.good[i]) <= rules.most_error[i]:
            cause, culprit = Cause.TRACKING_ERROR, i + 1
    for c in range(axes.u.size):
        if not is_finite(axes.wished[c]):
            cause, culprit = Cause.NOT_A_NUMBER, c + 1
    if cause != Cause.NONE:
        memory.culprit = culprit
        change_mode(state, k, Mode.RAMP, cause)


@kernel
def _ramp(rules: AxesLimits, state: SupervisorState, axes: AxesMemory, k: int) -> None:
    """Write the u of a sample of the ramp."""
    memory = state.memory[0]
    if memory.samples == 0:
        for c in range(axes.u.size):
            axes.ramp_start[c] = axes.u[c]
    memory.samples += 1
    left, most = rules.ramp - memory.samples, 0.0
    for c in range(axes.u.size):
        axes.next[c] = axes.ramp_start[c] * left / rules.ramp
        most = max(most, abs(axes.ramp_start[c]))
    if left <= 0 or most == 0.0:
        for c in range(axes.u.size):
            axes.next[c] = 0.0
        change_mode(state, k, Mode.STOPPED, Cause.RAMPED)
