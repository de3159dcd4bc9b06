"""The control law of ADRC, sample by sample: observer, learner, guard, law and limits.

    u_0 = k_1 (r − x̂_1) + k_2 (r' − x̂_2) + … + k_m (r^(m−1) − x̂_m) + r^(m),
    u   = sat( (u_0 − f_L − Δf̂ + a·x̂) / b0 ),        k_i = C(m, i−1) omega_c^(m−i+1)

(Gao, ACC 2003; paper eq. (control), which lacks the term ``a·x̂``.) Derivatives of r are zero
unless they are given; m is the relative degree from u to y, which is the plant's order unless it
has zeros. A model's feedforward takes the place of ``r^(m)/b0`` (``feedforward.py``): the share f_m
of f that it knows is fed to the observer beside f_L.

The learner's ``f_L = h + s u`` is affine in u, so the loop through u is solved exactly, without a
delay of one sample: ``u = sat( (u_0 − h − Δf̂ + a·x̂) / (b0 + s) )``.

If u reaches the plant with a delay, learner, guard and observer receive the u that *acts*
(``observers.base.acting_control``): ``f_L = h + s u_acting``. The law does not change, because f
contains ``s u`` when the u of this sample acts.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers.adrc.feedback import nonlinear_part
from quell.controllers.adrc.feedforward_law import known_share, reference_part, write_feedforward
from quell.controllers.bad_samples import hold_last_good, is_usable, is_usable_control
from quell.controllers.base import (
    bumpless_transfer,
    control,
    reset_loop,
    set_applied_control,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.limits import Limits, apply_limits, control_at_rest, largest_magnitude
from quell.guard import (
    assess,
    confine,
    limit,
    record_output,
    reset_filters,
    start_again,
    write_channels,
)
from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single
from quell.kernels.scalars import Scalars, clear
from quell.kernels.sized import Flag
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    forget,
    predict,
    restart,
    trouble,
)
from quell.learners.lag import lag_push, reset_lag
from quell.learners.recovery import (
    LearnerWatch,
    does_harm,
    has_escaped,
    has_lost_range,
    is_excessive,
    is_in_proportion,
)
from quell.lti.pole_pattern import pole_pattern
from quell.observers.base import acting_control, begin, expected_measurement, observe
from quell.types import Matrix, Status, Vector

_MEASUREMENT_HELD = int(Status.MEASUREMENT_HELD)
_OVERFLOWED = int(Status.OVERFLOWED)
_LEARNER_CUT = int(Status.LEARNER_CUT)

# A decaying offset below this is set to zero: arithmetic with denormal numbers (below 2.2e-308) is
# slow. Any value between that and the rounding error of u gives the same u. In single precision
# such numbers are below 1.2e-38.
_SMALLEST_OFFSET, _SMALLEST_OFFSET_SINGLE = 1e-200, 1e-30
# An offset so many times the limits of u comes from absurd estimates, which return faster than it
# decays: there is nothing to continue from. It would decay to the limits in 7/omega_c.
_LARGEST_OFFSET = 2.0**10


class AdrcLoop(Scalars):
    """Scalars of the control loop, kept from one sample to the next."""

    u: float  # applied control signal
    f_learned: float  # f_L, as the observer receives it
    f_known: float  # f_m, what the model of the feedforward knows of f in this sample
    f_learned_shown: float  # f_L^F: the share of f_L that Δf̂ lacks at the next sample
    r: float  # last finite reference
    y: float  # last finite measurement, or the one that the observer expected
    started: float  # 1 after the first finite measurement, else 0
    has_reference: float  # 1 after the first finite reference, else 0
    status: float  # status flags of the last sample
    constant: float  # h of f_L = h + s u
    slope: float  # s of f_L = h + s u
    u_limited: float  # control signal of the law after limits; differs from u in manual operation
    manual: float  # 1 in manual operation, else 0
    u_manual: float  # control signal of manual operation
    bumpless: float  # 1 if the next u is to continue from the last one, else 0
    offset: float  # decaying term that is added to u after a bumpless transfer


class AdrcDesign(NamedTuple):
    """Parameters of the controller, for a plant of order n and an observer of m extended states."""

    eso: Any  # parameters of the observer, see ``observers.base``
    law: Vector  # k (n,); zero from the relative degree on
    cancel: Vector  # a (n,)
    cancel_f: float  # 1 if f enters where u enters, else 0
    feedback: Any  # linear or nonlinear law of the errors, see ``feedback``
    feedforward: Any  # with or without a model, see ``feedforward``
    fade: float  # factor of the offset from one sample to the next
    b0: float
    limits: Limits
    learner: Any
    lag: Any  # lag filter of f_L; without taps if there is no learner
    guard: Any
    learns: Flag  # whether there is a learner
    forgets: Flag  # whether it forgets what does harm
    window: int  # samples of the windows in which it is watched


class AdrcState(NamedTuple):
    """State of the controller."""

    z: Vector  # state of the observer
    seen: Vector  # estimates (x̂_1 … x̂_n, Δf̂, Δf̂', …) of the observer (n + m,)
    reference: Vector  # r', r'', … as used, zero if they are not given; empty without feedforward
    loop: NDArray[AdrcLoop]  # (1,)
    learner: Any
    shadow: Matrix  # lag filter of f_L (1, …)
    guard: Any
    watch: NDArray[LearnerWatch]  # (1,)


@control.register(AdrcDesign)
def _control(design: AdrcDesign, state: AdrcState, r: float, y: float) -> float:
    loop, seen = state.loop[0], state.seen
    status = hold_last_good(loop, r, y)
    f_plain = 0.0
    u_acting = acting_control(design.eso, state.z, loop.u)
    if loop.started == 0.0:
        begin(design.eso, state.z, seen, loop.y)
        if status & _MEASUREMENT_HELD != 0:
            loop.u_limited = control_at_rest(design.limits)
            loop.u = loop.u_limited if loop.manual == 0.0 else loop.u_manual
            loop.status = status
            return loop.u
        loop.started = 1.0
    else:
        _finish_sample(design, state, u_acting)
        if status & _MEASUREMENT_HELD != 0:
            # The last y would look like a disturbance while the plant moves; the expected y does
            # not change the estimates.
            y = expected_measurement(design.eso, state.z, loop.u, loop.f_learned + loop.f_known)
            if is_usable(y):
                loop.y = y
        observe(design.eso, state.z, seen, loop.y, loop.u, loop.f_learned + loop.f_known)
        f_plain = seen[design.law.size] + loop.f_learned_shown
        assess(design.guard, state.guard, f_plain)
        if status & _MEASUREMENT_HELD == 0:
            adapt(design.learner, state.learner, seen, loop.y, u_acting, f_plain)
            status |= trouble(design.learner, state.learner)
    loop.f_known = known_share(design.feedforward, loop.r, state.reference)
    constant, slope = predict(design.learner, state.learner, seen, u_acting)
    output = constant + slope * u_acting
    constant, slope, was_cut = limit(
        design.guard, state.guard, f_plain, loop.f_learned_shown, constant, slope, u_acting
    )
    if was_cut:
        status |= _LEARNER_CUT
        restart(design.learner, state.learner)
    unlimited = unlimited_control(design, state, constant, slope)
    if slope != 0.0:
        # The guard's bound holds for the new u, too: beyond it the output counts as a constant.
        f_learned = constant + slope * acting_control(design.eso, state.z, unlimited)
        permitted = confine(design.guard, state.guard, f_learned)
        if permitted != f_learned:
            constant, slope = permitted, 0.0
            unlimited = unlimited_control(design, state, constant, slope)
    if not is_usable_control(design.limits, unlimited):
        status |= _OVERFLOWED
        # Else a finite θ that is out of all proportion overflows again in the next sample.
        _forget_learning(design, state)
        clear(state.watch)
        begin(design.eso, state.z, seen, loop.y)
        constant = slope = loop.offset = 0.0
        unlimited = loop.u
    smallest = _SMALLEST_OFFSET_SINGLE if is_single(design.b0) else _SMALLEST_OFFSET
    if loop.bumpless != 0.0:
        loop.offset = loop.u - unlimited
        loop.bumpless = 0.0
    if loop.offset != 0.0:
        if not abs(loop.offset) <= _LARGEST_OFFSET * largest_magnitude(design.limits):
            loop.offset = 0.0
        unlimited += loop.offset
        loop.offset = loop.offset * design.fade if abs(loop.offset) > smallest else 0.0
    u, cut = apply_limits(design.limits, unlimited, loop.u)
    loop.u_limited = u
    if loop.manual == 0.0:
        status |= cut
    else:
        u = loop.u_manual
    loop.u = u
    loop.constant, loop.slope = constant, slope
    loop.f_learned = constant + slope * acting_control(design.eso, state.z, u)
    if design.learns and status & _MEASUREMENT_HELD == 0:
        excessive = is_excessive(unlimited, u, smallest)
        limited, watch = cut != 0 and loop.manual == 0.0, state.watch[0]
        lost = has_escaped(watch, output, excessive) or has_lost_range(
            watch, design.window, loop.y, f_plain, output, excessive, limited
        )
        if design.forgets and does_harm(watch, design.window, seen[design.law.size], f_plain):
            lost = True
        if lost:
            status |= _OVERFLOWED
            _start_learning_again(design, state)
    loop.status = status
    return u


@kernel
def _start_learning_again(design: AdrcDesign, state: AdrcState) -> None:
    """Forget what was learned; the observer's estimate takes over what was fed forward.

    If that was out of all proportion, the whole estimate is useless, and the observer begins at y.
    """
    loop, order = state.loop[0], design.law.size
    if is_in_proportion(state.watch[0], loop.f_learned_shown):
        state.z[order] += loop.f_learned_shown
        state.seen[order] += loop.f_learned_shown
    else:
        begin(design.eso, state.z, state.seen, loop.y)
    loop.constant = loop.slope = loop.f_learned = 0.0
    _forget_learning(design, state)


@kernel
def _forget_learning(design: AdrcDesign, state: AdrcState) -> None:
    """Return learner, guard and the lag filter of f_L to their states before the first sample."""
    reset_lag_filters(design, state)
    start_again(design.guard, state.guard)
    forget(design.learner, state.learner)


@kernel
def _finish_sample(design: AdrcDesign, state: AdrcState, u_acting: float) -> None:
    """Update what depends on the u that acted since the last sample.

    This is done one sample later because ``set_applied_control`` may have corrected u meanwhile.
    """
    loop = state.loop[0]
    f_learned = loop.constant + loop.slope * u_acting
    if loop.slope != 0.0:
        f_learned = confine(design.guard, state.guard, f_learned)
    loop.f_learned = f_learned
    loop.f_learned_shown = lag_push(design.lag, state.shadow, 0, f_learned)
    commit(design.learner, state.learner, state.seen, u_acting, f_learned)
    record_output(design.guard, state.guard, f_learned)


@kernel
def reset_lag_filters(design: AdrcDesign, state: AdrcState) -> None:
    """Set the lag filters of f_L and of the guard to zero."""
    reset_filters(design.guard, state.guard)
    state.loop[0].f_learned_shown = 0.0
    reset_lag(state.shadow)


@kernel
def unlimited_control(design: AdrcDesign, state: AdrcState, constant: float, slope: float) -> float:
    """Return the control signal before limits for ``f_L = constant + slope · u``."""
    seen, reference, order = state.seen, state.reference, design.law.size
    r = state.loop[0].r
    unlimited = reference_part(design.feedforward, design.law, r, reference)
    for i in range(order):
        unlimited += (design.cancel[i] - design.law[i]) * seen[i]
    unlimited -= design.cancel_f * (seen[order] + constant)
    unlimited = nonlinear_part(design.feedback, design.law, seen, r, reference, unlimited)
    return unlimited / (design.b0 + design.cancel_f * slope)


@set_reference_derivatives.register(AdrcDesign)
def _set_reference_derivatives(design: AdrcDesign, state: AdrcState, derivatives: Vector) -> None:
    for i in range(state.reference.size):
        state.reference[i] = derivatives[i] if i < derivatives.size else 0.0
        if not is_usable(state.reference[i]):
            state.reference[i] = 0.0


@write_row.register(AdrcDesign)
def _write_row(design: AdrcDesign, state: AdrcState, row: Vector) -> None:
    order = design.law.size
    for i in range(order + 1):
        row[i] = state.seen[i]
    row[order + 1] = state.loop[0].f_learned
    row[order + 2] = state.loop[0].status
    after = state.seen.size + 2
    for i in range(order + 1, state.seen.size):
        row[i + 2] = state.seen[i]
    r, reference = state.loop[0].r, state.reference
    forward = write_feedforward(design.feedforward, r, reference, row[after:])
    written = write_channels(design.guard, state.guard, row[after + forward :])
    coefficients(design.learner, state.learner, row[after + forward + written :])


@status_flags.register(AdrcDesign)
def _status_flags(design: AdrcDesign, state: AdrcState) -> int:
    return int(state.loop[0].status)


@reset_loop.register(AdrcDesign)
def _reset_loop(design: AdrcDesign, state: AdrcState) -> None:
    clear(state.loop)
    for i in range(state.reference.size):
        state.reference[i] = 0.0
    reset_lag_filters(design, state)
    restart(design.learner, state.learner)


@set_applied_control.register(AdrcDesign)
def _set_applied_control(design: AdrcDesign, state: AdrcState, u: float) -> None:
    state.loop[0].u = u


@bumpless_transfer.register(AdrcDesign)
def _bumpless_transfer(design: AdrcDesign, state: AdrcState) -> None:
    loop = state.loop[0]
    if loop.started != 0.0:
        # u continues from the applied value although the law gives another one.
        loop.offset = loop.u - unlimited_control(design, state, loop.constant, loop.slope)


def law_gains(order: int, omega_c: float, poles: Any = None) -> Vector:
    """Return the gains (n,) of order n: the coefficients of ``s^n + k_n s^(n−1) + … + k_1``.

    By default all its roots lie at −omega_c, ``k_i = C(n, i−1) omega_c^(n−i+1)``; ``poles`` are
    others, in units of omega_c (``quell.lti.pole_pattern``).
    """
    weights = np.array([float(math.comb(order, i)) for i in range(order)])
    if poles is not None:
        pattern = pole_pattern("law_poles", poles, order)
        weights = np.real(np.poly(pattern))[:0:-1]
    with np.errstate(over="ignore"):
        powers = [np.float64(omega_c) ** (order - i) for i in range(order)]
        gains = np.array([weight * power for weight, power in zip(weights, powers, strict=True)])
    if not np.all(np.isfinite(gains)):
        raise ValueError(f"omega_c = {omega_c!r} rad/s: its power {order} must be finite; lower it")
    return gains
