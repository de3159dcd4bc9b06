"""Learners of several axes: each sees the states of all, or one serves all of them.

*The signals of other axes.* In a sample the axes run one after another, so a learner has x̂ of its
own axis as it is now, and of the others what follows from the sample before,

    x̂_j ← x̂_j + dt x̂_{j+1},      x̂_n ← x̂_n + dt (v + f̂ − a·x̂)

with the v that was applied. That is what their observers expect before they see the new y. It
learns from the x̂ of the same sample, so its regression has no delay. Each signal has the threshold
of noise of its own axis (``NoiseGateOfAxes``), and derivatives have a least scale by that of their
own position (``ScalingOfAxes``). All else is the learner's own: any learner on features serves.

*One learner for all axes* (``SharedLearner``) is least squares with several outputs: the features
of all axes are the same numbers, so features, filters, P and gain are computed once, and

    θ_i ← θ_i + g ε_i,        g = Pφ^F/(R (1 + ζ))

for each axis i costs as little as NLMS (Ljung & Söderström, *Theory and Practice of Recursive
Identification*, MIT Press 1983, section 3: the gain does not depend on the output). For n axes with
the same p features these are the θ of n learners of their own, in p² + n p operations in place of
n p². It needs one lag filter, so observers of one order, bandwidth and form. Where features differ
from axis to axis, or bandwidths, each axis needs its own learner. Each axis has its own scale of f,
its own bias and its own guard; a learner that the guard cuts off in one axis goes on in the others.
Where θ of one axis has to be forgotten, those of all are, with scales, filters and P: the samples
that have spoiled it are in the features of all.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.features.all_axes import asks_for_inputs, bound, sees_all_axes
from quell.features.base import covering, least_scale, scaling, update_scale
from quell.kernels.dispatch import generic, generic_with_default, is_finite, kernel
from quell.kernels.functions import log2
from quell.kernels.sized import Flag, Scalars, Size, Work, clear
from quell.learners.base import (
    NOISE_DEVIATIONS,
    FeatureLearner,
    NoiseGateMemory,
    adapt,
    coefficients,
    commit,
    follow_moments,
    follow_noise,
    forget,
    group_delay,
    grown,
    is_moving,
    lag_of,
    learner_flags,
    meaning,
    noise_gate,
    predict,
    restart,
    startup_samples,
    update_gate,
    write_features,
)
from quell.learners.regression import (
    LEAST_CONFIDENCE,
    MOST_SAMPLES,
    Linear,
    LinearDesign,
    LinearMemory,
    NlmsRule,
    rescale,
)
from quell.learners.rls import RlsMemory, RlsRule, least_squares_gain
from quell.observers.eso import ESO
from quell.types import Vector

# ---- Scales and thresholds of noise of signals that are of several axes ----


class ScalingOfAxes(NamedTuple):
    """Parameters for N signals, v and f."""

    floors: Vector  # least scales (N + 2,) over that of x_1 of the same axis
    fixed: Flag
    base: NDArray[np.int64]  # (N + 2,): index of that x_1


@update_scale.register(ScalingOfAxes)
def _update_scale(
    scaling: ScalingOfAxes, scale: Vector, estimate: Vector, u: float, f: float, powers: bool
) -> None:
    if scaling.fixed:
        return
    signals = scale.size - 2
    for i in range(scale.size):
        size = abs(estimate[i]) if i < signals else (abs(u) if i == signals else abs(f))
        size = max(size, scaling.floors[i] * scale[scaling.base[i]], least_scale(scale[i]))
        scale[i] = covering(scale[i], size, powers)


class NoiseGateOfAxes(NamedTuple):
    """Parameters for N signals of several axes and v of the own one.

    y and y − x̂_1 of the axes stand behind the signals in ``estimates``, those of the own axis are
    given as for ``NoiseGate``.
    """

    threshold: Vector  # (N + 1,), in units of the variance of y − x̂_1 of the signal's axis
    forget: float
    f_noise: float  # of the own axis; as in NoiseGate
    power: float
    sources: Size  # axes with a y of their own, the own one included
    states: Size  # of the N signals those that are states, not v
    with_own: Flag  # whether there is an own axis, which is source 0
    source: NDArray[np.int64]  # (N + 1,): of each signal
    first: NDArray[np.int64]  # (sources,): index of x_1 of each source


@is_moving.register(NoiseGateOfAxes)
def _is_moving(gate: NoiseGateOfAxes, memory: NoiseGateMemory, i: int) -> bool:
    at = 2 * gate.source[i]
    return memory.variance[i] * memory.noise[at + 1] > gate.threshold[i] * memory.noise[at]


@update_gate.register(NoiseGateOfAxes)
def _update_gate(
    gate: NoiseGateOfAxes, memory: NoiseGateMemory, estimates: Vector, y: float, u: float
) -> bool:
    signals = memory.variance.size - 1
    own = 1 if gate.with_own else 0
    behind = signals + 1
    for k in range(gate.sources):
        measured, error = y, y - estimates[0]
        if k >= own:
            measured = estimates[behind + k - own]
            error = estimates[behind + gate.sources - own + k - own]
        memory.noise[2 * k] = follow_noise(memory.noise[2 * k], gate.forget, measured, error)
        memory.noise[2 * k + 1] = grown(memory.noise[2 * k + 1], gate.forget)
    moves = False
    for i in range(signals + 1):
        value = estimates[i] if i < signals else u
        follow_moments(memory.mean, memory.variance, i, value, gate.forget)
        moves = moves or (i < gate.states and is_moving(gate, memory, i))
    return moves


@dataclass(frozen=True)
class AxesView:
    """What is known of the axes where a learner is designed."""

    names: tuple[str, ...]
    observers: tuple[ESO, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the states of all axes."""
        return tuple(
            f"{name}.x{j + 1}"
            for name, observer in zip(self.names, self.observers, strict=True)
            for j in range(observer.order)
        )

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of v of all axes."""
        return tuple(f"{name}.v" for name in self.names)


class SignalsOfAxes:
    """An observer of an axis for the design of a learner that has the signals of all.

    Its ``order`` is the number of signals; all else is the observer's.
    """

    def __init__(self, observer: ESO, view: AxesView, inputs: bool, with_own: bool) -> None:
        self.own, self.view, self.inputs, self.with_own = observer, view, inputs, with_own
        states = sum(each.order for each in view.observers)
        self.before = observer.order if with_own else 0
        self.states = self.before + states
        self.order = self.states + (len(view.observers) if inputs else 0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.own, name)

    @property
    def parts(self) -> list[ESO]:
        """The observers whose states are the signals."""
        return [self.own, *self.view.observers] if self.with_own else [*self.view.observers]

    @property
    def first(self) -> list[int]:
        """Index of x_1 of each part."""
        return np.cumsum([0, *(each.order for each in self.parts[:-1])]).tolist()


@scaling.register(SignalsOfAxes)
def _scaling(observer: SignalsOfAxes, frequency: float, fixed: bool) -> ScalingOfAxes:
    parts, more = observer.parts, observer.order - observer.states
    floors = [scaling(part, frequency, fixed).floors[: part.order] for part in parts]
    bases = [np.full(part.order, at) for part, at in zip(parts, observer.first, strict=True)]
    return ScalingOfAxes(
        np.concatenate([*floors, np.zeros(more + 2)]),
        fixed,
        np.concatenate([*bases, np.zeros(more + 2)]).astype(np.int64),
    )


@noise_gate.register(SignalsOfAxes)
def _noise_gate(observer: SignalsOfAxes, frequency: float) -> NoiseGateOfAxes:
    parts, own = observer.parts, noise_gate(observer.own, frequency)
    gates = [noise_gate(part, frequency) for part in parts]
    thresholds = [gate.threshold[: part.order] for gate, part in zip(gates, parts, strict=True)]
    sources = [np.full(part.order, k) for k, part in enumerate(parts)]
    if observer.inputs:
        begin = len(parts) - len(observer.view.observers)
        thresholds += [gate.threshold[-1:] for gate in gates[begin:]]
        sources.append(np.arange(begin, len(parts)))
    return NoiseGateOfAxes(
        threshold=np.concatenate([*thresholds, own.threshold[-1:]]),
        forget=own.forget,
        f_noise=own.f_noise,
        power=own.power,
        sources=len(parts),
        states=observer.states,
        with_own=observer.with_own,
        source=np.concatenate([*sources, [0]]).astype(np.int64),
        first=np.array(observer.first, dtype=np.int64),
    )


@lag_of.register(SignalsOfAxes)
def _lag_of(observer: SignalsOfAxes, every: int = 1) -> Any:
    return lag_of(observer.own, every)


@group_delay.register(SignalsOfAxes)
def _group_delay(observer: SignalsOfAxes) -> float:
    return group_delay(observer.own)


# ---- A learner of one axis that sees all of them ----


@generic_with_default
def show(learner: Any, memory: Any, before: Vector, now: Vector) -> None:
    """Show a learner the signals of all axes of the last sample, and as expected in this one."""


class SeeingDesign(NamedTuple):
    """Parameters of a learner that has the signals of all axes."""

    inner: Any
    own: Size  # order of the own axis
    at: Size  # place of its states among those of all axes
    inputs: Flag  # whether v of all axes are signals, too
    signals: Size  # N


class SeeingMemory(NamedTuple):
    """State: signals, a place for f, then y and y − x̂_1 of all axes."""

    inner: Any
    before: Work  # of the last sample
    now: Work  # as they are expected in this one


@show.register(SeeingDesign)
def _show(learner: SeeingDesign, memory: SeeingMemory, before: Vector, now: Vector) -> None:
    show_signals(before, memory.before, learner.own, learner.signals, learner.inputs)
    show_signals(now, memory.now, learner.own, learner.signals, learner.inputs)


@kernel
def show_signals(given: Vector, signals: Vector, own: int, count: int, inputs: bool) -> None:
    """Write the signals of all axes behind ``own`` ones.

    ``given`` are the states of all axes, then v, y and y − x̂_1 of each of the k axes.
    """
    behind = signals.size - count - 1  # 2 k
    axes = behind // 2
    states = given.size - 3 * axes
    seen = states + axes if inputs else states
    for i in range(seen):
        signals[own + i] = given[i]
    signals[count] = 0.0
    for i in range(behind):
        signals[count + 1 + i] = given[states + axes + i]


@kernel
def _with_own(learner: SeeingDesign, signals: Vector, estimates: Vector) -> None:
    """Write the own states, which are known as they are now, at both of their places."""
    for i in range(learner.own):
        signals[i] = estimates[i]
        signals[learner.own + learner.at + i] = estimates[i]


@adapt.register(SeeingDesign)
def _adapt(
    learner: SeeingDesign,
    memory: SeeingMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    _with_own(learner, memory.now, estimates)
    adapt(learner.inner, memory.inner, memory.now, y, u_before, f_plain)


@predict.register(SeeingDesign)
def _predict(
    learner: SeeingDesign, memory: SeeingMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    _with_own(learner, memory.now, estimates)
    constant, slope = predict(learner.inner, memory.inner, memory.now, u_before)
    return constant, slope


@commit.register(SeeingDesign)
def _commit(
    learner: SeeingDesign, memory: SeeingMemory, estimates: Vector, u: float, f_learned: float
) -> None:
    _with_own(learner, memory.before, estimates)
    commit(learner.inner, memory.inner, memory.before, u, f_learned)


@restart.register(SeeingDesign)
def _restart(learner: SeeingDesign, memory: SeeingMemory) -> None:
    restart(learner.inner, memory.inner)


@forget.register(SeeingDesign)
def _forget(learner: SeeingDesign, memory: SeeingMemory) -> None:
    forget(learner.inner, memory.inner)


@coefficients.register(SeeingDesign)
def _coefficients(learner: SeeingDesign, memory: SeeingMemory, theta: Vector) -> None:
    coefficients(learner.inner, memory.inner, theta)


@learner_flags.register(SeeingDesign)
def _flags(learner: SeeingDesign, memory: SeeingMemory) -> int:
    return learner_flags(learner.inner, memory.inner)


@meaning.register(SeeingDesign)
def _meaning(learner: SeeingDesign) -> Any:
    return meaning(learner.inner), learner.own, learner.at, learner.inputs


class SeeingLearner:
    """A learner of one axis of several, with features of all of them; ``Axes`` makes it."""

    of_axes = True  # the controller of its axis does not run alone

    def __init__(self, learner: Any, view: AxesView, axis: int) -> None:
        self.learner, self.view, self.axis = learner, view, axis
        self.inputs = asks_for_inputs(learner.features)
        own = view.observers[axis].order
        self.bound = copy.copy(learner)
        self.bound.features = bound(learner.features, own, view.labels, view.inputs)

    def __repr__(self) -> str:
        return repr(self.learner)

    def design(self, observer: ESO, omega_c: float) -> SeeingDesign:
        """Return the parameters for an observer of the axis and its bandwidth [rad/s]."""
        orders = [each.order for each in self.view.observers]
        signals = SignalsOfAxes(observer, self.view, self.inputs, True)
        inner = self.bound.design(signals, omega_c)
        at = sum(orders[: self.axis])
        return SeeingDesign(inner, observer.order, at, self.inputs, signals.order)

    def memory(self, parameters: SeeingDesign) -> SeeingMemory:
        """Return the state before anything is learned."""
        size = parameters.signals + 1 + 2 * len(self.view.observers)
        return SeeingMemory(self.bound.memory(parameters.inner), *np.zeros((2, size)))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return the names of the features that θ multiplies."""
        return self.bound.feature_names(order)


# ---- One learner that serves all axes ----


class OutputLoop(Scalars):
    """Scalars of one output, kept from one sample to the next."""

    samples: float  # since the axis started from rest
    scale: float  # what f is divided by; zero before the first sample
    bias: float  # d, in the plant's units
    ready: float  # 1 if there are features
    learns: float  # 1 if the error is one of this sample
    error: float  # target − θ·φ^F, scaled
    forgot: float  # 1 if θ was forgotten, and what is shared was not yet


class OutputDesign(NamedTuple):
    """Parameters of one output of a shared learner."""

    constant: Size  # index of the feature that is the constant 1; −1 without one
    startup: int  # samples after a start from rest in which nothing is learned
    bias_gain: float  # λ dt, at most 1
    power: float  # ω^n
    f_noise: float  # variance that white noise of unit variance in y causes in f̂


class OutputMemory(NamedTuple):
    """State of one output."""

    theta: Vector  # (p,), scaled
    units: Vector  # (p,): ``unit`` of the features
    features: Work  # of this sample (p,)
    filtered: Work  # φ^F (p,)
    loop: NDArray[OutputLoop]


@adapt.register(OutputDesign)
def _adapt_output(
    learner: OutputDesign,
    memory: OutputMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    loop, theta = memory.loop[0], memory.theta
    if loop.samples <= learner.startup or not is_finite(f_plain):
        return
    size = abs(f_plain)
    if size > loop.scale:
        larger = 2.0 ** math.ceil(log2(size))
        for i in range(theta.size):
            theta[i] *= loop.scale / larger
        loop.scale = larger
    if loop.ready == 0.0 or loop.scale == 0.0:
        return
    error = f_plain / loop.scale
    for i in range(theta.size):
        error -= theta[i] * memory.filtered[i]
    if not is_finite(error):
        return
    loop.bias += learner.bias_gain * (error * loop.scale - loop.bias)
    loop.error, loop.learns = error, 1.0


@predict.register(OutputDesign)
def _predict_output(
    learner: OutputDesign, memory: OutputMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    loop = memory.loop[0]
    if loop.ready == 0.0:
        return 0.0, 0.0
    total = 0.0
    for i in range(memory.theta.size):
        total += memory.theta[i] * memory.features[i]
    return loop.scale * total + loop.bias, 0.0


@commit.register(OutputDesign)
def _commit_output(
    learner: OutputDesign, memory: OutputMemory, estimates: Vector, u: float, f_learned: float
) -> None:
    if memory.loop[0].samples < MOST_SAMPLES:
        memory.loop[0].samples += 1.0


@restart.register(OutputDesign)
def _restart_output(learner: OutputDesign, memory: OutputMemory) -> None:
    loop = memory.loop[0]
    loop.samples = loop.bias = loop.learns = 0.0
    finite = True
    for i in range(memory.theta.size):
        finite = finite and is_finite(memory.theta[i])
    if not finite:
        _forget_theta(memory)


@forget.register(OutputDesign)
def _forget_output(learner: OutputDesign, memory: OutputMemory) -> None:
    _forget_theta(memory)


@kernel
def _forget_theta(memory: OutputMemory) -> None:
    ready = memory.loop[0].ready
    clear(memory.loop)
    memory.loop[0].ready, memory.loop[0].forgot = ready, 1.0
    for i in range(memory.theta.size):
        memory.theta[i] = 0.0


@coefficients.register(OutputDesign)
def _coefficients_output(learner: OutputDesign, memory: OutputMemory, theta: Vector) -> None:
    for i in range(theta.size):
        theta[i] = memory.theta[i] * memory.units[i] * memory.loop[0].scale
    if learner.constant >= 0:
        theta[learner.constant] += memory.loop[0].bias


@meaning.register(OutputDesign)
def _meaning_output(learner: OutputDesign) -> Any:
    return learner.constant


@generic
def shared_gain(rule: Any, memory: Any, features: Vector, confidence: float, gain: Vector) -> None:
    """Write what θ of each output moves by for an error of one into ``gain`` (p,)."""
    raise TypeError


@shared_gain.register(NlmsRule)
def _nlms_gain(
    rule: NlmsRule, memory: Vector, features: Vector, confidence: float, gain: Vector
) -> None:
    power = rule.floor
    for i in range(features.size):
        power += features[i] * features[i]
    for i in range(features.size):
        gain[i] = rule.gain * confidence * features[i] / power


@shared_gain.register(RlsRule)
def _rls_gain(
    rule: RlsRule, memory: RlsMemory, features: Vector, confidence: float, gain: Vector
) -> None:
    noise = rule.noise / confidence
    inverse = least_squares_gain(rule, memory.covariance, memory.gain, features, noise)
    for i in range(features.size):
        gain[i] = memory.gain[i] * inverse


class SharedDesign(NamedTuple):
    """Parameters of what all outputs share: a linear learner, whose θ is not used."""

    linear: LinearDesign
    inputs: Flag  # whether v of all axes are signals, too


@meaning.register(SharedDesign)
def _meaning_shared(shared: SharedDesign) -> Any:
    return meaning(shared.linear), shared.inputs


class SharedLoop(Scalars):
    """Scalars of what all outputs share."""

    moves: float  # 1 if a state moves


class SharedMemory(NamedTuple):
    """State of what all outputs share."""

    linear: (
        LinearMemory  # θ is 1, and after a change of scales what θ of the outputs is to be times
    )
    before: Work  # signals of the last sample, see ``SeeingMemory``
    now: Work
    gain: Work  # (p,)
    loop: NDArray[SharedLoop]


@kernel
def look(shared: SharedDesign, memory: SharedMemory, before: Vector, now: Vector) -> None:
    """Begin a sample of all axes: filter the features of the last one, write those of this one."""
    linear, inner = shared.linear, memory.linear
    count = memory.now.size - 1 - 2 * linear.inputs.gate.sources
    show_signals(before, memory.before, 0, count, shared.inputs)
    show_signals(now, memory.now, 0, count, shared.inputs)
    commit(linear, inner, memory.before, 0.0, 0.0)
    moves = update_gate(linear.inputs.gate, inner.gate, memory.now, 0.0, 0.0)
    memory.loop[0].moves = 1.0 if moves else 0.0
    for i in range(inner.theta.size):
        inner.theta[i] = 1.0
    if inner.loop[0].samples > linear.inputs.startup:
        rescale(linear, inner, memory.now, 0.0, 0.0)
    if inner.loop[0].has_scale != 0.0:
        write_features(linear.inputs, inner, memory.now, 0.0, inner.features)


@kernel
def share(
    shared: SharedDesign, memory: SharedMemory, learner: OutputDesign, output: OutputMemory
) -> None:
    """Hand the features of a sample to an output, before its axis runs."""
    inner, loop = memory.linear, output.loop[0]
    loop.ready, loop.learns = inner.loop[0].has_scale, 0.0
    for i in range(output.theta.size):
        output.theta[i] *= inner.theta[i]
        output.units[i] = inner.units[i]
        output.features[i] = inner.features[i]
        output.filtered[i] = inner.filtered[i]


@kernel
def confidence_in(
    shared: SharedDesign, memory: SharedMemory, learner: OutputDesign, axis: int
) -> float:
    """Return the share of f̂ of an axis that is not noise; see ``confidence``."""
    gate, inner = shared.linear.inputs.gate, memory.linear
    motion = learner.power * inner.scale[gate.first[axis]]
    noise = NOISE_DEVIATIONS * NOISE_DEVIATIONS * learner.f_noise * inner.gate.noise[2 * axis]
    seen = motion * motion * inner.gate.noise[2 * axis + 1]
    return seen / (seen + noise)


@kernel
def find_gain(shared: SharedDesign, memory: SharedMemory, least: float) -> bool:
    """Compute the gain of all outputs, given their least confidence; return whether there is one.

    A sample counts as much as for the axis with most noise: the gain has one R.
    """
    linear, inner = shared.linear, memory.linear
    loop = inner.loop[0]
    if loop.has_scale == 0.0 or memory.loop[0].moves == 0.0 or not least >= LEAST_CONFIDENCE:
        return False
    if loop.samples <= linear.inputs.startup or loop.samples <= loop.learn_after:
        return False
    shared_gain(linear.rule, inner.rule, inner.filtered, least, memory.gain)
    return True


@kernel
def take_gain(memory: SharedMemory, output: OutputMemory) -> None:
    """Move θ of an output by its error."""
    if output.loop[0].learns != 0.0:
        for i in range(output.theta.size):
            output.theta[i] += memory.gain[i] * output.loop[0].error


@restart.register(SharedDesign)
def _restart_shared(shared: SharedDesign, memory: SharedMemory) -> None:
    restart(shared.linear, memory.linear)


@forget.register(SharedDesign)
def _forget_shared(shared: SharedDesign, memory: SharedMemory) -> None:
    forget(shared.linear, memory.linear)


class OneOutput:
    """An output of a shared learner, as the learner of one axis; ``LearningOfAxes`` makes it."""

    of_axes = True

    def __init__(self, shared: SharedLearner, axis: int) -> None:
        self.shared, self.axis = shared, axis

    def __repr__(self) -> str:
        return repr(self.shared.learner)

    def design(self, observer: ESO, omega_c: float) -> OutputDesign:
        """Return the parameters for an observer of the axis and its bandwidth [rad/s]."""
        learner, features = self.shared.learner, self.shared.bound.features
        bandwidth = learner.bias_bandwidth
        bandwidth = observer.omega_o if bandwidth is None else bandwidth
        gate = noise_gate(observer, learner.frequency or omega_c)
        return OutputDesign(
            constant=features.constant(0),
            startup=startup_samples(observer),
            bias_gain=min(bandwidth * observer.dt, 1.0),
            power=gate.power,
            f_noise=gate.f_noise,
        )

    def memory(self, parameters: OutputDesign) -> OutputMemory:
        """Return the state before anything is learned."""
        theta, features, filtered = np.zeros((3, len(self.feature_names(0))))
        return OutputMemory(theta, np.ones(theta.size), features, filtered, OutputLoop.zeros())

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return the names of the features that θ multiplies."""
        return self.shared.bound.features.names(order)


class SharedLearner:
    """One linear learner with an output for each axis; ``Axes`` makes it.

    Its frequency, from which scales, thresholds of noise and the time of its memory follow, is
    ``omega_c``, the least of all axes, unless the learner gives one.
    """

    def __init__(self, learner: Any, view: AxesView, omega_c: float) -> None:
        if not isinstance(learner, Linear):
            raise ValueError(
                f"learner = {learner!r}: one for all axes must be linear in its features, RLS or "
                "NLMS, whose gain is that of all outputs; give a list with a learner for each axis"
            )
        first = lag_of(view.observers[0])
        for name, observer in zip(view.names, view.observers, strict=True):
            if not _same_lag(first, lag_of(observer)):
                raise ValueError(
                    f"learner = {learner!r}: {name} has another observer than {view.names[0]}; "
                    "features that all axes share pass through one lag filter: give all observers "
                    "one order, omega_o and form, or a list with a learner for each axis"
                )
        self.learner, self.view, self.omega_c = learner, view, omega_c
        self.inputs = asks_for_inputs(learner.features)
        self.bound = copy.copy(learner)
        self.bound.features = bound(learner.features, 0, view.labels, view.inputs)
        kind = type(self.design().linear.rule)
        if kind not in shared_gain.implementations:
            raise ValueError(
                f"learner = {learner!r}: strongest, relearn and recall decide by the error of one "
                "axis; leave them out, or give a list with a learner for each axis"
            )

    def __repr__(self) -> str:
        return repr(self.learner)

    def design(self) -> SharedDesign:
        """Return the parameters."""
        signals: Any = SignalsOfAxes(self.view.observers[0], self.view, self.inputs, False)
        return SharedDesign(self.bound.design(signals, self.omega_c), self.inputs)

    def memory(self, parameters: SharedDesign) -> SharedMemory:
        """Return the state before anything is learned."""
        linear = self.bound.memory(parameters.linear)
        count = parameters.linear.inputs.order
        before, now = np.zeros((2, count + 1 + 2 * len(self.view.observers)))
        gain = np.zeros(linear.theta.size)
        return SharedMemory(linear, before, now, gain, SharedLoop.zeros())


def _same_lag(one: Any, other: Any) -> bool:
    return type(one) is type(other) and all(map(np.array_equal, one, other))


def check_learner_of_axes(learner: Any, where: str) -> None:
    """Check a learner that is given to ``Axes``.

    Raises
    ------
    ValueError
        for a learner without features of all axes, and for options that are those of one axis.
    """
    if not isinstance(learner, FeatureLearner) or hasattr(learner, "external_fields"):
        raise ValueError(
            f"{where} = {learner!r}: must be a learner on features, RLS, NLMS, MLP, "
            "GaussianProcess or Online; one that learns from its own axis belongs into the ADRC"
        )
    if not sees_all_axes(learner):
        raise ValueError(
            f"{where} = {learner!r}: has no features of all axes, AllAxes(...); one that learns "
            "from its own axis belongs into the ADRC"
        )
    if learner.scale is not None:
        raise ValueError(
            f"{where}: scale = {learner.scale!r} is that of one axis; leave it out, scales are "
            "found automatically"
        )
    if getattr(learner, "recall", False):
        raise ValueError(f"{where}: recall = True is for one axis; give it to the ADRC of this one")
