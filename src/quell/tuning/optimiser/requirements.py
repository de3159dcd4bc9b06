"""The constraints as numbers: ratios to their bounds over frequency and plants.

A ratio r keeps to its bound if it is at most 1. The search uses ``1 − log2(1 + r²) ≥ 0``, which is
smooth, zero at the bound, and of moderate slope far beyond it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.analysis.frequency_response import Complex
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser.loops import Peak, PlantSet, peaks
from quell.types import Matrix, Vector

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


def worst_ratio(bounds: tuple[Bound, ...], plants: PlantSet, C: Complex) -> Vector:
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
    plants: PlantSet,
    controller: Callable[[Vector], Complex],
    C: Complex,
    beside: Vector,
    least: float,
) -> list[tuple[int, Peak]]:
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
    found = peaks(ratios, omega, values, least)
    return [(peak.plant // count, peak._replace(plant=peak.plant % count)) for peak in found]
