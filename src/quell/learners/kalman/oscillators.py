"""Oscillators whose frequency is adapted while their amplitudes are learned.

An oscillator advances its own phase, ``ψ' = ω̂``, and has a pair of features (sin kψ, cos kψ) for
each of its orders k, by default 1 alone. For a load ``A sin(ωt + φ)`` the learned pair θ = (θ_s,
θ_c) is a vector of length A, which rotates at ω − ω̂. So each update δθ of the pair corrects the
frequency by the angle of its rotation:

    ω̂ ← ω̂ + κ ω̂ (θ_s δθ_c − θ_c δθ_s) / (|θ|² + c E[ε² + (0.1 f̂)²])

With several orders the pairs turn at k (ω − ω̂), and the angle is that of the least squares, with
``Σ k (…)`` in the numerator and ``Σ k² |θ_k|²`` in the denominator.

Two properties make it lock quickly and remain locked. The gain is relative to ω̂, because an
oscillator learns at a rate proportional to its frequency (``pair_bandwidth`` in ``harmonic.py``);
so the loop of phase and frequency is equally damped at all frequencies. And the unexplained part ε
reduces the correction: when a load comes on, θ turns from an arbitrary direction that noise has
left, which carries no information on the frequency.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from quell.kernels.dispatch import kernel
from quell.kernels.functions import cos, sin
from quell.kernels.sized import Size
from quell.learners.lag import lag_push
from quell.types import Matrix, Vector

# κ and c: a broad optimum over random loops (docs/theory).
_FREQUENCY_GAIN, _UNEXPLAINED_WEIGHT = 0.4, 60.0


class Oscillators(NamedTuple):
    """Parameters of m oscillators with p orders, whose features are consecutive in θ."""

    first: Size  # index in θ of the first pair
    omega: Vector  # initial frequencies [rad/s] (m,)
    low: float  # least frequency [rad/s]
    high: float  # largest frequency [rad/s]
    orders: Vector  # k (p,)


@kernel
def retune(
    oscillators: Oscillators,
    omega: Vector,
    j: int,
    theta: Vector,
    gain: Vector,
    step: float,
    unexplained: float,
) -> None:
    """Correct the frequency of oscillator ``j`` after θ changed by ``step · gain``.

    ``unexplained`` is E[ε² + (0.1 f̂)²].
    """
    orders = oscillators.orders
    turn = size = 0.0
    for k in range(orders.size):
        at, order = oscillators.first + 2 * (j * orders.size + k), orders[k]
        change_s, change_c = step * gain[at], step * gain[at + 1]
        turn += order * (theta[at] * change_c - theta[at + 1] * change_s)
        size += order * order * (theta[at] * theta[at] + theta[at + 1] * theta[at + 1])
    size += _UNEXPLAINED_WEIGHT * unexplained
    if size > 0.0:
        turned = omega[j] * (1.0 + _FREQUENCY_GAIN * (turn / size))
        omega[j] = min(max(turned, oscillators.low), oscillators.high)


@kernel
def combined(oscillators: Oscillators, phase: Vector, theta: Vector, constant: float) -> float:
    """Return ``constant`` and the sum of all pairs, weighted with θ."""
    orders = oscillators.orders
    for j in range(phase.size):
        for k in range(orders.size):
            at, angle = oscillators.first + 2 * (j * orders.size + k), orders[k] * phase[j]
            constant += theta[at] * sin(angle) + theta[at + 1] * cos(angle)
    return constant


@kernel
def push_pairs(
    oscillators: Oscillators, lag: Any, chain: Matrix, filtered: Vector, phase: Vector
) -> None:
    """Advance the lag filters of all pairs by a sample."""
    orders = oscillators.orders
    for j in range(phase.size):
        for k in range(orders.size):
            at, angle = oscillators.first + 2 * (j * orders.size + k), orders[k] * phase[j]
            filtered[at] = lag_push(lag, chain, at, sin(angle))
            filtered[at + 1] = lag_push(lag, chain, at + 1, cos(angle))


@kernel
def open_pairs(oscillators: Oscillators, covariance: Matrix, variance: float) -> None:
    """Let the amplitudes be unknown, apart from a ``variance``."""
    first = oscillators.first
    for i in range(first, first + 2 * oscillators.omega.size * oscillators.orders.size):
        for j in range(covariance.shape[0]):
            if covariance.shape[1] > covariance.shape[0]:  # the lower triangle and carries
                low, high = min(i, j), max(i, j)
                covariance[high, low] = covariance[low, high + 1] = 0.0
            else:
                covariance[i, j] = covariance[j, i] = 0.0
        covariance[i, i] = variance


@kernel
def turn_phases(phase: Vector, omega: Vector, dt: float) -> None:
    """Advance all phases by a sample."""
    for j in range(phase.size):
        phase[j] = (phase[j] + omega[j] * dt) % (2.0 * math.pi)
