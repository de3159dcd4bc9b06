"""``Online``: a learner of any model that learns in each sample; ``MLP``, a small network.

The contract of a model, from which ``Online`` makes a learner.

A model predicts a number from features and learns from pairs (features, target). It is a NamedTuple
of parameters, a NamedTuple of arrays as its state, and two functions that are registered for the
type of the parameters. Features and target are O(1); lag, scaling and the loop are the task of
``Online``.

A learner around any model: features, scaling, and pairs that compensate the observer's lag.

The observer's estimate ``f^F = Δf̂ + f_L^F`` is f filtered (``learners/base.py``): approximately f
as it was D samples ago, with the filter's group delay D. So the model learns from the pair

    ( φ(k − D),  f^F(k) )

without lag bias, up to second order in frequency over omega_o. (A model that is linear in its
parameters does not need the approximation: ``learners/regression.py``, where the bias is
described.) A model at rest would learn the noise it is shown and forget the rest, so it learns
nothing while nothing moves or noise hides f (``learners/base.py``).

When a scale grows, by a factor of at least two, the same motion gives smaller features, and the
model has to learn them again. This happens in the first motions, and when a motion is larger than
all before; it does not happen if ``scale`` is given. Scales are √2 times powers of two: where y
rests at 1, noise beyond 1 would double a scale of 1.

A small neural network, trained while it runs.

    h_θ(φ) = v_0 + Σ_j v_j tanh(c_j + W_j · φ)

Each pair is a step of the extended Kalman filter on all weights: recursive least squares
(``learners/rls.py``) with the network's gradient ``∂h/∂θ`` in place of the features. It costs
O(p²) for p weights. A gradient step would cost O(p), but the effects of the weights are so similar
that it needs hours for what the filter learns in seconds, since its covariance separates them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.features import Features, State
from quell.features.base import reset_scale, reset_sizes, update_scale
from quell.kernels import user_functions
from quell.kernels.dispatch import generic, is_finite, kernel
from quell.kernels.functions import is_single, tanh
from quell.kernels.sized import Buffer, Scalars, Size, Work, clear
from quell.learners.base import (
    FeatureLearner,
    Inputs,
    NoiseGateMemory,
    adapt,
    check_lag,
    coefficients,
    commit,
    confidence,
    features_first,
    forget,
    group_delay,
    meaning,
    no_coefficients,
    noise_gate_memory,
    predict,
    reset_gate,
    restart,
    update_feature_sizes,
    update_gate,
    write_features,
)
from quell.learners.rls import RlsRule, least_squares_gain
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# ---- The contract of a model, from which Online makes a learner ----


class Model(Protocol):
    """A description of a model."""

    def design(self, features: int, dt: float) -> Any:
        """Return the parameters (a NamedTuple) for the number of features and a sample time [s]."""

    def memory(self, parameters: Any) -> Any:
        """Return the state before anything is learned (a NamedTuple of arrays)."""


@generic
def infer(model: Any, memory: Any, features: Vector) -> float:
    """Return the prediction for ``features`` (p,); change nothing but work space."""
    raise TypeError


@generic
def learn(model: Any, memory: Any, features: Vector, target: float) -> None:
    """Learn from ``features`` (p,) and ``target``; the state must stay bounded for any values."""
    raise TypeError


def checked_design(model: Model, features: int, dt: float) -> Any:
    """Return ``model.design(features, dt)``; check a user-defined model first.

    The model has to infer and learn, interpreted, on a memory that is discarded.
    """
    if not user_functions.is_user_defined(model):
        return model.design(features, dt)
    name = type(model).__name__
    rule = f"it is shown {features} features, of shape ({features},), and predicts one number"
    what = f"{name}.design({features}, {dt:g})"
    parameters = user_functions.attempt(
        what, "design takes (features, dt)", model.design, features, dt
    )
    user_functions.check_named_tuple(what, parameters, "numbers and arrays")
    user_functions.check_registered(name, parameters, infer, learn)
    what = f"{name}.memory(...)"
    memory = user_functions.attempt(what, "memory takes (parameters)", model.memory, parameters)
    user_functions.check_arrays(f"{name}.memory", memory, nested=False)
    memory = packed(memory)[0]
    for i in range(3):
        shown = user_functions.sample_values(features, 1.0 + i)
        what = f"{name}: infer"
        predicted = user_functions.attempt_kernel(what, rule, infer, parameters, memory, shown)
        if predicted is not user_functions.UNKNOWN:
            user_functions.check_number(what, predicted)
        user_functions.attempt_kernel(f"{name}: learn", rule, learn, parameters, memory, shown, 0.5)
    return parameters


def packed(memory: Any) -> tuple[Any, Vector]:
    """Return a copy of a NamedTuple of arrays as views of one flat array, and that array."""
    arrays = [np.asarray(array, dtype=np.float64) for array in memory]
    flat = np.concatenate([array.ravel() for array in arrays]) if arrays else np.zeros(0)
    ends = np.cumsum([array.size for array in arrays])
    places = zip(ends, arrays, strict=True)
    views = [flat[end - array.size : end].reshape(array.shape) for end, array in places]
    return type(memory)(*views), flat


# ---- A learner around any model ----

# Least confidence in f with which a model learns: at least half of f² is not noise. Chosen by hand.
_LEAST_CONFIDENCE = 0.5
# A state beyond this is as good as infinite: squares of it overflow; in single precision earlier.
_LARGEST, _LARGEST_SINGLE = 1e100, 1e15


class OnlineDesign(NamedTuple):
    """Parameters of a learner around a model with p features."""

    inputs: Inputs
    model: Any
    delay: int  # D [samples]


class OnlineLoop(Scalars):
    """Scalars of a learner around a model, kept from one sample to the next."""

    row: float  # of the ring, for the next features
    samples: float  # since the start from rest
    bias: float  # d, in the plant's units


class OnlineMemory(NamedTuple):
    """State of a learner around a model."""

    scale: Vector  # (n + 2,): what x_1 … x_n, u and f are divided by
    sizes: Vector  # (k,): what features of unknown size are divided by
    scaled: Work  # work space for the scaled state (n,)
    features: Work  # work space for the features of a prediction (p,)
    ring: Buffer  # the last features (D + 1, p)
    loop: NDArray[OnlineLoop]
    gate: NoiseGateMemory
    model: Any
    flat: Buffer  # all arrays of ``model``, end to end: the same memory
    initial: Buffer  # ``flat`` before anything was learned


@kernel
def has_pairs(learner: OnlineDesign, memory: OnlineMemory) -> bool:
    """Return whether there are pairs to learn from and features to predict from."""
    return bool(memory.loop[0].samples > learner.inputs.startup + learner.delay + 1)


@kernel
def _row(learner: OnlineDesign, memory: OnlineMemory) -> int:
    return min(max(int(memory.loop[0].row), 0), learner.delay)


@adapt.register(OnlineDesign)
def _adapt(
    learner: OnlineDesign,
    memory: OnlineMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    inputs, scale, loop = learner.inputs, memory.scale, memory.loop[0]
    moves = update_gate(inputs.gate, memory.gate, estimates, y, u_before)
    if loop.samples <= inputs.startup:
        return
    # A model is not converted: a scale that doubled would change all that it predicts at once.
    update_scale(inputs.scaling, scale, estimates, u_before, f_plain, False)
    update_feature_sizes(inputs, memory, estimates, u_before, False)
    if not has_pairs(learner, memory):
        return
    # The next row to be written is the oldest of the D + 1 rows: D samples older than the newest.
    features, f_scale = memory.ring[_row(learner, memory)], scale[scale.size - 1]
    if inputs.bias_gain > 0.0:
        left = f_plain - f_scale * infer(learner.model, memory.model, features) - loop.bias
        if is_finite(left):
            loop.bias += inputs.bias_gain * left
    if moves and confidence(inputs.gate, memory.gate, scale[0]) > _LEAST_CONFIDENCE:
        learn(learner.model, memory.model, features, f_plain / f_scale)


@predict.register(OnlineDesign)
def _predict(
    learner: OnlineDesign, memory: OnlineMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    if not has_pairs(learner, memory):
        return 0.0, 0.0
    write_features(learner.inputs, memory, estimates, u_before, memory.features)
    output = infer(learner.model, memory.model, memory.features)
    return memory.scale[memory.scale.size - 1] * output + memory.loop[0].bias, 0.0


@commit.register(OnlineDesign)
def _commit(
    learner: OnlineDesign, memory: OnlineMemory, estimates: Vector, u: float, f_learned: float
) -> None:
    row = _row(learner, memory)
    write_features(learner.inputs, memory, estimates, u, memory.ring[row])
    memory.loop[0].row = 0.0 if row == learner.delay else row + 1
    memory.loop[0].samples += 1.0


@restart.register(OnlineDesign)
def _restart(learner: OnlineDesign, memory: OnlineMemory) -> None:
    clear(memory.loop)
    reset_gate(memory.gate)
    finite = True
    for i in range(memory.flat.size):
        value = memory.flat[i]
        largest = _LARGEST_SINGLE if is_single(value) else _LARGEST
        finite = finite and abs(value) <= largest
    if not finite:
        _forget_model(memory)


@kernel
def _forget_model(memory: OnlineMemory) -> None:
    for i in range(memory.flat.size):
        memory.flat[i] = memory.initial[i]


@forget.register(OnlineDesign)
def _forget(learner: OnlineDesign, memory: OnlineMemory) -> None:
    restart(learner, memory)
    _forget_model(memory)
    reset_scale(learner.inputs.scaling, memory.scale)
    reset_sizes(memory.sizes)


coefficients.register(OnlineDesign)(no_coefficients)


@meaning.register(OnlineDesign)
def _meaning(learner: OnlineDesign) -> Any:
    return meaning(learner.inputs), type(learner.model).__name__, meaning(learner.model)


class Online(FeatureLearner):
    """A learner made of a model and features.

    Parameters
    ----------
    model
        a description with ``design(features, dt)`` and ``memory(parameters)``.

    The other parameters are described in the base class ``FeatureLearner``.

    Raises
    ------
    ValueError
        for an argument that is out of range, or is no model or no block of features.
    """

    def __init__(
        self,
        model: Model,
        features: Features | None = None,
        *,
        frequency: float | None = None,
        scale: Any = None,
        bias_bandwidth: float | None = None,
    ) -> None:
        if isinstance(model, type) or not (hasattr(model, "design") and hasattr(model, "memory")):
            raise ValueError(
                f"model = {model!r}: must have design(features, dt) and memory(parameters); "
                "see docs/extend"
            )
        super().__init__(features, frequency, scale, bias_bandwidth)
        self.model: Any = model

    def fitted_model(self, observer: ESO, omega_c: float) -> Model:
        """Return the model with the parameters that depend on observer and controller."""
        return self.model

    def design(self, observer: ESO, omega_c: float) -> OnlineDesign:
        """Return the parameters for an observer and the controller's bandwidth [rad/s]."""
        check_lag(observer, type(self).__name__)
        inputs, p = self._inputs(observer, omega_c), len(self.features.names(observer.order))
        return OnlineDesign(
            inputs=inputs,
            model=checked_design(self.fitted_model(observer, omega_c), p, observer.dt),
            delay=max(round(group_delay(observer)), 0),
        )

    def memory(self, parameters: OnlineDesign) -> OnlineMemory:
        """Return the state before anything is learned."""
        n = parameters.inputs.order
        p = len(self.features.names(n))
        model, flat = packed(self.model.memory(parameters.model))
        return OnlineMemory(
            scale=self._initial_scale(parameters.inputs),
            sizes=self._initial_sizes(parameters.inputs),
            scaled=np.zeros(n),
            features=np.zeros(p),
            ring=np.zeros((parameters.delay + 1, p)),
            loop=OnlineLoop.zeros(),
            gate=noise_gate_memory(parameters.inputs.gate),
            model=model,
            flat=flat,
            initial=flat.copy(),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names: the model has no coefficients with a meaning for the user."""
        return ()


# ---- A small neural network, trained while it runs ----

# No weight of a network with inputs and outputs of O(1) has to be larger; not tuned further.
_LARGEST_NETWORK = 30.0
# Standard deviation of the initial weights: a unit switches, as friction does, within a third of
# the features' range.
_PRIOR = 3.0
# Targets are O(1); a larger error is an outlier.
_LARGEST_ERROR = 1.0
# Default of memory_time in units of 1/omega_c; chosen by hand, not tuned further.
_MEMORY = 100.0


class NetworkDesign(NamedTuple):
    """Parameters of a network with m inputs and h hidden units, p = h (m + 2) + 1 weights."""

    rule: RlsRule
    inputs: Size
    hidden: Size
    every: int  # learn from every ``every``-th pair
    seed: int


class NetworkMemory(NamedTuple):
    """State of a network."""

    theta: Vector  # (p,): v_j, c_j, W_j for each hidden unit, then v_0
    covariance: Matrix  # (p, p)
    gradient: Vector  # work space for ∂h/∂θ (p,)
    gain: Vector  # work space (p,)
    skipped: Vector  # (1,): pairs since the last one that was learned from


@infer.register(NetworkDesign)
def _infer(model: NetworkDesign, memory: NetworkMemory, features: Vector) -> float:
    theta = memory.theta
    width = features.size + 2
    output = theta[theta.size - 1]
    for j in range(model.hidden):
        at = j * width
        inner = theta[at + 1]
        for i in range(features.size):
            inner += theta[at + 2 + i] * features[i]
        output += theta[at] * tanh(inner)
    return output


@kernel
def _infer_with_gradient(model: NetworkDesign, memory: NetworkMemory, features: Vector) -> float:
    """Return h and write its gradient."""
    theta, gradient = memory.theta, memory.gradient
    width = features.size + 2
    output = theta[theta.size - 1]
    gradient[theta.size - 1] = 1.0
    for j in range(model.hidden):
        at = j * width
        inner = theta[at + 1]
        for i in range(features.size):
            inner += theta[at + 2 + i] * features[i]
        unit = tanh(inner)
        output += theta[at] * unit
        gradient[at] = unit
        steep = theta[at] * (1.0 - unit * unit)
        gradient[at + 1] = steep
        for i in range(features.size):
            gradient[at + 2 + i] = steep * features[i]
    return output


@learn.register(NetworkDesign)
def _learn(model: NetworkDesign, memory: NetworkMemory, features: Vector, target: float) -> None:
    memory.skipped[0] += 1.0
    if memory.skipped[0] < model.every:
        return
    memory.skipped[0] = 0.0
    theta, gain = memory.theta, memory.gain
    error = target - _infer_with_gradient(model, memory, features)
    if not is_finite(error):
        return
    error = min(max(error, -_LARGEST_ERROR), _LARGEST_ERROR)
    rule, gradient = model.rule, memory.gradient
    step = error * least_squares_gain(rule, memory.covariance, gain, gradient, rule.noise)
    for i in range(theta.size):
        theta[i] = min(max(theta[i] + step * gain[i], -_LARGEST_NETWORK), _LARGEST_NETWORK)


@dataclass(frozen=True)
class Network:
    """The model of ``MLP``, whose parameters have the same meaning."""

    hidden: int
    seed: int
    every: int
    memory_time: float  # [s]
    noise: float  # standard deviation of noise in the targets, in units of their scale
    noise_time: float  # correlation time of that noise [s]

    def __post_init__(self) -> None:
        checks.whole("hidden", self.hidden, 1)
        checks.whole("seed", self.seed, 0)
        checks.whole("every", self.every, 1)
        checks.time_constant("memory_time", self.memory_time)
        checks.positive("noise", self.noise)
        checks.positive("noise_time", self.noise_time, "s")

    def design(self, features: int, dt: float) -> NetworkDesign:
        """Return the parameters for the number of features and a sample time [s]."""
        step = self.every * dt
        rule = RlsRule(
            self.noise**2 * max(self.noise_time / step, 1.0),
            -math.expm1(-step / self.memory_time),
            _PRIOR**2,
        )
        return NetworkDesign(rule, features, self.hidden, self.every, self.seed)

    def memory(self, parameters: NetworkDesign) -> NetworkMemory:
        """Return a network that predicts zero: its output weights are zero, the others random."""
        inputs, hidden = parameters.inputs, parameters.hidden
        rng = np.random.default_rng(parameters.seed)
        weights = _PRIOR * rng.normal(size=(hidden, inputs + 2))
        weights[:, 0] = 0.0
        # Each unit switches somewhere in the range of the features.
        centres = rng.uniform(-1.0, 1.0, (hidden, inputs))
        weights[:, 1] = -np.sum(weights[:, 2:] * centres, axis=1)
        theta = np.append(weights.ravel(), 0.0)
        covariance = parameters.rule.prior * np.eye(theta.size)
        gradient, gain = np.zeros((2, theta.size))
        return NetworkMemory(theta, covariance, gradient, gain, np.zeros(1))


@meaning.register(NetworkDesign)
def _meaning_of_network(model: NetworkDesign) -> Any:
    return model.inputs, model.hidden


class MLP(Online):
    """A neural network with one hidden layer of tanh units, trained in the loop from zero output.

    The training algorithm is an extended Kalman filter. Weights are bounded and errors are clipped,
    so that a single sample has a limited effect.

    Parameters
    ----------
    features
        blocks of features; the state by default.
    hidden
        number of hidden units h. A sample costs O(h²).
    memory_time
        time after which a sample has the weight 1/e, where new samples come [s]; ``100/omega_c`` by
        default.
    every
        learn from every ``every``-th sample only; predict in each.
    noise
        standard deviation of what the network cannot explain, in units of the largest f.
    seed
        of the initial weights.

    The other parameters are described in the base class ``FeatureLearner``.

    Raises
    ------
    ValueError
        for an argument out of range.

    References
    ----------
    Singhal & Wu, *Training multilayer perceptrons with the extended Kalman algorithm*, NIPS 1988;
    Puskorius & Feldkamp, *Neurocontrol of nonlinear dynamical systems with Kalman filter trained
    recurrent networks*, IEEE Trans. Neural Networks 5 (1994).
    """

    def __init__(
        self,
        features: Features | None = None,
        hidden: int = 10,
        *,
        memory_time: float | None = None,
        every: int = 1,
        noise: float = 0.1,
        seed: int = 0,
        frequency: float | None = None,
        scale: Any = None,
        bias_bandwidth: float | None = None,
    ) -> None:
        self.memory_time = checks.optional(checks.time_constant, "memory_time", memory_time)
        features, hidden = features_first(features, hidden, 10, "hidden")
        model = Network(hidden, seed, every, memory_time=1.0, noise=noise, noise_time=1.0)
        features = State() if features is None else features
        super().__init__(
            model, features, frequency=frequency, scale=scale, bias_bandwidth=bias_bandwidth
        )

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints: features, and the numbers of the network."""
        model = self.model
        numbers = {"hidden": model.hidden, "every": model.every, "noise": model.noise}
        return super().described() | numbers | {"seed": model.seed}

    def fitted_model(self, observer: ESO, omega_c: float) -> Network:
        """Return the network with the memory time and the noise's correlation time."""
        model: Network = self.model
        memory_time = self.memory_time or _MEMORY / omega_c
        return replace(model, memory_time=memory_time, noise_time=observer.lag_time)
