"""Cascaded position and speed loops with notch filters, as servo drives have them.

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
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.baselines.notch import Notch
from quell.controllers.limits import RateLimit
from quell.controllers.linear.linear import LinearController
from quell.controllers.linear.transfer import realised, sampled_law


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
