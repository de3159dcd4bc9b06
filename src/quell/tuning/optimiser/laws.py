"""The linear law of a controller in closed form, quick enough for each step of a search.

``quell.analysis`` measures the same matrices on the controller's own kernel, for any form of
observer; here they are derived, for the forms that the structures of tuning make. Without learner,
guard and nonlinear parts the state of an ADRC is the observer's prediction z⁻, its input the error
``e = y − z⁻_1``. With the correction ``z = J z⁻ + H e`` and the estimates ``x̂ = T z⁻ + D e``::

    z⁻⁺ = F z + Γ u = F J z⁻ + F H e + Γ u
    u   = ( k_1 r + k_2 r' + … + r^(m) + (a − k)·x̂_{1…n} − Δf̂ ) / b0        (``law.py``)

For an ESO (``observers/linear.py``) ``F = Φ``, ``H = L`` and ``J = I``; in the predictor form the
estimates are z⁻ itself. In a cascade of p levels (``observers/cascade.py``) each level corrects the
next one. The terms with r', r'', … are left out: they change no pole.
"""

from __future__ import annotations

from functools import singledispatch
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.adrc.feedback import LinearFeedback
from quell.controllers.adrc.feedforward_law import ModelFeedforward
from quell.controllers.adrc.law import AdrcDesign
from quell.controllers.base import Controller
from quell.controllers.linear.law import LinearLaw
from quell.controllers.linear.linear import LinearDesign
from quell.guard import UnguardedDesign
from quell.learners.base import NoLearnerDesign
from quell.observers.cascade import CascadeModel
from quell.observers.delay import DelayedModel, without_delay
from quell.observers.linear import EsoModel
from quell.types import Matrix, Vector


def law_of(controller: Controller) -> LinearLaw:
    """Return the law of a linear controller, driven by y and by the applied u without delay.

    Raises ``ValueError`` for a controller that is not linear.
    """
    law = _law(controller.parameters)
    if law is None:
        raise ValueError(f"controller = {controller!r}: must be linear")
    return law


class Prediction(NamedTuple):
    """The matrices above for an observer of s states and N estimates."""

    F: Matrix  # (s, s)
    input: Vector  # Γ (s,)
    J: Matrix  # (s, s)
    H: Vector  # (s,)
    T: Matrix  # (N, s)
    D: Vector  # (N,)


@singledispatch
def _prediction(model: Any) -> Prediction | None:
    """Return the matrices of a linear observer without delay; None for another one."""
    return None


@_prediction.register
def _of_eso(model: EsoModel) -> Prediction:
    size = model.gain.size
    unit, L = np.eye(size), model.gain
    D = np.zeros(size) if model.predictor else L
    return Prediction(model.transition, model.input, unit, L, unit, D)


@_prediction.register
def _of_cascade(model: CascadeModel) -> Prediction:
    levels, size = model.gains.shape
    states, n = levels * size, model.at_f
    F, J, H = np.zeros((states, states)), np.eye(states), np.zeros(states)
    error, error_e = np.zeros(states), 1.0  # of a level, from z⁻ and from e
    for level in range(levels):
        own = slice(level * size, (level + 1) * size)
        F[own, own] = model.transition
        for before in range(level):
            F[own, before * size + n] = model.feed
        J[own] += np.outer(model.gains[level], error)
        H[own] = model.gains[level] * error_e
        error, error_e = J[level * size].copy(), H[level * size]  # less the next level's z⁻_1
        error[(level + 1) * size % states] -= 1.0
    last = np.zeros((size, states))
    last[:, states - size :] = np.eye(size)
    for i in range(n, size):
        last[i, i::size] = 1.0  # Δf̂ and its derivatives are sums over the levels
    return Prediction(F, np.tile(model.input, levels), J, H, last @ J, last @ H)


@singledispatch
def _law(parameters: Any) -> LinearLaw | None:
    """Return the law of a controller with ``parameters``; None if it has none."""
    return None


@_law.register
def _of_linear_controller(design: LinearDesign) -> LinearLaw:
    return design.law


@_law.register
def _of_adrc(design: AdrcDesign) -> LinearLaw | None:
    kinds = tuple(map(type, (design.learner, design.guard, design.feedback)))
    found = _prediction(without_delay(design.eso))
    if isinstance(design.feedforward, ModelFeedforward):
        return None  # it acts on the observer with derivatives of r, and friction is not linear
    if found is None or kinds != (NoLearnerDesign, UnguardedDesign, LinearFeedback):
        return None
    order = design.law.size
    gains = np.zeros(found.D.size)
    gains[: order + 1] = np.append(design.cancel - design.law, -design.cancel_f) / design.b0
    law = LinearLaw(
        A=found.F @ found.J,
        B_r=np.zeros(found.H.size),
        B_y=found.F @ found.H,
        B_u=found.input,
        C=gains @ found.T,
        D_r=design.law[0] / design.b0,
        D_y=float(gains @ found.D),
    )
    first = np.eye(law.C.size)[0]  # e = y − z⁻_1
    law = law._replace(A=law.A - np.outer(law.B_y, first), C=law.C - law.D_y * first)
    return _delayed(law, design.eso.samples) if isinstance(design.eso, DelayedModel) else law


def _delayed(law: LinearLaw, samples: int) -> LinearLaw:
    """Return the law with u acting on its state ``samples`` later, as further states."""
    m = law.C.size
    A = np.zeros((m + samples, m + samples))
    A[:m, :m], A[:m, -1] = law.A, law.B_u
    A[m + 1 :, m:-1] = np.eye(samples - 1)
    B_u = np.zeros(m + samples)
    B_u[m] = 1.0
    none = np.zeros(samples)
    B_r, B_y = np.append(law.B_r, none), np.append(law.B_y, none)
    return LinearLaw(A, B_r, B_y, B_u, np.append(law.C, none), law.D_r, law.D_y)
