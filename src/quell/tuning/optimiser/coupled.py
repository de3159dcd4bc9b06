"""The bandwidths of several axes in one loop: measures for given bandwidths, and their search.

With G_v the plant from v to y, ``u = R v``, and C the diagonal of the axes' feedbacks from −y to
v, the loop is judged in all channels (``analysis/multivariable.py``)::

    S_o = (I + G_v C)⁻¹,   T_o = I − S_o,   T_u = R C S_o G_u,   S_u = I − T_u

An entry on the diagonal of S is the sensitivity of this channel with the loops of all others
closed. The structured singular value of ``S − I/2``, of which the disk margin is the inverse, is
bounded by the singular value with balanced rows and columns: this is exact or on the safe side.

The search is over the logarithms of omega_c and omega_o of all axes together. Rounds of sequential
quadratic programming (SLSQP; Nocedal & Wright, *Numerical Optimization*, 2nd ed. 2006, chapter 18)
in a box, with one constraint for the largest peak of each channel with each plant.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.analysis.disk import balanced, singular
from quell.analysis.margins import Complex, Response, eigenvalues, frequencies, in_s_plane
from quell.analysis.matrices import joined
from quell.controllers.adrc import ADRC
from quell.controllers.linear import LinearLaw
from quell.lti.models import MatrixSystem, System
from quell.observers.eso import with_gains
from quell.tuning.optimiser.loops import area_of_step, law_of
from quell.tuning.optimiser.requirements import Pole, counted_of, modes_of
from quell.types import DesignWarning, Matrix, Vector

# Points of the grid per decade, and its lowest frequency in units of half the sampling rate.
_POINTS_PER_DECADE, _LOWEST = 24, 1e-5
# Laws that are kept: those of a difference quotient and some more.
_KEPT = 64
# The response to a load ends after so many time constants of the slowest pole, when a share of e⁻²⁰
# is left.
_TIME_CONSTANTS = 20.0
# What an unstable loop costs, in units of the cost alone: more than any search gains.
_UNSTABLE = 100.0
UNSTABLE = -1.0
"""The last slack of a plant, of its poles, is at most this for an unstable loop."""


class Plant(NamedTuple):
    """One plant of the set, sampled, with its delays as states, and what makes u of v."""

    A: Matrix  # (n, n)
    B: Matrix  # from u (n, m)
    C: Matrix  # (p, n)
    R: Matrix  # B0⁻¹ at its operating point (m, p)


class Limits(NamedTuple):
    """Bounds of a coupled loop; None does not hold."""

    m_s: float | None  # of each channel, all others closed
    m_t: float | None
    m_ks: tuple[float, ...] | None  # from y_i to v_i, for each axis
    disk: float  # disk margin of all inputs, and of all outputs, at once
    damping: float | None


class Measured(NamedTuple):
    """Costs and constraints of the loops for given bandwidths."""

    cost: float  # mean of the logarithms of the axes' costs over those alone
    costs: Vector  # cost of each axis with the first plant (p,)
    slacks: Matrix  # constraints (plants, q), which must not be negative; logarithms of ratios
    stable: bool

    @property
    def violation(self) -> float:
        """The largest ratio to a limit, less one; infinite for an unstable loop."""
        if not self.stable:
            return math.inf
        return max(math.expm1(-float(np.min(self.slacks, initial=0.0))), 0.0)


class Law:
    """The feedback of an axis as a function of its bandwidths; the rest stays as in an ADRC."""

    def __init__(self, axis: ADRC) -> None:
        self.axis = axis
        self._known: dict[tuple[float, float], LinearLaw] = {}

    def controller(self, omega_c: float, omega_o: float) -> ADRC:
        """Return the axis without learner, guard and feedforward, with other bandwidths."""
        observer = with_gains(self.axis.observer, 1.0, omega_o)
        how = {"half_gain": self.axis.half_gain, "law_poles": self.axis.law_poles}
        return ADRC(observer, omega_c, **how)  # type: ignore[arg-type]

    def at(self, omega_c: float, omega_o: float) -> LinearLaw:
        """Return the linear law."""
        key = omega_c, omega_o
        if key not in self._known:
            if len(self._known) >= _KEPT:
                self._known.clear()
            with warnings.catch_warnings():
                # Of bandwidths on the way of a search; the result's own is made with warnings.
                warnings.simplefilter("ignore", DesignWarning)
                self._known[key] = law_of(self.controller(omega_c, omega_o))
        return self._known[key]


class CoupledLoops:
    """The loops of several axes with a set of plants, as functions of the bandwidths.

    Bounds hold with all plants; the cost is that of the first one.

    Parameters
    ----------
    plants
        the set, the nominal one first; all of one size.
    axes
        the ADRC of each axis.
    limits
        the bounds.
    dt
        sample time [s].
    dead
        samples that the inputs wait.
    alone
        the cost of each axis alone (p,), in units of which costs are counted.
    objective
        ``"load-iae"`` or ``"load"``.
    """

    def __init__(
        self,
        plants: Sequence[Plant],
        axes: Sequence[ADRC],
        limits: Limits,
        dt: float,
        dead: int,
        alone: Vector,
        objective: str,
    ) -> None:
        self.plants, self.limits, self.dt, self.dead = tuple(plants), limits, dt, dead
        self.laws, self.alone, self.objective = [Law(axis) for axis in axes], alone, objective
        poles = [in_s_plane(eigenvalues(each.A - np.eye(len(each.A))), dt) for each in plants]
        self.omega = self._grid(poles)
        least = limits.damping or 0.0
        self._modes = [
            modes_of((each.A - np.eye(len(each.A)), each.B @ each.R, each.C), s, least, dt)
            for each, s in zip(plants, poles, strict=True)
        ]
        # All plants at once: frequency responses (j, k, p, m), R, and G_v = G_u R.
        self._G = np.stack([self._responses(each) for each in plants])
        self._R = np.stack([each.R for each in plants])[:, None]
        self._G_v = self._G @ self._R

    def _grid(self, poles: Sequence[Complex]) -> Vector:
        top = math.pi / self.dt
        count = math.ceil(-_POINTS_PER_DECADE * math.log10(_LOWEST)) + 1
        parts = [np.geomspace(_LOWEST * top, top * (1.0 - 1e-6), count)]
        s = np.unique(np.concatenate(poles).round(6))
        s = s[np.isfinite(s) & (s.imag > 0.0)]
        resonant = s[-s.real < 0.5 * s.imag]
        if resonant.size:
            near = frequencies(resonant, self.dt)
            beside = np.abs(near[:, None] / resonant.imag[None, :] - 1.0) < 0.2
            parts.append(near[np.any(beside, axis=1)])
        return np.unique(np.concatenate(parts))

    def _responses(self, plant: Plant) -> Complex:
        m, p = plant.B.shape[1], plant.C.shape[0]
        N = plant.A - np.eye(plant.A.shape[0])
        return Response(MatrixSystem(N, plant.B, plant.C, np.zeros((p, m))))(self.omega, self.dt)

    # ---- measures

    def measured(self, values: Matrix) -> Measured:
        """Return cost and constraints for bandwidths (p, 2), omega_c and omega_o of each axis."""
        laws = [law.at(*map(float, row)) for law, row in zip(self.laws, values, strict=True)]
        C = np.stack([Response(_feedback(law))(self.omega, self.dt) for law in laws], axis=1)
        matrices = np.stack([closed(plant, laws) for plant in self.plants])
        shifted: Complex = np.linalg.eigvals(matrices).astype(np.complex128)
        damped, stable, first = [], True, np.zeros(0, dtype=complex)
        for j, each in enumerate(shifted):
            s = in_s_plane(each, self.dt)
            s = s[np.isfinite(s)]
            inside = bool(np.all(s.real < 0.0))
            stable &= inside
            damped.append(self._damped(s, self._modes[j], inside))
            first = s if j == 0 else first
        costs = _UNSTABLE * self.alone
        if np.all(first.real < 0.0):
            costs = self._costs(self.plants[0], matrices[0], first, laws)
        cost = float(np.mean(np.log(costs / self.alone)))
        slacks = np.column_stack([self._peaks(C), damped])
        return Measured(cost, costs, slacks, stable)

    def _peaks(self, C: Complex) -> Matrix:
        """Return the slacks of the bounds over frequency (j, q), for feedbacks C (k, p)."""
        p, m = C.shape[1], self._G.shape[3]
        S = np.linalg.inv(np.eye(p) + self._G_v * C[:, None, :]).astype(np.complex128)
        # R C S_o G_u, the complementary sensitivity of the actuators.
        T_u: Complex = self._R @ (C[:, :, None] * (S @ self._G))
        outputs = np.einsum("jkii->jki", S)
        found = []
        for S_own in (outputs, 1.0 - np.einsum("jkii->jki", T_u)):
            for limit, size in ((self.limits.m_s, S_own), (self.limits.m_t, 1.0 - S_own)):
                if limit is not None:
                    found.append(np.max(np.abs(size), axis=1) / limit)
        if self.limits.m_ks is not None:
            found.append(np.max(np.abs(C * outputs), axis=1) / np.array(self.limits.m_ks))
        for M in (S - 0.5 * np.eye(p), 0.5 * np.eye(m) - T_u):
            found.append(np.max(_scaled_norm(M), axis=1, keepdims=True) * self.limits.disk)
        ratios: Matrix = np.hstack([each.reshape(len(self.plants), -1) for each in found])
        return -np.log(np.maximum(ratios, 1e-12))

    def _damped(self, s: Complex, modes: tuple[Complex, int], inside: bool) -> float:
        """Return the slack of the least damped pole; of an unstable loop that of the worst."""
        worst = float(np.max(s.real / np.abs(s), initial=-1.0))
        if not inside:
            return UNSTABLE - max(worst, 0.0)
        if self.limits.damping is None:
            return min(-worst, 1.0)
        pole = self._least_damped(s, modes)
        return 1.0 if pole is None else max(1.0 - pole.ratio, 0.99 * UNSTABLE)

    def _least_damped(self, s: Complex, modes: tuple[Complex, int]) -> Pole | None:
        """Return the pole with the largest ratio to its bound; None if none has to be damped."""
        poles = counted_of(s, modes, self.dead, float(self.limits.damping or 0.0), self.dt)
        return max(poles, key=lambda pole: pole.ratio, default=None)

    def least_damped(self, values: Matrix, member: int) -> Pole | None:
        """Return the pole with the largest ratio to its bound, with one plant of the set.

        It is None if none has to be damped, or without a bound.
        """
        if self.limits.damping is None:
            return None
        laws = [law.at(*map(float, row)) for law, row in zip(self.laws, values, strict=True)]
        s = in_s_plane(eigenvalues(closed(self.plants[member], laws)), self.dt)
        return self._least_damped(s[np.isfinite(s)], self._modes[member])

    def _costs(self, plant: Plant, N: Matrix, s: Complex, laws: Sequence[LinearLaw]) -> Vector:
        """Return the cost of each axis: the integral of y_i or ``|y_i|`` after a step in v_i."""
        if self.objective == "load":
            return np.array([1.0 / integral_gain(law, self.dt) for law in laws])
        slowest = float(np.min(-s.real))
        size = math.ceil(_TIME_CONSTANTS / (slowest * self.dt)) + 2
        rest = np.zeros(N.shape[0] - plant.A.shape[0])
        B, found = plant.B @ plant.R, []
        for i, row in enumerate(plant.C):
            system = System(N, np.append(B[:, i], rest), np.append(row, rest), 0.0)
            found.append(area_of_step(system, size) * self.dt)
        return np.array(found)


def _scaled_norm(M: Complex) -> NDArray[np.float64]:
    """Return the largest singular values of matrices (j, k, c, c) with rows as large as columns."""
    if M.shape[-1] != 2:
        flat = M.reshape(-1, *M.shape[2:])
        return singular(balanced(flat)[0]).reshape(M.shape[:2])
    # Of two rows it is that with off-diagonal entries of one size, in closed form.
    a, b, c, d = M[..., 0, 0], M[..., 0, 1], M[..., 1, 0], M[..., 1, 1]
    power = np.abs(a) ** 2 + np.abs(d) ** 2 + 2.0 * np.abs(b * c)
    root = np.sqrt(np.maximum(power**2 - 4.0 * np.abs(a * d - b * c) ** 2, 0.0))
    return np.sqrt(0.5 * (power + root))


def closed(plant: Plant, laws: Sequence[LinearLaw]) -> Matrix:
    """Return ``A − I`` of the closed loop, the plant's states first."""
    law = joined(laws, plant.R)
    N = plant.A - np.eye(plant.A.shape[0])
    inner = law.A - np.eye(law.A.shape[0])
    return np.block(
        [[N + plant.B @ law.D_y @ plant.C, plant.B @ law.C], [law.B_y @ plant.C, inner]]
    )


def _feedback(law: LinearLaw) -> System:
    """Return an axis from −y to v."""
    A = law.A + np.outer(law.B_u, law.C) - np.eye(law.C.size)
    return System(A, -(law.B_y + law.B_u * law.D_y), law.C, -law.D_y)


def integral_gain(law: LinearLaw, dt: float) -> float:
    """Return k_i of a law with one integrator, the residue of its response at z = 1 over dt."""
    system = _feedback(law)
    left, _, right = np.linalg.svd(system.N)
    v, w = right[-1], left[:, -1]
    return float((system.C @ v) * (w @ system.B) / (w @ v) / dt)


# ---- The search ----

# Half width of the box of a round in the logarithms, rounds, and iterations of each.
_BOX, _ROUNDS, _ITERATIONS = 0.7, 8, 10
# Step of the differences in the logarithms, and the change of the cost that ends the rounds.
_DIFFERENCE, _SETTLED = 1e-5, 1e-4
# What exceeding a limit by a share costs, as in ``optimiser/search.py``.
_EXCESS = 20.0
# Factors of the grid of starts, and the distance of two valleys in the logarithms: two steps.
_FACTORS = tuple(10.0 ** (0.4 * k) for k in range(-6, 4))
_VALLEY = 1.9
# Slack that the search keeps, for peaks between points of the grid.
_SPARE = 2e-3


class Found(NamedTuple):
    """Where a search ended."""

    values: Matrix  # (p, 2)
    measured: Measured

    @property
    def merit(self) -> float:
        """The cost with what exceeding limits costs; less is better."""
        return self.measured.cost + _EXCESS * min(self.measured.violation, 1e3)

    @property
    def rank(self) -> tuple[bool, float]:
        """Those that keep to all limits first, by cost; then the others by merit."""
        bad = self.measured.violation > _SPARE
        return bad, self.merit if bad else self.measured.cost


def starts(
    loops: CoupledLoops, values: Matrix, low: Vector, high: Vector, count: int
) -> list[Found]:
    """Return the best bandwidths of a grid, at most ``count`` of them, in different valleys.

    The grid has those of ``values`` (p, 2) times factors of omega_c and of omega_o that all axes
    share. Loops often have two optima, one with the fast poles in the law and one with them in the
    observer.
    """
    every: list[Found] = []
    for factors in itertools.product(_FACTORS, repeat=2):
        tried = np.clip(values * factors, low, high)
        if not any(np.array_equal(tried, each.values) for each in every):
            every.append(Found(tried, loops.measured(tried)))
    every.sort(key=lambda each: each.rank)
    found: list[Found] = []
    for each in every:
        near = (np.max(np.abs(np.log(each.values / other.values))) < _VALLEY for other in found)
        if not any(near):
            found.append(each)
        if len(found) == count:
            break
    return found


def optimum(loops: CoupledLoops, start: Matrix, low: Vector, high: Vector) -> Found:
    """Return the optimum that is reached from bandwidths (p, 2); ``low``, ``high`` (2,) bound them.

    The result is never worse than the start.
    """
    from scipy.optimize import minimize

    shape = start.shape
    bottom, top = (np.tile(np.log(each), shape[0]) for each in (low, high))
    x = np.clip(np.log(start).ravel(), bottom, top)
    now = best = Found(start, loops.measured(start))
    box, last = _BOX, math.inf
    known: dict[bytes, Measured] = {}

    def at(x: Vector) -> Measured:
        key = x.tobytes()
        if key not in known:
            known[key] = loops.measured(np.exp(x).reshape(shape))
        return known[key]

    def slopes(x: Vector) -> tuple[Vector, Matrix]:
        here = at(x)
        cost, found = np.zeros(x.size), np.zeros((here.slacks.size, x.size))
        for i in range(x.size):
            step = np.zeros(x.size)
            step[i] = _DIFFERENCE
            near = at(x + step)
            cost[i] = (near.cost - here.cost) / _DIFFERENCE
            found[:, i] = (near.slacks - here.slacks).ravel() / _DIFFERENCE
        return cost, found

    for _ in range(_ROUNDS):
        sides = list(zip(np.maximum(bottom, x - box), np.minimum(top, x + box), strict=True))
        known.clear()
        try:
            end = minimize(
                lambda x: at(x).cost,
                x,
                jac=lambda x: slopes(x)[0],
                bounds=sides,
                constraints={
                    "type": "ineq",
                    "fun": lambda x: at(x).slacks.ravel() - _SPARE,
                    "jac": lambda x: slopes(x)[1],
                },
                method="SLSQP",
                options={"maxiter": _ITERATIONS, "ftol": 1e-6},
            )
        except (np.linalg.LinAlgError, ValueError):
            break
        after = np.clip(end.x, bottom, top) if np.all(np.isfinite(end.x)) else x
        tried = Found(np.exp(after).reshape(shape), at(after))
        if tried.merit < best.merit:
            best = tried
        if not tried.measured.stable or tried.merit > now.merit + 1e-9:
            box *= 0.3
            if box < 1e-3:
                break
            x, now = np.log(best.values).ravel(), best
            continue
        x, now = after, tried
        if now.measured.violation <= _SPARE and abs(last - now.measured.cost) < _SETTLED:
            break
        last = now.measured.cost
    return best
