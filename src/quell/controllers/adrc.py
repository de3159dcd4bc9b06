"""The ADRC controller: an ESO, its law, optional learner and guard.

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
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.base import RateLimit, checked_limits, set_reference_derivatives
from quell.controllers.bumpless import check_replacement
from quell.controllers.compensator import Compensator, padded
from quell.controllers.feedforward import (
    Feedforward,
    checked_feedforward,
    derivatives_used,
    feedforward_design,
)
from quell.controllers.from_pid import equal_to_pid
from quell.controllers.held import HeldPlant
from quell.controllers.law import (
    AdrcDesign,
    NonlinearFeedback,
    checked_feedback,
    feedback_design,
    law_gains,
)
from quell.controllers.online_gain import OnlineGain
from quell.controllers.safe_set import SafeSet
from quell.controllers.schedule import NoSchedule, Schedule, ScheduleDesign
from quell.controllers.stateful import Retuning
from quell.guard import Guard
from quell.hints import explained
from quell.learners.base import Learner
from quell.lti.canonical import format_roots
from quell.observers.eso import ESO
from quell.types import Channels, DesignWarning, Vector, warn

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


@explained("quell.ADRC(observer, omega_c=2.0), with observer = quell.ESO.model_free(…)")
class ADRC(Compensator):
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
    safe_set
        bands that y and its rate do not leave, whatever r and the learner ask for; none by default.
    held
        detects a plant that is held and undoes at its release what the observer made of it; none by
        default. ``set_held`` needs none.
    schedule
        tables of b0, omega_c and omega_o over one or two signals, which the gains follow, or an
        ``OnlineGain``, which estimates b0; none by default. A feedforward follows b0: r^(m)/b0, and
        the inertia of a model, which is that for the observer's b0.

    Raises
    ------
    ValueError
        for a bandwidth or rate limit that is not positive, limits in the wrong order, an
        observer of a plant with zeros outside of the left half plane; for a schedule of omega_o
        with a learner, or of omega_c with a nonlinear feedback; of b0 with a guard that is
        certified, or with a learner, a safe set or ``held`` where the observer has a model; for an
        ``OnlineGain`` with one of these three or with the feedforward of a model.

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

    omega_c: float
    _u_is_given = False

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
        safe_set: SafeSet | None = None,
        held: HeldPlant | None = None,
        schedule: Schedule | OnlineGain | None = None,
    ) -> None:
        self._take_parts(observer, learner, guard, safe_set, held, schedule)
        check_zeros(observer)
        self.omega_c = checks.positive("omega_c", omega_c, "rad/s")
        self.feedforward = checked_feedforward(feedforward)
        self.half_gain = checks.flag("half_gain", half_gain)
        self.feedback = checked_feedback(feedback)
        self.law_poles = law_poles
        self._learner_omega_c = self.omega_c  # the learner keeps its scales when omega_c is retuned
        self._limits = checked_limits(u_min, u_max, rate_limit, observer.dt)
        self._check_law_of_schedule()
        self._initialise()
        self._warn_of_design(observer, self.omega_c)
        self._warn_of_idle_guard()

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
        learner: Learner | None = None,
        guard: Guard | None = None,
        **options: Any,
    ) -> ADRC:
        """Return the ADRC that is equal, from y to u, to a PID controller that is sampled.

        ``controllers.equal_to_pid`` has a report: what differs and where to go from there.

        Parameters
        ----------
        kp, ki, kd, tf, dt, b0
            as for ``equal_to_pid``, with the same errors.
        learner, guard, **options
            of ``ADRC``, those that leave the law linear and its poles where they are: limits,
            ``feedforward``, ``safe_set``.

        Examples
        --------
        >>> controller = ADRC.from_pid(2.0, 1.0, dt=0.01, u_min=-5.0, u_max=5.0)
        >>> round(controller.omega_c, 3), controller.observer.form
        (0.868, 'reduced')
        """
        for name in {"half_gain", "feedback", "law_poles"} & options.keys():
            raise ValueError(f"{name} = {options[name]!r}: the PID controller decides it; leave it")
        equal = equal_to_pid(kp, ki, kd, tf=tf, dt=dt, b0=b0)
        parts: dict[str, Any] = {"learner": learner, "guard": guard, **options}
        return cls(equal.observer, equal.omega_c, law_poles=equal.law_poles, **parts)

    def _design(self, observer: ESO, omega_c: float | None = None) -> AdrcDesign:
        """Return the parameters with an observer and a bandwidth, by default the present one."""
        omega_c = omega_c or self.omega_c
        law = padded(self._law(omega_c, observer.degree), observer.order)
        return self._with_law(
            observer,
            law,
            law=law,
            cancel=observer.cancel,
            feedback=feedback_design(self.feedback, observer.degree, omega_c),
            feedforward=feedforward_design(self.feedforward, observer, law),
            fade=math.exp(-omega_c * observer.dt),
        )

    def _law(self, omega_c: float, degree: int) -> Vector:
        """Return the gains of the law (m,) for a bandwidth."""
        gains = law_gains(degree, omega_c, self.law_poles)
        return gains * (0.5 if self.half_gain else 1.0)

    def _schedule_design(self, observer: ESO) -> Any:
        if self.schedule is None:
            return NoSchedule()
        law = partial(self._law, degree=observer.degree)
        return self._with_parts(self.schedule.design(observer, self.omega_c, law), observer)

    def _with_parts(self, schedule: Any, observer: ESO) -> Any:
        schedule = super()._with_parts(schedule, observer)
        if not isinstance(schedule, ScheduleDesign) or not schedule.has_b0:
            return schedule
        if not isinstance(self.feedforward, Feedforward):
            has_model = bool(np.any(observer.cancel != 0.0))
            return schedule._replace(cancel=observer.cancel if has_model else np.zeros(0))
        fixed, fixed_acting = self.feedforward.fixed(observer)
        return schedule._replace(fixed=fixed, fixed_acting=fixed_acting)

    def _take_inertia(self, ratio: float) -> None:
        if isinstance(self.feedforward, Feedforward):
            self.feedforward = self.feedforward.with_inertia(ratio, self.observer.degree)

    def _take_gain(self, ratio: float) -> None:
        if isinstance(self.feedforward, Feedforward):
            self.feedforward = self.feedforward.with_gain(ratio)

    def _check_law_of_schedule(self) -> None:
        """Raise a ``ValueError`` for parts of the law that a schedule does not reach."""
        flat = isinstance(self.feedforward, Feedforward) and len(self.feedforward.numerator) > 1
        if flat and (self.schedule is not None or self.feedback is not None):
            raise ValueError(
                "feedforward.numerator with a schedule or a nonlinear feedback: their law takes r "
                "for y; leave numerator out"
            )
        if self.schedule is None:
            return
        if isinstance(self.schedule, OnlineGain) and isinstance(self.feedforward, Feedforward):
            raise ValueError(
                "schedule = OnlineGain(...) with the feedforward of a model: the model has an "
                "inertia, and the estimate others; take feedforward = true, which follows b0"
            )
        if self.schedule.omega_c is not None and self.feedback is not None:
            raise ValueError(
                "schedule.omega_c with feedback: the nonlinear law is made for one omega_c; "
                "schedule b0 and omega_o, or leave feedback out"
            )

    def _warn_of_design(self, observer: ESO, omega_c: float) -> None:
        """Issue the warnings of the design, with a schedule those at its fastest point."""
        if self.schedule is not None:
            omega_c = float(np.max(self.schedule.omega_c or omega_c))
            fastest = float(np.max(self.schedule.omega_o or observer.omega_o))
            observer = replace(observer, omega_o=fastest)
        warn_if_unwise(observer, omega_c)

    @property
    def gains(self) -> Vector:
        """Gains k (n,) of the law."""
        return self.parameters.law

    @property
    def derivatives(self) -> int:
        """Number of derivatives of the reference that are fed forward."""
        return derivatives_used(self.feedforward, self.observer.degree)

    @property
    def _channels_of_law(self) -> Channels:
        return (("u_feedforward", 1),) if isinstance(self.feedforward, Feedforward) else ()

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
        if derivatives or self.feedforward:  # an attribute: this is called in every sample
            if len(derivatives) > self.derivatives:
                usable = f"it uses {self.derivatives} at most"
                rule = usable if self.derivatives else "make the controller with feedforward=True"
                given = f"step was given {len(derivatives)} derivatives of the reference"
                raise ValueError(f"{given}: {rule}")
            values = np.array(derivatives, dtype=np.float64)
            set_reference_derivatives(self.parameters, self._state, values)
        try:
            u: float = self._step(self._packed, r, y)
        except TypeError:
            raise TypeError(f"r = {r!r}, y = {y!r}: must be numbers") from None
        return u

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
        design = partial(self._retuning, omega_c=omega_c, observer=observer)
        self._change_to(design, compiles=False)()

    def prepare_retune(
        self, *, omega_c: float | None = None, observer: ESO | None = None
    ) -> Callable[[], None]:
        """Return a function that does what ``retune`` does, in a step's time.

        All that takes time is done here, before the loop needs it; the code of the change is
        compiled. The function may be called in any later sample, and again, to switch between
        designs. ``set_limits`` or a restored state in between make its next calls slower, by a
        tenth of a millisecond. Parameters, rules and errors are those of ``retune``.
        """
        design = partial(self._retuning, omega_c=omega_c, observer=observer)
        return self._change_to(design, compiles=True)

    def _retuning(self, *, omega_c: float | None = None, observer: ESO | None = None) -> Retuning:
        """Return the parameters with other bandwidths, and what sets the attributes for them."""
        omega_c = checks.optional(checks.positive, "omega_c", omega_c, "rad/s") or self.omega_c
        if observer is not None:
            check_replacement(self.observer, observer, self._learns)
        if self.schedule is not None:
            self.schedule.check_retuning(self.observer, observer, omega_c != self.omega_c)
        observer = observer or self.observer
        new = self._design(observer, omega_c)
        found = self._retuning_to(new, observer=observer, omega_c=omega_c)
        self._warn_of_design(observer, omega_c)
        return found


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
    [2.634, 0.279, 4.861]
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
