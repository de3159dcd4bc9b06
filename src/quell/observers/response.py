"""What a linear observer does, as matrices: found by showing its own update one unit at a time."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell.observers.base import observe
from quell.observers.delay import without_delay
from quell.observers.nonlinear import NonlinearModel
from quell.types import Matrix, Vector


class Response(NamedTuple):
    """``z⁺ = M z + g_y y + g_u u + g_f f_L``,  ``seen = C z + d_y y + d_u u + d_f f_L``, with m states and N = n + 1 estimates."""

    transition: Matrix
    """M (m, m)."""
    input: Matrix
    """g_y, g_u, g_f (m, 3)."""
    output: Matrix
    """C (N, m)."""
    feedthrough: Matrix
    """d_y, d_u, d_f (N, 3)."""


def response(model: Any, estimates: int) -> Response:
    """Return the matrices of an observer's update from its ``model``, of any linear form, and the number N of its estimates.

    Raises
    ------
    ValueError
        for a nonlinear observer, which has none.
    """
    if isinstance(without_delay(model), NonlinearModel):
        raise ValueError(
            "observer is nonlinear (ESO.nonlinear): it has no exact lag, which learners and guards need; use a linear one"
        )
    m = model.states
    after, seen = np.zeros((m, m + 3)), np.zeros((estimates, m + 3))
    for i in range(m + 3):
        z, shown, values = np.zeros(m), np.zeros(estimates), np.zeros(3)
        if i < m:
            z[i] = 1.0
        else:
            values[i - m] = 1.0
        observe(model, z, shown, *values.tolist())
        after[:, i], seen[:, i] = z, shown
    return Response(
        after[:, :m].copy(), after[:, m:].copy(), seen[:, :m].copy(), seen[:, m:].copy()
    )


def f_learned_response(found: Response) -> tuple[Matrix, Vector, Vector, float]:
    """Return ``(M, g, c, d)`` of ``−Δf̂ = c·s + d φ``, ``s⁺ = M s + g φ``: what the estimate of f shows of f_L = φ, for y = u = 0."""
    return found.transition, found.input[:, 2], -found.output[-1], -float(found.feedthrough[-1, 2])


def scaled_response(observer: Any) -> Response:
    """Return that of an ``ESO`` without its delay of u, in its own time: z as ``x_i/omega_o^(i−1)``, ``f/omega_o^q``; ``seen`` as it is."""
    n = observer.order
    found = response(without_delay(observer.model), n + 1)
    units = np.resize(
        observer.omega_o ** np.append(np.arange(n, dtype=np.float64), observer.f_degree),
        found.transition.shape[0],
    )
    return found._replace(
        transition=found.transition * units[None, :] / units[:, None],
        input=found.input / units[:, None],
        output=found.output * units[None, :],
    )


def total_time_constant(found: Response) -> float:
    """Return ``Σ 1/|ln z_i|`` over the poles, as ``tr (I − M)⁻¹ − m/2``, which is it to second order."""
    m = found.transition.shape[0]
    return float(np.trace(np.linalg.inv(np.eye(m) - found.transition))) - 0.5 * m


def f_lag(found: Response) -> float:
    """Return by how many samples f, as the observer shows it, trails f, for what is slow: ``c (I − M)⁻² g``."""
    M, g, c, _ = f_learned_response(found)
    at_rest = np.eye(M.shape[0]) - M
    return float(c @ np.linalg.solve(at_rest, np.linalg.solve(at_rest, g)))
