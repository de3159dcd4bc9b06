"""Actions of a policy: the feedforward f_L of axes with a ``Policy``, or all control signals.

A policy gives f_L of an ADRC, or of each axis of ``quell.Axes``, whose learner is a ``Policy``, or
all control signals u of an open plant. Its numbers are written into the states of the loops
(``loops.py``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell.checks import positive
from quell.controllers.adrc import ADRC
from quell.controllers.axes import Axes
from quell.controllers.base import reset_loop, status_flags, write_row
from quell.controllers.several import control_all
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    no_coefficients,
    nothing_to_restart,
    predict,
    restart,
)
from quell.observers.eso import ESO
from quell.plants.base import inputs_of, outputs_of
from quell.simulation.scenario import check_fit
from quell.types import Channels, Vector

# ---- A learner whose output a policy sets ----


class PolicyDesign(NamedTuple):
    """Parameters of ``Policy``: none."""


class PolicyMemory(NamedTuple):
    """State of ``Policy``."""

    output: Vector  # f_L that the policy asks for (1,) [y-unit/s^n]


@dataclass(frozen=True)
class Policy:
    """A learner whose output a policy sets from outside, sample by sample.

    ``ADRC(…, learner=Policy(), guard=Guard())`` is the controller of an environment whose action is
    a share of the disturbance that is fed forward. It learns nothing itself. Outside of an
    environment, for example in ``simulate``, its output is zero, and the loop is the one without
    learner.

    Parameters
    ----------
    most
        output f_L for the action 1 [y-unit/s^n]; by default what u can cancel,
        ``b0 (u_max − u_min)/2``.
    """

    most: float | None = None

    def __post_init__(self) -> None:
        if self.most is not None:
            positive("most", self.most, "y-unit/s^n")

    def design(self, observer: ESO, omega_c: float) -> PolicyDesign:
        """Return no parameters."""
        return PolicyDesign()

    def memory(self, parameters: PolicyDesign) -> PolicyMemory:
        """Return the state with the output zero."""
        return PolicyMemory(np.zeros(1))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names."""
        return ()


@adapt.register(PolicyDesign)
def _adapt(
    learner: PolicyDesign,
    memory: PolicyMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    pass


@predict.register(PolicyDesign)
def _predict(
    learner: PolicyDesign, memory: PolicyMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    return memory.output[0], 0.0


@commit.register(PolicyDesign)
def _commit(
    learner: PolicyDesign, memory: PolicyMemory, estimates: Vector, u: float, f_learned: float
) -> None:
    pass


restart.register(PolicyDesign)(nothing_to_restart)
coefficients.register(PolicyDesign)(no_coefficients)


# ---- The absence of a controller ----


class GivenDesign(NamedTuple):
    """Parameters of ``GivenControl``: limits of magnitude of each control signal (m,)."""

    low: Vector
    high: Vector


class GivenState(NamedTuple):
    """State of ``GivenControl``."""

    u: Vector  # (m,)


@dataclass(frozen=True, eq=False)
class GivenControl:
    """The absence of a controller: all u come from outside, within limits."""

    dt: float
    parameters: GivenDesign
    outputs: int
    features: tuple[str, ...] = ()
    channels: Channels = ()
    names: tuple[str, ...] = ()

    @property
    def inputs(self) -> int:
        """Number of control signals."""
        return int(self.parameters.low.size)

    def initial_state(self) -> GivenState:
        """Return the state before the first sample."""
        return GivenState(np.zeros(self.inputs))


@control_all.register(GivenDesign)
def _control_all(design: GivenDesign, state: GivenState, r: Vector, y: Vector, u: Vector) -> None:
    for k in range(u.size):
        u[k] = min(max(state.u[k], design.low[k]), design.high[k])


@write_row.register(GivenDesign)
def _write_row(design: GivenDesign, state: GivenState, row: Vector) -> None:
    pass


@status_flags.register(GivenDesign)
def _status_flags(design: GivenDesign, state: GivenState) -> int:
    return 0


@reset_loop.register(GivenDesign)
def _reset_loop(design: GivenDesign, state: GivenState) -> None:
    for k in range(state.u.size):
        state.u[k] = 0.0


# ---- What the actions are ----


class Actions(NamedTuple):
    """Values of the actions −1 and 1, ``middle ± reach``, and the limits of u (m,)."""

    middle: Vector
    reach: Vector
    u_min: Vector
    u_max: Vector
    names: tuple[str, ...]  # of each action: u, f, or the axis whose f it is


def loop_of(
    plant: Any, controller: Any, dt: float | None, u_min: Any, u_max: Any
) -> tuple[Any, Actions]:
    """Return the controller of a loop and the meaning of its actions.

    Raises
    ------
    ValueError
        for a controller without ``Policy``, without finite limits, or for missing arguments.
    """
    if controller is None:
        if dt is None:
            raise ValueError("dt = None: must be the sample time [s] if there is no controller")
        dt = positive("dt", dt, "s")
        low, high = _limits("u_min and u_max", u_min, u_max, inputs_of(plant))
        actions = Actions(0.5 * (low + high), 0.5 * (high - low), low, high, places("u", low.size))
        return GivenControl(dt, GivenDesign(low, high), outputs_of(plant)), actions
    policies = {
        name: axis.learner
        for name, axis in _axes_of(controller)
        if isinstance(axis.learner, Policy)
    }
    if not policies:
        raise ValueError(
            f"controller = {controller!r:.60}: must be a quell.ADRC with "
            "learner=quell.envs.Policy(), whose output the actions are, quell.Axes that follow "
            "references with it in one axis or more, or None for actions that are u"
        )
    check_fit(plant, controller)
    for name, given, usual in (
        ("dt", dt, None), ("u_min", u_min, -math.inf), ("u_max", u_max, math.inf)
    ):  # fmt: skip
        if np.any(given != usual):
            raise ValueError(f"{name}: the controller has it; give it there only")
    limits = controller.limits
    what = "u_min and u_max of the controller"
    low, high = _limits(what, limits.low, limits.high, inputs_of(plant))
    reach = np.array(
        [_most(controller, name, policy, high - low) for name, policy in policies.items()]
    )
    return controller, Actions(np.zeros(reach.size), reach, low, high, tuple(policies))


def _axes_of(controller: Any) -> list[tuple[str, Any]]:
    """Return names and ADRC of the axes that a policy may drive."""
    if isinstance(controller, ADRC):
        return [("f", controller)]
    if isinstance(controller, Axes) and not controller.takes_u_0:
        return list(zip(controller.names, controller.axes, strict=True))
    return []


def _most(controller: Any, name: str, policy: Policy, span: Vector) -> float:
    """Return f_L of the action 1: by default what the actuators can cancel, one axis alone."""
    if policy.most is not None:
        return policy.most
    if isinstance(controller, ADRC):
        return float(0.5 * abs(controller.observer.b0) * span[0])
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
    except (TypeError, ValueError, OverflowError):
        ends = []
    if not ends or not np.all(np.isfinite(ends)) or not np.all(ends[0] < ends[1]):
        each = f", one for all or one for each of {size}" if size > 1 else ""
        rule = f"must be finite, the first one smaller{each}"
        raise ValueError(f"{what} = {low!r}, {high!r}: {rule}")
    return ends[0], ends[1]


def places(name: str, width: int) -> tuple[str, ...]:
    """Return a name for each number of a channel."""
    return tuple(f"{name}[{k}]" for k in range(width)) if width > 1 else (name,)


def places_of_actions(controller: Any, state: Any) -> list[Vector]:
    """Return the arrays in the state of a loop that its actions set, in their order."""
    if isinstance(controller, GivenControl):
        return [state.u]
    if isinstance(controller, ADRC):
        return [state.learner.output]
    pairs = zip(controller.axes, state.axes, strict=True)
    return [own.learner.output for axis, own in pairs if isinstance(axis.learner, Policy)]
