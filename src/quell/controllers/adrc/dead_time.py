"""ADRC of order 1 for a first-order plant with dead time, ``K e^(−Ls)/(T s + 1)``.

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
from typing import Any, NamedTuple

from quell import checks
from quell.controllers.adrc.adrc import ADRC
from quell.guard import Guard
from quell.learners.base import Learner
from quell.observers.eso import ESO

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
        ``"simc"`` or ``"amigo"``, see ``controllers/adrc/dead_time.py``.
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
