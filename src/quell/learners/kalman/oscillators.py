"""Oscillators whose frequency is adapted while their amplitudes are learned.

An oscillator advances its own phase, ``ψ' = ω̂``, and has the pair of features (sin ψ, cos ψ). For
a load ``A sin(ωt + φ)`` the learned pair θ = (θ_s, θ_c) is a vector of length A, which rotates at ω
− ω̂. So each update δθ of the pair corrects the frequency by the angle of its rotation:

    ω̂ ← ω̂ + κ ω̂ (θ_s δθ_c − θ_c δθ_s) / (|θ|² + c E[ε² + (0.1 f̂)²])

Two properties make it lock quickly and remain locked. The gain is relative to ω̂, because an
oscillator learns at a rate proportional to its frequency (``pair_bandwidth`` in ``harmonic.py``);
so the loop of phase and frequency is equally damped at all frequencies. And the unexplained part ε
reduces the correction: when a load comes on, θ turns from an arbitrary direction that noise has
left, which carries no information on the frequency.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from quell.kernels.dispatch import kernel
from quell.kernels.sized import Size
from quell.types import Vector

# κ and c: a broad optimum over random loops (docs/theory).
_FREQUENCY_GAIN, _UNEXPLAINED_WEIGHT = 0.4, 60.0


class Oscillators(NamedTuple):
    """Parameters of m oscillators, whose features are consecutive in θ."""

    first: Size  # index in θ of the first pair
    omega: Vector  # initial frequencies [rad/s] (m,)
    low: float  # least frequency [rad/s]
    high: float  # largest frequency [rad/s]


@kernel
def retune(
    oscillators: Oscillators,
    omega: Vector,
    j: int,
    theta: Vector,
    change_s: float,
    change_c: float,
    unexplained: float,
) -> None:
    """Correct the frequency of oscillator ``j`` after its pair changed by ``(change_s, change_c)``.

    ``unexplained`` is E[ε² + (0.1 f̂)²].
    """
    at = oscillators.first + 2 * j
    size = theta[at] * theta[at] + theta[at + 1] * theta[at + 1] + _UNEXPLAINED_WEIGHT * unexplained
    if size > 0.0:
        turn = (theta[at] * change_c - theta[at + 1] * change_s) / size
        turned = omega[j] * (1.0 + _FREQUENCY_GAIN * turn)
        omega[j] = min(max(turned, oscillators.low), oscillators.high)


@kernel
def turn_phases(phase: Vector, omega: Vector, dt: float) -> None:
    """Advance all phases by a sample."""
    for j in range(phase.size):
        phase[j] = (phase[j] + omega[j] * dt) % (2.0 * math.pi)
