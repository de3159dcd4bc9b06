"""Bandwidths as parameters that can be changed while an FMU runs: closed forms for C.

*omega_c*: ``k_i = w_i omega_c^(m−i+1)`` with the binomial coefficients, or those of a pattern of
poles, as w (``controllers/adrc/law.py``), and the factor ``exp(−omega_c dt)`` of the offset after a
bumpless transfer. A guard takes the m gains for poles at ``ω_g = k_1^(1/m)``, and has the parameter
``respond = 1 − exp(−ω_g dt)`` (``guard/guard.py``).

*omega_o*: Ackermann's formula (``observers/placement.py``) with N equal poles ``1 − ω``,
``ω = 1 − exp(−omega_o dt)``, is a polynomial, because its last factor does not depend on ω::

    L = (Φ − I + ω I)^N v = Σ_k C(N, k) ω^k (Φ − I)^(N−k) v,        v = O⁻¹ e_N

A bandwidth is offered only where its closed form gives all that it changes in the parameters, which
is checked; elsewhere it is fixed: omega_o with a learner, whose lag depends on it, with other poles
and in forms that are not linear; omega_c with a nonlinear law, or a guard with a certified bound.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.adrc.adrc import ADRC
from quell.controllers.adrc.law import law_gains
from quell.controllers.prefilters.prefilter import Prefiltered
from quell.guard.state import GuardDesign
from quell.learners import NoLearner
from quell.observers.eso import ESO
from quell.observers.linear import EsoModel
from quell.types import Matrix, Vector

# Relative error of the closed form of L where a bandwidth is still offered: it is 1e-11 at most for
# the observers of the tests, and an observer to which the form does not apply is far off.
_LARGEST_ERROR = 1e-9
_OTHER = 1.25  # times omega_c: another value, for which the closed form is checked


class Bandwidths(NamedTuple):
    """Data that C needs for the bandwidths of an ADRC; None for a bandwidth that is fixed."""

    path: str  # of the parameters of the ADRC within those of the controller, with a dot, or empty
    dt: float
    omega_c: float
    weights: Vector | None  # w (m,)
    guard: int | None  # m of its ω_g
    omega_o: float
    coefficients: Matrix | None  # of ω^k in L (N, N + 1)


def bandwidths(controller: Any) -> Bandwidths | None:
    """Return the bandwidths of a controller; None if it is no ADRC."""
    path = ""
    while isinstance(controller, Prefiltered):
        path, controller = f"{path}controller.", controller.controller
    if type(controller) is not ADRC:
        return None
    observer, guard = controller.observer, _guard_order(controller)
    return Bandwidths(
        path,
        observer.dt,
        controller.omega_c,
        _weights(controller, guard),
        guard,
        observer.omega_o,
        None if _learns(controller) else gain_coefficients(observer),
    )


def _learns(controller: ADRC) -> bool:
    return not isinstance(controller.learner, NoLearner)


def _guard_order(controller: ADRC) -> int | None:
    has_guard = isinstance(controller.parameters.guard, GuardDesign)
    return controller.observer.degree if has_guard else None


def _weights(controller: ADRC, guard: int | None) -> Vector | None:
    """Return the gains for omega_c = 1, if the closed forms give all that omega_c changes."""
    observer, dt = controller.observer, controller.dt
    weights = law_gains(observer.degree, 1.0, controller.law_poles)
    weights *= 0.5 if controller.half_gain else 1.0
    for omega_c in (controller.omega_c, _OTHER * controller.omega_c):
        gains = weights * omega_c ** (observer.degree - np.arange(observer.degree))
        closed = controller.parameters._replace(
            law=np.append(gains, np.zeros(observer.order - observer.degree)),
            fade=math.exp(-omega_c * dt),
        )
        if guard is not None:
            omega = float(gains[0]) ** (1.0 / guard)
            respond = -math.expm1(-omega * dt)
            closed = closed._replace(guard=closed.guard._replace(respond=respond))
        design = controller._design(observer, omega_c)
        if not all(_equal(*pair) for pair in zip(_leaves(design), _leaves(closed), strict=True)):
            return None
    return weights


def gain_coefficients(observer: ESO) -> Matrix | None:
    """Return the coefficients of ω^k in L (N, N + 1), if all poles are equal; else None."""
    model, n = observer.model, observer.plant.a.size
    if type(model) is not EsoModel or not observer.has_one_pole:
        return None
    size, m = observer.estimates, observer.disturbance_order
    # In the coordinates x_i dt^(i−1) and f^(j) dt^(q+j) of the design all entries are O(1).
    scale = observer.dt ** np.append(np.arange(n), observer.plant.f_degree + np.arange(m))
    difference = model.transition * scale[:, None] / scale[None, :] - np.eye(size)
    rows = np.empty((size, size))
    rows[0] = difference[0]
    rows[0, 0] += 1.0
    for i in range(1, size):
        rows[i] = rows[i - 1] @ difference
    vector = np.linalg.solve(rows, np.eye(size)[-1])
    columns = []
    for k in range(size, -1, -1):
        columns.append(math.comb(size, k) * vector / scale)
        vector = difference @ vector
    coefficients = np.array(columns[::-1]).T
    omega = -math.expm1(-observer.omega_o * observer.dt)
    gain = coefficients @ omega ** np.arange(size + 1)
    return coefficients if np.allclose(gain, model.gain, rtol=_LARGEST_ERROR, atol=0.0) else None


def _leaves(value: Any) -> Iterator[Any]:
    """Return an iterator over the numbers and arrays in nested NamedTuples."""
    if isinstance(value, tuple):
        for part in value:
            yield from _leaves(part)
    else:
        yield value


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, float | np.ndarray):
        return np.shape(one) == np.shape(other) and np.allclose(
            one, other, rtol=_LARGEST_ERROR, atol=0.0, equal_nan=True
        )
    return bool(one == other)
