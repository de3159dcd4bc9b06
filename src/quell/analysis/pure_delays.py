"""Sampled systems whose pure delays are powers of z⁻¹ instead of states.

A dead time of d samples is a chain of d states, each of which takes the value of the one before.
Such a state, whose next value is ``g`` times one other state and nothing else, is ``X_i = g z⁻¹
X_j``. Substituting this along the chains leaves r states (of both plant and controller few)::

    (z I − A − Σ_k z^(−k) M_k) X = B U,        Y = (C + Σ_k z^(−k) C_k) X + D U

which is exact. A frequency then costs r³ instead of (r + d)³ operations, and its memory r².
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.types import Matrix, Vector

# With fewer states to remove, the matrices of the whole system are as quick. Chosen by hand.
_WORTH = 4


class Delays(NamedTuple):
    """A matrix ``A − I`` without its chains of delays."""

    kept: NDArray[np.intp]  # indices of the r states that are left
    N: Matrix  # A − I of these (r, r)
    source: NDArray[np.intp]  # for each state of the whole: the state, of the r, that it delays
    steps: NDArray[np.intp]  # by so many samples; 0 for a state that is left
    factor: Vector  # and multiplies by this


def without_delays(N: Matrix, *inputs: Vector) -> Delays | None:
    """Return ``A − I`` (n, n) without the states that only delay another; None if there are few.

    States that one of the ``inputs`` (n,) reaches at once are kept.
    """
    size = N.shape[0]
    A_nonzero = N != 0.0
    np.fill_diagonal(A_nonzero, np.diag(N) != -1.0)
    candidates = (np.count_nonzero(A_nonzero, axis=1) == 1) & (np.diag(N) == -1.0)
    for column in inputs:
        candidates &= column == 0.0
    if np.count_nonzero(candidates) < _WORTH:
        return None
    before = np.argmax(A_nonzero, axis=1)
    source, steps = np.arange(size), np.zeros(size, dtype=np.intp)
    factor, is_kept = np.ones(size), ~candidates
    for start in np.flatnonzero(candidates):
        chain, at = [], int(start)
        while not is_kept[at] and steps[at] == 0 and at not in chain:
            chain.append(at)
            at = int(before[at])
        if at in chain:  # a cycle of delays: one of them stays a state
            is_kept[at] = True
            chain = chain[: chain.index(at)]
        for state in reversed(chain):
            j = before[state]
            source[state], steps[state] = source[j], steps[j] + 1
            factor[state] = factor[j] * N[state, j]
    kept = np.flatnonzero(is_kept)
    position = np.zeros(size, dtype=np.intp)
    position[kept] = np.arange(kept.size)
    return Delays(kept, N[np.ix_(kept, kept)], position[source], steps, factor)


def delayed_parts(delays: Delays, rows: Matrix) -> tuple[Vector, NDArray[np.float64]]:
    """Return the numbers of samples k (K,) and the parts (K, m, r) of ``rows`` (m, n) at z⁻ᵏ."""
    used = np.flatnonzero((delays.steps > 0) & np.any(rows != 0.0, axis=0))
    steps = np.unique(delays.steps[used])
    parts = np.zeros((steps.size, rows.shape[0], delays.kept.size))
    for i in used:
        k = np.searchsorted(steps, delays.steps[i])
        parts[k, :, delays.source[i]] += rows[:, i] * delays.factor[i]
    return steps.astype(np.float64), parts


def eigenvalues(N: Matrix) -> NDArray[np.complex128]:
    """Return the eigenvalues less one (n,) of A, given ``N = A − I`` (n, n).

    Chains of delays that feed nothing back, or that repeat another one, have all their eigenvalues
    at z = 0, where rounding errors would spread them: of a nilpotent block of 200 states over a
    circle of the radius 0.83. They are found from the structure instead.
    """
    delays = without_delays(N)
    if delays is None:
        return np.linalg.eigvals(N).astype(np.complex128)
    steps, M = delayed_parts(delays, N[delays.kept])
    rest, M = _merge_equal(delays.N.copy(), M)
    last = np.zeros(rest.shape[0], dtype=np.intp)  # longest delay of each state
    for k, part in zip(steps.astype(np.intp), M, strict=True):
        last[np.any(part != 0.0, axis=0)] = k
    first = rest.shape[0] + np.cumsum(last) - last  # place of the first state of each chain
    size = rest.shape[0] + int(np.sum(last))
    whole = np.zeros((size, size))
    whole[: rest.shape[0], : rest.shape[0]] = rest
    for j in np.flatnonzero(last):
        for k in range(last[j]):
            at = first[j] + k
            whole[at, at] = -1.0
            whole[at, at - 1 if k else j] = 1.0
    for k, part in zip(steps.astype(np.intp), M, strict=True):
        for j in np.flatnonzero(np.any(part != 0.0, axis=0)):
            whole[: rest.shape[0], first[j] + k - 1] += part[:, j]
    found = np.linalg.eigvals(whole).astype(np.complex128)
    return np.append(found, np.full(N.shape[0] - size, -1.0 + 0.0j))


def _merge_equal(N: Matrix, M: NDArray[np.float64]) -> tuple[Matrix, NDArray[np.float64]]:
    """Return the matrices without states that always equal another one after a sample."""
    while True:
        size = N.shape[0]
        rows = np.hstack([N + np.eye(size), *M])
        _, first, to = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        if first.size == size:
            return N, M
        twin = first[to.ravel()]  # each state's first equal
        kept = np.flatnonzero(twin == np.arange(size))
        for i in np.flatnonzero(twin != np.arange(size)):
            N[:, twin[i]] += N[:, i]
            M[:, :, twin[i]] += M[:, :, i]
        N, M = N[np.ix_(kept, kept)], M[:, kept][:, :, kept]
