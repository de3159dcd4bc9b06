"""Coupled axes in the file that is written: their steps and loads at the limits of the actuators.

What ``acceptance.judge_axes`` needs of a plant with several inputs and outputs.

*Prefilters.* Along y of one axis, the others at rest, the linear plant needs u = c_0 y + c_1 y' +
c_2 y''. With y = t²/2 and x = x_0 + x_1 t + x_2 t²/2, the powers of t in x' = A x + B u, y = C x
give three systems with one matrix, for e of the axis::

    K = [A, B; C, 0],   K [x_2; c_0] = [0; e],   K [x_1; c_1] = [x_2; 0],   K [x_0; c_2] = [x_1; 0]

So an axis that needs little u at rest gets a ``ProfileGenerator`` of its c_1 and c_2, as a single
one does (``tuning/reference.py``), with the feedforward of its order; axes that step in one sample
share the room for u. Another one gets a ``ReferenceModel``. Each try is a run of the file.
"""

from __future__ import annotations

import copy
import itertools
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
from quell.tuning.acceptance import (
    FASTEST_MODEL,
    WORSE,
    conditionally_stable,
    file_without_step,
)
from quell.tuning.optimiser.coupled import CoupledLoops, Found, Plant
from quell.tuning.reference import (
    BEYOND,
    MOST_RESERVED,
    SAMPLES,
    SHARES,
    SLOWER,
    TRIES,
    Axis,
    few_at_limits,
    with_less,
)
from quell.tuning.tables import SHARE
from quell.tuning.written import MOST_OVERSHOOT, StepFigures, Written
from quell.types import Matrix, Vector

# Factors of all bandwidths with which axes take the place of some that fail at the limits of u.
_SLOWER = (0.85, 0.7, 0.55)
# What holds an axis is looked at at the frequency of so many time constants.
_HOLD = 1e3
# A solution of ``A x + B u = −E w``, ``C x = 0`` within this share of its right side is one.
_SOLVED = 1e-6
# Ramps of the acceleration, in time constants of the axis. With the shares of a single axis the
# best is taken, or the first of slower ones. Chosen by hand; each is simulated.
_RAMPS = (0.3, 1.0, 3.0)
_BEYOND_MOVES = tuple(itertools.product(BEYOND, _RAMPS))
_QUICK_MOVES = tuple(itertools.product(SHARES, _RAMPS))
_SLOW_MOVES = tuple((SHARES[-1] * SLOWER**i, _RAMPS[-1]) for i in range(1, TRIES + 1))
# A step that needs more than this share of the room for u at rest is that of a process.
_PROCESS = 0.5


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
        room = room - np.minimum(np.abs(held) @ loads, MOST_RESERVED * room)
    together = Counter(first for first, _ in stepping.values())
    with np.errstate(divide="ignore", invalid="ignore"):
        needed = [
            np.max(np.where(u > 0.0, u / room[:, None], 0.0), axis=0)
            for u in needs_along(plant, axes, point)
        ]

    braked = set()  # axes that friction brakes
    for i, (first, size) in stepping.items():
        at_rest, viscous, inertia = (float(u[i]) * together[first] for u in needed)
        if Axis(viscous, inertia).beyond(size, 1.0 - at_rest * size):
            braked.add(i)

    def steps_of(made: Axes) -> list[StepFigures]:
        run = files[0].run(made)
        return [figures for i in stepping if (figures := files[i].figures(made, run)) is not None]

    def tried(share: float, ramp: float) -> Axes:
        """Return axes behind prefilters; a ``share`` above 1 goes beyond it, of ``braked`` ones."""
        made = copy.copy(axes)
        shapers = list(axes.prefilters)
        for i, (first, size) in stepping.items():
            axis = made.axes[i]
            at_rest, viscous, inertia = (float(u[i]) * together[first] for u in needed)
            if not max(at_rest, viscous, inertia) > 0.0:  # no actuator that moves it has limits
                continue
            own = min(share, SHARES[0])
            left = own * (1.0 - at_rest * size)
            if axis.observer.order < 2 or not left > own * (1.0 - _PROCESS):
                omega = min(FASTEST_MODEL * own / ramp * axis.omega_c, 1.0 / axes.dt)
                shapers[i] = ReferenceModel(omega, axis.observer.order)
                continue
            slow = max(ramp / axis.omega_c, SAMPLES[0] * axes.dt)
            beyond = max(share, 1.0) if i in braked else 1.0
            shapers[i] = Axis(viscous, inertia).profile(size, left, slow, beyond)
            if not axis.feedforward and axis.observer.order <= shapers[i].derivatives:
                axis.feedforward = checked_feedforward(True)
                axis._initialise()
        made.prefilters = tuple(shapers)
        made._initialise()
        return made

    best: tuple[float, Axes] | None = None
    for share, ramp in (*(_BEYOND_MOVES if braked else ()), *_QUICK_MOVES, *_SLOW_MOVES):
        if best is not None and share < SHARES[-1]:
            break
        made = tried(share, ramp)
        steps = steps_of(made)
        if any(math.isnan(s.settling) or not s.overshoot <= MOST_OVERSHOOT for s in steps):
            continue
        rank = sum(step.settling for step in steps)
        if any(s.limited > few_at_limits(s.settling, axes.dt) for s in steps):
            weaker = steps_of(with_less(made)) if braked else []
            if not weaker or not all(s.overshoot <= MOST_OVERSHOOT for s in weaker):
                rank = math.inf
        if math.isinf(rank) and share > 1.0:
            continue
        if best is None or rank < best[0]:
            best = rank, made
    return None if best is None else best[1]


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
