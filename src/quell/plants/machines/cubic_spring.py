"""Two masses, a spring that may harden or soften, and an actuator with lag.

The benchmark of Wie & Bernstein (1992) in the extended form of Rocchetta, Crespo & Kenny (*Solution
of the Benchmark Control Problem by Scenario Optimization*, DSCC 2019, doi
10.1115/DSCC2019-8949)::

    m1 x1'' = −p + λ F + w1          p = k (x1 − x2) + k_cubic (x1 − x2)³
    m2 x2'' =  p + w2                y = x2
    τ F'    = −F + u
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.described import Described
from quell.kernels.dispatch import kernel
from quell.plants.base import advance, measure
from quell.plants.labelled import labelled
from quell.plants.linear import LinearModel, LinearPlant
from quell.plants.machines.two_mass_spring import SIGNALS, two_mass_matrices
from quell.types import Vector


class CubicSpringModel(NamedTuple):
    """The sampled plant: its linear part and the impulses of the cubic spring."""

    linear: LinearModel
    impulse1: float  # velocity that m1 gains in half a sample at 1 m, ``−k_cubic dt / 2 m1``
    impulse2: float  # the same for m2, ``k_cubic dt / 2 m2``


@measure.register(CubicSpringModel)
def _measure(plant: CubicSpringModel, x: Vector) -> float:
    return x[1]


@advance.register(CubicSpringModel)
def _advance(
    plant: CubicSpringModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    _apply_cubic_force(plant, x)
    advance(plant.linear, x, scratch, t, u, w)
    _apply_cubic_force(plant, x)


@kernel
def _apply_cubic_force(plant: CubicSpringModel, x: Vector) -> None:
    cube = (x[0] - x[1]) ** 3
    x[2] += plant.impulse1 * cube
    x[3] += plant.impulse2 * cube


@dataclass(frozen=True, eq=False, repr=False)
class CubicSpringPlant(Described):
    """Two masses with a cubic spring; ``lagged_two_mass_spring`` makes it.

    It is solved by Strang splitting (Hairer, Lubich & Wanner, *Geometric Numerical Integration*,
    II.5): half the impulse of the cubic force, the linear plant exactly for a whole sample, the
    other half. The error is of order dt²; the linear part, however stiff, has none.
    """

    linear: LinearPlant
    m1: float
    m2: float
    k_cubic: float
    name: str = "two-mass-spring with cubic spring"
    compiled = True
    signals = SIGNALS

    @property
    def order(self) -> int:
        """Number of states."""
        return self.linear.order

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs."""
        return self.linear.disturbances

    def sampled(self, dt: float, interpret: bool = False) -> CubicSpringModel:
        """Return the parameters for a sample time ``dt`` [s]."""
        half = 0.5 * self.k_cubic * checks.positive("dt", dt, "s")
        return CubicSpringModel(self.linear.sampled(dt), -half / self.m1, half / self.m2)


def lagged_two_mass_spring(
    m1: float = 1.0,
    m2: float = 1.0,
    k: float = 1.0,
    k_cubic: float | None = None,
    effectiveness: float = 1.0,
    lag: float = 0.01,
) -> LinearPlant | CubicSpringPlant:
    """Return two masses on a spring, driven by an actuator with lag.

    States: positions of m1 and m2 [m], their velocities [m/s], the actuator's force before its
    effectiveness [N]. The control signal u [N] drives the actuator; the disturbance forces w1 and
    w2 act on m1 and m2 [N]. Output ``y = x2`` [m]. A unit impulse on m2 at t = 0 is the start from
    ``x0 = (0, 0, 0, 1/m2, 0)``.

    Parameters
    ----------
    m1, m2
        masses [kg].
    k
        stiffness of the spring [N/m].
    k_cubic
        its cubic part [N/m³]: hardening above zero, softening below; by default there is none, and
        the plant is a ``LinearPlant``.
    effectiveness
        share λ of the actuator's force that reaches m1.
    lag
        its time constant τ [s].

    Raises
    ------
    ValueError
        for a mass, stiffness, effectiveness or lag that is not positive, or a ``k_cubic`` that is
        not finite.
    """
    masses, forces = two_mass_matrices(m1, m2, k)
    effectiveness = checks.positive("effectiveness", effectiveness)
    lag = checks.positive("lag", lag, "s")
    A, E = np.zeros((5, 5)), np.zeros((5, 2))
    A[:4, :4], E[:4] = masses, forces
    A[2, 4], A[4, 4] = effectiveness / float(m1), -1.0 / lag
    B, C = [0.0, 0.0, 0.0, 0.0, 1.0 / lag], [0.0, 1.0, 0.0, 0.0, 0.0]
    linear = labelled(LinearPlant(A, B, C, E, name="two-mass-spring with lag"), *SIGNALS[:3])
    if k_cubic is None:
        return linear
    return CubicSpringPlant(linear, float(m1), float(m2), checks.finite("k_cubic", k_cubic))
