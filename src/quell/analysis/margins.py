"""Stability margins of a loop from its frequency response.

With L the loop, broken at the plant's input, and ``S = 1/(1 + L)``, a stable loop stays stable as
long as

* its gain is multiplied by a factor between the lower and the upper *gain margin*;
* its phase changes by less than the *phase margin*;
* its dead time grows by less than the *delay margin*;
* L changes by less than the *modulus margin* ``1/max |S| = min |1 + L|`` (Landau; Åström & Murray's
  stability margin s_m);
* gain and phase vary together in the disk ``(1 + δ/2)/(1 − δ/2)``, ``|δ| <`` the *disk margin* ``α
  = 1/max |S − ½|`` (Seiler, Packard & Gahinet, *IEEE Control Systems* 40, 2020, with skew 0): gain
  by any factor in ``(2 − α)/(2 + α) … (2 + α)/(2 − α)`` or phase by ``2 atan(α/2)``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from quell.analysis.frequency_response import Complex
from quell.types import Vector

Response = Callable[[Vector], Complex]

# Range of the search for the edge of stability: far beyond any physical error of a gain.
_LEAST_FACTOR, _LARGEST_FACTOR = 1e-9, 1e9
# How far below the lowest frequency of the grid ω → 0 is evaluated.
_TOWARDS_ZERO = 1e-3
# Local minima to refine: a sharp dip may lie beside a grid point that is not the lowest. Chosen by
# hand; one was enough in the loops that ``frequency_response`` names.
_MINIMA = 3
# Relative errors of the refined frequencies. The value of a flat minimum is exact before.
_MINIMUM_TOLERANCE, _CROSSING_TOLERANCE = 1e-9, 1e-13


class Margins(NamedTuple):
    """Margins of a loop, each with its frequency [rad/s] or NaN; zero for an unstable loop."""

    gain: tuple[float, float]
    """Range of factors of the gain; (1, 1) for an unstable loop. Factors below 1e-9 and above 1e9
    are not searched, and count as 0 and as infinite."""
    gain_omega: tuple[float, float]
    phase: float
    """[degrees]; infinite if the gain is never 1."""
    phase_omega: float
    modulus: float
    modulus_omega: float
    disk: float
    disk_omega: float
    delay: float
    """[s]; exact for whole numbers of samples."""
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
    """Return the margins of a loop, given as a function from frequencies [rad/s] to L.

    Extrema and crossings are refined between the frequencies ``omega``. ``stable_with`` returns
    whether the closed loop is stable with its gain times a factor.
    """
    nan = math.nan
    if not stable_with(1.0):
        return Margins((1.0, 1.0), (nan, nan), 0.0, nan, 0.0, nan, 0.0, nan, 0.0, nan)
    L = loop(omega)
    gain, gain_omega = _gain_margin(loop, omega, L, dt, stable_with)
    modulus, modulus_omega = least(lambda w: np.abs(1.0 + loop(w)), omega, np.abs(1.0 + L))
    disk, disk_omega = least(lambda w: _disk_distance(loop(w)), omega, _disk_distance(L))
    with np.errstate(divide="ignore"):
        crossings = _sign_changes(lambda w: np.log(np.abs(loop(w))), omega, np.log(np.abs(L)))
    phase, phase_omega, delay, delay_omega = math.inf, nan, math.inf, nan
    for at in crossings:
        # Angle from −1, counter-clockwise: 0 … 2π.
        lead = math.pi + float(np.angle(loop(np.array([at])))[0])
        if abs(math.remainder(lead, 2.0 * math.pi)) < phase:
            phase, phase_omega = abs(math.remainder(lead, 2.0 * math.pi)), at
        if lead / at < delay:
            delay, delay_omega = lead / at, at
    return Margins(
        *(gain, gain_omega, math.degrees(phase), phase_omega, modulus, modulus_omega),
        *(disk, disk_omega, delay, delay_omega),
    )


def _disk_distance(L: Complex) -> Vector:
    """Return ``1/|S − ½| = 2 |1 + L| / |1 − L|``."""
    with np.errstate(divide="ignore"):
        distance: Vector = 2.0 * np.abs(1.0 + L) / np.abs(1.0 - L)
    return distance


def _gain_margin(
    loop: Response, omega: Vector, L: Complex, dt: float, stable_with: Callable[[float], bool]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the range of gain factors for which the loop is stable, and the frequencies there.

    A pole is on the unit circle for the factor κ where ``κ L = −1``: at crossings of the negative
    real axis, at ω → 0 and at half the sampling rate. Between two such factors stability does not
    change, so one test between them is enough.
    """

    def inverse(w: float) -> complex:
        """Return 1/L(ω), which is zero at a pole of an undamped plant."""
        try:
            return complex(1.0 / loop(np.array([w]))[0])
        except ValueError:
            return 0.0

    def imaginary_part(w: Vector) -> Vector:
        return np.array([inverse(float(w[0])).imag])

    crossings = _sign_changes(imaginary_part, omega, np.imag(1.0 / L))
    candidates = {}
    for at in [*crossings, float(omega[0]) * _TOWARDS_ZERO, math.pi / dt]:
        factor = -inverse(at).real
        if _LEAST_FACTOR < factor < _LARGEST_FACTOR:
            candidates[factor] = at

    def edge(factors: list[float], last: float) -> tuple[float, float] | None:
        """Return the first of the factors beyond which the loop is unstable, with its frequency."""
        for factor, beyond in pairwise([*factors, last]):
            if not stable_with(math.sqrt(factor * beyond)):
                return factor, candidates[factor]
        return None

    # Beyond the last candidate stability does not change, so any larger (smaller) factor tests it.
    above = sorted(k for k in candidates if k > 1.0)
    below = sorted((k for k in candidates if k <= 1.0), reverse=True)
    high, high_omega = edge(above, 4.0 * max([1.0, *above])) or (math.inf, math.nan)
    low, low_omega = edge(below, 0.25 * min([1.0, *below])) or (0.0, math.nan)
    return (low, high), (low_omega, high_omega)


def least(
    function: Callable[[Vector], Vector], omega: Vector, values: Vector
) -> tuple[float, float]:
    """Return the minimum of a function and its frequency; ``values`` are those at ``omega``."""
    from scipy.optimize import minimize_scalar

    best = int(np.argmin(values))
    found = float(values[best]), float(omega[best])
    inside = np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:])) + 1
    for i in inside[np.argsort(values[inside])][:_MINIMA]:
        near = minimize_scalar(
            lambda x: float(function(np.exp(np.array([x])))[0]),
            bounds=(math.log(omega[i - 1]), math.log(omega[i + 1])),
            method="bounded",
            options={"xatol": _MINIMUM_TOLERANCE},
        )
        if near.fun < found[0]:
            found = float(near.fun), math.exp(near.x)
    return found


def _sign_changes(
    function: Callable[[Vector], Vector], omega: Vector, values: Vector
) -> list[float]:
    """Return the frequencies at which a function changes its sign."""
    from scipy.optimize import brentq

    @cache  # brentq begins with the ends of a bracket, which are known
    def at(x: float) -> float:
        return float(function(np.exp(np.array([x])))[0])

    found = []
    for i in np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:])):
        low, high = math.log(omega[i]), math.log(omega[i + 1])
        # At half the sampling rate a response is real: the sign of its imaginary part is a rounding
        # error, which does not repeat.
        if np.isfinite(values[i]) and np.isfinite(values[i + 1]) and at(low) * at(high) < 0.0:
            root = brentq(at, low, high, xtol=_CROSSING_TOLERANCE, rtol=_CROSSING_TOLERANCE)
            found.append(math.exp(root))
    return found
