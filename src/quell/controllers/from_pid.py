"""The ADRC that is equal to a PID controller.

A linear ADRC of order n, in a loop with the plant that its design assumes, the chain of integrators
``b_0/s^n``, has the n poles of its law and the n + 1 poles of its observer (separation). From −y to
u it is a controller ``C = N/(s D)`` with N and D of degree n, and the loop's polynomial ::

    s^n · s D(s) + b_0 N(s)  =  (s^n + k_n s^(n−1) + … + k_1) (s^(n+1) + l_1 s^n + … + l_(n+1))

contains ``b_0 N`` in its coefficients up to s^n and D in the others. So N and D follow from the
poles, and the poles from N and D: a PID controller is an ADRC, with the poles of its law and of its
observer, for every b_0 with which its loop around ``b_0/s^n`` is stable. The bandwidth
parametrisation, all poles of the law at −ω_c and all of the observer at −ω_o, is a special case of
three numbers: a PI controller with a filter of first order has it from ``T_i/t_f = 9`` on (Herbst,
*Control Theory and Technology* 19, 2021, arXiv 2011.01044), and an ADRC with other poles from 1 on.
Zhong, Huang & Guo, *Science China Information Sciences* 63, 2020, go from PID to ADRC without the
filter.

The same holds sample by sample. The observer in its current form gives a ``C(z)`` whose numerator
has the factor z, and so does a PID controller that is sampled by backward differences, as programs
in drives and PLCs are: ``s = (z − 1)/(dt z)``. The two are then equal for every frequency, to
rounding. The polynomial is written in ``γ = (z − 1)/dt``, in which slow poles keep their
precision::

    C = z (k_d γ² + k_p γ z + k_i z²) / (γ (z² + f_1 γ z + f_2 γ²)),        z = 1 + γ dt

around ``b_0 (1 + γ dt/2)/γ²`` for n = 2. With f_2 = 0, a PI controller without filter, or one whose
derivative alone is filtered, one pole lies at z = 0: the observer of reduced order. A controller
that is sampled by Tustin's rule, as ``quell.baselines.PID`` is, differs by the sampling:
``PidEqual.difference`` is that difference over frequency, and ``PidEqual.bound`` what it can make
of y in a loop. Two loops around the same plant P, with the controllers C and C', the same loads and
the same rest before, have outputs with ::

    y − y' = −P (C − C')/(1 + P C) y',        ‖y − y'‖ ≤ sup_ω |P (C − C')/(1 + P C)| ‖y'‖

in the sum of squares, if both loops are stable and no limit is reached.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.observers.eso import ESO
from quell.plants.linear import sampled_plant
from quell.types import Vector

# Trials of b0 when none is given, by factors below and above those that time scales give; and the
# least damping that the poles of law and observer may have: below, the reference's response and
# what follows a limit would ring. Chosen by hand.
_TRIALS, _LEAST_DAMPING = 400, 0.2
# Spread that stands for no ADRC at all, above that of any.
_IMPOSSIBLE = 1e6
# Poles count as one place if they differ by less than this share: the roots of a polynomial with a
# multiple root have about the root of the unit roundoff.
_ONE_PLACE = 1e-4
# Frequencies at which a bound is computed.
_FREQUENCIES = 2000

Complex = NDArray[np.complex128]
Pattern = tuple[float | tuple[float, float], ...]


class PidEqual(NamedTuple):
    """The ADRC that is equal to a PID controller, and what differs."""

    observer: ESO  #: with b0, omega_o and poles
    omega_c: float  #: geometric mean of the law's poles [rad/s]
    law_poles: Pattern  #: in units of omega_c, as ``ADRC`` has them
    kp: float  #: [u-unit/y-unit]
    ki: float  #: [u-unit/(y-unit s)]
    kd: float  #: [u-unit s/y-unit]
    filter: tuple[float, float]  #: (f1, f2) of the whole controller ``N/(s (1 + f1 s + f2 s²))``
    numerator: tuple[float, float, float]  #: coefficients of N, highest power first
    b0_given: bool  #: whether b0 was given, or found here

    @property
    def b0(self) -> float:
        """Gain that the ADRC assumes [y-unit/u-unit/s^order]."""
        return float(self.observer.b0)

    @property
    def omega_o(self) -> float:
        """Geometric mean of the observer's poles [rad/s]."""
        return float(self.observer.omega_o)

    @property
    def in_one_place(self) -> bool:
        """Whether all poles of the law lie at −omega_c and all of the observer at −omega_o."""
        law = _complex(self.law_poles)
        return self.observer.poles is None and bool(np.max(np.abs(law + 1.0)) < _ONE_PLACE)

    def response(self, omega: Any) -> Complex:
        """Return the frequency response of the ADRC from −y to u at ``omega`` [rad/s]."""
        z, observer = np.exp(1j * _frequencies(omega) * self.observer.dt), self.observer
        n, b0, model = observer.order, observer.b0, observer.model
        units = observer.omega_o ** np.arange(n + 1.0)
        correct = np.eye(n + 1)
        correct[:, 0] -= model.gain
        gains = np.append(_gains(self.law_poles, self.omega_c), 1.0)
        move = correct @ (model.transition - np.outer(model.input, gains) / b0)
        move, gain = move * units / units[:, None], model.gain / units
        one = np.eye(n + 1)
        found = [complex(gains * units @ np.linalg.solve(each * one - move, gain)) for each in z]
        return np.array(found) * z / b0

    def pid_response(self, omega: Any, sampled: str = "backward") -> Complex:
        """Return the frequency response of the PID controller from −y to u.

        Parameters
        ----------
        omega
            frequencies [rad/s].
        sampled
            ``"backward"`` differences, ``"tustin"`` as ``quell.baselines.PID``, or ``"no"`` for
            that in continuous time.
        """
        omega, dt = _frequencies(omega), self.observer.dt
        checks.one_of("sampled", sampled, ("backward", "tustin", "no"))
        s = 1j * omega
        if sampled == "backward":
            s = -np.expm1(-1j * omega * dt) / dt
        elif sampled == "tustin":
            s = 2j / dt * np.tan(0.5 * omega * dt)
        f1, f2 = self.filter
        return np.polyval(self.numerator, s) / (s * np.polyval([f2, f1, 1.0], s))

    def difference(self, omega: Any, sampled: str = "tustin") -> Vector:
        """Return the relative difference of ADRC and PID controller, ``|C − C'|/|C'|``, by omega.

        Parameters
        ----------
        omega
            frequencies [rad/s], below π/dt.
        sampled
            how the PID controller is sampled, as for ``pid_response``.
        """
        other = self.pid_response(omega, sampled)
        return np.abs(self.response(omega) - other) / np.abs(other)

    def bound(self, plant: Any, sampled: str = "tustin") -> float:
        """Return by how much y may differ in a loop, as a share of the RMS value of y.

        It holds for runs of any length from the same rest, under any load, at a constant reference
        of zero, without limits, if both loops are stable: the greatest value over frequency of
        ``|P (C − C')/(1 + P C)|``.

        Parameters
        ----------
        plant
            a linear plant, as for ``quell.analysis.analyse``.
        sampled
            how the PID controller is sampled, as for ``pid_response``.
        """
        dt = self.observer.dt
        model = sampled_plant(plant, dt)
        omega = _grid(1e-6 / dt, 0.9999 * math.pi / dt, _FREQUENCIES)
        one = np.eye(model.C.size)
        steps = np.expm1(1j * omega * dt)
        P = np.array([model.C @ np.linalg.solve(z * one - model.N, model.B) for z in steps])
        C, other = self.response(omega), self.pid_response(omega, sampled)
        return float(np.max(np.abs(P * (C - other) / (1.0 + P * C))))

    def describe(self) -> str:
        """Return what is equal, what is not and what comes next, as text."""
        observer, dt = self.observer, self.observer.dt
        top = min(max(self.omega_c, self.omega_o), 0.5 * math.pi / dt)
        band = _grid(1e-3 * min(self.omega_c, self.omega_o), top, 60)
        worst = {
            how: float(np.max(self.difference(band, how))) for how in ("backward", "tustin", "no")
        }
        form = "" if observer.form == "current" else f", form {observer.form!r}"
        lines = [
            f"ADRC of order {observer.order}: b0 = {self.b0:.5g}, omega_c = {self.omega_c:.5g} "
            f"rad/s, omega_o = {self.omega_o:.5g} rad/s{form}, dt = {dt:g} s"
        ]
        if self.in_one_place:
            lines.append("all poles of the law at -omega_c and of the observer at -omega_o")
        else:
            lines.append(
                f"poles of the law {_text(self.law_poles)} omega_c, of the observer "
                f"{_text(observer.poles or (-1.0,))} omega_o"
            )
        lines += [
            f"from y to u equal to the PID sampled by backward differences: {worst['backward']:.1e}"
            " at most, relative",
            f"up to {top:.4g} rad/s it differs by {_percent(worst['tustin'])} from the PID sampled "
            f"by Tustin's rule, by {_percent(worst['no'])} from the one in continuous time",
            self._about_reference(),
            "NOT equal at limits of u: there the observer gets the u that was applied, and the PID "
            "has its own anti-windup",
        ]
        if observer.form == "reduced":
            lines.append(
                "NOT for most learners: the observer of reduced form takes y for x_1 and sees no "
                "noise; give the PID a filter of the whole, or go on as in the next line"
            )
        if self.b0_given:
            lines.append(
                f"next: the ADRC of the same speeds, ESO.model_free({observer.order}, "
                f"b0={self.b0:.5g}, omega_o={self.omega_o:.5g}, dt={dt:g}) with "
                f"omega_c={self.omega_c:.5g}, then a "
                "learner; with b0 that of the plant both bandwidths may be raised"
            )
        else:
            lines.append(
                f"next: b0 = {self.b0:.5g} is the gain this PID behaves as if the plant had; "
                "find the plant's own (quell b0) and give it as b0: the same PID, by the poles "
                "that its loop has; then move omega_c and omega_o, and add a learner"
            )
        return "\n".join(lines)

    def _about_reference(self) -> str:
        """Return what differs for a step of the reference."""
        first = _gains(self.law_poles, self.omega_c)[0] / self.b0
        f1, f2 = self.filter
        dt = self.observer.dt
        jump = float(np.polyval(self.numerator, 1.0 / dt)) * dt
        jump /= float(np.polyval([f2, f1, 1.0], 1.0 / dt))
        return (
            f"NOT equal for steps of the reference: u jumps by {first:.4g} per unit of r, and that "
            f"of the PID by {jump:.4g} with set-point weights of 1; the ADRC's reference passes "
            "a filter with the zeros of its observer"
        )


def equal_to_pid(
    kp: float,
    ki: float,
    kd: float = 0.0,
    *,
    tf: float | tuple[float, float] = 0.0,
    dt: float,
    b0: float | None = None,
) -> PidEqual:
    """Return the ADRC that is equal, from y to u, to a PID controller that is sampled.

    Of order 1 without derivative, of order 2 with one. The forms of other makers::

        K (1 + 1/(T_i s) + T_d s/(1 + T_d s/N))            K, K/T_i, K T_d, tf = T_d/N
        K (1 + 1/(T_i s)) (1 + T_d s)/(1 + t s)            K (1 + (T_d − t)/T_i), K/T_i,
                                                           K (T_d − t)(1 − t/T_i), tf = t

    Parameters
    ----------
    kp, ki, kd
        gains of the parallel form [u-unit/y-unit, the same per s, times s]; all of one sign. An
        ADRC integrates, so that ki must not be zero.
    tf
        filter time [s]: of the derivative, ``k_d s/(1 + tf s)``, or without derivative of the
        whole controller. Or a pair (f1, f2) for a filter ``1/(1 + f1 s + f2 s²)`` of the whole
        controller, as ``quell.baselines.PID`` has it, whose single tf is the pair (tf, tf²/2).
    dt
        sample time [s].
    b0
        gain that the ADRC is to assume [y-unit/u-unit/s^order], that of the plant if it is known;
        by default the one with which the poles of law and observer lie closest to one place each.

    Raises
    ------
    ValueError
        for a number out of range, gains of different signs, and if no ADRC is equal, with the
        filter or the b0 that would be possible.

    Examples
    --------
    >>> print(equal_to_pid(2.0, 1.0, tf=0.1, dt=1e-3).describe().splitlines()[0])
    ADRC of order 1: b0 = 1.3873, omega_c = 0.63632 rad/s, omega_o = 4.6569 rad/s, dt = 0.001 s
    """
    gains = (
        checks.finite("kp", kp),
        checks.nonzero("ki", ki, "an ADRC integrates"),
        checks.finite("kd", kd),
    )
    kp, ki, kd = gains
    if kp * ki <= 0.0 or kd * ki < 0.0:
        raise ValueError(
            f"kp = {kp!r}, ki = {ki!r}, kd = {kd!r}: must have one sign, and kp and ki must not be "
            "zero; no other controller has an observer's poles"
        )
    dt = checks.positive("dt", dt, "s")
    b0 = None if b0 is None else checks.nonzero("b0", b0, "it is the gain from u to y")
    if b0 is not None and b0 * ki < 0.0:
        raise ValueError(f"b0 = {b0!r}: must have the sign of ki = {ki!r}")
    order = 1 if kd == 0.0 else 2
    numerator, lags = _polynomials(kp, ki, kd, tf)
    problem = _Problem(order, numerator, lags, dt)
    found = problem.search() if b0 is None else problem.at(b0)
    if found is None:
        raise ValueError(_not_possible(problem, kp, ki, kd, tf, b0))
    return _made(found, problem, (kp, ki, kd), b0 is not None)


def _polynomials(
    kp: float, ki: float, kd: float, tf: Any
) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """Return N and (f1, f2) of ``N/(s (1 + f1 s + f2 s²))``."""
    if np.ndim(tf) == 0:
        time = checks.non_negative("tf", tf, "s")
        if kd == 0.0:
            return (0.0, kp, ki), (time, 0.0)
        return (kd + kp * time, kp + ki * time, ki), (time, 0.0)
    f1, f2 = checks.vector("tf", tf, 2).tolist()
    if f1 < 0.0 or f2 < 0.0 or (f1 == 0.0 and f2 > 0.0):
        raise ValueError(f"tf = {tf!r}: f1 and f2 must not be negative, or the filter is unstable")
    if kd == 0.0 and f2 > 0.0:
        raise ValueError(
            f"tf = {tf!r} with kd = 0: an ADRC of order 1 is a PI controller with a filter of "
            f"first order; give tf = {f1:g}, whose lag at low frequencies is the same"
        )
    return (kd, kp, ki), (f1, f2)


class _Poles(NamedTuple):
    """The poles of an equal ADRC, in γ times the unit of time of the problem."""

    b0: float
    law: Complex
    observer: Complex
    spread: float  # distance of the poles from one place each


class _Problem:
    """A PID controller, and the poles of its loop around ``b0/s^n``, by b0.

    In the unit of time T_i = kp/ki all numbers are near one.
    """

    def __init__(
        self,
        order: int,
        numerator: tuple[float, float, float],
        lags: tuple[float, float],
        dt: float,
    ) -> None:
        self.order, self.numerator, self.lags, self.dt = order, numerator, lags, dt
        self.unit = T = numerator[1] / numerator[2]
        self.h = h = dt / T
        d, p, i = numerator[0] / T, numerator[1], numerator[2] * T
        f1, f2 = lags[0] / T, lags[1] / T**2
        g, z = np.array([1.0, 0.0]), np.array([h, 1.0])
        zz, gz, gg = np.polymul(z, z), np.polymul(g, z), np.polymul(g, g)
        # The factor z of numerator and denominator of the reduced form is left out of both.
        self.reduced = lags[1] == 0.0 if order == 2 else lags[0] == 0.0
        if order == 1:
            top = np.polyadd(p * g, i * z)
            bottom = np.ones(1) if self.reduced else np.polyadd(z, f1 * g)
            top = top if self.reduced else np.polymul(z, top)
            self.plant = np.ones(1)
        else:
            top = np.polyadd(np.polyadd(d * gg, p * gz), i * zz)
            bottom = np.polyadd(z, f1 * g)
            if not self.reduced:
                bottom = np.polyadd(np.polyadd(zz, f1 * gz), f2 * gg)
                top = np.polymul(z, top)
            self.plant = np.array([0.5 * h, 1.0])
        self.top = np.polymul(top, self.plant)
        self.bottom = np.append(bottom, np.zeros(order + 1))

    def stable(self, b0: Vector) -> NDArray[np.bool_]:
        """Return for which b0 (k,) the loop is stable."""
        size = max(self.top.size, self.bottom.size)
        top, bottom = (np.pad(p, (size - p.size, 0)) for p in (self.top, self.bottom))
        polynomials = bottom + (b0 * self.unit**self.order)[:, None] * top
        companions = np.zeros((b0.size, size - 1, size - 1))
        companions[:, 1:, :-1] = np.eye(size - 2)
        companions[:, 0, :] = -polynomials[:, 1:] / polynomials[:, :1]
        inside = np.abs(1.0 + self.h * np.linalg.eigvals(companions)) < 1.0
        return np.all(inside, axis=1)

    def at(self, b0: float) -> _Poles | None:
        """Return the poles for a b0, those of the law the slower ones; None if there are none."""
        gain = b0 * self.unit**self.order
        polynomial = np.polyadd(self.bottom, gain * self.top)
        if polynomial[0] == 0.0 or not np.all(np.isfinite(polynomial)):
            return None
        roots = np.roots(polynomial).astype(np.complex128)
        if not np.all(np.abs(1.0 + self.h * roots) < 1.0):
            return None
        best: _Poles | None = None
        for chosen in combinations(range(roots.size), self.order):
            law, others = roots[list(chosen)], np.delete(roots, chosen)
            if abs(np.sum(law).imag) > 1e-9 * np.max(np.abs(law)):
                continue  # a pair would be torn apart
            found = self._judged(b0, law, others)
            if found is not None and (best is None or found.spread < best.spread):
                best = found
        return best

    def _judged(self, b0: float, law: Complex, others: Complex) -> _Poles | None:
        """Return a division of the poles, or None if no ADRC has it."""
        z = 1.0 + self.h * others
        if np.any((z.real <= 0.0) & (np.abs(z.imag) < 1e-9)):
            return None  # an observer's real poles are exp(p dt)
        of_law = np.roots(np.append(1.0, self.law_coefficients(law)))
        of_observer = np.log1p(self.h * others) / self.h
        if np.any(of_law.real >= 0.0) or np.any(of_observer.real >= 0.0):
            return None
        every = np.append(of_law, of_observer)
        if np.min(-every.real / np.abs(every)) < _LEAST_DAMPING:
            return None
        centres = [math.exp(float(np.mean(np.log(np.abs(p))))) for p in (of_law, of_observer)]
        if centres[1] < centres[0]:
            return None
        away = np.append(np.log(of_law / -centres[0]), np.log(of_observer / -centres[1]))
        return _Poles(b0, law, others, float(np.sum(np.abs(away) ** 2)))

    def law_coefficients(self, law: Complex) -> Vector:
        """Return k_n … k_1 of the law in the unit of time, from its poles in γ."""
        if self.order == 1:
            return np.array([-law[0].real])
        k1 = float((law[0] * law[1]).real)
        return np.array([-float(np.sum(law).real) - 0.5 * self.h * k1, k1])

    def search(self) -> _Poles | None:
        """Return the poles for the b0 with which they lie closest to one place each."""
        from scipy.optimize import minimize_scalar

        d, p, _ = self.numerator
        T, dt = self.unit, self.dt
        # Loops of order 1 have the speed b0 kp, those of order 2 b0 kd, from 1/T_i to 1/dt.
        size = abs(p) if self.order == 1 else abs(d)
        trials = np.geomspace(1e-2 / T / size, 1e1 / dt / size, _TRIALS)
        sign = math.copysign(1.0, p)
        stable = np.flatnonzero(self.stable(sign * trials))
        spreads = [(one.spread, k) for k in stable if (one := self.at(sign * float(trials[k])))]
        if not spreads:
            return None
        k = min(spreads)[1]
        centre = sign * float(trials[k])
        step = math.log(float(trials[1] / trials[0]))

        def spread(of: float) -> float:
            one = self.at(centre * math.exp(of))
            return _IMPOSSIBLE if one is None else one.spread

        options = {"bounds": (-step, step), "method": "bounded", "options": {"xatol": 1e-13}}
        refined = minimize_scalar(spread, **options)
        best, rough = self.at(centre * math.exp(float(refined.x))), self.at(centre)
        found = [one for one in (best, rough) if one is not None]
        return min(found, key=lambda one: one.spread)


def _made(
    found: _Poles, problem: _Problem, gains: tuple[float, float, float], given: bool
) -> PidEqual:
    """Return the ADRC with these poles."""
    T, n = problem.unit, problem.order
    of_law = np.roots(np.append(1.0, problem.law_coefficients(found.law))) / T
    of_observer = np.log1p(problem.h * found.observer) / problem.dt
    omega_c, law_poles = _pattern(of_law)
    omega_o, pattern = _pattern(of_observer)
    form = "reduced" if problem.reduced else "current"
    # Poles in one place to rounding are in one place: the observer then has the formulas for it.
    poles = None if np.max(np.abs(_complex(pattern) + 1.0)) < _ONE_PLACE else pattern
    observer = ESO.model_free(n, found.b0, omega_o, problem.dt, form=form, poles=poles)
    return PidEqual(
        observer, omega_c, law_poles, *gains, problem.lags, problem.numerator, b0_given=given
    )


def _pattern(poles: NDArray[Any]) -> tuple[float, Pattern]:
    """Return a bandwidth, the geometric mean, and the poles in units of it."""
    omega = math.exp(float(np.mean(np.log(np.abs(poles)))))
    found: list[float | tuple[float, float]] = []
    for pole in sorted(poles / omega, key=abs):
        if pole.imag == 0.0:
            found.append(float(pole.real))
        elif pole.imag > 0.0:
            found.append((float(pole.real), float(pole.imag)))
    return omega, tuple(found)


def _gains(law_poles: Any, omega_c: float) -> Vector:
    """Return k_1 … k_n of a law with these poles."""
    return np.real(np.poly(omega_c * _complex(law_poles)))[:0:-1].astype(np.float64)


def _complex(pattern: Any) -> Complex:
    """Return all poles of a pattern, with the conjugates of its pairs."""
    every: list[complex] = []
    for each in pattern:
        pair = isinstance(each, tuple)
        every += [complex(*each), complex(*each).conjugate()] if pair else [complex(each)]
    return np.array(every)


def _not_possible(
    problem: _Problem, kp: float, ki: float, kd: float, tf: Any, b0: float | None
) -> str:
    """Return why there is no ADRC, and what would be possible."""
    given = f"kp = {kp!r}, ki = {ki!r}, kd = {kd!r}, tf = {tf!r}"
    if b0 is not None:
        other = problem.search()
        if other is not None:
            return (
                f"b0 = {b0!r}: the loop of this PID around b0/s^{problem.order} is not stable, or "
                f"not damped by {_LEAST_DAMPING:g}, so that no ADRC with this b0 is equal to it; "
                f"b0 = {other.b0:.4g} is possible; or design an ADRC for your b0 instead"
            )
    low, high = 0.0, 1.0
    for _ in range(14):
        middle = 0.5 * (low + high)
        scaled = middle * tf if np.ndim(tf) == 0 else (middle * tf[0], middle**2 * tf[1])
        trial = _Problem(problem.order, *_polynomials(kp, ki, kd, scaled), problem.dt)
        low, high = (middle, high) if trial.search() is not None else (low, middle)
    text = f"{given}: no ADRC is equal to this PID"
    if low > 0.0:
        size = (
            f"{low * tf:.4g}" if np.ndim(tf) == 0 else f"({low * tf[0]:.4g}, {low**2 * tf[1]:.4g})"
        )
        return (
            f"{text}: its loop around b0/s^{problem.order} is stable and damped by "
            f"{_LEAST_DAMPING:g} for no b0; possible from tf = {size} s on downwards"
        )
    return (
        f"{text}, with any filter: its loop around b0/s^{problem.order} is stable and damped by "
        f"{_LEAST_DAMPING:g} for no b0; lower ki, or sample faster"
    )


def _frequencies(omega: Any) -> Vector:
    return np.atleast_1d(np.asarray(omega, dtype=np.float64))


def _grid(low: float, high: float, count: int) -> Vector:
    return np.geomspace(low, high, count)


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %"


def _text(poles: Any) -> str:
    parts = [f"{p[0]:.4g} ± {p[1]:.4g}i" if isinstance(p, tuple) else f"{p:.4g}" for p in poles]
    return ", ".join(parts)
