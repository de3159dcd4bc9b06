"""Random plants of the trial, by family."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell.experiments.stress.adversaries import log_uniform
from quell.experiments.stress.general.loops.plant import GeneralPlant
from quell.plants import LinearPlant, two_mass_spring
from quell.types import Vector

Rng = np.random.Generator

FAMILIES = (
    "stable",
    "unstable",
    "lagged",
    "delayed",
    "saturated",
    "quantised",
    "friction",
    "gravity",
    "two masses",
)


class DrawnPlant(NamedTuple):
    """A plant, and what its controller and its load have to know."""

    plant: GeneralPlant
    order: int  # of the controller
    b: float  # gain from u to y^(order)
    load: float  # load that acts on f, at low frequencies, as 1 does
    operating_points: tuple[LinearPlant, ...]  # linear plants that it is at its operating points


def draw_plant(family: str, n: int, omega_o: float, dt: float, rng: Rng) -> DrawnPlant:
    """Return a random plant of a family for a controller of order n."""
    if family == "two masses":
        linear = _two_masses(rng)
    elif family in ("friction", "gravity") and n > 2:
        linear = _driven_mass(rng) if n == 3 else _two_masses(rng)
    else:
        linear = _chain(family, n, omega_o, rng)
    b = float((linear.C @ np.linalg.matrix_power(linear.A, n - 1) @ linear.B)[0, 0])
    if b == 0.0:  # a lag in front: its input is scaled so that the gain is that of the chain
        b = float((linear.C @ np.linalg.matrix_power(linear.A, n) @ linear.B)[0, 0])
        b /= -linear.A[-1, -1]
    parts: dict[str, Any] = {}
    slopes = [0.0]
    velocity = {1: 0, 2: 1, 3: 1, 4: 3}[n]
    if family == "delayed":
        parts["delay"] = max(round(log_uniform(rng, 0.02, 0.5) / omega_o / dt), 1)
    elif family == "quantised":
        parts["quantum"] = log_uniform(rng, 1e-4, 1e-2) * 0.2 ** (n - 1)
    elif family == "friction":
        parts |= {"velocity": velocity, "friction": log_uniform(rng, 0.05, 1.0)}
    elif family == "gravity":
        strength, rate = log_uniform(rng, 0.1, 2.0), log_uniform(rng, 0.3, 3.0)
        parts |= {"velocity": velocity, "strength": strength, "rate": rate}
        slopes = [-strength * rate, 0.0, strength * rate]
    points = []
    for slope in slopes:
        A = linear.A.copy()
        A[velocity] += slope * linear.C[0]
        points.append(LinearPlant(A, linear.B, linear.C, linear.E))
    load = 1.0 / load_gain(linear, n)
    return DrawnPlant(GeneralPlant(linear, **parts), n, b, load, tuple(points))


def load_gain(plant: LinearPlant, order: int) -> float:
    """Return the gain from the load to f at low frequencies, of the plant without a lag in front.

    It is the numerator ``C adj(−A) E = det(E C − A) − det(−A)`` of the load's transfer function.
    """
    A, E, C = plant.A[:order, :order], plant.E[:order], plant.C[:, :order]
    return float(np.linalg.det(E @ C - A) - np.linalg.det(-A))


def _two_masses(rng: Rng) -> LinearPlant:
    """Return two masses on a spring, with the load on the second."""
    m1, m2, k = rng.uniform(0.5, 2.0), rng.uniform(0.5, 2.0), rng.uniform(0.3, 3.0)
    plant = two_mass_spring(m1, m2, k)
    return LinearPlant(plant.A, plant.B, plant.C, plant.E[:, 1:])


def _driven_mass(rng: Rng) -> LinearPlant:
    """Return a mass with damping, its load, and a drive with a lag: y, its velocity, the force."""
    damping, lag, gain = log_uniform(rng, 0.05, 2.0), log_uniform(rng, 0.1, 2.0), _gain(rng)
    A = np.array([[0.0, 1.0, 0.0], [0.0, -damping, 1.0], [0.0, 0.0, -1.0 / lag]])
    return LinearPlant(A, [0.0, 0.0, gain], [1.0, 0.0, 0.0], [[0.0], [1.0], [0.0]])


def _chain(family: str, n: int, omega_o: float, rng: Rng) -> LinearPlant:
    """Return ``y^(n) = −a x + b u + w``, with a lag in front of u if it is lagged."""
    b, unit = _gain(rng), np.eye(n)
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = -_coefficients(n, family == "unstable", rng)
    B, E, C = b * unit[-1:].T, unit[-1:].T, unit[:1]
    if family == "lagged":
        tau = log_uniform(rng, 0.03, 1.0) / omega_o
        A = np.block([[A, B], [np.zeros((1, n)), np.full((1, 1), -1.0 / tau)]])
        B = np.eye(n + 1)[-1:].T / tau
        E, C = np.append(E, [[0.0]], axis=0), np.eye(n + 1)[:1]
    return LinearPlant(A, B, C, E)


def _gain(rng: Rng) -> float:
    return log_uniform(rng, 0.1, 10.0)


def _coefficients(n: int, unstable: bool, rng: Rng) -> Vector:
    """Return ``a_0 … a_{n−1}`` of ``s^n + a_{n−1} s^(n−1) + … + a_0`` with random poles."""
    poles: list[complex] = []
    while len(poles) < n:
        size = log_uniform(rng, 0.05, 2.0)
        if n - len(poles) >= 2 and rng.random() < 0.5:
            damping = rng.uniform(0.02, 1.0)
            pole = size * complex(-damping, math.sqrt(1.0 - damping**2))
            poles += [pole, pole.conjugate()]
        else:
            poles.append(-size if rng.random() < 0.7 else 0.0)
    if unstable:
        last = complex(poles[-1])
        if last.imag != 0.0:
            poles[-2:] = [-pole.conjugate() for pole in poles[-2:]]
        else:
            poles[-1] = log_uniform(rng, 0.05, 1.0)
    return np.asarray(np.real(np.poly(poles))[:0:-1])
