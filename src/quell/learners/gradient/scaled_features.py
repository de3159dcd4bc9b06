"""Algorithm 1 with user-defined features, scaled.

``buffers.py`` describes the method; here ``I = φ(x̂, u)``. The state, u and Δf̂ are divided by
powers of two (``features/scaling.py``). When a scale grows, θ is converted and the buffers are
filled again. Nothing is learned until the observer's initial transient has decayed: it would give
wrong scales.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

from quell.features.base import write, write_physical
from quell.features.scaling import Scaling, reset_scale, update_scale
from quell.features.sizes import (
    Indices,
    reset_sizes,
    scale_by_sizes,
    update_sizes,
    write_units,
)
from quell.kernels.dispatch import kernel
from quell.kernels.scalars import Scalars, clear
from quell.learners.base import adapt, coefficients, commit, forget, predict, restart
from quell.learners.gradient.buffers import (
    Buffers,
    clear_buffers,
    forget_buffers,
    restart_buffers,
    take_step,
)
from quell.types import Vector


class ScaledDesign(NamedTuple):
    """Parameters."""

    rate: float  # α, per sample
    batch: int  # n
    features: Any
    unscaled: Indices  # of the features whose size is unknown (k,)
    scaling: Scaling
    startup: int  # samples after a start from rest in which nothing is learned


class ScaledLoop(Scalars):
    """Scalars of the learner, kept from one sample to the next."""

    samples: float  # since the start from rest
    has_scale: float  # 1 once there are scales


class ScaledMemory(NamedTuple):
    """State for p features and a plant of order m."""

    buffers: Buffers  # all scaled
    loop: NDArray[ScaledLoop]
    scale: Vector  # (m + 2,): what x_1 … x_m, u and Δf̂ are divided by
    sizes: Vector  # (k,): what features of unknown size are divided by
    scaled: Vector  # work space for the scaled state (m,)
    units: Vector  # (p,): ``unit`` of the features for ``scale``


@adapt.register(ScaledDesign)
def _adapt(
    learner: ScaledDesign,
    memory: ScaledMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    if memory.loop[0].samples <= learner.startup:
        return
    _rescale(learner, memory, seen, u_before, f_plain)
    _write(learner, memory, seen, u_before)
    residual = seen[memory.scaled.size] / memory.scale[memory.scale.size - 1]
    take_step(memory.buffers, residual, learner.rate)


@kernel
def _rescale(learner: ScaledDesign, memory: ScaledMemory, seen: Vector, u: float, f: float) -> None:
    """Let the scales grow; if one does, convert θ and empty the buffers."""
    theta, current, scale = memory.buffers.theta, memory.buffers.current, memory.scale
    f_before = scale[scale.size - 1]
    before = after = 0.0
    for i in range(scale.size):
        before += scale[i]
    update_scale(learner.scaling, scale, seen, u, f)
    for i in range(scale.size):
        after += scale[i]
    grown = after != before
    if learner.unscaled.size > 0:
        write_physical(learner.features, seen[: memory.scaled.size], u, current)
        grown = update_sizes(learner.unscaled, memory.sizes, current) or grown
    if not grown:
        return
    write_units(learner.features, learner.unscaled, scale, memory.sizes, current)
    for i in range(theta.size):
        ratio = current[i] / memory.units[i]
        if memory.loop[0].has_scale > 0.0 and 0.0 < ratio <= 1.0:
            theta[i] *= f_before / scale[scale.size - 1] / ratio
        memory.units[i] = current[i]
    memory.loop[0].has_scale = 1.0
    clear_buffers(memory.buffers)


@kernel
def _write(learner: ScaledDesign, memory: ScaledMemory, seen: Vector, u: float) -> None:
    """Write the scaled features into the buffers' ``current``."""
    scale, scaled, current = memory.scale, memory.scaled, memory.buffers.current
    write_physical(learner.features, seen[: scaled.size], u, current)
    scale_by_sizes(learner.unscaled, memory.sizes, current)
    for i in range(scaled.size):
        scaled[i] = seen[i] / scale[i]
    write(learner.features, scaled, u / scale[scaled.size], current)


@predict.register(ScaledDesign)
def _predict(
    learner: ScaledDesign, memory: ScaledMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    if memory.loop[0].has_scale == 0.0:
        return 0.0, 0.0
    _write(learner, memory, seen, u_before)
    output = 0.0
    for i in range(memory.buffers.theta.size):
        output += memory.buffers.theta[i] * memory.buffers.current[i]
    return output * memory.scale[memory.scale.size - 1], 0.0


@commit.register(ScaledDesign)
def _commit(
    learner: ScaledDesign, memory: ScaledMemory, seen: Vector, u: float, f_learned: float
) -> None:
    memory.loop[0].samples += 1.0


@restart.register(ScaledDesign)
def _restart(learner: ScaledDesign, memory: ScaledMemory) -> None:
    memory.loop[0].samples = 0.0
    restart_buffers(memory.buffers)


@forget.register(ScaledDesign)
def _forget(learner: ScaledDesign, memory: ScaledMemory) -> None:
    forget_buffers(memory.buffers)
    clear(memory.loop)
    reset_scale(learner.scaling, memory.scale)
    reset_sizes(memory.sizes)
    for i in range(memory.units.size):
        memory.units[i] = 1.0


@coefficients.register(ScaledDesign)
def _coefficients(learner: ScaledDesign, memory: ScaledMemory, theta: Vector) -> None:
    f_scale, scaled = memory.scale[memory.scale.size - 1], memory.loop[0].has_scale > 0.0
    for i in range(theta.size):
        theta[i] = memory.buffers.theta[i] * memory.units[i] * f_scale if scaled else 0.0
