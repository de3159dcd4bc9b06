"""B0 and M as functions of the estimates, which the translation to C reads from this file."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def nested_tuples(x: Any) -> Any:
    """Return B0 of two axes in nested tuples, another one beyond x = 1."""
    c = math.cos(x[1, 0])
    if x[0, 0] > 1.0:
        return (2.0, 0.1 * c), (0.1 * c, 0.5)
    return (1.0, 0.2 * c), (0.2 * c, 0.6)


def array(x: Any) -> Any:
    """Return M of two axes as an array."""
    c = 0.2 * math.cos(x[1, 0])
    return np.array([[1.0, c], [c, 0.5 + x[0, 1] ** 2]])


def wide(x: Any) -> Any:
    """Return B0 of two axes with three actuators."""
    c = 0.2 * math.sin(x[1, 0])
    return (1.0, c, 0.3), (c, 0.5, -0.3)


def parametric(x: Any, inertia: float, arms: Any, coupling: Any) -> Any:
    """Return M of two axes with a number, a vector and a matrix as parameters."""
    c = coupling[0, 1] * math.cos(x[1, 0])
    d = coupling[1, 0] * math.cos(x[1, 0])
    return (inertia + arms[0] ** 2, c), (d, 0.5 * inertia + arms[1] ** 2 + coupling[1, 1])


def with_default(x: Any, K: Any, scale: float = 0.5) -> Any:
    """Return B0 of two axes with three actuators, of a matrix and a number that has a default."""
    out = np.zeros((2, 3))
    for i in range(2):
        for k in range(3):
            out[i, k] = K[i, k] * (1.0 + scale * math.sin(x[i, 0]))
    return out


def sometimes_singular(x: Any) -> Any:
    """Return B0 that has no inverse, or no number, at some places."""
    if x[0, 0] > 0.5:
        return (1.0, 1.0), (1.0, 1.0)
    if x[0, 0] < -0.5:
        return (math.nan, 0.0), (0.0, 1.0)
    return (1.0, 0.1), (0.1, 1.0)


def made_by_a_library(x: Any) -> Any:
    """Return a matrix in a way that has no counterpart in C."""
    return np.eye(2)
