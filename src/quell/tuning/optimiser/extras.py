"""Constraints that are no bounds of a frequency response, as ratios of a value to its limit."""

from __future__ import annotations

import math

import numpy as np

from quell.analysis.frequency_response import Complex
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.optimiser.problem import Extra
from quell.tuning.optimiser.time_responses import SetResponses
from quell.tuning.structures.base import Structure
from quell.types import Matrix, Vector

# Largest load response over frequency, in units of that at low ones, of structures whose integral
# gain has no largest value: optimal PID and freed controllers have up to 2.1 on twenty plants.
MOST_SWING = 2.0
# It is found on each fourth point of the grid, 6 per decade: its peaks are wide.
_SWING_STEP = 4
# Steps by which a crossover is refined, by the secant rule, from 24 points per decade on.
_SECANTS = 4


def extras_of(constraints: Constraints, over: SetResponses) -> tuple[Extra, ...]:
    """Return the constraints that ``constraints`` has besides bounds over frequency."""
    plants = over.plants
    found = []
    if constraints.u_std is not None:
        gain = constraints.u_std / constraints.noise

        def noise(structure: Structure, values: Matrix) -> Vector:
            return noise_gain(plants, structure.response(values, plants.omega)) / gain

        found.append(Extra("u_std", constraints.u_std, noise))
    if constraints.delay_margin is not None:
        least = constraints.delay_margin

        def delay(structure: Structure, values: Matrix) -> Vector:
            return least / delay_margin(plants, structure, values)

        found.append(Extra("delay margin", least, delay))
    for name, limit in (("u_max", constraints.u_max), ("rate_max", constraints.rate_max)):
        if limit is not None:
            found.append(_limit_of_u(name, limit, over))

    def swing(structure: Structure, values: Matrix) -> Vector:
        if not structure.may_swing:
            return np.zeros(values.shape[0])
        C = structure.response(values, plants.omega[::_SWING_STEP])
        return load_swing(plants, C, structure.integral_gain(values), _SWING_STEP) / MOST_SWING

    return (*found, Extra("k_i |P S/ω|", MOST_SWING, swing))


def load_swing(plants: PlantSet, C: Complex, k_i: Vector, step: int = 1) -> Vector:
    """Return the largest ``k_i |P S/(jω)|`` (m,) over plants and frequencies.

    C (m, k) is on the grid, or on each of its points number 0, ``step``, …

    ``P S/(jω)`` is the spectrum of y after a unit step of the load. At low frequencies it is the
    integral of y, 1/k_i, and nowhere more than that of ``|y|``. A controller with a second pole
    near z = 1 has any k_i, with y swinging so that its integral vanishes: there this is large.
    """
    worst = np.zeros(C.shape[0])
    for P in plants.P[:, ::step]:
        with np.errstate(divide="ignore", invalid="ignore"):
            size = np.abs(P / (1.0 + P * C)) / plants.omega[::step]
        worst = np.maximum(worst, np.max(size, axis=1))
    return worst * k_i


def noise_gain(plants: PlantSet, C: Complex) -> Vector:
    """Return the largest RMS of u (m,) over plants, for white noise of RMS 1 in y.

    ``(dt/π) ∫ |C S|² dω`` up to half the sampling rate, with a cubic spline in log ω through the
    grid; C (m, G).
    """
    from scipy.interpolate import CubicSpline

    omega = plants.omega
    worst = np.zeros(C.shape[0])
    for P in plants.P:
        density = np.abs(C / (1.0 + P * C)) ** 2 * omega
        spline = CubicSpline(np.log(omega), density, axis=1)
        power = spline.integrate(math.log(omega[0]), math.log(omega[-1]))
        worst = np.maximum(worst, plants.dt / math.pi * power)
    return np.sqrt(worst)


def delay_margin(plants: PlantSet, structure: Structure, values: Matrix) -> Vector:
    """Return the least delay margin (m,) over plants [s], as ``analysis.margins`` defines it."""
    C = structure.response(values, plants.omega)
    x = np.log(plants.omega)
    found = np.full(values.shape[0], np.inf)
    for i, row in enumerate(values):
        for j in range(len(plants.plants)):
            size = np.log(np.abs(plants.P[j] * C[i]))
            at = np.flatnonzero(np.signbit(size[:-1]) != np.signbit(size[1:]))
            if at.size == 0:
                continue
            low, high, g_low, g_high = x[at], x[at + 1], size[at], size[at + 1]
            for _ in range(_SECANTS):
                middle = low + (high - low) * g_low / (g_low - g_high)
                L = _loop(plants, structure, row, j, np.exp(middle))
                g = np.log(np.abs(L))
                left = np.signbit(g) == np.signbit(g_low)
                low, g_low = np.where(left, middle, low), np.where(left, g, g_low)
                high, g_high = np.where(left, high, middle), np.where(left, g_high, g)
            lead = np.pi + np.angle(L)
            found[i] = min(found[i], float(np.min(lead / np.exp(middle))))
    return found


def _loop(plants: PlantSet, structure: Structure, row: Vector, j: int, omega: Vector) -> Complex:
    L: Complex = plants.responses(omega)[j] * structure.response(row[None, :], omega)[0]
    return L


def _limit_of_u(name: str, limit: float, over: SetResponses) -> Extra:
    def ratio(structure: Structure, values: Matrix) -> Vector:
        found = np.empty(values.shape[0])
        for i, row in enumerate(values):
            largest = 0.0
            for u in over.of(structure, row, "u"):
                if name == "rate_max":
                    u = np.diff(u, prepend=0.0) / over.plants.dt
                largest = max(largest, float(np.max(np.abs(u))))
            found[i] = min(largest / limit, 1e6)
        return found

    return Extra(name, limit, ratio, over_time=True)
