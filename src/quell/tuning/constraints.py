"""What is asked of a tuned loop: bounds, and the power of a class of loads as an objective.

With ``S = 1/(1 + L)``, ``T = 1 − S`` and the controller C_y from −y to u, the bounds are those of
Åström & Hägglund (*Advanced PID Control*, ISA 2006, section 4.6): ``M_s = max |S|``, ``M_t = max
|T|``, ``M_ks = max |C_y S|``, over the frequencies up to half the sampling rate.

A load w at the plant's input whose power at the frequencies ω_i is W_i leaves, late in a run::

    E[y²] = ∫ |G_yd(jω)|² W(ω) dω = Σ_i |P(jω_i)/(1 + P(jω_i) C_y(jω_i))|² W_i

with the sampled plant P and controller C_y (Åström, *Introduction to Stochastic Control Theory*,
1970, section 4.5; Parseval). Its root is the objective. A controller that is tuned for it knows
nothing of the load but W.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quell import checks
from quell.types import Vector

# ---- Bounds ----


@dataclass(frozen=True, kw_only=True)
class Constraints:
    """Bounds for a tuned loop; None and omitted bounds do not hold.

    Parameters
    ----------
    m_s
        largest ``|S|``; 1.6 leaves a modulus margin of 0.625, a gain margin of at least 2.7 and a
        phase margin of at least 36°.
    m_t
        largest ``|T|``.
    m_ks
        largest gain from a sinusoid in y to u [u-unit/y-unit]; it bounds what noise does to u.
    u_std
        largest standard deviation of u [u-unit] that the noise of y causes; by default
        ``noise_share`` of half the range of u, where the noise and the limits of u are known.
    noise_std
        standard deviation of the white noise of y in each sample [y-unit].
    resolution
        step to which y is rounded [y-unit], as 360/2^16 degrees: noise of ``step/√12`` (Widrow,
        Kollár & Liu, *IEEE Trans. Instrumentation and Measurement* 45, 1996) besides the other.
    noise_share
        share of half the range of u that noise may use, as a standard deviation.
    delay_margin
        least additional dead time at which the loop becomes unstable [s].
    damping
        least damping of the closed loop's poles, ``−Re s/|s|``; 0.4 overshoots by 25 % alone. Poles
        of a dead time, with a half period below it, do not count, and a flexible mode of the plant
        keeps half of its own damping (docs/tuning_damping).
    u_max
        largest ``|u|`` in the responses of the objective's scenario [u-unit].
    rate_max
        largest rate of u in them [u-unit/s].
    noise_over_pi
        where neither ``m_ks`` nor the noise of y is known, M_ks is bounded by this multiple of that
        of the optimal PI controller under the other constraints, or, where no PI controller is of
        use, by that of the optimal PID controller with ``T_f = T_d/noise_over_pi``; None for no
        bound. Without one, an optimum with a derivative has the fastest filter that ``omega_o_dt``
        allows.
    omega_o_dt
        largest ``|p| dt`` of the poles of an observer or of a filter of the measurement; beyond
        0.5 sampling costs margin (docs/design).

    Raises
    ------
    ValueError
        for a bound that is not positive, M_s or M_t that no loop has, or ``u_std`` without
        ``noise_std`` or ``resolution``.
    """

    m_s: float | None = 1.6
    m_t: float | None = 1.6
    m_ks: float | None = None
    u_std: float | None = None
    noise_std: float | None = None
    resolution: float | None = None
    noise_share: float = 0.02
    delay_margin: float | None = None
    damping: float | None = 0.4
    u_max: float | None = None
    rate_max: float | None = None
    noise_over_pi: float | None = 10.0
    omega_o_dt: float = 0.5

    def __post_init__(self) -> None:
        for name in ("m_s", "m_t", "m_ks", "u_std", "noise_std", "delay_margin", "u_max"):
            checks.optional(checks.positive, name, getattr(self, name))
        for name in ("rate_max", "noise_over_pi", "resolution"):
            checks.optional(checks.positive, name, getattr(self, name))
        damping = checks.optional(checks.positive, "damping", self.damping)
        if damping is not None and damping >= 1.0:
            raise ValueError(
                f"damping = {self.damping!r}: must be below 1, the damping of real poles (0.4 lets "
                "a pair overshoot by 25 %, 0.7 by 5 %)"
            )
        checks.positive("noise_share", self.noise_share)
        checks.positive("omega_o_dt", self.omega_o_dt)
        for name in ("m_s", "m_t"):
            value = getattr(self, name)
            if value is not None and value <= 1.0:
                raise ValueError(
                    f"{name} = {value!r}: must be above 1; |S| exceeds 1 at some frequency "
                    "in every loop, and |T| is 1 at low ones (1.4 is cautious, 2 is bold)"
                )
        if self.u_std is not None and self.noise == 0.0:
            raise ValueError(
                f"u_std = {self.u_std!r}: needs noise_std or resolution, the noise of y that "
                "causes it"
            )
        if self.m_s is None and self.m_t is None:
            raise ValueError("m_s = None, m_t = None: one of them must bound the loop")

    @property
    def noise(self) -> float:
        """Standard deviation of the noise of y, rounding included [y-unit]; zero: not known."""
        return math.hypot(self.noise_std or 0.0, (self.resolution or 0.0) / math.sqrt(12.0))

    def __str__(self) -> str:
        """Return the bounds that hold, as text."""
        parts = [
            ("M_s ≤ {:g}", self.m_s),
            ("M_t ≤ {:g}", self.m_t),
            ("M_ks ≤ {:g}", self.m_ks),
            ("std(u) ≤ {:.4g}" + f" for noise of {self.noise:.3g} in y", self.u_std),
            ("delay margin ≥ {:g} s", self.delay_margin),
            ("damping ≥ {:g}", self.damping),
            ("|u| ≤ {:g}", self.u_max),
            ("|u'| ≤ {:g}/s", self.rate_max),
            ("|p| dt ≤ {:g} for poles of observers and filters", self.omega_o_dt),
        ]
        return ", ".join(text.format(value) for text, value in parts if value is not None)


def first_given(bounds: Constraints, names: Sequence[str]) -> str:
    """Return the first of these bounds that was given and is not the default; empty for none."""
    default = Constraints()
    given = ((name, getattr(bounds, name)) for name in names)
    known = (name for name, value in given if value not in (None, getattr(default, name)))
    return next(known, "")


def given_constraints(given: Any, default: Constraints | None = None) -> Constraints:
    """Return the constraints that a user gave, or the default ones for None."""
    if given is None:
        return Constraints() if default is None else default
    if not isinstance(given, Constraints):
        raise ValueError(f"constraints = {given!r:.60}: must be quell.tuning.Constraints(m_s=…)")
    return given


# ---- The power of a class of loads ----

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
