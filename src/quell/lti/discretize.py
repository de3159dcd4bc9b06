"""Exact sampling of linear models: held inputs, and integrals of quadratic forms."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from quell.parallel import one_blas_thread
from quell.types import Matrix

Stack = NDArray[np.float64]  # matrices (models, …, …)


def zero_order_hold(A: Matrix, inputs: Sequence[Matrix], dt: float) -> tuple[Matrix, list[Matrix]]:
    """Sample ``x' = A x + Σ B_i u_i`` exactly, with every ``u_i`` held over a sample of ``dt`` [s].

    Return Φ (n, n) and the list of Γ_i (n, m_i). One matrix exponential gives all (Van Loan, *IEEE
    Trans. Automatic Control* 23, 1978)::

        exp([[A, B], [0, 0]] dt) = [[Φ, Γ], [0, I]]
    """
    n = A.shape[0]
    edges = list(accumulate((B.shape[1] for B in inputs), initial=n))
    parts = [slice(*edge) for edge in pairwise(edges)]
    block = np.zeros((edges[-1], edges[-1]))
    block[:n, :n] = A
    for part, B in zip(parts, inputs, strict=True):
        block[:n, part] = B
    sampled = _exponential(edges[-1], (block * dt).tobytes())
    return sampled[:n, :n].copy(), [sampled[:n, part].copy() for part in parts]


def zero_order_holds(A: Stack, B: Stack, dt: float) -> tuple[Stack, Stack]:
    """Return Φ and Γ of many models with the same sizes, by the same method."""
    from scipy.linalg import expm

    models, n, _ = A.shape
    size = n + B.shape[2]
    block = np.zeros((models, size, size))
    block[:, :n, :n], block[:, :n, n:] = A, B
    with one_blas_thread():
        sampled = np.asarray(expm(block * dt))
    return sampled[:, :n, :n], sampled[:, :n, n:]


@lru_cache(maxsize=64)
def _exponential(size: int, block: bytes) -> Matrix:
    """Return exp of a matrix; kept, because a plant is sampled again for each of its runs."""
    from scipy.linalg import expm

    with one_blas_thread():
        found: Matrix = expm(np.frombuffer(block).reshape(size, size))
    found.flags.writeable = False
    return found


def gramian(A: Matrix, Q: Matrix, dt: float) -> Matrix:
    """Return ``∫ exp(A s) Q exp(Aᵀ s) ds`` over a sample, in the unit of Q times s (Van Loan 1978).

    ::

        exp([[−A, Q], [0, Aᵀ]] dt) = [[·, G], [0, Φᵀ]],      ∫ = Φ G

    Q (n, n) is symmetric. For white noise of density Q on x' the result is the covariance added in
    a sample. With Aᵀ for A it is the weight of x(0) in the cost ``∫ xᵀ Q x dt`` of a sample.
    """
    n = A.shape[0]
    block = np.block([[-A, Q], [np.zeros((n, n)), A.T]]) * dt
    sampled = _exponential(2 * n, block.tobytes())
    found: Matrix = sampled[n:, n:].T @ sampled[:n, n:]
    return 0.5 * (found + found.T)
