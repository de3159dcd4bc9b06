"""The loops of many controllers with a set of plants: responses, stability, peaks.

All plants of a set are sampled with the controller's dt, dead time and lag included, and have their
responses at the same frequencies. The responses are exact (``analysis.frequency_response``). The
grid only brackets: ``peaks`` finds the largest values between its points.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.analysis.frequency_response import Complex, Response, frequencies, in_s_plane
from quell.analysis.pure_delays import eigenvalues
from quell.lti.system import System
from quell.plants.sampled import SampledPlant
from quell.types import Matrix, Vector

# The lowest frequency of the grid, in units of the phase crossover; a pole below a tenth of it
# counts as an integrator.
_BOTTOM = 1e-4
# With integral action |L| is large at the lowest frequency, if that is below the loop's dynamics.
_LEAST_BOTTOM = 3.0
# Points per decade of the grid. With a dead time responses have a peak in each turn of its phase:
# the grid has an even part with so many radians between points, up to where the plant's gain has
# fallen to this share of that at the crossover. Beyond, the loop's gain is too small for peaks.
_POINTS_PER_DECADE, _TURN, _FALLEN = 24, 0.5, 0.02
NARROW = 0.1
"""Poles with less damping have peaks beside them that may lie between points of the grid."""
# Half the sampling rate itself is a pole of Tustin's rule.
_BELOW_HALF = 1.0 - 1e-6
# Points between the neighbours of a maximum, and how often they are placed anew: an interval of
# 0.1 shrinks to 1e-5.
_ZOOM, _ZOOMS = 17, 3


class Peak(NamedTuple):
    """A local maximum over frequency."""

    value: float
    omega: float
    plant: int


class PlantSet:
    """Sampled plants with factors of their gain, on a common grid of frequencies.

    Attributes
    ----------
    plants, factors
        the plants (J,) and the factors of their gain (J,).
    omega : array
        the grid (G,) [rad/s].
    P : array
        the responses (J, G).
    crossover : float
        frequency at which the first plant's phase lag is half a turn, or its scale [rad/s].
    """

    def __init__(self, plants: Sequence[SampledPlant], factors: Vector, dt: float) -> None:
        self.plants, self.factors, self.dt = tuple(plants), factors, dt
        distinct = {id(plant): plant for plant in plants}
        self._responses = {
            key: Response(System(plant.N, plant.B, plant.C, 0.0)) for key, plant in distinct.items()
        }
        self._poles = {key: eigenvalues(plant.N) for key, plant in distinct.items()}
        self.crossover = self._crossover()
        self.omega = self._grid()
        self.P = self.responses(self.omega)
        self._open = [self._open_poles(self._poles[id(plant)]) for plant in self.plants]

    def responses(self, omega: Vector) -> Complex:
        """Return P (J, k)."""
        found = {key: response(omega, self.dt) for key, response in self._responses.items()}
        rows = [found[id(plant)] for plant in self.plants]
        P: Complex = np.array(rows) * self.factors[:, None]
        return P

    def responses_of(self, omega: Vector, members: NDArray[np.intp]) -> Complex:
        """Return P (k,) at frequencies (k,), each of the plant with that number."""
        found = np.empty(omega.size, dtype=np.complex128)
        keys = np.array([id(plant) for plant in self.plants])[members]
        for key in np.unique(keys):
            own = keys == key
            found[own] = self._responses[int(key)](omega[own], self.dt)
        P: Complex = found * self.factors[members]
        return P

    @cached_property
    def resonant(self) -> bool:
        """Whether a plant has poles with so little damping that peaks beside them are narrow."""
        found = [self.s_poles(plant) for plant in self.plants]
        return any(np.any((s.imag > 0.0) & (-s.real < NARROW * s.imag)) for s in found)

    def scaled(self) -> list[SampledPlant]:
        """Return the plants with the factors of their gain."""
        return [
            plant if factor == 1.0 else plant._replace(B=plant.B * factor, E=plant.E * factor)
            for plant, factor in zip(self.plants, self.factors.tolist(), strict=True)
        ]

    def s_poles(self, plant: SampledPlant) -> Complex:
        """Return the poles of a plant of the set [rad/s], but for those at z = 0."""
        poles = in_s_plane(self._poles[id(plant)], self.dt)
        kept: Complex = poles[np.isfinite(poles)]
        return kept

    def _crossover(self) -> float:
        top = math.pi / self.dt
        first = self.plants[0]
        sizes = np.abs(self.s_poles(first))
        sizes = sizes[(sizes > 1e-7 * top) & (sizes < top)]
        low = 1e-2 * float(np.min(sizes, initial=1e-2 * top))
        omega = np.geomspace(low, top * _BELOW_HALF, 600)
        response = self._responses[id(first)](omega, self.dt)
        phase = np.unwrap(np.angle(response))
        phase += -2.0 * np.pi * np.round((phase[0] + 0.5 * np.pi) / (2.0 * np.pi))
        late = np.flatnonzero(phase <= -np.pi)
        if late.size and late[0] > 0:
            return float(omega[late[0]])
        return float(np.exp(np.mean(np.log(sizes)))) if sizes.size else 0.1 * top

    def _grid(self) -> Vector:
        top = math.pi / self.dt * _BELOW_HALF
        bottom = min(_BOTTOM * self.crossover, 0.01 * top)
        count = math.ceil(_POINTS_PER_DECADE * math.log10(top / bottom)) + 1
        parts = [np.geomspace(bottom, top, count)]
        longest = max(dead_samples(plant) for plant in self.plants) * self.dt
        if longest > 0.0:
            end = self._end_of_peaks(top)
            parts.append(np.arange(1.0, end * longest / _TURN) * (_TURN / longest))
        for plant in self.plants:
            poles = self.s_poles(plant)
            poles = poles[poles.imag > 0.0]
            resonant = poles[-poles.real < 0.5 * poles.imag]
            if resonant.size:
                near = frequencies(resonant, self.dt)
                parts.append(near[_beside(near, resonant)])
        grid = np.unique(np.concatenate(parts))
        kept: Vector = grid[(grid >= bottom) & (grid <= top)]
        return kept

    def _end_of_peaks(self, top: float) -> float:
        """Return the frequency above which all plants' gain is small [rad/s]."""
        omega = np.geomspace(self.crossover, top, 100)
        gain = np.abs(self.responses(omega))
        large = np.flatnonzero(np.any(gain > _FALLEN * gain[:, :1], axis=0))
        return float(omega[large[-1]])

    def _open_poles(self, shifted: Complex) -> tuple[float, float, Vector]:
        """Return unstable poles, integrators, and the frequencies of undamped ones [rad/s]."""
        s = in_s_plane(shifted, self.dt)
        s = s[np.isfinite(s)]
        zero = np.abs(s) < 0.1 * float(self.omega[0])
        undamped = ~zero & (np.abs(s.real) <= 1e-6 * np.abs(s.imag))
        unstable = ~zero & ~undamped & (s.real > 0.0)
        on_axis = s[undamped & (s.imag > 0.0)].imag
        return float(np.sum(unstable)), float(np.sum(zero)), np.sort(on_axis)

    # ---- loops

    def unstable_loops(self, C: Complex, controller: Vector, at_one: int = 1) -> Matrix:
        """Return the number (m, J) of unstable closed-loop poles, by the argument principle.

        ``1 + L`` is the closed loop's polynomial over the open loop's. Over the upper half circle
        each root inside adds π to the argument of a polynomial, one outside nothing, one at z = 1
        π/2. So the argument of 1 + L grows by ``π (open unstable + open at one / 2 − closed
        unstable)``. A pole on the circle counts as inside: at it the argument falls by π.

        Parameters
        ----------
        C
            responses (m, G) of controllers with ``at_one`` poles at z = 1, on the grid.
        controller
            their numbers of unstable poles (m,).
        """
        count = np.empty((C.shape[0], len(self.plants)))
        for j, (unstable, integrators, on_axis) in enumerate(self._open):
            steps = np.diff(np.angle(1.0 + self.P[j] * C), axis=1)
            # Whole turns that bring each step to −π up to π; a remainder takes ten times as long.
            turns = np.count_nonzero(steps < -np.pi, axis=1)
            turns -= np.count_nonzero(steps >= np.pi, axis=1)
            at = np.searchsorted(self.omega, on_axis) - 1
            at = at[(at >= 0) & (at < steps.shape[1])]
            across = np.remainder(steps[:, at] + np.pi, 2.0 * np.pi) - np.pi
            turns -= np.count_nonzero(across > 0.0, axis=1)
            expected = unstable + controller + 0.5 * (integrators + at_one)
            count[:, j] = np.round(expected - np.sum(steps, axis=1) / np.pi - 2.0 * turns)
            # A loop whose crossover lies below the grid: its slow poles do not show.
            count[np.abs(self.P[j, 0] * C[:, 0]) < _LEAST_BOTTOM, j] = np.inf
        return np.abs(count)


def peaks(
    function: Callable[[Vector, NDArray[np.intp]], NDArray[np.float64]],
    omega: Vector,
    values: Matrix,
    least: float,
) -> list[Peak]:
    """Return the local maxima (refined between grid points) above ``least``.

    ``function`` returns values (k,) at frequencies (k,) of the plants with numbers (k,);
    ``values`` (J, G) are those at ``omega``.
    """
    found = []
    padded = np.pad(values, ((0, 0), (1, 1)), constant_values=-np.inf)
    middle = padded[:, 1:-1]
    is_peak = (middle >= padded[:, :-2]) & (middle >= padded[:, 2:]) & (middle > least)
    plants, places = np.nonzero(is_peak)
    if plants.size == 0:
        return []
    x = np.log(omega)
    low, high = x[np.maximum(places - 1, 0)], x[np.minimum(places + 1, x.size - 1)]
    best, at = values[plants, places].copy(), x[places].copy()
    share = np.linspace(0.0, 1.0, _ZOOM)
    rows = np.arange(plants.size)
    for _ in range(_ZOOMS):
        points = low[:, None] + (high - low)[:, None] * share
        members = np.repeat(plants, _ZOOM)
        own = function(np.exp(points.ravel()), members).reshape(plants.size, _ZOOM)
        top = np.argmax(own, axis=1)
        better = own[rows, top] > best
        best = np.where(better, own[rows, top], best)
        at = np.where(better, points[rows, top], at)
        width = (high - low) / (_ZOOM - 1)
        low, high = np.maximum(at - width, low), np.minimum(at + width, high)
    for value, place, plant in zip(best, at, plants, strict=True):
        found.append(Peak(float(value), math.exp(place), int(plant)))
    return found


def dead_samples(plant: SampledPlant) -> int:
    """Return the number of samples that a plant's control signal waits."""
    return int(np.count_nonzero(np.diag(plant.N) == -1.0))


def _beside(omega: Vector, poles: Complex) -> NDArray[np.bool_]:
    """Return which frequencies lie within a fifth of a resonance."""
    distance = np.abs(omega[:, None] / poles.imag[None, :] - 1.0)
    near: NDArray[np.bool_] = np.any(distance < 0.2, axis=1)
    return near
