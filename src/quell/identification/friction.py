"""Coulomb friction as an input of its own: minus the sign of the speed.

    A y = B u + F v,      v = −sign(y')

F has degree n − 2: friction on what is measured moves y'' at once, friction on what is driven has the numerator of u, and what rubs on both
is their sum. Where everything turns one way v is known, and the model stays linear in F; so v is found from the last model's own motion (at
first from the measured one), the parameters for that v, and so on until v rests. A model with friction that is simulated without
being told v takes it from its own speed. Where it stands still, the sign then changes at every sample and its mean does what sticking does.
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


def free_run(structure: Structure, theta: Vector, v: Matrix, own_friction: bool = False) -> tuple[Vector, Matrix]:
    """Return y (N,) and the inputs; with ``own_friction`` the last input is taken from the model's own speed."""
    a, numerators = structure.denominator(theta), structure.numerators(theta)
    system = sampled(observable(a), np.ascontiguousarray(numerators[:, ::-1].T))
    start = structure.start(theta)[::-1]
    if not own_friction:
        return states(system, v, start)[:, 0], v
    # x_1' = x_2 − a_{n−1} x_1, without what the inputs feed through
    speed = np.zeros(structure.order)
    speed[0] = -a[-1]
    if structure.order > 1:
        speed[1] = 1.0
    x, sign = states_with_friction(system, v, speed, start)
    return x[:, 0], np.column_stack([v[:, :-1], sign])
