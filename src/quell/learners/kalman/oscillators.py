"""Sinusoids whose frequency is not known: oscillators that are retuned while they learn.

An oscillator turns its own phase, ``ψ' = ω̂``, and gives a learner the pair of features (sin ψ, cos ψ). A load ``A sin(ωt + φ)`` makes
the learned pair θ = (θ_s, θ_c) a vector of length A; where ω̂ is wrong, it turns at ω − ω̂. So each update δθ of the pair retunes the
oscillator by how much it turns:

    ω̂ ← ω̂ + κ ω̂ (θ_s δθ_c − θ_c δθ_s) / (|θ|² + c E[ε² + (0.1 f̂)²])

Two things make it lock quickly and stay. The gain is relative to ω̂, as an oscillator learns at a rate in proportion to its frequency
(its share of the bias's bandwidth, see ``kalman.py``): so the loop of phase and frequency is damped alike at all frequencies. And what
is not yet explained, ε, counts against the turn: when a load comes on, θ swings round from wherever noise had left it, which says
nothing about the frequency.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from quell.kernels.dispatch import kernel
from quell.types import Vector

# κ and c: a broad optimum over random loops (docs/theory).
_RETUNE, _DOUBT = 0.4, 60.0


class Oscillators(NamedTuple):
    """Parameters of m oscillators; their features lie side by side in θ."""

    first: int
    """Where in θ the first pair begins."""
    omega: Vector
    """Where their frequencies start [rad/s] (m,)."""
    low: float
    """Least frequency [rad/s]."""
    high: float
    """Largest."""


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
    """Retune oscillator ``j`` after an update of its pair by ``(change_s, change_c)``; ``unexplained`` is E[ε² + (0.1 f̂)²]."""
    at = oscillators.first + 2 * j
    size = theta[at] * theta[at] + theta[at + 1] * theta[at + 1] + _DOUBT * unexplained
    if size > 0.0:
        turn = (theta[at] * change_c - theta[at + 1] * change_s) / size
        omega[j] = min(max(omega[j] * (1.0 + _RETUNE * turn), oscillators.low), oscillators.high)


@kernel
def turn_phases(phase: Vector, omega: Vector, dt: float) -> None:
    """Turn all phases on by a sample."""
    for j in range(phase.size):
        phase[j] = (phase[j] + omega[j] * dt) % (2.0 * math.pi)
