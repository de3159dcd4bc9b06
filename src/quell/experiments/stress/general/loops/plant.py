"""One type of plant for all loops of the trial, so that each order of controller compiles once.

A linear plant, padded with zeros to ``STATES`` states, with a dead time, a limit that the
controller does not know, friction, gravity and a quantised output, each of which may be absent::

    x' = A x + B sat(u(t − τ)) + E w + D (p + h),   y = C x, rounded to multiples of the quantum
    p  = −strength sin(rate C x)                      gravity, at the place where friction acts
    h  = −friction sign(v), |h| ≤ friction at v = 0   v a state, D its force input

The linear part is exact for forces that are held over a sample. Gravity is taken in the middle of
the sample. Friction is what brings v to zero within the sample, or ``±friction`` if that is too
little (Moreau's time stepping: Acary & Brogliato, *Numerical Methods for Nonsmooth Dynamical
Systems*, 2008, section 10.1), so a plant at rest stays there, to rounding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quell.lti.discretize import zero_order_hold
from quell.plants import LinearPlant
from quell.plants.base import advance, measure
from quell.types import Matrix, Vector

STATES = 5
"""States of each plant without its dead time: order 4 and an actuator's lag."""


class GeneralModel(NamedTuple):
    """The plant, sampled."""

    transition: Matrix  # Φ (STATES, STATES)
    input: Vector  # Γ (STATES,)
    disturbance: Vector  # Γ_w (STATES,)
    force: Vector  # Γ_D (STATES,)
    output: Vector  # C (STATES,)
    velocity: int  # index of the state v
    friction: float
    strength: float
    rate: float  # [1/y-unit]
    dt: float
    limit: float  # of |u|
    quantum: float  # [y-unit]; zero for none


@measure.register(GeneralModel)
def _measure(plant: GeneralModel, x: Vector) -> float:
    y = 0.0
    for i in range(plant.output.size):
        y += plant.output[i] * x[i]
    if plant.quantum > 0.0:
        y = plant.quantum * np.floor(y / plant.quantum + 0.5)
    return y


@advance.register(GeneralModel)
def _advance(
    plant: GeneralModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    size, last = plant.output.size, x.size - 1
    if last >= size:
        arriving = x[last]
        for i in range(last, size, -1):
            x[i] = x[i - 1]
        x[size] = u
        u = arriving
    u = min(max(u, -plant.limit), plant.limit)
    p = 0.0
    if plant.strength != 0.0:
        y, rate = 0.0, 0.0
        for i in range(size):
            y += plant.output[i] * x[i]
        rate = x[plant.velocity] if plant.velocity > 0 else 0.0
        p = -plant.strength * math.sin(plant.rate * (y + 0.5 * plant.dt * rate))
    for i in range(size):
        total = plant.input[i] * u + plant.disturbance[i] * w[0] + plant.force[i] * p
        for j in range(size):
            total += plant.transition[i, j] * x[j]
        scratch[i] = total
    if plant.friction > 0.0:
        v = plant.velocity
        h = -scratch[v] / plant.force[v]
        h = min(max(h, -plant.friction), plant.friction)
        for i in range(size):
            scratch[i] += plant.force[i] * h
    for i in range(size):
        x[i] = scratch[i]


@dataclass(frozen=True, eq=False)
class GeneralPlant:
    """A linear plant of up to ``STATES`` states with what real plants have besides.

    Parameters
    ----------
    linear
        its linear part, with one disturbance input.
    delay
        dead time in samples.
    limit
        of ``|u|`` [u-unit], which the controller does not know.
    quantum
        of y [y-unit]; zero for none.
    velocity
        index of the state on which friction and gravity act; its derivative contains their sum.
        Gravity takes it for the velocity of y unless it is zero.
    friction
        Coulomb friction, in units of that derivative.
    strength, rate
        of gravity, ``−strength sin(rate y)`` [1/y-unit].
    """

    linear: LinearPlant
    delay: int = 0
    limit: float = math.inf
    quantum: float = 0.0
    velocity: int = 0
    friction: float = 0.0
    strength: float = 0.0
    rate: float = 1.0
    name: str = "general plant"
    compiled = True

    @property
    def order(self) -> int:
        """Number of states, including the delayed values of u."""
        return STATES + self.delay

    @property
    def disturbances(self) -> int:
        """One."""
        return 1

    def sampled(self, dt: float, interpret: bool = False) -> GeneralModel:
        """Return the parameters for a sample time ``dt`` [s]."""
        n = self.linear.order
        force = np.zeros((n, 1))
        force[self.velocity] = 1.0
        inputs = [self.linear.B, self.linear.E, force]
        phi, columns = zero_order_hold(self.linear.A, inputs, dt)
        transition = np.zeros((STATES, STATES))
        transition[:n, :n] = phi

        def padded(column: Matrix) -> Vector:
            return np.concatenate([np.ravel(column), np.zeros(STATES - n)])

        return GeneralModel(
            transition=transition,
            input=padded(columns[0]),
            disturbance=padded(columns[1]),
            force=padded(columns[2]),
            output=padded(self.linear.C),
            velocity=self.velocity,
            friction=self.friction,
            strength=self.strength,
            rate=self.rate,
            dt=dt,
            limit=self.limit,
            quantum=self.quantum,
        )
