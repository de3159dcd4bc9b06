"""The learner of periodic loads: state, bias and sinusoids of unknown frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quell import checks
from quell.learners.kalman.kalman import Kalman
from quell.learners.kalman.oscillators import Oscillators
from quell.learners.kalman.search import NoSearch, frequency_search
from quell.observers.eso import ESO

# Initial frequencies by default: omega_c, then each this multiple of the one before. This and the
# other defaults are from 300 random loops (docs/theory; quell.experiments.stress.random_loops).
_SPREAD = 0.3
# Default limits of the frequencies as multiples of omega_c and omega_o.
_LOWEST, _HIGHEST = 0.02, 0.5
# Default bandwidth of the pairs as a multiple of the bias's bandwidth.
_PAIR_BANDWIDTH = 2.5
# Most sinusoids: the time of a sample grows with the square of their number. And the highest order.
_MOST_PAIRS, _HIGHEST_ORDER = 16, 1000


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
        least and largest frequency [rad/s]; ``0.02 omega_c`` (of ``omega_o``, if that is smaller)
        and ``0.5 omega_o`` by default, or the largest with which the highest order is at
        ``omega_o``.
    orders
        multiples of each frequency that a load may contain, different whole numbers from 1, the
        strongest first: for example (1, 3, 5, 7) for a square wave. Together ``count`` and
        ``orders`` make 16 sinusoids at most.
    search
        whether frequencies are searched in the past (``search.py``), instead of near the initial
        ones alone. It separates sinusoids whose frequencies differ by a factor of 1.2 within a
        beat period, and finds loads of several orders.
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
    orders: Sequence[int] = (1,)
    search: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.whole("count", self.count, 1, 8)
        checks.flag("search", self.search)
        self._check_orders()
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

    def _check_orders(self) -> None:
        if not checks.is_sequence(self.orders) or len(self.orders) == 0:
            rule = "must be a tuple of whole numbers, for example (1, 3, 5)"
            raise ValueError(f"orders = {self.orders!r}: {rule}")
        for i, order in enumerate(self.orders):
            checks.whole(f"orders[{i}]", order, 1, _HIGHEST_ORDER)
        if len(set(self.orders)) < len(self.orders):
            raise ValueError(f"orders = {self.orders!r}: must not repeat an order")
        if self.count * len(self.orders) > _MOST_PAIRS:
            rule = f"must make {_MOST_PAIRS} sinusoids at most"
            raise ValueError(f"count = {self.count}, orders = {self.orders!r}: {rule}")

    def oscillators(self, observer: ESO, omega_c: float) -> tuple[Oscillators, float]:
        """Return the parameters of the oscillators, and the bandwidth of their pairs [rad/s].

        Raises
        ------
        ValueError
            for an initial frequency outside of the limits.
        """
        # A law may be faster than the observer, as one that was tuned; loads of use are not.
        slower = min(omega_c, observer.omega_o)
        low, high = _LOWEST * slower, _HIGHEST * observer.omega_o
        if len(self.orders) > 1:
            high = min(high, observer.omega_o / max(self.orders))
        if self.limits is not None:
            low, high = self.limits
        if self.omegas is None:
            start = np.clip(slower * _SPREAD ** np.arange(self.count), low, high)
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
        orders = np.array(self.orders, dtype=np.float64)
        return Oscillators(first, start, float(low), float(high), orders), bandwidth

    def frequency_search(self, observer: ESO, omega_c: float, oscillators: Oscillators) -> Any:
        """Return the parameters of the search for frequencies, if there is one."""
        if not self.search:
            return NoSearch()
        return frequency_search(observer, omega_c, oscillators, observer.order * self.state)

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1", …, "bias", "sin1", "cos1", …, "u")``, as far as they are features.

        With several orders the sinusoids are ``"sin1 ·1", "cos1 ·1", "sin1 ·3", …``.
        """
        names = super().feature_names(order)
        several = len(self.orders) > 1
        labels = [
            f"{j + 1}" + f" ·{order}" * several for j in range(self.count) for order in self.orders
        ]
        pairs = tuple(f"{wave}{label}" for label in labels for wave in ("sin", "cos"))
        split = len(names) - self.u
        return (*names[:split], *pairs, *names[split:])
