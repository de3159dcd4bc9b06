"""The control law of ADRC, sample by sample: observer, learner, guard, law and limits.

    u_0 = k_1 (r − x̂_1) + k_2 (r' − x̂_2) + … + k_m (r^(m−1) − x̂_m) + r^(m),
    u   = sat( (u_0 − f_L − Δf̂ + a·x̂) / b0 ),        k_i = C(m, i−1) omega_c^(m−i+1)

(Gao, ACC 2003; paper eq. (control), which lacks the term ``a·x̂``.) Derivatives of r are zero
unless they are given; m is the relative degree from u to y, which is the plant's order unless it
has zeros. A model's feedforward takes the place of ``r^(m)/b0`` (``controllers/feedforward.py``):
the share f_m of f that it knows is fed to the observer beside f_L.

The learner's ``f_L = h + s u`` is affine in u, so the loop through u is solved exactly, without a
delay of one sample: ``u = sat( (u_0 − h − Δf̂ + a·x̂) / (b0 + s) )``.

If u reaches the plant with a delay, learner, guard and observer receive the u that *acts*
(``observers.base.acting_control``): ``f_L = h + s u_acting``. The law does not change, because f
contains ``s u`` when the u of this sample acts.

The feedforward's part of the control law, sample by sample; see ``controllers/feedforward.py``.

Han's nonlinear feedback of the errors in place of their weighted sum.

Han ("From PID to active disturbance rejection control", *IEEE Trans. Industrial Electronics* 56,
2009, on the nonlinear feedback combination) replaces ``u_0 = Σ k_i e_i`` with ``e_1 = r − x̂_1``,
``e_2 = r' − x̂_2``, … by::

    u_0 = Σ β_i fal(e_i, α_i, δ_i)
    fal(e, α, δ) = e / δ^(1−α) for |e| ≤ δ,  |e|^α sign e beyond

usually with ``0 < α_1 < 1 < α_2``: for the same u at an error of one, small errors get more,
and large errors less. Here ``β_i = k_i δ_i^(1−α_i)``, so that within ±δ_i the law
is the linear one with all poles at −omega_c, and continuous at ±δ_i; with α = 1 it is linear
everywhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import (
    Limits,
    apply_limits,
    bumpless_transfer,
    control,
    control_at_rest,
    hold_last_good,
    is_usable,
    is_usable_control,
    largest_magnitude,
    reset_loop,
    set_applied_control,
    set_held,
    set_reference_derivatives,
    set_schedule_signals,
    status_flags,
    write_row,
)
from quell.controllers.held import (
    f_before,
    follow,
    held_flag,
    is_released,
    look_anew,
    miss,
    take_motion,
)
from quell.controllers.safe_set import (
    flags_of_applied,
    forget_motion,
    nearest_safe,
    see,
    set_motion,
)
from quell.controllers.schedule import (
    at_nominal,
    at_present,
    control_as_observed,
    control_at_nominal,
    fixed_control,
    follow_signals,
    forget_signals,
    gain_in_use,
    known_of_model,
    known_with_schedule,
    safe_as_applied,
    scheduled_correction,
    scheduled_law,
    set_signals,
    show_at_nominal,
    show_at_present,
    show_feedforward,
)
from quell.guard import (
    assess,
    limit,
    nearest_permitted,
    record_output,
    reset_filters,
    start_again,
    write_channels,
)
from quell.kernels.dispatch import generic_with_default, kernel
from quell.kernels.functions import is_single
from quell.kernels.sized import Flag, Scalars, clear
from quell.learners.base import (
    LearnerWatch,
    adapt,
    coefficients,
    commit,
    does_harm,
    forget,
    has_escaped,
    has_lost_range,
    is_excessive,
    is_in_proportion,
    lag_push,
    learner_flags,
    predict,
    reset_lag,
    restart,
)
from quell.lti.models import pole_pattern
from quell.observers.forms import (
    acting_control,
    begin,
    begin_with,
    expected_measurement,
    fal,
    observe,
)
from quell.types import Matrix, Status, Vector

# ---- The feedforward's part of the control law, sample by sample ----


class ReferenceOnly(NamedTuple):
    """The law with ``r^(n)/b0`` in place of a model's feedforward, or without derivatives."""


class ModelFeedforward(NamedTuple):
    """Parameters of the feedforward by a model, with m derivatives of the reference."""

    control: Vector  # c (m + 1,): u_ff from r, r', …, at the time when u acts
    wish: Vector  # (m + 1,): of r^(n) − D r in the numerator of the law, from r, r', …
    share: Vector  # (m + 1,): f_m from r, r', …
    b0: float
    coulomb: float
    full_speed: float  # |r'| from which Coulomb friction is whole
    constant: float
    lead: float  # time from now until u acts [s]
    lead_acting: float  # the same from the u that the observer receives in this sample


class ControlGiven(NamedTuple):
    """A control signal u_0 from elsewhere in the place of a law: the reference is u_0."""

    b0: float


@generic_with_default
def reference_part(feedforward: Any, law: Vector, r: float, reference: Vector) -> float:
    """Return what the numerator of the law takes from the reference and its derivatives."""
    total = law[0] * r
    if reference.size > 0:
        for i in range(1, reference.size):
            total += law[i] * reference[i - 1]
        total += reference[reference.size - 1]
    return total


@reference_part.register(ControlGiven)
def _given(feedforward: ControlGiven, law: Vector, r: float, reference: Vector) -> float:
    return feedforward.b0 * r


@generic_with_default
def has_reference_at_start(feedforward: Any) -> float:
    """Return 1 if the reference is zero before the first usable one, 0 if it is the last y."""
    return 0.0


@has_reference_at_start.register(ControlGiven)
def _zero_at_start(feedforward: ControlGiven) -> float:
    return 1.0


@reference_part.register(ModelFeedforward)
def _by_model(feedforward: ModelFeedforward, law: Vector, r: float, reference: Vector) -> float:
    total = law[0] * r
    for i in range(1, law.size):
        if i <= reference.size:
            total += law[i] * reference[i - 1]
    control = control_by_model(feedforward, r, reference)
    return total + _series(feedforward.wish, r, reference) + feedforward.b0 * control


@generic_with_default
def known_share(feedforward: Any, r: float, reference: Vector) -> float:
    """Return f_m: the part of f that the model knows for the sample that begins."""
    return 0.0


@known_share.register(ModelFeedforward)
def _share_of_model(feedforward: ModelFeedforward, r: float, reference: Vector) -> float:
    force = _force(feedforward, reference, feedforward.lead_acting)
    return _series(feedforward.share, r, reference) - feedforward.b0 * force


@generic_with_default
def control_by_model(feedforward: Any, r: float, reference: Vector) -> float:
    """Return u_ff."""
    return 0.0


@control_by_model.register(ModelFeedforward)
def _control_by_model(feedforward: ModelFeedforward, r: float, reference: Vector) -> float:
    force = _force(feedforward, reference, feedforward.lead)
    return _series(feedforward.control, r, reference) + force


@fixed_control.register(ModelFeedforward)
def _fixed_control(
    feedforward: ModelFeedforward, coefficients: Vector, r: float, reference: Vector, acting: bool
) -> float:
    lead = feedforward.lead_acting if acting else feedforward.lead
    return _series(coefficients, r, reference) + _force(feedforward, reference, lead)


@fixed_control.register(ControlGiven)
def _all_of_it(
    feedforward: ControlGiven, coefficients: Vector, r: float, reference: Vector, acting: bool
) -> float:
    return coefficients[0] * r


@generic_with_default
def write_feedforward(feedforward: Any, r: float, reference: Vector, row: Vector) -> int:
    """Write u_ff into ``row`` if there is a model; return how many numbers were written."""
    return 0


@write_feedforward.register(ModelFeedforward)
def _write_control(feedforward: ModelFeedforward, r: float, reference: Vector, row: Vector) -> int:
    row[0] = control_by_model(feedforward, r, reference)
    return 1


@kernel
def _series(coefficients: Vector, r: float, reference: Vector) -> float:
    total = coefficients[0] * r
    for i in range(reference.size):
        total += coefficients[i + 1] * reference[i]
    return total


@kernel
def _force(feedforward: ModelFeedforward, reference: Vector, lead: float) -> float:
    """Return Coulomb friction at the speed after a time ``lead``, and the constant."""
    speed, direction = reference[0], 0.0
    if reference.size > 1:
        speed += lead * reference[1]
    if abs(speed) >= feedforward.full_speed:
        if speed > 0.0:
            direction = 1.0
        elif speed < 0.0:
            direction = -1.0
    else:
        direction = speed / feedforward.full_speed
    return feedforward.coulomb * direction + feedforward.constant


def without_forces(design: Any) -> Any:
    """Return the parameters without friction and constant: what remains is linear."""
    if isinstance(design, ModelFeedforward):
        return design._replace(coulomb=0.0, constant=0.0)
    return design


# ---- Han's nonlinear feedback of the errors in place of their weighted sum ----

# The largest power: with more, a large error demands a u that no actuator has. Chosen by hand.
_LARGEST_POWER = 2.0


class LinearFeedback(NamedTuple):
    """The weighted sum of the errors."""


class FalFeedback(NamedTuple):
    """Parameters of the nonlinear law, for a plant of relative degree m."""

    alpha: Vector  # α (m,)
    delta: Vector  # δ (m,) [y-unit/s^(i−1)]


@generic_with_default
def nonlinear_part(
    feedback: Any, law: Vector, estimates: Vector, r: float, reference: Vector, linear: float
) -> float:
    """Return ``linear``, the control law's numerator, with the nonlinear law in place of its sum.

    ``reference`` holds r', r'', …, as far as they are fed forward.
    """
    return linear


@nonlinear_part.register(FalFeedback)
def _fal_part(
    feedback: FalFeedback,
    law: Vector,
    estimates: Vector,
    r: float,
    reference: Vector,
    linear: float,
) -> float:
    total = linear
    for i in range(feedback.alpha.size):
        wished = r if i == 0 else 0.0
        if reference.size > 0 and 0 < i <= reference.size:
            wished = reference[i - 1]
        error, alpha, delta = wished - estimates[i], feedback.alpha[i], feedback.delta[i]
        if abs(error) > delta:
            total += law[i] * (delta ** (1.0 - alpha) * fal(error, alpha, delta) - error)
    return total


@dataclass(frozen=True)
class NonlinearFeedback:
    """Han's nonlinear feedback law for ``ADRC(..., feedback=...)``.

    Parameters
    ----------
    alpha
        the powers α_1, α_2, … of the errors of y and its derivatives, above 0 and at most 2, one
        for each derivative up to the plant's relative degree. 1 is linear.
    delta
        error of y up to which the law is linear, δ_1 [y-unit]; that of the i-th derivative is then
        ``δ_1 omega_c^(i−1)``. Or one for each error [y-unit/s^(i−1)].

    Raises
    ------
    ValueError
        for a power or an error out of range.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01)
    >>> han = NonlinearFeedback(alpha=(0.75, 1.25), delta=0.01)
    >>> round(ql.ADRC(observer, omega_c=2.0, feedback=han).step(r=1.0, y=0.0), 4)
    1.2649
    """

    alpha: tuple[float, ...]
    delta: float | tuple[float, ...]

    def __post_init__(self) -> None:
        alpha = checks.positive_vector("alpha", self.alpha)
        if not np.all(alpha <= _LARGEST_POWER):
            raise ValueError(
                f"alpha = {self.alpha!r}: each must be above 0 and at most {_LARGEST_POWER:g}"
            )
        checks.positive_vector("delta", self.delta)

    def design(self, degree: int, omega_c: float) -> FalFeedback:
        """Return the parameters for a plant of relative degree m and a bandwidth [rad/s]."""
        alpha = checks.vector("feedback.alpha", self.alpha, degree)
        if np.ndim(self.delta) == 0:
            delta = checks.positive("feedback.delta", self.delta) * omega_c ** np.arange(degree)
        else:
            delta = checks.vector("feedback.delta", self.delta, degree)
        return FalFeedback(alpha, np.asarray(delta, dtype=np.float64))


def checked_feedback(feedback: Any) -> NonlinearFeedback | None:
    """Return ``feedback`` if it is a nonlinear law or None."""
    if feedback is None or isinstance(feedback, NonlinearFeedback):
        return feedback
    example = "quell.controllers.NonlinearFeedback(alpha=(0.75, 1.25), delta=0.01)"
    raise ValueError(f"feedback = {feedback!r}: must be {example}, or None")


def feedback_design(feedback: NonlinearFeedback | None, degree: int, omega_c: float) -> Any:
    """Return the parameters of the law, also of the linear one."""
    return LinearFeedback() if feedback is None else feedback.design(degree, omega_c)


# ---- The control law of ADRC, sample by sample ----

_MEASUREMENT_HELD = int(Status.MEASUREMENT_HELD)
_OVERFLOWED = int(Status.OVERFLOWED)
_LEARNER_CUT = int(Status.LEARNER_CUT)
_HELD = int(Status.HELD)

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
    f_learned_filtered: float  # f_L^F: the share of f_L that Δf̂ lacks at the next sample
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
    held: float  # 1 while the machine says that the plant is held, else 0


class AdrcDesign(NamedTuple):
    """Parameters of the controller, for a plant of order n and an observer of m extended states."""

    eso: Any  # parameters of the observer, see ``observers.base``
    law: Vector  # k (n,); zero from the relative degree on
    cancel: Vector  # a (n,)
    cancel_f: float  # 1 if f enters where u enters, else 0
    feedback: Any  # linear or nonlinear law of the errors, see ``feedback``
    feedforward: Any  # with or without a model, see ``feedforward``
    safe_set: Any  # bands for y and its rate, or none
    held: Any  # detection of a held plant, or none
    schedule: Any  # tables of gains, or none
    fade: float  # factor of the offset from one sample to the next
    b0: float
    limits: Limits
    learner: Any
    lag: Any  # lag filter of f_L; without taps if there is no learner
    guard: Any
    learns: Flag  # whether there is a learner
    forgets: Flag  # whether it forgets what does harm
    window: int  # samples of the windows in which it is watched
    # Whether there are parts: the calls of one that is absent are left out.
    guarded: Flag
    scheduled: Flag
    has_safe_set: Flag
    has_held: Flag  # a detection of holds
    has_model: Flag  # in the feedforward
    nonlinear: Flag  # feedback


class AdrcState(NamedTuple):
    """State of the controller."""

    z: Vector  # state of the observer
    estimates: Vector  # estimates (x̂_1 … x̂_n, Δf̂, Δf̂', …) of the observer (n + m,)
    reference: Vector  # r', r'', … as used, zero if they are not given; empty without feedforward
    loop: NDArray[AdrcLoop]  # (1,)
    learner: Any
    lag_state: Matrix  # lag filter of f_L (1, …)
    guard: Any
    watch: NDArray[LearnerWatch]  # (1,)
    safe_set: Any
    held: Any
    schedule: Any


@control.register(AdrcDesign)
def _control(design: AdrcDesign, state: AdrcState, r: float, y: float) -> float:
    loop, estimates = state.loop[0], state.estimates
    status = hold_last_good(loop, r, y)
    if design.has_safe_set:
        see(design.safe_set, state.safe_set, y, nominal_control(design, state, loop.u))
    f_plain, continues = 0.0, loop.started != 0.0
    u_acting = acting_control(design.eso, state.z, loop.u)
    if loop.started == 0.0:
        begin(design.eso, state.z, estimates, loop.y)
        if status & _MEASUREMENT_HELD != 0:
            loop.u_limited = control_at_rest(design.limits)
            loop.u = loop.u_limited if loop.manual == 0.0 else loop.u_manual
            loop.status = status
            return loop.u
        loop.started = 1.0
        if loop.held != 0.0:
            status |= _HELD
        elif design.has_held:
            u_nominal = nominal_control(design, state, u_acting)
            is_released(design.held, state.held, loop.y, u_nominal, 0.0, 0.0, design.b0)
    else:
        if design.learns or design.guarded:
            _finish_sample(design, state, u_acting)
        if status & _MEASUREMENT_HELD != 0 and loop.held == 0.0:
            # The last y would look like a disturbance while the plant moves; the expected y does
            # not change the estimates.
            known, u_observed = known_now(design, state, u_acting), loop.u
            if design.scheduled:
                u_observed = control_as_observed(design.schedule, state.schedule, u_observed)
            y = expected_measurement(design.eso, state.z, u_observed, known)
            if is_usable(y):
                loop.y = y
        status |= _estimate(design, state, u_acting, status & _MEASUREMENT_HELD == 0)
        f_plain = estimates[design.law.size]
        if design.scheduled:
            f_plain = at_nominal(design.schedule, state.schedule, f_plain)
        f_plain += loop.f_learned_filtered
        if design.guarded and loop.held == 0.0:
            assess(design.guard, state.guard, f_plain)
        if design.learns and status & _MEASUREMENT_HELD == 0 and loop.held == 0.0:
            if design.scheduled:
                show_at_nominal(design.schedule, state.schedule, estimates, design.law.size)
            adapt(design.learner, state.learner, estimates, loop.y, u_acting, f_plain)
            if design.scheduled:
                show_at_present(design.schedule, state.schedule, estimates, design.law.size)
            status |= learner_flags(design.learner, state.learner)
    order = design.law.size
    if design.scheduled:
        status |= follow_signals(
            design.schedule, state.schedule, loop, state.z, estimates, state.reference, order,
            u_acting, continues, design.safe_set, state.safe_set, design.held, state.held,
        )  # fmt: skip
    known = 0.0
    if design.has_model:
        known = known_share(design.feedforward, loop.r, state.reference)
    if design.scheduled:
        known = known_of_model(
            design.schedule, state.schedule, design.feedforward, loop.r, state.reference,
            design.b0, known,
        )  # fmt: skip
    loop.f_known = known
    constant = slope = output = 0.0
    if design.learns:
        constant, slope = predict(design.learner, state.learner, estimates, u_acting)
        output = constant + slope * u_acting
    if design.guarded:
        constant, slope, was_cut = limit(
            design.guard, state.guard, f_plain, loop.f_learned_filtered, constant, slope, u_acting
        )
        if was_cut:
            status |= _LEARNER_CUT
            restart(design.learner, state.learner)
    unlimited = unlimited_control(design, state, constant, slope)
    if design.guarded and slope != 0.0:
        # The guard's bound holds for the new u, too: beyond it the output counts as a constant.
        f_learned = constant + slope * acting_control(design.eso, state.z, unlimited)
        permitted = nearest_permitted(design.guard, state.guard, f_learned)
        if permitted != f_learned:
            constant, slope = permitted, 0.0
            unlimited = unlimited_control(design, state, constant, slope)
    if not is_usable_control(design.limits, unlimited):
        status |= _OVERFLOWED
        # Else a finite θ that is out of all proportion overflows again in the next sample.
        _forget_learning(design, state)
        clear(state.watch)
        look_anew(design.held, state.held)
        begin(design.eso, state.z, estimates, loop.y)
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
    safe, changed = unlimited, 0
    if design.has_safe_set:
        wished = nominal_control(design, state, unlimited)
        safe, changed = nearest_safe(design.safe_set, state.safe_set, wished)
        if design.scheduled:
            safe = safe_as_applied(
                design.schedule, state.schedule, safe, unlimited, design.safe_set, state.safe_set
            )
    u, cut = apply_limits(design.limits, safe, loop.u)
    cut |= changed
    loop.u_limited = u
    if loop.manual == 0.0:
        status |= cut
    else:
        u = loop.u_manual
    loop.u = u
    if design.has_safe_set:
        status |= flags_of_applied(design.safe_set, state.safe_set, u)
    loop.constant, loop.slope = constant, slope
    if design.learns or design.guarded:
        f_learned = constant + slope * acting_control(design.eso, state.z, u)
        if design.scheduled:
            f_learned = at_present(design.schedule, state.schedule, f_learned)
        loop.f_learned = f_learned
    if design.learns and status & _MEASUREMENT_HELD == 0 and loop.held == 0.0:
        excessive = is_excessive(unlimited, u, smallest)
        limited, watch = cut != 0 and loop.manual == 0.0, state.watch[0]
        lost = has_escaped(watch, output, excessive) or has_lost_range(
            watch, design.window, loop.y, f_plain, output, excessive, limited
        )
        if design.forgets:
            residual = estimates[design.law.size]
            if design.scheduled:
                residual = at_nominal(design.schedule, state.schedule, residual)
            if does_harm(watch, design.window, residual, f_plain):
                lost = True
        if lost:
            status |= _OVERFLOWED
            start_learning_again(design, state)
    loop.status = status
    return u


@kernel
def _estimate(design: AdrcDesign, state: AdrcState, u_acting: float, is_measured: bool) -> int:
    """Update the observer; return the flag of a held plant."""
    loop, z, estimates, order = state.loop[0], state.z, state.estimates, design.law.size
    fed, before = loop.f_learned + loop.f_known, estimates[order]
    known, u_observed = fed, loop.u
    if design.scheduled:
        known = known_with_schedule(design.schedule, state.schedule, fed, design.b0, u_acting)
        u_observed = control_as_observed(design.schedule, state.schedule, loop.u)
    observe(design.eso, z, estimates, loop.y, u_observed, known)
    if design.scheduled:
        scheduled_correction(design.schedule, state.schedule, design.eso, z, estimates, loop.y)
    if loop.held != 0.0:
        begin_with(design.eso, z, estimates, loop.y, order, before)
        set_motion(design.safe_set, state.safe_set, estimates, before + fed)
        look_anew(design.held, state.held)
        return _HELD
    if not design.has_held:
        return 0
    if is_measured:
        # A learner's share that follows u is right for any u.
        u_nominal = nominal_control(design, state, u_acting)
        own = fed - loop.slope * u_nominal
        residual = f_before(design.held, state.held) - own
        follow(design.held, state.held, design.eso, z, loop.y, u_observed, known, residual)
        f = estimates[order] + own
        if is_released(design.held, state.held, loop.y, u_nominal, f, loop.slope, design.b0):
            take_motion(design.held, state.held, z, estimates)
            set_motion(design.safe_set, state.safe_set, estimates, estimates[order] + fed)
    else:
        miss(design.held, state.held)
    return held_flag(design.held, state.held)


@kernel
def nominal_control(design: AdrcDesign, state: AdrcState, u: float) -> float:
    """Return what a control signal is for the observer's b0."""
    return control_at_nominal(design.schedule, state.schedule, u) if design.scheduled else u


@kernel
def start_learning_again(design: AdrcDesign, state: AdrcState) -> None:
    """Forget what was learned; the observer's estimate takes over what was fed forward.

    If that was out of all proportion, the whole estimate is useless, and the observer begins at y.
    """
    loop, order = state.loop[0], design.law.size
    if is_in_proportion(state.watch[0], loop.f_learned_filtered):
        state.z[order] += at_present(design.schedule, state.schedule, loop.f_learned_filtered)
        state.estimates[order] += at_present(
            design.schedule, state.schedule, loop.f_learned_filtered
        )
    else:
        begin(design.eso, state.z, state.estimates, loop.y)
    loop.constant = loop.slope = loop.f_learned = 0.0
    _forget_learning(design, state)


@kernel
def _forget_learning(design: AdrcDesign, state: AdrcState) -> None:
    """Return learner, guard and the lag filter of f_L to their states before the first sample."""
    _reset_lag_filter(state)
    start_again(design.guard, state.guard)
    forget(design.learner, state.learner)


@kernel
def _finish_sample(design: AdrcDesign, state: AdrcState, u_acting: float) -> None:
    """Update what depends on the u that acted since the last sample.

    This is done one sample later because ``set_applied_control`` may have corrected u meanwhile.
    """
    loop = state.loop[0]
    f_learned = loop.constant + loop.slope * u_acting
    if design.guarded and loop.slope != 0.0:
        f_learned = nearest_permitted(design.guard, state.guard, f_learned)
    loop.f_learned = f_learned
    if design.scheduled:
        loop.f_learned = at_present(design.schedule, state.schedule, f_learned)
    loop.f_learned_filtered = lag_push(design.lag, state.lag_state, 0, f_learned)
    commit(design.learner, state.learner, state.estimates, u_acting, f_learned)
    if design.guarded:
        record_output(design.guard, state.guard, f_learned)


@kernel
def reset_lag_filters(design: AdrcDesign, state: AdrcState) -> None:
    """Set the lag filters of f_L and of the guard to zero."""
    reset_filters(design.guard, state.guard)
    _reset_lag_filter(state)


@kernel
def _reset_lag_filter(state: AdrcState) -> None:
    state.loop[0].f_learned_filtered = 0.0
    reset_lag(state.lag_state)


@kernel
def unlimited_control(design: AdrcDesign, state: AdrcState, constant: float, slope: float) -> float:
    """Return the control signal before limits for ``f_L = constant + slope · u``."""
    estimates, reference, order = state.estimates, state.reference, design.law.size
    r = state.loop[0].r
    unlimited = reference_part(design.feedforward, design.law, r, reference)
    for i in range(order):
        unlimited += (design.cancel[i] - design.law[i]) * estimates[i]
    schedule, memory = design.schedule, state.schedule
    if design.scheduled:
        constant, slope = (
            at_present(schedule, memory, constant),
            at_present(schedule, memory, slope),
        )
    unlimited -= design.cancel_f * (estimates[order] + constant)
    if design.nonlinear:
        unlimited = nonlinear_part(design.feedback, design.law, estimates, r, reference, unlimited)
    if not design.scheduled:
        return unlimited / (design.b0 + design.cancel_f * slope)
    unlimited = scheduled_law(
        schedule, memory, design.feedforward, estimates, r, reference, design.b0, unlimited
    )
    return unlimited / (gain_in_use(schedule, memory, design.b0) + design.cancel_f * slope)


@kernel
def known_now(design: AdrcDesign, state: AdrcState, u: float) -> float:
    """Return what is known of f while u acts: from learner, feedforward and schedule."""
    known = state.loop[0].f_learned + state.loop[0].f_known
    if design.scheduled:
        known = known_with_schedule(design.schedule, state.schedule, known, design.b0, u)
    return known


@set_reference_derivatives.register(AdrcDesign)
def _set_reference_derivatives(design: AdrcDesign, state: AdrcState, derivatives: Vector) -> None:
    for i in range(state.reference.size):
        state.reference[i] = derivatives[i] if i < derivatives.size else 0.0
        if not is_usable(state.reference[i]):
            state.reference[i] = 0.0
    set_signals(design.schedule, state.schedule, derivatives, state.reference.size)


@set_schedule_signals.register(AdrcDesign)
def _set_schedule_signals(design: AdrcDesign, state: AdrcState, values: Vector) -> None:
    set_signals(design.schedule, state.schedule, values, -1)


@set_held.register(AdrcDesign)
def _set_held(design: AdrcDesign, state: AdrcState, held: bool) -> None:
    state.loop[0].held = 1.0 if held else 0.0


@write_row.register(AdrcDesign)
def _write_row(design: AdrcDesign, state: AdrcState, row: Vector) -> None:
    order = design.law.size
    for i in range(order + 1):
        row[i] = state.estimates[i]
    row[order + 1] = state.loop[0].f_learned
    row[order + 2] = state.loop[0].status
    after = state.estimates.size + 2
    for i in range(order + 1, state.estimates.size):
        row[i + 2] = state.estimates[i]
    r, reference = state.loop[0].r, state.reference
    forward = write_feedforward(design.feedforward, r, reference, row[after:])
    show_feedforward(design.schedule, state.schedule, design.feedforward, r, reference, row[after:])
    written = write_channels(design.guard, state.guard, row[after + forward :])
    coefficients(design.learner, state.learner, row[after + forward + written :])


@status_flags.register(AdrcDesign)
def _status_flags(design: AdrcDesign, state: AdrcState) -> int:
    return int(state.loop[0].status)


@reset_loop.register(AdrcDesign)
def _reset_loop(design: AdrcDesign, state: AdrcState) -> None:
    held = state.loop[0].held
    clear(state.loop)
    state.loop[0].held = held
    look_anew(design.held, state.held)
    state.loop[0].has_reference = has_reference_at_start(design.feedforward)
    for i in range(state.reference.size):
        state.reference[i] = 0.0
    reset_lag_filters(design, state)
    forget_motion(design.safe_set, state.safe_set)
    forget_signals(design.schedule, state.schedule, design.b0)
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
    others, in units of omega_c (``quell.lti.models``).
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
