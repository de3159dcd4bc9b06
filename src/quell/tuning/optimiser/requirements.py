"""Requirements of a tuning as numbers: damping, bounds over frequency, objectives.

The closed loop's poles: their damping, and the frequencies at which narrow peaks stand.

A pole z of the sampled loop is ``s = log(z)/dt``, its damping ``ζ = −Re s/|s|``. A bound of it is a
sector of the s-plane (Ackermann, *Robust Control*, Springer 1993, chapter 4). It is about the
poles that a controller can damp, which are not all:

* A dead time L gives a loop poles without end, near ``Im s = 2 k π/L``, with a damping that goes to
  zero (Bellman & Cooke, *Differential-Difference Equations*, 1963, chapter 12). Feedback
  answers an oscillation L later; where that is half a period or more, the swing is over and the
  answer meets the next one. So poles count with ``Im s < π/(L + 2 dt)``, where two samples are for
  the hold and the sampling.
* A flexible mode of the plant stays one in the loop: at its resonance, or, where the loop is
  quick, at an antiresonance, from which the poles cannot be moved. A controller that answers it has
  a pair of its own there, that of a notch or of an observer's model. So each pair of the plant's
  poles with less damping than the bound excuses two pairs of the loop, the nearest within a factor
  of 2 of such a pole or zero of the plant. They must keep half of the damping that the plant has.

The search follows the poles: with ``g(s) = 1 + L(s)`` and a root s_0 for the parameters at the
start of a round, Halley's step ``s = s_0 − 2 g g'/(2 g'² − g g'')`` at s_0 gives the root for
others, up to the third power of its distance. So each pole is one smooth constraint.

The constraints as numbers: ratios to their bounds over frequency and plants.

A ratio r keeps to its bound if it is at most 1. The search uses ``1 − log2(1 + r²) ≥ 0``, which is
smooth, zero at the bound, and of moderate slope far beyond it.

Objectives, as logarithms to minimise, for many parameter vectors.

* ``load``: ``1/k_i``, the integral of y after a unit step of the load at the plant's input (IE;
  Åström & Hägglund, *Advanced PID Control*, ISA 2006, eq. 4.35). It is the same for all plants.
  With more than one integrator k_i is infinite, and the search for starts has the integral of y²
  (ISE) after that step in its place, ``1/π ∫ |P S/ω|² dω`` by Parseval's theorem.
* ``load-iae``: the integral of ``|y|`` after that step, from the exact response.
* ``tracking``: the RMS of ``r − y`` along a given reference.

Of several plants, the last two take the largest value, or a quantile of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.analysis.loop import closed_loop_matrix, law_matrix
from quell.analysis.margins import Complex, eigenvalues, in_s_plane
from quell.tuning.constraints import Constraints, LoadSpectrum
from quell.tuning.optimiser import loops
from quell.tuning.structures.base import Structure
from quell.types import Matrix, Vector

# ---- The closed loop's poles ----

# A pole with less is said to ring, where nothing bounds the damping.
USUAL_DAMPING = 0.4
# Samples of delay that hold and sampling count for.
_SAMPLING = 2
# A pole of the loop belongs to a mode of the plant within this factor of its frequency, and keeps
# this share of its damping. An antiresonance lies below its resonance by √(1 + J_l/J_m), so poles
# on the way between are within a factor of 2 of either up to a ratio of 15.
_NEAR, _KEPT = 2.0, 0.5
_PAIRS = 2  # of the loop for one of the plant
# Poles with a smaller imaginary part, in units of their size, are real, to rounding.
_REAL = 1e-6
# Narrow peaks are looked for so many half widths beside a pole.
_BESIDE = np.array([-3.0, -1.0, 0.0, 1.0, 3.0])
# The search follows poles with less than this damping, or than what they must have by this factor.
_FOLLOWED, _FOLLOWED_BEYOND = 0.75, 1.5
# Step of the derivatives of g by differences, in units of |s|.
_STEP = 1e-4


class Pole(NamedTuple):
    """A pole of the closed loop with a plant of the set, in the upper half plane."""

    s: complex  # [rad/s]
    plant: int
    least: float  # the damping that it must have
    own: bool  # whether it belongs to a mode of the plant

    @property
    def damping(self) -> float:
        """``−Re s/|s|``."""
        return -self.s.real / abs(self.s)

    @property
    def ratio(self) -> float:
        """``(1 − ζ)/(1 − ζ_least)``: a value over its limit, as that of other constraints."""
        return (1.0 - self.damping) / (1.0 - self.least)


def closed_loop_poles(
    plants: loops.PlantSet, structure: Structure, values: Vector
) -> list[Complex]:
    """Return all poles of the loops of each plant with the controller of values (p,) [rad/s]."""
    law = loops.law_at(structure, values)
    inner, found = law_matrix(law), []
    for plant in plants.scaled():
        whole = closed_loop_matrix(plant.N, plant.B, plant.C, law, inner)
        found.append(in_s_plane(eigenvalues(whole), plants.dt))
    return found


def counted(plants: loops.PlantSet, poles: list[Complex], damping: float) -> list[Pole]:
    """Return the poles that count, of those of each plant's loop, with the damping they need."""
    if damping not in plants.modes:
        plants.modes[damping] = [
            modes_of(
                (plant.N, plant.B[:, None], plant.C[None, :]),
                plants.s_poles(plant),
                damping,
                plants.dt,
            )
            for plant in plants.plants
        ]
    found: list[Pole] = []
    each = zip(plants.plants, poles, plants.modes[damping], strict=True)
    for j, (plant, s, own) in enumerate(each):
        found += counted_of(s, own, loops.dead_samples(plant), damping, plants.dt, j)
    return found


def counted_of(
    s: Complex, of_plant: tuple[Complex, int], dead: int, damping: float, dt: float, j: int = 0
) -> list[Pole]:
    """Return the poles that count, of the poles s of the loop with one plant, the j-th.

    ``of_plant`` is what ``modes_of`` returns, ``dead`` the samples that its inputs wait.
    """
    top = math.pi / ((dead + _SAMPLING) * dt)
    s = _upper(s)
    s = s[s.imag < top]
    least, own = np.full(s.size, damping), np.zeros(s.size, dtype=bool)
    modes, count = of_plant
    if count:
        distance = np.abs(np.log(np.abs(s)[:, None] / np.abs(modes)[None, :]))
        nearest = np.min(distance, axis=1)
        few = np.flatnonzero((nearest < math.log(_NEAR)) & (_damping(s) < damping))
        own[few[np.argsort(nearest[few])][: _PAIRS * count]] = True
        least[own] = _KEPT * max(float(np.min(_damping(modes))), 0.0)
    rows = zip(s.tolist(), least.tolist(), own.tolist(), strict=True)
    return [Pole(pole, j, needs, is_own) for pole, needs, is_own in rows]


def _damping(s: Complex) -> Vector:
    return -s.real / np.abs(s)


def _upper(s: Complex) -> Complex:
    """Return the poles in the upper half plane, without the real ones."""
    s = s[np.isfinite(s)]
    return s[s.imag > _REAL * np.abs(s)]


def beside_poles(plants: loops.PlantSet, poles: list[Complex]) -> Vector:
    """Return the frequencies (k,) at and beside poles with little damping [rad/s]."""
    if not poles:
        return np.zeros(0)
    s = np.concatenate([_upper(each) for each in poles])
    s = s[np.abs(_damping(s)) < loops.NARROW]
    width = np.maximum(np.abs(s.real), 1e-7 * s.imag)
    near = np.ravel(s.imag[:, None] + width[:, None] * _BESIDE)
    near = near[(near > plants.omega[0]) & (near < plants.omega[-1])]
    return np.setdiff1d(near, plants.omega)


class Followed:
    """Poles of a loop, as functions of the controller near the present one."""

    def __init__(self, plants: loops.PlantSet, poles: list[Pole]) -> None:
        kept = [
            pole
            for pole in poles
            if pole.damping < (_FOLLOWED_BEYOND * pole.least if pole.own else _FOLLOWED)
        ]
        self._s = np.array([pole.s for pole in kept], dtype=np.complex128)
        self._least = np.array([pole.least for pole in kept])
        self._h = _STEP * np.abs(self._s)
        points: Any = np.concatenate([self._s - self._h, self._s, self._s + self._h])
        self._omega: Any = -1j * points
        members = np.tile(np.array([pole.plant for pole in kept], dtype=np.intp), 3)
        self._P = plants.responses_of(self._omega, members) if kept else np.zeros(0, dtype=complex)

    def slacks(self, structure: Structure, values: Matrix) -> Matrix:
        """Return one less the ratios (m, k), of controllers with values (m, p)."""
        count = self._s.size
        if count == 0:
            return np.zeros((values.shape[0], 0))
        C: Any = structure.response(values, self._omega)
        g: Any = 1.0 + self._P * C
        before, at, after = g[:, :count], g[:, count : 2 * count], g[:, 2 * count :]
        first = 0.5 * (after - before) / self._h
        second = (after - 2.0 * at + before) / self._h**2
        with np.errstate(divide="ignore", invalid="ignore"):
            s = self._s - 2.0 * at * first / (2.0 * first**2 - at * second)
            slack = (_damping(s) - self._least) / (1.0 - self._least)
        return np.nan_to_num(slack, nan=-1.0, posinf=-1.0, neginf=-1.0)


def modes_of(
    plant: tuple[Matrix, Matrix, Matrix], poles: Complex, damping: float, dt: float
) -> tuple[Complex, int]:
    """Return poles and zeros of a sampled plant with less damping, and the number of these poles.

    All are in the upper half plane [rad/s]; ``plant`` is (A − I, B, C) with as many inputs as
    outputs, and ``poles`` are all of its poles. Without such poles there are no modes.
    """
    from scipy.linalg import eigvals

    few = _upper(poles)
    few = few[_damping(few) < damping]
    if few.size == 0:
        return few, 0
    N, B, C = plant
    n, m = B.shape
    pencil = np.block([[N, B], [C, np.zeros((m, m))]])
    shifted = eigvals(pencil, np.diag(np.append(np.ones(n), np.zeros(m))))
    shifted = shifted[np.isfinite(shifted)]
    shifted = shifted[np.abs(1.0 + shifted) > 1e-3]
    zeros = _upper(in_s_plane(shifted, dt))
    zeros = zeros[(_damping(zeros) < damping) & (zeros.imag < 0.5 * math.pi / dt)]
    # A zero far beyond all resonances is none of their antiresonances.
    zeros = zeros[zeros.imag < _NEAR * np.max(few.imag)]
    return np.concatenate([few, zeros]), few.size


# ---- The constraints as numbers ----

KINDS = {"m_s": "M_s", "m_t": "M_t", "m_ks": "M_ks"}


class Bound(NamedTuple):
    """A bound of a frequency response."""

    kind: str  # ``"M_s"``, ``"M_t"`` or ``"M_ks"``
    limit: float


class Part(NamedTuple):
    """The points at which one bound is kept."""

    bound: Bound
    rows: NDArray[np.intp]  # their numbers among all points (k,)
    P: Complex  # responses of their plants (k,)
    at: NDArray[np.intp]  # indices of their frequencies (k,)


class Points(NamedTuple):
    """Points at which bounds are kept, each of a bound, a plant and a frequency."""

    parts: tuple[Part, ...]
    omega: Vector  # distinct frequencies

    @property
    def total(self) -> int:
        """Their number k."""
        return sum(part.rows.size for part in self.parts)


class Active(NamedTuple):
    """A constraint at its bound."""

    name: str
    value: float
    limit: float
    omega: float  # [rad/s]; NaN for one that belongs to no frequency
    plant: int


def bounds_of(constraints: Constraints) -> tuple[Bound, ...]:
    """Return the bounds over frequency."""
    found = [(text, getattr(constraints, name)) for name, text in KINDS.items()]
    return tuple(Bound(text, float(value)) for text, value in found if value is not None)


def sizes(kind: str, P: Complex, C: Complex) -> NDArray[np.float64]:
    """Return |S|, |T| or |C S| for broadcast responses of plants and controllers."""
    with np.errstate(divide="ignore", invalid="ignore"):
        _, found = _sensitivities(kind, P, C)
        size: NDArray[np.float64] = np.abs(found)
    return size


def _sensitivities(kind: str, P: Complex, C: Complex) -> tuple[Complex, Complex]:
    """Return S, and S, T or C S."""
    L = P * C
    S = 1.0 / (1.0 + L)
    if kind == "M_s":
        return S, S
    return S, (L if kind == "M_t" else C) * S


def worst_ratio(bounds: tuple[Bound, ...], plants: loops.PlantSet, C: Complex) -> Vector:
    """Return the largest ratio (m,) on the grid, for controllers (m, G)."""
    worst, gain = np.zeros(C.shape[0]), np.abs(C)
    for P in plants.P:
        with np.errstate(divide="ignore", invalid="ignore"):
            S = 1.0 / np.abs(1.0 + P * C)
            for kind, limit in bounds:
                size = S
                if kind != "M_s":
                    size = (np.abs(P) * gain if kind == "M_t" else gain) * S
                worst = np.maximum(worst, np.max(size, axis=1) / limit)
    return worst


def points_of(
    bounds: tuple[Bound, ...],
    kind: NDArray[np.intp],
    P: Complex,
    at: NDArray[np.intp],
    omega: Vector,
) -> Points:
    """Return points, given the number of the bound, the plant and the frequency of each (k,)."""
    parts = []
    for number, bound in enumerate(bounds):
        rows = np.flatnonzero(kind == number)
        if rows.size:
            parts.append(Part(bound, rows, P[rows], at[rows]))
    return Points(tuple(parts), omega)


def slacks(points: Points, C: Complex) -> Vector:
    """Return the slack ``1 − log2(1 + r²)`` (k,) at points, for a controller C (ω,)."""
    found = np.empty(points.total)
    for (kind, limit), rows, P, at in points.parts:
        _, X = _sensitivities(kind, P, C[at])
        square = (X.real**2 + X.imag**2) / limit**2
        found[rows] = 1.0 - np.log1p(square) / math.log(2.0)
    return found


def slopes_of_slacks(points: Points, C: Complex, dC: NDArray[np.complex128]) -> Matrix:
    """Return the derivatives (k, p) of the slacks, for a controller C (ω,) and its own (p, ω).

    With S = 1/(1 + PC): ``dS = −S² P dC``, ``dT = S² P dC``, ``d(CS) = S² dC``.
    """
    found = np.empty((points.total, dC.shape[0]))
    for (kind, limit), rows, P, at in points.parts:
        S, X = _sensitivities(kind, P, C[at])
        slope = S**2
        if kind != "M_ks":
            slope = (-slope if kind == "M_s" else slope) * P
        square = (X.real**2 + X.imag**2) / limit**2
        weight = np.conj(X) * slope * (-2.0 / math.log(2.0) / limit**2) / (1.0 + square)
        change = dC[:, at]
        found[rows] = (weight.real * change.real - weight.imag * change.imag).T
    return found


def all_peaks(
    bounds: tuple[Bound, ...],
    plants: loops.PlantSet,
    controller: Callable[[Vector], Complex],
    C: Complex,
    beside: Vector,
    least: float,
) -> list[tuple[int, loops.Peak]]:
    """Return the refined maxima with a ratio above ``least``, each with the number of its bound.

    ``controller`` is a function from frequencies to C_y (k,), and C (G,) are its values on the
    grid. Maxima are bracketed by the grid and by the frequencies ``beside``, between which narrow
    ones may be.
    """
    count = len(plants.plants)

    def ratios(omega: Vector, rows: NDArray[np.intp]) -> Vector:
        number, plant = np.divmod(rows, count)
        P, C = plants.responses_of(omega, plant), controller(omega)
        found = np.empty(omega.size)
        for i, (kind, limit) in enumerate(bounds):
            own = number == i
            found[own] = sizes(kind, P[own], C[own]) / limit
        return found

    omega, P = plants.omega, plants.P
    if beside.size:
        omega = np.concatenate([omega, beside])
        order = np.argsort(omega)
        P = np.hstack([P, plants.responses(beside)])[:, order]
        C, omega = np.append(C, controller(beside))[order], omega[order]
    values = np.vstack([sizes(kind, P, C) / limit for kind, limit in bounds])
    found = loops.peaks(ratios, omega, values, least)
    return [(peak.plant // count, peak._replace(plant=peak.plant % count)) for peak in found]


# ---- Objectives, as logarithms to minimise, for many parameter vectors ----

OBJECTIVES = ("load", "load-iae", "tracking")
"""Names of the objectives that the optimiser of linear loops knows."""
OF_SPECTRUM = "load-spectrum"
"""Name of the objective that a ``LoadSpectrum`` is: the RMS of y under that load."""
WITHOUT_TIME = ("load", OF_SPECTRUM)
"""Objectives that need no response over time, which are quick."""

Cost = Callable[[Structure, Matrix], Vector]

# The logarithm of an objective that no stable loop has.
_WORST = 200.0


def load_cost(structure: Structure, values: Matrix, plants: loops.PlantSet) -> Vector:
    """Return ``−log k_i`` (m,); with more integrators the logarithm of the root of the ISE."""
    if structure.integrators > 1:
        return _log_root_ise(plants, structure.response(values, plants.omega))
    with np.errstate(divide="ignore", invalid="ignore"):
        cost = -np.log(structure.integral_gain(values))
    return np.where(np.isfinite(cost), cost, _WORST)


def _log_root_ise(plants: loops.PlantSet, C: Complex) -> Vector:
    worst, omega = np.zeros(C.shape[0]), plants.omega
    for P in plants.P:
        density = np.abs(P / (1.0 + P * C)) ** 2 / omega  # over log ω
        worst = np.maximum(worst, np.trapezoid(density, np.log(omega), axis=1) / np.pi)
    with np.errstate(divide="ignore", invalid="ignore"):
        cost: Vector = 0.5 * np.log(worst)
    return np.where(np.isfinite(cost), cost, _WORST)


def scores(
    objective: str, structure: Structure, values: Vector, over: loops.SetResponses
) -> Vector:
    """Return the objective of each plant (J,)."""
    if objective == "load-iae":
        return over.areas(structure, values)
    found = over.of(structure, values)
    return np.array([np.sqrt(np.mean((over.inputs.r - y) ** 2)) for y in found])


def spectrum_cost(over: loops.SetResponses, load: LoadSpectrum, quantile: float) -> Cost:
    """Return the cost of a load by its spectrum: the logarithm of the RMS of y."""
    P = over.plants.responses(load.omega)[:, None, :]

    def cost(structure: Structure, values: Matrix) -> Vector:
        with np.errstate(all="ignore"):
            y = np.abs(P / (1.0 + P * structure.response(values, load.omega))) ** 2
            found: Vector = 0.5 * np.log(np.quantile(y @ load.power, quantile, axis=0))
        return np.where(np.isfinite(found), found, _WORST)

    return cost


def cost_of(
    objective: str, over: loops.SetResponses, quantile: float, spectrum: LoadSpectrum | None = None
) -> Cost:
    """Return the function from a structure and values (m, p) to costs (m,)."""
    if objective == "load":
        return partial(load_cost, plants=over.plants)
    if spectrum is not None:
        return spectrum_cost(over, spectrum, quantile)

    def cost(structure: Structure, values: Matrix) -> Vector:
        found = np.empty(values.shape[0])
        for i, row in enumerate(values):
            each = scores(objective, structure, row, over)
            with np.errstate(invalid="ignore"):  # between two infinite ones, of unstable loops
                value = float(np.quantile(each, quantile))
            found[i] = np.log(value) if 0.0 < value < np.inf else _WORST
        return found

    return cost
