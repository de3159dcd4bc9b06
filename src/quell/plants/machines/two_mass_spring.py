"""The two-mass-spring benchmark of Wie & Bernstein (1992)."""

from __future__ import annotations

from quell import checks
from quell.plants.labelled import labelled
from quell.plants.linear import LinearPlant
from quell.plants.machines.n_mass import chain_matrices
from quell.quantities import Signals
from quell.types import Matrix

SIGNALS = Signals.of("position [m]", "force [N]", ("force on m1 [N]", "force on m2 [N]"))
"""Names and units of the signals of two masses that a force drives."""


def two_mass_matrices(m1: float, m2: float, k: float) -> tuple[Matrix, Matrix]:
    """Return A (4, 4) and the inputs (4, 2) of forces on both masses; the arguments are checked."""
    m1, m2 = checks.positive("m1", m1, "kg"), checks.positive("m2", m2, "kg")
    k = checks.positive("k", k, "N/m")
    return chain_matrices((m1, m2), (k,), (0.0,), (0.0, 0.0))


def two_mass_spring(
    m1: float = 1.0, m2: float = 1.0, k: float = 1.0, c1: float = 0.0, c2: float = 1.0
) -> LinearPlant:
    """Return the two-mass-spring system (paper eq. (two-mass)), without friction.

    States: positions of m1 and m2 [m], their velocities [m/s]. The control force u [N] acts on m1,
    the disturbance forces w1 on m1 and w2 on m2 [N]. Output ``y = c1 x1 + c2 x2`` [m]. For the
    default ``y = x2``, eq. (4order)::

        y⁗ = −k (m1 + m2)/(m1 m2) y'' + k/(m1 m2) (u + w1 + w2) + w2''/m2

    Parameters
    ----------
    m1, m2
        masses [kg].
    k
        stiffness of the spring [N/m].
    c1, c2
        weights of the positions in y.

    Raises
    ------
    ValueError
        for a mass or stiffness that is not positive, or if c1 and c2 are both zero.
    """
    A, E = two_mass_matrices(m1, m2, k)
    c1, c2 = checks.finite("c1", c1), checks.finite("c2", c2)
    if c1 == 0.0 and c2 == 0.0:
        raise ValueError(
            "c1 = 0.0, c2 = 0.0: at least one must differ from zero, or nothing is measured"
        )
    C = [c1, c2, 0.0, 0.0]
    return labelled(LinearPlant(A, E[:, 0], C, E, name="two-mass-spring"), *SIGNALS[:3])
