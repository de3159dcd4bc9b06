"""The law of ADRC, sample by sample: what the observer is told, what the learner adds, what is applied.

    u_0 = k_1 (r − x̂_1) + k_2 (r' − x̂_2) + … + k_m (r^(m−1) − x̂_m) + r^(m),      k_i = C(m, i−1) omega_c^(m−i+1)
    u   = sat( (u_0 − f_L − Δf̂ + a·x̂) / b0 )

(Gao, ACC 2003; paper eq. (control), with the term ``a·x̂`` that the paper forgets.) The derivatives of r are zero where none are given; m
is the relative degree from u to y, the plant's order unless it has zeros. With ``f_L = h + s u`` affine in u the loop through u is solved
instead of closed a sample late: ``u = sat( (u_0 − h − Δf̂ + a·x̂) / (b0 + s) )``. Where u reaches the plant with a delay, learner, guard
and observer are told of the u that *acts* (``observers.base.acting_control``): ``f_L = h + s u_acting``. The law is the same then, for when the u
it finds acts, f will have ``s u`` in it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.bad_samples import control_at_rest, hold_last_good
from quell.controllers.base import (
    bumpless_transfer,
    control,
    reset_loop,
    set_applied_control,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.limits import Limits, apply_limits
from quell.guard import assess, limit, record_output, reset_filters, write_channels
from quell.kernels.dispatch import is_finite, kernel
from quell.learners.base import adapt, coefficients, commit, predict, restart, trouble
from quell.learners.lag import lag_push
from quell.observers.base import acting_control, begin, expected_measurement, observe
from quell.types import Matrix, Status, Vector

_MEASUREMENT_HELD = int(Status.MEASUREMENT_HELD)
_OVERFLOWED = int(Status.OVERFLOWED)
_LEARNER_CUT = int(Status.LEARNER_CUT)

_NOTHING = 1e-200

LOOP = 15
"""Length of ``AdrcState.loop``, whose places are:"""
(
    U,  # applied
    F_LEARNED,  # f_L, as the observer is told
    _F_SHOWN,  # what Δf̂ will show of it
    R,  # last good reference
    Y,  # last measurement, or what was expected in the place of one
    STARTED,  # whether there was one
    REFERENCED,  # whether there was a reference
    STATUS,  # of the last sample
    CONSTANT,  # h of f_L = h + s u
    SLOPE,  # s
    WISHED,  # what the law would apply, limits included
    MANUAL,  # whether somebody else applies u, and it is
    MANUAL_U,
    BUMPLESS,  # whether the next u is to go on from this one
    OFFSET,  # what is still added for that
) = range(LOOP)


class AdrcDesign(NamedTuple):
    """Parameters of the controller, for a plant of order n; N = n + 1."""

    eso: Any
    """The observer's model, see ``observers.base``."""
    law: Vector
    """k (n,); zero from the relative degree on."""
    cancel: Vector
    """a (n,)."""
    cancel_f: float
    """1 where f enters as u does, else 0."""
    fade: float
    """What is left a sample later of an offset that avoids a bump."""
    b0: float
    limits: Limits
    learner: Any
    lag: Any
    """How f_L shows in Δf̂; without taps where there is no learner."""
    guard: Any


class AdrcState(NamedTuple):
    """State of the controller."""

    z: Vector
    """The observer's."""
    seen: Vector
    """What the law may know of it (N,)."""
    reference: Vector
    """r', …, r^(m) (m,), zero where they are not given; empty where they are not fed forward."""
    loop: Vector
    """(LOOP,)."""
    learner: Any
    shadow: Matrix
    """The lag filter of f_L (1, …)."""
    guard: Any


@control.register(AdrcDesign)
def _control(design: AdrcDesign, state: AdrcState, r: float, y: float) -> float:
    loop, seen = state.loop, state.seen
    status = hold_last_good(loop, R, r, y)
    f_plain = 0.0
    acted = acting_control(design.eso, state.z, loop[U])
    if loop[STARTED] == 0.0:
        begin(design.eso, state.z, seen, loop[Y])
        if status & _MEASUREMENT_HELD != 0:
            loop[WISHED] = control_at_rest(design.limits)
            loop[U] = loop[WISHED] if loop[MANUAL] == 0.0 else loop[MANUAL_U]
            loop[STATUS] = status
            return loop[U]
        loop[STARTED] = 1.0
    else:
        _conclude(design, state, acted)
        if status & _MEASUREMENT_HELD != 0:
            # A y that stands still while the plant moves would be taken for a blow; the expected one tells the observer nothing.
            y = expected_measurement(design.eso, state.z, loop[U], loop[F_LEARNED])
            if is_finite(y):
                loop[Y] = y
        observe(design.eso, state.z, seen, loop[Y], loop[U], loop[F_LEARNED])
        f_plain = seen[seen.size - 1] + loop[_F_SHOWN]
        assess(design.guard, state.guard, f_plain)
        if status & _MEASUREMENT_HELD == 0:
            adapt(design.learner, state.learner, seen, loop[Y], acted, f_plain)
            status |= trouble(design.learner, state.learner)
    constant, slope = predict(design.learner, state.learner, seen, acted)
    constant, slope, cut_off = limit(design.guard, state.guard, f_plain, constant, slope, acted)
    if cut_off:
        status |= _LEARNER_CUT
        restart(design.learner, state.learner)
    wished = unlimited_u(design, state, constant, slope)
    if not is_finite(wished):
        status |= _OVERFLOWED
        restart(design.learner, state.learner)
        reset_lag_filters(design, state)
        begin(design.eso, state.z, seen, loop[Y])
        constant = slope = loop[OFFSET] = 0.0
        wished = loop[U]
    if loop[BUMPLESS] != 0.0:
        loop[OFFSET] = loop[U] - wished
        loop[BUMPLESS] = 0.0
    if loop[OFFSET] != 0.0:
        wished += loop[OFFSET]
        # Numbers near the end of the range are slow to calculate with.
        loop[OFFSET] = loop[OFFSET] * design.fade if abs(loop[OFFSET]) > _NOTHING else 0.0
    u, cut = apply_limits(design.limits, wished, loop[U])
    loop[WISHED] = u
    if loop[MANUAL] == 0.0:
        status |= cut
    else:
        u = loop[MANUAL_U]
    loop[U] = u
    loop[CONSTANT], loop[SLOPE] = constant, slope
    loop[F_LEARNED] = constant + slope * acting_control(design.eso, state.z, u)
    loop[STATUS] = status
    return u


@kernel
def _conclude(design: AdrcDesign, state: AdrcState, acted: float) -> None:
    """Take note of the u that acted since the last sample: only now it is sure that nobody has corrected it."""
    loop = state.loop
    f_learned = loop[CONSTANT] + loop[SLOPE] * acted
    loop[F_LEARNED] = f_learned
    loop[_F_SHOWN] = lag_push(design.lag, state.shadow, 0, f_learned)
    commit(design.learner, state.learner, state.seen, acted, f_learned)
    record_output(design.guard, state.guard, f_learned)


@kernel
def reset_lag_filters(design: AdrcDesign, state: AdrcState) -> None:
    """Empty the filter of f_L, and the guard's."""
    reset_filters(design.guard, state.guard)
    state.loop[_F_SHOWN] = 0.0
    for i in range(state.shadow.shape[1]):
        state.shadow[0, i] = 0.0


@kernel
def unlimited_u(design: AdrcDesign, state: AdrcState, constant: float, slope: float) -> float:
    """Return the u that the law wants, before limits, for ``f_L = constant + slope · u``."""
    seen, reference, order = state.seen, state.reference, design.law.size
    wished = design.law[0] * state.loop[R] - design.cancel_f * (seen[order] + constant)
    if reference.size > 0:
        for i in range(1, reference.size):
            wished += design.law[i] * reference[i - 1]
        wished += reference[reference.size - 1]
    for i in range(order):
        wished += (design.cancel[i] - design.law[i]) * seen[i]
    return wished / (design.b0 + design.cancel_f * slope)


@set_reference_derivatives.register(AdrcDesign)
def _set_reference_derivatives(design: AdrcDesign, state: AdrcState, derivatives: Vector) -> None:
    for i in range(state.reference.size):
        known = i < derivatives.size and is_finite(derivatives[i])
        state.reference[i] = derivatives[i] if known else 0.0


@write_row.register(AdrcDesign)
def _write_row(design: AdrcDesign, state: AdrcState, row: Vector) -> None:
    order = design.law.size
    for i in range(order + 1):
        row[i] = state.seen[i]
    row[order + 1] = state.loop[F_LEARNED]
    row[order + 2] = state.loop[STATUS]
    told = write_channels(design.guard, state.guard, row[order + 3 :])
    coefficients(design.learner, state.learner, row[order + 3 + told :])


@status_flags.register(AdrcDesign)
def _status_flags(design: AdrcDesign, state: AdrcState) -> int:
    return int(state.loop[STATUS])


@reset_loop.register(AdrcDesign)
def _reset_loop(design: AdrcDesign, state: AdrcState) -> None:
    for i in range(state.loop.size):
        state.loop[i] = 0.0
    for i in range(state.reference.size):
        state.reference[i] = 0.0
    reset_lag_filters(design, state)
    restart(design.learner, state.learner)


@set_applied_control.register(AdrcDesign)
def _set_applied_control(design: AdrcDesign, state: AdrcState, u: float) -> None:
    state.loop[U] = u


@bumpless_transfer.register(AdrcDesign)
def _bumpless_transfer(design: AdrcDesign, state: AdrcState) -> None:
    loop = state.loop
    if loop[STARTED] != 0.0:
        # Without this offset the law, whose reference is where y is, would already have applied something else.
        loop[OFFSET] = loop[U] - unlimited_u(design, state, loop[CONSTANT], loop[SLOPE])


def law_gains(order: int, omega_c: float) -> Vector:
    """Return ``k_i = C(n, i−1) omega_c^(n−i+1)``, i = 1 … n: all poles of ``s^n + k_n s^(n−1) + … + k_1`` lie at −omega_c."""
    with np.errstate(over="ignore"):
        gains = np.array(
            [math.comb(order, i) * np.float64(omega_c) ** (order - i) for i in range(order)]
        )
    if not np.all(np.isfinite(gains)):
        raise ValueError(
            f"omega_c = {omega_c!r} rad/s: its power {order} must be a number; lower omega_c"
        )
    return gains
