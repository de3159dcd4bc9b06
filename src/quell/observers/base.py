"""What the controller asks of an observer.

An observer is an ``ESO``: an immutable description with ``order`` n, ``b0``, ``omega_o``, ``dt`` and ``model``, a NamedTuple of
parameters. Its running state is one vector, as long as ``states`` says; entry n of it is a summand of the estimated f, so that a
controller may shift the estimate there. For the type of ``model`` the two functions below are registered.
"""

from __future__ import annotations

from typing import Any

from quell.dispatch import generic
from quell.types import Vector


@generic
def observe(model: Any, z: Vector, seen: Vector, y: float, u: float, f_learned: float) -> None:
    """Advance the observer's state ``z`` by a sample, and put into ``seen`` (n + 1,) what may be known: ``x̂_1 … x̂_n, Δf̂``.

    ``u`` is the control signal that was applied, ``f_learned`` the share of f that was fed forward, over the sample that ends with ``y``.
    """
    raise TypeError


@generic
def begin(model: Any, z: Vector, seen: Vector, y: float) -> None:
    """Start at rest at the first measurement: ``x̂_1 = y``, all else zero."""
    raise TypeError
