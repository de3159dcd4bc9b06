"""The closed loop's poles: their damping, and the frequencies at which narrow peaks stand.

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
"""

from __future__ import annotations

import math
import warnings
from typing import Any, NamedTuple

import numpy as np

from quell.analysis.frequency_response import Complex, in_s_plane
from quell.analysis.pure_delays import eigenvalues
from quell.analysis.subsystems import closed_loop_matrix, law_matrix
from quell.plants.sampled import SampledPlant
from quell.tuning.optimiser.laws import law_of
from quell.tuning.optimiser.loops import NARROW, PlantSet, dead_samples
from quell.tuning.structures.base import Structure
from quell.types import DesignWarning, Matrix, Vector

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


def closed_loop_poles(plants: PlantSet, structure: Structure, values: Vector) -> list[Complex]:
    """Return all poles of the loops of each plant with the controller of values (p,) [rad/s]."""
    with warnings.catch_warnings():
        # Of controllers on the way of a search; the result's own is made with warnings.
        warnings.simplefilter("ignore", DesignWarning)
        law = law_of(structure.controller(values))
    inner, found = law_matrix(law), []
    for plant in plants.scaled():
        whole = closed_loop_matrix(plant.N, plant.B, plant.C, law, inner)
        found.append(in_s_plane(eigenvalues(whole), plants.dt))
    return found


def counted(plants: PlantSet, poles: list[Complex], damping: float) -> list[Pole]:
    """Return the poles that count, of those of each plant's loop, with the damping they need."""
    found: list[Pole] = []
    for j, (plant, s) in enumerate(zip(plants.plants, poles, strict=True)):
        top = math.pi / ((dead_samples(plant) + _SAMPLING) * plants.dt)
        s = _upper(s)
        s = s[s.imag < top]
        least, own = np.full(s.size, damping), np.zeros(s.size, dtype=bool)
        modes, count = _modes(plant, plants.s_poles(plant), damping, plants.dt)
        if count:
            distance = np.abs(np.log(np.abs(s)[:, None] / np.abs(modes)[None, :]))
            nearest = np.min(distance, axis=1)
            few = np.flatnonzero((nearest < math.log(_NEAR)) & (_damping(s) < damping))
            own[few[np.argsort(nearest[few])][: _PAIRS * count]] = True
            least[own] = _KEPT * max(float(np.min(_damping(modes))), 0.0)
        rows = zip(s.tolist(), least.tolist(), own.tolist(), strict=True)
        found += [Pole(pole, j, needs, is_own) for pole, needs, is_own in rows]
    return found


def _damping(s: Complex) -> Vector:
    damping: Vector = -s.real / np.abs(s)
    return damping


def _upper(s: Complex) -> Complex:
    """Return the poles in the upper half plane, without the real ones."""
    s = s[np.isfinite(s)]
    kept: Complex = s[s.imag > _REAL * np.abs(s)]
    return kept


def beside_poles(plants: PlantSet, poles: list[Complex]) -> Vector:
    """Return the frequencies (k,) at and beside poles with little damping [rad/s]."""
    if not poles:
        return np.zeros(0)
    s = np.concatenate([_upper(each) for each in poles])
    s = s[np.abs(_damping(s)) < NARROW]
    width = np.maximum(np.abs(s.real), 1e-7 * s.imag)
    near = np.ravel(s.imag[:, None] + width[:, None] * _BESIDE)
    near = near[(near > plants.omega[0]) & (near < plants.omega[-1])]
    kept: Vector = np.setdiff1d(near, plants.omega)
    return kept


class Followed:
    """Poles of a loop, as functions of the controller near the present one."""

    def __init__(self, plants: PlantSet, poles: list[Pole]) -> None:
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


def _modes(plant: SampledPlant, poles: Complex, damping: float, dt: float) -> tuple[Complex, int]:
    """Return poles and zeros of a plant with less damping, and the number of these poles.

    All are in the upper half plane [rad/s]; ``poles`` are all of the plant's. Without such poles
    there are no modes.
    """
    from scipy.linalg import eigvals

    few = _upper(poles)
    few = few[_damping(few) < damping]
    if few.size == 0:
        return few, 0
    n = plant.N.shape[0]
    pencil = np.block([[plant.N, plant.B[:, None]], [plant.C[None, :], np.zeros((1, 1))]])
    shifted = eigvals(pencil, np.diag(np.append(np.ones(n), 0.0)))
    shifted = shifted[np.isfinite(shifted)]
    shifted = shifted[np.abs(1.0 + shifted) > 1e-3]
    zeros = _upper(in_s_plane(shifted, dt))
    zeros = zeros[(_damping(zeros) < damping) & (zeros.imag < 0.5 * math.pi / dt)]
    # A zero far beyond all resonances is none of their antiresonances.
    zeros = zeros[zeros.imag < _NEAR * np.max(few.imag)]
    return np.concatenate([few, zeros]), few.size
