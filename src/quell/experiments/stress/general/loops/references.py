"""References of the trial, and the response that the design asks for."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from quell.experiments.stress.adversaries import log_uniform
from quell.types import Vector

Rng = np.random.Generator


def _regulation(t: Vector, rng: Rng) -> Vector:
    return np.zeros_like(t)


def _steps(t: Vector, rng: Rng) -> Vector:
    """Return steps of up to 1, 15 to 60/omega_c apart."""
    r, at, height = np.zeros_like(t), rng.uniform(0.0, 20.0), 0.0
    while at < t[-1]:
        height += float(np.clip(rng.uniform(-1.0, 1.0), -2.0 - height, 2.0 - height))
        r[t >= at] = height
        at += rng.uniform(15.0, 60.0)
    return r


def _moves(t: Vector, rng: Rng) -> Vector:
    """Return smooth moves of up to 1, 15 to 60/omega_c apart."""
    corners, heights = [0.0], [0.0]
    while corners[-1] < t[-1]:
        rest, move = rng.uniform(5.0, 40.0), rng.uniform(4.0, 20.0)
        corners += [corners[-1] + rest, corners[-1] + rest + move]
        heights += [heights[-1], float(rng.uniform(-1.0, 1.0))]
    at = np.searchsorted(corners, t, side="right") - 1
    at = np.minimum(at, len(corners) - 2)
    low, high = np.asarray(corners)[at], np.asarray(corners)[at + 1]
    share = np.clip((t - low) / (high - low), 0.0, 1.0)
    a, b = np.asarray(heights)[at], np.asarray(heights)[at + 1]
    return a + (b - a) * (10.0 * share**3 - 15.0 * share**4 + 6.0 * share**5)


def _sine(t: Vector, rng: Rng) -> Vector:
    return np.sin(log_uniform(rng, 0.1, 1.0) * t)


def _trained(t: Vector, rng: Rng) -> Vector:
    """Return a sinusoid for two fifths of the run, then a step, as the two-mass loops have."""
    return np.where(t < 0.4 * t[-1], np.sin(t), 1.0)


REFERENCES: dict[str, Callable[[Vector, Rng], Vector]] = {
    "regulation": _regulation,
    "steps": _steps,
    "smooth moves": _moves,
    "sinusoid": _sine,
    "sinusoid, then a step": _trained,
}


def reference_table(kind: str, t: Vector, rng: Rng) -> Vector:
    """Return the reference at the times ``t``."""
    return REFERENCES[kind](t, rng)


def ideal(r: Vector, dt: float, order: int, omega_c: float = 1.0) -> Vector:
    """Return ``(omega_c/(s + omega_c))^n r`` with r held over each sample.

    The first lag is sampled with a held input, exactly; its output is continuous, and the others
    are sampled with an input that is linear between samples (first-order hold).
    """
    from scipy.signal import lfilter

    x = omega_c * dt
    pole = np.exp(-x)
    y = np.append(0.0, lfilter([-np.expm1(-x)], [1.0, -pole], r)[:-1])
    late = 1.0 - (1.0 - pole) / x  # first-order hold: y⁺ = p y + (1 − p − late) u + late u⁺
    for _ in range(order - 1):
        y = lfilter([late, 1.0 - pole - late], [1.0, -pole], y)
    return np.asarray(y)
