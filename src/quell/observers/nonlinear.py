"""Han's nonlinear extended state observer: a correction that grows slower than its error.

Han, "From PID to active disturbance rejection control", *IEEE Trans. Industrial Electronics* 56, 2009, with his ``fal``::

    fal(e, α, δ) = e / δ^(1−α)         |e| ≤ δ
                   |e|^α sign e        |e| > δ

His observer is of Euler's kind; here the model is sampled exactly, as for the linear one, and only the correction is nonlinear::

    z⁻ = Φ z + Γ_u u + Γ_f f_L,      e = y − z⁻_1,      z_i = z⁻_i + L_i δ^(1−α_i) fal(e, α_i, δ)

The factor makes the correction ``L_i e`` within ±δ, whatever α: there it is the linear observer of the bandwidth omega_o, and with α = 1
it is that everywhere. Outside it corrects less: an outlier, or a start far off, is answered more gently. Han's gains are
``β_i = L_i δ^(1−α_i) / dt``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from quell.kernels.dispatch import kernel
from quell.observers.base import begin, begin_at, observe, predict_state
from quell.types import Matrix, Vector


class NonlinearModel(NamedTuple):
    """Parameters of the nonlinear observer, with N = n + 1 states."""

    transition: Matrix
    """Φ (N, N)."""
    input: Vector
    """Γ_u (N,)."""
    feed: Vector
    """Γ_f (N,)."""
    gain: Vector
    """L (N,), as for the linear observer."""
    alpha: Vector
    """α (N,), above 0 and at most 1."""
    delta: float
    """δ [y-unit]."""

    @property
    def states(self) -> int:
        """Length of the running state."""
        return int(self.gain.size)


@kernel
def fal(error: float, alpha: float, delta: float) -> float:
    """Return Han's ``fal``: the power α of an error, signed, and linear within ±δ, where the power's slope would be without bound."""
    size = abs(error)
    if size <= delta:
        return float(error / delta ** (1.0 - alpha))
    return math.copysign(size**alpha, error)


@observe.register(NonlinearModel)
def _observe(
    model: NonlinearModel, z: Vector, seen: Vector, y: float, u: float, f_learned: float
) -> None:
    predict_state(model, z, seen, u, f_learned)
    error = y - seen[0]
    for i in range(z.size):
        seen[i] += (
            model.gain[i]
            * model.delta ** (1.0 - model.alpha[i])
            * fal(error, model.alpha[i], model.delta)
        )
        z[i] = seen[i]


@begin.register(NonlinearModel)
def _begin(model: NonlinearModel, z: Vector, seen: Vector, y: float) -> None:
    begin_at(z, seen, y)
