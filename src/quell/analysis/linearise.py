"""The linear law that a controller is without limits, with a learner that is frozen or adapts.

The exact linear law in discrete time that a controller is without limits.

It is measured, not derived: without limits a controller is a linear map from its state, r and y to
its next state and u, so unit vectors through its own ``control`` give the matrices, for any form of
observer. The unit is 2⁻⁶⁰: scaling by it is exact for a linear map, and it is small enough for a
map that is linear for small errors only. State entries that do not reach u, or that nothing reaches
(records, filters for learning), are left out. The next sample must have the same law: from a state
of random numbers it must go where the matrices say.

A learner frozen at an instant: its feedback of the state and the control signal.

Around its inputs at that instant, a learner that no longer learns is

    f_L = const + g · (x̂_1 … x̂_n, Δf̂) + h u_before + s u

For features that are the state, u and a constant, this is exact everywhere, with g = θ. For any
other learner (a network, a Gaussian process, polynomials) it holds for small motions: g and h are
central differences of its own ``predict``. The constant, and autonomous features (oscillators), are
a feedforward: they move the loop but do not close it, so no margin depends on them.

A learner with a gate of noise (``learners/base.py``) is taken in motion, with the gate open:
within the noise its feedback of a signal is cut, and the loop is as without it.

A guard multiplies all of it by the learner's authority β. When it clips the output
(``Reason.OUT_OF_BOUNDS``), the true feedback is smaller than the one computed here.

A learner that goes on learning, linearised about its steady state at rest.

What a learner knows of the plant is a feedback, that of a frozen one. At rest it is fixed, because
signals that do not move carry no information on their coefficients (``learners/base.py``).
What goes on adapting is the bias d, and the amplitudes of oscillators at ω_j: with

    q    = g · (x̂_1 … x̂_n, Δf̂) + h u_before + s u,        f_L = q + d + Σ_j Re c_j
    ε    = Δf̂ + f_L^F − q^F − d − Σ_j Re(H_j c_j)
    d   ← d + γ ε,        c_j ← e^{i ω_j dt} (c_j + Γ_j ε)

the learner is linear, and a part of the loop. ^F is the observer's own lag (``learners/base.py``),
H_j its response at ω_j to the sinusoid of the last sample, and c_j turns with the oscillator, which
makes the law the same in each sample. So the bias is an integrator, and each oscillator is a
resonance: a loop with a bias has two integrators, and its margins are those of such a loop
(docs/theory_learners, "Effect of the bias").

The gains γ and Γ are steady ones. Those of a Kalman filter follow from its Riccati equation for the
features that move at rest, the constant 1 and the sinusoids, in units of the density of the noise,

    P ← P − P φ (P φ)ᵀ/(φ·P φ + 1/dt) + Q dt,        gain = P φ/max(φ·P φ + 1/dt, φ·P φ/(λ_m dt))

so they depend on the bandwidths of the design alone, for the bias γ ≈ λ dt. The other learners with
a bias have γ = λ dt. Algorithm 1 learns from Δf̂ alone, the sum of the last ``batch`` samples, and
does not subtract means: at rest at (x̂_1, 0, …, u) each feature that is not zero is one more bias,
so ``d ← d + α (1 + x̂_1² + u²) Σ Δf̂``.

Frequencies that are still being adapted, a guard's changes of authority, and what is learned in
motion are not in it.

A learner that sees all axes (``learners/all_axes.py``) adapts its bias as one of its own axis does.
Its feedback of the states of other axes is not in the law of an axis: ``knows_other_axes`` says
whether there is one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import NO_LIMITS, Controller, control
from quell.controllers.compensated import (
    Compensated,
    CompensatedDesign,
    CompensatedState,
    compensating_part,
)
from quell.controllers.compensator import Compensator
from quell.controllers.law import AdrcState, without_forces
from quell.controllers.linear import LinearLaw
from quell.controllers.memory import named_arrays
from quell.controllers.schedule import is_scheduled
from quell.guard import UnguardedDesign, UnguardedMemory
from quell.kernels.dispatch import kernel
from quell.kernels.functions import cos, sin
from quell.learners.all_axes import OutputDesign, SeeingDesign, SeeingMemory
from quell.learners.base import (
    NoLearner,
    NoLearnerDesign,
    NoLearnerMemory,
    adapt,
    coefficients,
    commit,
    lag_memory,
    lag_push,
    no_coefficients,
    nothing_to_restart,
    predict,
    restart,
)
from quell.learners.batch_gradient import BatchDesign
from quell.learners.kalman import KalmanDesign
from quell.learners.online import OnlineDesign
from quell.learners.regression import LinearDesign
from quell.records.record import first_sample_at
from quell.records.trajectory import Trajectory
from quell.types import Matrix, Vector

# ---- A learner frozen at an instant ----

# Step of the central differences, relative to the size of a signal; their relative error is of the
# order of its square, 1e-8.
_STEP = 1e-4
# Features of time alone, by their names in ``Bias`` and ``Harmonic``.
_FEEDFORWARD = re.compile(r"bias|(sin|cos)\d+")
_USE_STATE = "pass the scenario to loops_over_time, or the final_state of a run that ends then"


class Frozen(NamedTuple):
    """A learner that no longer learns, for a plant of order n; all with its authority."""

    gain: Vector  # g (n + 1,), for x̂_1 … x̂_n and Δf̂
    before: float  # h, for the control signal applied a sample before
    slope: float  # s, for the control signal that is about to be applied
    authority: float = 1.0  # β, by which these are multiplied already


@predict.register(Frozen)
def _predict(
    learner: Frozen, memory: NoLearnerMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    constant = learner.before * u_before
    for i in range(learner.gain.size):
        constant += learner.gain[i] * seen[i]
    return constant, learner.slope


# Everything else is as without a learner.
for _generic in (adapt, commit, restart, coefficients):
    _generic.register(Frozen)(_generic.implementations[NoLearnerDesign])


def frozen(controller: Controller, run: Any = None, t: float | None = None) -> Frozen:
    """Freeze a controller's learner: now, at the end of a run, or at any time of it.

    The gains include the authority that a guard gave it. Raises ``ValueError`` if the record
    lacks the time or the learner's coefficients, and for a learner that calls a Python model, whose
    answer is held between calls.

    Parameters
    ----------
    controller
        an ``ADRC``.
    run
        a ``Trajectory`` of it, or a state of it, for instance ``run.final_state``; by default the
        controller's own state.
    t
        time of the run [s]; by default its end. The coefficients at that time come from the record,
        so the learner's features must be states, u, a constant and sinusoids. Freeze any other
        learner at the end of a run that ends at that time.
    """
    part = compensating_part(controller)
    if part is None:
        raise ValueError(f"controller = {controller!r}: must be an ADRC or a compensator")
    controller = part
    if run is None:
        return _from_state(controller, controller._state)
    if isinstance(run, AdrcState | CompensatedState):
        return _from_state(controller, _learning_state(run))
    if not isinstance(run, Trajectory):
        raise ValueError(f"run = {run!r}: must be a run of the controller, or a state of it")
    if t is None and run.final_state is not None:
        return _from_state(controller, _learning_state(run.final_state))
    return _from_record(controller, run, run.ended if t is None else checks.finite("t", t))


def _learning_state(state: Any) -> AdrcState:
    """Return the state of observer, learner and guard within that of a controller."""
    return state.compensator if isinstance(state, CompensatedState) else state


def _from_record(controller: Compensator, run: Trajectory, t: float) -> Frozen:
    row = first_sample_at(t, run.every * run.dt, len(run))
    if not (t >= 0.0 and row < len(run)):
        raise ValueError(f"t = {t!r}: must be a time of the record, from 0 to {run.t[-1]:g} s")
    order = controller.observer.order
    if tuple(run.features) != tuple(controller.features):
        rule = f"must be a run of this controller, which has {controller.features}"
        raise ValueError(f"run has the features {run.features}: {rule}")
    if not (run.features or isinstance(controller.learner, NoLearner)):
        name = type(controller.learner).__name__
        raise ValueError(f"t = {t!r}: {name} has no coefficients to record; {_USE_STATE}")
    gain, slope = np.zeros(order + 1), 0.0
    states = {f"x{i + 1}": i for i in range(order)}
    for name, theta in zip(run.features, run["theta"][row] if run.features else (), strict=True):
        if name in states:
            gain[states[name]] += theta
        elif name == "u":
            slope += float(theta)
        elif not _FEEDFORWARD.fullmatch(name):
            raise ValueError(f"t = {t!r}: the feature {name!r} is not linear; {_USE_STATE}")
    authority = float(run["authority"][row]) if "authority" in run.names else 1.0
    return _with_authority(controller, gain, 0.0, slope, authority)


def _from_state(controller: Compensator, state: Any) -> Frozen:
    if hasattr(controller.learner, "external_fields"):
        raise ValueError(
            f"learner = {type(controller.learner).__name__}: a Python model is called once a "
            "period, so it has no gain at an instant; analyse the loop without it"
        )
    learner, memory = controller.parameters.learner, copy_state(state.learner)
    _open_gate(memory)
    known = controller.read(state)
    seen, u = np.append(known.x, known.f_residual), known.u
    sizes = _signal_sizes(controller, memory, seen, u)

    def output(seen: Vector, before: float) -> float:
        constant, slope = predict(learner, copy_state(memory), seen, before)
        return constant + slope * u

    def derivative(i: int) -> float:
        step = _STEP * sizes[i]
        moved = [np.append(seen, u) for _ in range(2)]
        moved[0][i] += step
        moved[1][i] -= step
        difference = output(moved[0][:-1], moved[0][-1]) - output(moved[1][:-1], moved[1][-1])
        return difference / float(moved[0][i] - moved[1][i])

    gains = [derivative(i) for i in range(seen.size + 1)]
    slope = float(predict(learner, copy_state(memory), seen, u)[1])
    return _with_authority(controller, np.array(gains[:-1]), gains[-1], slope, known.authority)


def _open_gate(memory: Any) -> None:
    """Let all signals of a learner's memory move."""
    own = memory.inner if isinstance(memory, SeeingMemory) else memory
    if hasattr(own, "gate"):
        own.gate.variance[:] = np.inf


def knows_other_axes(controller: Compensator) -> bool:
    """Whether a learner that sees all axes has learned what ``linear_law`` does not have.

    That is a feedback of states of other axes; of an output of a learner that all axes share it is
    one of any state.
    """
    learner, memory = controller.parameters.learner, copy_state(controller._state.learner)
    if isinstance(learner, OutputDesign):
        return bool(np.any(memory.theta != 0.0))
    if not isinstance(learner, SeeingDesign):
        return False
    _open_gate(memory)
    known = controller.read(controller._state)
    seen = np.append(known.x, known.f_residual)

    def output(now: Vector) -> tuple[float, float]:
        memory.now[:] = now
        return predict(learner, copy_state(memory), seen, known.u)

    # Numbers without a pattern: a product of states is not zero at them. Own states are written
    # over them.
    moved = np.random.default_rng(0).uniform(0.5, 1.0, memory.now.size)
    return output(memory.now.copy()) != output(moved)


def _with_authority(
    controller: Compensator, gain: Vector, before: float, slope: float, authority: float
) -> Frozen:
    """Return β times all of it; a slope outside of the guard's interval acts on the u before."""
    if not (np.all(np.isfinite(gain)) and math.isfinite(before) and math.isfinite(slope)):
        raise ValueError("learner: its output is not finite at this instant")
    gain, before, slope = authority * gain, authority * before, authority * slope
    guard = controller.parameters.guard
    guarded = not isinstance(guard, UnguardedDesign)
    if guarded and not guard.least_slope <= slope <= guard.largest_slope:
        before, slope = before + slope, 0.0
    return Frozen(gain, float(before), float(slope), authority)


def _signal_sizes(controller: Compensator, memory: Any, seen: Vector, u: float) -> Vector:
    """Return the sizes of x̂_1 … x̂_n, Δf̂ and u: the learner's scales, or from present values."""
    scale = np.asarray(getattr(memory, "scale", ()))
    # A scale is at its floor, 1e-100 (``features.scaling``), until its signal was seen.
    if scale.shape == (seen.size + 1,) and np.all(scale > 1e-90):
        return np.append(scale[:-2], scale[[-1, -2]])
    ladder = float(controller.omega_c) ** np.arange(seen.size)
    length = float(np.max(np.abs(seen) / ladder)) or 1.0
    return np.append(length * ladder, abs(u) or length * ladder[-1] / abs(controller.observer.b0))


def copy_state(state: Any) -> Any:
    """Return a copy of a nested NamedTuple of arrays."""
    return type(state)(*map(copy_state, state)) if isinstance(state, tuple) else np.array(state)


# ---- A learner that goes on learning, linearised about its steady state at rest ----

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
def _predict_adapting_learner(
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
    part = compensating_part(controller)
    assert part is not None
    controller = part
    design = controller.parameters.learner
    state = controller._state if run is None else getattr(run, "final_state", run)
    memory = (controller.initial_state() if state is None else _learning_state(state)).learner
    if isinstance(design, SeeingDesign):
        design, memory = design.inner, memory.inner
    rates = adaptation_of(design, memory)
    lag: Any = getattr(design, "lag", controller.parameters.lag)
    angles = rates.omega * controller.dt
    seen = lag_response(lag, angles) * np.exp(-1j * angles)
    seen_parts = np.column_stack([seen.real, seen.imag])
    return Adapting(known, rates, lag, float(controller.dt), seen_parts)


def within_noise(controller: Controller, at: Any = None) -> Adapting | None:
    """Return a learner as motions meet it that its gate takes for noise; None if it is the same.

    None of its signals moves then, so what it has learned of the state and u is not fed back; its
    bias adapts as in motion. ``at`` is that of ``linear_law``; a ``Frozen`` learner has no gate.
    """
    part = compensating_part(controller)
    if part is None or isinstance(at, Frozen):
        return None
    memory: Any = part._state.learner
    if not hasattr(memory.inner if isinstance(memory, SeeingMemory) else memory, "gate"):
        return None
    found = at if isinstance(at, Adapting) else adapting(controller, at)
    known = found.known
    if not (np.any(known.gain) or known.before or known.slope):
        return None
    nothing = Frozen(np.zeros_like(known.gain), 0.0, 0.0, known.authority)
    return found._replace(known=nothing)


def adaptation_memory(learner: Adapting) -> AdaptingMemory:
    """Return its state with a bias and oscillators of zero."""
    rates = learner.rates
    pairs, errors = np.zeros((rates.omega.size, 2)), np.zeros(rates.window - 1)
    return AdaptingMemory(np.zeros(1), pairs, errors, lag_memory(learner.lag, 1), np.zeros(1))


def adaptation_of(design: Any, memory: Any) -> Adaptation:
    """Return the steady gains of a learner's parameters, with its frequencies in ``memory``."""
    if isinstance(design, SeeingDesign):
        return adaptation_of(design.inner, memory.inner)
    if isinstance(design, OutputDesign):
        return NOTHING._replace(level=design.bias_gain)
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
    if isinstance(design, SeeingDesign):
        return is_known(design.inner)
    kinds = (KalmanDesign, LinearDesign, OnlineDesign, OutputDesign, BatchDesign, NoLearnerDesign)
    return isinstance(design, (*kinds, Frozen))


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
        level=level, omega=angular[order][firsts], drive=np.column_stack([merged.real, merged.imag])
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


# ---- The exact linear law in discrete time that a controller is without limits ----

_UNIT = 2.0**-60
# Share of its terms by which a prediction may miss: far above rounding errors, far below any change
# of a law that matters. Chosen by hand.
_SAME = 1e-9


def linear_law(controller: Controller, at: Any = None) -> LinearLaw:
    """Return the linear law of a controller, its learner as it adapts at rest.

    It equals the controller without limits, except for what the learner learns in motion, and
    except for a first sample with y ≠ 0, at which an ADRC takes the measurement as its state.
    Raises ``ValueError`` for a controller without a linear law, or with one that changes from
    sample to sample.

    Parameters
    ----------
    controller
        an ``ADRC``, a ``Compensator`` (r is then u_0), a ``Compensated`` controller, or a linear
        controller, whose own law is returned.
    at
        instant at which the learner is looked at: an ``Adapting`` or a ``Frozen``, a run or a state
        of the controller (its end); by default the present state.
    """
    if at is not None and hasattr(controller, "law_at"):
        return controller.law_at(getattr(at, "final_state", at))
    if hasattr(controller, "law"):
        return controller.law
    if not isinstance(controller, Compensator | Compensated):
        raise ValueError(
            f"controller = {controller!r}: must be an ADRC, a compensator or a linear controller"
        )
    if is_scheduled(controller):
        raise ValueError(
            f"controller = {controller!r}: its gains follow a schedule; take it at fixed signals, "
            "controller.at(…)"
        )
    learner = at if isinstance(at, Frozen | Adapting) else adapting(controller, at)
    design, state = _linear_part(controller, learner)
    control(design, state, 0.0, 0.0)
    measured = _measured(_Sample(design, state))
    law = measured.law()
    if not all(np.all(np.isfinite(part)) for part in law):
        raise ValueError(f"controller = {controller!r}: b0 + ∂f_L/∂u is zero with this learner")
    control(design, state, 0.0, 0.0)
    if not measured.predicts(_Sample(design, state)):
        raise ValueError(f"controller = {controller!r}: its law changes from sample to sample")
    return law


def _linear_part(controller: Compensator | Compensated, learner: Any) -> tuple[Any, Any]:
    """Return parameters and state of a controller without limits and guard, with ``learner``."""
    nothing = np.zeros(0)
    if isinstance(controller, Compensated):
        inner = _linear_part(controller.compensator, learner)
        parameters, before = controller.parameters, controller.initial_state()
        return parameters._replace(compensator=inner[0]), before._replace(compensator=inner[1])
    given = controller.parameters
    design = given._replace(
        learner=learner,
        learns=not isinstance(learner, NoLearnerDesign),
        guard=UnguardedDesign(),
        guarded=False,
        limits=NO_LIMITS,
        feedforward=without_forces(given.feedforward),
    )
    learned: Any = NoLearnerMemory(nothing)
    if isinstance(learner, Adapting):
        learned = adaptation_memory(learner)
    state = controller.initial_state()._replace(learner=learned, guard=UnguardedMemory(nothing))
    return design, state


def _between(design: Any, u: float) -> Any:
    """Return parameters whose limits leave only ``u``."""
    limits = NO_LIMITS._replace(low=u, high=u)
    if isinstance(design, CompensatedDesign):
        return design._replace(compensator=design.compensator._replace(limits=limits))
    return design._replace(limits=limits)


class _Sample:
    """One sample of a design from states near ``origin``, where no limit and no flag acts.

    Entries of the origin that are not zero are flags and the like; the others are the state x.
    """

    def __init__(self, design: Any, origin: Any) -> None:
        self._design, self._state = design, copy_state(origin)
        self._origin, self._arrays = named_arrays(origin), named_arrays(self._state)
        self._free = {name: array == 0.0 for name, array in self._origin.items()}
        entries = ((name, at) for name, free in self._free.items() for at in np.argwhere(free))
        self._places = [(name, tuple(at)) for name, at in entries]
        self.size = len(self._places)

    def __call__(
        self, x: Mapping[int, float], r: float = 0.0, y: float = 0.0, u: float | None = None
    ) -> tuple[Vector, float]:
        """Return the next state and u, all in units; limits fix u if it is given."""
        for name, array in self._arrays.items():
            array[...] = self._origin[name]
        for i, value in x.items():
            name, at = self._places[i]
            self._arrays[name][at] = value * _UNIT
        design = self._design
        if u is not None:
            design = _between(design, u * _UNIT)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u = control(design, self._state, r * _UNIT, y * _UNIT)
        moved = np.concatenate([self._arrays[name][free] for name, free in self._free.items()])
        return moved / _UNIT, u / _UNIT


class _Measured(NamedTuple):
    """Matrices of the entries ``at`` of a state, all that r, y and u reach."""

    at: NDArray[np.intp]
    A: Matrix
    B: Matrix  # from r, y and u, in columns
    C: Vector
    D: Vector  # from r, y and u

    def reaching(self) -> NDArray[np.bool_]:
        """Return which entries reach u."""
        found: NDArray[np.bool_] = self.C != 0.0
        while True:
            more = found | np.any(self.A[found] != 0.0, axis=0)
            if np.array_equal(more, found):
                return found
            found = more

    def law(self) -> LinearLaw:
        """Return the law of the entries that reach u."""
        kept = self.reaching()
        A = np.ascontiguousarray(self.A[np.ix_(kept, kept)])
        B_r, B_y, B_u = (np.ascontiguousarray(column) for column in self.B[kept].T)
        return LinearLaw(A, B_r, B_y, B_u, self.C[kept], float(self.D[0]), float(self.D[1]))

    def predicts(self, sample: _Sample) -> bool:
        """Return whether a sample from a state of random numbers goes where the law says."""
        inputs = np.random.default_rng(0).uniform(0.5, 1.0, self.at.size + 3)
        state, (r, y, u) = dict(zip(self.at.tolist(), inputs, strict=False)), inputs[-3:]
        moved, wished = sample(state, r, y, u)[0][self.at], sample(state, r, y)[1]
        kept = self.reaching()
        rows = np.vstack([np.hstack([self.A, self.B])[kept], [*self.C, *self.D]])
        missed = np.abs(np.append(moved[kept], wished) - rows @ inputs)
        return bool(np.all(missed <= _SAME * (np.abs(rows) @ inputs)))


def _measured(sample: _Sample) -> _Measured:
    """Measure one entry after the other, with u fixed at zero, and without limits for u itself."""
    from_r, from_y, from_u = sample({}, r=1.0, u=0.0), sample({}, y=1.0, u=0.0), sample({}, u=1.0)
    D = np.array([sample({}, r=1.0)[1], sample({}, y=1.0)[1], 0.0])
    B = np.array([from_r[0], from_y[0], from_u[0]]).T
    columns: dict[int, Vector] = {}
    new = np.flatnonzero(np.any(B != 0.0, axis=1))
    while new.size:
        columns |= {i: sample({i: 1.0}, u=0.0)[0] for i in new.tolist()}
        reached = np.any([column != 0.0 for column in columns.values()], axis=0)
        new = np.setdiff1d(np.flatnonzero(reached), [*columns])
    at = np.array(sorted(columns), dtype=np.intp)
    A = np.array([columns[i][at] for i in at.tolist()]).reshape(at.size, at.size).T
    C = np.array([sample({i: 1.0})[1] for i in at.tolist()])
    return _Measured(at, A, B[at], C, D)
