"""Starts from models of high order in discrete time, reduced to the order that is wanted.

An ARX model ``y[k] = −Σ α_i y[k−i] + Σ β_i u[k−i] + ε[k]`` with many terms is linear in its
parameters and describes plant and noise of any kind (Wahlberg, *IEEE Trans. Automatic Control* 34,
1989). Its impulse response g from u has little noise left, and the first singular vectors of the
Hankel matrices ``H₀ = [g_{i+j+1}]`` and ``H₁ = [g_{i+j+2}]`` give the n poles that matter (Juang &
Pappa, *J. Guidance, Control, and Dynamics* 8, 1985)::

    H₀ ≈ U S Vᵀ,      z = eig(S^{−1/2} Uᵀ H₁ V S^{−1/2}),      p = ln z

No start in continuous time is needed, and no pole has to be near another one. A slow plant is
sampled too fast for this, so the samples are also averaged over 4, 16, … of them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from quell.identification.model.structure import Structure, nonzero_lengths
from quell.types import Matrix, Vector

# Lags of the ARX model: at least, for each pole, and as a share of the samples at most. Chosen by
# hand: enough for a model of the noise, few enough that the coefficients are certain.
_LAGS, _LAGS_PER_POLE, _SHARE = 20, 4, 0.05
# Averages over 1, 4, 16, … samples, as long as this many averages for each pole remain (by hand).
_FACTOR, _AVERAGES = 4, 50
# Rows of the Hankel matrices for each lag: the impulse response lasts longer than the lags.
_LONGER = 3
# Poles that are taken besides those of the model, for what noise adds; the slow ones are kept.
_EXTRA = 2
# Relative singular value of the equations that counts as zero.
_RANK = 1e-10
# Slowest and fastest pole that is passed on [1/sample]: beyond any that samples show.
_SLOWEST, _FASTEST = 1e-6, 10.0


def reduced_models(structure: Structure, v: Matrix, y: Vector) -> Iterator[Vector]:
    """Yield θ with the poles of reduced models; its linear parameters are zero."""
    every = 1
    while every == 1 or y.size // every >= _AVERAGES * max(structure.order, _FACTOR):
        whole = y.size // every * every
        inputs = v[:whole].reshape(-1, every, v.shape[1]).mean(axis=1)
        response = _impulse_response(structure.order, inputs, y[:whole:every])
        for order in (structure.order, structure.order + _EXTRA):
            poles = _poles(response, order)
            if poles.size:
                yield _with_poles(structure, _continuous(poles, every))
        every *= _FACTOR


def _impulse_response(order: int, v: Matrix, y: Vector) -> Vector:
    """Return the impulse response from the first input of an ARX model with many lags."""
    from scipy.signal import lfilter

    lags = int(min(max(_LAGS, _LAGS_PER_POLE * order), max(_SHARE * y.size, 2 * order)))
    past = np.arange(lags, y.size)[:, None] - np.arange(1, lags + 1)
    regressors = np.hstack([y[past], v[past, 0], v[lags:, 1:]])
    size = nonzero_lengths(regressors)
    regressors /= size
    gram, right = regressors.T @ regressors, regressors.T @ y[lags:]
    found = np.linalg.lstsq(gram, right, rcond=_RANK)[0] / size
    impulse = np.zeros(2 * _LONGER * lags + 1)
    impulse[0] = 1.0
    # The model of a record with little noise may be unstable.
    with np.errstate(all="ignore"):
        g = lfilter(np.append(0.0, found[lags : 2 * lags]), np.append(1.0, -found[:lags]), impulse)
    return np.asarray(g[1:])


def _poles(g: Vector, order: int) -> NDArray[np.complex128]:
    """Return the poles z of the impulse response ``g``; none if it has fewer than ``order``."""
    half = g.size // 2
    if not np.all(np.isfinite(g)) or order > half:
        return np.zeros(0, dtype=complex)
    entries = np.arange(half)[:, None] + np.arange(half)
    U, S, V = np.linalg.svd(g[entries])
    if not S[order - 1] > 0.0:
        return np.zeros(0, dtype=complex)
    root = np.sqrt(S[:order])
    A = (U[:, :order] / root).T @ g[entries + 1] @ (V[:order].T / root)
    return np.asarray(np.linalg.eigvals(A), dtype=complex)


def _continuous(z: NDArray[np.complex128], every: int) -> NDArray[np.complex128]:
    """Return stable poles [1/sample] of poles z of averages over ``every`` samples."""
    with np.errstate(all="ignore"):
        p = np.log(z) / every
    # A real z that is not positive has no real logarithm: a pole at half the sampling rate.
    p = np.where((z.imag == 0.0) & (z.real <= 0.0), -np.pi / every, p)
    return np.asarray(-np.clip(np.abs(p.real), _SLOWEST, _FASTEST) + 1j * p.imag)


def _with_poles(structure: Structure, poles: NDArray[np.complex128]) -> Vector:
    """Return θ with these poles; slow ones stand for the integrators, the fastest are left out."""
    theta = np.zeros(structure.size)
    slow_first = poles[np.argsort(np.abs(poles))]
    kept = slow_first[structure.integrators : structure.order]
    if kept.size:
        theta[: structure.free] = np.poly(kept).real[:0:-1]
    return theta
