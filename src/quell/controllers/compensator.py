"""A disturbance compensator: observer, learner and guard on top of any controller.

A controller or drive that stays as it is asks for u_0. The compensator adds what cancels the total
disturbance f, as an ESO of the plant between u and y estimates it and a learner predicts it::

    u = sat( u_0 − (f_L + Δf̂) / b0 )

and for a learner with ``f_L = h + s u`` (``controllers/law.py``) the u that solves it exactly,
``(b0 u_0 − h − Δf̂)/(b0 + s)``. The plant may be a closed drive that takes commands of position or
speed: then a known model (a, b) of it, or an order and a b0, is that of the closed drive, and f is
what the model misses (arXiv 2512.05292; the Disturbance Compensator block of Simulink is of this
form). With a model the drive keeps its dynamics, ``a · x̂`` is not cancelled.

ADRC is this compensator with the law ``u_0 = (k_1 (r − x̂_1) + … + a · x̂)/b0``: both have one
kernel, that of ``controllers/law.py``.

A compensator changes the loop: between u_0 and y, the controller finds the plant of the observer,
but with the observer's lag, and with the margins of a loop of its own. For an observer of order n
with all poles at −ω_o and no model, the feedback that is added is::

    u = u_0 − Q(s) (s^n y/b0 − u),     Q = ω_o^(n+1) / (s + ω_o)^(n+1),     n + 1 = N

So it integrates below ω_o/N, and at the resonance of a flexible plant it is as strong as Q there.
``analyse`` and ``tune`` judge that loop together with the controller's
(``Compensated``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers import bumpless
from quell.controllers.base import Limits, RateLimit, changed_limits, checked_limits
from quell.controllers.held import HeldPlant, NoHeldMemory, NoHeldPlant, check_rest
from quell.controllers.law import (
    AdrcDesign,
    AdrcLoop,
    AdrcState,
    ControlGiven,
    LinearFeedback,
    ModelFeedforward,
    has_reference_at_start,
    law_gains,
)
from quell.controllers.safe_set import NoSafeSet, NoSafeSetMemory, SafeSet
from quell.controllers.schedule import (
    NoSchedule,
    NoScheduleMemory,
    Point,
    Schedule,
    ScheduleDesign,
    checked_schedule,
    set_signal,
)
from quell.controllers.stateful import Retuning, StatefulController
from quell.guard import (
    GUARD_CHANNELS,
    Guard,
    Reason,
    UnguardedDesign,
    UnguardedMemory,
    write_channels,
)
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
    window_samples,
)
from quell.observers.eso import ESO, with_gains
from quell.types import Channels, Status, Vector, warn

# ---- The estimates of a compensator or an ADRC after a step ----


class Estimate(NamedTuple):
    """Estimates and status of a compensator or an ADRC after a step."""

    x: Vector
    """(n,): y and its derivatives; if the plant has zeros, see ``observer.states_of``."""
    f: float
    """Total disturbance ``f_learned + f_residual`` [y-unit/s^n; y-unit/s^f_degree with zeros]."""
    f_learned: float
    """The learner's share, f_L; with a guard its constant part is free, and ``f`` is right."""
    f_residual: float
    """The observer's share, Δf̂."""
    theta: dict[str, float]
    """The learner's coefficients by feature; with a table of b0 those for the observer's b0."""
    u: float
    """The applied control signal."""
    status: Status
    """Status flags of the step."""
    authority: float = 1.0
    """Share of its output that the guard allows the learner."""
    error_plain: float = math.nan
    """RMS error in f of an ESO without learner, as the guard estimates it [y-unit/s^n].

    With a table of b0 it is for the observer's b0, as ``error_learned``.
    """
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
    learned, residual = float(state.loop[0].f_learned), float(state.estimates[order])
    guarded: dict[str, Any] = {}
    row = np.zeros(len(GUARD_CHANNELS))
    if write_channels(design.guard, state.guard, row):
        guarded = dict(zip((name for name, _ in GUARD_CHANNELS), row.tolist(), strict=True))
        guarded["reason"] = Reason(int(guarded["reason"]))
    return Estimate(
        x=state.estimates[:order].copy(),
        f=learned + residual,
        f_learned=learned,
        f_residual=residual,
        theta=dict(zip(features, theta.tolist(), strict=True)),
        u=float(state.loop[0].u),
        status=Status(int(state.loop[0].status)),
        **guarded,
        f_derivatives=state.estimates[order + 1 :].copy(),
    )


# ---- The compensator ----

# The bandwidth of a loop is told by the poles of a model that are slower than this share of the
# fastest one; a model with slower poles integrates, and its loop is closed by others.
_INTEGRATES = 1e-6


class Compensator(StatefulController):
    """Observer, learner and guard on top of any controller: ``u = u_0 − (f_L + Δf̂)/b0``.

    ``step(u_0, y)`` takes one sample. In ``simulate``, in an exported program and in the real-time
    loop the reference of a compensator is u_0, in units of u. ``Compensated(controller,
    compensator)`` is both in one.

    Parameters
    ----------
    observer
        of the plant between u and y, which may be a closed drive that takes commands: model-free
        with its order and b0, or model-based. It sets dt.
    omega_c
        bandwidth of the loop in which the compensator works [rad/s], from which a learner and a
        guard take their scales, and with which a difference after ``hand_over`` decays. By default
        with a learner that of the observer's model, and needed if there is no model of a stable
        plant; without a learner that of the observer's lag.
    learner
        predicts f and feeds it forward; none by default.
    guard
        limits the learner to the authority that it has earned, which is full without a guard.
    u_min, u_max
        limits of the control signal [u-unit].
    rate_limit
        largest rate of the control signal, in both directions, or (lowest, highest) [u-unit/s].
    safe_set
        bands that y and its rate do not leave, whatever u_0 and the learner ask for; none by
        default.
    held
        detects a plant that is held and undoes at its release what the observer made of it; none by
        default. ``set_held`` needs none.
    schedule
        tables of b0 and omega_o over one or two signals, which the gains follow; none by default.

    Raises
    ------
    ValueError
        for an observer whose f does not enter the plant where u does, so that no u cancels it; a
        learner without a bandwidth; a guard that is certified for plants, whose loop is not known
        here; limits in the wrong order.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=1, b0=2.0, omega_o=20.0, dt=0.01)
    >>> compensator = Compensator(observer, u_max=1.5)
    >>> [round(compensator.step(1.0, y=0.0), 3) for _ in range(3)]
    [1.0, 1.033, 1.088]

    y does not move although u acts, so u grows.
    """

    _u_is_given = True

    def __init__(
        self,
        observer: ESO,
        *,
        omega_c: float | None = None,
        learner: Learner | None = None,
        guard: Guard | None = None,
        u_min: float = -math.inf,
        u_max: float = math.inf,
        rate_limit: RateLimit = math.inf,
        safe_set: SafeSet | None = None,
        held: HeldPlant | None = None,
        schedule: Schedule | None = None,
    ) -> None:
        self._take_parts(observer, learner, guard, safe_set, held, schedule)
        if observer.cancel_f == 0.0:
            raise ValueError(
                "observer: f does not enter the plant where u does, so adding −f̂/b0 to u does not "
                "cancel it; take an observer with matched f (without E), or an ADRC"
            )
        if guard is not None and guard.certified_for is not None:
            raise ValueError(
                "guard: certified_for bounds the loop of an ADRC, with its law; that of a "
                "compensator has another controller in it; use Guard() without it"
            )
        if omega_c is None:
            omega_c = _bandwidth_of_model(observer) if self._learns else 1.0 / observer.lag_time
        self.omega_c = self._learner_omega_c = checks.positive("omega_c", omega_c, "rad/s")
        self._limits = checked_limits(u_min, u_max, rate_limit, observer.dt)
        self._initialise()
        self._warn_of_idle_guard()

    def _take_parts(
        self, observer: Any, learner: Any, guard: Any, safe_set: Any, held: Any, schedule: Any
    ) -> None:
        """Check and keep observer, learner, guard and the other parts."""
        if not isinstance(observer, ESO):
            raise ValueError(f"observer = {observer!r}: must be an ESO, as from ESO.model_free")
        self.observer = observer
        self.guard = guard
        self.learner: Learner = NoLearner() if learner is None else learner
        if isinstance(self.learner, type) or not all(
            hasattr(self.learner, name) for name in ("design", "memory", "feature_names")
        ):
            example = "for example quell.learners.Kalman()"
            raise ValueError(f"learner = {learner!r}: must be a learner, {example}, or None")
        if guard is not None and not isinstance(guard, Guard):
            raise ValueError(f"guard = {guard!r}: must be a quell.Guard(), or None")
        if safe_set is not None and not isinstance(safe_set, SafeSet):
            raise ValueError(f"safe_set = {safe_set!r}: must be a quell.SafeSet(), or None")
        self.safe_set = safe_set
        if held is not None and not isinstance(held, HeldPlant):
            raise ValueError(f"held = {held!r}: must be a quell.HeldPlant(), or None")
        self.held = held
        self.schedule: Any = checked_schedule(schedule)
        self._check_schedule()

    def _warn_of_idle_guard(self) -> None:
        if self.guard is not None and not self._learns:
            rule = "has no effect without a learner; give one, or no guard"
            warn(f"guard = {self.guard!r} {rule}")

    @property
    def _learns(self) -> bool:
        return not isinstance(self.learner, NoLearner)

    def _update_parameters(self) -> None:
        self.parameters = self._design(self.observer)
        self.features = self.learner.feature_names(self.observer.order)

    def _design(self, observer: ESO) -> AdrcDesign:
        """Return the parameters with an observer: u_0 takes the place of the law."""
        nothing = np.zeros(observer.order)
        return self._with_law(
            observer,
            self.gains,
            law=nothing,
            cancel=nothing,
            feedback=LinearFeedback(),
            feedforward=ControlGiven(observer.b0),
            fade=math.exp(-self._learner_omega_c * observer.dt),
        )

    @property
    def gains(self) -> Vector:
        """Gains k (n,) of the loop with which learner and guard reckon: of an ADRC its law's."""
        return padded(law_gains(self.observer.degree, self.omega_c), self.observer.order)

    def _with_law(self, observer: ESO, gains: Vector, **law: Any) -> AdrcDesign:
        """Return the parameters with a law; ``gains`` k (n,) are those of the closed loop."""
        learner = checked_learner_design(self.learner, observer, self._learner_omega_c)
        schedule = self._schedule_design(observer)
        return AdrcDesign(
            eso=observer.model,
            cancel_f=observer.cancel_f,
            b0=observer.b0,
            limits=self._limits,
            safe_set=self._safe_set_design(observer),
            held=NoHeldPlant() if self.held is None else self.held.design(observer),
            schedule=schedule,
            learner=learner,
            lag=lag_of(observer) if self._learns else NO_LAG,
            guard=UnguardedDesign() if self.guard is None else self.guard.design(observer, gains),
            learns=self._learns,
            # A guard judges the output itself; an output set from outside is kept in any case.
            forgets=self.guard is None and type(learner) in forget.implementations,
            window=window_samples(observer) if self._learns else 0,
            guarded=self.guard is not None,
            scheduled=not isinstance(schedule, NoSchedule),
            has_safe_set=self.safe_set is not None,
            has_held=self.held is not None,
            has_model=isinstance(law["feedforward"], ModelFeedforward),
            nonlinear=not isinstance(law["feedback"], LinearFeedback),
            **law,
        )

    def _safe_set_design(self, observer: ESO, limits: Limits | None = None) -> Any:
        """Return the parameters of the safe set for limits, by default the present ones."""
        if self.safe_set is None:
            return NoSafeSet()
        ratio = 1.0
        if isinstance(self.schedule, Schedule):
            ratio = self.schedule.largest_ratio(observer)
        return self.safe_set.design(observer, limits or self._limits, ratio)

    def _check_schedule(self) -> None:
        """Raise a ``ValueError`` for parts that are made for one b0 or one omega_o."""
        if self.schedule is None:
            return
        parts = {"learner": self._learns, "safe_set": self.safe_set is not None}
        parts["held"] = self.held is not None
        part = next((name for name, is_there in parts.items() if is_there), None)
        if self.schedule.b0 is not None and part is not None:
            if not isinstance(self.schedule, Schedule):
                raise ValueError(
                    f"schedule = {self.schedule!r} with {part}: it changes b0 where the machine "
                    f"does not change, so what the {part.replace('_', ' ')} knows of f would be "
                    "wrong; take a table over a signal (Schedule), or leave one of them out"
                )
            if np.any(self.observer.cancel != 0.0):
                raise ValueError(
                    f"schedule.b0 with {part}: the observer has a model with a = "
                    f"{self.observer.cancel.tolist()}, which follows the inertia, too, and does "
                    "not follow a table of b0; take ESO.model_free"
                )
        if self.schedule.b0 is not None and getattr(self.guard, "certified_for", None) is not None:
            raise ValueError(
                "schedule.b0 with a guard that is certified_for a plant: the bound is that of one "
                "b0; give Guard() without it"
            )
        if self.schedule.omega_o is not None and self._learns:
            raise ValueError(
                "schedule.omega_o with learner: each feature is filtered with the observer's lag, "
                "and a change of omega_o changes the filter under what is in it, so the learner "
                "would take the change for one of the plant; schedule b0 and omega_c only"
            )

    def _schedule_design(self, observer: ESO) -> Any:
        if self.schedule is None:
            return NoSchedule()
        schedule = self._with_parts(self.schedule.design(observer, self.omega_c, None), observer)
        return schedule._replace(fixed=np.ones(1) if schedule.has_b0 else np.zeros(0))  # u_0

    def _with_parts(self, schedule: Any, observer: ESO) -> Any:
        """Return parameters of a schedule with what the other parts of the controller need."""
        if not isinstance(schedule, ScheduleDesign) or not schedule.has_b0:
            return schedule
        return schedule._replace(
            extended=observer.disturbance_order if self._learns else 0,
            has_safe_set=self.safe_set is not None,
            has_held=self.held is not None,
        )

    @property
    def gain_estimate(self) -> Any:
        """The estimate of b by an ``OnlineGain``; a ``ValueError`` if b0 is not estimated."""
        if not hasattr(self.schedule, "read"):
            raise ValueError("gain_estimate: give schedule=quell.OnlineGain(low, high) for one")
        return self.schedule.read(self._state.schedule)

    @property
    def external_signals(self) -> int:
        """Number of external signals that the schedule follows."""
        return 0 if self.schedule is None else self.schedule.external

    def set_signals(self, *values: float) -> None:
        """Set the external signals of the schedule for the next steps, until they are set again.

        One that is not finite is ignored: the last one stays, and ``status`` reports it. Before the
        first one the gains are those of observer and omega_c.
        """
        if len(values) != self.external_signals:
            raise ValueError(
                f"set_signals was given {len(values)} signals: the schedule follows "
                f"{self.external_signals} external ones"
            )
        for i, value in enumerate(values):
            set_signal(self._state.schedule, i, float(value))

    def at(self, *signals: float) -> Any:
        """Return the controller without schedule that this one is at fixed signals.

        ``analyse`` it to see poles and margins there. It is new, and shares no state.

        Parameters
        ----------
        signals
            value of each signal of the schedule; one outside of its table is at its end.
        """
        if self.schedule is None:
            raise ValueError("at: the controller has no schedule; analyse it itself")
        if len(signals) != len(self.schedule.signals):
            raise ValueError(f"at{signals!r}: must be a value for each of {self.schedule.signals}")
        values = [checks.finite("signal", value) for value in signals]
        base = Point(self.observer.b0, self.omega_c, self.observer.omega_o)
        found = self.schedule.at(values, base)
        made = type(self).__new__(type(self))
        vars(made).update(vars(self), schedule=None, omega_c=found.omega_c)
        ratio = found.b0 / self.observer.b0
        made.observer = with_gains(self.observer, found.b0, found.omega_o)
        if self.safe_set is not None:  # its f_rate is that of the observer's b0
            made.safe_set = replace(self.safe_set, f_rate=ratio * self.safe_set.f_rate)
        made._take_inertia(1.0 / ratio)
        made._initialise()
        return made

    def with_b0(self, b0: float) -> Any:
        """Return the controller for an actuator of another gain, ``b0`` in place of the observer's.

        What it knows in units of u is converted: limits, a feedforward, ``largest_u`` of a safe
        set. It is new, and shares no state. Raises ``ValueError`` for a b0 of zero, and for a
        controller with a schedule.
        """
        checks.nonzero("b0", b0, "or u does not reach y")
        if self.schedule is not None:
            raise ValueError("with_b0: the controller has a schedule; make one for this b0")
        ratio = b0 / self.observer.b0
        made = type(self).__new__(type(self))
        vars(made).update(vars(self))
        made.observer = with_gains(self.observer, b0, self.observer.omega_o)
        if self.safe_set is not None:
            largest = self.safe_set.largest_u / abs(ratio)
            made.safe_set = replace(self.safe_set, largest_u=largest)
        low, high = sorted((self._limits.low / ratio, self._limits.high / ratio))
        least, most = sorted((self._limits.least_change / ratio, self._limits.most_change / ratio))
        made._limits = Limits(low, high, most, least)
        made._take_gain(ratio)
        made._initialise()
        return made

    def _take_gain(self, ratio: float) -> None:
        """Convert what depends on the actuator to a gain ``ratio`` times as large: nothing here."""

    def _take_inertia(self, ratio: float) -> None:
        """Convert what depends on the inertia to ``ratio`` times as much: nothing here."""

    def set_limits(
        self,
        *,
        u_min: float | None = None,
        u_max: float | None = None,
        rate_limit: RateLimit | None = None,
    ) -> None:
        """Change limits of the control signal while running; see ``StatefulController``."""
        self._check_own("set_limits")
        if self.safe_set is not None and self.safe_set.gain_error > 0.0:
            new = changed_limits(self._limits, self.dt, u_min, u_max, rate_limit)
            safe_set = self._safe_set_design(self.observer, new)
            self.parameters = self.parameters._replace(safe_set=safe_set)
        super().set_limits(u_min=u_min, u_max=u_max, rate_limit=rate_limit)

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
        return 0

    @property
    def channels(self) -> Channels:
        """Name and width of each recorded channel, in order."""
        estimates = (("x_hat", self.observer.order), ("f_residual", 1), ("f_learned", 1))
        guard = () if self.guard is None else GUARD_CHANNELS
        rates = self.observer.disturbance_order - 1
        of_f = (("f_derivatives", rates),) if rates else ()
        forward = self._channels_of_law
        return (*estimates, ("status", 1), *of_f, *forward, *guard, ("theta", len(self.features)))

    @property
    def _channels_of_law(self) -> Channels:
        return ()

    def initial_state(self) -> AdrcState:
        """Return a state before the first sample, with nothing learned."""
        design, guard = self.parameters, UnguardedMemory(np.zeros(0))
        state = AdrcState(
            z=np.zeros(self.observer.states),
            estimates=np.zeros(self.observer.estimates),
            reference=np.zeros(self.derivatives),
            loop=AdrcLoop.zeros(),
            learner=self.learner.memory(design.learner),
            lag_state=lag_memory(design.lag, 1),
            guard=guard if self.guard is None else self.guard.memory(design.guard),
            watch=LearnerWatch.zeros(),
            safe_set=(
                NoSafeSetMemory(np.zeros(0))
                if self.safe_set is None
                else self.safe_set.memory(design.safe_set)
            ),
            held=(
                NoHeldMemory(np.zeros(0))
                if self.held is None
                else self.held.memory(design.held, self.observer)
            ),
            schedule=(
                NoScheduleMemory(np.zeros(0))
                if self.schedule is None
                else self.schedule.memory(design.schedule)
            ),
        )
        state.loop[0].has_reference = has_reference_at_start(design.feedforward)
        return state

    def step(self, u_0: float, y: float) -> float:
        """Take one sample: return the control signal [u-unit] for u_0 and the measurement.

        A u_0 that is not finite is replaced by the last finite one, zero before the first; a
        measurement by the one that the observer expects; ``estimate.status`` reports it. The
        observer assumes that the returned value is applied: set limits by ``u_min``, ``u_max`` and
        ``rate_limit``, or call ``applied`` with what was applied.

        The first call compiles, or loads from the disk cache; ``prepare`` does that beforehand.
        """
        if self._packed is None:
            self.prepare()
        try:
            u: float = self._step(self._packed, u_0, y)
        except TypeError:
            raise TypeError(f"u_0 = {u_0!r}, y = {y!r}: must be numbers") from None
        return u

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
            continues without a jump, and the move begins with the observer's own dynamics. Of a
            compensator u_0 of the next step [u-unit]; ``u`` by default.
        """
        y, u = checks.signal("y", y), checks.signal("u", u)
        goal = (u if self._u_is_given else y) if r is None else checks.signal("r", r)
        number = self._state.z.dtype.type  # of the precision of the state
        signals = map(number, (y, u, goal))
        samples = bumpless.samples_to_settle(self.observer)
        bumpless.start_at_rest(self.parameters, self._state, samples, *signals)

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
            of f, f', … [y-unit/s^(n+j)], the missing ones zero. With a table of b0 it is the one
            for the observer's b0.
        u
            control signal applied until the next step [u-unit]; a delayed one has the same past.
        r
            reference until the next one that is finite [y-unit]; ``x[0]`` by default. Of a
            compensator u_0 [u-unit]; ``u`` by default.
        """
        estimates = checks.vector("x", x, self.observer.order)
        u = checks.signal("u", u)
        most = self.observer.disturbance_order
        given = checks.vector("f", checks.finite("f", f) if np.ndim(f) == 0 else f)
        if given.size > most:
            raise ValueError(f"f = {f!r}: the observer estimates {most} of f, f', …: give as many")
        of_f = np.append(given, np.zeros(most - given.size))
        usual = u if self._u_is_given else float(estimates[0])
        goal = usual if r is None else checks.signal("r", r)
        bumpless.start_in_motion(self.parameters, self._state, estimates, of_f, u, goal)

    def track(self, r: float, y: float, u: float, *derivatives: float) -> float:
        """Take one sample in manual operation: ``u`` is applied, unlimited, until the next sample.

        Return the control signal that would have been applied [u-unit]; ``r`` (u_0 of a
        compensator), ``y`` and ``derivatives`` are as for ``step``.
        """
        with bumpless.manual_operation(self._state, checks.signal("u", u)):
            self.step(r, y, *derivatives)
        return float(self._state.loop[0].u_limited)

    def hand_over(self) -> None:
        """End manual operation: the next ``step`` continues from the u of the last ``track``.

        Raises ``ValueError`` before the first sample.
        """
        if self._state.loop[0].started == 0.0:
            raise ValueError("hand_over: there was no sample yet; call track or start before")
        self._state.loop[0].bumpless = 1.0

    def set_held(self, held: bool) -> None:
        """Set whether the plant is held, by a brake for instance: u does not act until it is not.

        Call it when that changes. While it is held the observer rests at y with the f̂ of before,
        and the law works with it, so nothing winds up and the release makes no bump.
        ``estimate.status`` has the flag ``HELD``. It stays across ``start`` and ends with
        ``reset``. Raises ``ValueError`` for a plant with zeros, whose rest the observer does not
        know.
        """
        check_rest(self.observer, "set_held")
        self._state.loop[0].held = 1.0 if checks.flag("held", held) else 0.0

    def increment(self, r: float, y: float, *derivatives: float) -> float:
        """Take one sample: return the change of the control signal [u-unit], within the limits.

        For actuators that take increments (steppers, valves, a drive that holds its set point). The
        law is that of ``step`` (Herbst, arXiv 1908.04610, section IV, shows that the two are one).
        If the actuator's position is not known, ``start(y)`` takes it as zero, f̂ includes the
        difference, and limits of magnitude refer to that zero.
        """
        before = float(self._state.loop[0].u)
        return self.step(r, y, *derivatives) - before

    def retune(self, *, observer: ESO) -> None:
        """Change the observer while running, without a bump; allowed in every sample.

        As ``ADRC.retune``, with the same errors.

        Parameters
        ----------
        observer
            new observer of the same order, form, structure and sample time.
        """
        self._change_to(partial(self._retuning, observer=observer), compiles=False)()

    def prepare_retune(self, *, observer: ESO) -> Callable[[], None]:
        """Return a function that does what ``retune`` does, in a step's time.

        As ``ADRC.prepare_retune``.
        """
        return self._change_to(partial(self._retuning, observer=observer), compiles=True)

    def _retuning(self, *, omega_c: float | None = None, observer: ESO | None = None) -> Retuning:
        """Return the parameters with another observer, and what sets the attributes for them."""
        if omega_c is not None or observer is None:
            rule = "a compensator has no law; give another observer"
            raise ValueError(f"omega_c = {omega_c!r}: {rule}")
        bumpless.check_replacement(self.observer, observer, self._learns)
        if self.schedule is not None:
            self.schedule.check_retuning(self.observer, observer, False)
        return self._retuning_to(self._design(observer), observer=observer)

    def _retuning_to(self, new: AdrcDesign, **named: Any) -> Retuning:
        """Return parameters, and what sets the attributes ``named``; check their structure."""
        bumpless.check_structure(self.parameters, new)
        return Retuning(new, partial(vars(self).update, named))

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


def padded(gains: Vector, size: int) -> Vector:
    """Return gains with zeros behind them up to a size."""
    return np.append(gains, np.zeros(size - gains.size))


def _bandwidth_of_model(observer: ESO) -> float:
    """Return the geometric mean of the slowest poles of a model, as many as its relative degree.

    Raises ``ValueError`` for a model that has none, integrates or is unstable.
    """
    poles = np.roots(np.append(1.0, observer.cancel[::-1]))
    size = np.abs(poles)
    slowest = poles[np.argsort(size)][: observer.degree]
    if not (np.all(slowest.real < 0.0) and np.min(size) > _INTEGRATES * np.max(size)):
        raise ValueError(
            "omega_c = None: a learner takes its scales from the bandwidth of the loop, and the "
            "observer has no model of a stable plant that tells it; give omega_c, the bandwidth "
            "[rad/s] of the loop that u_0 closes"
        )
    return float(np.exp(np.mean(np.log(np.abs(slowest)))))
