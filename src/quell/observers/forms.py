"""The forms of observers as kernels: linear, cascade, nonlinear, delayed, in delta form.

Generic functions that the controller calls on an observer.

An observer is an ``ESO``. Its ``model`` is a NamedTuple of parameters with ``states``, the length
of the running state ``z``. Entry n of ``z`` is a summand of the estimated f, so a controller may
shift the estimate there; with m extended states f', … follow. A new kind of model registers
``observe``. It registers ``begin`` if its ``z`` does not start with the estimates,
``expected_measurement`` if it lacks ``transition``, ``input`` and ``feed`` for the first entries of
``z``, and ``acting_control`` if u is delayed.

The update of the linear extended state observer.

Each sample, with the exactly sampled extended model ``Φ, Γ_u, Γ_f``::

    predict   z⁻ = Φ z + Γ_u u + Γ_f f_L          u: the control signal that was applied
    correct   z  = z⁻ + L (y − z⁻_1)

The *current* form hands ``z`` to the controller. The *predictor* form hands it ``z⁻``, which knows
y only up to the sample before: one sample of delay more, with the same poles.

A cascade of extended state observers: less noise for the same disturbance rejection.

Łakomy & Madonski, *ISA Transactions* 109, 2021 (arXiv 2004.01483). The first level is slow and the
only one that reads y. Each further level is faster, uses the estimates of f of all levels before
it, and follows the output of the level before instead of y::

    ξ_1' = A ξ_1 + B (b0 u + f_L) + l_1 (y − ξ_1,1)
    ξ_i' = A ξ_i + B (b0 u + f_L + Σ_{j<i} ξ_j,n+1) + l_i (ξ_{i−1},1 − ξ_i,1)        i = 2 … p
    x̂ = (ξ_p,1 … ξ_p,n),     Δf̂ = Σ_j ξ_j,n+1

with bandwidths ``omega_1 < omega_2 = α omega_1 < … < omega_p``. Noise reaches the fast levels only
through the slow ones. Here each level is sampled exactly, with zero-order hold on u, f_L and the f
of the levels before, and corrects as the current form does::

    ξ_i⁻ = Φ ξ_i + Γ_u u + Γ_f (f_L + Σ_{j<i} ξ_j,n+1)
    ξ_i  = ξ_i⁻ + L_i (ξ_{i−1},1 − ξ_i⁻,1),      ξ_0,1 = y

With m extended states ``ξ_i,n+1`` is f, and f', … follow; f of the levels before is held over a
sample as f is in each level's own model, so nothing else changes. The poles of level i lie at
``exp(−omega_i dt)``, because no level feeds back to one before it.

Han's nonlinear extended state observer: a correction that grows slower than its error.

Han, "From PID to active disturbance rejection control", *IEEE Trans. Industrial Electronics* 56,
2009, with his ``fal``::

    fal(e, α, δ) = e / δ^(1−α)         |e| ≤ δ
                   |e|^α sign e        |e| > δ

Han integrates by Euler's method. Here the model is sampled exactly, as for the linear observer, and
only the correction is nonlinear::

    z⁻ = Φ z + Γ_u u + Γ_f f_L,      e = y − z⁻_1,      z_i = z⁻_i + L_i δ^(1−α_i) fal(e, α_i, δ)

Within ±δ the correction is ``L_i e`` for any α: the linear observer of the bandwidth omega_o. With
α = 1 it is linear everywhere. Beyond δ it corrects less, so it responds less to an outlier or to a
wrong initial state, and needs longer to return from a state that is far off: the time grows with a
power of e. Beyond an error from which it would hardly return, 2¹⁶ δ with the powers 1, ½ and ¼, it
starts again at y. Han's gains are ``β_i = L_i δ^(1−α_i) / dt``.

A known input delay: the observer is fed the control signal that reaches the plant.

For a plant ``y^(n)(t) = b0 u(t − τ) + f(t)`` with ``τ = d dt``, an ESO that is fed u(t) takes the
missing response for a disturbance and counteracts it. An ESO that is fed ``u(t − τ)`` compares
signals of the same time (Zhao & Gao, *ISA Transactions* 53, 2014). The control law does not change:
it acts on present estimates, and the delay remains in the loop.

A part of a sample is not represented: the observer is given the nearest whole number of samples and
takes the effect of the rest, at most half a sample, for a disturbance. The plant, analysis and
tuning have the whole delay.

The running state is that of the inner observer, followed by the last d values of u, newest first.

The observers in delta form with compensated sums, for single precision.

An observer adds small increments to its state. In single precision most of their digits are lost
in the sum: at ω_o dt = 0.01 the increments are a hundredth of a state and less. So only the
increments are calculated, and what rounding takes from their sum is carried over to the next
sample (Middleton & Goodwin, *IEEE Trans. Automatic Control* 31, 1986, for the delta form; Kahan,
*Communications of the ACM* 8, 1965, for the sum). With the carry c of each state::

    d   = (Φ − I) z + Γ_u u + Γ_f f_L + c                 predicted increment
    e   = (y − z_1) − d_1
    d   ← d + L e
    z⁺  = z + d,        c⁺ = d − (z⁺ − z)

This is the update of the linear observer, term by term; exactly calculated, c is zero. ``Φ − I`` is
calculated in double precision. The carry makes the state as good as one of twice the digits; what
remains are the rounding of y, and that of d relative to itself.

Coordinates such as x_i/ω_o^(i−1) would not change any of this: rounding is relative.

The running state is (z, c). The compiled double code does not use this form: its rounding is far
below the noise of any sensor, and its figures are published.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.kernels.dispatch import generic, generic_with_default, kernel
from quell.kernels.functions import copysign
from quell.kernels.single import add_with_carry
from quell.kernels.sized import Flag, Size
from quell.types import Matrix, Vector

# ---- Generic functions that the controller calls on an observer ----


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
def begin_with(model: Any, z: Vector, estimate: Vector, y: float, at_f: int, f: float) -> None:
    """Start at rest at y with an estimate of f, in entry ``at_f`` = n; a delayed u goes on."""
    begin(model, z, estimate, y)
    z[at_f] = estimate[at_f] = f


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


# ---- The update of the linear extended state observer ----


class EsoModel(NamedTuple):
    """Parameters of the update for order n, with N = n + m states."""

    transition: Matrix  # Φ (N, N)
    input: Vector  # Γ_u (N,)
    feed: Vector  # Γ_f (N,)
    gain: Vector  # L (N,)
    predictor: Flag  # whether the controller gets z⁻ instead of z

    @property
    def states(self) -> int:
        """Length of the running state."""
        return int(self.gain.size)


@observe.register(EsoModel)
def _observe(
    model: EsoModel, z: Vector, estimate: Vector, y: float, u: float, f_learned: float
) -> None:
    predict_state(model, z, estimate, u, f_learned)
    error = y - estimate[0]
    for i in range(z.size):
        z[i] = estimate[i] + model.gain[i] * error
        if not model.predictor:
            estimate[i] = z[i]


# ---- A cascade of extended state observers ----


class CascadeModel(NamedTuple):
    """Parameters of p levels with N = n + m states each; the state of the first level is first."""

    transition: Matrix  # Φ (N, N)
    input: Vector  # Γ_u (N,)
    feed: Vector  # Γ_f (N,)
    gains: Matrix  # L_i (p, N)
    at_f: Size  # n, the place of f in a level's state

    @property
    def states(self) -> int:
        """Length of the running state."""
        return int(self.gains.size)


@kernel
def add_levels(z: Vector, estimate: Vector, at_f: int, levels: int, stride: int) -> None:
    """Set f and its derivatives in ``estimate`` to their sums over the levels in ``z``."""
    for i in range(at_f, estimate.size):
        total = 0.0
        for level in range(levels):
            total += z[level * stride + i]
        estimate[i] = total


@observe.register(CascadeModel)
def _observe_cascade(
    model: CascadeModel, z: Vector, estimate: Vector, y: float, u: float, f_learned: float
) -> None:
    levels, size = model.gains.shape
    target, f_known = y, f_learned
    for level in range(levels):
        state = z[level * size : (level + 1) * size]
        f_before = state[model.at_f]
        predict_state(model, state, estimate, u, f_known)
        error = target - estimate[0]
        for i in range(size):
            state[i] = estimate[i] + model.gains[level, i] * error
        target = state[0]
        f_known += f_before
    for i in range(model.at_f):
        estimate[i] = z[(levels - 1) * size + i]
    add_levels(z, estimate, model.at_f, levels, size)


@begin.register(CascadeModel)
def _begin(model: CascadeModel, z: Vector, estimate: Vector, y: float) -> None:
    size = estimate.size
    for i in range(z.size):
        z[i] = y if i % size == 0 else 0.0
    for i in range(size):
        estimate[i] = 0.0
    estimate[0] = y


def level_bandwidths(omega_o: float, levels: int, ratio: float) -> list[float]:
    """Return the bandwidths ``omega_1 … omega_p = omega_o`` of the levels [rad/s]."""
    p, ratio = checks.whole("levels", levels, 1, 8), checks.positive("ratio", ratio)
    if ratio <= 1.0:
        raise ValueError(f"ratio = {ratio!r}: must be above 1, so that each level is faster")
    return [omega_o / ratio ** (p - 1 - i) for i in range(p)]


def cascade_model(levels: Sequence[EsoModel], order: int) -> CascadeModel:
    """Return the cascade of ``levels``, which differ only in their gain; the first one reads y."""
    first = levels[0]
    gains = np.array([level.gain for level in levels])
    return CascadeModel(first.transition, first.input, first.feed, gains, order)


# ---- Han's nonlinear extended state observer ----

# At an error e the weakest correction has the slope (δ/|e|)^(1−α) of its linear part, and an
# observer with ω_o dt = 0.2 returns in about as many samples as the inverse of this slope: 2¹² from
# |e| = 2¹⁶ δ with Han's powers of order 2 (benchmarks/hostile_steps.py). Beyond 2⁴⁰ δ no power
# makes it an error of estimation.
_INVERSE_SLOPE, _LARGEST = 12.0, 40.0  # powers of two


class NonlinearModel(NamedTuple):
    """Parameters of the nonlinear observer, with N = n + m states."""

    transition: Matrix  # Φ (N, N)
    input: Vector  # Γ_u (N,)
    feed: Vector  # Γ_f (N,)
    gain: Vector  # L (N,), as for the linear observer
    alpha: Vector  # α (N,), above 0 and at most 1
    delta: float  # δ [y-unit]
    largest_error: float  # beyond it the observer starts again [y-unit]

    @property
    def states(self) -> int:
        """Length of the running state."""
        return int(self.gain.size)


@kernel
def fal(error: float, alpha: float, delta: float) -> float:
    """Return Han's ``fal``: ``|error|^alpha`` with the sign of ``error``, but linear within ±δ.

    The slope of the power alone would be unbounded at zero.
    """
    size = abs(error)
    if size <= delta:
        return float(error / delta ** (1.0 - alpha))
    return copysign(size**alpha, error)


@kernel
def is_lost(model: Any, error: float) -> bool:
    """Return whether ``error`` is too large for an error of estimation."""
    return not abs(error) <= model.largest_error


@kernel
def nonlinear_correction(model: Any, i: int, error: float) -> float:
    """Return ``L_i δ^(1−α_i) fal(e, α_i, δ)``."""
    alpha, delta = model.alpha[i], model.delta
    return float(model.gain[i] * delta ** (1.0 - alpha) * fal(error, alpha, delta))


@observe.register(NonlinearModel)
def _observe_nonlinear(
    model: NonlinearModel, z: Vector, estimate: Vector, y: float, u: float, f_learned: float
) -> None:
    predict_state(model, z, estimate, u, f_learned)
    error = y - estimate[0]
    if is_lost(model, error):
        begin(model, z, estimate, y)
        return
    for i in range(z.size):
        estimate[i] += nonlinear_correction(model, i, error)
        z[i] = estimate[i]


def nonlinear_model(linear: EsoModel, delta: float, alpha: Any) -> NonlinearModel:
    """Return the nonlinear observer that is ``linear`` within ±delta; see ``ESO.nonlinear``."""
    delta, size = checks.positive("delta", delta, "y-unit"), linear.states
    powers = 0.5 ** np.arange(float(size)) if alpha is None else checks.vector("alpha", alpha, size)
    if not np.all((powers > 0.0) & (powers <= 1.0)):
        raise ValueError(f"alpha = {alpha!r}: each entry must be above 0 and at most 1")
    weakest = float(np.min(powers))
    reach = _INVERSE_SLOPE / (1.0 - weakest) if weakest < 1.0 else _LARGEST
    return NonlinearModel(
        *(linear.transition, linear.input, linear.feed, linear.gain),
        *(powers, delta, 2.0 ** min(reach, _LARGEST) * delta),
    )


# ---- A known input delay ----

# The longest delay. All stored values of u are shifted in each sample, so the cost grows with it.
# Chosen by hand; not tuned further. Its main use is to detect a delay that is not in seconds.
_MOST_SAMPLES = 10_000
_PART = "; give the observer the nearer one, the rest of a delay counts as a disturbance"


class DelayedModel(NamedTuple):
    """Parameters of an observer with a delay of u."""

    inner: Any  # parameters of the observer without delay
    size: Size  # length of the running state of ``inner``
    samples: int  # d, at least 1

    @property
    def states(self) -> int:
        """Length of the running state."""
        return self.size + self.samples


@observe.register(DelayedModel)
def _observe_delay(
    model: DelayedModel, z: Vector, estimate: Vector, y: float, u: float, f_learned: float
) -> None:
    last = z.size - 1
    arriving = z[last]
    for i in range(last, model.size, -1):
        z[i] = z[i - 1]
    z[model.size] = u
    observe(model.inner, z[: model.size], estimate, y, arriving, f_learned)


@expected_measurement.register(DelayedModel)
def _expected(model: DelayedModel, z: Vector, u: float, f_learned: float) -> float:
    return expected_measurement(model.inner, z, z[z.size - 1], f_learned)


@begin.register(DelayedModel)
def _begin_delay(model: DelayedModel, z: Vector, estimate: Vector, y: float) -> None:
    for i in range(model.size, z.size):
        z[i] = 0.0
    begin(model.inner, z[: model.size], estimate, y)


@begin_with.register(DelayedModel)
def _begin_delay_with(
    model: DelayedModel, z: Vector, estimate: Vector, y: float, at_f: int, f: float
) -> None:
    begin_with(model.inner, z[: model.size], estimate, y, at_f, f)


@acting_control.register(DelayedModel)
def _acting_control(model: DelayedModel, z: Vector, u: float) -> float:
    return z[z.size - 1]


def delayed_model(model: Any, delay: float, dt: float) -> Any:
    """Return ``model`` with a delay [s] of u; ``model`` itself if the delay is zero."""
    samples = checks.samples("delay", delay, dt, _PART)
    if samples > _MOST_SAMPLES:
        raise ValueError(
            f"delay = {delay!r} s with dt = {dt!r} s: must be at most {_MOST_SAMPLES} samples"
        )
    return model if samples == 0 else DelayedModel(model, model.states, samples)


def without_delay(model: Any) -> Any:
    """Return an observer's model without its delay of u, which affects neither y nor f_L."""
    return model.inner if isinstance(model, DelayedModel) else model


# ---- The observers in delta form with compensated sums, for single precision ----


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
def _observe_delta(
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
def _expected_delta(model: Any, z: Vector, u: float, f_learned: float) -> float:
    size = model.feed.size
    total = z[size] + model.input[0] * u + model.feed[0] * f_learned
    for j in range(size):
        total += model.difference[0, j] * z[j]
    return z[0] + total


@begin.register(DeltaModel)
@begin.register(DeltaNonlinearModel)
@begin.register(DeltaCascadeModel)
def _begin_delta(model: Any, z: Vector, estimate: Vector, y: float) -> None:
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


# ---- The running state of an observer for given estimates ----


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
