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

Stack = NDArray[np.float64]
_KINDS = {"m_s": "M_s", "m_t": "M_t", "m_ks": "M_ks"}


class Bound(NamedTuple):
    """A bound of a frequency response."""

    kind: str  # ``"M_s"``, ``"M_t"`` or ``"M_ks"``
    limit: float


class Points(NamedTuple):
    """Points at which bounds are kept: for each the bound, the plant and the frequency."""

    kind: NDArray[np.intp]
    P: NDArray[np.complex128]
    at: NDArray[np.intp]  # index of the frequency
    omega: Vector  # distinct frequencies


class Active(NamedTuple):
    """A constraint at its bound."""

    name: str
    value: float
    limit: float
    omega: float  # [rad/s]; NaN for one that belongs to no frequency
    plant: int


def bounds_of(constraints: Constraints) -> tuple[Bound, ...]:
    """Return the bounds over frequency."""
    found = [(text, getattr(constraints, name)) for name, text in _KINDS.items()]
    return tuple(Bound(text, float(value)) for text, value in found if value is not None)


def sizes(kind: str, P: Complex, C: Complex) -> NDArray[np.float64]:
    """Return |S|, |T| or |C S| for broadcast responses of plants and controllers."""
    with np.errstate(divide="ignore", invalid="ignore"):
        L = P * C
        S = 1.0 / (1.0 + L)
        found = {"M_s": S, "M_t": L * S, "M_ks": C * S}[kind]
        size: NDArray[np.float64] = np.abs(found)
    return size


def worst_ratio(bounds: tuple[Bound, ...], plants: PlantSet, C: Complex) -> Vector:
    """Return the largest ratio (m,) on the grid, for controllers (m, G)."""
    worst, gain = np.zeros(C.shape[0]), np.abs(C)
    for P in plants.P:
        L = P * C
        with np.errstate(divide="ignore", invalid="ignore"):
            S = 1.0 / np.abs(1.0 + L)
            size = {"M_s": S, "M_t": np.abs(P) * gain * S, "M_ks": gain * S}
        for kind, limit in bounds:
            worst = np.maximum(worst, np.max(size[kind], axis=1) / limit)
    return worst


def slack(ratio: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``1 − log2(1 + r²)``."""
    found: NDArray[np.float64] = 1.0 - np.log1p(ratio**2) / math.log(2.0)
    return found


def slack_and_slope(
    bounds: tuple[Bound, ...], points: Points, C: Complex, dC: NDArray[np.complex128]
) -> tuple[Vector, Matrix]:
    """Return the slack (k,) at points and its derivatives (k, p).

    ``C`` (ω,) and ``dC`` (p, ω) are the controller and its derivatives. With S = 1/(1 + PC):
    ``dS = −S² P dC``, ``dT = S² P dC``, ``d(CS) = S² dC``.
    """
    values, slopes = np.empty(points.kind.size), np.empty((points.kind.size, dC.shape[0]))
    for number, (kind, limit) in enumerate(bounds):
        mine = points.kind == number
        if not np.any(mine):
            continue
        P, at = points.P[mine], points.at[mine]
        here, change = C[at], dC[:, at]
        S = 1.0 / (1.0 + P * here)
        X, slope = {
            "M_s": (S, -(S**2) * P),
            "M_t": (P * here * S, S**2 * P),
            "M_ks": (here * S, S**2),
        }[kind]
        square = (X.real**2 + X.imag**2) / limit**2
        values[mine] = 1.0 - np.log1p(square) / math.log(2.0)
        weight = np.conj(X) * slope * (-2.0 / math.log(2.0) / limit**2) / (1.0 + square)
        slopes[mine] = (weight.real * change.real - weight.imag * change.imag).T
    return values, slopes


def all_peaks(
    bounds: tuple[Bound, ...],
    plants: PlantSet,
    controller: Callable[[Vector], Complex],
    C: Complex,
    least: float,
) -> list[tuple[int, Peak]]:
    """Return the refined maxima with a ratio above ``least``, each with the number of its bound.

    ``controller`` is a function from frequencies to C_y (k,); ``C`` (G,) are its values on the
    grid.
    """
    found = []
    for number, (kind, limit) in enumerate(bounds):

        def ratio(
            omega: Vector, members: NDArray[np.intp], kind: str = kind, limit: float = limit
        ) -> Stack:
            return sizes(kind, plants.responses_of(omega, members), controller(omega)) / limit

        values = sizes(kind, plants.P, C) / limit
        found += [(number, peak) for peak in peaks(ratio, plants.omega, values, least)]
    return found
