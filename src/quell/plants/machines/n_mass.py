"""Inertias in a chain, with stiffness, damping and play in each coupling: a flexible axis.

The first inertia is driven. With the angles θ_i and the twist ``φ_i = θ_i − θ_{i+1}`` of the
coupling between inertia i and the next one::

    J_i θ_i'' = T_{i−1} − T_i − c_i θ_i' + w_i        (+ u for i = 1;  T_0 = T_N = 0)
    T_i       = k_i φ_i + d_i φ_i'                                       without play
    T_i       = max(k_i (φ_i − p_i/2) + d_i φ_i', 0)                     for φ_i > p_i/2
              = min(k_i (φ_i + p_i/2) + d_i φ_i', 0)                     for φ_i < −p_i/2
              = 0                                                        between

The play p_i is the whole angle over which the coupling is free. It is the model with a dead zone
(Nordin & Gutman, *Controlling mechanical systems with backlash – a survey*, Automatica 38 (2002),
section 3), with a damper that acts in contact only and cannot pull.

*Solution.* Without play it is a ``LinearPlant``, which is sampled exactly. With play, the linear
plant is advanced exactly over a sub-step, under the torques by which the couplings with play differ
from linear ones: those at the middle, which half a sub-step finds (the exponential midpoint rule:
Hochbruck & Ostermann, *Exponential integrators*, Acta Numerica 19 (2010), section 2). The error is
of order h², of order h where a damper comes into contact, and zero while couplings without damping
stay in contact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.kernels.dispatch import kernel
from quell.kernels.sized import Size
from quell.plants.base import advance, measure
from quell.plants.labelled import labelled
from quell.plants.linear import LinearModel, LinearPlant
from quell.quantities import Signals
from quell.types import Matrix, Vector

# A sub-step turns the fastest mode by at most so many radians: the period of a coupling in its play
# is then right to 3e-4.
_TURN = 0.05
# Most sub-steps of a sample: the fastest mode then has 80 periods in it.
_MOST_SUBSTEPS = 10_000


def chain_matrices(
    inertias: Sequence[float],
    stiffnesses: Sequence[float],
    dampings: Sequence[float],
    ground: Sequence[float],
) -> tuple[Matrix, Matrix]:
    """Return A (2N, 2N) of N inertias in a chain, and the inputs (2N, N) of torques on each.

    The states are the angles, then the speeds.

    Parameters
    ----------
    inertias
        N of them, above zero [kg m²], or masses [kg].
    stiffnesses, dampings
        of the N − 1 couplings [N m/rad, N m s/rad].
    ground
        viscous friction of each inertia [N m s/rad].
    """
    n = len(inertias)
    K, D = np.zeros((n, n)), np.diag(np.array(ground, dtype=np.float64))
    for i, (k, d) in enumerate(zip(stiffnesses, dampings, strict=True)):
        both = np.ix_((i, i + 1), (i, i + 1))
        K[both] += np.array([[k, -k], [-k, k]])
        D[both] += np.array([[d, -d], [-d, d]])
    J = np.array(inertias, dtype=np.float64)
    A, E = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, n))
    A[:n, n:] = np.eye(n)
    A[n:, :n], A[n:, n:] = (0.0 - part / J[:, None] for part in (K, D))
    E[n:] = np.diag(1.0 / J)
    return A, E


class NMassModel(NamedTuple):
    """Inertias in a chain with play, sampled at a sub-step.

    The disturbances of the linear models are torques at the loads, then torques that wind up each
    coupling.
    """

    whole: LinearModel  # over a sub-step
    half: LinearModel  # over half a sub-step
    substeps: int
    inertias: Size  # N
    stiffness: Vector  # k_i (N − 1,) [N m/rad]
    damping: Vector  # d_i (N − 1,) [N m s/rad]
    free: Vector  # p_i/2 (N − 1,) [rad]


@measure.register(NMassModel)
def _measure(plant: NMassModel, x: Vector) -> float:
    return measure(plant.whole, x)


@advance.register(NMassModel)
def _advance(plant: NMassModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector) -> None:
    order, loads, couplings = 2 * plant.inertias, w.size, plant.free.size
    middle = scratch[order : 2 * order]
    torques = scratch[2 * order : 2 * order + loads + couplings]
    for i in range(loads):
        torques[i] = w[i]
    for _ in range(plant.substeps):
        for i in range(order):
            middle[i] = x[i]
        _set_missing_torques(plant, x, torques, loads)
        advance(plant.half, middle, scratch, t, u, torques)
        _set_missing_torques(plant, middle, torques, loads)
        advance(plant.whole, x, scratch, t, u, torques)


@kernel
def _set_missing_torques(plant: NMassModel, x: Vector, torques: Vector, loads: int) -> None:
    """Set the torques that couplings with play lack against linear ones."""
    n = plant.inertias
    for i in range(plant.free.size):
        twist = x[i] - x[i + 1]
        linear = plant.stiffness[i] * twist + plant.damping[i] * (x[n + i] - x[n + i + 1])
        free, torque = plant.free[i], 0.0
        if free == 0.0:
            torque = linear
        elif twist > free:
            torque = max(linear - plant.stiffness[i] * free, 0.0)
        elif twist < -free:
            torque = min(linear + plant.stiffness[i] * free, 0.0)
        torques[loads + i] = linear - torque


@dataclass(frozen=True, eq=False)
class NMassPlant:
    """Inertias in a chain with play in a coupling; ``n_mass`` makes it.

    Its states are the angles, then the speeds.
    """

    linear: LinearPlant  #: the chain without play, from u to the sensor's angle: for design
    inertias: tuple[float, ...]  # J_i (N,) [kg m²]
    stiffnesses: tuple[float, ...]  # k_i (N − 1,) [N m/rad]
    dampings: tuple[float, ...]  # d_i (N − 1,) [N m s/rad]
    play: tuple[float, ...]  # p_i (N − 1,) [rad]
    signals: Signals
    name: str = "chain of inertias with play"
    compiled = True

    @property
    def order(self) -> int:
        """Number of states."""
        return self.linear.order

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs: torques on the loads."""
        return self.linear.disturbances

    def sampled(self, dt: float, interpret: bool = False) -> NMassModel:
        """Return the parameters for a sample time ``dt`` [s]."""
        fastest = float(np.max(np.abs(np.linalg.eigvals(self.linear.A))))
        substeps = max(math.ceil(checks.positive("dt", dt, "s") * fastest / _TURN), 1)
        if substeps > _MOST_SUBSTEPS:
            longest = _MOST_SUBSTEPS * _TURN / fastest
            rule = f"must be at most {longest:.3g} s with play and a mode at {fastest:.3g} rad/s"
            raise ValueError(f"dt = {dt!r} s: {rule}")
        n = len(self.inertias)
        winding = np.zeros((2 * n, n - 1))
        for i, J in enumerate(self.inertias[:-1]):
            winding[n + i, i] = 1.0 / J
            winding[n + i + 1, i] = -1.0 / self.inertias[i + 1]
        model = self.linear
        driven = LinearPlant(model.A, model.B, model.C, np.hstack([model.E, winding]))
        return NMassModel(
            whole=driven.sampled(dt / substeps),
            half=driven.sampled(0.5 * dt / substeps),
            substeps=substeps,
            inertias=n,
            stiffness=np.array(self.stiffnesses),
            damping=np.array(self.dampings),
            free=0.5 * np.array(self.play),
        )


def n_mass(
    inertias: Sequence[float],
    stiffnesses: Sequence[float],
    dampings: Sequence[float] | None = None,
    ground: Sequence[float] | None = None,
    play: Sequence[float] | None = None,
    sensor: int = 1,
    loads: Sequence[int] | None = None,
) -> LinearPlant | NMassPlant:
    """Return inertias in a chain of couplings, the first one driven: a flexible axis.

    States: the angles [rad] from the drive to the end of the chain, then their speeds [rad/s]. The
    control signal u is the torque on inertia 1 [N m]. Output: the angle of the inertia ``sensor``
    [rad]. For masses and springs read m, N and kg in place of rad, N m and kg m².

    Parameters
    ----------
    inertias
        J_i of at least one inertia, from the drive on [kg m²].
    stiffnesses
        k_i of the couplings [N m/rad], one fewer than inertias.
    dampings
        d_i of the couplings [N m s/rad]; none by default.
    ground
        viscous friction c_i of each inertia against the ground [N m s/rad]; none by default.
    play
        p_i, the whole angle over which each coupling is free [rad]; by default there is none, and
        the plant is a ``LinearPlant``.
    sensor
        number of the inertia whose angle is measured, counted from 1, the drive.
    loads
        numbers of the inertias on which a disturbance torque acts [N m], one for each entry; by
        default the last inertia only.

    Raises
    ------
    ValueError
        for an inertia or stiffness that is not positive, a damping, friction or play below zero,
        lists of unsuitable length, or the number of an inertia that does not exist.

    Examples
    --------
    An axis with its motor, a gear and a load, with the encoder at the load:

    >>> axis = n_mass([3.2e-4, 1e-4, 9e-4], [300.0, 180.0], [0.02, 0.02], sensor=3)
    >>> axis.order, axis.C.tolist()
    (6, [[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    """
    J = _entries("inertias", inertias, None, checks.positive, "kg m²")
    n = len(J)
    k = _entries("stiffnesses", stiffnesses, n - 1, checks.positive, "N m/rad")
    d = _entries("dampings", dampings, n - 1, checks.non_negative, "N m s/rad")
    c = _entries("ground", ground, n, checks.non_negative, "N m s/rad")
    p = _entries("play", play, n - 1, checks.non_negative, "rad")
    at = checks.whole("sensor", sensor, 1, n) - 1
    if loads is not None and (not checks.is_sequence(loads) or len(loads) == 0):
        raise ValueError(f"loads = {loads!r}: must be a list of numbers of inertias, as [{n}]")
    numbers = [n] if loads is None else list(loads)
    columns = [checks.whole(f"loads[{i}]", one, 1, n) - 1 for i, one in enumerate(numbers)]
    if len(set(columns)) < len(columns):
        raise ValueError(f"loads = {loads!r}: must have each inertia once")
    A, E = chain_matrices(J, k, d, c)
    signals = Signals.of(
        "angle [rad]", "torque [N m]", tuple(f"torque on inertia {i + 1} [N m]" for i in columns)
    )
    linear = LinearPlant(A, E[:, 0], np.eye(2 * n)[at], E[:, columns], name="chain of inertias")
    linear = labelled(linear, *signals[:3])
    if not any(p):
        return linear
    return NMassPlant(linear, J, k, d, p, signals)


def _entries(name: str, given: Any, count: int | None, check: Any, unit: str) -> tuple[float, ...]:
    """Return the numbers of a list of that length, checked one by one; zeros for None."""
    if given is None:
        return (0.0,) * (count or 0)
    if not checks.is_sequence(given) and np.ndim(given) != 1:
        raise ValueError(f"{name} = {given!r}: must be a list of numbers [{unit}]")
    values = tuple(given)
    if count is None and not values:
        raise ValueError(f"{name} = {given!r}: must have at least one entry")
    if count is not None and len(values) != count:
        rule = f"must have {count} entries for {_inertias(name, count)}"
        raise ValueError(f"{name} has {len(values)} entries: {rule}")
    return tuple(check(f"{name}[{i}]", value, unit) for i, value in enumerate(values))


def _inertias(name: str, count: int) -> str:
    return f"{count} inertias" if name == "ground" else f"{count + 1} inertias in a chain"
