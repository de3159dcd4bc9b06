"""The compiled loop of the environments: some samples of each of many loops."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers.base import (
    control,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.envs.policy import set_action
from quell.envs.stacked import member
from quell.kernels.dispatch import compiled_loop, is_finite
from quell.plants.base import advance, measure
from quell.types import Matrix, Vector

Integers = NDArray[np.int64]
SIGNALS = 4  # r, y, y_measured, u: the first columns of ``Step.row``
NOISE = 1  # column of the noise in a table of signals; the reference comes first, w last


class Lane(NamedTuple):
    """One loop between samples."""

    x: Vector  # state of the plant (n,)
    scratch: Vector  # (6 n,), see ``plants.base.advance``
    controller: Any  # state of the controller


class Step(NamedTuple):
    """Results of a step, for each loop."""

    row: Matrix  # all channels after the step, see ``Lanes.channels`` (N, …)
    cost: Vector  # of the step (N,)
    sample: Integers  # sample at which each loop is (N,)
    status: Integers  # flags of the step (N,)
    diverged: Integers  # 1 if ``|y|`` was beyond the limit (N,)


class Rules(NamedTuple):
    """Numbers that are the same for all loops."""

    dt: float
    samples: int  # of an episode
    repeat: int  # samples of a step
    limit: float  # |y| beyond it ends an episode
    cost_of_u: float  # [y-unit²/u-unit²]
    worst: float  # cost of a second beyond the limit [y-unit²], more than any within it
    derivatives: int  # of the reference


@compiled_loop("plants", "design", "rules", "actions", "active", "signals")
def run_step(
    plants: Any,
    plant_stride: int,
    lanes: Any,
    lane_stride: int,
    design: Any,
    rules: Rules,
    actions: Vector,
    active: Integers,
    signals: NDArray[np.float64],
    step: Step,
    first: int,
    last: int,
) -> None:
    """Take the loops from ``first`` to before ``last`` through a step, and write their rows.

    Those that are not ``active`` do not move. ``signals`` (N or 1, samples, 2 + …) has r, the
    noise, the derivatives of r and w of each sample, for each loop or for all.
    """
    shared = signals.shape[0] == 1
    begin = 2 + rules.derivatives
    for i in range(first, last):
        plant = member(plants, plant_stride, i)
        lane = member(lanes, lane_stride, i)
        table = signals[0 if shared else i]
        row = step.row[i]
        k = step.sample[i]
        y = measure(plant, lane.x)
        if active[i] != 0:
            set_action(design, lane.controller, actions[i])
            u, cost, status, diverged = 0.0, 0.0, 0, 0
            for _ in range(min(rules.repeat, rules.samples - 1 - k)):
                if rules.derivatives > 0:
                    set_reference_derivatives(design, lane.controller, table[k, 2:begin])
                u = control(design, lane.controller, table[k, 0], y + table[k, NOISE])
                status |= status_flags(design, lane.controller)
                advance(plant, lane.x, lane.scratch, k * rules.dt, u, table[k, begin:])
                k += 1
                y = measure(plant, lane.x)
                if not abs(y) <= rules.limit:
                    diverged = 1
                    break
                error = table[k, 0] - y
                cost += (error * error + rules.cost_of_u * (u * u)) * rules.dt
            if diverged != 0:
                cost += (rules.samples - k) * rules.worst * rules.dt
            row[3] = u
            step.cost[i], step.status[i], step.diverged[i] = cost, status, diverged
            step.sample[i] = k
        row[0], row[1], row[2] = table[k, 0], y, y + table[k, NOISE]
        at = SIGNALS
        for j in range(begin, table.shape[1]):
            row[at] = table[k, j]
            at += 1
        for j in range(lane.x.size):
            row[at] = lane.x[j]
            at += 1
        write_row(design, lane.controller, row[at:])
        if step.diverged[i] != 0:
            for j in range(row.size):
                row[j] = row[j] if is_finite(row[j]) else 0.0
