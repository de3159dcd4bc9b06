"""Frequency responses of sampled systems, and the frequencies at which to evaluate them.

No polynomial is formed: poles of an observer coincide close to z = 1, where the roots of a
polynomial of degree 5 move by the fifth root of its rounding errors. A response is a linear solve,
``C (ζI − N)⁻¹ B + D`` with ``ζ = e^(jω dt) − 1`` and ``N = A − I``, so that slow dynamics are not
the difference of two numbers near one. A dead time is a power of z (``pure_delays``).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.analysis.pure_delays import delayed_parts, without_delays
from quell.lti.system import System
from quell.types import Matrix, Vector

Complex = NDArray[np.complex128]

# The grid only brackets extrema and sign changes, which ``margins`` refines. With 10 to 240 points
# per decade, and without the points beside resonances, the margins of 63 loops (chains, two masses,
# weak resonances; ADRC, LQG, PID) agree to 1e-11; the points beside resonances are for plots.
_POINTS_PER_DECADE = 60
# Points beside a resonance, in units of its damping; without damping, as shares of its frequency.
_BESIDE_DAMPED = np.array([0.0, 0.1, 0.3, 1.0, 3.0])
_BESIDE_UNDAMPED = np.logspace(-6.0, -1.0, 11)
# Numbers in the matrices of the frequencies that are solved together: 16 MB. Chosen by hand; larger
# blocks are not quicker.
_BLOCK = 1_000_000


class Response:
    """The frequency response of a system, prepared for many frequencies."""

    def __init__(self, system: System) -> None:
        delays = without_delays(system.N, system.B)
        if delays is None:
            self._prepare(System.balanced(*system), np.zeros(0))
            return
        kept = delays.kept
        steps, parts = delayed_parts(delays, np.vstack([system.N[kept], system.C]))
        N, C = delays.N, system.C[kept]
        scale = _scales(N, parts[:, :-1])
        self._M = parts[:, :-1] * scale[None, None, :] / scale[None, :, None]
        self._M = self._M.reshape(steps.size, -1)
        self._C_k = parts[:, -1] * scale
        N = N * scale[None, :] / scale[:, None]
        self._prepare(System(N, system.B[kept] / scale, C * scale, system.D), steps)

    def _prepare(self, system: System, steps: Vector) -> None:
        """Keep the system without delays, the delays in samples, and what each call needs."""
        self._system, self._steps = system, steps
        self._identity, self._input = np.eye(system.N.shape[0]), system.B[:, None].astype(complex)

    def __call__(self, omega: Any, dt: float) -> Complex:
        """Return the response (k,) at the frequencies ``omega`` (k,) [rad/s].

        A complex frequency −j s gives the transfer function at s. Raises ``ValueError`` at the
        frequency of a pole.
        """
        omega = np.atleast_1d(np.asarray(omega))
        if omega.dtype != np.complex128:
            omega = omega.astype(np.float64)
        count = math.ceil(omega.size * (self._system.N.size + self._steps.size) / _BLOCK)
        if count < 2:
            return self._block(omega, dt)
        return np.concatenate([self._block(part, dt) for part in np.array_split(omega, count)])

    def _block(self, omega: Vector, dt: float) -> Complex:
        N, _, C, D = self._system
        zeta = np.expm1(1j * omega * dt)
        if N.shape[0] == 0:
            return np.full(zeta.shape, complex(D))
        resolvent = zeta[:, None, None] * self._identity - N
        output: Any = C
        if self._steps.size:
            late = np.exp(-1j * dt * omega[:, None] * self._steps)
            resolvent -= (late @ self._M).reshape(resolvent.shape)
            output = C + late @ self._C_k
        try:
            solved = np.linalg.solve(resolvent, self._input)[:, :, 0]
        except np.linalg.LinAlgError:
            raise ValueError(
                f"omega = {omega.tolist()!r} rad/s: the response is infinite at one of "
                "them, a pole; leave it out"
            ) from None
        product = np.sum(solved * output, axis=1) if self._steps.size else solved @ C
        return np.asarray(product + D, dtype=np.complex128)


def _scales(N: Matrix, M: NDArray[np.float64]) -> Vector:
    """Return factors that balance a matrix with the sizes of its delayed parts."""
    from scipy.linalg import matrix_balance

    size = np.abs(N) + np.sum(np.abs(M), axis=0)
    _, (scale, _) = matrix_balance(size, permute=False, separate=True)
    balance: Vector = scale
    return balance


def in_s_plane(shifted: Complex, dt: float) -> Complex:
    """Return ``log(z)/dt`` for poles given as z − 1; a pole at z = 0 becomes −inf."""
    with np.errstate(divide="ignore"):
        size = np.where(
            np.abs(1.0 + shifted) < 1e-7,  # z = 0, found as an eigenvalue of a defective matrix
            -np.inf,
            0.5 * np.log1p(2.0 * shifted.real + np.abs(shifted) ** 2),
        )
    angle = np.where(np.isinf(size), 0.0, np.angle(1.0 + shifted))
    s: Complex = size / dt + 1j * (angle / dt)
    return s


def frequencies(poles: Complex, dt: float) -> Vector:
    """Return frequencies [rad/s] up to half the sampling rate, dense near the s-plane poles."""
    top = math.pi / dt
    size = np.abs(poles)
    finite = size[(size > 1e-9 * top) & (size < top)]  # smaller ones are integrators, to rounding
    bottom = 1e-2 * float(np.min(finite, initial=0.1 * top))
    grid = [np.geomspace(bottom, top, math.ceil(_POINTS_PER_DECADE * math.log10(top / bottom)) + 1)]
    for pole in poles[np.isfinite(poles) & (poles.imag > 0.0)]:
        center, damping = pole.imag, abs(pole.real)
        away = damping * _BESIDE_DAMPED if damping > 1e-6 * center else center * _BESIDE_UNDAMPED
        grid += [center - away, center + away]
    omega = np.unique(np.concatenate(grid))
    kept: Vector = omega[(omega >= bottom) & (omega <= top)]
    return kept
