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
