"""PI or PID with a notch filter on a resonance.

::

    N(s) = (s² + 2 ζ_z ω s + ω²) / (s² + 2 ζ_p ω s + ω²)
    |N(jω)| = ζ_z/ζ_p = depth,      −3 dB over about  2 ζ_p ω = width · ω

(Ellis, *Control System Design Guide*, 4th ed. 2012, chapter 9; Vukosavić & Stojić, *IEEE Trans.
Industrial Electronics* 45, 1998, for drives with torsional resonance.) The filter removes the
resonance from the loop and does not damp it: a plant without friction keeps swinging after a
disturbance. At low frequencies the filter acts as a delay ``2 (ζ_p − ζ_z)/ω``, which a tuning rule
must include.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.baselines.pid import PID


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
