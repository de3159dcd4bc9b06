"""An ADRC without learner, guard and nonlinear parts as a linear law, in closed form.

The state is the observer's prediction z⁻, its input the error ``e = y − z⁻_1``. With the correction
``z = J z⁻ + H e`` and the estimates ``x̂ = T z⁻ + D e``::

    z⁻⁺ = F z + Γ u = F J z⁻ + F H e + Γ u
    u   = ( k_1 r + k_2 r' + … + r^(m) + (a − k)·x̂_{1…n} − Δf̂ ) / b0        (``law.py``)

For an ESO (``observers/linear.py``) ``F = Φ``, ``H = L`` and ``J = I``; in the predictor form the
estimates are z⁻ itself. In a cascade of p levels (``observers/cascade.py``) each level corrects the
next one.
"""

from __future__ import annotations

from functools import singledispatch
from typing import Any, NamedTuple

import numpy as np

from quell.checks import LARGEST_SIGNAL
from quell.controllers.adrc.feedback import LinearFeedback
from quell.controllers.adrc.feedforward_law import ModelFeedforward
from quell.controllers.adrc.law import AdrcDesign
from quell.controllers.linear.form import LinearForm, linear_form
from quell.controllers.linear.law import LinearLaw
from quell.guard import UnguardedDesign
from quell.learners.base import NoLearnerDesign
from quell.observers.cascade import CascadeModel
from quell.observers.delay import DelayedModel, without_delay
from quell.observers.linear import EsoModel
from quell.types import Matrix, Vector


class Prediction(NamedTuple):
    """The matrices above for an observer of s states and N estimates."""

    F: Matrix  # (s, s)
    input: Vector  # Γ (s,)
    J: Matrix  # (s, s)
    H: Vector  # (s,)
    T: Matrix  # (N, s)
    D: Vector  # (N,)
    start: Vector  # z⁻ at the first sample, for y = 1 (s,)


@singledispatch
def prediction(model: Any) -> Prediction | None:
    """Return the matrices of a linear observer without delay; None for another one."""
    return None


@prediction.register
def _of_eso(model: EsoModel) -> Prediction:
    size = model.gain.size
    unit, L = np.eye(size), model.gain
    D = np.zeros(size) if model.predictor else L
    return Prediction(model.transition, model.input, unit, L, unit, D, unit[0])


@prediction.register
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
    start = np.tile(np.eye(size)[0], levels)
    return Prediction(F, np.tile(model.input, levels), J, H, last @ J, last @ H, start)


@linear_form.register
def _of_adrc(design: AdrcDesign) -> LinearForm | None:
    kinds = tuple(map(type, (design.learner, design.guard, design.feedback)))
    found = prediction(without_delay(design.eso))
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
    degree = np.count_nonzero(design.law)
    estimates = np.column_stack([found.T, found.D])
    rates = {"f_derivatives": estimates[order + 1 :]} if order + 1 < found.D.size else {}
    return LinearForm(
        law=law,
        predicts=1.0,
        derivatives=np.append(design.law[1:degree], 1.0) / design.b0,
        start=found.start,
        delay=design.eso.samples if isinstance(design.eso, DelayedModel) else 0,
        limits=design.limits,
        largest_wish=LARGEST_SIGNAL,
        channels={
            "x_hat": estimates[:order],
            "f_residual": estimates[order : order + 1],
            "f_learned": np.zeros((1, estimates.shape[1])),
        }
        | rates,
    )
