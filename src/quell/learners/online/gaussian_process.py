"""A Gaussian process on a bounded budget: the kernel recursive least squares tracker.

f is taken for a Gaussian process with the kernel ``k(φ, φ') = exp(−|φ − φ'|²/(2 length²))``. All that is kept of what was seen is a
dictionary of at most M points c_i, with the mean μ and the covariance Σ of f there. For a pair (φ, y), with ``Q = K⁻¹`` and
``k_i = k(φ, c_i)``::

    q = Q k,   γ² = 1 − k·q,   h = Σ q,   s = γ² + q·h + σ²,   e = y − q·μ                (Van Vaerenbergh et al., eqs. (9)-(13))

* where γ² is small, the dictionary knows the place: ``μ += h e/s``, ``Σ −= h hᵀ/s``;
* else φ joins the dictionary, and where that is full, the point goes whose loss changes the mean least: ``min (Qμ)_i²/Q_ii``.

Before that, what is known fades back to the prior, ``Σ ← λΣ + (1−λ)K``, ``μ ← √λ μ``. All in O(M²), in place.
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
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# Least γ² with which a point joins: it also bounds what rounding does to Q.
_NEW = 1e-2


class GaussianProcessDesign(NamedTuple):
    """Parameters of a process with a budget of M points."""

    inputs: int
    budget: int
    weight: float
    """``1/(2 length²)``."""
    noise: float
    """σ²."""
    forget: float
    """1 − λ."""
    every: int
    """Learn from every so-many-th pair."""


class GaussianProcessMemory(NamedTuple):
    """State; room for one point more than the budget, m features."""

    points: Matrix
    """c (M + 1, m)."""
    kernel: Matrix
    """K (M + 1, M + 1)."""
    inverse: Matrix
    """Q (M + 1, M + 1)."""
    covariance: Matrix
    """Σ (M + 1, M + 1)."""
    mean: Vector
    """μ (M + 1,)."""
    weights: Vector
    """Qμ (M + 1,)."""
    near: Vector
    """Room for k (M + 1,)."""
    share: Vector
    """Room for q (M + 1,)."""
    spread: Vector
    """Room for h (M + 1,)."""
    place: Vector
    """(2,): number of points; pairs passed over since the last that was learned from."""


@kernel
def _likeness(
    model: GaussianProcessDesign, memory: GaussianProcessMemory, i: int, features: Vector
) -> float:
    distance = 0.0
    for j in range(features.size):
        away = features[j] - memory.points[i, j]
        distance += away * away
    return math.exp(-model.weight * distance)


@kernel
def _count(model: GaussianProcessDesign, memory: GaussianProcessMemory) -> int:
    return min(max(int(memory.place[0]), 0), model.budget)


@infer.register(GaussianProcessDesign)
def _infer(model: GaussianProcessDesign, memory: GaussianProcessMemory, features: Vector) -> float:
    output = 0.0
    for i in range(_count(model, memory)):
        output += memory.weights[i] * _likeness(model, memory, i, features)
    return output


@learn.register(GaussianProcessDesign)
def _learn(
    model: GaussianProcessDesign, memory: GaussianProcessMemory, features: Vector, target: float
) -> None:
    memory.place[1] += 1.0
    if memory.place[1] < model.every or not is_finite(target):
        return
    memory.place[1] = 0.0
    count = _count(model, memory)
    mean, covariance = memory.mean, memory.covariance
    near, share, spread = memory.near, memory.share, memory.spread
    _fade(model, memory, count)
    for i in range(count):
        near[i] = _likeness(model, memory, i, features)
    novelty, error = 1.0, target
    for i in range(count):
        total = 0.0
        for j in range(count):
            total += memory.inverse[i, j] * near[j]
        share[i] = total
        novelty -= total * near[i]
        error -= total * mean[i]
    novelty = max(novelty, 0.0)
    variance = novelty
    for i in range(count):
        total = 0.0
        for j in range(count):
            total += covariance[i, j] * share[j]
        spread[i] = total
        variance += total * share[i]
    if not (variance > 0.0 and is_finite(error)):
        return
    total = count
    if novelty > _NEW:
        _join(memory, count, features, novelty, variance, target - error)
        total = count + 1
    gain = 1.0 / (variance + model.noise)
    for i in range(total):
        mean[i] += spread[i] * error * gain
        for j in range(i + 1):
            covariance[i, j] -= spread[i] * spread[j] * gain
            covariance[j, i] = covariance[i, j]
    _weigh(memory, total)
    if total > model.budget:
        _leave(memory, total)
        total -= 1
        _weigh(memory, total)
    memory.place[0] = total


@kernel
def _fade(model: GaussianProcessDesign, memory: GaussianProcessMemory, count: int) -> None:
    """Go back towards the prior."""
    if model.forget == 0.0:
        return
    keep = 1.0 - model.forget
    root = math.sqrt(keep)
    for i in range(count):
        memory.mean[i] *= root
        for j in range(count):
            memory.covariance[i, j] = (
                keep * memory.covariance[i, j] + model.forget * memory.kernel[i, j]
            )


@kernel
def _join(
    memory: GaussianProcessMemory,
    count: int,
    features: Vector,
    novelty: float,
    variance: float,
    expected: float,
) -> None:
    """Add a point, with what was expected there."""
    for j in range(features.size):
        memory.points[count, j] = features[j]
    memory.share[count] = -1.0
    for i in range(count + 1):
        for j in range(count + 1):
            before = memory.inverse[i, j] if i < count and j < count else 0.0
            memory.inverse[i, j] = before + memory.share[i] * memory.share[j] / novelty
    for i in range(count):
        memory.kernel[count, i] = memory.kernel[i, count] = memory.near[i]
        memory.covariance[count, i] = memory.covariance[i, count] = memory.spread[i]
    memory.kernel[count, count] = 1.0
    memory.covariance[count, count] = variance
    memory.spread[count] = variance
    memory.mean[count] = expected


@kernel
def _weigh(memory: GaussianProcessMemory, count: int) -> None:
    for i in range(count):
        total = 0.0
        for j in range(count):
            total += memory.inverse[i, j] * memory.mean[j]
        memory.weights[i] = total


@kernel
def _leave(memory: GaussianProcessMemory, count: int) -> None:
    """Remove the point whose loss changes the mean least; the last one takes its place."""
    least, out, last = math.inf, count - 1, count - 1
    for i in range(count):
        loss = memory.weights[i] * memory.weights[i] / memory.inverse[i, i]
        if loss < least:
            least, out = loss, i
    pivot = memory.inverse[out, out]
    for i in range(count):
        memory.near[i] = memory.inverse[i, out]
    for i in range(count):
        for j in range(count):
            memory.inverse[i, j] -= memory.near[i] * memory.near[j] / pivot
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


class GaussianProcessModel:
    """The model behind ``GaussianProcess``: see there.

    Parameters
    ----------
    budget, length, every
        as for ``GaussianProcess``.
    memory_time
        after which what was seen counts 1/e [s].
    noise, noise_time
        of the targets, in units of their scale, and how long it is correlated [s].
    """

    def __init__(
        self,
        budget: int,
        length: float,
        every: int,
        memory_time: float,
        noise: float,
        noise_time: float,
    ) -> None:
        self.budget = checks.whole("budget", budget, 1)
        self.length = checks.positive("length", length)
        self.every = checks.whole("every", every, 1)
        self.memory_time = checks.time_constant("memory_time", memory_time)
        self.noise = checks.positive("noise", noise)
        self.noise_time = checks.positive("noise_time", noise_time, "s")

    def design(self, features: int, dt: float) -> GaussianProcessDesign:
        """Return the parameters for so many features and a sample time [s]."""
        step = self.every * dt
        return GaussianProcessDesign(
            inputs=features,
            budget=self.budget,
            weight=0.5 / self.length**2,
            noise=self.noise**2 * max(self.noise_time / step, 1.0),
            forget=-math.expm1(-step / self.memory_time),
            every=self.every,
        )

    def memory(self, parameters: GaussianProcessDesign) -> GaussianProcessMemory:
        """Return an empty dictionary."""
        size = parameters.budget + 1
        return GaussianProcessMemory(
            points=np.zeros((size, parameters.inputs)),
            kernel=np.zeros((size, size)),
            inverse=np.zeros((size, size)),
            covariance=np.zeros((size, size)),
            mean=np.zeros(size),
            weights=np.zeros(size),
            near=np.zeros(size),
            share=np.zeros(size),
            spread=np.zeros(size),
            place=np.zeros(2),
        )


class GaussianProcess(Online):
    """A Gaussian process on a bounded budget of points, which it chooses itself: no model of f at all, but that it is smooth.

    Where nothing was seen it says nothing.

    Parameters
    ----------
    budget
        number M of points it keeps. A sample costs O(M²).
    features
        what it is shown; the state by default.
    length
        over which f varies, in scaled features: those lie in [−1, 1].
    memory_time
        after which what was seen counts 1/e [s]; ``1000/omega_c`` by default.
    every
        learn from every so-many-th sample only; it predicts at each.
    noise
        standard deviation of what it can't explain, in units of the largest f.
    frequency, scale, bias_bandwidth
        as for ``Online``.

    Raises
    ------
    ValueError
        for arguments out of range.

    References
    ----------
    Van Vaerenbergh, Lázaro-Gredilla & Santamaría, *Kernel recursive least-squares tracker for time-varying regression*, IEEE Trans. Neural
    Networks and Learning Systems 23 (2012); Csató & Opper, *Sparse on-line Gaussian processes*, Neural Computation 14 (2002).
    """

    def __init__(
        self,
        budget: int = 40,
        features: Features | None = None,
        *,
        length: float = 0.5,
        memory_time: float | None = None,
        every: int = 4,
        noise: float = 0.1,
        frequency: float | None = None,
        scale: Any = None,
        bias_bandwidth: float | None = None,
    ) -> None:
        self.memory_time = (
            None if memory_time is None else checks.time_constant("memory_time", memory_time)
        )
        model = GaussianProcessModel(budget, length, every, 1.0, noise, 1.0)
        super().__init__(
            model,
            State() if features is None else features,
            frequency=frequency,
            scale=scale,
            bias_bandwidth=bias_bandwidth,
        )

    def fitted_model(self, observer: ESO, omega_c: float) -> GaussianProcessModel:
        """Return the process with memory and correlation of noise as observer and controller want them."""
        model: GaussianProcessModel = self.model
        return GaussianProcessModel(
            model.budget,
            model.length,
            model.every,
            self.memory_time or 1000.0 / omega_c,
            model.noise,
            observer.lag_time,
        )
