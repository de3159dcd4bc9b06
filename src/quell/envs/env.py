"""``Env`` and ``VectorEnv``: environments for Gymnasium.

Spaces of observations and actions, with finite bounds.

``Env``: one loop that a policy drives.

``VectorEnv``: many loops that a policy drives, in one compiled call.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from quell import checks
from quell.checks import import_extra
from quell.controllers.adrc import ADRC
from quell.controllers.axes import Axes
from quell.envs.actions import Actions, loop_of, places
from quell.envs.loops import Draw, Loops
from quell.lti.models import is_linear_model
from quell.plants.base import check_plant, inputs_of, outputs_of, signals_of
from quell.plants.linear import LinearPlant
from quell.quantities import UNKNOWN, Signals
from quell.records.record import columns_of
from quell.simulation.scenario import Scenario
from quell.types import Vector

# ---- Spaces of observations and actions, with finite bounds ----

OBSERVED_WITH_U = ("r", "y_measured", "u", "x")
OBSERVED_WITH_F = ("r", "y_measured", "u", "x_hat", "f_residual", "f_learned")
# Entries of a controller's status are flags below this (``types.Status``).
_FLAGS = 2048.0


class Observed:
    """The observed channels: their columns in a row, and their bounds.

    A channel's bound is what it can be while ``|y|`` is within the limit L: L for r and y, the
    limits for u, ``L omega_o^i`` for the i-th derivative that the observer estimates. States of the
    plant have the bound ``x_limit``, disturbances L.
    """

    def __init__(
        self, names: Sequence[str] | None, loop: Loops, action: Actions, x_limit: Any
    ) -> None:
        if isinstance(names, str):
            names = (names,)
        if names is not None and not checks.is_sequence(names):
            raise ValueError(f"observe = {names!r}: must be a list of names of channels")
        self.names = tuple(names or _observed_by_default(loop.controller))
        widths = {name: width for name, width in loop.channels if width}
        for name in self.names:
            checks.one_of("observe", name, tuple(widths))
        if len({*self.names}) != len(self.names):
            raise ValueError(f"observe = {names!r}: must be different channels")
        most = _bounds(loop, action, x_limit)
        high = [np.broadcast_to(most.get(name, loop.limit), widths[name]) for name in self.names]
        low = [
            np.broadcast_to(action.u_min, widths[name]) if name == "u" else -each
            for name, each in zip(self.names, high, strict=True)
        ]
        axes = getattr(loop.controller, "names", ())
        #: a name for each number of an observation, as ``"r[elbow]"``
        self.labels = tuple(
            label for name in self.names for label in _labels(name, widths[name], axes)
        )
        self.high: Vector = np.concatenate(high).astype(np.float64)
        self.low: Vector = np.concatenate(low).astype(np.float64)
        every = range(sum(widths.values()))
        chosen = [every[columns_of(loop.channels, name)] for name in self.names]
        self.columns = np.array([k for columns in chosen for k in columns])

    def of(self, rows: Any) -> Any:
        """Return the observations of rows (…, channels), clipped to the bounds."""
        return np.clip(rows[..., self.columns], self.low, self.high)


def _observed_by_default(controller: Any) -> tuple[str, ...]:
    """Return the channels that a policy sees."""
    if isinstance(controller, ADRC):
        return OBSERVED_WITH_F
    if not controller.names:
        return OBSERVED_WITH_U
    known = {name for name, width in controller.channels if width}
    every = [f"{axis}.{channel}" for axis in controller.names for channel in OBSERVED_WITH_F[3:]]
    return (*OBSERVED_WITH_F[:3], *(name for name in every if name in known))


def _labels(channel: str, width: int, axis_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return a name for each number of a channel: of axes by their names, else by numbers."""
    if width > 1 and channel in ("r", "y", "y_measured", "v") and len(axis_names) == width:
        return tuple(f"{channel}[{name}]" for name in axis_names)
    return places(channel, width)


def _bounds(loop: Loops, action: Actions, x_limit: Any) -> dict[str, Any]:
    """Return the bounds that are not the limit, by channel."""
    order, limit = loop.plant.order, loop.limit
    x = np.full(order, limit) if x_limit is None else np.atleast_1d(x_limit)
    if x.size == 1:
        x = np.full(order, x[0])
    found: dict[str, Any] = {"u": action.u_max}
    found["x"] = checks.positive_vector("x_limit", x)
    if x.size != order:
        raise ValueError(f"x_limit has {x.size} entries: must be a number, or one for each state")
    controller: Any = loop.controller
    if isinstance(controller, ADRC):
        found |= _bounds_of(controller.observer, limit, float(action.reach[0]))
    elif isinstance(controller, Axes):
        reaches = dict(zip(action.names, action.reach.tolist(), strict=True))
        for name, axis in zip(controller.names, controller.axes, strict=True):
            own = _bounds_of(axis.observer, limit, reaches.get(name, 0.0))
            found |= {f"{name}.{channel}": most for channel, most in own.items()}
        found["v"] = np.array([float(found[f"{name}.f_residual"]) for name in controller.names])
        found["status"] = _FLAGS
    return found


def _bounds_of(observer: Any, limit: float, reach: float) -> dict[str, Any]:
    """Return the bounds of the channels of an ADRC."""
    rates = limit * observer.omega_o ** np.arange(observer.estimates + 0.0)
    n = observer.order
    f = max(float(rates[n]), reach)
    found: dict[str, Any] = dict.fromkeys(
        ("f_residual", "f_learned", "error_plain", "error_learned"), f
    )
    found |= {"x_hat": rates[:n], "f_derivatives": rates[n + 1 :]}
    return found | {"authority": 1.0, "status": _FLAGS, "reason": _FLAGS}


# ---- Loops, spaces and the work of a step, which Env and VectorEnv share ----

# Channels that ``info`` shows if there are any.
_SHOWN = ("y", "u", "f_learned", "authority")


class Driven:
    """Loops that a policy drives; see ``Env`` for the parameters."""

    def __init__(
        self,
        count: int,
        plant: Any,
        scenario: Scenario | Draw,
        controller: ADRC | Axes | None = None,
        *,
        dt: float | None = None,
        u_min: Any = -math.inf,
        u_max: Any = math.inf,
        action_repeat: int = 1,
        limit: float | None = None,
        cost_of_u: float = 0.0,
        weights: Any = None,
        observe: Sequence[str] | None = None,
        x_limit: Any = None,
        interpret: bool = False,
        workers: int | None = None,
    ) -> None:
        if not hasattr(plant, "sampled") and is_linear_model(plant):
            plant = LinearPlant.of(plant)
        if not checks.is_sequence(plant):
            check_plant(plant)
        first: Any = next(iter(plant), None) if checks.is_sequence(plant) else plant
        law, self.action = loop_of(first, controller, dt, u_min, u_max)
        #: whether r, y and u have an axis for their entries
        self.several = max(outputs_of(first), inputs_of(first)) > 1
        if weights is not None and not self.several:
            raise ValueError(f"weights = {weights!r}: are those of several axes; leave it out")
        # Of several control signals the square is that of all together.
        u_most = np.linalg.norm(np.maximum(np.abs(self.action.u_min), np.abs(self.action.u_max)))
        self.loops = Loops(
            *(plant, scenario, law, count),
            weights=weights,
            repeat=action_repeat,
            limit=limit,
            cost_of_u=cost_of_u,
            u_most=float(u_most),
            interpret=checks.flag("interpret", interpret),
            workers=workers,
        )
        self.observed = Observed(observe, self.loops, self.action, x_limit)
        names = [name for name, width in self.loops.channels if width]
        self._shown = [
            name for name in names if name in _SHOWN or name.rpartition(".")[2] in _SHOWN[2:]
        ]
        self._columns = [columns_of(self.loops.channels, name) for name in self._shown]
        self.step_time = law.dt * action_repeat
        box = import_extra("gymnasium.spaces", "envs", "quell.envs").Box
        self.observation_space = box(self.observed.low, self.observed.high, dtype=np.float64)
        self.actions = int(np.size(self.action.reach))
        self.action_space = box(-1.0, 1.0, (self.actions,), np.float64)

    def begin(self, rngs: Sequence[np.random.Generator]) -> None:
        """Begin an episode in each loop, and write its first row."""
        count = self.loops.count
        self.loops.reset(range(count), rngs)
        self.loops.advance(np.zeros((count, self.actions)), np.zeros(count, np.int64))

    def advance(self, actions: Vector, active: Any) -> None:
        """Take the active loops through a step with actions from −1 to 1, which are clipped.

        They are (N, actions).
        """
        if not np.all(np.isfinite(actions)):
            raise ValueError(f"action = {actions!r}: must be finite")
        middle, reach = self.action.middle, self.action.reach
        self.loops.advance(middle + reach * np.clip(actions, -1.0, 1.0), active)

    def shaped(self, actions: Any) -> Vector:
        """Return actions as ``advance`` takes them; they have the right size."""
        return actions.reshape(self.loops.count, self.actions)

    @property
    def action_names(self) -> tuple[str, ...]:
        """Kind of each number of an action: u, f, or the axis whose f it is."""
        return self.action.names

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
        shown = {
            name: step.row[:, columns if self._is_wide(name) else columns.start].copy()
            for name, columns in zip(self._shown, self._columns, strict=True)
        }
        if self.several:
            shown["cost"] = step.costs.copy()
        return {"t": step.sample * self.loops.rules.dt, **shown, "status": step.status.copy()}

    def _is_wide(self, name: str) -> bool:
        return self.several and name in ("y", "u")


# ---- VectorEnv ----

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
        controller: ADRC | Axes | None = None,
        *,
        workers: int | None = None,
        **options: Any,
    ) -> None:
        self.num_envs = checks.whole("num_envs", num_envs, 1)
        driven = Driven(self.num_envs, plant, scenario, controller, workers=workers, **options)
        self._driven, self._ended = driven, np.zeros(self.num_envs, bool)
        self.single_observation_space = driven.observation_space
        self.single_action_space = driven.action_space
        self.observation_names = driven.observed.labels
        self.action_names = driven.action_names
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

        ``actions`` are (N, 1), of several axes (N, actions).
        """
        if not self._rngs:
            raise errors.ResetNeeded("step was called before reset: call reset first")
        given = np.asarray(actions, dtype=np.float64)
        shape = self.num_envs, self._driven.actions
        if given.size != math.prod(shape):
            raise ValueError(f"actions have shape {given.shape}: must have {shape}")
        begin = np.flatnonzero(self._ended).tolist()
        if begin:
            self._driven.loops.reset(begin, self._rngs)
        self._driven.advance(self._driven.shaped(given), (~self._ended).astype(np.int64))
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


# ---- Text and pictures of an episode ----

MODES = ("ansi", "rgb_array")
_SIZE, _DOTS = (6.4, 4.8), 100  # inches, and dots an inch: 640 x 480, as Gymnasium's own


def as_text(past: Sequence[tuple[float, ...]], signals: Signals = UNKNOWN) -> str:
    """Return the last of the rows (t, r, y, u) as a line with units."""
    t, r, y, u = past[-1]
    of_y, of_u = (f" {each.unit}" if each.unit else "" for each in (signals.y, signals.u))
    return f"t = {t:8.3f} s   r = {r:10.4g}{of_y}   y = {y:10.4g}{of_y}   u = {u:10.4g}{of_u}\n"


def as_picture(past: Sequence[tuple[float, ...]], signals: Signals = UNKNOWN) -> Any:
    """Return rows (t, r, y, u) as a picture (480, 640, 3) of y over r, and of u, with units."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE, dpi=_DOTS, layout="constrained")
    canvas: Any = FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True)
    t, r, y, u = np.asarray(past).T
    upper.plot(t, y, label="y")
    upper.plot(t, r, "--", label="r")
    upper.set_ylabel(signals.y.label("output"))
    # u is held during the step that ends with its row.
    lower.step(t, u, where="pre", label="u")
    lower.set_ylabel(signals.u.label("control signal"))
    lower.set_xlabel("time [s]")
    for axes in (upper, lower):
        # Above the axes, where it hides no data.
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3].copy()


# ---- Env ----

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

    **Several axes.** ``controller`` is ``quell.Axes``, in which some axes have the learner
    ``Policy``; the action has a number for each of these. Without controller, for a plant of
    several signals, the action is all control signals. ``observation_names`` and ``action_names``
    say what each number is, as ``"r[elbow]"`` and ``"elbow"``; by default r, y_measured, u and the
    estimates of all axes are observed. ``info["cost"]`` has the integral of the squared error of
    each axis over the step, ``weights`` make one reward of them.

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
        an ``ADRC`` with ``learner=Policy()``, best with ``guard=Guard()``, and finite limits of u,
        or ``quell.Axes`` of such; None if the action is u.
    dt, u_min, u_max
        sample time [s] and limits of u, of several one for all or one for each, only without
        controller, and then necessary.
    action_repeat
        samples of a step.
    limit
        ``|y|`` beyond which the loop counts as lost [y-unit]; by default ten times the largest of
        1, ``|x0|`` and the reference. For scenarios that are drawn, those of one draw, which is the
        same for all seeds.
    cost_of_u
        ρ [y-unit²/u-unit²].
    weights
        of several axes: weights of their squared errors in the reward (n,); 1 by default. Axes of
        other units need them.
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
        controller: ADRC | Axes | None = None,
        *,
        dt: float | None = None,
        u_min: Any = -math.inf,
        u_max: Any = math.inf,
        action_repeat: int = 1,
        limit: float | None = None,
        cost_of_u: float = 0.0,
        weights: Any = None,
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
            weights=weights,
            observe=observe,
            x_limit=x_limit,
            interpret=interpret,
        )
        if render_mode is not None and self._driven.several:
            rule = "NOT for several axes yet; record the observations and plot them"
            raise ValueError(f"render_mode = {render_mode!r}: {rule}")
        self.observation_space = self._driven.observation_space
        self.action_space = self._driven.action_space
        self.observation_names = self._driven.observed.labels
        self.action_names = self._driven.action_names
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
        size = self._driven.actions
        if given.size != size:
            what = "one number" if size == 1 else f"{size} numbers"
            rule = f"must be {what}, in an array of shape ({size},)"
            raise ValueError(f"action = {action!r}: {rule}")
        self._driven.advance(self._driven.shaped(given), np.ones(1, np.int64))
        (terminated,), (truncated,) = self._driven.ends
        self._ended = bool(terminated or truncated)
        cost = float(self._driven.loops.step.cost[0])
        observation, info = self._seen()
        return observation, -cost, bool(terminated), bool(truncated), info

    def _seen(self) -> tuple[Any, dict[str, Any]]:
        info = {
            name: values[0].item() if values.ndim == 1 else values[0]
            for name, values in self._driven.info.items()
        }
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
