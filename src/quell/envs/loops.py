"""Many loops that a policy drives step by step: the work of ``Env`` and ``VectorEnv``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.base import Controller
from quell.envs.block import SIGNALS, Lane, Rules, Step, run_step
from quell.envs.episodes import Draw, Episodes
from quell.envs.stacked import Stacked
from quell.kernels import dispatch
from quell.kernels.dispatch import interpreted, specialised
from quell.kernels.sized import layout_of
from quell.kernels.user_types import explain_compile_errors
from quell.plants.base import Plant, begin_run, check_run
from quell.plants.batch import PlantBatch
from quell.records.channels import columns_of
from quell.simulation.driver import logged_channels
from quell.simulation.scenario import Scenario
from quell.types import Channels, Vector

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
        interpret: bool = False,
        workers: int | None = None,
    ) -> None:
        given: Any = plants
        each = PlantBatch(given) if checks.is_sequence(given) else None
        plant: Any = given if each is None else each[0]
        if each is not None and len(each) != count:
            raise ValueError(f"plant has {len(each)} entries, num_envs = {count}: must be equal")
        self.plant, self.controller, self.count = plant, controller, count
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
            worst=4.0 * self.limit**2 + cost * u_most**2,
            derivatives=len(example.derivatives),
        )
        self.channels: Channels = logged_channels(plant, controller)
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

    def _make_arrays(self) -> None:
        count, width = self.count, sum(width for _, width in self.channels)
        tables = 1 if self.episodes.are_equal else count
        columns = 2 + self.rules.derivatives + self.plant.disturbances
        self._signals = np.zeros((tables, self.rules.samples, columns))
        if self.episodes.are_equal:
            self._signals[0] = self.episodes.draw(np.random.default_rng(0)).table
        self.step = Step(
            row=np.zeros((count, width)),
            cost=np.zeros(count),
            sample=np.zeros(count, np.int64),
            status=np.zeros(count, np.int64),
            diverged=np.zeros(count, np.int64),
        )

    def column(self, name: str) -> int:
        """Return the first column of a channel."""
        return columns_of(self.channels, name).start

    def _at_rest(self) -> Lane:
        n = self.plant.order
        return Lane(np.zeros(n), np.zeros(6 * n), self.controller.initial_state())

    def reset(self, which: Sequence[int], rngs: Sequence[np.random.Generator]) -> None:
        """Begin an episode in some loops, drawn from the generator of each."""
        chosen = np.asarray(which, np.int64)
        self._lanes.memory[chosen] = self._rest
        for array in (self.step.sample, self.step.status, self.step.diverged, self.step.cost):
            array[chosen] = 0
        self.step.row[chosen, SIGNALS - 1] = 0.0
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

    def advance(self, actions: Vector, active: Any) -> None:
        """Take the active loops through a step; write ``step``."""
        models, plant_stride, lanes = self._models, self._plant_stride, self._lanes
        inputs = self.controller.parameters, self.rules, actions, active, self._signals, self.step
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
