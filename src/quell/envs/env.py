"""``Env``: one loop that a policy drives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from quell.controllers.adrc.adrc import ADRC
from quell.envs.driven import Driven
from quell.envs.episodes import Draw
from quell.envs.rendering import MODES, as_picture, as_text
from quell.optional import import_extra
from quell.plants.labelled import signals_of
from quell.simulation.scenario import Scenario

gymnasium = import_extra("gymnasium", "envs", "quell.envs.Env")


class Env(gymnasium.Env):  # type: ignore[misc, name-defined, unused-ignore]
    """A loop that a policy drives, as an environment for Gymnasium.

    **Action.** One number a from −1 to 1 (a beyond is clipped), held for ``action_repeat`` samples.
    Without ``controller`` it is the control signal, ``u = (u_min + u_max)/2 + a (u_max − u_min)/2``
    of the open plant. With a ``controller``, whose learner is a ``Policy``, it is the part of the
    total disturbance that is fed forward, ``f_L = a · most`` [y-unit/s^n]: residual reinforcement
    learning (Johannink et al., ICRA 2019). The policy is a learner, and a ``Guard`` of the
    controller allows it as much as it explains. With the action zero the loop is the one of
    ``simulate`` with the same controller, bit for bit where both run as plain Python.

    **Observation.** The channels ``observe`` (names as in a ``Trajectory``), clipped to bounds that
    hold while ``|y|`` is within ``limit``. r, y, y_measured, w and x are those of the next sample,
    which the action will act on; u, the estimates (x_hat, f_residual, f_learned) and what the guard
    says are of the sample before. By default, without controller, r, y_measured, u and x: the state
    is all that an optimal policy needs to know of the plant, but a real loop does not measure it
    (``observe=("r", "y_measured", "u")`` is what it does). With controller, what that knows: r,
    y_measured, u, x_hat, f_residual, f_learned.

    **Reward.** ``−∫ (r − y)² + ρ u² dt`` over the step, as a sum over its samples: the return is
    the quadratic cost of the episode, and does not depend on how it is divided into steps.

    **End.** An episode is truncated at the scenario's ``duration``. It is terminated when ``|y|``
    exceeds ``limit`` or is not finite; the reward then has the largest cost for all the time that
    is left, ``(2 limit)² + ρ max u²`` a second, so that to end early never pays.

    Parameters
    ----------
    plant
        a plant, or any argument of ``LinearPlant.of``.
    scenario
        a ``Scenario``; each episode gets another seed of its noise. Or a function that draws the
        scenario of an episode from a ``numpy.random.Generator``; all have the same duration.
    controller
        an ``ADRC`` with ``learner=Policy()``, best with ``guard=Guard()``, and finite limits of u;
        None if the action is u.
    dt, u_min, u_max
        sample time [s] and limits of u, only without controller, and then necessary.
    action_repeat
        samples of a step.
    limit
        ``|y|`` beyond which the loop counts as lost [y-unit]; by default ten times the largest of
        1, ``|x0|`` and the reference. For scenarios that are drawn, those of one draw, which is the
        same for all seeds.
    cost_of_u
        ρ [y-unit²/u-unit²].
    observe
        names of channels.
    x_limit
        bound of the observed states, a number or (n,); by default ``limit``.
    render_mode
        ``"ansi"`` for a line of text, ``"rgb_array"`` for a picture of the episode so far.
    interpret
        run as plain Python, to debug.

    Raises
    ------
    ImportError
        without Gymnasium.
    ValueError
        for a controller without ``Policy`` or finite limits, a scenario with ``rest_at``, an
        unknown channel, or numbers out of range.

    Examples
    --------
    >>> import quell as ql
    >>> from quell.envs import Env
    >>> scenario = ql.Scenario(ql.signals.Step(), duration=5.0)
    >>> env = Env(ql.plants.two_mass_spring(), scenario, dt=0.01, u_min=-1.0, u_max=1.0)
    >>> observation, info = env.reset(seed=1)
    >>> env.observation_space.shape, env.action_space.shape
    ((7,), (1,))
    """

    def __init__(
        self,
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
        render_mode: str | None = None,
        interpret: bool = False,
    ) -> None:
        if render_mode not in (None, *MODES):
            raise ValueError(f"render_mode = {render_mode!r}: must be one of {MODES}, or None")
        self._driven = Driven(
            *(1, plant, scenario, controller),
            dt=dt,
            u_min=u_min,
            u_max=u_max,
            action_repeat=action_repeat,
            limit=limit,
            cost_of_u=cost_of_u,
            observe=observe,
            x_limit=x_limit,
            interpret=interpret,
        )
        self.observation_space = self._driven.observation_space
        self.action_space = self._driven.action_space
        self.render_mode = render_mode
        rate = max(1, round(1.0 / self._driven.step_time))
        self.metadata = {"render_modes": list(MODES), "render_fps": rate}
        self._past: list[tuple[float, ...]] = []
        self._ended = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; return the first observation and ``info``."""
        super().reset(seed=seed)
        self._driven.begin([self.np_random])
        self._past, self._ended = [], False
        return self._seen()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take a step; return observation, reward, terminated, truncated and ``info``.

        ``info`` has the time, y and u, the status flags of the step and, with a controller, f_L as
        the guard has let it pass and the authority.
        """
        if self._ended:
            raise gymnasium.error.ResetNeeded("the episode has ended: call reset first")
        given = np.asarray(action, dtype=np.float64)
        if given.size != 1:
            raise ValueError(f"action = {action!r}: must be one number, in an array of shape (1,)")
        self._driven.advance(given.reshape(1), np.ones(1, np.int64))
        (terminated,), (truncated,) = self._driven.ends
        self._ended = bool(terminated or truncated)
        cost = float(self._driven.loops.step.cost[0])
        observation, info = self._seen()
        return observation, -cost, bool(terminated), bool(truncated), info

    def _seen(self) -> tuple[Any, dict[str, Any]]:
        info = {name: values[0].item() for name, values in self._driven.info.items()}
        if self.render_mode is not None:
            r = float(self._driven.loops.step.row[0, 0])
            self._past.append((info["t"], r, info["y"], info["u"]))
        return self._driven.observations[0], info

    def render(self) -> Any:
        """Return the episode so far, as ``render_mode`` says; None without one."""
        if self.render_mode is None or not self._past:
            return None
        draw = as_text if self.render_mode == "ansi" else as_picture
        return draw(self._past, signals_of(self._driven.loops.plant))

    def close(self) -> None:
        """End the loop; of a single one nothing is left to release."""
        self._driven.loops.close()
