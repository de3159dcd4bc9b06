"""The learner of loads that repeat: state, bias and sinusoids of unknown frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quell import checks
from quell.learners.kalman.kalman import Kalman
from quell.learners.kalman.oscillators import Oscillators
from quell.observers.eso import ESO
from quell.types import Vector

# Where frequencies start by default, in omega_c: the next oscillator at this share of the one before.
_SPREAD = 0.3
# Frequencies stay within these shares of omega_c and omega_o.
_LOWEST, _HIGHEST = 0.02, 0.5


@dataclass(frozen=True)
class Harmonic(Kalman):
    """``Kalman`` with sinusoids of unknown frequency: ``f_L = θ · (x̂_1 … x̂_n, 1, sin ψ_1, cos ψ_1, …, u)``.

    Loads that rotate or repeat are rejected to nothing once their frequency is found (``oscillators.py`` says how), and what is learned of
    the plant is not worn away by a load that goes on.

    Parameters
    ----------
    count
        how many sinusoids, 1 to 8.
    omegas
        where their frequencies start [rad/s], one for each; by default ``omega_c`` of the controller, 0.3 omega_c, 0.09 omega_c …
    limits
        within which the frequencies stay [rad/s]; by default from ``0.02 omega_c`` to ``0.5 omega_o``.
    pair_bandwidth
        how fast the sinusoids follow, as λ of the bias [rad/s]; 2.5 times that of the bias by default. An oscillator at ω learns at about
        the rate ``ω · pair_bandwidth / bias_bandwidth``.

    All other parameters are those of ``Kalman``.

    Raises
    ------
    ValueError
        for a parameter out of range.
    """

    count: int = 1
    omegas: Sequence[float] | None = None
    limits: tuple[float, float] | None = None
    pair_bandwidth: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.whole("count", self.count, 1, 8)
        if self.omegas is not None:
            for omega in checks.vector("omegas", self.omegas, self.count).tolist():
                checks.positive("omegas", omega, "rad/s")
        if self.limits is not None:
            low, high = checks.vector("limits", self.limits, 2).tolist()
            if not 0.0 < low < high:
                raise ValueError(
                    f"limits = {self.limits!r}: must be (low, high) with 0 < low < high [rad/s]"
                )
        if self.pair_bandwidth is not None:
            checks.positive("pair_bandwidth", self.pair_bandwidth, "rad/s")

    def oscillators(self, observer: ESO, omega_c: float) -> tuple[Oscillators, float]:
        """Return the oscillators' parameters and how fast their pairs follow [rad/s].

        Raises
        ------
        ValueError
            where a frequency starts outside of the limits.
        """
        low, high = (
            (_LOWEST * omega_c, _HIGHEST * observer.omega_o) if self.limits is None else self.limits
        )
        if self.omegas is None:
            start: Vector = np.asarray(
                np.clip(omega_c * _SPREAD ** np.arange(self.count), low, high), dtype=np.float64
            )
        else:
            start = checks.vector("omegas", self.omegas)
        if not np.all((low <= start) & (start <= high)):
            raise ValueError(
                f"omegas = {self.omegas!r} rad/s: must lie within limits = ({low:g}, {high:g}) rad/s"
            )
        follow = observer.omega_o if self.bias_bandwidth is None else self.bias_bandwidth
        return Oscillators(
            observer.order * self.state + self.bias, start, float(low), float(high)
        ), (2.5 * follow if self.pair_bandwidth is None else self.pair_bandwidth)

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1", …, "bias", "sin1", "cos1", …, "u")``, as far as they are features."""
        names = super().feature_names(order)
        pairs = tuple(f"{wave}{j + 1}" for j in range(self.count) for wave in ("sin", "cos"))
        split = len(names) - self.u
        return (*names[:split], *pairs, *names[split:])
