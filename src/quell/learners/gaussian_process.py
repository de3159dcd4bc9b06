"""A Gaussian process with a bounded number of points: the kernel recursive least squares tracker.

f is modelled as a Gaussian process with the kernel ``k(φ, φ') = exp(−|φ − φ'|²/(2 length²))``. It
stores at most M points c_i, with the mean μ and the covariance Σ of f at these points. For a pair
(φ, y), with ``Q = K⁻¹`` and ``k_i = k(φ, c_i)`` (Van Vaerenbergh et al., eqs. (9)-(13))::

    q = Q k,   γ² = 1 − k·q,   h = Σ q,   s = γ² + q·h + σ²,   e = y − q·μ

* if γ² is small, the stored points determine f at φ: ``μ += h e/s``, ``Σ −= h hᵀ/s``;
* else φ becomes a point. If there are then more than M, the point is removed whose loss changes the
  mean least: ``min (Qμ)_i²/Q_ii``.

Before that, the state is moved back towards the prior, ``Σ ← λΣ + (1−λ)K``, ``μ ← √λ μ``. All of it
is O(M²) and in place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.features import Features, State
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.functions import exp, sqrt
from quell.kernels.sized import Buffer, Size
from quell.learners.base import features_first, meaning
from quell.learners.online import Online, infer, learn
from quell.observers.eso import ESO
from quell.types import Vector

# Default of novelty; also bounds rounding errors of Q. Chosen by hand, not tuned further.
_NOVELTY = 1e-2
# With it, single precision changes u by less than 1e-4 of its RMS with 10 and 20 points; with the
# default by a quarter to a half (two masses, docs/single_precision).
SINGLE_NOVELTY = 0.1
# Default of memory_time in units of 1/omega_c; chosen by hand, not tuned further.
_MEMORY = 1000.0


class ProcessDesign(NamedTuple):
    """Parameters of a process with a budget of M points."""

    inputs: Size
    budget: int
    weight: float  # ``1/(2 length²)``
    noise: float  # σ²
    forget: float  # 1 − λ
    every: int  # learn from every ``every``-th pair
    novelty: float  # least γ² of a new point


class ProcessMemory(NamedTuple):
    """State for m features; one row more than the budget, for the point that is added last."""

    points: Buffer  # c (M + 1, m)
    kernel: Buffer  # K (M + 1, M + 1)
    inverse: Buffer  # Q (M + 1, M + 1)
    covariance: Buffer  # Σ (M + 1, M + 1)
    mean: Buffer  # μ (M + 1,)
    weights: Buffer  # Qμ (M + 1,)
    k: Buffer  # work space (M + 1,)
    q: Buffer  # work space (M + 1,)
    h: Buffer  # work space (M + 1,)
    counters: Vector  # (2,): number of points; pairs since the last one that was learned from


@kernel
def _similarity(model: ProcessDesign, memory: ProcessMemory, i: int, features: Vector) -> float:
    distance = 0.0
    for j in range(features.size):
        away = features[j] - memory.points[i, j]
        distance += away * away
    return exp(-model.weight * distance)


@kernel
def _point_count(model: ProcessDesign, memory: ProcessMemory) -> int:
    return min(max(int(memory.counters[0]), 0), model.budget)


@infer.register(ProcessDesign)
def _infer(model: ProcessDesign, memory: ProcessMemory, features: Vector) -> float:
    output = 0.0
    for i in range(_point_count(model, memory)):
        output += memory.weights[i] * _similarity(model, memory, i, features)
    return output


@learn.register(ProcessDesign)
def _learn(model: ProcessDesign, memory: ProcessMemory, features: Vector, target: float) -> None:
    memory.counters[1] += 1.0
    if memory.counters[1] < model.every or not is_finite(target):
        return
    memory.counters[1] = 0.0
    count = _point_count(model, memory)
    mean, covariance = memory.mean, memory.covariance
    k, q, h = memory.k, memory.q, memory.h
    _forget(model, memory, count)
    for i in range(count):
        k[i] = _similarity(model, memory, i, features)
    novelty, error = 1.0, target
    for i in range(count):
        total = 0.0
        for j in range(count):
            total += memory.inverse[i, j] * k[j]
        q[i] = total
        novelty -= total * k[i]
        error -= total * mean[i]
    novelty = max(novelty, 0.0)
    variance = novelty
    for i in range(count):
        total = 0.0
        for j in range(count):
            total += covariance[i, j] * q[j]
        h[i] = total
        variance += total * q[i]
    if not (variance > 0.0 and is_finite(error)):
        return
    points = count
    if novelty > model.novelty:
        _add_point(memory, count, features, novelty, variance, target - error)
        points = count + 1
    gain = 1.0 / (variance + model.noise)
    for i in range(points):
        mean[i] += h[i] * error * gain
        for j in range(i + 1):
            covariance[i, j] -= h[i] * h[j] * gain
            covariance[j, i] = covariance[i, j]
    _update_weights(memory, points)
    if points > model.budget:
        _remove_point(memory, points)
        points -= 1
        _update_weights(memory, points)
    memory.counters[0] = points


@kernel
def _forget(model: ProcessDesign, memory: ProcessMemory, count: int) -> None:
    """Move mean and covariance back towards the prior."""
    if model.forget == 0.0:
        return
    keep = 1.0 - model.forget
    root = sqrt(keep)
    for i in range(count):
        memory.mean[i] *= root
        for j in range(count):
            prior = model.forget * memory.kernel[i, j]
            memory.covariance[i, j] = keep * memory.covariance[i, j] + prior


@kernel
def _add_point(
    memory: ProcessMemory,
    count: int,
    features: Vector,
    novelty: float,
    variance: float,
    expected: float,
) -> None:
    """Add a point; ``expected`` is the prediction at it."""
    for j in range(features.size):
        memory.points[count, j] = features[j]
    memory.q[count] = -1.0
    for i in range(count + 1):
        for j in range(count + 1):
            before = memory.inverse[i, j] if i < count and j < count else 0.0
            memory.inverse[i, j] = before + memory.q[i] * memory.q[j] / novelty
    for i in range(count):
        memory.kernel[count, i] = memory.kernel[i, count] = memory.k[i]
        memory.covariance[count, i] = memory.covariance[i, count] = memory.h[i]
    memory.kernel[count, count] = 1.0
    memory.covariance[count, count] = variance
    memory.h[count] = variance
    memory.mean[count] = expected


@kernel
def _update_weights(memory: ProcessMemory, count: int) -> None:
    for i in range(count):
        total = 0.0
        for j in range(count):
            total += memory.inverse[i, j] * memory.mean[j]
        memory.weights[i] = total


@kernel
def _remove_point(memory: ProcessMemory, count: int) -> None:
    """Remove the point whose loss changes the mean least; the last point moves to its row."""
    least, out, last = math.inf, count - 1, count - 1
    for i in range(count):
        loss = memory.weights[i] * memory.weights[i] / memory.inverse[i, i]
        if loss < least:
            least, out = loss, i
    pivot = memory.inverse[out, out]
    for i in range(count):
        memory.k[i] = memory.inverse[i, out]
    for i in range(count):
        for j in range(count):
            memory.inverse[i, j] -= memory.k[i] * memory.k[j] / pivot
    memory.mean[out] = memory.mean[last]
    for j in range(memory.points.shape[1]):
        memory.points[out, j] = memory.points[last, j]
    for i in range(count):
        memory.kernel[out, i] = memory.kernel[last, i]
        memory.inverse[out, i] = memory.inverse[last, i]
        memory.covariance[out, i] = memory.covariance[last, i]
    for i in range(count):
        memory.kernel[i, out] = memory.kernel[i, last]
        memory.inverse[i, out] = memory.inverse[i, last]
        memory.covariance[i, out] = memory.covariance[i, last]


@meaning.register(ProcessDesign)
def _meaning(model: ProcessDesign) -> Any:
    return model.inputs, model.budget, model.weight


@dataclass(frozen=True)
class GaussianProcessModel:
    """The model of ``GaussianProcess``, whose parameters have the same meaning."""

    budget: int
    length: float
    every: int
    memory_time: float  # [s]
    noise: float  # standard deviation of noise in the targets, in units of their scale
    noise_time: float  # correlation time of that noise [s]
    novelty: float = _NOVELTY

    def __post_init__(self) -> None:
        checks.whole("budget", self.budget, 1)
        checks.positive("length", self.length)
        checks.whole("every", self.every, 1)
        checks.time_constant("memory_time", self.memory_time)
        checks.positive("noise", self.noise)
        checks.positive("noise_time", self.noise_time, "s")
        if checks.positive("novelty", self.novelty) >= 1.0:
            raise ValueError(f"novelty = {self.novelty!r}: must be below 1")

    def design(self, features: int, dt: float) -> ProcessDesign:
        """Return the parameters for the number of features and a sample time [s]."""
        step = self.every * dt
        return ProcessDesign(
            inputs=features,
            budget=self.budget,
            weight=0.5 / self.length**2,
            noise=self.noise**2 * max(self.noise_time / step, 1.0),
            forget=-math.expm1(-step / self.memory_time),
            every=self.every,
            novelty=float(self.novelty),
        )

    def memory(self, parameters: ProcessDesign) -> ProcessMemory:
        """Return a process without points."""
        size = parameters.budget + 1
        points = np.zeros((size, parameters.inputs))
        K, Q, covariance = np.zeros((3, size, size))
        mean, weights, k, q, h = np.zeros((5, size))
        return ProcessMemory(points, K, Q, covariance, mean, weights, k, q, h, np.zeros(2))


class GaussianProcess(Online):
    """A Gaussian process on a bounded number of points: a model that assumes only that f is smooth.

    It chooses the points itself. Far from all of them it predicts zero.

    Parameters
    ----------
    features
        blocks of features; the state by default.
    budget
        largest number M of points. A sample costs O(M²).
    length
        distance over which f varies, in scaled features, which lie in [−1, 1].
    memory_time
        time after which a sample has the weight 1/e [s]; ``1000/omega_c`` by default.
    every
        learn from every ``every``-th sample only; predict in each.
    noise
        standard deviation of what the process cannot explain, in units of the largest f.
    novelty
        least variance of f at a new point that the stored points leave, between 0 and 1. The
        inverse of their covariance loses digits as it becomes smaller: take 0.1 in single
        precision.

    The other parameters are described in the base class ``FeatureLearner``.

    Raises
    ------
    ValueError
        for an argument out of range.

    References
    ----------
    Van Vaerenbergh, Lázaro-Gredilla & Santamaría, *Kernel recursive least-squares tracker for
    time-varying regression*, IEEE Trans. Neural Networks and Learning Systems 23 (2012); Csató &
    Opper, *Sparse on-line Gaussian processes*, Neural Computation 14 (2002).
    """

    def __init__(
        self,
        features: Features | None = None,
        budget: int = 40,
        *,
        length: float = 0.5,
        memory_time: float | None = None,
        every: int = 4,
        noise: float = 0.1,
        novelty: float = _NOVELTY,
        frequency: float | None = None,
        scale: Any = None,
        bias_bandwidth: float | None = None,
    ) -> None:
        self.memory_time = checks.optional(checks.time_constant, "memory_time", memory_time)
        features, budget = features_first(features, budget, 40, "budget")
        model = GaussianProcessModel(budget, length, every, 1.0, noise, 1.0, novelty)
        features = State() if features is None else features
        super().__init__(
            model, features, frequency=frequency, scale=scale, bias_bandwidth=bias_bandwidth
        )

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints: features, and the numbers of the process."""
        numbers = {
            name: getattr(self.model, name)
            for name in ("budget", "length", "every", "noise", "novelty")
        }
        return super().described() | numbers

    def fitted_model(self, observer: ESO, omega_c: float) -> GaussianProcessModel:
        """Return the process with the memory time and the noise's correlation time."""
        model: GaussianProcessModel = self.model
        memory_time = self.memory_time or _MEMORY / omega_c
        return replace(model, memory_time=memory_time, noise_time=observer.lag_time)
