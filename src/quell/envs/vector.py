"""``VectorEnv``: many loops that a policy drives, in one compiled call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.adrc.adrc import ADRC
from quell.envs.driven import Driven
from quell.envs.episodes import Draw
from quell.optional import import_extra
from quell.simulation.scenario import Scenario

_PURPOSE = "quell.envs.VectorEnv"
vector = import_extra("gymnasium.vector", "envs", _PURPOSE)
batch_space = import_extra("gymnasium.vector.utils", "envs", _PURPOSE).batch_space
errors = import_extra("gymnasium.error", "envs", _PURPOSE)
seeding = import_extra("gymnasium.utils.seeding", "envs", _PURPOSE)


class VectorEnv(vector.VectorEnv):  # type: ignore[misc, name-defined, unused-ignore]
    """Many loops that a policy drives, advanced in one compiled call on all cores.

    Loop i of ``reset(seed=s)`` is an ``Env`` with ``reset(seed=s + i)``, bit for bit; ``Env`` says
    what is observed and rewarded. A loop whose episode has ended begins the next one in the step
    after it: that step ignores its action, returns the first observation and the reward zero
    (Gymnasium's ``AutoresetMode.NEXT_STEP``).

    Parameters
    ----------
    num_envs
        number of loops N.
    plant
        one plant for all loops, or a sequence with one for each, as from ``quell.plants.batch``:
        linear plants of one order, nonlinear ones that differ in their ``parameters``, or others
        that differ only in arrays.
    scenario, controller
        as for ``Env``. Scenarios that are drawn, or have noise, take 8 bytes for each loop, sample
        and signal: 64 MB for 1000 loops, 2000 samples, r, noise and two disturbances.
    workers
        number of threads; by default one for each core.
    options
        all other arguments of ``Env`` but ``render_mode``.

    Raises
    ------
    ImportError, ValueError
        as for ``Env``, and for plants that do not fit together.

    Examples
    --------
    >>> import numpy as np
    >>> import quell as ql
    >>> from quell.envs import VectorEnv
    >>> plants = ql.plants.batch(ql.plants.two_mass_spring, k=np.linspace(0.5, 2.0, 8))
    >>> scenario = ql.Scenario(ql.signals.Step(), duration=5.0)
    >>> env = VectorEnv(8, plants, scenario, dt=0.01, u_min=-1.0, u_max=1.0)
    >>> observations, infos = env.reset(seed=1)
    >>> observations.shape
    (8, 7)
    """

    def __init__(
        self,
        num_envs: int,
        plant: Any,
        scenario: Scenario | Draw,
        controller: ADRC | None = None,
        *,
        workers: int | None = None,
        **options: Any,
    ) -> None:
        self.num_envs = checks.whole("num_envs", num_envs, 1)
        driven = Driven(self.num_envs, plant, scenario, controller, workers=workers, **options)
        self._driven, self._ended = driven, np.zeros(self.num_envs, bool)
        self.single_observation_space = driven.observation_space
        self.single_action_space = driven.action_space
        self.observation_space = batch_space(driven.observation_space, self.num_envs)
        self.action_space = batch_space(driven.action_space, self.num_envs)
        self.metadata = {"autoreset_mode": vector.AutoresetMode.NEXT_STEP, "render_modes": []}
        self._rngs: list[np.random.Generator] = []

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in each loop; return the first observations and ``infos``.

        ``seed`` s gives loop i the seed s + i; a sequence has the seed of each loop. Without seeds
        the generators of the loops go on, and the first time are seeded by the system.
        """
        count = self.num_envs
        seeds = (
            [int(seed) + i for i in range(count)] if isinstance(seed, int | np.integer) else seed
        )
        if seeds is not None and not checks.is_sequence(seeds):
            raise ValueError(f"seed = {seed!r}: must be a whole number, or a list of one for each")
        if seeds is not None and len(seeds) != count:
            raise ValueError(f"seed has {len(seeds)} entries, num_envs = {count}: must be equal")
        if seeds is not None or not self._rngs:
            before: list[Any] = [*self._rngs] or [None] * count
            self._rngs = [
                rng if each is None and rng is not None else seeding.np_random(each)[0]
                for rng, each in zip(before, seeds or [None] * count, strict=True)
            ]
        self._driven.begin(self._rngs)
        self._ended[:] = False
        return self._driven.observations, self._infos()

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take a step in each loop; return observations, rewards, terminations, truncations, infos.

        ``actions`` are (N, 1).
        """
        if not self._rngs:
            raise errors.ResetNeeded("step was called before reset: call reset first")
        given = np.asarray(actions, dtype=np.float64)
        if given.size != self.num_envs:
            raise ValueError(f"actions have shape {given.shape}: must have ({self.num_envs}, 1)")
        begin = np.flatnonzero(self._ended).tolist()
        if begin:
            self._driven.loops.reset(begin, self._rngs)
        self._driven.advance(given.reshape(-1), (~self._ended).astype(np.int64))
        terminated, truncated = self._driven.ends
        self._ended = terminated | truncated
        rewards = 0.0 - self._driven.loops.step.cost
        return self._driven.observations, rewards, terminated, truncated, self._infos()

    def _infos(self) -> dict[str, Any]:
        infos = self._driven.info
        everywhere = np.ones(self.num_envs, bool)
        return infos | {f"_{name}": everywhere for name in infos}

    def close_extras(self, **unused: Any) -> None:
        """End the threads."""
        self._driven.loops.close()
