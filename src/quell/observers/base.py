"""Generic functions that the controller calls on an observer.

An observer is an ``ESO``. Its ``model`` is a NamedTuple of parameters with ``states``, the length
of the running state ``z``. Entry n of ``z`` is a summand of the estimated f, so a controller may
shift the estimate there; with m extended states f', … follow. A new kind of model registers
``observe``. It registers ``begin`` if its ``z`` does not start with the estimates,
``expected_measurement`` if it lacks ``transition``, ``input`` and ``feed`` for the first entries of
``z``, and ``acting_control`` if u is delayed.
"""

from __future__ import annotations

from typing import Any

from quell.kernels.dispatch import generic, generic_with_default, kernel
from quell.types import Vector


@generic
def observe(model: Any, z: Vector, estimate: Vector, y: float, u: float, f_learned: float) -> None:
    """Advance the state ``z`` by a sample; write ``x̂_1 … x̂_n, Δf̂, Δf̂', …`` into ``estimate`` (N,).

    ``u`` is the control signal that was applied, ``f_learned`` the share of f that was fed
    forward, over the sample that ends with the measurement ``y``.
    """
    raise TypeError


@generic_with_default
def expected_measurement(model: Any, z: Vector, u: float, f_learned: float) -> float:
    """Return the measurement for which ``observe`` makes no correction, given the same inputs."""
    total = model.input[0] * u + model.feed[0] * f_learned
    for j in range(model.feed.size):
        total += model.transition[0, j] * z[j]
    return total


@generic_with_default
def begin(model: Any, z: Vector, estimate: Vector, y: float) -> None:
    """Start at rest at the first measurement: ``x̂_1 = y``, all else zero."""
    for i in range(z.size):
        z[i] = estimate[i] = 0.0
    z[0] = estimate[0] = y


@generic_with_default
def acting_control(model: Any, z: Vector, u: float) -> float:
    """Return the u that reaches the plant while ``u`` is applied: ``u`` itself unless delayed."""
    return u


@kernel
def predict_state(model: Any, z: Vector, predicted: Vector, u: float, f: float) -> None:
    """Write ``Φ z + Γ_u u + Γ_f f`` into ``predicted`` (N,)."""
    for i in range(z.size):
        total = 0.0
        for j in range(z.size):
            total += model.transition[i, j] * z[j]
        predicted[i] = total + model.feed[i] * f + model.input[i] * u
