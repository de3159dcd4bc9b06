"""Coupled axes in the file that is written: their steps and loads at the limits of the actuators.

What ``acceptance.judge_axes`` needs of a plant with several inputs and outputs.

*Prefilters.* Along y of one axis, the others at rest, the linear plant needs u = c_0 y + c_1 y' +
c_2 y''. With y = t²/2 and x = x_0 + x_1 t + x_2 t²/2, the powers of t in x' = A x + B u, y = C x
give three systems with one matrix, for e of the axis::

    K = [A, B; C, 0],   K [x_2; c_0] = [0; e],   K [x_1; c_1] = [x_2; 0],   K [x_0; c_2] = [x_1; 0]

So an axis that needs little u at rest gets a ``ProfileGenerator`` of its c_1 and c_2, and another
one a ``ReferenceModel``, each as a single one does (``tuning/reference.py``), one after the other;
axes that step in one sample share the room for u. Each try is a run of the file.
"""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quell.analysis.matrices import linear_part_of
from quell.analysis.multivariable import MultivariableLoop
from quell.controllers.axes import Axes
from quell.controllers.feedforward import checked_feedforward
from quell.controllers.prefilters import ReferenceModel
from quell.plants.channels import DelayedInputs, EncodedOutputs
from quell.plants.nonlinear import checked_point
from quell.tuning import reference
from quell.tuning.acceptance import FASTEST_MODEL, WORSE, conditionally_stable, file_without_step
from quell.tuning.optimiser.coupled import CoupledLoops, Found, Plant
from quell.tuning.tables import SHARE
from quell.tuning.written import MOST_OVERSHOOT, Written
from quell.types import Matrix, Vector

# Factors of all bandwidths with which axes take the place of some that fail at the limits of u.
_SLOWER = (0.85, 0.7, 0.55)
# What holds an axis is looked at at the frequency of so many time constants.
_HOLD = 1e3
# A solution of ``A x + B u = −E w``, ``C x = 0`` within this share of its right side is one.
_SOLVED = 1e-6
# A step that needs more than this share of the room for u at rest is that of a process.
_PROCESS = 0.5
# The bandwidth of the reference model of axes whose turn is later, in units of omega_c, and the
# derivatives that a profile generator has.
_SLOW_MODEL, _DERIVATIVES = 0.3, 3


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
    # What rounding leaves of an actuator that holds nothing would be a huge load at its limits.
    return np.where(np.abs(held) > _SOLVED * np.max(np.abs(held), axis=0, initial=0.0), held, 0.0)


def needs_along(plant: Any, axes: Axes, point: Any) -> tuple[Matrix, Matrix, Matrix]:
    """Return the u that each axis needs for y, y' and y'' of 1 (m, n) each; see above."""
    linear = linear_part_of(plant, axes.dt, point)[0]
    n, p, m = linear.A.shape[0], linear.C.shape[0], linear.B.shape[1]
    inverse = np.linalg.pinv(np.block([[linear.A, linear.B], [linear.C, np.zeros((p, m))]]))
    x, found = np.zeros((n, p)), []
    for y in (np.eye(p), np.zeros((p, p)), np.zeros((p, p))):
        solved = inverse @ np.vstack([x, y])
        x = solved[:n]
        found.append(np.abs(solved[n:]))
    return found[0], found[1], found[2]


def with_prefilters(
    plant: Any, axes: Axes, held: Matrix, point: Any, files: Sequence[Written]
) -> Axes | None:
    """Return the axes behind prefilters with which the steps of the file overshoot by 5 % at most.

    None where no step is left without a prefilter, or no prefilters do.

    Parameters
    ----------
    plant, axes, point
        as for ``tune``.
    held
        u that holds each disturbance of 1 (m, q).
    files
        plant and scenario, for each axis.
    """
    stepping = {
        i: (each.largest[0], abs(each.largest[2]))
        for i, (each, given) in enumerate(zip(files, axes.prefilters, strict=True))
        if each.largest is not None and given is None
    }
    if not stepping:
        return None
    u = np.zeros(axes.inputs) if point is None else np.atleast_1d(checked_point(point)[1])
    room = np.minimum(axes.limits.high - u, u - axes.limits.low)
    t = np.arange(round(files[0].scenario.duration / axes.dt)) * axes.dt
    loads = np.array([float(np.max(np.abs(load(t)), initial=0.0)) for load in files[0].loads])
    if held.shape[1] == loads.size:
        room = room - np.minimum(np.abs(held) @ loads, reference.MOST_RESERVED * room)
    together = Counter(first for first, _ in stepping.values())
    with np.errstate(divide="ignore", invalid="ignore"):
        needed = [
            np.max(np.where(u > 0.0, u / room[:, None], 0.0), axis=0)
            for u in needs_along(plant, axes, point)
        ]

    # What each axis needs of the room, with those that step with it; None for another plant.
    parts: dict[int, tuple[reference.Axis | None, float]] = {}
    made = copy.copy(axes)
    for i, (first, size) in stepping.items():
        own = made.axes[i]
        at_rest, viscous, inertia = (float(u[i]) * together[first] for u in needed)
        if not max(at_rest, viscous, inertia) > 0.0:  # no actuator that moves it has limits
            continue
        left = 1.0 - at_rest * size
        moves = own.observer.order > 1 and left > 1.0 - _PROCESS
        parts[i] = reference.Axis(viscous, inertia) if moves else None, left
        if moves and not own.feedforward and own.observer.order <= _DERIVATIVES:
            own.feedforward = checked_feedforward(True)
            own._initialise()
    made._initialise()
    for i in parts:  # while one is tried the others move slowly
        slow = ReferenceModel(_SLOW_MODEL * made.axes[i].omega_c, made.axes[i].observer.order)
        made = reference.behind(made, slow, i)
    for i, (rigid, left) in parts.items():
        own, file = made.axes[i], files[i]
        found = reference.Shaped(None, None)
        if rigid is not None:
            found = reference.profile_for(file, made, rigid, 1.0 / own.omega_c, left)
        if found.step is None:
            found = reference.reference_model_for(
                file, made, FASTEST_MODEL * own.omega_c, own.observer.order
            )
        if found.step is None:
            return None
        made = reference.behind(made, found.prefilter, i)
    run = files[0].run(made)
    for i in stepping:
        step = files[i].figures(made, run)
        if step is None or not step.overshoot <= MOST_OVERSHOOT or math.isnan(step.settling):
            return None
    return made


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
