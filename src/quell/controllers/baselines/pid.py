"""PID controllers: with a filter, with a notch, cascaded, and the one that equals an ADRC.

The filtered PID controller of two degrees of freedom.

::

    U = 1/F(s) · ( k_p (b R − Y) + k_i/s (R − Y) + k_d s (c R − Y) )
    F(s) = 1 + T_f s + (T_f s)²/2

(Åström & Hägglund, *Advanced PID Control*, ISA 2006, sections 3.2 to 3.4: set-point weights b and
c, and a filter of second order on the measurement, not one on the derivative alone, so that the
controller rolls off. The reference is filtered as well, so that both paths have the same
denominator, which makes little difference for small T_f.) While u lies at a limit the integrator
follows it with the tracking time T_t (section 3.5, back-calculation).

PI or PID with a notch filter on a resonance.

::

    N(s) = (s² + 2 ζ_z ω s + ω²) / (s² + 2 ζ_p ω s + ω²)
    |N(jω)| = ζ_z/ζ_p = depth,      −3 dB over about  2 ζ_p ω = width · ω

(Ellis, *Control System Design Guide*, 4th ed. 2012, chapter 9; Vukosavić & Stojić, *IEEE Trans.
Industrial Electronics* 45, 1998, for drives with torsional resonance.) The filter removes the
resonance from the loop and does not damp it: a plant without friction keeps swinging after a
disturbance. At low frequencies the filter acts as a delay ``2 (ζ_p − ζ_z)/ω``, which a tuning rule
must include.

Cascaded position and speed loops with notch filters, as servo drives have them.

A proportional position controller sets the speed, a PI controller of the speed sets the torque, and
notch filters take resonances out of it. Only the position y is measured; the drive differentiates
it::

    v_set = K_v (r − y) [+ s r/(1 + T_f s)]               position controller, speed feedforward
    v     = s y/(1 + T_f s)                               measured speed
    u     = N_1(s) N_2(s) … K_p (1 + 1/(T_n s)) (v_set − v)  [+ (J s² + c s) r]
    N_i   = (s² + 2 ζ_z ω_i s + ω_i²)/(s² + 2 ζ_p ω_i s + ω_i²)

(Ellis, *Control System Design Guide*, 4th ed. 2012, chapters 9, 16 and 17; Groß, Hamann &
Wiegärtner, *Electrical Feed Drives in Automation*, 2001, chapters 5 and 7.) The terms in brackets
are the feedforward of speed and of torque, with the inertia J and the viscous friction c of the
axis. From −y to u it is::

    C = N_1 N_2 … K_p (1 + 1/(T_n s)) (K_v + s/(1 + T_f s)),        k_i = K_p K_v/T_n

It is sampled by Tustin's rule, with each notch where it is to be. With ``T_f = dt/2`` the speed is
the difference of two samples over dt; the derivatives of r for the torque always are. So in single
precision the torque has the rounding of r times J/dt², ``6e-8 J |r|/dt²``.

The PID controller that is equivalent to a linear ADRC.

In continuous time, an ESO of order n in closed loop with its own law is a linear system from (r, y)
to u. With ``k_i`` the law's gains, and the ESO model-free with all poles at ω_o, elimination of its
state gives (Herbst, *Control Theory and Technology* 19, 2021, arXiv 2011.01044; Zhong, Huang & Guo,
*Science China Information Sciences* 63, 2020, derive the reverse, from PID to ADRC)::

    n = 1    b_0 U = ( k_1 (s + ω_o)² R − (β_1 s + β_0) Y ) / ( s (s + α_0) )
             α_0 = 2ω_o + k_1,      β_1 = ω_o² + 2 k_1 ω_o,      β_0 = k_1 ω_o²

    n = 2    b_0 U = ( k_1 (s + ω_o)³ R − (β_2 s² + β_1 s + β_0) Y ) / ( s (s² + α_1 s + α_0) )
             α_1 = 3ω_o + k_2,      α_0 = 3ω_o² + 3ω_o k_2 + k_1
             β_2 = ω_o³ + 3ω_o² k_2 + 3ω_o k_1,      β_1 = ω_o³ k_2 + 3ω_o² k_1,      β_0 = k_1 ω_o³

From y to u this is exactly a PI controller with a filter of first order, or a PID controller with
one of second order; from r to u it is the same controller with a prefilter of the reference, here
the ``setpoint`` polynomial. The sampled ADRC and the PID controller sampled by Tustin's rule agree
to first order in dt, as long as no limit is reached.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.adrc import ADRC
from quell.controllers.base import RateLimit
from quell.controllers.linear import LinearController, realised, sampled_law
from quell.hints import explained
from quell.learners.base import NoLearner
from quell.observers.eso import ESO

# ---- The filtered PID controller of two degrees of freedom ----


@explained("quell.baselines.PID(kp=2.0, ki=1.0, dt=1e-3)")
class PID(LinearController):
    """A filtered PID controller of two degrees of freedom, sampled by Tustin's rule.

    Parameters
    ----------
    kp, ki, kd
        gains of the parallel form [u-unit/y-unit, the same per s, times s]; any sign. ``simc`` and
        ``simc_double_integrator`` tune them.
    tf
        filter time [s], of ``F = 1 + tf s + (tf s)²/2``; or a pair (f1, f2), of ``F = 1 + f1 s + f2
        s²``. Required with a derivative.
    b, c
        set-point weights of the proportional and the derivative part, usually 0 to 1.
    tt
        tracking time [s]; by default √(T_i T_d), or T_i without derivative (section 3.5, as above).
    dt
        sample time [s].
    setpoint
        polynomial T(s), highest power first, for the reference's path instead of ``k_d c s² + k_p b
        s + k_i``; of degree 3 at most.
    u_min, u_max, rate_limit, name
        as for ``LinearController``.

    Raises
    ------
    ValueError
        for a number out of range, or a derivative without filter.

    Examples
    --------
    >>> controller = PID.simc(gain=2.0, tau1=1.0, theta=0.1, dt=0.01)
    >>> round(controller.kp, 3), round(controller.ki, 3)
    (2.5, 3.125)
    """

    _prewarp: float | None = None

    def __init__(
        self,
        kp: float,
        ki: float = 0.0,
        kd: float = 0.0,
        *,
        tf: float | tuple[float, float] = 0.0,
        b: float = 1.0,
        c: float = 0.0,
        tt: float | None = None,
        dt: float,
        setpoint: Sequence[float] | None = None,
        u_min: float = -math.inf,
        u_max: float = math.inf,
        rate_limit: RateLimit = math.inf,
        name: str = "PID",
    ) -> None:
        self.kp, self.ki = checks.finite("kp", kp), checks.finite("ki", ki)
        self.kd = checks.finite("kd", kd)
        self.b, self.c = checks.finite("b", b), checks.finite("c", c)
        self.filter = _filter(tf)
        self.tf = tf
        if self.kd != 0.0 and self.filter == (0.0, 0.0):
            rule = "a derivative needs a filter, tf greater than zero; a tenth of kd/kp is usual"
            raise ValueError(f"kd = {kd!r}, tf = {tf!r}: {rule}")
        self.tt = checks.optional(checks.positive, "tt", tt, "s") or self._tracking_time()
        usual = self._usual_setpoint()
        self.setpoint = usual if setpoint is None else tuple(checks.vector("setpoint", setpoint))
        if not self.setpoint:
            raise ValueError(f"setpoint = {setpoint!r}: must be a polynomial in s")
        system, dt = realised(*self.polynomials()), checks.positive("dt", dt, "s")
        law = sampled_law(system, dt, prewarp=self._prewarp, tracking_time=self.tt)
        super().__init__(law, dt, u_min=u_min, u_max=u_max, rate_limit=rate_limit, name=name)

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints; the polynomial of the reference only if it was given."""
        found = super().described()
        if self.setpoint == self._usual_setpoint():
            del found["setpoint"]
        return found

    def _usual_setpoint(self) -> tuple[float, ...]:
        return self.kd * self.c, self.kp * self.b, self.ki

    def polynomials(self) -> tuple[list[Any], Any]:
        """Return the numerators from r and y and their common denominator, polynomials in s."""
        f1, f2 = self.filter
        feedback = [-self.kd, -self.kp, -self.ki]
        if self.ki == 0.0 and self.setpoint[-1] == 0.0:  # no integrator: s cancels
            return [list(self.setpoint[:-1]), feedback[:-1]], [f2, f1, 1.0]
        return [list(self.setpoint), feedback], [f2, f1, 1.0, 0.0]

    def _tracking_time(self) -> float:
        if self.ki == 0.0:
            return 1.0  # nothing winds up
        integral, derivative = abs(self.kp / self.ki), abs(self.kd / self.kp) if self.kp else 0.0
        return math.sqrt(integral * derivative) or integral or 1.0

    @classmethod
    def simc(
        cls,
        gain: float,
        tau1: float,
        theta: float,
        tau2: float = 0.0,
        *,
        tau_c: float | None = None,
        dt: float,
        **options: Any,
    ) -> PID:
        """Tune for ``gain e^(−θs) / ((τ1 s + 1)(τ2 s + 1))`` by the SIMC rules.

        In series form ``K_c = τ1 / (gain (τ_c + θ))``, ``τ_I = min(τ1, 4 (τ_c + θ))``, ``τ_D =
        τ2``; PI without τ2 (Skogestad, *J. Process Control* 13, 2003, eqs. (23)-(25)).

        Parameters
        ----------
        gain, tau1, theta, tau2
            of the model [y-unit/u-unit, s, s, s]; include half of the sample time in θ.
        tau_c
            time constant of the loop [s]; θ by default, the smallest recommended value.
        dt
            sample time [s].
        **options
            passed on to ``PID``. With τ2 the filter time is τ2/10 by default.

        Raises
        ------
        ValueError
            for a gain of zero, a time out of range, θ = 0 without ``tau_c``, and as ``PID``.
        """
        gain = checks.nonzero("gain", gain, "or u does not reach y")
        tau1, theta = checks.positive("tau1", tau1, "s"), checks.non_negative("theta", theta, "s")
        tau2 = checks.non_negative("tau2", tau2, "s")
        time = checks.positive("theta, or tau_c,", theta if tau_c is None else tau_c, "s") + theta
        return cls._series(tau1 / (gain * time), min(tau1, 4.0 * time), tau2, dt, options)

    @classmethod
    def simc_double_integrator(
        cls, gain: float, theta: float, *, tau_c: float | None = None, dt: float, **options: Any
    ) -> PID:
        """Tune for ``gain e^(−θs) / s²`` by the SIMC rule (Skogestad 2003, table 1).

        In series form ``K_c = 1 / (4 gain (τ_c + θ)²)``, ``τ_I = τ_D = 4 (τ_c + θ)``.

        Parameters
        ----------
        gain
            of the model [y-unit/u-unit/s²]: acceleration per unit of u.
        theta
            its delay [s]; include half of the sample time and the filter's lag.
        tau_c, dt, **options
            as for ``simc``, with the same errors. The filter time is τ_D/10 by default.
        """
        gain = checks.nonzero("gain", gain, "or u does not reach y")
        theta = checks.non_negative("theta", theta, "s")
        time = checks.positive("theta, or tau_c,", theta if tau_c is None else tau_c, "s") + theta
        return cls._series(0.25 / (gain * time**2), 4.0 * time, 4.0 * time, dt, options)

    @classmethod
    def _series(
        cls, K: float, integral: float, derivative: float, dt: float, options: dict[str, Any]
    ) -> PID:
        """Return the parallel form of ``K (1 + 1/(τ_I s)) (1 + τ_D s)``."""
        options = {"tf": 0.1 * derivative} | options
        kp = K * (1.0 + derivative / integral)
        return cls(kp, K / integral, K * derivative, dt=dt, **options)


def _filter(tf: Any) -> tuple[float, float]:
    """Return the coefficients (f1, f2) of ``F = 1 + f1 s + f2 s²``."""
    if np.ndim(tf) == 0:
        time = checks.non_negative("tf", tf, "s")
        return time, 0.5 * time**2
    f1, f2 = checks.vector("tf", tf, 2).tolist()
    if f1 < 0.0 or f2 < 0.0 or (f1 == 0.0 and f2 > 0.0):
        raise ValueError(f"tf = {tf!r}: f1 and f2 must not be negative, or the filter is unstable")
    return f1, f2


# ---- PI or PID with a notch filter on a resonance ----


class Notch(NamedTuple):
    """A notch filter; make it with ``Notch.at``."""

    omega: float  # centre [rad/s]
    zero_damping: float  # ζ_z
    pole_damping: float  # ζ_p

    @classmethod
    def at(cls, omega: float, *, depth: float = 0.1, width: float = 1.0) -> Notch:
        """Return the notch with the gain ``depth`` at ``omega``, ``width · omega`` wide at −3 dB.

        A wider notch tolerates a larger error of the resonance and has more lag at low frequencies.

        Parameters
        ----------
        omega
            centre [rad/s].
        depth
            gain at the centre, from 0 to below 1.
        width
            as a share of ``omega``, greater than zero.

        Raises
        ------
        ValueError
            for a frequency or width that is not positive, or a depth that is not from 0 to below 1.
        """
        omega, width = checks.positive("omega", omega, "rad/s"), checks.positive("width", width)
        depth = checks.non_negative("depth", depth)
        if depth >= 1.0:
            raise ValueError(f"depth = {depth!r}: must be below 1, it is the gain at the centre")
        return cls(omega, 0.5 * depth * width, 0.5 * width)

    @property
    def delay(self) -> float:
        """Equivalent delay at low frequencies [s]."""
        return 2.0 * (self.pole_damping - self.zero_damping) / self.omega

    def polynomials(self) -> tuple[list[float], list[float]]:
        """Return numerator and denominator in s, highest power first."""
        w = self.omega
        return [1.0, 2.0 * self.zero_damping * w, w**2], [1.0, 2.0 * self.pole_damping * w, w**2]


class NotchPID(PID):
    """A PID controller in series with a notch filter; PI + notch with ``kd = 0``.

    It is sampled by Tustin's rule, prewarped at the notch.

    Parameters
    ----------
    notch
        the filter, from ``Notch.at``.
    kp, ki, kd, **options
        as for ``PID``.

    Raises
    ------
    ValueError
        as ``PID``, for a notch above half the sampling rate, and for anything but a notch.

    Examples
    --------
    >>> controller = NotchPID(Notch.at(omega=1.4, depth=0.05), kp=0.2, ki=0.01, dt=0.01)
    >>> round(controller.notch.delay, 2)
    0.68
    """

    def __init__(
        self,
        notch: Notch,
        kp: float,
        ki: float = 0.0,
        kd: float = 0.0,
        *,
        dt: float,
        **options: Any,
    ) -> None:
        if not isinstance(notch, Notch):
            raise ValueError(f"notch = {notch!r}: must be from quell.baselines.Notch.at(omega)")
        if notch.omega * checks.positive("dt", dt, "s") >= math.pi:
            rule = f"must be below pi/dt = {math.pi / dt:.3g} rad/s"
            raise ValueError(f"notch at {notch.omega!r} rad/s with dt = {dt!r} s: {rule}")
        self.notch = notch
        self._prewarp = notch.omega
        options = {"name": "PID + notch" if kd else "PI + notch"} | options
        super().__init__(kp, ki, kd, dt=dt, **options)

    def polynomials(self) -> tuple[list[Any], Any]:
        """Return the numerators from r and from y and their common denominator, see ``PID``."""
        numerators, denominator = super().polynomials()
        zeros, poles = self.notch.polynomials()
        return [np.polymul(part, zeros) for part in numerators], np.polymul(denominator, poles)


# ---- Cascaded position and speed loops with notch filters, as servo drives have them ----


class PPI(LinearController):
    """Cascaded P position and PI speed control with notch filters and torque feedforward.

    Parameters
    ----------
    kv
        gain of the position controller [1/s].
    kp
        gain of the speed controller [u-unit/(y-unit/s)]; its sign is that of the plant's gain.
    tn
        integral time of the speed controller [s].
    tf
        time constant of the filter of the speed [s], at least dt/2, with which the speed is the
        difference of two samples; dt/2 by default.
    notches
        filters of the torque, from ``Notch.at``; none by default.
    inertia
        J for the feedforward of the torque [u-unit/(y-unit/s²)]; with it the speed of the reference
        is fed forward, too. By default there is no feedforward: a step of r needs none.
    viscous
        viscous friction c for the feedforward [u-unit/(y-unit/s)]; goes with ``inertia``.
    dt
        sample time [s].
    u_min, u_max, rate_limit, name
        as for ``LinearController``.

    Raises
    ------
    ValueError
        for a number out of range, a notch above half the sampling rate, anything but notches, and
        ``viscous`` without ``inertia``.

    Examples
    --------
    >>> drive = PPI(kv=50.0, kp=0.1, tn=0.02, notches=[Notch.at(860.0)], dt=2.5e-4)
    >>> round(drive.ki, 3)
    250.0
    """

    def __init__(
        self,
        kv: float,
        kp: float,
        tn: float,
        *,
        dt: float,
        tf: float | None = None,
        notches: Sequence[Notch] = (),
        inertia: float | None = None,
        viscous: float | None = None,
        u_min: float = -math.inf,
        u_max: float = math.inf,
        rate_limit: RateLimit = math.inf,
        name: str = "P-PI",
    ) -> None:
        dt = checks.positive("dt", dt, "s")
        self.kv, self.tn = checks.positive("kv", kv, "1/s"), checks.positive("tn", tn, "s")
        self.kp = checks.nonzero("kp", kp, "or u does nothing")
        self.tf = 0.5 * dt if tf is None else checks.positive("tf", tf, "s")
        if self.tf < 0.5 * dt * (1.0 - 1e-9):
            rule = "must be at least dt/2, with which the speed is the difference of two samples"
            raise ValueError(f"tf = {tf!r} s with dt = {dt!r} s: {rule}")
        self.notches = _checked(notches, dt)
        self.inertia = checks.optional(checks.finite, "inertia", inertia)
        self.viscous = checks.optional(checks.finite, "viscous", viscous)
        if self.viscous is not None and self.inertia is None:
            raise ValueError(f"viscous = {viscous!r}: goes with inertia, or has no effect; give it")
        system = realised(*self._polynomials(dt))
        law = sampled_law(system, dt, tracking_time=self.tn)
        super().__init__(law, dt, u_min=u_min, u_max=u_max, rate_limit=rate_limit, name=name)

    @property
    def ki(self) -> float:
        """Integral gain k_i: u per integral of y under a constant load [u-unit/(y-unit s)]."""
        return self.kp * self.kv / self.tn

    def _polynomials(self, dt: float) -> tuple[list[Any], Any]:
        """Return the numerators from r and from y and their common denominator, in s."""
        zeros: Any = np.ones(1)
        poles: Any = np.ones(1)
        for notch in self.notches:
            top, bottom = prewarped(notch, dt).polynomials()
            zeros, poles = np.polymul(zeros, top), np.polymul(poles, bottom)
        pi = np.polymul(zeros, self.kp * np.array([1.0, 1.0 / self.tn]))
        position = self.kv * np.array([self.tf, 1.0])
        both = np.polyadd(position, [1.0, 0.0])
        den = np.polymul(poles, [self.tf, 1.0, 0.0])
        if self.inertia is None:
            return [np.polymul(pi, position), -np.polymul(pi, both)], den
        difference = np.array([0.25 * dt**2, dt, 1.0])  # (1 + s dt/2)²
        torque = [self.inertia, self.viscous or 0.0, 0.0]
        from_r = np.polymul(np.polymul(pi, both), difference)
        from_r = np.polyadd(from_r, np.polymul(torque, den))
        from_y = -np.polymul(np.polymul(pi, both), difference)
        return [from_r, from_y], np.polymul(den, difference)


def prewarped(notch: Notch, dt: float) -> Notch:
    """Return the notch that is at the centre of ``notch`` after sampling by Tustin's rule."""
    return notch._replace(omega=2.0 / dt * math.tan(0.5 * dt * notch.omega))


def _checked(notches: Any, dt: float) -> tuple[Notch, ...]:
    rule = "must be a list of quell.baselines.Notch.at(omega)"
    if isinstance(notches, Notch) or not isinstance(notches, list | tuple):
        raise ValueError(f"notches = {notches!r}: {rule}")
    for i, notch in enumerate(notches):
        if not isinstance(notch, Notch):
            rule = "must be from quell.baselines.Notch.at(omega)"
            raise ValueError(f"notches[{i}] = {notch!r}: {rule}")
        if notch.omega * dt >= math.pi:
            rule = f"must be below pi/dt = {math.pi / dt:.3g} rad/s"
            raise ValueError(f"notches[{i}] at {notch.omega!r} rad/s with dt = {dt!r} s: {rule}")
    return tuple(notches)


# ---- The PID controller that is equivalent to a linear ADRC ----


def equivalent_pid(controller: ADRC, **options: Any) -> PID:
    """Return the PID controller that a linear ADRC of order 1 (PI) or 2 is in continuous time.

    Raises ``ValueError`` for an ADRC with another order or observer, a learner or feedforward, or
    another type.

    Parameters
    ----------
    controller
        an ``ADRC`` without learner around a model-free ESO of order 1 or 2.
    **options
        limits and name; by default the limits of ``controller``, except its rate limit.
    """
    _check_linear(controller)
    observer, gains = controller.observer, controller.parameters.law.tolist()
    w, b0 = observer.omega_o, observer.b0
    if observer.order == 1:
        (k1,) = gains
        alpha, beta = [2.0 * w + k1], [k1 * w**2, w**2 + 2.0 * k1 * w, 0.0]
        tf = (1.0 / alpha[0], 0.0)
    else:
        k1, k2 = gains
        alpha = [3.0 * w**2 + 3.0 * w * k2 + k1, 3.0 * w + k2]
        beta = [k1 * w**3, w**3 * k2 + 3.0 * w**2 * k1, w**3 + 3.0 * w**2 * k2 + 3.0 * w * k1]
        tf = (alpha[1] / alpha[0], 1.0 / alpha[0])
    ki, kp, kd = (value / (alpha[0] * b0) for value in beta)
    setpoint = k1 / (alpha[0] * b0) * np.poly([-w] * (observer.order + 1))
    limits = controller.parameters.limits
    name = f"PID equivalent to ADRC of order {observer.order}"
    settings: dict[str, Any] = {"u_min": limits.low, "u_max": limits.high, "name": name} | options
    return PID(kp, ki, kd, tf=tf, setpoint=setpoint.tolist(), dt=controller.dt, **settings)


def _check_linear(controller: Any) -> None:
    """Raise a ``ValueError`` for a controller without an equivalent."""
    if not isinstance(controller, ADRC):
        raise ValueError(f"controller = {controller!r}: must be an ADRC")
    observer = controller.observer
    if not isinstance(controller.learner, NoLearner):
        raise ValueError(
            f"controller has a learner, {type(controller.learner).__name__}: only a linear ADRC, "
            "without one, has an equivalent"
        )
    if controller.feedback is not None:
        raise ValueError("controller has a nonlinear feedback law: only a linear one is a PID")
    if observer.order > 2:
        raise ValueError(
            f"controller is of order {observer.order}: must be of order 1 (PI) or 2 (PID); an ADRC "
            "of order n has n zeros from y, a PID controller two at most"
        )
    if observer.disturbance_order > 1:
        raise ValueError(
            f"observer has disturbance_order = {observer.disturbance_order}: its feedback has so "
            "many integrators, and that of a PID controller has one; use disturbance_order = 1"
        )
    design = (observer.order, observer.b0, observer.omega_o, observer.dt)
    usual = ESO.model_free(*design, form=observer.form).model
    if (
        observer.form == "reduced"
        or type(observer.model) is not type(usual)
        or not all(map(np.array_equal, observer.model, usual))
    ):
        raise ValueError("controller has an observer with a model: it must be from ESO.model_free")
    if controller.derivatives:
        raise ValueError(
            "controller has feedforward: a PID controller has no derivatives of the reference; "
            "use feedforward=False"
        )
