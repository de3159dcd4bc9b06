"""Environments of several axes: what a policy sets for each, and many such loops at once.

A policy gives f_L of each axis of ``quell.Axes`` whose learner is a ``Policy``, or all control
signals u of an open plant. Its numbers are written into the states of the loops, which lie at equal
distances in memory, for all loops at once. The rest is that of one axis (``loops.py``), with
vectors in the place of r, y and u.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.axes import Axes
from quell.controllers.base import reset_loop, status_flags, write_row
from quell.controllers.several import control_all
from quell.envs.loops import (
    Integers,
    Loops,
    Policy,
    Rules,
    check_given_once,
    member,
    sample_time,
)
from quell.kernels.dispatch import compiled_loop, interpreted, is_finite, kernel
from quell.plants.multivariable import measure_all
from quell.simulation.several import check_fit, logged_channels, run_axes
from quell.types import Channels, Matrix, Vector

# ---- The absence of a controller ----


class GivenDesigns(NamedTuple):
    """Parameters of ``GivenControls``: limits of magnitude of each control signal (m,)."""

    low: Vector
    high: Vector


class GivenStates(NamedTuple):
    """State of ``GivenControls``."""

    u: Vector  # (m,)


@dataclass(frozen=True, eq=False)
class GivenControls:
    """The absence of a controller of several axes: all u come from outside, within limits."""

    dt: float
    parameters: GivenDesigns
    outputs: int
    features: tuple[str, ...] = ()
    channels: Channels = ()
    names: tuple[str, ...] = ()

    @property
    def inputs(self) -> int:
        """Number of control signals."""
        return int(self.parameters.low.size)

    @property
    def derivatives(self) -> tuple[int, ...]:
        """No derivative of a reference is used."""
        return (0,) * self.outputs

    def initial_state(self) -> GivenStates:
        """Return the state before the first sample."""
        return GivenStates(np.zeros(self.inputs))


@control_all.register(GivenDesigns)
def _control_all(design: GivenDesigns, state: GivenStates, r: Vector, y: Vector, u: Vector) -> None:
    for k in range(u.size):
        u[k] = min(max(state.u[k], design.low[k]), design.high[k])


@write_row.register(GivenDesigns)
def _write_row(design: GivenDesigns, state: GivenStates, row: Vector) -> None:
    pass


@status_flags.register(GivenDesigns)
def _status_flags(design: GivenDesigns, state: GivenStates) -> int:
    return 0


@reset_loop.register(GivenDesigns)
def _reset_loop(design: GivenDesigns, state: GivenStates) -> None:
    for k in range(state.u.size):
        state.u[k] = 0.0


# ---- What the actions are ----


class Actions(NamedTuple):
    """Values of the actions −1 and 1, ``middle ± reach``, and the limits of u (m,)."""

    middle: Any
    reach: Any
    u_min: Any
    u_max: Any
    names: tuple[str, ...]  # of each action


def loop_of_axes(
    plant: Any, controller: Any, dt: float | None, u_min: Any, u_max: Any
) -> tuple[Any, Actions]:
    """Return the controller of a loop of several axes and the meaning of its actions.

    Raises
    ------
    ValueError
        for a controller without ``Policy``, without finite limits, or for missing arguments.
    """
    if controller is None:
        dt = sample_time(dt)
        low, high = _limits("u_min and u_max", u_min, u_max, plant.inputs)
        actions = Actions(0.5 * (low + high), 0.5 * (high - low), low, high, _places("u", low.size))
        return GivenControls(dt, GivenDesigns(low, high), plant.outputs), actions
    if not isinstance(controller, Axes) or controller.takes_u_0:
        raise ValueError(
            f"controller = {controller!r:.60}: must be quell.Axes that follow references, with "
            "learner=quell.envs.Policy() in one axis or more, or None for actions that are u"
        )
    check_fit(plant, controller)
    policies = {
        name: axis.learner
        for name, axis in zip(controller.names, controller.axes, strict=True)
        if isinstance(axis.learner, Policy)
    }
    if not policies:
        raise ValueError(
            "controller: no axis has learner=quell.envs.Policy(), whose output the actions are"
        )
    check_given_once(dt, u_min, u_max)
    limits = controller.limits
    what = "u_min and u_max of the controller"
    low, high = _limits(what, limits.low, limits.high, controller.inputs)
    reach = np.array(
        [_most(controller, name, policy, high - low) for name, policy in policies.items()]
    )
    return controller, Actions(np.zeros(reach.size), reach, low, high, tuple(policies))


def _most(controller: Axes, name: str, policy: Policy, span: Vector) -> float:
    """Return f_L of the action 1: by default what the actuators can cancel, one axis alone."""
    if policy.most is not None:
        return policy.most
    if callable(controller.B0) or callable(controller.M):
        raise ValueError(
            f"axis {name}: Policy(most=None): B0 is a function, so what u can cancel depends on "
            "the estimates; give most, the f_L of the action 1"
        )
    row = controller.first_gain[controller.names.index(name)]
    return float(0.5 * np.sum(np.abs(row) * span))


def _limits(what: str, low: Any, high: Any, size: int) -> tuple[Vector, Vector]:
    """Return finite limits of each control signal, from one for all or one for each."""
    try:
        ends = [
            np.broadcast_to(np.asarray(end, dtype=np.float64), (size,)).copy()
            for end in (low, high)
        ]
    except (TypeError, ValueError):
        ends = []
    if not ends or not np.all(np.isfinite(ends)) or not np.all(ends[0] < ends[1]):
        rule = f"must be finite, the first smaller, one for all or one for each of {size}"
        raise ValueError(f"{what} = {low!r}, {high!r}: {rule}")
    return ends[0], ends[1]


def _places(name: str, width: int) -> tuple[str, ...]:
    return tuple(f"{name}[{k}]" for k in range(width))


def labels_of(channel: str, width: int, axis_names: tuple[str, ...]) -> list[str]:
    """Return a name for each number of a channel: of axes by their names, else by numbers."""
    if width == 1:
        return [channel]
    if channel in ("r", "y", "y_measured", "v") and len(axis_names) == width:
        return [f"{channel}[{name}]" for name in axis_names]
    return [*_places(channel, width)]


def observed_by_default(controller: Any) -> tuple[str, ...]:
    """Return the channels that a policy of several axes sees."""
    if not controller.names:
        return "r", "y_measured", "u", "x"
    own = ("x_hat", "f_residual", "f_learned")
    known = {name for name, width in controller.channels if width}
    every = [f"{axis}.{channel}" for axis in controller.names for channel in own]
    return ("r", "y_measured", "u", *(name for name in every if name in known))


# ---- The compiled loop ----

run_axes_samples = kernel(interpreted(run_axes))
"""``run_axes`` for the compiled loop over several loops."""


class StepOfAxes(NamedTuple):
    """Results of a step, for each loop of several axes."""

    row: Matrix  # all channels after the step (N, …)
    cost: Vector  # of the step (N,)
    costs: Matrix  # integral of the squared error of each axis over the step (N, n)
    sample: Integers  # sample at which each loop is (N,)
    status: Integers  # flags of the step (N,)
    diverged: Integers  # 1 if any ``|y|`` was beyond the limit (N,)
    log: NDArray[np.float64]  # work space: all channels of its samples (N, repeat, …)
    now: NDArray[np.float64]  # work space: y and the measured y (N, 2, n)
    u: Matrix  # work space: control signals (N, m)


@compiled_loop("plants", "design", "rules", "weights", "active", "signals")
def run_axes_step(
    plants: Any,
    plant_stride: int,
    lanes: Any,
    lane_stride: int,
    design: Any,
    rules: Rules,
    weights: Vector,
    active: Integers,
    signals: NDArray[np.float64],
    step: StepOfAxes,
    first: int,
    last: int,
) -> None:
    """Take the loops from ``first`` to before ``last`` through a step; see ``loops.run_step``.

    ``signals`` (N or 1, samples, 2 n + …) has r and the noise of each axis, the derivatives of r
    and w of each sample; ``weights`` (n,) are those of the squared errors.
    """
    shared = signals.shape[0] == 1
    n, m = weights.size, step.u.shape[1]
    begin = 2 * n
    end = begin + rules.derivatives
    for i in range(first, last):
        plant = member(plants, plant_stride, i)
        lane = member(lanes, lane_stride, i)
        table = signals[0 if shared else i]
        row, now = step.row[i], step.now[i]
        y = now[0]
        k = step.sample[i]
        measure_all(plant, lane.x, y)
        if active[i] != 0:
            log, until = step.log[i], min(k + rules.repeat, rules.samples - 1)
            done, _, _, status = run_axes_samples(
                plant,
                lane.x,
                lane.scratch,
                design,
                lane.controller,
                k * rules.dt,
                rules.dt,
                table[k:until, :n],
                table[k:until, begin:end],
                table[k:until, end:],
                table[k:until, n:begin],
                now,
                step.u[i],
                log,
                0,
                1,
                0,
                rules.limit,
            )
            measure_all(plant, lane.x, y)
            diverged, cost = 0, 0.0
            for a in range(n):
                step.costs[i, a] = 0.0
                if not abs(y[a]) <= rules.limit:
                    diverged = 1
            for j in range(done):
                k += 1
                for c in range(m):
                    row[3 * n + c] = log[j, 3 * n + c]
                if j + 1 < done or diverged == 0:
                    for a in range(n):
                        error = table[k, a] - (log[j + 1, n + a] if j + 1 < done else y[a])
                        step.costs[i, a] += error * error * rules.dt
                        cost += weights[a] * (error * error) * rules.dt
                    for c in range(m):
                        cost += rules.cost_of_u * (log[j, 3 * n + c] * log[j, 3 * n + c]) * rules.dt
            if diverged != 0:
                cost += (rules.samples - k) * rules.worst * rules.dt
            step.cost[i], step.status[i], step.diverged[i] = cost, status, diverged
            step.sample[i] = k
        for a in range(n):
            row[a], row[n + a], row[2 * n + a] = table[k, a], y[a], y[a] + table[k, n + a]
        at = 3 * n + m
        for j in range(end, table.shape[1]):
            row[at] = table[k, j]
            at += 1
        for j in range(lane.x.size):
            row[at] = lane.x[j]
            at += 1
        write_row(design, lane.controller, row[at:])
        if step.diverged[i] != 0:
            for j in range(row.size):
                row[j] = row[j] if is_finite(row[j]) else 0.0


# ---- Many loops of several axes ----


class LoopsOfAxes(Loops):
    """Loops of several axes, with one plant or one for each; see ``Loops``.

    ``weights`` (n,) are those of the squared errors of the axes in the cost.
    """

    entry = staticmethod(run_axes_step)

    def __init__(self, *parts: Any, weights: Any = None, **options: Any) -> None:
        self.outputs = size = parts[2].outputs
        given = np.ones(size) if weights is None else weights
        self.weights: Vector = checks.vector("weights", given, size)
        if not np.all(self.weights >= 0.0) or not np.any(self.weights > 0.0):
            rule = "must not be negative, and one must be positive"
            raise ValueError(f"weights = {weights!r}: {rule}")
        self.weight = float(np.sum(self.weights))
        super().__init__(*parts, **options)
        self._given = [*self._places_of_actions()]

    def _logged(self, plant: Any, controller: Any) -> Channels:
        check_fit(plant, controller)
        return logged_channels(plant, controller)

    def _arrays_of_step(self, count: int, width: int, repeat: int) -> StepOfAxes:
        n, m = self.plant.outputs, self.plant.inputs
        return StepOfAxes(
            row=np.zeros((count, width)),
            cost=np.zeros(count),
            costs=np.zeros((count, n)),
            sample=np.zeros(count, np.int64),
            status=np.zeros(count, np.int64),
            diverged=np.zeros(count, np.int64),
            log=np.zeros((count, repeat, width)),
            now=np.zeros((count, 2, n)),
            u=np.zeros((count, m)),
        )

    @property
    def _columns_of_u(self) -> slice:
        first = 3 * self.plant.outputs
        return slice(first, first + self.plant.inputs)

    def _inputs(self, actions: Any, active: Any) -> tuple[Any, ...]:
        """Write the actions into the states; return the arguments of the compiled loop."""
        moving = np.flatnonzero(active)
        at = 0
        for place in self._given:
            width = place.shape[1]
            place[moving] = actions[moving, at : at + width]
            at += width
        return (
            self.controller.parameters,
            self.rules,
            self.weights,
            active,
            self._signals,
            self.step,
        )

    def _places_of_actions(self) -> list[NDArray[np.float64]]:
        """Return the numbers that actions set, as views (N, …) of the states of all loops."""
        state: Any = self._lanes.members[0].controller
        if isinstance(self.controller, GivenControls):
            return [self._everywhere(state.u)]
        found = []
        chain = state.axes
        for axis in self.controller.axes:  # type: ignore[attr-defined]
            if isinstance(axis.learner, Policy):
                found.append(self._everywhere(chain.axis.learner.output))
            chain = chain.others
        return found

    def _everywhere(self, first: Vector) -> NDArray[np.float64]:
        """Return an array of the first loop's state in all loops (N, size)."""
        memory = self._lanes.memory
        offset = first.ctypes.data - memory.ctypes.data
        strides = memory.shape[1], first.itemsize
        shape = len(memory), first.size
        return np.ndarray(shape, np.float64, memory.reshape(-1).data, offset, strides)
