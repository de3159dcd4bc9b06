"""Which model is fitted: its parameters, how it answers, and how that changes with them.

    A(p) y = B(p) u + Σ_j F_j(p) v_j + D(p) δ(t),        A = p^q (p^(n−q) + … + a_q),   p = s dt

with u held between samples, further known inputs v_j (1 for a constant force, −sign(speed) for Coulomb friction), and D for the state that
the record starts with: ``D(p)/A(p) δ`` is the free motion from any state. The answer to held inputs is exact at the samples. With
``ŷ = A⁻¹(B u + …)`` its derivatives are exact too, and as cheap::

    ∂ŷ/∂a_i = −p^i/A ŷ,      ∂ŷ/∂b_i = p^i/A u,      ∂ŷ/∂d_i = p^i/A δ

(Ljung, *System Identification*, 2nd ed. 1999, eqs. (10.52)–(10.55) has them in the shift operator.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.identification import sampling
from quell.identification.sampling import chains, observable, sampled, states
from quell.types import Matrix, Vector


class Structure(NamedTuple):
    """How many parameters there are of what, in the order of the vector θ: a_q … a_{n−1}; each input's numerator; D."""

    order: int
    """n."""
    integrators: int
    """q, how many poles are known to lie at s = 0."""
    degrees: tuple[int, ...]
    """degree of the numerator of each input, that of u first."""
    rubbing: tuple[float, ...] = ()
    """for each of the last inputs, those of friction, what the speed is that it goes by; see ``friction``."""

    @property
    def free(self) -> int:
        """Number of free coefficients of A."""
        return self.order - self.integrators

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.free + sum(self.degrees) + len(self.degrees) + self.order

    def denominator(self, theta: Vector) -> Vector:
        """Return a (n,), in ascending powers."""
        a = np.zeros(self.order)
        a[self.integrators :] = theta[: self.free]
        return a

    def numerators(self, theta: Vector) -> Matrix:
        """Return the numerators (inputs, n), in ascending powers."""
        found, at = np.zeros((len(self.degrees), self.order)), self.free
        for row, degree in zip(found, self.degrees, strict=True):
            row[: degree + 1] = theta[at : at + degree + 1]
            at += degree + 1
        return found

    def start(self, theta: Vector) -> Vector:
        """Return D (n,), in ascending powers."""
        return theta[self.size - self.order :]

    def powers(self, unit: float) -> Vector:
        """Return what each parameter is multiplied with when time is counted in units ``unit`` times as long."""
        n = self.order
        parts = [unit ** (n - np.arange(degree + 1.0)) for degree in self.degrees]
        return np.concatenate(
            [
                unit ** (n - np.arange(float(self.integrators), n)),
                *parts,
                unit ** (n - 1.0 - np.arange(n)),
            ]
        )


def linear_columns(structure: Structure, a: Vector, v: Matrix) -> Matrix:
    """Return the derivatives of y by all parameters but those of A, which it is linear in (N, size − free)."""
    bank = chains(a, v)
    return np.hstack(
        [
            bank[:, : degree + 1, j]
            for j, degree in enumerate((*structure.degrees, structure.order - 1))
        ]
    )


def output(structure: Structure, theta: Vector, v: Matrix) -> Vector:
    """Return y (N,) for the inputs ``v`` (N, inputs)."""
    B = np.ascontiguousarray(structure.numerators(theta)[:, ::-1].T)
    return states(
        sampled(observable(structure.denominator(theta)), B), v, structure.start(theta)[::-1]
    )[:, 0]


def gradient(structure: Structure, theta: Vector, v: Matrix) -> tuple[Vector, Matrix]:
    """Return y (N,) and its derivatives by θ (N, size)."""
    n, degrees = structure.order, (*structure.degrees, structure.order - 1)
    columns, at = np.full((n, len(degrees)), -1), structure.free
    for j, degree in enumerate(degrees):
        columns[: degree + 1, j] = np.arange(at, at + degree + 1)
        at += degree + 1
    B = structure.numerators(theta)[:, ::-1].T
    a, start = structure.denominator(theta), structure.start(theta)[::-1]
    return sampling.gradient(a, B, start, columns, structure.integrators, v, structure.size)


def lengths(columns: Matrix) -> Vector:
    """Return the columns' lengths."""
    return np.sqrt(np.einsum("ki,ki->i", columns, columns))
