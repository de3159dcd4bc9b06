"""The matrices of a linear observer, found by applying its update to unit vectors."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell.observers.base import observe
from quell.observers.delay import without_delay
from quell.observers.nonlinear import NonlinearModel
from quell.types import Matrix, Vector


class Response(NamedTuple):
    """The update ``z⁺ = M z + G (y, u, f_L)`` and the estimates ``C z + D (y, u, f_L)``.

    There are m states and N estimates, ``x̂_1 … x̂_n, Δf̂`` and its derivatives, if there are any.
    """

    transition: Matrix  #: M (m, m)
    input: Matrix  #: G (m, 3)
    output: Matrix  #: C (N, m)
    feedthrough: Matrix  #: D (N, 3)
    at_f: int  #: n, the place of Δf̂ among the estimates


def response(model: Any, estimates: int, at_f: int) -> Response:
    """Return the matrices of the update of a linear observer's ``model``, for N ``estimates``."""
    if isinstance(without_delay(model), NonlinearModel):
        raise ValueError(
            "observer is nonlinear: it has no exact lag for learners and guards; use a linear one"
        )
    m = model.states
    state, estimated = np.zeros((m, m + 3)), np.zeros((estimates, m + 3))
    for i, one in enumerate(np.eye(m + 3)):
        z, estimate = one[:m].copy(), np.zeros(estimates)
        observe(model, z, estimate, *one[m:].tolist())
        state[:, i], estimated[:, i] = z, estimate
    parts = state[:, :m], state[:, m:], estimated[:, :m], estimated[:, m:]
    transition, given, output, feedthrough = (part.copy() for part in parts)
    return Response(transition, given, output, feedthrough, at_f)


def f_learned_response(found: Response) -> tuple[Matrix, Vector, Vector, float]:
    """Return ``(M, g, c, d)`` of ``s⁺ = M s + g f_L``, ``−Δf̂ = c·s + d f_L``, for y = u = 0."""
    feedthrough = float(found.feedthrough[found.at_f, 2])
    return found.transition, found.input[:, 2], -found.output[found.at_f], -feedthrough


def scaled_response(model: Any, units: Vector, at_f: int) -> Response:
    """Return the response without the delay of u, with the states divided by ``units`` (N,).

    ``ESO.units`` makes the poles O(1) in the time unit ``1/omega_o``. The estimates keep theirs.
    """
    found = response(without_delay(model), units.size, at_f)
    units = np.resize(units, found.transition.shape[0])
    return found._replace(
        transition=found.transition * units[None, :] / units[:, None],
        input=found.input / units[:, None],
        output=found.output * units[None, :],
    )


def total_time_constant(found: Response) -> float:
    """Return ``Σ 1/|ln z_i|`` over the poles [samples], to second order ``tr (I − M)⁻¹ − m/2``."""
    m = found.transition.shape[0]
    return float(np.trace(np.linalg.inv(np.eye(m) - found.transition))) - 0.5 * m


def f_lag(found: Response) -> float:
    """Return the lag of the estimate behind a slowly varying f [samples], ``c (I − M)⁻² g``."""
    M, g, c, _ = f_learned_response(found)
    at_rest = np.eye(M.shape[0]) - M
    return float(c @ np.linalg.solve(at_rest, np.linalg.solve(at_rest, g)))
