"""The observers in delta form with compensated sums, for single precision.

An observer adds small increments to its state. In single precision most of their digits are lost
in the sum: at ω_o dt = 0.01 the increments are a hundredth of a state and less. So only the
increments are calculated, and what rounding takes from their sum is carried over to the next
sample (Middleton & Goodwin, *IEEE Trans. Automatic Control* 31, 1986, for the delta form; Kahan,
*Communications of the ACM* 8, 1965, for the sum). With the carry c of each state::

    d   = (Φ − I) z + Γ_u u + Γ_f f_L + c                 predicted increment
    e   = (y − z_1) − d_1
    d   ← d + L e
    z⁺  = z + d,        c⁺ = d − (z⁺ − z)

This is the update of ``linear.py``, term by term; exactly calculated, c is zero. ``Φ − I`` is
calculated in double precision. The carry makes the state as good as one of twice the digits; what
remains are the rounding of y, and that of d relative to itself.

Coordinates such as x_i/ω_o^(i−1) would not change any of this: rounding is relative.

The running state is (z, c). The compiled double code does not use this form: its rounding is far
below the noise of any sensor, and its figures are published.
"""

from __future__ import annotations

from functools import singledispatch
from typing import Any, NamedTuple

import numpy as np

from quell.kernels.dispatch import kernel
from quell.kernels.sized import Flag, Size
from quell.kernels.sums import add_with_carry
from quell.observers.base import begin, expected_measurement, observe
from quell.observers.cascade import CascadeModel, add_levels
from quell.observers.delay import DelayedModel
from quell.observers.linear import EsoModel
from quell.observers.nonlinear import NonlinearModel, is_lost, nonlinear_correction
from quell.types import Matrix, Vector


class DeltaModel(NamedTuple):
    """Parameters of the linear observer for order n, with N = n + m states and N carries."""

    difference: Matrix  # Φ − I (N, N)
    input: Vector  # Γ_u (N,)
    feed: Vector  # Γ_f (N,)
    gain: Vector  # L (N,)
    predictor: Flag  # whether the controller gets z⁻ instead of z
    chain: Flag  # whether Φ − I is zero up to its diagonal, as in a chain of integrators

    @property
    def states(self) -> int:
        """Length of the running state."""
        return 2 * int(self.gain.size)


class DeltaNonlinearModel(NamedTuple):
    """Parameters of the nonlinear observer, with N = n + m states and N carries."""

    difference: Matrix  # Φ − I (N, N)
    input: Vector  # Γ_u (N,)
    feed: Vector  # Γ_f (N,)
    gain: Vector  # L (N,)
    alpha: Vector  # α (N,)
    delta: float  # δ [y-unit]
    largest_error: float  # beyond it the observer starts again [y-unit]
    chain: Flag  # whether Φ − I is zero up to its diagonal

    @property
    def states(self) -> int:
        """Length of the running state."""
        return 2 * int(self.gain.size)


class DeltaCascadeModel(NamedTuple):
    """Parameters of p levels, each with N = n + m states and N carries."""

    difference: Matrix  # Φ − I (N, N)
    input: Vector  # Γ_u (N,)
    feed: Vector  # Γ_f (N,)
    gains: Matrix  # L_i (p, N)
    at_f: Size  # n, the place of f in a level's state
    chain: Flag  # whether Φ − I is zero up to its diagonal

    @property
    def states(self) -> int:
        """Length of the running state."""
        return 2 * int(self.gains.size)


@kernel
def predict_increments(model: Any, z: Vector, increments: Vector, u: float, f: float) -> None:
    """Write ``(Φ − I) z + Γ_u u + Γ_f f + c`` into ``increments`` (N,)."""
    size = increments.size
    for i in range(size):
        total = z[size + i]
        for j in range(i + 1 if model.chain else 0, size):
            total += model.difference[i, j] * z[j]
        increments[i] = total + model.feed[i] * f + model.input[i] * u


@observe.register(DeltaModel)
def _observe(
    model: DeltaModel, z: Vector, estimate: Vector, y: float, u: float, f_learned: float
) -> None:
    size = estimate.size
    predict_increments(model, z, estimate, u, f_learned)
    error = (y - z[0]) - estimate[0]
    for i in range(size):
        before, predicted = z[i], estimate[i]
        add_with_carry(z, size, i, predicted + model.gain[i] * error)
        estimate[i] = before + predicted if model.predictor else z[i]


@observe.register(DeltaNonlinearModel)
def _observe_nonlinearly(
    model: DeltaNonlinearModel, z: Vector, estimate: Vector, y: float, u: float, f_learned: float
) -> None:
    size = estimate.size
    predict_increments(model, z, estimate, u, f_learned)
    error = (y - z[0]) - estimate[0]
    if is_lost(model, error):
        begin(model, z, estimate, y)
        return
    for i in range(size):
        add_with_carry(z, size, i, estimate[i] + nonlinear_correction(model, i, error))
        estimate[i] = z[i]


@observe.register(DeltaCascadeModel)
def _observe_by_levels(
    model: DeltaCascadeModel, z: Vector, estimate: Vector, y: float, u: float, f_learned: float
) -> None:
    levels, size = model.gains.shape
    target, f_known = y, f_learned
    for level in range(levels):
        state = z[2 * level * size : 2 * (level + 1) * size]
        f_before = state[model.at_f]
        predict_increments(model, state, estimate, u, f_known)
        error = (target - state[0]) - estimate[0]
        for i in range(size):
            add_with_carry(state, size, i, estimate[i] + model.gains[level, i] * error)
        target = state[0]
        f_known += f_before
    for i in range(model.at_f):
        estimate[i] = z[2 * (levels - 1) * size + i]
    add_levels(z, estimate, model.at_f, levels, 2 * size)


@expected_measurement.register(DeltaModel)
@expected_measurement.register(DeltaNonlinearModel)
@expected_measurement.register(DeltaCascadeModel)
def _expected(model: Any, z: Vector, u: float, f_learned: float) -> float:
    size = model.feed.size
    total = z[size] + model.input[0] * u + model.feed[0] * f_learned
    for j in range(size):
        total += model.difference[0, j] * z[j]
    return z[0] + total


@begin.register(DeltaModel)
@begin.register(DeltaNonlinearModel)
@begin.register(DeltaCascadeModel)
def _begin(model: Any, z: Vector, estimate: Vector, y: float) -> None:
    size = estimate.size
    for i in range(z.size):
        z[i] = y if i % (2 * size) == 0 else 0.0
    for i in range(size):
        estimate[i] = 0.0
    estimate[0] = y


@singledispatch
def delta_form(model: Any) -> Any:
    """Return an observer's ``model`` in delta form; ``model`` itself if it has none."""
    return model


@delta_form.register
def _of_linear(model: EsoModel) -> DeltaModel:
    return DeltaModel(*_parts(model))


@delta_form.register
def _of_nonlinear(model: NonlinearModel) -> DeltaNonlinearModel:
    return DeltaNonlinearModel(*_parts(model))


@delta_form.register
def _of_cascade(model: CascadeModel) -> DeltaCascadeModel:
    return DeltaCascadeModel(*_parts(model))


@delta_form.register
def _of_delayed(model: DelayedModel) -> DelayedModel:
    inner = delta_form(model.inner)
    return DelayedModel(inner, inner.states, model.samples)


def _parts(model: Any) -> tuple[Any, ...]:
    """Return the fields of the delta form of ``model``; rounding of Φ is that of the double run."""
    difference: Matrix = model.transition - np.eye(model.feed.size)
    return difference, *model[1:], not np.any(np.tril(difference))
