"""What the observer would answer to a known input: the exact lag between a disturbance and its estimate.

The ESO is linear. To an input φ that enters where f does, and that its measurement does not show, its error answers with the shadow

    s⁺ = (I − L C)(Φ s + Γ_f φ),        φ^F = −s_N

so that ``Δf̂ = (f − f_L)^F`` exactly, but for noise and for what f does between samples, and ``Δf̂ + f_L^F ≈ θ·φ^F`` is a regression
without lag bias. All poles of the shadow lie at β = exp(−omega_o dt) in one Jordan chain, so φ^F is a weighted sum of N lags in a row,

    v_1⁺ = β v_1 + (1−β) φ,      v_j⁺ = β v_j + (1−β) v_{j−1},      φ^F = Σ c_j v_j

which costs O(N) an input instead of O(N²), and moves all inputs side by side.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.dispatch import kernel
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# In units of the observer's lag: after this its initial error has decayed to a part in a thousand.
WATCH = 2.0


class Lag(NamedTuple):
    """The lag filter of one observer, with N = n + 1 states for each input."""

    pole: float
    """β."""
    rise: float
    """1 − β, without the rounding of the difference."""
    taps: Vector
    """c (N,)."""
    predictor: bool
    """One sample later, for an observer in predictor form."""


def watch_samples(observer: ESO) -> int:
    """Return how many samples after a start from rest nothing is learned: the observer's own initial error is in Δf̂ then."""
    return round(WATCH * (observer.order + 1) / observer.omega_o / observer.dt)


def lag_of(observer: ESO) -> Lag:
    """Return the lag filter of an observer.

    With ``M = (I − L C) Φ`` and ``g = (I − L C) Γ_f``, the chain is ``s = V v`` with ``V_1 = g/(1−β)`` and
    ``V_{j+1} = (M − βI) V_j/(1−β)``, which ends by Cayley-Hamilton; ``c_j = −(V_j)_N``.
    """
    model = observer.model
    size = observer.order + 1
    # In the coordinates x_i dt^(i−1), as for the design: there all entries are O(1).
    scale = observer.dt ** np.arange(size)
    correct = np.eye(size)
    correct[:, 0] -= model.gain * scale
    transition = correct @ (model.transition * scale[:, None] / scale[None, :])
    rise = -np.expm1(-observer.omega_o * observer.dt)
    shifted = transition - np.eye(size) + rise * np.eye(size)
    column = correct @ (model.feed * scale) / rise
    taps = np.empty(size)
    for j in range(size):
        taps[j] = -column[-1] / scale[-1]
        column = shifted @ column / rise
    return Lag(observer.pole, rise, taps, model.predictor)


@kernel
def lag_push(lag: Lag, chain: Matrix, i: int, value: float) -> float:
    """Move chain ``i`` of (m, N) on by a sample with the input ``value``; return what the next estimate shows of it."""
    shown = 0.0
    if lag.predictor:
        for j in range(lag.taps.size):
            shown += lag.taps[j] * chain[i, j]
    carry = lag.rise * value
    after = 0.0
    for j in range(lag.taps.size):
        old = chain[i, j]
        new = lag.pole * old + carry
        carry = lag.rise * old
        chain[i, j] = new
        after += lag.taps[j] * new
    return shown if lag.predictor else after
