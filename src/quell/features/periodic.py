"""Forces that are periodic in position: cogging, eccentricity, screw pitch, gear mesh."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.features.base import (
    Features,
    dimensionless,
    unit,
    write,
    write_nothing,
    write_physical,
)
from quell.kernels.functions import cos, sin
from quell.kernels.sized import Size
from quell.types import Vector

# A learner's covariance of so many orders takes 8 MB, and a sample of it a millisecond.
_MOST_ORDERS = 500
# No encoder has so many counts a period.
_LARGEST_ORDER = 100_000


class PeriodicDesign(NamedTuple):
    """Parameters of ``Periodic``."""

    state: Size  # index of the state
    rate: float  # ``2π/period``
    orders: NDArray[np.int64]  # m (k,), increasing


@dataclass(frozen=True)
class Periodic(Features):
    """Waves in position, ``sin(2π m x/period)`` and ``cos(2π m x/period)`` for each order m.

    With them ``f = Σ a_m sin(2π m x/period) + b_m cos(2π m x/period)`` is linear in its
    coefficients, and stays the same at any speed, where sinusoids in time (``Harmonic``) have to
    find each new frequency. After a shift of the origin, for example by a restart without index
    pulse, the coefficients are other ones.

    Parameters
    ----------
    period
        change of x after which the force repeats, in the units of x: by default 2π, a revolution in
        radians.
    orders
        numbers m of waves in a period, whole numbers from 1.
    highest
        in place of ``orders``, if they are not known: all orders from 1 to this one; 12 by default.
        ``RLS`` finds all coefficients, or with ``RLS(..., strongest=k)`` the k strongest alone,
        which takes less time a sample and more revolutions.
    state
        number of the state x, from 1; the output y by default.

    Raises
    ------
    ValueError
        for a period that is not positive, orders that are no different whole numbers from 1, both
        ``orders`` and ``highest``, or a plant without the state.

    References
    ----------
    Petrović, Ortega, Stanković & Tadmor, *Design and implementation of an adaptive controller for
    torque ripple minimization in PM synchronous motors*, IEEE Trans. Power Electronics 15 (2000):
    cogging as a Fourier series in position, learned online.

    Examples
    --------
    >>> Periodic(orders=(7, 28)).names(2)
    ('sin 7 x1', 'cos 7 x1', 'sin 28 x1', 'cos 28 x1')
    """

    period: float = math.tau
    orders: Sequence[int] | None = None
    highest: int | None = None
    state: int = 1

    def __post_init__(self) -> None:
        checks.positive("period", self.period)
        checks.whole("state", self.state, 1)
        checks.optional(checks.whole, "highest", self.highest, 1, _MOST_ORDERS)
        if self.orders is None:
            return
        if self.highest is not None:
            raise ValueError("orders and highest: give one of them")
        if not checks.is_sequence(self.orders) or not 0 < len(self.orders) <= _MOST_ORDERS:
            rule = f"must be a tuple of 1 to {_MOST_ORDERS} whole numbers, for example (1, 2, 6)"
            raise ValueError(f"orders = {self.orders!r}: {rule}")
        for i, order in enumerate(self.orders):
            checks.whole(f"orders[{i}]", order, 1, _LARGEST_ORDER)
        if len(set(self.orders)) < len(self.orders):
            raise ValueError(f"orders = {self.orders!r}: must not repeat an order")

    @property
    def _sorted_orders(self) -> list[int]:
        if self.orders is None:
            return list(range(1, (12 if self.highest is None else self.highest) + 1))
        return sorted(self.orders)

    def design(self, order: int) -> PeriodicDesign:
        """Return the index of the state, the angle of a unit of x, and the orders."""
        if self.state > order:
            rule = f"a plant of order {order} has no state {self.state}"
            raise ValueError(f"state = {self.state!r}: {rule}")
        orders = np.array(self._sorted_orders, dtype=np.int64)
        return PeriodicDesign(self.state - 1, math.tau / self.period, orders)

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("sin 1 x1", "cos 1 x1", …)``, in units of 2π/period."""
        waves = ((wave, m) for m in self._sorted_orders for wave in ("sin", "cos"))
        return tuple(f"{wave} {m} x{self.state}" for wave, m in waves)


@write_physical.register(PeriodicDesign)
def _write(features: PeriodicDesign, x: Vector, u: float, out: Vector) -> None:
    angle = features.rate * x[features.state]
    step_sine, step_cosine = sin(angle), cos(angle)
    sine, cosine = 0.0, 1.0
    before = 0.0
    for k in range(features.orders.size):
        m = float(features.orders[k])
        if m == before + 1.0:
            # The next order by the addition theorem, a fifth of the time of sin and cos. The error
            # of 500 such steps is below 1e-13.
            turned = sine * step_cosine + cosine * step_sine
            cosine = cosine * step_cosine - sine * step_sine
            sine = turned
        else:
            sine, cosine = sin(m * angle), cos(m * angle)
        out[2 * k], out[2 * k + 1] = sine, cosine
        before = m


write.register(PeriodicDesign)(write_nothing)
unit.register(PeriodicDesign)(dimensionless)
