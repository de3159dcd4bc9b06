"""Vector fitting: poles and zeros of a rational function from its values at frequencies.

With known poles p_i the equation ``(1 + Σ c_i/(s − p_i)) G = Σ r_i/(s − p_i) + d`` is linear, and
the zeros of its first factor are better poles (Gustavsen & Semlyen, *IEEE Trans. Power Delivery*
14, 1999). After some rounds the poles no longer change; the zeros are those of the right side.

The spectra U and Y of a record of N samples have such an equation, too, and no window is needed:
what the record begins and ends with adds ``Σ t_i/(z − p_i) + e`` to Y, as a transient has the poles
of the plant (Pintelon & Schoukens, *System Identification*, 2nd ed. 2012, sec. 6.3.2)::

    (1 + Σ c_i/(z − p_i)) Y = (Σ r_i/(z − p_i) + d) U + Σ t_i/(z − p_i) + e,     z = exp(jω_k)

Noise in Y multiplies the unknown c_i, so a resonance that is hardly above the noise is not found in
this way. Beside the poles that are known it is: for a pair p, p̄ of given frequency and damping the
equation ``Y = (Σ r_i/(z − p_i) + d) U + Σ t_i/(z − p_i) + e`` is linear, and the pair that reduces
the error most is looked for on a grid (a matched filter for each). The error is weighted by the
spectrum of what the known poles leave, the median of neighbouring lines, which no resonance moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.types import Matrix, Vector

Complex = NDArray[Any]

ROUNDS = 12
"""Rounds after which poles hardly change: chosen by hand."""

# Range of the first poles: from so many lines of a spectrum on, to so many rad per sample. By hand.
_SLOWEST, _FASTEST = 3.0, 1.5
# Damping and largest frequency [rad/sample] of the pairs of the grid, and the step of frequency as
# a multiple of the damping: neighbours overlap. By hand.
_DAMPING, _FASTEST_PAIR, _STEP = (0.02, 0.1), 2.0, 1.5
# Lines of a band in which noise is taken as white, at least, and its last line over its first one:
# by hand.
_BAND, _WIDER = 12, 1.3
# Relative singular value of normal equations that counts as zero.
_RANK = 1e-10


class Rational(NamedTuple):
    """A rational function that was fitted."""

    poles: Complex
    zeros: Complex  # as many
    error: float  # mean square of its weighted error


def vector_fit(
    s: Complex, H: Complex, weight: Vector, order: int, rounds: int = ROUNDS
) -> Rational:
    """Return a rational function of ``order``.

    ``H`` are its values at the imaginary ``s`` (N,), in a unit near their middle, and ``weight``
    that of the error of each.
    """
    poles = _first(abs(s[0]), abs(s[-1]), order)
    one = np.ones(s.size)
    for _ in range(rounds):
        poles = _better(poles, s, H, [one], weight)
        poles = _cleaned(np.where(poles.real > 0.0, -poles.conjugate(), poles))
    return _rational(poles, s, H, [one], weight)


class Spectra(NamedTuple):
    """The spectra of u and y of a record, without its mean."""

    z: Complex  # exp(jω) of the lines (N,)
    omega: Vector  # [rad/sample]
    U: Complex
    Y: Complex

    @classmethod
    def of(cls, u: Vector, y: Vector) -> Spectra:
        """Return those of a record."""
        U, Y = (np.fft.rfft(x - np.mean(x))[1 : (x.size + 1) // 2] for x in (u, y))
        omega = 2.0 * np.pi * np.arange(1, U.size + 1) / u.size
        return cls(np.exp(1j * omega), omega, U, Y)

    @property
    def factors(self) -> list[Complex]:
        """What the fractions are multiplied by: for the response, and for the transient."""
        return [self.U, np.ones(self.U.size)]

    def fitted(self, poles: Complex, weight: Vector) -> Rational:
        """Return the rational function with these poles z that is nearest."""
        return _rational(poles, self.z, self.Y, self.factors, weight)


def fit_of_record(
    u: Vector, y: Vector, order: int, extra: int = 0, rounds: int = ROUNDS
) -> Rational:
    """Return a rational function of z of ``order`` from the spectra of a record, with transient.

    It is fitted with ``extra`` poles more, for what noise adds; those without which the error grows
    least are left out. The error is that of a line of the spectrum of y.
    """
    of = Spectra.of(u, y)
    weight = np.ones(of.U.size)
    poles = np.exp(_first(_SLOWEST * of.omega[0], _FASTEST, order + extra))
    for _ in range(rounds):
        poles = _better(poles, of.z, of.Y, of.factors, weight)
        with np.errstate(divide="ignore"):
            poles = _cleaned(np.where(np.abs(poles) > 1.0, 1.0 / poles.conjugate(), poles))
    while poles.size > order:
        fits = [of.fitted(rest, weight) for rest in _without_one(poles, order)]
        poles = min(fits, key=lambda one: one.error).poles
    return of.fitted(poles, weight)


def pair_beside(of: Spectra, poles: Complex) -> tuple[complex, Vector]:
    """Return the upper one z of the pair that explains most beside poles z, and a weight of lines.

    The weight (N,) is one over the deviation of what the poles leave, from the medians of bands.
    """
    left, Q = _left(of, poles, np.ones(of.U.size))
    half = of.U.size
    power = left[:half] ** 2 + left[half:] ** 2
    edges = [0]
    while edges[-1] < half:
        after = max(edges[-1] + _BAND, int(_WIDER * edges[-1]))
        edges.append(after if after + _BAND <= half else half)
    parts = [slice(*ends) for ends in pairwise(edges)]
    middle = [float(np.mean(np.log(of.omega[part]))) for part in parts]
    level = [math.log(max(float(np.median(power[part])), 1e-300)) for part in parts]
    weight = np.exp(-0.5 * np.interp(np.log(of.omega), middle, level))
    left, Q = _left(of, poles, weight)

    def explained(omega: float, damping: float) -> float:
        basis = _basis(of.z, _pair(omega, damping))
        columns = _real(np.hstack([basis * factor[:, None] for factor in of.factors]), weight)
        columns /= np.linalg.norm(columns, axis=0)
        known, right = Q.T @ columns, columns.T @ left
        # What they explain beside Q, from the normal equations of the rest.
        found = np.linalg.lstsq(columns.T @ columns - known.T @ known, right, rcond=_RANK)[0]
        return float(right @ found)

    grid = [
        (float(omega), damping)
        for damping in _DAMPING
        for omega in np.exp(
            np.arange(math.log(_SLOWEST * of.omega[0]), math.log(_FASTEST_PAIR), _STEP * damping)
        )
    ]
    omega, damping = max(grid, key=lambda one: explained(*one))
    return complex(_pair(omega, damping)[0]), weight


def _pair(omega: float, damping: float) -> Complex:
    """Return a pair of poles z."""
    upper = np.exp(omega * (-damping + 1j * math.sqrt(1.0 - damping**2)))
    return np.array([upper, upper.conjugate()])


def _left(of: Spectra, poles: Complex, weight: Vector) -> tuple[Vector, Matrix]:
    """Return what poles z leave of Y, weighted, and a basis of what they explain."""
    columns = np.column_stack(of.factors)
    if poles.size:
        columns = _columns(poles, of.z, of.factors)[1]
    known = _real(columns, weight)
    Q = np.linalg.qr(known / np.linalg.norm(known, axis=0))[0]
    y = _real(of.Y[:, None], weight)[:, 0]
    return y - Q @ (Q.T @ y), Q


def _real(columns: Complex, weight: Vector) -> Matrix:
    """Return real and imaginary part of weighted columns (2 N, k) below each other."""
    columns = columns * weight[:, None]
    return np.vstack([columns.real, columns.imag])


def _without_one(poles: Complex, order: int) -> Iterator[Complex]:
    """Yield the poles without each real one or pair; of a pair a real one stays for ``order``."""
    for pole in poles[poles.imag >= 0.0]:
        out = (poles == pole) | (poles == pole.conjugate())
        rest = poles[~out]
        yield rest if rest.size >= order else np.append(rest, abs(pole))


def _first(low: float, high: float, order: int) -> Complex:
    """Return poles to begin with, spread over a range of frequencies."""
    pairs = np.geomspace(low, high, order // 2 + 2)[1:-1] if order > 1 else np.zeros(0)
    poles = np.concatenate([pairs * (-0.02 + 1j), pairs * (-0.02 - 1j)])
    return np.append(poles, -math.sqrt(low * high)) if order % 2 else poles


def _columns(poles: Complex, s: Complex, factors: list[Complex]) -> tuple[Complex, Complex]:
    """Return the partial fractions, and the columns of the right side: fractions and one each."""
    basis = _basis(s, poles)
    both = np.hstack([basis, np.ones((s.size, 1))])
    return basis, np.hstack([both * each[:, None] for each in factors])


def _better(
    poles: Complex, s: Complex, H: Complex, factors: list[Complex], weight: Vector
) -> Complex:
    """Return the poles after one round."""
    basis, right = _columns(poles, s, factors)
    left = np.hstack([right, -basis * H[:, None]]) * weight[:, None]
    x = _solved(left, H * weight)
    A, b = _state(poles)
    return np.asarray(np.linalg.eigvals(A - np.outer(b, x[-poles.size :])))


def _rational(
    poles: Complex, s: Complex, H: Complex, factors: list[Complex], weight: Vector
) -> Rational:
    """Return the rational function with these poles that is nearest."""
    _, right = _columns(poles, s, factors)
    left = right * weight[:, None]
    x = _solved(left, H * weight)
    A, b = _state(poles)
    roots = np.linalg.eigvals(A - np.outer(b, x[: poles.size]) / (x[poles.size] or 1e-12))
    error = float(np.mean(np.abs(left @ x - H * weight) ** 2))
    return Rational(poles, _cleaned(roots), error)


def _cleaned(roots: Complex) -> Complex:
    """Return roots, the pairs next to each other and exact; no root is at zero."""
    roots = np.asarray(roots, dtype=np.complex128)
    upper = roots[roots.imag > 1e-9 * np.abs(roots)]
    real = roots[np.abs(roots.imag) <= 1e-9 * np.abs(roots)].real
    real = np.where(np.abs(real) < 1e-9, -1e-9, real)
    return np.concatenate([np.column_stack([upper, upper.conjugate()]).ravel(), real])


def _basis(s: Complex, poles: Complex) -> Complex:
    """Return the columns of the partial fractions with real coefficients."""
    columns, i = [], 0
    while i < poles.size:
        p = poles[i]
        if p.imag != 0.0:
            one, other = 1.0 / (s - p), 1.0 / (s - p.conjugate())
            columns += [one + other, 1j * (one - other)]
            i += 2
        else:
            columns.append(1.0 / (s - p))
            i += 1
    return np.column_stack(columns)


def _state(poles: Complex) -> tuple[Matrix, Vector]:
    """Return A and b of the real partial fractions."""
    n = poles.size
    A: Matrix = np.zeros((n, n))
    b: Vector = np.zeros(n)
    i = 0
    while i < n:
        p = poles[i]
        if p.imag != 0.0:
            A[i : i + 2, i : i + 2] = [[p.real, p.imag], [-p.imag, p.real]]
            b[i] = 2.0
            i += 2
        else:
            A[i, i], b[i] = p.real, 1.0
            i += 1
    return A, b


def _solved(left: Complex, right: Complex) -> Vector:
    """Return the real least-squares solution of a complex equation."""
    both = np.vstack([left.real, left.imag])
    size = np.linalg.norm(both, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    target = np.concatenate([right.real, right.imag])
    return np.asarray(np.linalg.lstsq(both / size, target, rcond=1e-13)[0] / size)
