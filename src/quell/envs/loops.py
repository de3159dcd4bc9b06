"""The compiled loops of the environments: episodes, and many loops at once.

Scenarios of episodes: one that is fixed, or one that is drawn for each.

Many loops that a policy drives step by step: the work of ``Env`` and ``VectorEnv``.

The compiled loop of the environments: some samples of each of many loops. What a policy sets is
written into the states of the loops, which lie at equal distances in memory, for all loops at once.

Many states of one layout, one after the other in memory, for a compiled loop over them.

A state is a NamedTuple of arrays. Compiled code gets the first one and the distance to the next;
``member`` then moves the addresses of all its arrays, so that nothing is copied, and the shapes
stay constants (``kernels/sized.py``).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numba import types as nb_types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import Controller, write_row
from quell.envs.actions import places_of_actions
from quell.kernels import dispatch
from quell.kernels.dispatch import (
    compiled_loop,
    explain_compile_errors,
    interpreted,
    is_finite,
    specialised,
)
from quell.kernels.linking import KERNEL_OPTIONS, OPTIONS
from quell.kernels.numba_internals import pointer_add
from quell.kernels.sized import layout_of, remade
from quell.plants.base import (
    Plant,
    PlantBatch,
    begin_run,
    check_run,
    inputs_of,
    measure_all,
    outputs_of,
)
from quell.records.record import columns_of
from quell.simulation import driver
from quell.simulation.driver import run_samples
from quell.simulation.scenario import SampledScenario, Scenario, check_scenario, is_random
from quell.types import Channels, Matrix, Vector

# ---- Scenarios of episodes ----

Draw = Callable[[np.random.Generator], Scenario]
# Seeds of the scenarios of episodes are below this: any 31 bits do.
_SEEDS = 2**31


class Episode(NamedTuple):
    """An episode's signals and the plant's initial state."""

    table: NDArray[np.float64]  # r and noise of each axis, derivatives of r, w (samples, …)
    x0: Vector


class Episodes:
    """The episodes of an environment.

    Parameters
    ----------
    scenario
        a ``Scenario``, whose noise gets a new seed in each episode, or a function that draws a
        scenario from a ``numpy.random.Generator``.
    plant, controller
        of the loop.
    """

    def __init__(self, scenario: Scenario | Draw, plant: Plant, controller: Controller) -> None:
        if not callable(scenario):
            check_scenario(scenario)
        self._scenario, self._plant, self._controller = scenario, plant, controller
        #: an episode that does not depend on the seed of the environment
        self.example = self._sampled(self._drawn(np.random.default_rng(0)))
        may_differ = callable(scenario) or is_random(scenario)
        self._shared = None if may_differ else self._tabulated(self.example)

    @property
    def are_equal(self) -> bool:
        """True if all episodes have the same signals."""
        return self._shared is not None

    def draw(self, rng: np.random.Generator) -> Episode:
        """Return the next episode."""
        if self._shared is not None:
            return self._shared
        return self._tabulated(self._sampled(self._drawn(rng)))

    def _drawn(self, rng: np.random.Generator) -> Scenario:
        if not callable(self._scenario):
            return replace(self._scenario, seed=int(rng.integers(_SEEDS)))
        drawn = self._scenario(rng)
        check_scenario(drawn, "scenario(rng)")
        return drawn

    def _sampled(self, scenario: Scenario) -> Any:
        if len(scenario.rest_at):
            raise ValueError(
                f"rest_at = {scenario.rest_at!r}: must be empty, each episode starts from rest"
            )
        found = SampledScenario.of(scenario, self._plant, self._controller, None)
        if found.samples < 2:
            raise ValueError(
                f"duration = {scenario.duration!r} s with dt = {found.dt!r} s: must be at least "
                "one sample"
            )
        example = getattr(self, "example", found)
        if found.samples != example.samples:
            raise ValueError(
                f"scenario(rng) has duration = {scenario.duration!r} s, another one "
                f"{(example.samples - 1) * found.dt:.9g} s: must be the same in all episodes"
            )
        return found

    def _tabulated(self, scenario: Any) -> Episode:
        whole = scenario.segment(0, scenario.samples)
        parts: list[Any] = [whole.r, whole.noise, whole.derivatives, whole.w]
        return Episode(np.column_stack(parts), scenario.x0)


# ---- Many states of one layout, one after the other in memory, for a compiled loop over them ----

_ALIGNMENT = 8  # bytes, of each array
_LINE = 64  # bytes of a line of the processor's cache: two threads never write into the same one


class Stacked:
    """Copies of a NamedTuple, or of several of one layout, in one block of memory.

    Parameters
    ----------
    values
        the NamedTuples; their arrays have equal shapes and types. Numbers in them are not copied.
    """

    def __init__(self, values: list[Any]) -> None:
        self._sizes: list[int] = []
        self._layout(values[0])
        self.stride = -(-sum(self._sizes) // _LINE) * _LINE or _LINE
        block = np.zeros(len(values) * self.stride + _LINE, np.uint8)
        start = -block.ctypes.data % _LINE
        self.memory = block[start : start + len(values) * self.stride].reshape(len(values), -1)
        self.members = [self._view(value, i) for i, value in enumerate(values)]

    def _layout(self, value: Any) -> None:
        if isinstance(value, np.ndarray):
            self._sizes.append(-(-value.nbytes // _ALIGNMENT) * _ALIGNMENT)
        elif isinstance(value, tuple):
            for part in value:
                self._layout(part)

    def _view(self, value: Any, i: int) -> Any:
        """Return a copy of the value in row i of the memory."""
        place = 0

        def copy(part: Any) -> Any:
            nonlocal place
            if isinstance(part, np.ndarray):
                size = -(-part.nbytes // _ALIGNMENT) * _ALIGNMENT
                block = self.memory[i, place : place + part.nbytes]
                place += size
                if part.nbytes == 0:
                    return part.copy()
                there = block.view(part.dtype).reshape(part.shape)
                there[...] = part
                return there
            if isinstance(part, tuple):
                return remade(part, map(copy, part))
            return part

        return copy(value)


def member(first: Any, stride: int, i: int) -> Any:
    """Return member ``i`` of a stack, ``stride`` bytes each.

    ``first`` is the first one for compiled code, and the list of all for Python. A list of one, or
    a stride of zero, stands for members that are all the same.
    """
    return first[i if stride else 0]


@overload(member, strict=False, jit_options=OPTIONS | KERNEL_OPTIONS)
def _compiled_member(first: Any, stride: Any, i: Any) -> Any:
    return lambda first, stride, i: _moved(first, stride * i)


@intrinsic
def _moved(typing_context: Any, first: Any, shift: Any) -> Any:
    """Return a tuple whose arrays lie ``shift`` bytes behind those of ``first``."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        def move(kind: Any, value: Any) -> Any:
            if isinstance(kind, nb_types.BaseTuple):
                parts = [move(part, builder.extract_value(value, j)) for j, part in enumerate(kind)]
                return context.make_tuple(builder, kind, parts)
            if isinstance(kind, nb_types.Array):
                array = context.make_array(kind)(context, builder, value)
                place = pointer_add(builder, array.data, values[1])
                array.data = builder.bitcast(place, array.data.type)
                return array._getvalue()
            return value

        return move(first, values[0])

    return first(first, nb_types.intp), generate


# ---- The compiled loop of the environments ----

Integers = NDArray[np.int64]


class Lane(NamedTuple):
    """One loop between samples."""

    x: Vector  # state of the plant (n,)
    scratch: Vector  # (6 n,), see ``plants.base.advance``
    controller: Any  # state of the controller
    sample: driver.Sample  # work space


class Step(NamedTuple):
    """Results of a step, for each loop."""

    row: Matrix  # all channels after the step (N, …)
    cost: Vector  # of the step (N,)
    costs: Matrix  # integral of the squared error of each axis over the step (N, n)
    sample: Integers  # sample at which each loop is (N,)
    status: Integers  # flags of the step (N,)
    diverged: Integers  # 1 if any ``|y|`` was beyond the limit (N,)
    log: NDArray[np.float64]  # work space: r, y, y_measured, u of its samples (N, repeat, …)


class Rules(NamedTuple):
    """Numbers that are the same for all loops."""

    dt: float
    samples: int  # of an episode
    repeat: int  # samples of a step
    limit: float  # |y| beyond it ends an episode
    cost_of_u: float  # [y-unit²/u-unit²]
    worst: float  # cost of a second beyond the limit [y-unit²], more than any within it
    derivatives: int  # of the references


@compiled_loop("plants", "design", "rules", "weights", "active", "signals")
def run_step(
    plants: Any,
    plant_stride: int,
    lanes: Any,
    lane_stride: int,
    design: Any,
    rules: Rules,
    weights: Vector,
    active: Integers,
    signals: NDArray[np.float64],
    step: Step,
    first: int,
    last: int,
) -> None:
    """Take the loops from ``first`` to before ``last`` through a step, and write their rows.

    Those that are not ``active`` do not move. ``signals`` (N or 1, samples, 2 n + …) has r and the
    noise of each axis, the derivatives of r and w of each sample, for each loop or for all;
    ``weights`` (n,) are those of the squared errors.
    """
    shared = signals.shape[0] == 1
    for i in range(first, last):
        plant = member(plants, plant_stride, i)
        lane = member(lanes, lane_stride, i)
        table = signals[0 if shared else i]
        row, y = step.row[i], lane.sample.y
        n, m = y.size, lane.sample.u.size
        begin = 2 * n
        end = begin + rules.derivatives
        k = step.sample[i]
        measure_all(plant, lane.x, y)
        if active[i] != 0:
            log, until = step.log[i], min(k + rules.repeat, rules.samples - 1)
            done, _, _, status = run_samples(
                plant,
                lane.x,
                lane.scratch,
                design,
                lane.controller,
                lane.sample,
                k * rules.dt,
                rules.dt,
                table[k:until, :n],
                table[k:until, begin:end],
                table[k:until, end:],
                table[k:until, n:begin],
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
                    squares = 0.0
                    for a in range(n):
                        error = table[k, a] - (log[j + 1, n + a] if j + 1 < done else y[a])
                        step.costs[i, a] += error * error * rules.dt
                        squares += weights[a] * (error * error)
                    for c in range(m):
                        u = log[j, 3 * n + c]
                        squares += rules.cost_of_u * (u * u)
                    cost += squares * rules.dt
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


# ---- Many loops that a policy drives step by step ----

# Loops for which a second thread is worth its start, about 20 µs: 64 samples take as long.
_LOOPS_PER_THREAD = 64


class Loops:
    """Loops of one controller and scenario, with one plant or one for each.

    Parameters
    ----------
    plants
        one plant for all loops, or one for each.
    scenario, controller
        see ``Env``; the controller has a ``Policy``, or is a ``GivenControl``.
    count
        number of loops.
    repeat
        samples of a step.
    limit
        ``|y|`` that ends an episode; by default the usual range of the scenario.
    cost_of_u
        weight of u² in the cost [y-unit²/u-unit²].
    weights
        of the squared errors of the axes in the cost (n,); 1 by default.
    interpret
        run as plain Python.
    workers
        threads; by default one for each core, and none for few loops.
    """

    def __init__(
        self,
        plants: Plant | Sequence[Plant],
        scenario: Scenario | Draw,
        controller: Controller,
        count: int,
        repeat: int = 1,
        limit: float | None = None,
        cost_of_u: float = 0.0,
        u_most: float = 0.0,
        weights: Any = None,
        interpret: bool = False,
        workers: int | None = None,
    ) -> None:
        given: Any = plants
        each = PlantBatch(given) if checks.is_sequence(given) else None
        plant: Any = given if each is None else each[0]
        if each is not None and len(each) != count:
            raise ValueError(f"plant has {len(each)} entries, num_envs = {count}: must be equal")
        self.plant, self.controller, self.count = plant, controller, count
        self.outputs, self.inputs = outputs_of(plant), inputs_of(plant)
        self.weights = np.ones(self.outputs)
        if weights is not None:
            self.weights = checks.vector("weights", weights, self.outputs)
            if not np.all(self.weights >= 0.0) or not np.any(self.weights > 0.0):
                rule = "must not be negative, and one must be positive"
                raise ValueError(f"weights = {weights!r}: {rule}")
        self.episodes = Episodes(scenario, plant, controller)
        example = self.episodes.example
        self.limit = checks.optional(checks.positive, "limit", limit) or example.range
        cost = checks.non_negative("cost_of_u", cost_of_u)
        self.rules = Rules(
            dt=controller.dt,
            samples=example.samples,
            repeat=checks.whole("action_repeat", repeat, 1),
            limit=self.limit,
            cost_of_u=cost,
            # Within the limit |r − y| is less than twice the limit.
            worst=4.0 * self.limit**2 * float(np.sum(self.weights)) + cost * u_most**2,
            derivatives=len(example.derivatives),
        )
        self.channels: Channels = driver.logged_channels(plant, controller)
        self._as_python = interpret or dispatch.interpret_all or not plant.compiled
        models = [p.sampled(controller.dt, interpret) for p in (each or [plant])]
        self._models, self._plant_stride = models, int(len(models) > 1)
        if not self._as_python:
            stack = _stacked_models(models)
            self._models, self._plant_stride = stack.members, self._plant_stride * stack.stride
        self._lanes = Stacked([self._at_rest()] * count)
        self._rest = self._lanes.memory[0].copy()
        self._begins = type(models[0]) in begin_run.implementations
        self._make_arrays()
        workers = checks.whole("workers", workers or os.cpu_count() or 1, 1)
        self._shares = max(1, min(workers, count // _LOOPS_PER_THREAD))
        self._pool = ThreadPoolExecutor(self._shares - 1) if self._shares > 1 else None
        self._run: Any = None
        state = self._lanes.members[0].controller
        self._given = [self._everywhere(each) for each in places_of_actions(controller, state)]

    def _make_arrays(self) -> None:
        count, width = self.count, sum(width for _, width in self.channels)
        tables = 1 if self.episodes.are_equal else count
        columns = 2 * self.outputs + self.rules.derivatives + self.plant.disturbances
        self._signals = np.zeros((tables, self.rules.samples, columns))
        if self.episodes.are_equal:
            self._signals[0] = self.episodes.draw(np.random.default_rng(0)).table
        repeat = min(self.rules.repeat, self.rules.samples)
        self.step: Any = self._arrays_of_step(count, width, repeat)

    def _arrays_of_step(self, count: int, width: int, repeat: int) -> Step:
        """Return the arrays that a step writes."""
        return Step(
            row=np.zeros((count, width)),
            cost=np.zeros(count),
            costs=np.zeros((count, self.outputs)),
            sample=np.zeros(count, np.int64),
            status=np.zeros(count, np.int64),
            diverged=np.zeros(count, np.int64),
            log=np.zeros((count, repeat, driver.width_of_signals(self.plant, self.controller))),
        )

    def _everywhere(self, first: Vector) -> NDArray[np.float64]:
        """Return an array of the first loop's state in all loops (N, size)."""
        memory = self._lanes.memory
        offset = first.ctypes.data - memory.ctypes.data
        strides = memory.shape[1], first.itemsize
        shape = len(memory), first.size
        return np.ndarray(shape, np.float64, memory.reshape(-1).data, offset, strides)

    def column(self, name: str) -> int:
        """Return the first column of a channel."""
        return columns_of(self.channels, name).start

    def _at_rest(self) -> Lane:
        n = self.plant.order
        state = self.controller.initial_state()
        return Lane(
            np.zeros(n), np.zeros(6 * n), state, driver.sample_of(self.plant, self.controller)
        )

    def reset(self, which: Sequence[int], rngs: Sequence[np.random.Generator]) -> None:
        """Begin an episode in some loops, drawn from the generator of each."""
        chosen = np.asarray(which, np.int64)
        self._lanes.memory[chosen] = self._rest
        for array in (self.step.sample, self.step.status, self.step.diverged, self.step.cost):
            array[chosen] = 0
        self.step.row[chosen, 3 * self.outputs : 3 * self.outputs + self.inputs] = 0.0
        for i in which:
            episode = self.episodes.draw(rngs[i])
            if not self.episodes.are_equal:
                self._signals[i] = episode.table
            lane = self._lanes.members[i]
            lane.x[:] = episode.x0
            if self._begins:
                begin_run(self._model(i), lane.x, lane.scratch)

    def _model(self, i: int) -> Any:
        return self._models[i if self._plant_stride else 0]

    def advance(self, actions: Matrix, active: Any) -> None:
        """Take the active loops through a step with ``actions`` (N, …); write ``step``."""
        models, plant_stride, lanes = self._models, self._plant_stride, self._lanes
        moving: Any = slice(None) if np.all(active) else np.flatnonzero(active)
        at = 0
        for place in self._given:
            place[moving] = actions[moving, at : at + place.shape[1]]
            at += place.shape[1]
        given = self.controller.parameters, self.rules, self.weights
        inputs: tuple[Any, ...] = (*given, active, self._signals, self.step)
        if self._as_python:
            run: Any = interpreted(run_step)
            stacks: tuple[Any, ...] = models, plant_stride, lanes.members, lanes.stride
        else:
            stacks = models[0], plant_stride, lanes.members[0], lanes.stride
            if self._run is None:
                with explain_compile_errors(models[0], inputs[0]):
                    self._run = specialised(run_step, *stacks, *inputs, 0, 1)
            run = self._run
        edges = [self.count * part // self._shares for part in range(self._shares + 1)]
        jobs = []
        if self._pool is not None:
            jobs = [
                self._pool.submit(partial(run, *stacks, *inputs, edges[part], edges[part + 1]))
                for part in range(1, self._shares)
            ]
        with np.errstate(all="ignore"):
            run(*stacks, *inputs, edges[0], edges[1])
        for job in jobs:
            job.result()
        if self._begins:
            for i, lane in enumerate(lanes.members):
                check_run(self._model(i), lane.scratch)

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()


def _stacked_models(models: list[Any]) -> Stacked:
    """Return sampled plants side by side; they may differ in arrays, not in numbers."""
    first = models[0]
    for i, model in enumerate(models):
        if layout_of(model) != layout_of(first) or _numbers(model) != _numbers(first):
            raise ValueError(
                f"plant[{i}] differs from plant[0] in more than the entries of its matrices: "
                "make an environment for each, or take linear plants of one order"
            )
    return Stacked(models)


def _numbers(model: Any) -> list[Any]:
    """Return what a sampled plant has besides arrays."""
    if isinstance(model, tuple):
        return [number for part in model for number in _numbers(part)]
    return [] if isinstance(model, np.ndarray) else [model]
