"""Sampled systems of one input and one output."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.types import Matrix, Vector


class System(NamedTuple):
    """A sampled system of one input and one output: ``x⁺ − x = N x + B u``, ``y = C x + D u``."""

    N: Matrix
    B: Vector
    C: Vector
    D: float

    @classmethod
    def balanced(cls, N: Matrix, B: Vector, C: Vector, D: float) -> System:
        """Return the system with states scaled to similar size by powers of two, which is exact."""
        from scipy.linalg import matrix_balance

        if N.shape[0] == 0:
            return cls(N, B, C, D)
        scaled, (scale, _) = matrix_balance(N, permute=False, separate=True)
        return cls(scaled, B / scale, C * scale, D)

    @property
    def largest_pole(self) -> float:
        """Largest |z| of all poles; 0 without states."""
        poles = 1.0 + np.linalg.eigvals(System.balanced(*self).N)
        return float(np.max(np.abs(poles), initial=0.0))

    def then(self, following: System) -> System:
        """Return this system followed by another one: its output is the input of ``following``."""
        n, m = self.N.shape[0], following.N.shape[0]
        N = np.block([[self.N, np.zeros((n, m))], [np.outer(following.B, self.C), following.N]])
        B = np.concatenate([self.B, following.B * self.D])
        return System(N, B, np.append(following.D * self.C, following.C), following.D * self.D)
