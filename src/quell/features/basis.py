"""Features of the state that are nonlinear: Fourier, radial, periodic, friction.

Random Fourier features.

Forces that are periodic in position: cogging, eccentricity, screw pitch, gear mesh.

Dry friction: features that depend on the direction of motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.features.base import (
    Features,
    StateIndices,
    check_states,
    dimensionless,
    state_indices,
    unit,
    write,
    write_nothing,
    write_physical,
)
from quell.kernels.functions import cos, exp, sin, tanh
from quell.kernels.sized import Flag, Size
from quell.types import Matrix, Vector

# ---- Random Fourier features ----


class RandomFourierDesign(NamedTuple):
    """Parameters of ``RandomFourier``."""

    states: StateIndices
    waves: Matrix  # w (p, k)
    phase: Vector  # b (p,)
    size: float  # ``sqrt(2/p)``


@dataclass(frozen=True)
class RandomFourier(Features):
    """Random features ``sqrt(2/p) cos(w·x + b)``.

    A linear model in these features approximates a Gaussian process in x: with w normal of standard
    deviation 1/length and b uniform, ``φ(x)·φ(x')`` approaches ``exp(−|x − x'|²/2 length²)`` as p
    grows.

    Parameters
    ----------
    count
        number p of features.
    length
        length over which the function varies, in scaled states, which lie in [−1, 1].
    seed
        of w and b.
    states
        numbers of the states, from 1; all by default.

    Raises
    ------
    ValueError
        for arguments out of range.

    References
    ----------
    Rahimi & Recht, *Random features for large-scale kernel machines*, NIPS 2007, algorithm 1.
    """

    count: int = 50
    length: float = 1.0
    seed: int = 0
    states: Sequence[int] | None = None

    def __post_init__(self) -> None:
        checks.whole("count", self.count, 1)
        checks.positive("length", self.length)
        checks.whole("seed", self.seed, 0)
        check_states(self.states)

    def design(self, order: int) -> RandomFourierDesign:
        """Return the waves, drawn from ``seed``."""
        rng, chosen = np.random.default_rng(self.seed), state_indices(self.states, order)
        return RandomFourierDesign(
            states=chosen,
            waves=rng.normal(size=(self.count, chosen.size)) / self.length,
            phase=rng.uniform(0.0, 2.0 * math.pi, self.count),
            size=math.sqrt(2.0 / self.count),
        )

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("fourier1", …)``."""
        return tuple(f"fourier{j + 1}" for j in range(self.count))


@write.register(RandomFourierDesign)
def _write(features: RandomFourierDesign, x: Vector, u: float, out: Vector) -> None:
    for j in range(features.phase.size):
        angle = features.phase[j]
        for k in range(features.states.size):
            angle += features.waves[j, k] * x[features.states[k]]
        out[j] = features.size * cos(angle)


unit.register(RandomFourierDesign)(dimensionless)


# ---- Radial basis functions ----

# Bases of the Halton sequence, one for each state.
_PRIMES = (2, 3, 5, 7, 11, 13, 17, 19)


class RadialDesign(NamedTuple):
    """Parameters of ``RBF``."""

    states: StateIndices
    centers: Matrix  # (p, k)
    weight: float  # ``1/(2 width²)``


class RBF(Features):
    """Gaussians ``exp(−|x − c|²/(2 width²))`` around centres c in the scaled states' range [−1, 1].

    Each is large only near its centre, so learning at one place does not change other places.

    Parameters
    ----------
    count
        number p of centres from a Halton sequence; 25 by default.
    width
        of a Gaussian; ``2 p^(−1/k)`` for k states by default, about the distance between centres.
    states
        numbers of the states, from 1; the first two by default.
    centers
        the centres (p, k), instead of ``count``.

    Raises
    ------
    ValueError
        for arguments out of range, or centres that do not fit the states.

    References
    ----------
    Broomhead & Lowe, *Multivariable functional interpolation and adaptive networks*, Complex
    Systems 2 (1988), eq. (2.2); Halton, *On the efficiency of certain quasi-random sequences of
    points*, Numerische Mathematik 2 (1960).
    """

    def __init__(
        self,
        count: int | None = None,
        width: float | None = None,
        *,
        states: Sequence[int] | None = None,
        centers: Any = None,
    ) -> None:
        if count is not None and centers is not None:
            raise ValueError("count and centers: give one of them")
        self.centers = checks.optional(checks.matrix, "centers", centers)
        self.count = checks.whole("count", 25 if count is None else count, 1)
        if self.centers is not None:
            self.count = len(self.centers)
        self.width = checks.optional(checks.positive, "width", width)
        check_states(states)
        self.states = None if states is None else tuple(states)

    def __repr__(self) -> str:
        return f"RBF(count={self.count}, width={self.width}, states={self.states})"

    def design(self, order: int) -> RadialDesign:
        """Return centres and width."""
        chosen = state_indices(self.states, order, 2)
        if self.centers is None:
            if chosen.size > len(_PRIMES):
                rule = f"must be at most {len(_PRIMES)}, or centers must be given"
                raise ValueError(f"states = {self.states!r}: {rule}")
            bases, points = _PRIMES[: chosen.size], range(1, self.count + 1)
            halton = np.array([[_radical_inverse(i, base) for base in bases] for i in points])
            centers = 2.0 * halton - 1.0
        else:
            centers = checks.matrix("centers", self.centers, columns=chosen.size)
        width = 2.0 * self.count ** (-1.0 / chosen.size) if self.width is None else self.width
        return RadialDesign(chosen, centers, 0.5 / width**2)

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("rbf1", …)``."""
        return tuple(f"rbf{j + 1}" for j in range(self.count))


def _radical_inverse(index: int, base: int) -> float:
    """Return ``index`` with its digits reversed behind the point, in (0, 1) (Halton 1960)."""
    inverse, place = 0.0, 1.0 / base
    while index:
        index, digit = divmod(index, base)
        inverse += digit * place
        place /= base
    return inverse


@write.register(RadialDesign)
def _write_radial(features: RadialDesign, x: Vector, u: float, out: Vector) -> None:
    for j in range(features.centers.shape[0]):
        distance = 0.0
        for k in range(features.states.size):
            difference = x[features.states[k]] - features.centers[j, k]
            distance += difference * difference
        out[j] = exp(-features.weight * distance)


unit.register(RadialDesign)(dimensionless)


# ---- Forces that are periodic in position ----

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
def _write_periodic(features: PeriodicDesign, x: Vector, u: float, out: Vector) -> None:
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


# ---- Dry friction ----


class FrictionDesign(NamedTuple):
    """Parameters of ``Friction``."""

    states: StateIndices
    width: float
    sign: Flag


class FrictionAtSpeedDesign(NamedTuple):
    """Parameters of ``Friction`` with a ``speed``."""

    states: StateIndices
    width: float  # in the units of the velocities
    sign: Flag


@dataclass(frozen=True)
class Friction(Features):
    """Coulomb friction, smoothed: ``tanh(v/width)``, for each velocity v.

    Parameters
    ----------
    width
        velocity over which the friction reverses, as a share of the largest velocity. Because the
        estimated velocity lags and its noise must not flip the feature, choose it too wide rather
        than too narrow.
    sign
        whether ``sign(v)`` is a feature too.
    states
        numbers of the velocities among the states, from 1; x_2 by default.
    speed
        in place of ``width``, the velocity over which the friction reverses, in the units of the
        plant. Use it where y grows without bound, as the angle of a shaft does: the largest
        velocity that a learner expects grows with y.

    Raises
    ------
    ValueError
        for a width or speed that is not positive, or a plant without a velocity.

    References
    ----------
    Armstrong-Hélouvry, Dupont & Canudas de Wit, *A survey of models, analysis tools and
    compensation methods for the control of machines with friction*, Automatica 30 (1994), section
    2.
    """

    width: float = 0.05
    sign: bool = False
    states: Sequence[int] = (2,)
    speed: float | None = None

    def __post_init__(self) -> None:
        checks.positive("width", self.width)
        checks.optional(checks.positive, "speed", self.speed)
        checks.flag("sign", self.sign)
        check_states(self.states)

    @property
    def _width(self) -> float:
        return float(self.width if self.speed is None else self.speed)

    def design(self, order: int) -> FrictionDesign | FrictionAtSpeedDesign:
        """Return the indices of the velocities, the width and whether there are signs."""
        design = FrictionDesign if self.speed is None else FrictionAtSpeedDesign
        return design(state_indices(self.states, order), self._width, bool(self.sign))

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("tanh(x2/0.05)",)``, with ``"sign(x2)"`` after each if ``sign`` is set."""
        names: list[str] = []
        for i in state_indices(self.states, order):
            names.append(f"tanh(x{i + 1}/{self._width:g})")
            if self.sign:
                names.append(f"sign(x{i + 1})")
        return tuple(names)


@write.register(FrictionDesign)
@write_physical.register(FrictionAtSpeedDesign)
def _write_friction(features: Any, x: Vector, u: float, out: Vector) -> None:
    at = 0
    for k in range(features.states.size):
        velocity = x[features.states[k]]
        out[at] = tanh(velocity / features.width)
        at += 1
        if features.sign:
            out[at] = 1.0 if velocity > 0.0 else (-1.0 if velocity < 0.0 else 0.0)
            at += 1


write.register(FrictionAtSpeedDesign)(write_nothing)
unit.register(FrictionDesign)(dimensionless)
unit.register(FrictionAtSpeedDesign)(dimensionless)
