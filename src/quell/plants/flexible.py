"""Flexible axes: inertias in a chain, two masses and a spring, a cubic spring.

Inertias in a chain, with stiffness, damping and play in each coupling: a flexible axis.

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

Two masses, a spring that may harden or soften, and an actuator with lag.

The benchmark of Wie & Bernstein (1992) in the extended form of Rocchetta, Crespo & Kenny (*Solution
of the Benchmark Control Problem by Scenario Optimization*, DSCC 2019, doi
10.1115/DSCC2019-8949)::

    m1 x1'' = −p + λ F + w1          p = k (x1 − x2) + k_cubic (x1 − x2)³
    m2 x2'' =  p + w2                y = x2
    τ F'    = −F + u
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np

from quell import checks
from quell.checks import Described
from quell.hints import explained
from quell.kernels.dispatch import kernel
from quell.kernels.sized import Size
from quell.plants.base import Flow, advance, labelled, measure
from quell.plants.linear import LinearModel, LinearPlant
from quell.quantities import Signals
from quell.types import Matrix, Vector

# ---- Inertias in a chain, with stiffness, damping and play in each coupling ----

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
        both = (slice(i, i + 2), slice(i, i + 2))
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
    def flow(self) -> Flow:
        """The speed of the driven inertia."""
        return cast(Flow, getattr(self.linear, "flow"))  # noqa: B009  no field of a linear plant

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


@explained("quell.plants.n_mass([3e-4, 9e-4], [180.0])")
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
    linear = labelled(linear, *signals[:3], flow=np.eye(2 * n)[n].tolist())
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


# ---- The two-mass-spring benchmark of Wie & Bernstein (1992) ----

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
    plant = LinearPlant(A, E[:, 0], C, E, name="two-mass-spring")
    return labelled(plant, *SIGNALS[:3], flow=[0.0, 0.0, 1.0, 0.0])


# ---- Two masses, a spring that may harden or soften, and an actuator with lag ----


class CubicSpringModel(NamedTuple):
    """The sampled plant: its linear part and the impulses of the cubic spring."""

    linear: LinearModel
    impulse1: float  # velocity that m1 gains in half a sample at 1 m, ``−k_cubic dt / 2 m1``
    impulse2: float  # the same for m2, ``k_cubic dt / 2 m2``


@measure.register(CubicSpringModel)
def _measure_cubic_spring(plant: CubicSpringModel, x: Vector) -> float:
    return x[1]


@advance.register(CubicSpringModel)
def _advance_cubic_spring(
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
