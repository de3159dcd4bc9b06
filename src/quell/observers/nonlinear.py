"""Han's nonlinear extended state observer: a correction that grows slower than its error.

Han, "From PID to active disturbance rejection control", *IEEE Trans. Industrial Electronics* 56,
2009, with his ``fal``::

    fal(e, α, δ) = e / δ^(1−α)         |e| ≤ δ
                   |e|^α sign e        |e| > δ

Han integrates by Euler's method. Here the model is sampled exactly, as for the linear observer, and
only the correction is nonlinear::

    z⁻ = Φ z + Γ_u u + Γ_f f_L,      e = y − z⁻_1,      z_i = z⁻_i + L_i δ^(1−α_i) fal(e, α_i, δ)

Within ±δ the correction is ``L_i e`` for any α: the linear observer of the bandwidth omega_o. With
α = 1 it is linear everywhere. Beyond δ it corrects less, so it responds less to an outlier or to a
wrong initial state, and needs longer to return from a state that is far off: the time grows with a
power of e. Beyond an error from which it would hardly return, 2¹⁶ δ with the powers 1, ½ and ¼, it
starts again at y. Han's gains are ``β_i = L_i δ^(1−α_i) / dt``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.kernels.dispatch import kernel
from quell.kernels.functions import copysign
from quell.observers.base import begin, observe, predict_state
from quell.observers.linear import EsoModel
from quell.types import Matrix, Vector

# At an error e the weakest correction has the slope (δ/|e|)^(1−α) of its linear part, and an
# observer with ω_o dt = 0.2 returns in about as many samples as the inverse of this slope: 2¹² from
# |e| = 2¹⁶ δ with Han's powers of order 2 (benchmarks/hostile_steps.py). Beyond 2⁴⁰ δ no power
# makes it an error of estimation.
_INVERSE_SLOPE, _LARGEST = 12.0, 40.0  # powers of two


class NonlinearModel(NamedTuple):
    """Parameters of the nonlinear observer, with N = n + m states."""

    transition: Matrix  # Φ (N, N)
    input: Vector  # Γ_u (N,)
    feed: Vector  # Γ_f (N,)
    gain: Vector  # L (N,), as for the linear observer
    alpha: Vector  # α (N,), above 0 and at most 1
    delta: float  # δ [y-unit]
    largest_error: float  # beyond it the observer starts again [y-unit]

    @property
    def states(self) -> int:
        """Length of the running state."""
        return int(self.gain.size)


@kernel
def fal(error: float, alpha: float, delta: float) -> float:
    """Return Han's ``fal``: ``|error|^alpha`` with the sign of ``error``, but linear within ±δ.

    The slope of the power alone would be unbounded at zero.
    """
    size = abs(error)
    if size <= delta:
        return float(error / delta ** (1.0 - alpha))
    return copysign(size**alpha, error)


@kernel
def is_lost(model: Any, error: float) -> bool:
    """Return whether ``error`` is too large for an error of estimation."""
    return not abs(error) <= model.largest_error


@kernel
def nonlinear_correction(model: Any, i: int, error: float) -> float:
    """Return ``L_i δ^(1−α_i) fal(e, α_i, δ)``."""
    alpha, delta = model.alpha[i], model.delta
    return float(model.gain[i] * delta ** (1.0 - alpha) * fal(error, alpha, delta))


@observe.register(NonlinearModel)
def _observe(
    model: NonlinearModel, z: Vector, estimate: Vector, y: float, u: float, f_learned: float
) -> None:
    predict_state(model, z, estimate, u, f_learned)
    error = y - estimate[0]
    if is_lost(model, error):
        begin(model, z, estimate, y)
        return
    for i in range(z.size):
        estimate[i] += nonlinear_correction(model, i, error)
        z[i] = estimate[i]


def nonlinear_model(linear: EsoModel, delta: float, alpha: Any) -> NonlinearModel:
    """Return the nonlinear observer that is ``linear`` within ±delta; see ``ESO.nonlinear``."""
    delta, size = checks.positive("delta", delta, "y-unit"), linear.states
    powers = 0.5 ** np.arange(float(size)) if alpha is None else checks.vector("alpha", alpha, size)
    if not np.all((powers > 0.0) & (powers <= 1.0)):
        raise ValueError(f"alpha = {alpha!r}: each entry must be above 0 and at most 1")
    weakest = float(np.min(powers))
    reach = _INVERSE_SLOPE / (1.0 - weakest) if weakest < 1.0 else _LARGEST
    return NonlinearModel(
        *(linear.transition, linear.input, linear.feed, linear.gain),
        *(powers, delta, 2.0 ** min(reach, _LARGEST) * delta),
    )
