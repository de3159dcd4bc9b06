"""Sample correlations of two signals, by the fast Fourier transform."""

from __future__ import annotations

import numpy as np

from quell.types import Vector


def correlation(a: Vector, b: Vector, lags: int) -> Vector:
    """Return ``mean(a[k + τ] b[k])`` for τ = −lags … lags."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(a.size + lags, real=True)
    found = irfft(rfft(a, size) * np.conj(rfft(b, size)), size) / a.size
    return np.concatenate([found[size - lags :], found[: lags + 1]])


def autocorrelation(error: Vector, lags: int) -> Vector:
    """Return ``R(τ)/R(0)`` for τ = 0 … lags, of ``error`` without its mean; zero for a constant."""
    e = error - np.mean(error)
    found = correlation(e, e, lags)[lags:]
    return found / (found[0] or 1.0)
