"""Random Fourier features."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.features.base import Features, dimensionless, unit, write
from quell.features.states import StateIndices, check_states, state_indices
from quell.kernels.functions import cos
from quell.types import Matrix, Vector


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
