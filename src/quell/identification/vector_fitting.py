"""Vector fitting: poles and zeros of a rational function from its values at frequencies.

With known poles p_i the equation ``(1 + Σ c_i/(s − p_i)) G = Σ r_i/(s − p_i) + d`` is linear, and
the zeros of its first factor are better poles (Gustavsen & Semlyen, *IEEE Trans. Power Delivery*
14, 1999). After some rounds the poles no longer change; the zeros are those of the right side.

The spectra U and Y of a record of N samples have such an equation, too, and no window is needed:
what the record begins and ends with adds ``Σ t_i/(z − p_i) + e`` to Y, as a transient has the poles
of the plant (Pintelon & Schoukens, *System Identification*, 2nd ed. 2012, sec. 6.3.2)::

    (1 + Σ c_i/(z − p_i)) Y = (Σ r_i/(z − p_i) + d) U + Σ t_i/(z − p_i) + e,     z = exp(jω_k)
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.types import Matrix, Vector

Complex = NDArray[Any]

ROUNDS = 12
"""Rounds after which poles hardly change: chosen by hand."""

# Range of the first poles: from so many lines of a spectrum on, to so many rad per sample. By hand.
_SLOWEST, _FASTEST = 3.0, 1.5


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


def fit_of_record(
    u: Vector, y: Vector, order: int, extra: int = 0, rounds: int = ROUNDS
) -> Rational:
    """Return a rational function of z of ``order`` from the spectra of a record, with transient.

    It is fitted with ``extra`` poles more, for what noise adds; those without which the error grows
    least are left out. The error is that of a line of the spectrum of y.
    """
    U, Y = (np.fft.rfft(x - np.mean(x))[1 : (x.size + 1) // 2] for x in (u, y))
    omega = 2.0 * np.pi * np.arange(1, U.size + 1) / u.size
    z, weight = np.exp(1j * omega), np.ones(U.size)
    poles = np.exp(_first(_SLOWEST * omega[0], _FASTEST, order + extra))
    factors = [U, np.ones(U.size)]
    for _ in range(rounds):
        poles = _better(poles, z, Y, factors, weight)
        with np.errstate(divide="ignore"):
            poles = _cleaned(np.where(np.abs(poles) > 1.0, 1.0 / poles.conjugate(), poles))
    while poles.size > order:
        fits = [_rational(rest, z, Y, factors, weight) for rest in _without_one(poles, order)]
        poles = min(fits, key=lambda one: one.error).poles
    return _rational(poles, z, Y, factors, weight)


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
