"""The noise of the estimates that is caused by measurement noise."""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from quell.observers.eso import ESO
from quell.observers.response import scaled_response
from quell.types import Vector


def noise_gains(observer: ESO) -> Vector:
    """Return the variance (n + 1,) that white noise of unit variance in y causes in x̂ and f̂.

    If all poles lie in one place, the formula of a model-free observer is used. In continuous time
    ``x̂_i = Σ_{k=i}^{N} C(N, k) ω_o^k s^(N−k+i−1) / (s + ω_o)^N · y``, and sampled white noise has
    the density dt, so the variance is ``dt ω_o^(2i−1) ∫ |·|² dω / 2π`` with the integrand at
    ω_o = 1. This is accurate for small ``omega_o dt``. With other poles, or if f enters before the
    last integrator, the variance is summed sample by sample instead.
    """
    kept = observer.order + 1
    if observer.f_degree < observer.order or not observer.has_one_pole:
        return _summed_noise_gains(observer)
    unit = _unit_noise_gains(observer.estimates)[:kept]
    return observer.dt * observer.omega_o ** (2.0 * np.arange(kept) + 1.0) * unit


@cache
def _unit_noise_gains(size: int) -> Vector:
    """Return the integrals of ``noise_gains``, which depend only on the number of states."""
    omega = np.geomspace(1e-4, 1e4, 4001)
    s = 1j * omega
    gains = np.empty(size)
    for i in range(1, size + 1):
        powers = (math.comb(size, k) * s ** (size - k + i - 1) for k in range(i, size + 1))
        response = sum(powers) / (s + 1.0) ** size
        gains[i - 1] = np.trapezoid(np.abs(response) ** 2, omega) / math.pi
    gains.flags.writeable = False
    return gains


def _summed_noise_gains(observer: ESO) -> Vector:
    """Return the diagonal of ``C P Cᵀ + d dᵀ``, ``P = Σ M^k g gᵀ M^kᵀ``, by doubling."""
    found = scaled_response(observer.model, observer.units, observer.order)
    gain, feedthrough, transition = found.input[:, 0], found.feedthrough[:, 0], found.transition
    total = np.outer(gain, gain)
    for _ in range(64):
        total += transition @ total @ transition.T
        transition = transition @ transition
        if np.max(np.abs(transition)) < 1e-12:
            break
    variances: Vector = np.einsum("ij,jk,ik->i", found.output, total, found.output)
    return (variances + feedthrough**2)[: observer.order + 1]
