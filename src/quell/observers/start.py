"""The running state of an observer for given estimates."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell.observers.cascade import CascadeModel
from quell.observers.delay import DelayedModel
from quell.observers.delta import DeltaCascadeModel
from quell.types import Vector


def state_for(model: Any, x: Vector, f: Vector, u: float) -> Vector:
    """Return the running state whose estimates are ``x`` (n,) and ``f`` (m,), after a constant u.

    ``f`` is f with its derivatives; missing ones are zero. All levels of a cascade have the same x,
    and the first one has f; the others estimate what the levels before them miss.
    """
    if isinstance(model, DelayedModel):
        inner = state_for(model.inner, x, f, u)
        return np.append(inner, np.full(model.samples, u))
    z = np.zeros(model.states)
    z[: x.size], z[x.size : x.size + f.size] = x, f
    if isinstance(model, CascadeModel | DeltaCascadeModel):
        levels = model.gains.shape[0]
        for start in range(z.size // levels, z.size, z.size // levels):
            z[start : start + x.size] = x
    return z
