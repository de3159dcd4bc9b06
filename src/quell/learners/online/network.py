"""A small neural network, trained while it runs.

    h_θ(φ) = v_0 + Σ_j v_j tanh(c_j + W_j · φ)

Each pair is a step of the extended Kalman filter on all weights: recursive least squares
(``least_squares.py``) with the network's gradient ``∂h/∂θ`` in place of the features. It costs
O(p²) for p weights. A gradient step would cost O(p), but the effects of the weights are so similar
that it needs hours for what the filter learns in seconds, since its covariance separates them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.features import Features, State
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.functions import tanh
from quell.kernels.sized import Size
from quell.learners.feature_learner import features_first
from quell.learners.least_squares import RlsRule, least_squares_gain
from quell.learners.online.learner import Online
from quell.learners.online.model import infer, learn
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# No weight of a network with inputs and outputs of O(1) has to be larger; not tuned further.
_LARGEST = 30.0
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
        theta[i] = min(max(theta[i] + step * gain[i], -_LARGEST), _LARGEST)


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
