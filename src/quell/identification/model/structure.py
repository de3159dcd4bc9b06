"""The model structure: its parameters θ, its output, and the derivatives of the output by θ.

    A(p) y = B(p) u + Σ_j F_j(p) v_j + D(p) δ(t),        A = p^q (p^(n−q) + … + a_q),   p = s dt

u is held between samples; v_j are further known inputs (1 for a constant force, −sign(speed) for
Coulomb friction), and D stands for the initial state: ``D(p)/A(p) δ`` is the free motion from any
state. The output is exact at the samples, and with ``ŷ = A⁻¹(B u + …)`` so are its derivatives::

    ∂ŷ/∂a_i = −p^i/A ŷ,      ∂ŷ/∂b_i = p^i/A u,      ∂ŷ/∂d_i = p^i/A δ

(Ljung, *System Identification*, 2nd ed. 1999, eqs. (10.52)–(10.55), in the shift operator.)

With *direct feedthrough* u also acts on y at once, ``y = B/A u + D_u u + …``: a numerator ``B + D_u
A`` with as many zeros as poles. D_u is a linear parameter as b is, and its derivative is u.

**Coulomb friction** is an input of its own, minus the sign of a speed::

    A y = B u + F₁ v₁ + F₂ v₂,      v₁ = −sign(speed of the driven side),   v₂ = −sign(y')

For known v the model is linear in F. The v are taken from the motion of the last model (at first v₂
from the measured motion), then the parameters are fitted for these v, and so on until the v no
longer change; the last steps are those of the simulated model, which takes v from its own speeds.

v is held over a sample as u is, so it is the mean of −sign(w) of a speed w. To first order w is a
straight line in a sample: it ends at ``w_0 + Δ`` where v = −sign(w_0) acts all along. If it keeps
its sign, this is v. Else w is zero after the share ``λ = −w_0/Δ`` of the sample. If u overcomes the
friction, w goes on with the other sign, and ``v = (1 − 2 λ) sign(w_0)``; if not, the side sticks,
and v is the value within ±1 for which w ends at zero (the implicit step of Acary & Brogliato,
*Numerical Methods for Nonsmooth Dynamical Systems*, 2008, ch. 1).

Friction on the measured side acts on y″ directly: F₂ has degree n − 2. Friction on the driven side
enters like u: F₁ has degree 0. Up to order 3 the sides move as one, and there is only v₂. From
order 4 on there may be a spring between them. For inertias J₁ (driven) and J₂ with a spring k::

    J₂ y″ = k (θ₁ − y) − …     so   θ₁' = y' + y‴/ω_a²,     ω_a² = k/J₂

ω_a, the frequency at which the driven side stands still while the other oscillates, is not a zero
of y and has to be searched for: it is below the resonance ``ω_r² = ω_a² (1 + J₂/J₁)``.

In order 1 y is itself the speed, ``y' + a y = b u − F sign(y)``: the record of a drive's speed.

**Start at rest.** A plant that has been at rest at u_0 and y_0 before the record obeys::

    y = y_0 + B/A (u − u_0) + F₁/A v₁ + …        from zero initial states

with one unknown y_0 in place of the n of D and the constant force.

**Several records** have the same A, B and F, but each has its own D, or its own y_0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from quell.identification.model import sampling
from quell.identification.model.sampling import (
    chains,
    observable,
    sampled,
    states,
    states_with_friction,
)
from quell.types import Matrix, Vector


class Structure(NamedTuple):
    """The parameters θ: a_q … a_{n−1}; numerators of the inputs; D_u; D or y_0 of each record."""

    order: int  #: n
    integrators: int  #: q, the number of poles that are set to s = 0
    degrees: tuple[int, ...]  #: degree of the numerator of each input, u first
    friction: tuple[float, ...] = ()
    """1/ω_a² [samples²] of each friction input, the last ones; 0.0 on the measured side."""
    direct: bool = False
    """Whether u also acts on y at once: ``y = … + D_u u``; then B has the degree n − 1."""
    at_rest: bool = False
    """Whether the records start at rest; then the first input is u − u_0."""
    samples: tuple[int, ...] = ()
    """Number of samples of each record, if there are several."""

    @property
    def free(self) -> int:
        """Number of free coefficients of A."""
        return self.order - self.integrators

    @property
    def common(self) -> int:
        """Number of parameters that all records have in common."""
        return self.free + sum(self.degrees) + len(self.degrees) + self.direct

    @property
    def of_start(self) -> int:
        """Number of parameters of the start of each record."""
        return 1 if self.at_rest else self.order

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.common + self.of_start * max(len(self.samples), 1)

    def denominator(self, theta: Vector) -> Vector:
        """Return a (n,), in ascending powers."""
        a = np.zeros(self.order)
        a[self.integrators :] = theta[: self.free]
        return a

    @property
    def places(self) -> list[int]:
        """Places in θ where the numerator of each input begins."""
        sizes = [degree + 1 for degree in self.degrees[:-1]]
        return list(accumulate(sizes, initial=self.free))

    def numerators(self, theta: Vector) -> Matrix:
        """Return the numerators (inputs, n), in ascending powers."""
        found = np.zeros((len(self.degrees), self.order))
        for row, degree, at in zip(found, self.degrees, self.places, strict=True):
            row[: degree + 1] = theta[at : at + degree + 1]
        return found

    def initial(self, theta: Vector) -> Vector:
        """Return D (n,) of a single record, in ascending powers; zero for a start at rest."""
        return np.zeros(self.order) if self.at_rest else theta[self.common :]

    def level(self, theta: Vector) -> float:
        """Return y_0 of a single record that starts at rest, else zero."""
        return float(theta[-1]) if self.at_rest else 0.0

    def feedthrough(self, theta: Vector) -> float:
        """Return D_u, zero without direct feedthrough."""
        return float(theta[self.common - 1]) if self.direct else 0.0

    def powers(self, unit: float) -> Vector:
        """Return the factor of each parameter for a unit of time that is ``unit`` times as long."""
        n = self.order
        a = unit ** (n - np.arange(float(self.integrators), n))
        numerators = [unit ** (n - np.arange(degree + 1.0)) for degree in self.degrees]
        direct = np.ones(int(self.direct))
        start = np.ones(1) if self.at_rest else unit ** (n - 1.0 - np.arange(n))
        return np.concatenate([a, *numerators, direct, np.tile(start, max(len(self.samples), 1))])

    def records(self, count: int) -> list[slice]:
        """Return the places of each record in ``count`` samples."""
        edges = accumulate(self.samples or (count,), initial=0)
        return [slice(*pair) for pair in pairwise(edges)]

    def single(self) -> Structure:
        """Return the structure for one of the records."""
        return self._replace(samples=())


def _each(structure: Structure, theta: Vector, count: int) -> Iterator[tuple[slice, Vector, slice]]:
    """Yield the samples of each record, its own θ, and the places of its start in θ."""
    for i, place in enumerate(structure.records(count)):
        at = structure.common + i * structure.of_start
        start = slice(at, at + structure.of_start)
        yield place, np.append(theta[: structure.common], theta[start]), start


def linear_columns(structure: Structure, a: Vector, v: Matrix) -> Matrix:
    """Return the derivatives of y by all parameters except those of A (N, size − free)."""
    found = np.zeros((v.shape[0], structure.size - structure.free))
    common = structure.common - structure.free
    for i, place in enumerate(structure.records(v.shape[0])):
        bank = chains(a, v[place])
        parts = [bank[:, : degree + 1, j] for j, degree in enumerate(structure.degrees)]
        found[place, :common] = np.hstack([*parts, v[place, : int(structure.direct)]])
        at = common + i * structure.of_start
        start = 1.0 if structure.at_rest else bank[:, :, -1]
        found[place, at : at + structure.of_start] = start
    return found


def output(structure: Structure, theta: Vector, v: Matrix) -> Vector:
    """Return y (N,) for the inputs ``v`` (N, inputs)."""
    return free_run(structure, theta, v)[0]


def free_run(
    structure: Structure, theta: Vector, v: Matrix, own_friction: bool = False
) -> tuple[Vector, Matrix]:
    """Return y (N,) and the inputs, with ``own_friction`` those of the model's own speeds."""
    if structure.samples:
        single, parts = structure.single(), _each(structure, theta, v.shape[0])
        runs = [free_run(single, own, v[place], own_friction) for place, own, _ in parts]
        return np.concatenate([y for y, _ in runs]), np.vstack([inputs for _, inputs in runs])
    A = observable(structure.denominator(theta))
    B = np.ascontiguousarray(structure.numerators(theta)[:, ::-1].T)
    system, initial = sampled(A, B), structure.initial(theta)[::-1]
    direct = structure.feedthrough(theta) * v[:, 0] + structure.level(theta)
    if not (own_friction and structure.friction):
        return states(system, v, initial)[:, 0] + direct, v
    if structure.order == 1:
        # y, and with it the sign of the speed, has a level of its own.
        speeds, offset = np.ones((1, 1)), structure.level(theta)
    else:
        # y' and y‴ without the direct effect of the inputs; y = x_1
        first, offset = A[0], 0.0
        third = first @ A @ A
        speeds = np.array([first + weight * third for weight in structure.friction])
    x, inputs = states_with_friction(system, v, speeds, initial, offset)
    return x[:, 0] + direct, inputs


def cost(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> float:
    """Return the mean square of the output error [y-unit²]; infinite if it is not finite."""
    if not np.all(np.isfinite(theta)):
        return math.inf
    with np.errstate(all="ignore"):
        value = float(np.mean((y - output(structure, theta, v)) ** 2))
    return value if math.isfinite(value) else math.inf


def gradient(structure: Structure, theta: Vector, v: Matrix) -> tuple[Vector, Matrix]:
    """Return y (N,) and its derivatives by θ (N, size)."""
    if structure.samples:
        y, psi = np.empty(v.shape[0]), np.zeros((v.shape[0], structure.size))
        single, common = structure.single(), structure.common
        for place, own, start in _each(structure, theta, v.shape[0]):
            y[place], part = gradient(single, own, v[place])
            psi[place, :common], psi[place, start] = part[:, :common], part[:, common:]
        return y, psi
    n, degrees = structure.order, structure.degrees
    columns = np.full((n, len(degrees) + 1), -1)
    for j, (degree, at) in enumerate(zip(degrees, structure.places, strict=True)):
        columns[: degree + 1, j] = np.arange(at, at + degree + 1)
    if not structure.at_rest:
        columns[:, -1] = np.arange(structure.common, structure.size)
    a, B = structure.denominator(theta), structure.numerators(theta)[:, ::-1].T
    initial = structure.initial(theta)[::-1]
    y, psi = sampling.gradient(a, B, initial, columns, structure.integrators, v, structure.size)
    # The derivatives by a are those of the part of y that has passed through 1/A.
    if structure.direct:
        psi[:, structure.common - 1] = v[:, 0]
        y += structure.feedthrough(theta) * v[:, 0]
    if structure.at_rest:
        psi[:, -1] = 1.0
        y += structure.level(theta)
    return y, psi


def lengths(columns: Matrix) -> Vector:
    """Return the Euclidean lengths of the columns."""
    return np.sqrt(np.einsum("ki,ki->i", columns, columns))


def nonzero_lengths(columns: Matrix) -> Vector:
    """Return the lengths of the columns, 1 for a zero column, to divide by."""
    size = lengths(columns)
    return np.where(size > 0.0, size, 1.0)
