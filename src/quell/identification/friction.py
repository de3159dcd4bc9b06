"""Coulomb friction as inputs of their own: minus the sign of a speed.

    A y = B u + F₁ v₁ + F₂ v₂,      v₁ = −sign(speed of what is driven),   v₂ = −sign(y')

Where everything turns one way the v are known, and the model stays linear in F. So they are found from the last model's own motion (at
first v₂ from the measured one), the parameters for these v, and so on until the v rest. A model with friction that is simulated takes
them from its own speeds. Where it stands still, a sign then changes at every sample, and its mean does what sticking does.

On what is measured, friction moves y″ at once: F₂ has degree n − 2. On what is driven it enters as u does; F₁ has degree 0. Up to order 3
the two move as one and there is v₂ alone. From order 4 on a spring may lie between. For two inertias J₁ (driven), J₂ and a spring k::

    J₂ y″ = k (θ₁ − y) − …     so   θ₁' = y' + y‴/ω_a²,     ω_a² = k/J₂

ω_a, the frequency at which the driven side stands still while the other swings, leaves no zero in y and is searched for: it lies below the
resonance ``ω_r² = ω_a² (1 + J₂/J₁)``.
"""

from __future__ import annotations

import numpy as np

from quell.identification.sampling import observable, sampled, states, states_with_friction
from quell.identification.structure import Structure
from quell.types import Matrix, Vector


def measured_sign(y: Vector, half_width: int) -> Vector:
    """Return minus the sign of the speed of ``y``, from its mean slope over so many samples either way."""
    index = np.arange(y.size)
    ahead, behind = np.minimum(index + half_width, y.size - 1), np.maximum(index - half_width, 0)
    return -np.sign(y[ahead] - y[behind])


def free_run(
    structure: Structure, theta: Vector, v: Matrix, own_friction: bool = False
) -> tuple[Vector, Matrix]:
    """Return y (N,) and the inputs; with ``own_friction`` those of friction are taken from the model's own speeds.

    ``structure.rubbing`` has 1/ω_a² for each of them [samples²], 0.0 for that of what is measured.
    """
    a, numerators = structure.denominator(theta), structure.numerators(theta)
    A = observable(a)
    system = sampled(A, np.ascontiguousarray(numerators[:, ::-1].T))
    start = structure.start(theta)[::-1]
    if not (own_friction and structure.rubbing):
        return states(system, v, start)[:, 0], v
    # y' and y‴ without what the inputs feed through; y = x_1
    slope = A[0]
    third = slope @ A @ A
    x, inputs = states_with_friction(
        system, v, np.array([slope + weight * third for weight in structure.rubbing]), start
    )
    return x[:, 0], inputs


def resonance(a: Vector) -> float:
    """Return the size of the least damped pair of poles [1/sample], 0.0 where all are real or unstable."""
    poles = np.roots(np.append(1.0, a[::-1]))
    pairs = poles[(poles.imag > 0.0) & (poles.real <= 0.0)]
    return float(np.abs(pairs[np.argmin(-pairs.real / np.abs(pairs))])) if pairs.size else 0.0
