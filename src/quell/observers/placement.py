"""Where the poles of an observer go, and the gain that puts them there."""

from __future__ import annotations

import numpy as np

from quell.types import Matrix, Vector


def place_poles(difference: Matrix, rises: Vector) -> Vector:
    """Return L that puts the eigenvalues of ``(I − L C) Φ``, with C = (1, 0, …), at ``1 − rises`` (Ackermann's formula).

    ``L = Π (Φ − β_i I) O⁻¹ e_N`` with the rows ``C Φ (Φ − I)^i`` for O: differences instead of powers leave ``O⁻¹ e_N`` as it is
    and make O triangular for a chain of integrators, where powers would be nearly parallel. They are taken over the largest rise, which
    makes them O(1) too.

    Parameters
    ----------
    difference
        ``Φ − I`` (N, N), in coordinates of the observer's own time, so that divided by the largest rise it is O(1).
    rises
        ``1 − β_i`` (N,), complex ones in conjugate pairs.

    Returns
    -------
    array
        L (N,); NaN where Φ can't be observed through C.
    """
    size = difference.shape[0]
    unit = np.max(np.abs(rises))
    rate = difference / unit
    rows = np.empty((size, size))
    rows[0] = difference[0]
    rows[0, 0] += 1.0
    for i in range(1, size):
        rows[i] = rows[i - 1] @ rate
    try:
        vector = np.linalg.solve(rows, np.eye(size)[-1])
    except np.linalg.LinAlgError:
        return np.full(size, np.nan)
    for rise in rises / unit:
        vector = rate @ vector + rise * vector
    gain: Vector = unit * np.real(vector)
    return gain


def sampled_zeros(difference: Matrix, zeros: Vector, dt: float) -> Vector:
    """Return ``1 − ζ`` for the zeros ζ, in the z-plane, that f has to y because the plant has ``zeros`` [rad/s] from f.

    They are near ``exp(zeros dt)``, among the finite eigenvalues of the pencil ``[[Φ − I − λ I, Γ], [C, 0]]`` with ``λ = ζ − 1``; its
    others come with the sampling. Γ is the last column of Φ, which is what a held f does.

    Parameters
    ----------
    difference
        ``Φ − I`` of the extended model (N, N), as for ``place_poles``; its last state is f.
    zeros
        some of the plant's zeros from f, complex ones in conjugate pairs.
    dt
        sample time [s].

    Returns
    -------
    array
        as many, to be used as ``rises``.
    """
    from scipy.linalg import eigvals

    size = difference.shape[0]
    pencil = difference.copy()
    pencil[-1] = np.eye(size)[0]
    found = eigvals(pencil, np.diag(np.append(np.ones(size - 1), 0.0)))
    found = found[np.isfinite(found)]
    rises = np.empty(zeros.size, dtype=complex)
    for i, zero in enumerate(zeros):
        nearest = int(np.argmin(np.abs(found - np.expm1(zero * dt))))
        rises[i] = -found[nearest]
        found = np.delete(found, nearest)
    return rises
