"""The linear plant that another one is for small motions about an operating point."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from quell import checks
from quell.plants.encoder import EncodedPlant
from quell.plants.linear import LinearPlant
from quell.plants.machines.cubic_spring import CubicSpringPlant
from quell.plants.nonlinear.plant import NonlinearPlant
from quell.types import Matrix, Vector

# Step of the central differences, absolute for values below 1, else relative. Its error is 1e-10 by
# rounding and 1e-12 f'''/6 by truncation, which is 3e-7 of f' even for friction tanh(v/0.001).
_STEP = 1e-6
# Derivatives from the step and from twice the step that differ by more than this share belong to a
# function with a jump or a corner. Chosen by hand; smooth functions agree to 1e-5.
_SMOOTH = 1e-2


def linearised(plant: Any, x: Any, u: float = 0.0, *, w: Any = None, t: float = 0.0) -> LinearPlant:
    """Return a plant linearised about a state and a control signal.

    Its states and signals are the differences from those of the operating point. The result
    describes small motions, also when the point is not a state of rest.

    Parameters
    ----------
    plant
        a ``NonlinearPlant``, whose derivatives are found by central differences with steps of 1e-6
        (choose units in which states are of order one); a plant with a cubic spring; an encoded
        plant, whose encoder is left out; a linear plant, which is returned as it is.
    x
        state (n,).
    u
        control signal [u-unit].
    w
        disturbances (m,); zero by default.
    t
        time [s], for an equation that depends on it.

    Returns
    -------
    LinearPlant

    Raises
    ------
    ValueError
        for another plant, a state of unsuitable length, and a plant that has no derivative there
        (dry friction at standstill, a stop, a dead zone's edge).

    Examples
    --------
    >>> import math
    >>> pendulum = NonlinearPlant(lambda t, x, u, w: (x[1], u - 9.81 * math.sin(x[0])), order=2)
    >>> linearised(pendulum, x=[math.pi, 0.0]).A.round(6).tolist()
    [[0.0, 1.0], [9.81, 0.0]]
    """
    while isinstance(plant, EncodedPlant):
        plant = plant.plant
    if isinstance(plant, LinearPlant):
        return plant
    if isinstance(plant, CubicSpringPlant):
        return _with_spring_of(plant, checks.vector("x", x, plant.order))
    if isinstance(plant, NonlinearPlant):
        state = checks.vector("x", x, plant.order)
        loads = np.zeros(plant.disturbances) if w is None else w
        loads = checks.vector("w", loads, plant.disturbances)
        return _differentiated(plant, state, checks.finite("u", u), loads, checks.finite("t", t))
    rule = "must be a NonlinearPlant, a plant with a cubic spring, or a linear plant"
    raise ValueError(f"plant = {getattr(plant, 'name', plant)!r}: {rule}")


def _with_spring_of(plant: CubicSpringPlant, x: Vector) -> LinearPlant:
    """Return the linear part with ``k + 3 k_cubic (x1 − x2)²`` for k."""
    A = plant.linear.A.copy()
    stiffness = 3.0 * plant.k_cubic * (x[0] - x[1]) ** 2
    A[2, :2] += np.array([-1.0, 1.0]) * stiffness / plant.m1
    A[3, :2] += np.array([1.0, -1.0]) * stiffness / plant.m2
    return LinearPlant(A, plant.linear.B, plant.linear.C, plant.linear.E, name=plant.name)


def _differentiated(plant: NonlinearPlant, x: Vector, u: float, w: Vector, t: float) -> LinearPlant:
    model: Any = plant.sampled(1.0, interpret=True)
    n = x.size

    def rate(point: Vector) -> Any:
        return model.rate(t, point[:n], float(point[n]), point[n + 1 :])

    J = _jacobian(rate, np.concatenate([x, [u], w]), "f")
    C = _jacobian(lambda point: [model.output(point)], x, "output")
    return LinearPlant(J[:, :n], J[:, n], C, J[:, n + 1 :], name=f"{plant.name}, linearised")


def _jacobian(function: Callable[[Vector], Any], point: Vector, name: str) -> Matrix:
    """Return the derivatives (m, n) of m values by the n entries of ``point``."""
    columns = []
    for i in range(point.size):
        step = _STEP * max(1.0, abs(point[i]))
        values = []
        for share in (-2.0, -1.0, 0.0, 1.0, 2.0):
            moved = point.copy()
            moved[i] += share * step
            values.append(np.array(function(moved), dtype=np.float64))
        slopes = np.diff(values, axis=0) / step
        derivative = 0.5 * (slopes[1] + slopes[2])
        # Rounding errors of the values, divided by the step.
        size = np.max(np.abs(values), axis=0) * 1e-9 / step
        allowed = _SMOOTH * np.max(np.abs(slopes), axis=0) + size
        if not np.all(np.ptp(slopes, axis=0) <= allowed):
            raise ValueError(
                f"{name} has no derivative by entry {i} of (x, u, w) = {point.tolist()!r}, where "
                "it jumps or has a corner (dry friction, a stop, the end of a range); take a point "
                "beside it, or a smooth model"
            )
        columns.append(derivative)
    return np.array(columns).T
