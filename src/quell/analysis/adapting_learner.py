"""A learner that goes on learning, linearised about its steady state at rest.

What a learner knows of the plant is a feedback, ``frozen_learner.py``. At rest it is fixed, because
signals that do not move carry no information on their coefficients (``learners/noise_gate.py``).
What goes on adapting is the bias d, and the amplitudes of oscillators at ω_j: with

    q    = g · (x̂_1 … x̂_n, Δf̂) + h u_before + s u,        f_L = q + d + Σ_j Re c_j
    ε    = Δf̂ + f_L^F − q^F − d − Σ_j Re(H_j c_j)
    d   ← d + γ ε,        c_j ← e^{i ω_j dt} (c_j + Γ_j ε)

the learner is linear, and a part of the loop. ^F is the observer's own lag (``learners/lag.py``),
H_j its response at ω_j to the sinusoid of the last sample, and c_j turns with the oscillator, which
makes the law the same in each sample. So the bias is an integrator, and each oscillator is a
resonance: a loop with a bias has two integrators, and its margins are those of such a loop
(docs/theory, "What the bias is").

The gains γ and Γ are steady ones. Those of a Kalman filter follow from its Riccati equation for the
features that move at rest, the constant 1 and the sinusoids, in units of the density of the noise,

    P ← P − P φ (P φ)ᵀ/(φ·P φ + 1/dt) + Q dt,        gain = P φ/max(φ·P φ + 1/dt, φ·P φ/(λ_m dt))

so they depend on the bandwidths of the design alone, for the bias γ ≈ λ dt. The other learners with
a bias have γ = λ dt. Algorithm 1 learns from Δf̂ alone, the sum of the last ``batch`` samples, and
does not subtract means: at rest at (x̂_1, 0, …, u) each feature that is not zero is one more bias,
so ``d ← d + α (1 + x̂_1² + u²) Σ Δf̂``.

Frequencies that are still being adapted, a guard's changes of authority, and what is learned in
motion are not in it.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.analysis.frozen_learner import Frozen, frozen
from quell.controllers.adrc.adrc import ADRC
from quell.controllers.base import Controller
from quell.kernels.dispatch import kernel
from quell.kernels.functions import cos, sin
from quell.learners.base import (
    NoLearnerDesign,
    adapt,
    coefficients,
    commit,
    no_coefficients,
    nothing_to_restart,
    predict,
    restart,
)
from quell.learners.gradient.batch_gradient import BatchDesign
from quell.learners.kalman.kernels import KalmanDesign
from quell.learners.lag import lag_memory, lag_push
from quell.learners.online.learner import OnlineDesign
from quell.learners.regression.kernels import LinearDesign
from quell.types import Matrix, Vector

# With oscillators the Riccati equation is followed for so many times the slowest adaptation, in at
# most so many steps; then gains are averaged over the last part of it, some turns of each one.
_SETTLING, _MOST_STEPS, _AVERAGED = 12.0, 200_000, 0.25
# Frequencies that differ by less than this share are one: apart they would turn once in a million.
_EQUAL = 1e-6


class Adaptation(NamedTuple):
    """Steady gains of what a learner goes on adapting at rest."""

    level: float  # γ of the bias, for one sample
    window: int  # samples whose errors are summed: 1 unless the learner has a batch
    compensated: bool  # whether the error is that of f_plain; else Δf̂
    omega: Vector  # ω_j of the oscillators [rad/s] (m,)
    drive: Matrix  # Re Γ_j and Im Γ_j (m, 2)

    @property
    def acts(self) -> bool:
        """Whether anything is adapted at rest."""
        return self.level > 0.0 or self.omega.size > 0


NOTHING = Adaptation(0.0, 1, True, np.zeros(0), np.zeros((0, 2)))
"""Of a learner that does not adapt at rest."""


class Adapting(NamedTuple):
    """A learner that adapts its bias and its oscillators, for a plant of order n."""

    known: Frozen  # g, h and s, with the authority of a guard, which multiplies d and c_j, too
    rates: Adaptation
    lag: Any
    dt: float
    seen: Matrix  # Re and Im of H_j e^{−i ω_j dt} (m, 2): what c_j of this sample has of the last


class AdaptingMemory(NamedTuple):
    """State of ``Adapting``."""

    level: Vector  # d (1,)
    pairs: Matrix  # Re c_j and Im c_j (m, 2)
    errors: Vector  # the last errors, of a batch (window − 1,)
    chain: Matrix  # lag filter of q (1, …)
    known: Vector  # q^F (1,)


@adapt.register(Adapting)
def _adapt(
    learner: Adapting,
    memory: AdaptingMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    rates, pairs, errors = learner.rates, memory.pairs, memory.errors
    error = seen[learner.known.gain.size - 1]
    if rates.compensated:
        error = f_plain - memory.known[0] - memory.level[0]
        for j in range(rates.omega.size):
            error -= learner.seen[j, 0] * pairs[j, 0] - learner.seen[j, 1] * pairs[j, 1]
    total = error
    for i in range(errors.size):
        total += errors[i]
    for i in range(errors.size - 1, 0, -1):
        errors[i] = errors[i - 1]
    if errors.size > 0:
        errors[0] = error
    memory.level[0] += rates.level * total
    for j in range(rates.omega.size):
        pairs[j, 0] += rates.drive[j, 0] * error
        pairs[j, 1] += rates.drive[j, 1] * error


@kernel
def _adapted(memory: AdaptingMemory) -> float:
    """Return d + Σ Re c_j."""
    total = memory.level[0]
    for j in range(memory.pairs.shape[0]):
        total += memory.pairs[j, 0]
    return total


@predict.register(Adapting)
def _predict(
    learner: Adapting, memory: AdaptingMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    known = learner.known
    constant = known.authority * _adapted(memory) + known.before * u_before
    for i in range(known.gain.size):
        constant += known.gain[i] * seen[i]
    return constant, known.slope


@commit.register(Adapting)
def _commit(
    learner: Adapting, memory: AdaptingMemory, seen: Vector, u: float, f_learned: float
) -> None:
    # What is known of the plant is all of the output but the level and the oscillators. A guard's
    # authority is part of it: a learner estimates q, and its output is β q.
    authority, omega = learner.known.authority, learner.rates.omega
    if authority > 0.0:
        known = (f_learned - authority * _adapted(memory)) / authority
        memory.known[0] = lag_push(learner.lag, memory.chain, 0, known)
    for j in range(omega.size):
        angle = omega[j] * learner.dt
        c, s = cos(angle), sin(angle)
        real, imaginary = memory.pairs[j, 0], memory.pairs[j, 1]
        memory.pairs[j, 0] = c * real - s * imaginary
        memory.pairs[j, 1] = s * real + c * imaginary


restart.register(Adapting)(nothing_to_restart)
coefficients.register(Adapting)(no_coefficients)


def adapting(controller: Controller, run: Any = None, t: float | None = None) -> Adapting:
    """Return a controller's learner as it adapts at rest: now, or as a run left it.

    Raises ``ValueError`` as ``frozen`` does.

    Parameters
    ----------
    controller, run, t
        as for ``frozen``. Frequencies of oscillators are those at the end of the run, or the
        controller's own.
    """
    known = frozen(controller, run, t)
    assert isinstance(controller, ADRC)
    design = controller.parameters.learner
    state = controller._state if run is None else getattr(run, "final_state", run)
    memory = controller.initial_state().learner if state is None else state.learner
    rates = adaptation_of(design, memory)
    lag: Any = getattr(design, "lag", controller.parameters.lag)
    angles = rates.omega * controller.dt
    seen = lag_response(lag, angles) * np.exp(-1j * angles)
    seen_parts = np.column_stack([seen.real, seen.imag])
    return Adapting(known, rates, lag, float(controller.dt), seen_parts)


def adaptation_memory(learner: Adapting) -> AdaptingMemory:
    """Return its state with a bias and oscillators of zero."""
    rates = learner.rates
    pairs, errors = np.zeros((rates.omega.size, 2)), np.zeros(rates.window - 1)
    return AdaptingMemory(np.zeros(1), pairs, errors, lag_memory(learner.lag, 1), np.zeros(1))


def adaptation_of(design: Any, memory: Any) -> Adaptation:
    """Return the steady gains of a learner's parameters, with its frequencies in ``memory``."""
    if isinstance(design, KalmanDesign):
        return _of_kalman(design, memory.omega)
    if isinstance(design, LinearDesign | OnlineDesign):
        return NOTHING._replace(level=design.inputs.bias_gain)
    if isinstance(design, BatchDesign):
        constant = memory.current[[0, design.order] if design.with_u else [0]]
        level = design.rate * (1.0 + float(constant @ constant))
        return NOTHING._replace(level=level, window=design.batch, compensated=False)
    return NOTHING


def is_known(design: Any) -> bool:
    """Whether the adaptation of a learner's parameters is known here."""
    kinds = (KalmanDesign, LinearDesign, OnlineDesign, BatchDesign, NoLearnerDesign, Frozen)
    return isinstance(design, kinds)


def lag_response(lag: Any, angles: Vector) -> Any:
    """Return what a lag filter answers to ``e^{i k angle}``, as a multiple of the last input."""
    z = np.exp(1j * np.asarray(angles))
    if hasattr(lag, "pole"):
        stage = lag.rise / (z - lag.pole)
        # The first lag has the newest input, the others what the one before had a sample earlier.
        total = sum(tap * z * stage ** (j + 1) for j, tap in enumerate(lag.taps.tolist()))
        return total / z if lag.predictor else total
    size = lag.taps.size
    rows = [lag.taps @ np.linalg.solve(one * np.eye(size) - lag.transition, lag.input) for one in z]
    return lag.through + np.array(rows, dtype=np.complex128)


def _of_kalman(design: KalmanDesign, omega: Vector) -> Adaptation:
    """Return the steady gains by the Riccati equation of the features that move at rest."""
    orders, dt = design.oscillators.orders, design.dt
    angular = np.ravel(omega[:, None] * orders[None, :])
    first = design.oscillators.first
    at = [design.states] * design.bias + list(range(first, first + 2 * angular.size))
    walk = design.walk[at]
    if not at or not np.any(walk > 0.0):
        return NOTHING
    if angular.size == 0:  # the scalar equation: P² = Q dt (P + 1/dt)
        Q = float(walk[0]) * dt
        P = 0.5 * (Q + math.sqrt(Q * (Q + 4.0 / dt)))
        return NOTHING._replace(level=min(P / (P + 1.0 / dt), design.fastest * dt))
    shift = lag_response(design.lag, angular * dt)
    given = (tuple(each.tolist()) for each in (walk, angular, shift))
    level, drive = _averaged_gains(dt, design.fastest, *given)
    # Two oscillators at one frequency, as at a limit, are one: their difference shows nowhere.
    order = np.argsort(angular)
    apart = np.diff(angular[order]) > _EQUAL * angular[order][1:]
    firsts = np.flatnonzero(np.append(True, apart))
    merged = np.add.reduceat(drive[order], firsts)
    return NOTHING._replace(
        level=level,
        omega=angular[order][firsts],
        drive=np.column_stack([merged.real, merged.imag]),
    )


@lru_cache(maxsize=64)  # many instants of a run have the same
def _averaged_gains(
    dt: float,
    fastest: float,
    walk: tuple[float, ...],
    angular: tuple[float, ...],
    shift: tuple[complex, ...],
) -> tuple[float, NDArray[np.complex128]]:
    """Return γ, zero without a bias, and Γ_j (m,), averaged over turns of the oscillators.

    ``walk`` has a number for the bias, if there is one, and two for each oscillator of ``angular``;
    ``shift`` are their H_j.
    """
    bias, omega, H = len(walk) % 2, np.array(angular), np.array(shift)
    slowest = math.sqrt(min(each for each in walk if each > 0.0))
    slowest = min(slowest, min(angular) * slowest / fastest)
    samples = math.ceil(_SETTLING / (slowest * dt))
    # The equation is one of densities: a longer step gives the gain of as many samples.
    stride = math.ceil(samples / _MOST_STEPS)
    step, steps = stride * dt, math.ceil(samples / stride)
    P, level, drive = np.zeros((len(walk), len(walk))), 0.0, np.zeros(omega.size, np.complex128)
    last = range(math.ceil((1.0 - _AVERAGED) * steps), steps)
    drift = np.diag(np.array(walk) * step)
    # An oscillator has turned by one sample when its error is seen.
    ahead = np.exp(1j * omega * dt)
    for k in range(steps):
        turned = np.exp(1j * omega * step * k)
        shown = H * turned
        phi = np.append(np.ones(bias), np.column_stack([shown.imag, shown.real]).ravel())
        of_phi = P @ phi
        spread = float(phi @ of_phi)
        gain = of_phi / max(spread + 1.0 / step, spread / (fastest * step))
        P += drift - np.outer(gain, of_phi)
        if k in last:
            level += float(gain[0]) if bias else 0.0
            pairs = gain[bias:].reshape(-1, 2)
            drive += (pairs[:, 1] - 1j * pairs[:, 0]) * turned * ahead
    count = stride * len(last)
    return level / count, drive / count
