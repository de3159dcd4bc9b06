"""Pole placement for observers, in terms of ``1 − pole`` to keep full precision near z = 1."""

from __future__ import annotations

import numpy as np

from quell.types import Matrix, Vector


def place_poles(difference: Matrix, offsets: Vector) -> Vector:
    """Return L that puts the eigenvalues of ``(I − L C) Φ``, C = (1, 0, …), at ``1 − offsets``.

    ``difference`` is ``Φ − I`` (N, N), in coordinates in which it is O(1) after division by the
    largest offset; complex offsets (N,) come in conjugate pairs. L (N,) is NaN if Φ can't be
    observed through C.

    Ackermann's formula: ``L = Π (Φ − β_i I) O⁻¹ e_N`` with the rows ``C Φ (Φ − I)^i`` for O.
    Differences instead of powers do not change ``O⁻¹ e_N`` and make O triangular for a chain of
    integrators, where powers would be nearly parallel. Dividing by the largest offset makes them
    O(1).
    """
    size = difference.shape[0]
    unit = np.max(np.abs(offsets))
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
    for offset in offsets / unit:
        vector = rate @ vector + offset * vector
    gain: Vector = unit * np.real(vector)
    return gain


def sampled_zeros(difference: Matrix, zeros: Vector, dt: float) -> Vector:
    """Return ``1 − ζ`` for the z-plane zeros ζ from f to y that belong to the plant's ``zeros``.

    The plant's zeros [rad/s] come in conjugate pairs. ζ are close to ``exp(zeros dt)`` among the
    finite eigenvalues of the pencil ``[[Φ − I − λ I, Γ], [C, 0]]`` with ``λ = ζ − 1``; the others
    are due to sampling. Γ, the response to a held f, is the last column of Φ.
    """
    from scipy.linalg import eigvals

    size = difference.shape[0]
    pencil = difference.copy()
    pencil[-1] = np.eye(size)[0]
    found = eigvals(pencil, np.diag(np.append(np.ones(size - 1), 0.0)))
    found = found[np.isfinite(found)]
    offsets = np.empty(zeros.size, dtype=complex)
    for i, zero in enumerate(zeros):
        nearest = int(np.argmin(np.abs(found - np.expm1(zero * dt))))
        offsets[i] = -found[nearest]
        found = np.delete(found, nearest)
    return offsets
