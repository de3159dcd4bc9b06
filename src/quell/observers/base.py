"""What the controller asks of an observer.

An observer is an ``ESO``: an immutable description with ``order`` n, ``b0``, ``omega_o``, ``dt`` and ``model``, a NamedTuple of
parameters with ``states``, the length of its running state. That is one vector; entry n of it is a summand of the estimated f, so that a
controller may shift the estimate there. For the type of ``model`` the functions below are registered; ``acting_control`` only where u is delayed,
``expected_measurement`` only where the model has no ``transition``, ``input`` and ``feed`` for the first entries of z.
"""

from __future__ import annotations

from typing import Any

from quell.kernels.dispatch import generic, kernel
from quell.types import Vector


@generic
def observe(model: Any, z: Vector, seen: Vector, y: float, u: float, f_learned: float) -> None:
    """Advance the observer's state ``z`` by a sample, and put into ``seen`` (n + 1,) what may be known: ``x̂_1 … x̂_n, Δf̂``.

    ``u`` is the control signal that was applied, ``f_learned`` the share of f that was fed forward, over the sample that ends with ``y``.
    """
    raise TypeError


@generic
def expected_measurement(model: Any, z: Vector, u: float, f_learned: float) -> float:
    """Return the measurement that ``observe`` would find nothing to correct by, for the same ``u`` and ``f_learned``."""
    raise TypeError


@expected_measurement.register(object)
def _first_of_the_forecast(model: Any, z: Vector, u: float, f_learned: float) -> float:
    total = model.input[0] * u + model.feed[0] * f_learned
    for j in range(model.feed.size):
        total += model.transition[0, j] * z[j]
    return total


@generic
def begin(model: Any, z: Vector, seen: Vector, y: float) -> None:
    """Start at rest at the first measurement: ``x̂_1 = y``, all else zero."""
    raise TypeError


@generic
def acting_control(model: Any, z: Vector, u: float) -> float:
    """Return the control signal that reaches the plant in the sample for which ``u`` is applied: u itself, unless it is delayed."""
    raise TypeError


@acting_control.register(object)
def _acts_at_once(model: Any, z: Vector, u: float) -> float:
    return u


@kernel
def predict_state(model: Any, z: Vector, ahead: Vector, u: float, f: float) -> None:
    """Write ``Φ z + Γ_u u + Γ_f f`` into ``ahead``, both (N,), for a model with ``transition``, ``input`` and ``feed``."""
    for i in range(z.size):
        total = model.input[i] * u + model.feed[i] * f
        for j in range(z.size):
            total += model.transition[i, j] * z[j]
        ahead[i] = total


@kernel
def begin_at(z: Vector, seen: Vector, y: float) -> None:
    """Put y into the first entry of both (N,), zero into all others."""
    for i in range(z.size):
        z[i] = seen[i] = 0.0
    z[0] = seen[0] = y
