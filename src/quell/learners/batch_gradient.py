"""``BatchGradient``: Algorithm 1 of the paper, with its features or others.

The buffers of Algorithm 1 and its gradient step, O(p) a sample for any buffer size.

Three buffers of size n hold the newest features I, residuals ``ΔF = Δf̂`` and outputs
``F_L = h_θ(I)``. Once they are full, each sample replaces the oldest entry, takes one step down the
gradient of

    J(θ) = ½ Σ_i (h_θ(I_i) − f̂_i)²,        f̂_i = F_L,i + ΔF_i          (eq. (cost))

and relabels the whole batch, ``F_L = h_θ(I)`` (line 18). So the gradient at the next sample is

    ∇J = Σ_i (h_θ(I_i) − F_L,i − ΔF_i) I_i = −Σ_i Δf̂_i I_i

for any θ: a sliding sum, and F_L need not be stored (``outputs`` computes it). A sliding sum
drifts in floating point. So a second sum is built from the entries written since the ring last
wrapped around, and replaces the first when the ring wraps: no rounding error is older than 2n
samples, and every sample costs the same.

Algorithm 1 of the paper: batch gradient descent on the observer's own estimates.

``BatchGradient`` without features uses those of the paper, ``I = (x̂_1 … x̂_n, u, 1)``.

Algorithm 1 with user-defined features, scaled.

The method is the one above, with ``I = φ(x̂, u)``. The state, u and Δf̂ are divided by
powers of two (``features/base.py``). When a scale grows, θ is converted and the buffers are
filled again. Nothing is learned until the observer's initial transient has decayed: it would give
wrong scales.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.checks import Described
from quell.features import Features
from quell.features.base import (
    Indices,
    Scaling,
    checked_design,
    initial_scale,
    initial_sizes,
    reset_scale,
    reset_sizes,
    scale_by_sizes,
    scaling,
    unscaled_indices,
    update_scale,
    update_sizes,
    write,
    write_physical,
    write_units,
)
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.sized import Buffer, Flag, Scalars, Size, Work, clear
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    forget,
    meaning,
    predict,
    restart,
    startup_samples,
)
from quell.observers.eso import ESO
from quell.types import Vector

# ---- The buffers of Algorithm 1 and its gradient step, O(p) a sample for any buffer size ----


class Buffers(NamedTuple):
    """State of Algorithm 1 with p features and buffers of size n."""

    theta: Vector  # (p,)
    features: Buffer  # I (n, p), a ring
    residuals: Buffer  # ΔF (n,), a ring
    total: Vector  # Σ Δf̂ I over the ring (p,)
    fresh: Vector  # the same over the entries written since the ring last wrapped around (p,)
    current: Work  # work space for the newest features (p,)
    position: Vector  # (2,): row of the next entry; 1 once the ring has been full


def empty_buffers(n: int, p: int) -> Buffers:
    """Return empty buffers of size ``n`` and θ = 0 for ``p`` features."""
    rows = np.zeros((n, p)), np.zeros(n)
    return Buffers(np.zeros(p), *rows, np.zeros(p), np.zeros(p), np.zeros(p), np.zeros(2))


def outputs(memory: Buffers) -> Vector:
    """Return the buffer F_L (n,): the batch labelled with the newest θ."""
    return np.asarray(memory.features @ memory.theta)


@kernel
def take_step(memory: Buffers, residual: float, rate: float) -> None:
    """Put ``memory.current`` and ``residual`` into the buffers; if they are full, move θ."""
    position, size = memory.position, memory.residuals.size
    row = min(max(int(position[0]), 0), size - 1)
    oldest = memory.residuals[row]
    for i in range(memory.theta.size):
        gained = residual * memory.current[i]
        memory.total[i] += gained - oldest * memory.features[row, i]
        memory.fresh[i] += gained
        memory.features[row, i] = memory.current[i]
    memory.residuals[row] = residual
    row += 1
    if row == size:
        row = 0
        position[1] = 1.0
        for i in range(memory.theta.size):
            memory.total[i] = memory.fresh[i]
            memory.fresh[i] = 0.0
    position[0] = row
    if position[1] > 0.0:
        for i in range(memory.theta.size):
            memory.theta[i] += rate * memory.total[i]


@kernel
def clear_buffers(memory: Buffers) -> None:
    """Empty the buffers; keep θ."""
    for i in range(memory.theta.size):
        memory.total[i] = memory.fresh[i] = 0.0
        for k in range(memory.residuals.size):
            memory.features[k, i] = 0.0
    for k in range(memory.residuals.size):
        memory.residuals[k] = 0.0
    memory.position[0] = memory.position[1] = 0.0


@kernel
def restart_buffers(memory: Buffers) -> None:
    """Keep buffers and θ if θ and the sum are finite; else start from zero."""
    finite = True
    for i in range(memory.theta.size):
        finite = finite and is_finite(memory.theta[i]) and is_finite(memory.total[i])
    if not finite:
        forget_buffers(memory)


@kernel
def forget_buffers(memory: Buffers) -> None:
    """Start from zero."""
    for i in range(memory.theta.size):
        memory.theta[i] = 0.0
    clear_buffers(memory)


# ---- Algorithm 1 with user-defined features, scaled ----


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
    scaled: Work  # work space for the scaled state (m,)
    units: Vector  # (p,): ``unit`` of the features for ``scale``


@adapt.register(ScaledDesign)
def _adapt(
    learner: ScaledDesign,
    memory: ScaledMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    if memory.loop[0].samples <= learner.startup:
        return
    _rescale(learner, memory, estimates, u_before, f_plain)
    _write(learner, memory, estimates, u_before)
    residual = estimates[memory.scaled.size] / memory.scale[memory.scale.size - 1]
    take_step(memory.buffers, residual, learner.rate)


@kernel
def _rescale(
    learner: ScaledDesign, memory: ScaledMemory, estimates: Vector, u: float, f: float
) -> None:
    """Let the scales grow; if one does, convert θ and empty the buffers."""
    theta, current, scale = memory.buffers.theta, memory.buffers.current, memory.scale
    f_before = scale[scale.size - 1]
    before = after = 0.0
    for i in range(scale.size):
        before += scale[i]
    update_scale(learner.scaling, scale, estimates, u, f, True)
    for i in range(scale.size):
        after += scale[i]
    grown = after != before
    if learner.unscaled.size > 0:
        write_physical(learner.features, estimates[: memory.scaled.size], u, current)
        grown = update_sizes(learner.unscaled, memory.sizes, current, True) or grown
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


@meaning.register(ScaledDesign)
def _meaning(learner: ScaledDesign) -> Any:
    return learner.features, learner.unscaled, learner.batch


@kernel
def _write(learner: ScaledDesign, memory: ScaledMemory, estimates: Vector, u: float) -> None:
    """Write the scaled features into the buffers' ``current``."""
    scale, scaled, current = memory.scale, memory.scaled, memory.buffers.current
    write_physical(learner.features, estimates[: scaled.size], u, current)
    scale_by_sizes(learner.unscaled, memory.sizes, current)
    for i in range(scaled.size):
        scaled[i] = estimates[i] / scale[i]
    write(learner.features, scaled, u / scale[scaled.size], current)


@predict.register(ScaledDesign)
def _predict(
    learner: ScaledDesign, memory: ScaledMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    if memory.loop[0].has_scale == 0.0:
        return 0.0, 0.0
    _write(learner, memory, estimates, u_before)
    output = 0.0
    for i in range(memory.buffers.theta.size):
        output += memory.buffers.theta[i] * memory.buffers.current[i]
    return output * memory.scale[memory.scale.size - 1], 0.0


@commit.register(ScaledDesign)
def _commit(
    learner: ScaledDesign, memory: ScaledMemory, estimates: Vector, u: float, f_learned: float
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


# ---- Algorithm 1 of the paper ----


class BatchDesign(NamedTuple):
    """Parameters of Algorithm 1."""

    rate: float  # α, per sample
    batch: int  # n
    order: Size  # order of the plant; the bias is the last feature
    with_u: Flag  # whether u is a feature


@adapt.register(BatchDesign)
def _adapt_batch_gradient(
    learner: BatchDesign,
    memory: Buffers,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    for i in range(learner.order):
        memory.current[i] = estimates[i]
    if learner.with_u:
        memory.current[learner.order] = u_before
    memory.current[memory.theta.size - 1] = 1.0
    take_step(memory, estimates[learner.order], learner.rate)


@predict.register(BatchDesign)
def _predict_batch_gradient(
    learner: BatchDesign, memory: Buffers, estimates: Vector, u_before: float
) -> tuple[float, float]:
    output = memory.theta[memory.theta.size - 1]
    if learner.with_u:
        output = memory.theta[learner.order] * u_before + output
    for i in range(learner.order):
        output += memory.theta[i] * estimates[i]
    return output, 0.0


@commit.register(BatchDesign)
def _commit_batch_gradient(
    learner: BatchDesign, memory: Buffers, estimates: Vector, u: float, f_learned: float
) -> None:
    pass


@restart.register(BatchDesign)
def _restart_batch_gradient(learner: BatchDesign, memory: Buffers) -> None:
    restart_buffers(memory)


@forget.register(BatchDesign)
def _forget_batch_gradient(learner: BatchDesign, memory: Buffers) -> None:
    forget_buffers(memory)


@coefficients.register(BatchDesign)
def _coefficients_batch_gradient(learner: BatchDesign, memory: Buffers, theta: Vector) -> None:
    for i in range(theta.size):
        theta[i] = memory.theta[i]


@dataclass(frozen=True, repr=False)
class BatchGradient(Described):
    """Algorithm 1 of the paper, with the features ``(x̂_1 … x̂_n, u, 1)`` and θ from zero.

    It is included for comparison. As printed it is fragile: it is stable in a small range of rates,
    which shrinks when a disturbance comes (docs/paper). Use ``Kalman`` instead.

    Parameters
    ----------
    features
        other features, which are scaled to O(1), as is Δf̂; those of the
        paper, unscaled, by default.
    rate
        learning rate α, per sample. The cost is a sum over the batch, so the step grows with
        ``batch`` and, per unit of time, with 1/dt.
    batch
        size n of the three buffers, in samples.
    u
        whether u is one of the paper's features. Without it the algorithm does not learn the
        control law in place of the plant, and far larger rates are stable (docs/paper).

    Raises
    ------
    ValueError
        for a negative rate, a batch below 1, or something that is no block of features; for
        ``u = False`` beside ``features``, which say themselves what is used.
    """

    features: Features | None = None
    rate: float = 1e-6
    batch: int = 10
    u: bool = True

    def __post_init__(self) -> None:
        given: Any = self.features
        if not isinstance(given, Features | None):
            rule = "must be made of blocks, or None; give rate= and batch= by their names"
            raise ValueError(f"features = {self.features!r}: {rule}")
        checks.non_negative("rate", self.rate)
        checks.whole("batch", self.batch, 1)
        checks.flag("u", self.u)
        if self.features is not None and not self.u:
            raise ValueError("u = False: leave it out, as features say whether u is among them")

    def design(self, observer: ESO, omega_c: float) -> BatchDesign | ScaledDesign:
        """Return the parameters for an observer.

        The bandwidth ``omega_c`` [rad/s] is used only to scale features other than the paper's.
        """
        rate, order = float(self.rate), observer.order
        if self.features is None:
            return BatchDesign(rate, self.batch, order, self.u)
        return ScaledDesign(
            rate=rate,
            batch=self.batch,
            features=checked_design(self.features, order),
            unscaled=unscaled_indices(self.features, order),
            scaling=scaling(observer, omega_c, False),
            startup=startup_samples(observer),
        )

    def memory(self, parameters: Any) -> Buffers | ScaledMemory:
        """Return empty buffers and θ = 0."""
        if isinstance(parameters, BatchDesign):
            return empty_buffers(parameters.batch, parameters.order + 1 + parameters.with_u)
        scale = initial_scale(parameters.scaling)
        order = scale.size - 2
        p = len(self.feature_names(order))
        return ScaledMemory(
            buffers=empty_buffers(parameters.batch, p),
            loop=ScaledLoop.zeros(),
            scale=scale,
            sizes=initial_sizes(parameters.unscaled),
            scaled=np.zeros(order),
            units=np.ones(p),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1", …, "u", "bias")``, or the names of other features."""
        if self.features is None:
            return (*(f"x{i + 1}" for i in range(order)), *["u"] * self.u, "bias")
        return self.features.names(order)
