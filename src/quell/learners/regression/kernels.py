"""Learners that are linear in what they learn: ``f_L = θ · φ(x̂, u)``, with the observer's lag taken out exactly.

The features go through the observer's own lag filter (``lag.py``), so that

    Δf̂ + f_L^F = θ · φ^F + noise

is a regression without lag bias, whatever the features. How θ is found is the business of a *rule*: a NamedTuple for whose type
``update_theta`` and ``reset_uncertainty`` are registered (``nlms.py``, ``rls.py``).

*Scaling.* States, u and f are divided by powers of two (``scaling.py``), and all is learned in these units. When one of them grows, θ and
the filters are converted: for features that are products of signals exactly, so that nothing jumps. A nonlinear feature of such a state is
another function from then on, and is learned anew. It happens in the first motions, and where a motion is larger than all before.

*Rest.* What does not stand clear of noise is shown as its mean, and θ learns nothing while nothing moves (``noise_gate.py``): a load that comes
at rest says nothing about the features.

*What is left.* A fast bias d follows what θ does not explain, ``d' = λ (Δf̂ + f_L^F − θ·φ^F − d)``, and is fed forward with it. θ does not
know of d: two that learn from what both leave would share it at random.

*Input.* With ``Input()`` the last feature is u itself. f_L is then affine in u and the controller solves for u exactly; the effective gain
``(b0 + θ_u)/b0`` is kept in an interval, for where it goes to zero the loop's gain goes to infinity.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from quell.features.base import unit, write
from quell.features.scaling import Scaling, update_scale
from quell.kernels.dispatch import generic, is_finite, kernel
from quell.learners.base import adapt, coefficients, commit, predict, restart
from quell.learners.lag import lag_push
from quell.learners.noise_gate import (
    NoiseGate,
    NoiseGateMemory,
    confidence,
    gated,
    reset_gate,
    update_gate,
)
from quell.types import Matrix, Vector

# Where less than this share of what is seen can be a motion, nothing is learned from it: noise that is held is stronger than it looks.
_LEAST_SURE = 0.1

# Places in LinearMemory.place.
_SINCE, _SCALED, _LEFT, _OPEN = range(4)


@generic
def update_theta(
    rule: Any, memory: Any, theta: Vector, features: Vector, error: float, sure: float
) -> None:
    """Move ``theta`` (p,) so that ``error = target − θ·features`` becomes smaller; ``sure``, in (0, 1], says how little noise is in it."""
    raise TypeError


@generic
def reset_uncertainty(rule: Any, memory: Any) -> None:
    """Take what is known for uncertain again: the features have changed their meaning."""
    raise TypeError


class LinearDesign(NamedTuple):
    """Parameters of a linear learner with p features, for a plant of order n and an observer with N = n + 1 states."""

    features: Any
    scaling: Scaling
    gate: NoiseGate
    lag: Any
    rule: Any
    constant: int
    """Which feature is the constant 1; −1 for none."""
    with_u: bool
    slope_low: float
    """Least θ_u, in the plant's units."""
    slope_high: float
    depends: Matrix
    """(p, n + 1): 1 where a feature depends on a state, or on u."""
    follow: float
    """λ dt, at most 1."""
    watch: int
    """Samples after a start from rest in which nothing is learned."""


class LinearMemory(NamedTuple):
    """State of a linear learner."""

    theta: Vector
    """(p,), scaled."""
    scale: Vector
    """(n + 2,): what x_1 … x_n, u and f are divided by."""
    former: Vector
    """Room for ``scale`` as it was (n + 2,)."""
    shown: Vector
    """Room for the scaled state (n,)."""
    now: Vector
    """Room for the features (p,)."""
    units: Vector
    """(p,): ``unit`` of the features for ``scale``."""
    chain: Matrix
    """(p, N): the lag filters of the features."""
    filtered: Vector
    """(p,): what they show."""
    place: Vector
    """(4,): samples since the start from rest; whether there is a scale; d, in the plant's units; after which sample θ learns."""
    gate: NoiseGateMemory
    rule: Any


@adapt.register(LinearDesign)
def _adapt(
    learner: LinearDesign,
    memory: LinearMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    place, theta = memory.place, memory.theta
    moves = update_gate(learner.gate, memory.gate, seen, y, u_before)
    if place[_SINCE] <= learner.watch:
        return
    _rescale(learner, memory, seen, u_before, f_plain)
    if place[_SINCE] <= learner.watch:
        return
    scale = memory.scale
    error = f_plain / scale[scale.size - 1]
    for i in range(theta.size):
        error -= theta[i] * memory.filtered[i]
    if not is_finite(error):
        return
    place[_LEFT] += learner.follow * (error * scale[scale.size - 1] - place[_LEFT])
    sure = confidence(learner.gate, memory.gate, scale[0])
    if not moves or sure < _LEAST_SURE or place[_SINCE] <= place[_OPEN]:
        return
    update_theta(learner.rule, memory.rule, theta, memory.filtered, error, sure)
    if learner.with_u:
        last = theta.size - 1
        in_plant = scale[scale.size - 1] / scale[scale.size - 2]
        theta[last] = min(
            max(theta[last], learner.slope_low / in_plant), learner.slope_high / in_plant
        )


@kernel
def _rescale(learner: LinearDesign, memory: LinearMemory, seen: Vector, u: float, f: float) -> None:
    """Let the scales grow, and convert what is in their units."""
    theta, scale, former, units, new, chain = (
        memory.theta,
        memory.scale,
        memory.former,
        memory.units,
        memory.now,
        memory.chain,
    )
    for i in range(scale.size):
        former[i] = scale[i]
    update_scale(learner.scaling, scale, seen, u, f)
    if memory.place[_SCALED] == 0.0:
        # From now on there are features; what the observer showed until now was without them, so watch once more.
        memory.place[_SCALED] = 1.0
        memory.place[_SINCE] = 0.0
        unit(learner.features, scale, units)
        return
    last = scale.size - 1
    if scale[last] != former[last]:
        for i in range(theta.size):
            theta[i] *= former[last] / scale[last]
    grown = False
    for j in range(last):
        grown = grown or scale[j] != former[j]
    if not grown:
        return
    unit(learner.features, scale, new)
    touched = False
    for i in range(theta.size):
        moved = False
        for j in range(last):
            moved = moved or (scale[j] != former[j] and learner.depends[i, j] > 0.0)
        if not moved:
            continue
        touched = True
        ratio = new[i] / units[i]
        units[i] = new[i]
        if ratio == 1.0 or not ratio > 0.0:
            # Another function from now on: better silent than wrong, until the filter holds it and it has been learned anew.
            ratio = theta[i] = 0.0
            memory.place[_OPEN] = memory.place[_SINCE] + learner.watch
        else:
            theta[i] /= ratio
        memory.filtered[i] *= ratio
        for j in range(chain.shape[1]):
            chain[i, j] *= ratio
    if touched:
        reset_uncertainty(learner.rule, memory.rule)


@kernel
def _show(learner: LinearDesign, memory: LinearMemory, seen: Vector, u: float) -> None:
    """Write the features of the state and u into ``memory.now``."""
    scale, shown = memory.scale, memory.shown
    for i in range(shown.size):
        shown[i] = gated(learner.gate, memory.gate, i, seen[i]) / scale[i]
    write(
        learner.features,
        shown,
        gated(learner.gate, memory.gate, shown.size, u) / scale[shown.size],
        memory.now,
    )


@predict.register(LinearDesign)
def _predict(
    learner: LinearDesign, memory: LinearMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    if memory.place[_SCALED] == 0.0:
        return 0.0, 0.0
    theta, scale = memory.theta, memory.scale
    _show(learner, memory, seen, u_before)
    size = theta.size - 1 if learner.with_u else theta.size
    constant = 0.0
    for i in range(size):
        constant += theta[i] * memory.now[i]
    f_scale = scale[scale.size - 1]
    return f_scale * constant + memory.place[_LEFT], theta[size] * f_scale / scale[
        scale.size - 2
    ] if learner.with_u else 0.0


@commit.register(LinearDesign)
def _commit(
    learner: LinearDesign, memory: LinearMemory, seen: Vector, u: float, f_learned: float
) -> None:
    memory.place[_SINCE] += 1.0
    if memory.place[_SCALED] == 0.0:
        return
    _show(learner, memory, seen, u)
    for i in range(memory.filtered.size):
        memory.filtered[i] = lag_push(learner.lag, memory.chain, i, memory.now[i])


@restart.register(LinearDesign)
def _restart(learner: LinearDesign, memory: LinearMemory) -> None:
    memory.place[_SINCE] = memory.place[_LEFT] = memory.place[_OPEN] = 0.0
    for i in range(memory.filtered.size):
        memory.filtered[i] = 0.0
        for j in range(memory.chain.shape[1]):
            memory.chain[i, j] = 0.0
    reset_gate(memory.gate)
    finite = True
    for i in range(memory.theta.size):
        finite = finite and is_finite(memory.theta[i])
    if not finite:
        for i in range(memory.theta.size):
            memory.theta[i] = 0.0
        reset_uncertainty(learner.rule, memory.rule)


@coefficients.register(LinearDesign)
def _coefficients(learner: LinearDesign, memory: LinearMemory, theta: Vector) -> None:
    f_scale = memory.scale[memory.scale.size - 1]
    for i in range(theta.size):
        theta[i] = (
            memory.theta[i] * memory.units[i] * f_scale if memory.place[_SCALED] > 0.0 else 0.0
        )
    if learner.constant >= 0:
        theta[learner.constant] += memory.place[_LEFT]
