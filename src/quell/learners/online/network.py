"""A small neural network, trained while it runs.

    h_θ(φ) = v_0 + Σ_j v_j tanh(c_j + W_j · φ)

Each pair is a step of the extended Kalman filter on all weights: recursive least squares (``rls.py``) with the network's gradient ``∂h/∂θ``
in the place of the features. It costs O(p²) for p weights. A gradient step alone would cost O(p), but the weights of a network act so much
alike that it needs hours for what the filter, which knows by its covariance what has been settled, learns in seconds.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.features import Features, State
from quell.kernels.dispatch import is_finite, kernel
from quell.learners.online.learner import Online
from quell.learners.online.model import infer, learn
from quell.learners.regression.rls import RlsRule, least_squares_gain
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# No weight of a network with inputs and outputs of O(1) needs to be larger.
_LARGEST = 30.0
# Standard deviation of weights before anything is known: steep enough for units that switch, as friction does, within a third of the range.
_PRIOR = 3.0
# Targets are O(1); an error beyond this is an outlier.
_LARGEST_ERROR = 1.0


class NetworkDesign(NamedTuple):
    """Parameters of a network with m inputs and h hidden units, p = h (m + 2) + 1 weights."""

    rule: RlsRule
    inputs: int
    hidden: int
    every: int
    """Learn from every so-many-th pair."""
    seed: int


class NetworkMemory(NamedTuple):
    """State of a network."""

    theta: Vector
    """(p,): for each hidden unit v_j, c_j, W_j; last v_0."""
    covariance: Matrix
    """(p, p)."""
    slope: Vector
    """Room for ∂h/∂θ (p,)."""
    gain: Vector
    """Room (p,)."""
    skipped: Vector
    """(1,): pairs passed over since the last that was learned from."""


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
        output += theta[at] * math.tanh(inner)
    return output


@kernel
def _with_slope(model: NetworkDesign, memory: NetworkMemory, features: Vector) -> float:
    """Return h, and write its gradient."""
    theta, slope = memory.theta, memory.slope
    width = features.size + 2
    output = theta[theta.size - 1]
    slope[theta.size - 1] = 1.0
    for j in range(model.hidden):
        at = j * width
        inner = theta[at + 1]
        for i in range(features.size):
            inner += theta[at + 2 + i] * features[i]
        unit = math.tanh(inner)
        output += theta[at] * unit
        slope[at] = unit
        steep = theta[at] * (1.0 - unit * unit)
        slope[at + 1] = steep
        for i in range(features.size):
            slope[at + 2 + i] = steep * features[i]
    return output


@learn.register(NetworkDesign)
def _learn(model: NetworkDesign, memory: NetworkMemory, features: Vector, target: float) -> None:
    memory.skipped[0] += 1.0
    if memory.skipped[0] < model.every:
        return
    memory.skipped[0] = 0.0
    theta, gain = memory.theta, memory.gain
    error = target - _with_slope(model, memory, features)
    if not is_finite(error):
        return
    error = min(max(error, -_LARGEST_ERROR), _LARGEST_ERROR)
    step = error * least_squares_gain(
        model.rule, memory.covariance, gain, memory.slope, model.rule.noise
    )
    for i in range(theta.size):
        theta[i] = min(max(theta[i] + step * gain[i], -_LARGEST), _LARGEST)


class Network:
    """The model behind ``MLP``: see there.

    Parameters
    ----------
    hidden, seed, every
        as for ``MLP``.
    memory_time
        after which what was seen counts 1/e [s].
    noise, noise_time
        of the targets, in units of their scale, and how long it is correlated [s].
    """

    def __init__(
        self,
        hidden: int,
        seed: int,
        every: int,
        memory_time: float,
        noise: float,
        noise_time: float,
    ) -> None:
        self.hidden = checks.whole("hidden", hidden, 1)
        self.seed = checks.whole("seed", seed, 0)
        self.every = checks.whole("every", every, 1)
        self.memory_time = checks.time_constant("memory_time", memory_time)
        self.noise = checks.positive("noise", noise)
        self.noise_time = checks.positive("noise_time", noise_time, "s")

    def design(self, features: int, dt: float) -> NetworkDesign:
        """Return the parameters for so many features and a sample time [s]."""
        step = self.every * dt
        rule = RlsRule(
            self.noise**2 * max(self.noise_time / step, 1.0),
            -math.expm1(-step / self.memory_time),
            _PRIOR**2,
        )
        return NetworkDesign(rule, features, self.hidden, self.every, self.seed)

    def memory(self, parameters: NetworkDesign) -> NetworkMemory:
        """Return a network that says nothing: its output weights are zero, the others random."""
        width = parameters.inputs + 2
        rng = np.random.default_rng(parameters.seed)
        weights = _PRIOR * rng.normal(size=(parameters.hidden, width))
        weights[:, 0] = 0.0
        # Each unit switches somewhere in the range of the features.
        weights[:, 1] = -np.sum(
            weights[:, 2:] * rng.uniform(-1.0, 1.0, (parameters.hidden, parameters.inputs)), axis=1
        )
        theta = np.append(weights.ravel(), 0.0)
        p = theta.size
        return NetworkMemory(
            theta, parameters.rule.prior * np.eye(p), np.zeros(p), np.zeros(p), np.zeros(1)
        )


class MLP(Online):
    """A neural network with one hidden layer of tanh units, trained from zero in the loop by an extended Kalman filter.

    Weights are bounded, and errors clipped, so that no single sample can spoil much.

    Parameters
    ----------
    hidden
        number of hidden units h. A sample costs O(h²).
    features
        what it is shown; the state by default.
    memory_time
        after which what was seen counts 1/e, where something new is seen [s]; ``100/omega_c`` by default.
    every
        learn from every so-many-th sample only; it predicts at each.
    noise
        standard deviation of what it can't explain, in units of the largest f.
    seed
        of the first weights.
    frequency, scale, bias_bandwidth
        as for ``Online``.

    Raises
    ------
    ValueError
        for arguments out of range.

    References
    ----------
    Singhal & Wu, *Training multilayer perceptrons with the extended Kalman algorithm*, NIPS 1988; Puskorius & Feldkamp, *Neurocontrol of
    nonlinear dynamical systems with Kalman filter trained recurrent networks*, IEEE Trans. Neural Networks 5 (1994).
    """

    def __init__(
        self,
        hidden: int = 10,
        features: Features | None = None,
        *,
        memory_time: float | None = None,
        every: int = 1,
        noise: float = 0.1,
        seed: int = 0,
        frequency: float | None = None,
        scale: Any = None,
        bias_bandwidth: float | None = None,
    ) -> None:
        self.memory_time = (
            None if memory_time is None else checks.time_constant("memory_time", memory_time)
        )
        model = Network(hidden, seed, every, 1.0, noise, 1.0)
        super().__init__(
            model,
            State() if features is None else features,
            frequency=frequency,
            scale=scale,
            bias_bandwidth=bias_bandwidth,
        )

    def fitted_model(self, observer: ESO, omega_c: float) -> Network:
        """Return the network with memory and correlation of noise as observer and controller want them."""
        model: Network = self.model
        return Network(
            model.hidden,
            model.seed,
            model.every,
            self.memory_time or 100.0 / omega_c,
            model.noise,
            observer.lag_time,
        )
