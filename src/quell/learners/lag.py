"""The lag filter: the observer's exact response to an input that enters where f does.

The ESO is linear. An input φ that enters where f does and that its measurement does not show causes
the error

    s⁺ = (I − L C)(Φ s + Γ_f φ),        φ^F = −s_{n+1}

so ``Δf̂ = (f − f_L)^F`` exactly, except for noise and for changes of f between samples, and
``Δf̂ + f_L^F ≈ θ·φ^F`` is a regression without lag bias. All poles of this filter are at
β = exp(−omega_o dt) in one Jordan chain, so φ^F is a weighted sum of a chain of N first-order lags,

    v_1⁺ = β v_1 + (1−β) φ,      v_j⁺ = β v_j + (1−β) v_{j−1},      φ^F = Σ c_j v_j

which costs O(N) per input instead of O(N²). An observer of other tuning or structure has other
poles: then the filter is used in its full form (``DenseLag``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell.kernels.dispatch import generic, kernel
from quell.kernels.sized import Flag
from quell.observers.delay import without_delay
from quell.observers.eso import ESO
from quell.observers.response import (
    Response,
    f_lag,
    f_learned_response,
    response,
    scaled_response,
)
from quell.types import Matrix, Vector

# Duration of the start in units of the observer's lag: its initial error decays to 0.1 % in it.
STARTUP_LAGS = 2.0


class Lag(NamedTuple):
    """The lag filter of an observer with all poles in one place, N = n + m states per input."""

    pole: float  # β
    rise: float  # 1 − β, without cancellation
    taps: Vector  # c (N,)
    predictor: Flag  # whether the observer is in predictor form: its estimate is a sample later

    @property
    def width(self) -> int:
        """Numbers stored per input."""
        return int(self.taps.size)


class DenseLag(NamedTuple):
    """The lag filter of any linear observer, with m states per input."""

    transition: Matrix  # M (m, m)
    input: Vector  # g (m,)
    taps: Vector  # c (m,): effect of the state on the next estimate
    through: float  # d: effect of the input

    @property
    def width(self) -> int:
        """Numbers stored per input: the states and work space of the same size."""
        return 2 * int(self.taps.size)


NO_LAG = Lag(0.0, 0.0, np.zeros(0), False)
"""The filter of a loop without feedforward; its output is zero."""


def startup_samples(observer: ESO) -> int:
    """Return the number of samples after a start from rest in which Δf̂ shows the initial error."""
    return round(STARTUP_LAGS * observer.lag_time / observer.dt)


def lag_memory(lag: Lag | DenseLag, count: int) -> Matrix:
    """Return the state of the lag filters for ``count`` inputs, at rest."""
    return np.zeros((count, lag.width))


@kernel
def reset_lag(memory: Matrix) -> None:
    """Return lag filters, all of ``memory``, to rest."""
    for i in range(memory.shape[0]):
        for j in range(memory.shape[1]):
            memory[i, j] = 0.0


def lag_of(observer: ESO) -> Lag | DenseLag:
    """Return the lag filter of an observer.

    It is a ``Lag`` if all poles are in one place, else a ``DenseLag``. A delay of u has no effect:
    the feedforward is not delayed. Raises ``ValueError`` for a nonlinear observer, which has no lag
    filter.
    """
    if observer.has_one_pole:
        return _chain(observer)
    M, g, c, d = f_learned_response(_response(observer))
    return DenseLag(M, g.copy(), c, d)


def _response(observer: ESO) -> Response:
    return response(without_delay(observer.model), observer.estimates, observer.order)


def group_delay(observer: ESO) -> float:
    """Return the lag in samples of f^F, as the next estimate shows it, behind slow changes of f.

    The j-th lag of the chain delays by ``β/(1−β) + (j−1)/(1−β)``, and the taps sum to one.
    """
    if not observer.has_one_pole:
        return f_lag(scaled_response(observer.model, observer.units, observer.order))
    lag = _chain(observer)
    stage = np.arange(lag.taps.size)
    return float(lag.taps @ (lag.pole / lag.rise + stage / lag.rise)) + float(lag.predictor)


def _chain(observer: ESO) -> Lag:
    """Return the filter as a chain of first-order lags.

    With ``M = (I − L C) Φ`` and ``g = (I − L C) Γ_f``, the chain is ``s = V v`` with ``V_1 =
    g/(1−β)`` and ``V_{j+1} = (M − βI) V_j/(1−β)``, which ends after N by Cayley-Hamilton; ``c_j =
    −(V_j)_{n+1}``, in predictor form ``−(Φ V_j)_{n+1}`` for the next sample.
    """
    model, at_f = without_delay(observer.model), observer.order
    size = observer.estimates
    # In the coordinates x_i dt^(i−1) all entries are O(1).
    scale = observer.dt ** np.arange(size)
    correct = np.eye(size)
    correct[:, 0] -= model.gain * scale
    transition = correct @ (model.transition * scale[:, None] / scale[None, :])
    rise = -np.expm1(-observer.omega_o * observer.dt)
    shifted = transition - np.eye(size) + rise * np.eye(size)
    column = correct @ (model.feed * scale) / rise
    # In predictor form f̂ is the f that is predicted from these states: f itself, or f + dt f' + ….
    row = np.eye(size)[at_f]
    if model.predictor and observer.disturbance_order > 1:
        row = model.transition[at_f] * scale[at_f] / scale
    taps = np.empty(size)
    for j in range(size):
        taps[j] = -(row @ column) / scale[at_f]
        column = shifted @ column / rise
    return Lag(observer.pole, rise, taps, model.predictor)


@generic
def lag_push(lag: Any, memory: Matrix, i: int, value: float) -> float:
    """Advance filter ``i`` of ``lag_memory`` by a sample with the input ``value``.

    Return its output, the effect of the inputs on the next estimate of f.
    """
    raise TypeError


@lag_push.register(Lag)
def _push_chain(lag: Lag, chain: Matrix, i: int, value: float) -> float:
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


@lag_push.register(DenseLag)
def _push_dense(lag: DenseLag, memory: Matrix, i: int, value: float) -> float:
    size = lag.taps.size
    shown = lag.through * value
    for j in range(size):
        shown += lag.taps[j] * memory[i, j]
        total = lag.input[j] * value
        for k in range(size):
            total += lag.transition[j, k] * memory[i, k]
        memory[i, size + j] = total
    for j in range(size):
        memory[i, j] = memory[i, size + j]
    return shown
