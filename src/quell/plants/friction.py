"""A transfer function whose input acts against Coulomb friction, as identification finds it.

::

    x' = A x + B (u + w − σ F tanh(y'/v)),      y = x_1

σ is the sign of the gain from u to the motion, so that friction acts against it. In order 1 y is
the speed, and stands in the place of y'. v is small against the speeds of motion. The sign of the
speed is smooth, so that Runge-Kutta steps solve the equation; a plant at rest creeps slowly under
less than F.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.checks import Described
from quell.kernels.functions import tanh
from quell.plants.base import Plant, advance, measure
from quell.plants.linear import LinearPlant, delayed
from quell.plants.nonlinear import derivatives, runge_kutta
from quell.types import Matrix, Vector

# ---- A transfer function whose input acts against Coulomb friction ----

# Largest h |λ| of a sub-step h with the eigenvalue of largest magnitude at rest, as for nonlinear
# plants, and most sub-steps: beyond, friction is stiffer than any sample shows. By hand.
_LARGEST_STEP_FRICTION, _MOST_SUBSTEPS_FRICTION = 1.0, 1000


class FrictionModel(NamedTuple):
    """Parameters of a transfer function with friction."""

    A: Matrix  # observable companion form (n, n)
    B: Vector  # (n,)
    force: float  # σ F [u-unit]
    width: float  # v [y-unit/s]
    step: float  # length of a sub-step [s]
    substeps: int


@measure.register(FrictionModel)
def _measure_friction(plant: FrictionModel, x: Vector) -> float:
    return x[0]


@derivatives.register(FrictionModel)
def _derivatives_friction(
    plant: FrictionModel, t: float, x: Vector, u: float, w: Vector, dx: Vector
) -> None:
    n = plant.B.size
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += plant.A[i, j] * x[j]
        dx[i] = total
    speed = dx[0] if n > 1 else x[0]
    drive = u + w[0] - plant.force * tanh(speed / plant.width)
    for i in range(n):
        dx[i] += plant.B[i] * drive


advance.register(FrictionModel)(runge_kutta)


@dataclass(frozen=True, eq=False, repr=False)
class FrictionPlant(Described):
    """A transfer function with Coulomb friction: of order 1, or of relative degree 2 or more.

    Parameters
    ----------
    linear
        the plant without friction: for design.
    num, den
        its transfer function, highest power of s first.
    force
        Coulomb friction F [u-unit].
    width
        speed v at which three quarters of it act [y-unit/s].
    """

    linear: LinearPlant
    num: Vector
    den: Vector
    force: float
    width: float
    name: str = "plant with friction"
    disturbances = 1
    compiled = True

    def __post_init__(self) -> None:
        checks.positive("force", self.force, "u-unit")
        checks.positive("width", self.width, "y-unit/s")
        if self.den[0] == 0.0:
            raise ValueError(f"den[0] = {self.den[0]}: must not be zero; leave it out")
        if self.order > 1 and len(self.num) > self.order - 1:
            raise ValueError(
                f"num has {len(self.num)} coefficients, den {len(self.den)}: the relative degree "
                "must be 2 or more, or u moves the speed at once"
            )

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.den) - 1

    @property
    def signed_force(self) -> float:
        """F with the sign of the gain: friction acts against the motion that u causes [u-unit]."""
        return math.copysign(self.force, self.num[0] / self.den[0])

    def sampled(self, dt: float, interpret: bool = False) -> FrictionModel:
        """Return the parameters for a sample time ``dt`` [s]."""
        n, lead = self.order, float(self.den[0])
        A = np.diag(np.ones(n - 1), 1)
        A[:, 0] -= np.asarray(self.den[1:], dtype=np.float64) / lead
        B = np.zeros(n)
        B[n - len(self.num) :] = np.asarray(self.num, dtype=np.float64) / lead
        force = self.signed_force
        speed = A[0] if n > 1 else np.ones(1)
        at_rest = A - force / self.width * np.outer(B, speed)
        fastest = float(np.max(np.abs(np.linalg.eigvals(at_rest))))
        wanted = checks.positive("dt", dt, "s") * fastest / _LARGEST_STEP_FRICTION
        substeps = min(max(math.ceil(wanted), 1), _MOST_SUBSTEPS_FRICTION)
        return FrictionModel(A, B, force, self.width, dt / substeps, substeps)


# ---- A transfer function with the dry friction and the delay that an identification found ----


def with_friction_and_delay(
    linear: LinearPlant,
    num: Vector,
    den: Vector,
    force: float | None,
    width: float | None,
    delay: float,
    dt: float,
) -> Plant:
    """Return the plant ``linear`` for simulations, as identified.

    Parameters
    ----------
    linear
        the plant without friction and delay.
    num, den
        its transfer function, highest power of s first.
    force, width
        Coulomb friction [u-unit] and the speed at which three quarters of it act [y-unit/s]; None
        or zero for none.
    delay
        [s]; with friction rounded to a whole number of samples.
    dt
        sample time of the loop [s].
    """
    plant: Plant = linear
    if force and width:
        plant = FrictionPlant(linear, num, den, force, width, linear.name)
    if plant is not linear:
        delay = round(delay / dt) * dt
    return delayed(plant, delay, dt) if delay > 0.0 else plant
