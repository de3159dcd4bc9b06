"""The feedback of many sampled ADRC designs at many frequencies, without building controllers.

With the observer in its current form, c = (1, 0, …) and the law ``u = −K ẑ`` (``observers/linear``,
``controllers/adrc/law``), z⁻ the prediction and d the samples by which u is delayed::

    ẑ = z⁻ + L (y − c z⁻),     z z⁻ = (Φ − z^(−d) Γ K) ẑ
    C_y = z K ( z I − (I − L c) (Φ − z^(−d) Γ K) )⁻¹ L

and with ``ζ = z − 1``, ``Δ = Φ − I`` nothing is a small difference of large numbers::

    z I − (I − L c) (Φ − z^(−d) Γ K) = ζ I + L c − (I − L c) (Δ − z^(−d) Γ K)

L follows from Ackermann's formula, ``L = π(−Δ) O⁻¹ e_N`` but for signs, with π the polynomial with
the roots ``1 − z_i`` and O the observability matrix: it is linear in the coefficients of π.

C_y has a pole at z = 1. With v and w the right and left null vectors of that matrix M at ζ = 0, its
residue is ``K v · w L / (w M'(0) v)``, from which the integral gain follows. All is in coordinates
``x_i/ω^(i−1)``, ``f^(j)/ω^(q+j)`` with ω the geometric mean of the observer's poles; then C_y is
``ω^r/b0`` times a function of the poles alone.

With e extended states the pole at z = 1 has the multiplicity e, the integral gain is infinite, and
at low frequencies M is singular to rounding. There C_y is found from the innovation, with
A = Δ − Γ K. The states x of it do not depend on f, because u cancels it where it enters, and f is a
chain of its own, so that its powers of 1/ζ are exact::

    (ζ I − A) W = (I + A) L,        C_y = K (W + L) / (1 + c W)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.analysis.frequency_response import Complex
from quell.lti.canonical import Canonical
from quell.lti.discretize import zero_order_hold
from quell.observers.design import with_motion_of_f, with_rates
from quell.types import Matrix, Vector

Stack = NDArray[np.float64]

# A pole of the controller beyond is unstable; the integrator, to rounding, is not.
_OUTSIDE = 1e-7


class SampledChain(NamedTuple):
    """The extended model of a plant, sampled in ``x_i dt^(i−1)``, ``f^(j) dt^(q+j)``."""

    difference: Matrix  # Φ − I (N, N)
    input: Vector  # Γ for b0 = 1 and u in units of dt^−r (N,)
    placing: Matrix  # Δ^j O⁻¹ e_N in row N − j (N + 1, N)
    power: Vector  # 0 … n − 1, q, q + 1, …
    cancel: Vector  # (n,)
    cancel_f: float
    degree: int
    dt: float


def sampled_chain(plant: Canonical, dt: float, extended: int = 1) -> SampledChain:
    """Sample the model of ``plant`` with extended states as ``observers/design`` does."""
    n, q = plant.a.size, plant.f_degree
    A = np.diag(np.ones(n), 1)
    A[-2, :-1] -= plant.a * dt ** (n - np.arange(n))
    A[:-1, -1] = plant.E * dt ** (np.arange(n) + 1.0 - q)
    column = np.zeros((n + 1, 1))
    column[:-1, 0] = plant.B / plant.b * dt ** (np.arange(n) + 1.0 - plant.degree)
    _, (difference, gamma) = zero_order_hold(A, [A, column], 1.0)
    difference, gamma = with_motion_of_f(difference, extended), with_rates(gamma, extended)
    cancel = plant.a if plant.degree == n else -np.eye(n)[plant.degree]
    power = np.append(np.arange(float(n)), q + np.arange(float(extended)))
    matched = 1.0 if plant.matched else 0.0
    return SampledChain(
        difference, gamma[:, 0], _placing(difference), power, cancel, matched, plant.degree, dt
    )


def _placing(difference: Matrix) -> Matrix:
    """Return what places poles: L is a combination of its rows (Ackermann's formula)."""
    size = difference.shape[0]
    rows = [difference[0] + np.eye(size)[0]]
    for _ in range(size - 1):
        rows.append(rows[-1] @ difference)
    found = [np.linalg.solve(np.array(rows), np.eye(size)[-1])]
    for _ in range(size):
        found.append(difference @ found[-1])
    return np.array(found[::-1])


@dataclass(frozen=True, eq=False)
class Designs:
    """m designs in coordinates of similar size."""

    gain: Matrix  # L (m, N)
    law: Matrix  # K (m, N)
    factor: Vector  # ω^r (m,); C_y = factor / b0 times the response of these
    base: Stack  # L c − (I − L c) Δ (m, N, N)
    closing: Stack  # (I − L c) Γ K (m, N, N)
    inner: Stack  # A = Δ − Γ K (m, N, N)
    delay: int
    dt: float
    extended: int  # e, number of extended states

    @cached_property
    def integral_gain(self) -> Vector:
        """``k_i b0 / ω^r`` (m,)."""
        if self.extended > 1:
            return np.full(self.gain.shape[0], np.inf)
        left, _, right = np.linalg.svd(self.base + self.closing)
        v, w = right[:, -1, :], left[:, :, -1]
        slope = np.eye(v.shape[1]) - self.delay * self.closing
        inner = np.einsum("mi,mij,mj->m", w, slope, v)
        through = np.sum(self.law * v, axis=1) * np.sum(w * self.gain, axis=1)
        gain: Vector = through / inner / self.dt
        return gain


def designs(
    chain: SampledChain,
    law: Matrix,
    poles: NDArray[np.complex128],
    kept: NDArray[np.intp],
    *,
    reduced: bool = False,
    half_gain: bool = False,
    delay: int = 0,
) -> Designs:
    """Return designs with law gains k (m, r) and observer poles (m, N), or (m, N − 1) if reduced.

    With more than one extended state there must be no delay.

    ``kept`` are the numbers of those to return: not by itself, because in a product of matrices a
    single row has other rounding. ``delay`` is the known delay of u [samples].
    """
    count, size = law.shape[0], chain.power.size
    omega = np.exp(np.sum(np.log(np.abs(poles)), axis=1) / poles.shape[1])
    step = omega * chain.dt
    power = chain.power
    offsets = -np.expm1(poles * chain.dt)
    if reduced:
        offsets = np.hstack([offsets, np.ones((count, 1))])
    gain = monic(-offsets) @ chain.placing
    gain, law, omega, step = gain[kept], law[kept], omega[kept], step[kept]
    gain *= step[:, None] ** -power
    if reduced:
        gain[:, 0] = 1.0
    if half_gain:
        gain *= 0.5
    K = np.zeros((kept.size, size))
    K[:, : law.shape[1]] = law
    n = chain.cancel.size
    K[:, :n] -= chain.cancel
    K[:, n] = chain.cancel_f
    K *= omega[:, None] ** (power - chain.degree)
    correct = np.empty((kept.size, size, size))  # I − L c
    correct[:] = np.eye(size)
    correct[:, :, 0] -= gain
    column = chain.input * step[:, None] ** (chain.degree - power)
    closing = (correct @ column[:, :, None]) * K[:, None, :]
    difference = chain.difference * step[:, None, None] ** (power - power[:, None])
    base = -(correct @ difference)
    base[:, :, 0] += gain
    inner = difference - column[:, :, None] * K[:, None, :]
    factor = omega**chain.degree
    return Designs(gain, K, factor, base, closing, inner, delay, chain.dt, size - n)


def coefficients(roots: NDArray[np.complex128]) -> Matrix:
    """Return ``c_0 … c_(n−1)`` (m, n) of the polynomials ``s^n + … + c_1 s + c_0`` with roots."""
    return np.ascontiguousarray(monic(roots)[:, :0:-1])


def monic(roots: NDArray[np.complex128]) -> Matrix:
    """Return the coefficients (m, n + 1), highest power first, of the polynomials with roots."""
    count, size = roots.shape
    found = np.zeros((count, size + 1), dtype=complex)
    found[:, 0] = 1.0
    for i in range(size):
        found[:, 1 : i + 2] -= roots[:, i : i + 1] * found[:, : i + 1]
    return np.ascontiguousarray(found.real)


def feedback(found: Designs, omega: Vector) -> Complex:
    """Return ``C_y b0 / ω^r`` (m, k) at frequencies (k,) [rad/s]."""
    if found.extended > 1:
        return _feedback_by_innovation(found, omega)
    matrix, z = _matrices(found, omega)
    solved = np.linalg.solve(matrix, found.gain[:, None, :, None])[..., 0]
    product: Complex = np.einsum("mkn,mn->mk", solved, found.law) * z
    return product


def _feedback_by_innovation(found: Designs, omega: Vector) -> Complex:
    zeta, A = np.expm1(1j * omega * found.dt), found.inner
    count, size = found.gain.shape
    n = size - found.extended
    given = found.gain + np.einsum("mij,mj->mi", A, found.gain)  # (I + A) L
    given[:, :n] = found.gain[:, :n] + np.einsum("mij,mj->mi", A[:, :n, :n], found.gain[:, :n])
    W = np.empty((count, omega.size, size), dtype=complex)
    for i in range(size - 1, n - 1, -1):
        later = np.einsum("mj,mkj->mk", A[:, i, i + 1 :], W[:, :, i + 1 :])
        W[:, :, i] = (given[:, i, None] + later) / zeta
    matrix = zeta[:, None, None] * np.eye(n) - A[:, None, :n, :n]
    given_x = np.broadcast_to(given[:, None, :n, None], (count, omega.size, n, 1))
    W[:, :, :n] = np.linalg.solve(matrix, given_x)[..., 0]
    corrected = np.einsum("mki,mi->mk", W + found.gain[:, None, :], found.law)
    response: Complex = corrected / (1.0 + W[:, :, 0])
    return response


def _matrices(found: Designs, omega: Vector) -> tuple[Complex, Complex]:
    """Return M (m, k, N, N) and z (k,)."""
    base, closing = found.base[:, None], found.closing[:, None]
    zeta = np.expm1(1j * omega * found.dt)
    z = 1.0 + zeta
    if found.delay:
        closing = z[:, None, None] ** -float(found.delay) * closing
    count, _, size, _ = base.shape
    matrix = np.empty((count, omega.size, size, size), dtype=complex)
    matrix[...] = base + closing
    _diagonals(matrix)[...] = zeta[:, None] + _diagonals(base) + _diagonals(closing)
    return matrix, z


def _diagonals(matrix: NDArray[Any]) -> NDArray[Any]:
    """Return the diagonals (m, k, N) of matrices (m, k, N, N), to read or to write."""
    found: NDArray[Any] = np.einsum("mkii->mki", matrix)
    return found


def unstable_poles(found: Designs) -> Vector:
    """Return the number (m,) of poles of C_y outside of the unit circle.

    With a delay the poles are counted by the argument of det M(z) over the upper half circle, which
    is ``π (N − unstable − 1/2)`` with the integrator's pole at z = 1.
    """
    base, closing = found.base, found.closing
    if found.delay == 0:
        shifted: Any = np.linalg.eigvals(-(base + closing))
        if found.extended > 1:
            # Rounding moves an e-fold pole by its e-th root: the integrators are those next to 1.
            near = np.argsort(np.abs(shifted), axis=1)
            shifted = np.take_along_axis(shifted, near[:, found.extended :], axis=1)
        outside = np.abs(1.0 + shifted) > 1.0 + _OUTSIDE
        return np.sum(outside, axis=1).astype(np.float64)
    top, size = np.pi / found.dt, base.shape[1]
    even = np.linspace(0.0, top, 24 * (found.delay + size) + 2)[1:]
    omega = np.unique(np.concatenate([np.geomspace(1e-5 * top, top, 200), even]))
    angle = np.angle(np.linalg.det(_matrices(found, omega)[0]))
    steps = np.remainder(np.diff(angle, axis=1) + np.pi, 2.0 * np.pi) - np.pi
    count: Vector = np.maximum(np.round(size - 0.5 - np.sum(steps, axis=1) / np.pi), 0.0)
    return count
