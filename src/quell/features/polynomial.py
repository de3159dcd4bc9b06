"""Monomials of the state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.features.base import Features, unit, write
from quell.features.states import check_states, state_indices
from quell.types import Vector

# A learner's covariance of so many features takes 8 MB, and a sample of it a millisecond.
_MOST_FEATURES = 1000


class PolynomialDesign(NamedTuple):
    """Parameters of ``Polynomial``."""

    factors: NDArray[np.int64]  # (p, degree): indices of the states to multiply; −1 for none


@dataclass(frozen=True)
class Polynomial(Features):
    """All monomials of the state of total degree 2 to ``degree``.

    They describe a spring that stiffens or a drag that grows with the square of the speed. Degree 1
    is ``State()``, degree 0 ``Bias()``.

    Parameters
    ----------
    degree
        the largest total degree.
    states
        numbers of the states, from 1; all by default.

    Raises
    ------
    ValueError
        for a degree below 2, more than a thousand monomials, or a state that the plant does not
        have.
    """

    degree: int = 3
    states: Sequence[int] | None = None

    def __post_init__(self) -> None:
        checks.whole("degree", self.degree, 2)
        check_states(self.states)

    def design(self, order: int) -> PolynomialDesign:
        """Return the table of factors."""
        chosen = state_indices(self.states, order).tolist()
        count = math.comb(len(chosen) + self.degree, len(chosen)) - 1 - len(chosen)
        if count > _MOST_FEATURES:
            raise ValueError(
                f"degree = {self.degree}: has {count:.3g} monomials of {len(chosen)} states: must "
                f"have at most {_MOST_FEATURES}; lower degree, or choose states"
            )
        rows = [
            [*factors, *[-1] * (self.degree - degree)]
            for degree in range(2, self.degree + 1)
            for factors in combinations_with_replacement(chosen, degree)
        ]
        return PolynomialDesign(np.array(rows, dtype=np.int64))

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1^2", "x1 x2", …)``."""
        return tuple(_name([int(i) for i in row if i >= 0]) for row in self.design(order).factors)


def _name(factors: list[int]) -> str:
    powers = {f"x{i + 1}": factors.count(i) for i in factors}
    return " ".join(f"{x}^{power}" if power > 1 else x for x, power in powers.items())


@write.register(PolynomialDesign)
def _write(features: PolynomialDesign, x: Vector, u: float, out: Vector) -> None:
    factors = features.factors
    for j in range(factors.shape[0]):
        product = 1.0
        for k in range(factors.shape[1]):
            if factors[j, k] >= 0:
                product *= x[factors[j, k]]
        out[j] = product


@unit.register(PolynomialDesign)
def _unit(features: PolynomialDesign, scale: Vector, out: Vector) -> None:
    factors = features.factors
    for j in range(factors.shape[0]):
        product = 1.0
        for k in range(factors.shape[1]):
            if factors[j, k] >= 0:
                product /= scale[factors[j, k]]
        out[j] = product
