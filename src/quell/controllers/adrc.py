"""The ADRC controller: an ESO, its law, optional learner and guard.

Start under load, manual operation and retuning of an ADRC: functions of parameters and state.

A controller starts under load, or follows manual operation, by its observer: the observer receives
y and the applied u and estimates f (Herbst, "Practical Active Disturbance Rejection Control:
Bumpless Transfer, Rate Limitation, and Incremental Algorithm", arXiv 1908.04610). At rest at the
reference the law then returns exactly that u. Otherwise, with another reference or new gains, the
difference is added to u and decays as ``exp(−omega_c t)``. The observer receives the sum, so the
offset does not disturb its estimate.

Design rules for the sample time and a known delay, judged from the design alone.

An observer places its poles in the z-plane, so it is stable at any sample time, but slow sampling
reduces the margins. Measured on the loop with the plant that the design assumes, a chain of n = 1 …
4 integrators, with omega_o 3 and 10 times omega_c (docs/analysis): compared with fast sampling the
modulus margin is 8 to 16 % smaller at ``omega_o dt = 1`` for the current form, and 9 to 14 % at 0.3
for the predictor form, which has one more sample of delay. The law's gains are those of continuous
time: with omega_o = omega_c, the loops of order 3 and 4 are stable at ``omega_c dt = 0.5`` and
unstable at 0.7. The observer takes account of a known delay of u, but the delay stays in the loop:
with omega_o 3 to 10 times omega_c, the chains have modulus margins of about 0.39, 0.33, 0.28 and
0.22 at ``n omega_c delay = 0.5``, and become unstable between 1.2 and 1.6.

ADRC of order 1 for a first-order plant with dead time, ``K e^(−Ls)/(T s + 1)``.

In continuous time an ADRC of order 1 is, from y to u, a PI controller with a filter (Herbst,
*Control Theory and Technology* 19, 2021, arXiv 2011.01044; see ``baselines.equivalent_pid``)::

    K_c (1 + 1/(T_i s)) / (1 + t_f s)
    t_f = 1/(2ω_o + ω_c),    T_i = 1/ω_c + 2/ω_o,    K_c = ω_o (ω_o + 2ω_c) t_f / b_0

So tuning rules for PI control of such plants are tuning rules for ADRC. Solved for the three
numbers, with ``x = T_i/t_f ≥ 9``::

    ω_o = (x + 3 + √((x − 1)(x − 9))) / (4 T_i),    ω_c = 1/t_f − 2ω_o,
    b_0 = ω_o (ω_o + 2ω_c) t_f / K_c

The filter time, which the rules do not give, is a tenth of the smaller of L and T_i, so that it
costs little of the margin; at T_i/10 the bandwidths are ``ω_c = 2/T_i`` and ``ω_o = 4/T_i``. The
b_0 found is not K/T: it carries the gain of the rule.

``"simc"``
    ``K_c = T/(K (τ_c + L))``, ``T_i = min(T, 4 (τ_c + L))`` (Skogestad, *J. Process Control* 13,
    2003, eqs. (23) and (24)). With τ_c = L the PI loop has 1/modulus margin = 1.59 to 1.70.
``"amigo"``
    ``K_c = (0.15 + (0.35 − L T/(L + T)²) T/L)/K``, ``T_i = 0.35 L + 13 L T²/(T² + 12 L T + 7 L²)``
    (Åström & Hägglund, *J. Process Control* 14, 2004): slower, at most 1.47.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.base import RateLimit, checked_limits, reset_loop, set_reference_derivatives
from quell.controllers.feedforward import (
    Feedforward,
    checked_feedforward,
    derivatives_used,
    feedforward_design,
)
from quell.controllers.from_pid import equal_to_pid
from quell.controllers.law import (
    AdrcDesign,
    AdrcLoop,
    AdrcState,
    NonlinearFeedback,
    checked_feedback,
    feedback_design,
    known_share,
    law_gains,
    unlimited_control,
)
from quell.controllers.stateful import StatefulController
from quell.guard import (
    GUARD_CHANNELS,
    Guard,
    Reason,
    UnguardedDesign,
    UnguardedMemory,
    limit,
    write_channels,
)
from quell.kernels.dispatch import call_specialised, compiled
from quell.learners.base import (
    NO_LAG,
    Learner,
    LearnerWatch,
    NoLearner,
    checked_learner_design,
    coefficients,
    forget,
    lag_memory,
    lag_of,
    predict,
    window_samples,
)
from quell.lti.canonical import format_roots
from quell.observers.design import scaled_response
from quell.observers.eso import ESO
from quell.observers.forms import (
    NonlinearModel,
    acting_control,
    begin,
    observe,
    state_for,
    without_delay,
)
from quell.types import Channels, DesignWarning, Status, Vector, warn

# ---- The estimates of an ADRC controller after a step ----


class Estimate(NamedTuple):
    """Estimates and status of an ADRC controller after a step."""

    x: Vector
    """(n,): y and its derivatives; if the plant has zeros, see ``observer.states_of``."""
    f: float
    """Total disturbance ``f_learned + f_residual`` [y-unit/s^n; y-unit/s^f_degree with zeros]."""
    f_learned: float
    """The learner's share, f_L; with a guard its constant part is free, and ``f`` is right."""
    f_residual: float
    """The observer's share, Δf̂."""
    theta: dict[str, float]
    """The learner's coefficients by feature."""
    u: float
    """The applied control signal."""
    status: Status
    """Status flags of the step."""
    authority: float = 1.0
    """Share of its output that the guard allows the learner."""
    error_plain: float = math.nan
    """RMS error in f of an ESO without learner, as the guard estimates it [y-unit/s^n]."""
    error_learned: float = math.nan
    """The same for the learner with full authority."""
    reason: Reason = Reason.TRUSTED
    """Reason for the authority."""
    f_derivatives: Vector = np.zeros(0)
    """(m − 1,): derivatives of Δf̂, of an observer with m extended states [y-unit/s^(n+j)]."""


def read_estimate(design: AdrcDesign, state: AdrcState, features: tuple[str, ...]) -> Estimate:
    """Return the estimates in ``state``, with the learner's coefficients named by ``features``."""
    order = design.law.size
    theta = np.zeros(len(features))
    coefficients(design.learner, state.learner, theta)
    learned, residual = float(state.loop[0].f_learned), float(state.seen[order])
    guarded: dict[str, Any] = {}
    row = np.zeros(len(GUARD_CHANNELS))
    if write_channels(design.guard, state.guard, row):
        guarded = dict(zip((name for name, _ in GUARD_CHANNELS), row.tolist(), strict=True))
        guarded["reason"] = Reason(int(guarded["reason"]))
    return Estimate(
        x=state.seen[:order].copy(),
        f=learned + residual,
        f_learned=learned,
        f_residual=residual,
        theta=dict(zip(features, theta.tolist(), strict=True)),
        u=float(state.loop[0].u),
        status=Status(int(state.loop[0].status)),
        **guarded,
        f_derivatives=state.seen[order + 1 :].copy(),
    )


# ---- Start under load, manual operation and retuning of an ADRC ----

# Time constants after which an initial error is below the unit roundoff: exp(−40) = 4e-18.
_TIME_CONSTANTS = 40.0
# Bound on the time that ``start`` takes: some seconds of calculation. Chosen by hand.
_MOST_SAMPLES = 100_000_000


def start_at_rest(
    design: AdrcDesign, state: AdrcState, samples: int, y: float, u: float, r: float
) -> None:
    """Set the state to rest at y under u, with the reference r; see ``samples_to_settle``.

    The numbers are in the precision of the state.
    """
    _start_loop(design, state, y, u, r)
    begin(design.eso, state.z, state.seen, y)
    loop = state.loop[0]
    model, z, seen = design.eso, state.z, state.seen
    known = loop.f_learned + loop.f_known
    call_specialised(_observe_at_rest, model, z, seen, y, u, known, samples)
    _feed_forward(design, state, u)
    known = loop.f_learned + loop.f_known
    call_specialised(_observe_at_rest, model, z, seen, y, u, known, samples)
    loop.bumpless = 1.0


def start_in_motion(
    design: AdrcDesign, state: AdrcState, x: Vector, f: Vector, u: float, r: float
) -> None:
    """Set the state to the estimates ``x`` (n,) and ``f`` (m,) under u, with the reference r."""
    _start_loop(design, state, float(x[0]), u, r)
    state.seen[:] = np.append(x, f)
    _feed_forward(design, state, u)
    state.seen[x.size] -= state.loop[0].f_learned + state.loop[0].f_known
    state.z[:] = state_for(design.eso, x, state.seen[x.size :], u)


def _start_loop(design: AdrcDesign, state: AdrcState, y: float, u: float, r: float) -> None:
    reset_loop(design, state)
    loop = state.loop[0]
    loop.y, loop.r, loop.u = y, r, u
    loop.started = loop.has_reference = 1.0
    loop.f_known = known_share(design.feedforward, r, state.reference)


def _feed_forward(design: AdrcDesign, state: AdrcState, u: float) -> None:
    """Set the learner's share of f for the estimates in ``state`` under u."""
    loop = state.loop[0]
    constant, slope = predict(design.learner, state.learner, state.seen, u)
    constant, slope, _ = limit(design.guard, state.guard, 0.0, 0.0, constant, slope, u)
    loop.constant, loop.slope = constant, slope
    loop.f_learned = constant + slope * u


def samples_to_settle(observer: ESO) -> int:
    """Return after how many samples an observer has forgotten its initial state."""
    samples = _TIME_CONSTANTS * observer.lag_time / observer.dt
    if not isinstance(without_delay(observer.model), NonlinearModel):
        transition = scaled_response(observer.model, observer.units, observer.order).transition
        slowest = float(np.max(np.abs(np.linalg.eigvals(transition))))
        if 0.0 < slowest < 1.0:
            samples = max(samples, _TIME_CONSTANTS / -math.log(slowest))
    return min(round(samples), _MOST_SAMPLES) + observer.states


@compiled
def _observe_at_rest(
    model: Any, z: Vector, seen: Vector, y: float, u: float, f_learned: float, samples: int
) -> None:
    """Update the observer with constant y, u and f_L."""
    for _ in range(samples):
        observe(model, z, seen, y, u, f_learned)


@contextmanager
def manual_operation(state: AdrcState, u: float) -> Iterator[None]:
    """Apply ``u`` instead of the law's own control signal inside the ``with`` block."""
    state.loop[0].manual, state.loop[0].u_manual = 1.0, u
    try:
        yield
    finally:
        state.loop[0].manual = 0.0


def change_design(old: AdrcDesign, new: AdrcDesign, state: AdrcState) -> None:
    """Convert a running state to new parameters, without a jump of u."""
    loop, size = state.loop[0], new.law.size
    if loop.started == 0.0:
        return
    before = unlimited_control(old, state, loop.constant, loop.slope)
    # By definition f is what b0 u and a·x do not explain, so its estimate changes with b0 and a.
    # Its derivatives, if the observer has them, stay: how u moves from now on is not known.
    acting = acting_control(old.eso, state.z, float(loop.u))
    change = (old.b0 - new.b0) * acting
    for i in range(size):
        change += (new.cancel[i] - old.cancel[i]) * state.seen[i]
    # The model's share of f depends on them, too, and is not in the estimate.
    known = known_share(new.feedforward, loop.r, state.reference)
    change -= known - loop.f_known
    loop.f_known = known
    state.z[size] += change
    state.seen[size] += change
    loop.offset += before - unlimited_control(new, state, loop.constant, loop.slope)


def check_replacement(old: ESO, new: Any, learns: bool) -> None:
    """Check that ``new`` can replace ``old`` in a running controller; ``learns`` with a learner."""
    if not isinstance(new, ESO):
        raise ValueError(f"observer = {new!r}: must be an ESO")
    names = ("order", "disturbance_order", "degree", "f_degree", "dt", "form", "states")
    for name in names:
        if getattr(new, name) != getattr(old, name):
            rule = f"the present one {getattr(old, name)!r}: must be the same"
            raise ValueError(f"observer has {name} = {getattr(new, name)!r}, {rule}")
    same_gain = new.b0 == old.b0
    plants = [(getattr(new.plant, name), getattr(old.plant, name)) for name in "aBE"]
    if same_gain and all(np.array_equal(*pair) for pair in plants):
        return
    if any(observer.plant.zeros.size or not observer.plant.matched for observer in (old, new)):
        raise ValueError(
            "observer has another model or b0, which changes the meaning of its states for a plant "
            "with zeros; change omega_o only"
        )
    if learns and not (same_gain and np.array_equal(new.cancel, old.cancel)):
        raise ValueError(
            f"observer has b0 = {new.b0!r} and a = {new.cancel.tolist()}, not those of the present "
            "one: what was learned refers to that; change omega_o only, or make a new controller"
        )


def check_structure(old: AdrcDesign, new: AdrcDesign) -> None:
    """Raise a ``ValueError`` if compiled code and state arrays for ``old`` do not fit ``new``."""
    if _structure(new) != _structure(old):
        raise ValueError("observer is of another structure than the present one: make a new ADRC")


def _structure(value: Any) -> Any:
    """Return types and array shapes of a nested NamedTuple."""
    if isinstance(value, tuple):
        return type(value), tuple(map(_structure, value))
    return value.shape if isinstance(value, np.ndarray) else type(value)


# ---- Design rules for the sample time and a known delay, judged from the design alone ----

# Limits of omega_o dt by the form of the observer, of omega_c dt, and of order times omega_c times
# a known delay of u; measured as described above.
_OBSERVER_LIMIT = {"current": 1.0, "predictor": 0.3}
_LAW_LIMIT = 0.5
_DELAY_LIMIT = 0.5
# A product that rounding alone puts above its limit keeps to it, as that of a tuner which ends at
# the limit.
_ROUNDING = 1.0 + 1e-9


class Finding(NamedTuple):
    """A weak point of a design."""

    subject: str  #: "sampling", "bandwidth", "margin", "learner", "lag", "noise" or "stability"
    value: float
    limit: float
    message: str  # the weak point, with both numbers, and what to do

    def __str__(self) -> str:
        return self.message


def known_samples(observer: ESO) -> int:
    """Return the delay of u that an observer knows [samples]."""
    return int(getattr(observer.model, "samples", 0))


def sampling_findings(observer: ESO, omega_c: float) -> list[Finding]:
    """Return the findings about the sample time and about a delay that the observer knows."""
    dt, form = observer.dt, observer.form
    found = []
    value, limit = observer.omega_o * dt, _OBSERVER_LIMIT.get(form, _OBSERVER_LIMIT["current"])
    if value > _ROUNDING * limit:
        current_helps = form == "predictor" and value <= _OBSERVER_LIMIT["current"]
        cost = "there sampling costs up to a sixth of the modulus margin, beyond it more"
        if value >= math.pi:
            cost = (
                f"with its poles at z = {observer.pole:.2g} the observer follows every sample of "
                "y, noise included"
            )
        message = (
            f"omega_o * dt = {value:.3g} is above {limit:g}: {cost}; "
            f"sample every {limit / observer.omega_o:.3g} s or faster, "
            f"lower omega_o to {limit / dt:.3g} rad/s{', or take the current form' * current_helps}"
        )
        found.append(Finding("sampling", value, limit, message))
    value = omega_c * dt
    if value > _ROUNDING * _LAW_LIMIT:
        message = (
            f"omega_c * dt = {value:.3g} is above {_LAW_LIMIT:g}: the law's gains are made for "
            "faster sampling, the loop may be unstable; "
            f"sample every {_LAW_LIMIT / omega_c:.3g} s or faster, "
            f"or lower omega_c to {_LAW_LIMIT / dt:.3g} rad/s"
        )
        found.append(Finding("sampling", value, _LAW_LIMIT, message))
    delay = dt * known_samples(observer)
    value = observer.degree * omega_c * delay
    if value > _ROUNDING * _DELAY_LIMIT:
        message = (
            f"order * omega_c * delay = {value:.3g} is above {_DELAY_LIMIT:g}: the delay stays in "
            "the loop, which becomes unstable soon after 1; "
            f"lower omega_c to {_DELAY_LIMIT / (observer.degree * delay):.3g} rad/s"
        )
        found.append(Finding("lag", value, _DELAY_LIMIT, message))
    return found


def warn_if_unwise(observer: ESO, omega_c: float, stacklevel: int | None = None) -> None:
    """Issue a ``DesignWarning`` for each finding.

    Its source is the nearest line outside of quell, or the one ``stacklevel`` frames above.
    """
    for finding in sampling_findings(observer, omega_c):
        if stacklevel is None:
            warn(finding.message)
        else:
            warnings.warn(finding.message, DesignWarning, stacklevel=stacklevel)


def check_zeros(observer: ESO) -> None:
    """Check that the plant's inverse is stable: the zeros from u become poles of u."""
    unstable = observer.plant.unstable_zeros
    if unstable.size:
        raise ValueError(
            f"observer: the plant has zeros from u at {format_roots(unstable)} rad/s, not in the "
            "left half plane; ADRC inverts the plant, so u would grow or oscillate while "
            "y looks well; control another output, or use a controller that does not invert the "
            "plant (linear-quadratic, for instance)"
        )


# ---- The ADRC controller ----


class ADRC(StatefulController):
    """Active disturbance rejection control around an ESO, with or without a learner.

    All but the running state is immutable, except through ``retune``. ``step`` advances the running
    state; ``simulate`` does not touch it and uses a state of its own.

    Parameters
    ----------
    observer
        model-free or model-based, of a plant whose zeros lie in the left half plane; it sets order,
        b0 and dt.
    omega_c
        controller bandwidth [rad/s]: all poles of the ideal loop lie at −omega_c.
    learner
        predicts f and feeds it forward; none by default.
    guard
        limits the learner to the authority that it has earned, which is full without a guard.
    feedforward
        whether to feed the reference's derivatives forward, r^(m)/b0, or a ``Feedforward``: that of
        a model of the plant, which does not depend on b0 and which the observer knows. ``simulate``
        takes the derivatives from the signal, ``step`` from its arguments. The ideal loop then
        follows the reference without lag. Where b0 is not the plant's gain, as after tuning, only
        the model's follows fast moves.
    u_min, u_max
        limits of the control signal [u-unit].
    rate_limit
        largest rate of the control signal, in both directions, or (lowest, highest) [u-unit/s].
    half_gain
        whether to halve the gains k of the law, reference included, but not the cancellation of f.
        The gain from noise in x̂ is halved, and the loop settles to 2 % in 2.0, 1.4, 1.2 and 1.0
        times the time for orders 1 to 4 (Herbst, Hempel, Göhrt & Streif 2020, arXiv 2003.03986).
    feedback
        Han's nonlinear law of the errors; the linear law by default.
    law_poles
        poles of the ideal loop in units of omega_c, instead of all at −1: negative numbers, and
        pairs (real, imaginary) for two conjugate ones; as many as the relative degree.

    Raises
    ------
    ValueError
        for a bandwidth or rate limit that is not positive, limits in the wrong order, an
        observer of a plant with zeros outside of the left half plane.

    Examples
    --------
    >>> from quell.observers import ESO
    >>> observer = ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01)
    >>> controller = ADRC(observer, omega_c=2.0, u_min=-1.0, u_max=1.0)
    >>> controller.step(r=1.0, y=0.0)
    1.0
    >>> controller.estimate.status
    <Status.SATURATED: 4>
    """

    def __init__(
        self,
        observer: ESO,
        omega_c: float,
        *,
        learner: Learner | None = None,
        guard: Guard | None = None,
        feedforward: bool | Feedforward = False,
        u_min: float = -math.inf,
        u_max: float = math.inf,
        rate_limit: RateLimit = math.inf,
        half_gain: bool = False,
        feedback: NonlinearFeedback | None = None,
        law_poles: Sequence[float | tuple[float, float]] | None = None,
    ) -> None:
        if not isinstance(observer, ESO):
            raise ValueError(f"observer = {observer!r}: must be an ESO, as from ESO.model_free")
        self.observer = observer
        check_zeros(observer)
        self.omega_c = checks.positive("omega_c", omega_c, "rad/s")
        self.guard = guard
        self.learner: Learner = NoLearner() if learner is None else learner
        if isinstance(self.learner, type) or not all(
            hasattr(self.learner, name) for name in ("design", "memory", "feature_names")
        ):
            example = "for example quell.learners.Kalman()"
            raise ValueError(f"learner = {learner!r}: must be a learner, {example}, or None")
        if guard is not None and not isinstance(guard, Guard):
            raise ValueError(f"guard = {guard!r}: must be a quell.Guard(), or None")
        self.feedforward = checked_feedforward(feedforward)
        self.half_gain = checks.flag("half_gain", half_gain)
        self.feedback = checked_feedback(feedback)
        self.law_poles = law_poles
        self._learner_omega_c = self.omega_c  # the learner keeps its scales when omega_c is retuned
        self._limits = checked_limits(u_min, u_max, rate_limit, observer.dt)
        self._initialise()
        warn_if_unwise(observer, self.omega_c)
        if guard is not None and isinstance(self.learner, NoLearner):
            message = f"guard = {guard!r} has no effect without a learner; give one, or no guard"
            warn(message)

    @classmethod
    def from_pid(
        cls,
        kp: float,
        ki: float,
        kd: float = 0.0,
        *,
        tf: float | tuple[float, float] = 0.0,
        dt: float,
        b0: float | None = None,
        **options: Any,
    ) -> ADRC:
        """Return the ADRC that is equal, from y to u, to a PID controller that is sampled.

        ``controllers.equal_to_pid`` has the parameters, the errors, and a report: what differs and
        where to go from there. ``options`` are those of ``ADRC`` that leave the law linear and its
        poles where they are: limits, ``learner``, ``guard``, ``feedforward``.

        Examples
        --------
        >>> controller = ADRC.from_pid(2.0, 1.0, dt=0.01, u_min=-5.0, u_max=5.0)
        >>> round(controller.omega_c, 3), controller.observer.form
        (0.926, 'reduced')
        """
        for name in {"half_gain", "feedback", "law_poles"} & options.keys():
            raise ValueError(f"{name} = {options[name]!r}: the PID controller decides it; leave it")
        equal = equal_to_pid(kp, ki, kd, tf=tf, dt=dt, b0=b0)
        return cls(equal.observer, equal.omega_c, law_poles=equal.law_poles, **options)

    def _update_parameters(self) -> None:
        self.parameters = self._design(self.observer, self.omega_c)
        self.features = self.learner.feature_names(self.observer.order)

    def _design(self, observer: ESO, omega_c: float) -> AdrcDesign:
        learns = not isinstance(self.learner, NoLearner)
        gains = law_gains(observer.degree, omega_c, self.law_poles)
        gains = gains * (0.5 if self.half_gain else 1.0)
        law = np.append(gains, np.zeros(observer.order - observer.degree))
        learner = checked_learner_design(self.learner, observer, self._learner_omega_c)
        return AdrcDesign(
            eso=observer.model,
            law=law,
            cancel=observer.cancel,
            cancel_f=observer.cancel_f,
            feedback=feedback_design(self.feedback, observer.degree, omega_c),
            feedforward=feedforward_design(self.feedforward, observer),
            fade=math.exp(-omega_c * observer.dt),
            b0=observer.b0,
            limits=self._limits,
            learner=learner,
            lag=lag_of(observer) if learns else NO_LAG,
            guard=UnguardedDesign() if self.guard is None else self.guard.design(observer, law),
            learns=learns,
            # A guard judges the output itself; an output set from outside is kept in any case.
            forgets=self.guard is None and type(learner) in forget.implementations,
            window=window_samples(observer) if learns else 0,
        )

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints; no learner is none."""
        found = super().described()
        if isinstance(self.learner, NoLearner):
            del found["learner"]
        return found

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.observer.dt

    @property
    def derivatives(self) -> int:
        """Number of derivatives of the reference that are fed forward."""
        return derivatives_used(self.feedforward, self.observer.degree)

    @property
    def channels(self) -> Channels:
        """Name and width of each recorded channel, in order."""
        estimates = (("x_hat", self.observer.order), ("f_residual", 1), ("f_learned", 1))
        by_model = isinstance(self.feedforward, Feedforward)
        forward = (("u_feedforward", 1),) if by_model else ()
        guard = () if self.guard is None else GUARD_CHANNELS
        rates = self.observer.disturbance_order - 1
        of_f = (("f_derivatives", rates),) if rates else ()
        return (*estimates, ("status", 1), *of_f, *forward, *guard, ("theta", len(self.features)))

    def initial_state(self) -> AdrcState:
        """Return a state before the first sample, with nothing learned."""
        design, guard = self.parameters, UnguardedMemory(np.zeros(0))
        return AdrcState(
            z=np.zeros(self.observer.states),
            seen=np.zeros(self.observer.estimates),
            reference=np.zeros(self.derivatives),
            loop=AdrcLoop.zeros(),
            learner=self.learner.memory(design.learner),
            shadow=lag_memory(design.lag, 1),
            guard=guard if self.guard is None else self.guard.memory(design.guard),
            watch=LearnerWatch.zeros(),
        )

    def step(self, r: float, y: float, *derivatives: float) -> float:
        """Take one sample: return the control signal [u-unit] for reference and measurement.

        ``r`` and ``y`` are in y-units. With ``feedforward``, r', r'', … may follow [y-unit/s^i];
        missing ones, and those that are not finite, count as zero.

        A measurement that is not finite is replaced by the one that the observer expects, a
        reference by the last finite one; ``estimate.status`` reports it. The observer assumes that
        the returned value is applied: set limits by ``u_min``, ``u_max`` and ``rate_limit``, or
        call ``applied`` with what was applied.

        The first call compiles, or loads from the disk cache; ``prepare`` does that beforehand.
        Raises ``ValueError`` for more derivatives than are fed forward.
        """
        if self._packed is None:
            self.prepare()
        if derivatives or self.derivatives:
            self._set_derivatives(derivatives)
        try:
            return self._step(self._packed, r, y)
        except TypeError:
            raise TypeError(f"r = {r!r}, y = {y!r}: must be numbers") from None

    def _set_derivatives(self, derivatives: tuple[float, ...]) -> None:
        if len(derivatives) > self.derivatives:
            usable = f"it uses {self.derivatives} at most"
            rule = usable if self.derivatives else "make the controller with feedforward=True"
            given = f"step was given {len(derivatives)} derivatives of the reference"
            raise ValueError(f"{given}: {rule}")
        values = np.array(derivatives, dtype=np.float64)
        set_reference_derivatives(self.parameters, self._state, values)

    def start(self, y: float, u: float = 0.0, r: float | None = None) -> None:
        """Start at a plant that rests at ``y`` under ``u``: the next ``step`` continues from ``u``.

        What was learned is kept. A controller that is not started begins at its first sample with
        f̂ = 0, which is right for a plant at rest without load and makes a bump under load.

        Parameters
        ----------
        y
            measurement [y-unit].
        u
            control signal that holds the plant there [u-unit]; should be within the limits.
        r
            reference of the next step [y-unit]; ``y`` by default. With another one u still
            continues without a jump, and the move begins with the observer's own dynamics.
        """
        y, u = checks.signal("y", y), checks.signal("u", u)
        goal = y if r is None else checks.signal("r", r)
        number = self._state.z.dtype.type  # of the precision of the state
        signals = map(number, (y, u, goal))
        start_at_rest(self.parameters, self._state, samples_to_settle(self.observer), *signals)

    def start_at(self, x: Any, f: Any = 0.0, *, u: float = 0.0, r: float | None = None) -> None:
        """Start with given estimates, for a plant in motion; what was learned is kept.

        They are those of the sample before the next ``step``, which takes u for the control signal
        applied since then. Unlike after ``start``, the next u is the law's own; call ``hand_over``
        next for one that continues from ``u``.

        Parameters
        ----------
        x
            estimates x̂ (n,), y and its derivatives; see ``observer.states_of`` if there are zeros.
        f
            total disturbance [y-unit/s^n]; for an observer with more extended states also a list
            of f, f', … [y-unit/s^(n+j)], the missing ones zero.
        u
            control signal applied until the next step [u-unit]; a delayed one has the same past.
        r
            reference until the next one that is finite [y-unit]; ``x[0]`` by default.
        """
        estimates = checks.vector("x", x, self.observer.order)
        u = checks.signal("u", u)
        most = self.observer.disturbance_order
        given = checks.vector("f", checks.finite("f", f) if np.ndim(f) == 0 else f)
        if given.size > most:
            raise ValueError(f"f = {f!r}: the observer estimates {most} of f, f', …: give as many")
        of_f = np.append(given, np.zeros(most - given.size))
        goal = float(estimates[0]) if r is None else checks.signal("r", r)
        start_in_motion(self.parameters, self._state, estimates, of_f, u, goal)

    def track(self, r: float, y: float, u: float, *derivatives: float) -> float:
        """Take one sample in manual operation: ``u`` is applied, unlimited, until the next sample.

        Return the control signal that the controller would have applied [u-unit]; ``r``, ``y`` and
        ``derivatives`` are as for ``step``.
        """
        with manual_operation(self._state, checks.signal("u", u)):
            self.step(r, y, *derivatives)
        return float(self._state.loop[0].u_limited)

    def hand_over(self) -> None:
        """End manual operation: the next ``step`` continues from the u of the last ``track``.

        Raises ``ValueError`` before the first sample.
        """
        if self._state.loop[0].started == 0.0:
            raise ValueError("hand_over: there was no sample yet; call track or start before")
        self._state.loop[0].bumpless = 1.0

    def increment(self, r: float, y: float, *derivatives: float) -> float:
        """Take one sample: return the change of the control signal [u-unit], within the limits.

        For actuators that take increments (steppers, valves, a drive that holds its set point). The
        law is that of ``step`` (Herbst, arXiv 1908.04610, section IV, shows that the two are one).
        If the actuator's position is not known, ``start(y)`` takes it as zero, f̂ includes the
        difference, and limits of magnitude refer to that zero.
        """
        before = float(self._state.loop[0].u)
        return self.step(r, y, *derivatives) - before

    def retune(self, *, omega_c: float | None = None, observer: ESO | None = None) -> None:
        """Change bandwidths while running, without a bump; allowed in every sample.

        The control signal continues from where the old gains would have it, and the difference
        decays with the new ``omega_c``. A faster observer still moves it in the middle of a motion,
        by its own better estimate. What was learned is kept. A call takes some milliseconds,
        because the designs are sampled again: ``prepare_retune`` does that beforehand, for a loop
        that has no such time. Raises ``ValueError`` for an observer of another kind, for a change
        of b0 or model that a learner's coefficients or the state do not allow; the controller is
        then unchanged.

        Parameters
        ----------
        omega_c
            new controller bandwidth [rad/s]; unchanged by default.
        observer
            new observer of the same order, form, structure and sample time, with another
            ``omega_o``, ``b0`` or model; unchanged by default. For a plant with zeros, or with a
            separate input for f, only ``omega_o`` may change.
        """
        self.prepare_retune(omega_c=omega_c, observer=observer)()

    def prepare_retune(
        self, *, omega_c: float | None = None, observer: ESO | None = None
    ) -> Callable[[], None]:
        """Design what ``retune`` changes to; the function returned applies it, in a step's time.

        It may be called at any later sample, any number of times, to switch between designs. The
        parameters, the rules and the errors are those of ``retune``.
        """
        omega_c = checks.optional(checks.positive, "omega_c", omega_c, "rad/s") or self.omega_c
        if observer is not None:
            check_replacement(self.observer, observer, not isinstance(self.learner, NoLearner))
        observer = observer or self.observer
        new = self._design(observer, omega_c)
        check_structure(self.parameters, new)
        warn_if_unwise(observer, omega_c)

        def apply() -> None:
            old, limits = self.parameters, self._limits
            self.parameters = new if new.limits is limits else new._replace(limits=limits)
            self.observer, self.omega_c = observer, omega_c
            change_design(old, self.parameters, self._state)
            self._pack_again()

        return apply

    @property
    def _external_fields(self) -> tuple[str, ...]:
        return tuple(f"learner.{name}" for name in getattr(self.learner, "external_fields", ()))

    def _external_snapshots(self, state: AdrcState) -> dict[str, Any]:
        if not self._external_fields:
            return {}
        snapshot = self.learner.snapshot(state.learner)  # type: ignore[attr-defined]
        return {f"learner.{name}": value for name, value in snapshot.items()}

    def _restore_external(self, state: AdrcState, snapshots: Mapping[str, Any]) -> None:
        named = {name.removeprefix("learner."): value for name, value in snapshots.items()}
        self.learner.recall(state.learner, named)  # type: ignore[attr-defined]

    @property
    def estimate(self) -> Estimate:
        """Estimates and status after the last step."""
        return self.read(self._state)

    def read(self, state: AdrcState) -> Estimate:
        """Return the estimates and the status in ``state``."""
        return read_estimate(self.parameters, state, self.features)


# ---- ADRC of order 1 for a first-order plant with dead time, K e^(−Ls)/(T s + 1) ----

RULES = ("simc", "amigo")
# Filter time as a share of dead time and integral time. At a tenth it raises 1/(modulus margin) by
# 0.12 at most, for T/L from 0.1 to 10 000; 1/9 is the largest share of T_i that an ADRC can have.
_FILTER = 0.1


class DeadTimeTuning(NamedTuple):
    """The three numbers of an ADRC of order 1."""

    b0: float  #: [y-unit/u-unit/s]
    omega_c: float  #: [rad/s]
    omega_o: float  #: [rad/s]


def dead_time_tuning(
    gain: float,
    time_constant: float,
    dead_time: float,
    *,
    rule: str = "simc",
    tau_c: float | None = None,
) -> DeadTimeTuning:
    """Return b0 and the bandwidths for a first-order plant with dead time.

    Parameters
    ----------
    gain
        steady-state gain K [y-unit/u-unit].
    time_constant
        T [s]. For an integrating plant ``k e^(−Ls)/s`` take a T far above 8 L, and K = k T.
    dead_time
        L [s]; include half of the sample time and other small lags.
    rule
        ``"simc"`` or ``"amigo"``.
    tau_c
        time constant of the closed loop [s], for ``"simc"`` only; ``dead_time`` by default. A
        larger one is slower and more robust.

    Raises
    ------
    ValueError
        for a gain of zero, a time that is not positive, ``tau_c`` with another rule, or numbers
        from which no finite b0 follows.

    Examples
    --------
    >>> [round(number, 3) for number in dead_time_tuning(2.0, time_constant=4.0, dead_time=1.0)]
    [2.571, 0.284, 4.858]
    """
    K = checks.nonzero("gain", gain, "or u does not reach y")
    T = checks.positive("time_constant", time_constant, "s")
    L = checks.positive("dead_time", dead_time, "s")
    if checks.one_of("rule", rule, RULES) == "amigo" and tau_c is not None:
        raise ValueError(f"tau_c = {tau_c!r} with rule = {rule!r}: only the rule 'simc' has it")
    closed = L if tau_c is None else checks.positive("tau_c", tau_c, "s")
    try:
        found = _solved(L, *(_simc(K, T, L, closed) if rule == "simc" else _amigo(K, T, L)))
        usable = all(math.isfinite(number) and number != 0.0 for number in found)
    except ArithmeticError:
        usable = False
    if not usable:
        raise ValueError(
            f"gain = {gain!r}, time_constant = {time_constant!r}, dead_time = {dead_time!r}: b0 "
            "and the bandwidths are beyond all numbers; check the units"
        )
    return found


def _simc(K: float, T: float, L: float, tau_c: float) -> tuple[float, float]:
    """Return K_c and T_i."""
    return T / (K * (L + tau_c)), min(T, 4.0 * (L + tau_c))


def _amigo(K: float, T: float, L: float) -> tuple[float, float]:
    """Return K_c and T_i."""
    Kc = (0.15 + (0.35 - L * T / (L + T) ** 2) * T / L) / K
    return Kc, 0.35 * L + 13.0 * L * T**2 / (T**2 + 12.0 * L * T + 7.0 * L**2)


def _solved(L: float, Kc: float, Ti: float) -> DeadTimeTuning:
    """Return the ADRC that is this PI controller with a filter."""
    tf = _FILTER * min(L, Ti)
    x = Ti / tf
    omega_o = (x + 3.0 + math.sqrt((x - 1.0) * (x - 9.0))) / (4.0 * Ti)
    omega_c = 1.0 / tf - 2.0 * omega_o
    return DeadTimeTuning(omega_o * (omega_o + 2.0 * omega_c) * tf / Kc, omega_c, omega_o)


def adrc_for_dead_time(
    gain: float,
    time_constant: float,
    dead_time: float,
    *,
    dt: float,
    rule: str = "simc",
    tau_c: float | None = None,
    learner: Learner | None = None,
    guard: Guard | None = None,
    **options: Any,
) -> ADRC:
    """Return an ADRC of order 1 for a first-order plant with dead time.

    Parameters
    ----------
    gain, time_constant, dead_time, rule, tau_c
        as for ``dead_time_tuning``; half a sample time is added to the dead time here.
    dt
        sample time [s].
    learner, guard, **options
        passed on to ``ADRC``.

    Raises
    ------
    ValueError
        as ``dead_time_tuning`` and ``ADRC``.
    """
    dt = checks.positive("dt", dt, "s")
    dead_time = checks.positive("dead_time", dead_time, "s") + 0.5 * dt
    b0, omega_c, omega_o = dead_time_tuning(gain, time_constant, dead_time, rule=rule, tau_c=tau_c)
    observer = ESO.model_free(order=1, b0=b0, omega_o=omega_o, dt=dt)
    return ADRC(observer, omega_c, learner=learner, guard=guard, **options)
