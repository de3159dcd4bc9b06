"""The filtered PID controller of two degrees of freedom.

::

    U = 1/F(s) · ( k_p (b R − Y) + k_i/s (R − Y) + k_d s (c R − Y) )
    F(s) = 1 + T_f s + (T_f s)²/2

(Åström & Hägglund, *Advanced PID Control*, ISA 2006, sections 3.2 to 3.4: set-point weights b and
c, and a filter of second order on the measurement, not one on the derivative alone, so that the
controller rolls off. The reference is filtered as well, so that both paths have the same
denominator, which makes little difference for small T_f.) While u lies at a limit the integrator
follows it with the tracking time T_t (section 3.5, back-calculation).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.limits import RateLimit
from quell.controllers.linear.linear import LinearController
from quell.controllers.linear.transfer import realised, sampled_law


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
