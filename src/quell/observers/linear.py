"""The update of the linear extended state observer.

Each sample, with the exactly sampled extended model ``Φ, Γ_u, Γ_f``::

    predict   z⁻ = Φ z + Γ_u u + Γ_f f_L          u: the control signal that was applied
    correct   z  = z⁻ + L (y − z⁻_1)

The *current* form hands ``z`` to the controller. The *predictor* form hands it ``z⁻``, which knows
y only up to the sample before: one sample of delay more, with the same poles.
"""

from __future__ import annotations

from typing import NamedTuple

from quell.kernels.sized import Flag
from quell.observers.base import observe, predict_state
from quell.types import Matrix, Vector


class EsoModel(NamedTuple):
    """Parameters of the update for order n, with N = n + m states."""

    transition: Matrix  # Φ (N, N)
    input: Vector  # Γ_u (N,)
    feed: Vector  # Γ_f (N,)
    gain: Vector  # L (N,)
    predictor: Flag  # whether the controller gets z⁻ instead of z

    @property
    def states(self) -> int:
        """Length of the running state."""
        return int(self.gain.size)


@observe.register(EsoModel)
def _observe(
    model: EsoModel, z: Vector, estimate: Vector, y: float, u: float, f_learned: float
) -> None:
    predict_state(model, z, estimate, u, f_learned)
    error = y - estimate[0]
    for i in range(z.size):
        z[i] = estimate[i] + model.gain[i] * error
        if not model.predictor:
            estimate[i] = z[i]
