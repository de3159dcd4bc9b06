"""The power of a class of loads over frequency, as an objective of ``tune``.

A load w at the plant's input whose power at the frequencies ω_i is W_i leaves, late in a run,

    E[y²] = ∫ |G_yd(jω)|² W(ω) dω = Σ_i |P(jω_i)/(1 + P(jω_i) C_y(jω_i))|² W_i

with the sampled plant P and controller C_y (Åström, *Introduction to Stochastic Control Theory*,
1970, section 4.5; Parseval). Its root is the objective. A controller that is tuned for it knows
nothing of the load but W.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from quell import checks
from quell.types import Vector

# Frequencies of a band, evenly spaced.
_OF_BAND = 60
# A record's power is summed over bands of this share of their frequency; what is below this share
# of the largest band is rounding and the window's side lobes.
_WIDTH, _FLOOR = 0.01, 1e-9
_FEWEST = 16  # samples of a record


@dataclass(frozen=True, eq=False)
class LoadSpectrum:
    """The power of a class of loads: ``tune(objective=LoadSpectrum…)`` leaves the least RMS of y.

    Parameters
    ----------
    omega
        frequencies (k,) [rad/s], positive.
    power
        power of the load in the band of each of them (k,) [u-unit²], its mean square in all: a
        sinusoid of amplitude a has a²/2.

    Raises
    ------
    ValueError
        for arrays of different length, frequencies that are not positive, a power that is negative,
        or none at all.

    Examples
    --------
    >>> load = LoadSpectrum.band(0.5, 5.5)
    >>> load.omega.size, round(load.rms, 6)
    (60, 0.707107)
    """

    omega: Vector
    power: Vector

    def __post_init__(self) -> None:
        omega, power = checks.vector("omega", self.omega), checks.vector("power", self.power)
        if omega.size == 0 or omega.size != power.size:
            raise ValueError(
                f"power has {power.size} entries for {omega.size} frequencies omega: must have one "
                "for each, and at least one"
            )
        if not np.all(omega > 0.0):
            raise ValueError(f"omega = {np.min(omega):g} rad/s: frequencies must be above 0")
        if not (np.all(power >= 0.0) and np.any(power > 0.0)):
            raise ValueError("power: must not be negative, and not zero everywhere")
        for name, each in (("omega", omega), ("power", power)):
            each.flags.writeable = False
            object.__setattr__(self, name, each)

    @property
    def rms(self) -> float:
        """Root of the mean square of the load [u-unit]."""
        return math.sqrt(float(np.sum(self.power)))

    @classmethod
    def band(cls, low: float, high: float, amplitude: float = 1.0) -> LoadSpectrum:
        """Return that of a sinusoid whose frequency may be anywhere in a band.

        Parameters
        ----------
        low, high
            ends of the band [rad/s].
        amplitude
            of the sinusoid [u-unit].
        """
        low = checks.positive("low", low, "rad/s")
        high = checks.positive("high", high, "rad/s")
        if not low < high:
            raise ValueError(f"low = {low:g}, high = {high:g} rad/s: low must be below high")
        amplitude = checks.positive("amplitude", amplitude, "u-unit")
        omega = np.linspace(low, high, _OF_BAND)
        return cls(omega, np.full(_OF_BAND, 0.5 * amplitude**2 / _OF_BAND))

    @classmethod
    def of_record(cls, load: Any, dt: float) -> LoadSpectrum:
        """Return that of a recorded load, for instance f̂/b0 of a run, ``run["f_hat"] / b0``.

        The periodogram with Hann's window, in bands of 1 % of their frequency; the constant part is
        left out, as each integrator removes it.

        Parameters
        ----------
        load
            its samples (N,) [u-unit], 16 or more.
        dt
            their distance [s].
        """
        w = checks.vector("load", load)
        dt = checks.positive("dt", dt, "s")
        if w.size < _FEWEST:
            raise ValueError(f"load has {w.size} samples: must have at least {_FEWEST}")
        w = w - np.mean(w)
        window = np.hanning(w.size)
        power = np.abs(np.fft.rfft(w * window)) ** 2
        omega = 2.0 * np.pi * np.fft.rfftfreq(w.size, dt)
        kept = (omega > 0.0) & (power > _FLOOR * np.max(power))
        if not np.any(kept):
            raise ValueError("load: is constant, its spectrum has no power but at zero")
        omega, power = omega[kept], power[kept]
        _, band = np.unique(np.round(np.log(omega) / _WIDTH), return_inverse=True)
        total = np.bincount(band, power)
        centre = np.bincount(band, power * omega) / total
        return cls(centre, total * (np.mean(w**2) / np.sum(total)))
