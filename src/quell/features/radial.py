"""Radial basis functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.features.base import Features, dimensionless, unit, write
from quell.features.states import StateIndices, check_states, state_indices
from quell.kernels.functions import exp
from quell.types import Matrix, Vector

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
def _write(features: RadialDesign, x: Vector, u: float, out: Vector) -> None:
    for j in range(features.centers.shape[0]):
        distance = 0.0
        for k in range(features.states.size):
            difference = x[features.states[k]] - features.centers[j, k]
            distance += difference * difference
        out[j] = exp(-features.weight * distance)


unit.register(RadialDesign)(dimensionless)
