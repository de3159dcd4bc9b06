"""Algorithm 1 on features of one's own choice, scaled.

The same sliding sum as in ``gradient.py``, with ``I = φ(x̂, u)``; the state, u and Δf̂ are divided by powers of two (``scaling.py``). When
one of these grows, θ is converted as in ``regression.py`` and the buffers are filled anew. Until the observer has forgotten its start
nothing is pushed: there is no scale to be had from its transient.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell.features import Features
from quell.features.base import checked_design, unit, write
from quell.features.scaling import Scaling, scaling, update_scale
from quell.kernels.dispatch import is_finite, kernel
from quell.learners.base import adapt, coefficients, commit, predict, restart
from quell.learners.lag import startup_samples
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# Places in FeatureGradientMemory.place.
_AT, _FULL, _SINCE, _SCALED = range(4)


class FeatureGradientDesign(NamedTuple):
    """Parameters."""

    rate: float
    """α, a sample."""
    batch: int
    """n."""
    features: Any
    scaling: Scaling
    watch: int
    """Samples after a start from rest in which nothing is learned."""


class FeatureGradientMemory(NamedTuple):
    """State, with p features."""

    theta: Vector
    """(p,), scaled."""
    features: Matrix
    """I (n, p), a ring."""
    residuals: Vector
    """ΔF (n,), a ring."""
    total: Vector
    """Σ Δf̂ I over the ring (p,)."""
    fresh: Vector
    """The same over what was pushed since the ring last came round (p,)."""
    place: Vector
    """(4,): where the next datum goes; whether the ring has been full; samples since the start; whether there is a scale."""
    scale: Vector
    """(n + 2,)."""
    shown: Vector
    """Room for the scaled state."""
    now: Vector
    """Room for the features (p,)."""
    units: Vector
    """(p,): ``unit`` of the features for ``scale``."""


def feature_gradient_design(
    rate: float, batch: int, features: Features, observer: ESO, frequency: float
) -> FeatureGradientDesign:
    """Return the parameters for an observer and a frequency the plant has [rad/s]."""
    return FeatureGradientDesign(
        rate=rate,
        batch=batch,
        features=checked_design(features, observer.order),
        scaling=scaling(observer, frequency, False),
        watch=startup_samples(observer),
    )


def feature_gradient_memory(design: FeatureGradientDesign, p: int) -> FeatureGradientMemory:
    """Return empty buffers and θ = 0, for p features."""
    n, size = design.batch, design.scaling.floors.size
    return FeatureGradientMemory(
        theta=np.zeros(p),
        features=np.zeros((n, p)),
        residuals=np.zeros(n),
        total=np.zeros(p),
        fresh=np.zeros(p),
        place=np.zeros(4),
        scale=np.full(size, 1e-100),
        shown=np.zeros(size - 2),
        now=np.zeros(p),
        units=np.ones(p),
    )


@adapt.register(FeatureGradientDesign)
def _adapt(
    learner: FeatureGradientDesign,
    memory: FeatureGradientMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    place, theta, total, fresh = memory.place, memory.theta, memory.total, memory.fresh
    if place[_SINCE] <= learner.watch:
        return
    _rescale(learner, memory, seen, u_before, f_plain)
    _show(learner, memory, seen, u_before)
    at = min(max(int(place[_AT]), 0), learner.batch - 1)
    residual = seen[seen.size - 1] / memory.scale[memory.scale.size - 1]
    oldest = memory.residuals[at]
    for i in range(theta.size):
        gained = residual * memory.now[i]
        total[i] += gained - oldest * memory.features[at, i]
        fresh[i] += gained
        memory.features[at, i] = memory.now[i]
    memory.residuals[at] = residual
    at += 1
    if at == learner.batch:
        at = 0
        place[_FULL] = 1.0
        for i in range(theta.size):
            total[i] = fresh[i]
            fresh[i] = 0.0
    place[_AT] = at
    if place[_FULL] > 0.0:
        for i in range(theta.size):
            theta[i] += learner.rate * total[i]


@kernel
def _rescale(
    learner: FeatureGradientDesign, memory: FeatureGradientMemory, seen: Vector, u: float, f: float
) -> None:
    theta, scale = memory.theta, memory.scale
    f_before = scale[scale.size - 1]
    before = after = 0.0
    for i in range(scale.size):
        before += scale[i]
    update_scale(learner.scaling, scale, seen, u, f)
    for i in range(scale.size):
        after += scale[i]
    if after == before:
        return
    unit(learner.features, scale, memory.now)
    for i in range(theta.size):
        ratio = memory.now[i] / memory.units[i]
        if memory.place[_SCALED] > 0.0 and 0.0 < ratio <= 1.0:
            theta[i] *= f_before / scale[scale.size - 1] / ratio
        memory.units[i] = memory.now[i]
    memory.place[_SCALED] = 1.0
    _empty(memory)


@kernel
def _empty(memory: FeatureGradientMemory) -> None:
    for i in range(memory.theta.size):
        memory.total[i] = memory.fresh[i] = 0.0
        for k in range(memory.residuals.size):
            memory.features[k, i] = 0.0
    for k in range(memory.residuals.size):
        memory.residuals[k] = 0.0
    memory.place[_AT] = memory.place[_FULL] = 0.0


@kernel
def _show(
    learner: FeatureGradientDesign, memory: FeatureGradientMemory, seen: Vector, u: float
) -> None:
    scale, shown = memory.scale, memory.shown
    for i in range(shown.size):
        shown[i] = seen[i] / scale[i]
    write(learner.features, shown, u / scale[shown.size], memory.now)


@predict.register(FeatureGradientDesign)
def _predict(
    learner: FeatureGradientDesign, memory: FeatureGradientMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    if memory.place[_SCALED] == 0.0:
        return 0.0, 0.0
    _show(learner, memory, seen, u_before)
    output = 0.0
    for i in range(memory.theta.size):
        output += memory.theta[i] * memory.now[i]
    return output * memory.scale[memory.scale.size - 1], 0.0


@commit.register(FeatureGradientDesign)
def _commit(
    learner: FeatureGradientDesign,
    memory: FeatureGradientMemory,
    seen: Vector,
    u: float,
    f_learned: float,
) -> None:
    memory.place[_SINCE] += 1.0


@restart.register(FeatureGradientDesign)
def _restart(learner: FeatureGradientDesign, memory: FeatureGradientMemory) -> None:
    memory.place[_SINCE] = 0.0
    finite = True
    for i in range(memory.theta.size):
        finite = finite and is_finite(memory.theta[i]) and is_finite(memory.total[i])
    if not finite:
        for i in range(memory.theta.size):
            memory.theta[i] = 0.0
        _empty(memory)


@coefficients.register(FeatureGradientDesign)
def _coefficients(
    learner: FeatureGradientDesign, memory: FeatureGradientMemory, theta: Vector
) -> None:
    for i in range(theta.size):
        theta[i] = (
            memory.theta[i] * memory.units[i] * memory.scale[memory.scale.size - 1]
            if memory.place[_SCALED] > 0.0
            else 0.0
        )
