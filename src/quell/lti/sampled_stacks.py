"""Exact sampling of many linear models at once."""

from __future__ import annotations

from math import factorial

import numpy as np
from numpy.typing import NDArray

Stack = NDArray[np.float64]  # matrices (models, …, …)

# Coefficients of the Padé approximant of degree 13, from the lowest power, and the largest 1-norm
# for which its error is below rounding (Higham 2005, table 2.3).
_PADE = [float(factorial(26 - j) // (factorial(13 - j) * factorial(j))) for j in range(14)]
_LARGEST_NORM = 5.371920351148152


def zero_order_holds(A: Stack, B: Stack, dt: float) -> tuple[Stack, Stack]:
    """Return the Φ and Γ of ``lti.discretize.zero_order_hold`` for stacks of A and B."""
    models, n, _ = A.shape
    size = n + B.shape[2]
    block = np.zeros((models, size, size))
    block[:, :n, :n], block[:, :n, n:] = A, B
    sampled = exponentials(block * dt)
    return sampled[:, :n, :n], sampled[:, :n, n:]


def exponentials(M: Stack) -> Stack:
    """Return ``exp(M)`` of each matrix (models, n, n).

    SciPy takes them one by one. Those of a small norm, as a sample time usually makes them, need no
    scaling, and their Padé approximants are computed together in a third of the time (Higham,
    *SIAM J. Matrix Analysis and Applications* 26, 2005, algorithm 2.3). What a matrix gives does
    not depend on the others.
    """
    from scipy.linalg import expm

    small = np.max(np.sum(np.abs(M), axis=1), axis=1) <= _LARGEST_NORM
    found = np.empty_like(M)
    found[small], found[~small] = _pade(M[small]), expm(M[~small])
    return found


def _pade(M: Stack) -> Stack:
    """Return the approximants of degree 13 of matrices of small norm."""
    b, unit = _PADE, np.eye(M.shape[2])
    M2 = M @ M
    M4 = M2 @ M2
    M6 = M4 @ M2
    high_odd, low_odd = b[13] * M6 + b[11] * M4 + b[9] * M2, b[7] * M6 + b[5] * M4 + b[3] * M2
    high_even, low_even = b[12] * M6 + b[10] * M4 + b[8] * M2, b[6] * M6 + b[4] * M4 + b[2] * M2
    odd = M @ (M6 @ high_odd + low_odd + b[1] * unit)
    even = M6 @ high_even + low_even + b[0] * unit
    return np.asarray(np.linalg.solve(even - odd, even + odd), dtype=np.float64)
