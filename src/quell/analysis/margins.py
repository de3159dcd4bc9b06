"""Stability margins of a loop from its frequency response.

With L the loop, broken at the plant's input, and ``S = 1/(1 + L)``, a stable loop stays stable as long as

* its gain is multiplied by less than the upper and more than the lower *gain margin*;
* its phase falls or rises by less than the *phase margin*;
* it gets less dead time than the *delay margin*;
* L is moved by less than the *modulus margin* ``1/max |S| = min |1 + L|`` (Landau; Åström & Murray's stability margin s_m);
* gain and phase vary together, in the disk ``(1 + δ/2)/(1 − δ/2)``, ``|δ| <`` the *disk margin* ``α = 1/max |S − ½|`` (Seiler, Packard &
  Gahinet, *IEEE Control Systems* 40, 2020, with skew 0): gain by any factor in ``(2 − α)/(2 + α) … (2 + α)/(2 − α)`` or phase by
  ``2 atan(α/2)``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from quell.analysis.frequency_response import Complex
from quell.types import Vector

Response = Callable[[Vector], Complex]


class Margins(NamedTuple):
    """Margins of a loop, each with its frequency [rad/s] (NaN where there is none); of an unstable loop all are zero."""

    gain: tuple[float, float]
    """Between which factors the loop's gain may lie; (1, 1) for an unstable loop."""
    gain_omega: tuple[float, float]
    phase: float
    """[degrees]; infinite where the gain never is 1."""
    phase_omega: float
    modulus: float
    modulus_omega: float
    disk: float
    disk_omega: float
    delay: float
    """[s]; exact where it is a whole number of samples."""
    delay_omega: float

    @property
    def disk_gain(self) -> tuple[float, float]:
        """Factors of the gain that the disk margin allows, at any phase in its disk."""
        high = math.inf if self.disk >= 2.0 else (2.0 + self.disk) / (2.0 - self.disk)
        return 1.0 / high, high

    @property
    def disk_phase(self) -> float:
        """Phase that the disk margin allows, at any gain in its disk [degrees]."""
        return math.degrees(2.0 * math.atan(self.disk / 2.0))


def margins(
    loop: Response, omega: Vector, dt: float, stable_with: Callable[[float], bool]
) -> Margins:
    """Return the margins of a loop.

    Parameters
    ----------
    loop
        L at frequencies [rad/s].
    omega
        where to look first; what lies between is refined.
    dt
        sample time [s].
    stable_with
        whether the closed loop is stable with its gain multiplied by a factor.
    """
    nan = math.nan
    if not stable_with(1.0):
        return Margins((1.0, 1.0), (nan, nan), 0.0, nan, 0.0, nan, 0.0, nan, 0.0, nan)
    L = loop(omega)
    gain, gain_omega = _gain_margin(loop, omega, L, dt, stable_with)
    modulus, modulus_omega = least(lambda w: np.abs(1.0 + loop(w)), omega, np.abs(1.0 + L))
    disk, disk_omega = least(lambda w: _away(loop(w)), omega, _away(L))
    with np.errstate(divide="ignore"):
        crossings = _zeros(lambda w: np.log(np.abs(loop(w))), omega, np.log(np.abs(L)))
    phase, phase_omega, delay, delay_omega = math.inf, nan, math.inf, nan
    for at in crossings:
        lead = math.pi + float(
            np.angle(loop(np.array([at])))[0]
        )  # from −1, counter-clockwise: 0 … 2π
        if abs(math.remainder(lead, 2.0 * math.pi)) < phase:
            phase, phase_omega = abs(math.remainder(lead, 2.0 * math.pi)), at
        if lead / at < delay:
            delay, delay_omega = lead / at, at
    return Margins(
        gain,
        gain_omega,
        math.degrees(phase),
        phase_omega,
        modulus,
        modulus_omega,
        disk,
        disk_omega,
        delay,
        delay_omega,
    )


def _away(L: Complex) -> Vector:
    """Return ``1/|S − ½| = 2 |1 + L| / |1 − L|``."""
    with np.errstate(divide="ignore"):
        away: Vector = 2.0 * np.abs(1.0 + L) / np.abs(1.0 - L)
    return away


def _gain_margin(
    loop: Response, omega: Vector, L: Complex, dt: float, stable_with: Callable[[float], bool]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the factors between which the gain may lie, and the frequencies at which the loop is lost there.

    A pole is on the unit circle for the factor κ where ``κ L = −1``: at crossings of the negative real axis, at ω → 0 and at half the
    sampling rate. Between two such factors nothing changes, so stability is asked for between them only.
    """

    def turned(w: Vector) -> Vector:
        return np.imag(1.0 / loop(w))

    candidates = {}
    for at in [*_zeros(turned, omega, np.imag(1.0 / L)), float(omega[0]) * 1e-3, math.pi / dt]:
        factor = -float(np.real(1.0 / loop(np.array([at])))[0])
        if 1e-9 < factor < 1e9:
            candidates[factor] = at
    low, high, low_omega, high_omega = 0.0, math.inf, math.nan, math.nan
    above, below = (
        sorted(k for k in candidates if k > 1.0),
        sorted((k for k in candidates if k <= 1.0), reverse=True),
    )
    for factor, beyond in pairwise([*above, 4.0 * max([1.0, *above])]):
        if not stable_with(math.sqrt(factor * beyond)):
            high, high_omega = factor, candidates[factor]
            break
    for factor, beyond in pairwise([*below, 0.25 * min([1.0, *below])]):
        if not stable_with(math.sqrt(factor * beyond)):
            low, low_omega = factor, candidates[factor]
            break
    return (low, high), (low_omega, high_omega)


def least(
    function: Callable[[Vector], Vector], omega: Vector, values: Vector
) -> tuple[float, float]:
    """Return the least value of a function of the frequency, and where; ``values`` are those at ``omega``."""
    from scipy.optimize import minimize_scalar

    best = int(np.argmin(values))
    found = float(values[best]), float(omega[best])
    inside = np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:])) + 1
    # A sharp dip may hide beside a point that is not the lowest.
    for i in inside[np.argsort(values[inside])][:3]:
        near = minimize_scalar(
            lambda x: float(function(np.exp(np.array([x])))[0]),
            bounds=(math.log(omega[i - 1]), math.log(omega[i + 1])),
            method="bounded",
            options={"xatol": 1e-9},
        )
        if near.fun < found[0]:
            found = float(near.fun), math.exp(near.x)
    return found


def _zeros(function: Callable[[Vector], Vector], omega: Vector, values: Vector) -> list[float]:
    """Return the frequencies at which a function changes its sign."""
    from scipy.optimize import brentq

    def at(x: float) -> float:
        return float(function(np.exp(np.array([x])))[0])

    found = []
    for i in np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:])):
        low, high = math.log(omega[i]), math.log(omega[i + 1])
        # At half the sampling rate a response is real; the sign of its imaginary part is that of a rounding error, which nothing repeats.
        if np.isfinite(values[i]) and np.isfinite(values[i + 1]) and at(low) * at(high) < 0.0:
            found.append(math.exp(brentq(at, low, high, xtol=1e-13, rtol=1e-13)))
    return found
