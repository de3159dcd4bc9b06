"""Loops, spaces and the work of a step, which ``Env`` and ``VectorEnv`` share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.adrc.adrc import ADRC
from quell.envs.episodes import Draw
from quell.envs.loops import Loops
from quell.envs.spaces import Observed, loop_of
from quell.lti.models import is_linear_model
from quell.optional import import_extra
from quell.plants.base import check_plant
from quell.plants.linear import LinearPlant
from quell.simulation.scenario import Scenario
from quell.types import Vector

# Channels that ``info`` shows if there are any.
_SHOWN = ("y", "u", "f_learned", "authority")


class Driven:
    """Loops that a policy drives; see ``Env`` for the parameters."""

    def __init__(
        self,
        count: int,
        plant: Any,
        scenario: Scenario | Draw,
        controller: ADRC | None = None,
        *,
        dt: float | None = None,
        u_min: float = -math.inf,
        u_max: float = math.inf,
        action_repeat: int = 1,
        limit: float | None = None,
        cost_of_u: float = 0.0,
        observe: Sequence[str] | None = None,
        x_limit: Any = None,
        interpret: bool = False,
        workers: int | None = None,
    ) -> None:
        if not hasattr(plant, "sampled") and is_linear_model(plant):
            plant = LinearPlant.of(plant)
        if not checks.is_sequence(plant):
            check_plant(plant)
        law, self.action = loop_of(controller, dt, u_min, u_max)
        u_most = max(abs(self.action.u_min), abs(self.action.u_max))
        self.loops = Loops(
            *(plant, scenario, law, count),
            repeat=action_repeat,
            limit=limit,
            cost_of_u=cost_of_u,
            u_most=u_most,
            interpret=checks.flag("interpret", interpret),
            workers=workers,
        )
        self.observed = Observed(observe, self.loops, self.action, x_limit)
        names = [name for name, width in self.loops.channels if width]
        self._shown = [name for name in _SHOWN if name in names]
        self._columns = [self.loops.column(name) for name in self._shown]
        self.step_time = law.dt * action_repeat
        box = import_extra("gymnasium.spaces", "envs", "quell.envs").Box
        self.observation_space = box(self.observed.low, self.observed.high, dtype=np.float64)
        self.action_space = box(-1.0, 1.0, (1,), np.float64)

    def begin(self, rngs: Sequence[np.random.Generator]) -> None:
        """Begin an episode in each loop, and write its first row."""
        count = self.loops.count
        self.loops.reset(range(count), rngs)
        self.loops.advance(np.zeros(count), np.zeros(count, np.int64))

    def advance(self, actions: Vector, active: Any) -> None:
        """Take the active loops through a step with actions from −1 to 1, which are clipped."""
        if not np.all(np.isfinite(actions)):
            raise ValueError(f"action = {actions!r}: must be finite")
        middle, reach = self.action.middle, self.action.reach
        self.loops.advance(middle + reach * np.clip(actions, -1.0, 1.0), active)

    @property
    def observations(self) -> Any:
        """Observations of all loops (N, …)."""
        return self.observed.of(self.loops.step.row)

    @property
    def ends(self) -> tuple[Any, Any]:
        """Which loops have diverged, and which are at the end of their episode (N,)."""
        step = self.loops.step
        terminated = step.diverged != 0
        return terminated, (step.sample >= self.loops.rules.samples - 1) & ~terminated

    @property
    def info(self) -> dict[str, Any]:
        """Arrays (N,) of the time, of channels and of the step's status flags."""
        step = self.loops.step
        shown = dict(zip(self._shown, step.row[:, self._columns].T.copy(), strict=True))
        return {"t": step.sample * self.loops.rules.dt, **shown, "status": step.status.copy()}
