"""The ADRC controller: an ESO, the law around it (``law.py``), optional learner and guard."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.adrc.estimate import Estimate, read_estimate
from quell.controllers.adrc.feedback import NonlinearFeedback, checked_feedback, feedback_design
from quell.controllers.adrc.feedforward import (
    Feedforward,
    checked_feedforward,
    derivatives_used,
    feedforward_design,
)
from quell.controllers.adrc.handover import (
    change_design,
    check_replacement,
    check_structure,
    manual_operation,
    samples_to_settle,
    start_at_rest,
    start_in_motion,
)
from quell.controllers.adrc.law import AdrcDesign, AdrcLoop, AdrcState, law_gains
from quell.controllers.base import set_reference_derivatives
from quell.controllers.design_checks import check_zeros, warn_if_unwise
from quell.controllers.limits import RateLimit, checked_limits
from quell.controllers.stateful import StatefulController
from quell.guard import GUARD_CHANNELS, Guard, UnguardedDesign, UnguardedMemory
from quell.learners.base import Learner, NoLearner, checked_design, forget
from quell.learners.lag import NO_LAG, lag_memory, lag_of
from quell.learners.recovery import LearnerWatch, window_samples
from quell.observers.eso import ESO
from quell.types import Channels
from quell.warn import warn


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

    def _update_parameters(self) -> None:
        self.parameters = self._design(self.observer, self.omega_c)
        self.features = self.learner.feature_names(self.observer.order)

    def _design(self, observer: ESO, omega_c: float) -> AdrcDesign:
        learns = not isinstance(self.learner, NoLearner)
        gains = law_gains(observer.degree, omega_c, self.law_poles)
        gains = gains * (0.5 if self.half_gain else 1.0)
        law = np.append(gains, np.zeros(observer.order - observer.degree))
        learner = checked_design(self.learner, observer, self._learner_omega_c)
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
        because the designs are sampled again. Raises ``ValueError`` for an observer of another
        kind, for a change of b0 or model that a learner's coefficients or the state do not allow;
        the controller is then unchanged.

        Parameters
        ----------
        omega_c
            new controller bandwidth [rad/s]; unchanged by default.
        observer
            new observer of the same order, form, structure and sample time, with another
            ``omega_o``, ``b0`` or model; unchanged by default. For a plant with zeros, or with a
            separate input for f, only ``omega_o`` may change.
        """
        omega_c = checks.optional(checks.positive, "omega_c", omega_c, "rad/s") or self.omega_c
        if observer is not None:
            check_replacement(self.observer, observer, not isinstance(self.learner, NoLearner))
        observer = observer or self.observer
        old, new = self.parameters, self._design(observer, omega_c)
        check_structure(old, new)
        self.observer, self.omega_c, self.parameters = observer, omega_c, new
        warn_if_unwise(observer, omega_c)
        change_design(old, new, self._state)
        self._pack_again()

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
