"""What noise in the measurement leaves in the estimates."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from quell.observers.response import scaled_response
from quell.types import Vector


def noise_gains(observer: Any) -> Vector:
    """Return the variance of each estimate (N,) that white noise of unit variance in y leaves.

    Where the poles lie in one place, it is that of a model-free observer. In continuous time
    ``x̂_i = Σ_{k=i}^{N} C(N, k) ω_o^k s^(N−k+i−1) / (s + ω_o)^N · y``, and sampled white noise has the density dt; so
    the variance is ``dt ω_o^(2i−1) ∫ |·|² dω / 2π`` of what is left at ω_o = 1. Good while ``omega_o dt`` is small. With other poles, and
    where f enters before the last integrator, with zeros of the plant in its way, that says nothing of it, and its variance is summed up
    sample by sample.
    """
    size = observer.order + 1
    if observer.f_degree < observer.order or not observer.has_one_pole:
        return _summed_noise_gains(observer)
    return observer.dt * observer.omega_o ** (2.0 * np.arange(size) + 1.0) * _unit_noise_gains(size)


@cache
def _unit_noise_gains(size: int) -> Vector:
    """Return the integrals of ``noise_gains``, which depend on the number of states only."""
    omega = np.geomspace(1e-4, 1e4, 4001)
    s = 1j * omega
    gains = np.empty(size)
    for i in range(1, size + 1):
        response = (
            sum(math.comb(size, k) * s ** (size - k + i - 1) for k in range(i, size + 1))
            / (s + 1.0) ** size
        )
        gains[i - 1] = np.trapezoid(np.abs(response) ** 2, omega) / math.pi
    gains.flags.writeable = False
    return gains


def _summed_noise_gains(observer: Any) -> Vector:
    """Return the diagonal of ``C P Cᵀ + d dᵀ``, ``P = Σ M^k g gᵀ M^kᵀ``, by doubling, in the observer's own time."""
    found = scaled_response(observer)
    gain, through, transition = found.input[:, 0], found.feedthrough[:, 0], found.transition
    total = np.outer(gain, gain)
    for _ in range(64):
        total += transition @ total @ transition.T
        transition = transition @ transition
        if np.max(np.abs(transition)) < 1e-12:
            break
    variances: Vector = np.einsum("ij,jk,ik->i", found.output, total, found.output) + through**2
    return variances
