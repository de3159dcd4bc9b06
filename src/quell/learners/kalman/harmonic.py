"""The learner of periodic loads: state, bias and sinusoids of unknown frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quell import checks
from quell.learners.kalman.kalman import Kalman
from quell.learners.kalman.oscillators import Oscillators
from quell.observers.eso import ESO

# Initial frequencies by default: omega_c, then each this multiple of the one before. This and the
# other defaults are from 300 random loops (docs/theory; quell.experiments.stress.random_loops).
_SPREAD = 0.3
# Default limits of the frequencies as multiples of omega_c and omega_o.
_LOWEST, _HIGHEST = 0.02, 0.5
# Default bandwidth of the pairs as a multiple of the bias's bandwidth.
_PAIR_BANDWIDTH = 2.5


@dataclass(frozen=True)
class Harmonic(Kalman):
    """A ``Kalman`` learner with sinusoids of unknown frequency.

    ``f_L = θ · (x̂_1 … x̂_n, 1, sin ψ_1, cos ψ_1, …, u)``. Once the frequency of a rotating or
    repeating load is found (``oscillators.py``), the load is rejected completely, and it does not
    disturb what is learned of the plant.

    Parameters
    ----------
    count
        number of sinusoids, 1 to 8.
    omegas
        initial frequencies [rad/s] within ``limits``, one for each sinusoid; by default ``omega_c``
        of the controller, 0.3 omega_c, 0.09 omega_c …
    limits
        least and largest frequency [rad/s]; ``0.02 omega_c`` and ``0.5 omega_o`` by default.
    pair_bandwidth
        bandwidth λ with which the sinusoids follow [rad/s]; 2.5 times that of the bias by default.
        An oscillator at ω learns at about the rate ``ω · pair_bandwidth / bias_bandwidth``.

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
                rule = "must be (low, high) with 0 < low < high [rad/s]"
                raise ValueError(f"limits = {self.limits!r}: {rule}")
        if self.pair_bandwidth is not None:
            checks.positive("pair_bandwidth", self.pair_bandwidth, "rad/s")

    def oscillators(self, observer: ESO, omega_c: float) -> tuple[Oscillators, float]:
        """Return the parameters of the oscillators, and the bandwidth of their pairs [rad/s].

        Raises
        ------
        ValueError
            for an initial frequency outside of the limits.
        """
        low, high = _LOWEST * omega_c, _HIGHEST * observer.omega_o
        if self.limits is not None:
            low, high = self.limits
        if self.omegas is None:
            start = np.clip(omega_c * _SPREAD ** np.arange(self.count), low, high)
        else:
            start = checks.vector("omegas", self.omegas)
        if not np.all((low <= start) & (start <= high)):
            rule = f"must lie within limits = ({low:g}, {high:g}) rad/s"
            raise ValueError(f"omegas = {self.omegas!r} rad/s: {rule}")
        first = observer.order * self.state + self.bias
        bandwidth = self.pair_bandwidth
        if bandwidth is None:
            bias = observer.omega_o if self.bias_bandwidth is None else self.bias_bandwidth
            bandwidth = _PAIR_BANDWIDTH * bias
        return Oscillators(first, start, float(low), float(high)), bandwidth

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1", …, "bias", "sin1", "cos1", …, "u")``, as far as they are features."""
        names = super().feature_names(order)
        pairs = tuple(f"{wave}{j + 1}" for j in range(self.count) for wave in ("sin", "cos"))
        split = len(names) - self.u
        return (*names[:split], *pairs, *names[split:])
