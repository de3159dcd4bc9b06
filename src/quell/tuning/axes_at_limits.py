"""Coupled axes in the file that is written: their steps and loads at the limits of the actuators.

What ``acceptance.judge_axes`` needs of a plant with several inputs and outputs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quell.analysis.matrices import linear_part_of
from quell.analysis.multivariable import MultivariableLoop
from quell.controllers.axes import Axes
from quell.plants.channels import DelayedInputs, EncodedOutputs
from quell.plants.nonlinear import checked_point
from quell.tuning.acceptance import WORSE, conditionally_stable, file_without_step
from quell.tuning.optimiser.coupled import CoupledLoops, Found, Plant
from quell.tuning.tables import SHARE
from quell.tuning.written import Written
from quell.types import Matrix, Vector

# Factors of all bandwidths with which axes take the place of some that fail at the limits of u.
_SLOWER = (0.85, 0.7, 0.55)
# What holds an axis is looked at at the frequency of so many time constants.
_HOLD = 1e3
# A solution of ``A x + B u = −E w``, ``C x = 0`` within this share of its right side is one.
_SOLVED = 1e-6


def file_at(plant: Any, axes: Axes, point: Any) -> Written:
    """Return the plant at rest in a scenario in which nothing happens."""
    file = file_without_step(plant, axes.dt, len(axes.names))
    if point is None:
        return file
    x = checked_point(point)[0]
    inner = plant
    while isinstance(inner, DelayedInputs | EncodedOutputs):
        inner = inner.plant
    x0 = np.append(x, np.zeros(plant.order - inner.order))
    at = replace(file, scenario=replace(file.scenario, x0=x0))
    y = [replace(at, axis=i).start for i in range(len(axes.names))]
    return replace(at, scenario=replace(at.scenario, reference=y))


def held_loads(plant: Any, axes: Axes, point: Any) -> Matrix:
    """Return the u that holds each disturbance of 1 (m, q); zero for one that none holds."""
    linear = linear_part_of(plant, axes.dt, point)[0]
    n, p = linear.A.shape[0], linear.C.shape[0]
    matrix = np.block([[linear.A, linear.B], [linear.C, np.zeros((p, linear.B.shape[1]))]])
    right = np.vstack([-linear.E, np.zeros((p, linear.E.shape[1]))])
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    left = np.linalg.norm(matrix @ found - right, axis=0)
    solved = left <= _SOLVED * np.linalg.norm(right, axis=0)
    held: Matrix = np.where(solved, found[n:], 0.0)
    return held


def time_constant(loop: MultivariableLoop) -> float:
    """Return 1/ω of the slowest axis [s]: where its |S| first reaches 1/√2."""
    omega = loop.omega[1:]
    S = np.abs(np.einsum("kii->ki", loop.response("S_o", omega)))
    return 1.0 / min(float(omega[np.argmax(each >= math.sqrt(0.5))]) for each in S.T)


def step_sizes(plant: Plant, axes: Axes, tau: float, point: Any) -> Vector:
    """Return steps of the references (n,) that use a share of the range of an actuator.

    An axis asks for ω_c^n of the step in the first sample, and for what holds it at rest later.
    """
    A, B, C, R = plant
    z = np.exp(1j * axes.dt / (_HOLD * tau))
    at_rest = np.abs(np.linalg.pinv(C @ np.linalg.solve(z * np.eye(A.shape[0]) - A, B)))
    first = np.array([axis.omega_c**axis.observer.order for axis in axes.axes])
    needed = np.maximum(at_rest, np.abs(R) * first)
    u = np.zeros(axes.inputs) if point is None else np.atleast_1d(checked_point(point)[1])
    low, high = axes.limits.low, axes.limits.high
    room = np.maximum(np.minimum(high - u, u - low), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        sizes = np.where(needed > 0.0, SHARE * room[:, None] / needed, math.inf)
    found: Vector = np.min(sizes, axis=0)
    return np.where(np.isfinite(found), found, 1.0)


def slower(found: Found, loops: CoupledLoops) -> Iterator[Found]:
    """Yield slower axes that are not much worse and keep the bounds as well."""
    for factor in _SLOWER:
        for row in ((factor, factor), (factor, 1.0)):  # omega_c and omega_o
            values = found.values * np.array(row)
            other = Found(values, loops.measured(values))
            worse = np.max(other.measured.costs / found.measured.costs)
            if other.rank[0] <= found.rank[0] and worse <= WORSE:
                yield other


def least_gains(loops: Sequence[MultivariableLoop]) -> list[str]:
    """Return a line with the least gain that a channel bears, where there is one."""
    found = [
        loop.channel_margins(name).gain
        for loop in loops
        if loop.stable
        for name in (*loop.inputs, *loop.outputs)
    ]
    return conditionally_stable(found, " of a channel, all others closed")
