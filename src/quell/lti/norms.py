"""Norms of sampled systems: the peak-to-peak gain, and the sum of the squared impulse response.

**Peak-to-peak gain**, the largest output for inputs of at most one. It is the ℓ1 norm of the
impulse response, ``Γ = |D| + Σ |h_k|`` with ``h_k = C A^k B`` (Dahleh & Pearson, *IEEE Trans.
Automatic Control* 32, 1987): the input ``sign(h_{K−k})`` attains it in the limit. The first m terms
are added. The others are bounded: with ``M = A^m`` and ``‖M‖ = μ < 1``, and m split into ``m = J
b``, h is made of the rows ``R_j = C A^(jb)`` and the columns ``X_i = A^i B``, so that

    Σ_{k ≥ m} |h_k| = Σ_{l ≥ 1} Σ_{j, i} |R_j M^l X_i| ≤ μ/(1 − μ) · Σ_j ‖R_j‖ · Σ_i ‖X_i‖

m is doubled until this is a small share of the sum. What is returned is the sum *and* this bound,
so it is never less than Γ, except for rounding errors.
"""

from __future__ import annotations

import numpy as np

from quell.lti.system import System
from quell.types import Matrix, Vector

# Share of the sum at which the bound on the rest is small enough; chosen by hand.
_SMALL = 1e-6
# Columns that are kept, and rows that are multiplied at a time: some MB. Chosen by hand.
_COLUMNS, _ROWS = 4096, 256
# A stable loop that needs more samples than 2 to this power is too slow for its sample time: with
# 1 kHz 4.7 h. Chosen by hand.
_MOST_DOUBLINGS = 24
# Growth that no stable system reaches in balanced coordinates. Chosen by hand.
_DIVERGED = 1e30


def peak_gain(system: System) -> float:
    """Return the peak-to-peak gain of a stable system, or a little more, by a share of 1e-6.

    Raises ``ValueError`` if the impulse response does not decay within 2²⁴ samples.
    """
    N, B, C, D = System.balanced(*system)  # N is A^m − I for the growing m
    columns, rows = B[:, None], C[None, :]
    identity = np.eye(N.shape[0])
    for _ in range(_MOST_DOUBLINGS + 1):
        contraction = float(np.max(np.sum(np.abs(N + identity), axis=1), initial=0.0))
        if contraction > _DIVERGED:
            break
        if contraction < 1.0:
            total = _sum_of_products(rows, columns)
            # The maximum norm of vectors X, the sum norm of rows R, and the norm of M they induce.
            sizes = float(np.sum(np.abs(rows)) * np.sum(np.max(np.abs(columns), axis=0)))
            rest = contraction / (1.0 - contraction) * sizes
            if rest <= _SMALL * total:
                return abs(D) + total + rest
        if columns.shape[1] < _COLUMNS:
            columns = np.hstack([columns, columns + N @ columns])
        else:
            rows = np.vstack([rows, rows + rows @ N])
        N = 2.0 * N + N @ N
    raise ValueError(
        f"the impulse response does not decay within {2**_MOST_DOUBLINGS} samples: the largest "
        f"pole is at |z| = {system.largest_pole:.9g}; take a longer sample time if it is below 1"
    )


def pulse_response(system: System, samples: int) -> Vector:
    """Return ``D, C B, C A B, …`` (samples,)."""
    N, B, C, D = System.balanced(*system)
    found, x = np.zeros(samples), B.copy()
    found[:1] = D
    for k in range(1, samples):
        found[k] = C @ x
        x = x + N @ x
    return found


def h2_squared(system: System) -> float:
    """Return the sum of the squared impulse response of a stable system.

    By doubling, ``X ← X + M X Mᵀ``, ``M ← M²`` (Smith 1968): only positive terms are added, so
    nothing cancels; after k rounds 2ᵏ samples are summed.
    """
    system = System.balanced(*system)
    M, X = system.N + np.eye(system.N.shape[0]), np.outer(system.B, system.B)
    for _ in range(64):  # 2⁶⁴ samples: no stable loop in double precision is slower
        more = M @ X @ M.T
        X = X + more
        if np.max(np.abs(more)) <= 1e-16 * np.max(np.abs(X)):  # below the unit roundoff
            break
        M = M @ M
    return float(system.C @ X @ system.C) + system.D**2


def _sum_of_products(rows: Matrix, columns: Matrix) -> float:
    """Return ``Σ |R_j X_i|`` over all rows and columns."""
    parts = range(0, rows.shape[0], _ROWS)
    return float(sum(np.sum(np.abs(rows[i : i + _ROWS] @ columns)) for i in parts))
