"""Spaces of observations and actions, with finite bounds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.adrc.adrc import ADRC
from quell.controllers.base import Controller
from quell.controllers.limits import checked_limits
from quell.envs.loops import Loops
from quell.envs.policy import GivenControl, GivenDesign, Policy
from quell.records.channels import columns_of
from quell.types import Vector

OBSERVED_WITH_U = ("r", "y_measured", "u", "x")
OBSERVED_WITH_F = ("r", "y_measured", "u", "x_hat", "f_residual", "f_learned")
# Entries of a controller's status are flags below this (``types.Status``).
_FLAGS = 2048.0


class Action(NamedTuple):
    """Values of the actions −1 and 1: ``middle ± reach``."""

    middle: float
    reach: float
    u_min: float
    u_max: float


def loop_of(
    controller: ADRC | None, dt: float | None, u_min: float, u_max: float
) -> tuple[Controller, Action]:
    """Return the controller of the loop and the meaning of its action.

    Raises
    ------
    ValueError
        for a controller without ``Policy``, without finite limits, or for missing arguments.
    """
    if controller is None:
        if dt is None:
            raise ValueError("dt = None: must be the sample time [s] if there is no controller")
        dt = checks.positive("dt", dt, "s")
        low, high = _limits(u_min, u_max, "u_min and u_max")
        middle, reach = 0.5 * (low + high), 0.5 * (high - low)
        given = GivenDesign(checked_limits(low, high, math.inf, dt))
        return GivenControl(dt, given), Action(middle, reach, low, high)
    if not isinstance(controller, ADRC) or not isinstance(controller.learner, Policy):
        raise ValueError(
            f"controller = {controller!r}: must be a quell.ADRC with learner=quell.envs.Policy(), "
            "whose output the actions are, or None for actions that are u"
        )
    twice = {"dt": dt is not None, "u_min": u_min != -math.inf, "u_max": u_max != math.inf}
    for name, is_given in twice.items():
        if is_given:
            raise ValueError(f"{name}: the controller has it; give it there only")
    limits = controller.limits
    low, high = _limits(limits.low, limits.high, "u_min and u_max of the controller")
    most = controller.learner.most
    if most is None:
        most = 0.5 * abs(controller.observer.b0) * (high - low)
    return controller, Action(0.0, most, low, high)


def _limits(low: Any, high: Any, what: str) -> tuple[float, float]:
    with suppress(TypeError, ValueError, OverflowError):
        ends = float(low), float(high)
        if -math.inf < ends[0] < ends[1] < math.inf:
            return ends
    raise ValueError(f"{what} = {low!r}, {high!r}: must be finite, the first one smaller")


class Observed:
    """The observed channels: their columns in a row, and their bounds.

    A channel's bound is what it can be while ``|y|`` is within the limit L: L for r and y, the
    limits for u, ``L omega_o^i`` for the i-th derivative that the observer estimates. States of the
    plant have the bound ``x_limit``, disturbances L.
    """

    def __init__(
        self,
        names: Sequence[str] | None,
        loop: Loops,
        action: Action,
        x_limit: Any,
    ) -> None:
        is_adrc = isinstance(loop.controller, ADRC)
        default = OBSERVED_WITH_F if is_adrc else OBSERVED_WITH_U
        if isinstance(names, str):
            names = (names,)
        if names is not None and not checks.is_sequence(names):
            raise ValueError(f"observe = {names!r}: must be a list of names of channels")
        self.names = tuple(names or default)
        widths = {name: width for name, width in loop.channels if width}
        for name in self.names:
            checks.one_of("observe", name, tuple(widths))
        if len({*self.names}) != len(self.names):
            raise ValueError(f"observe = {names!r}: must be different channels")
        most = _bounds(loop, action, x_limit)
        high = [np.broadcast_to(most.get(name, loop.limit), widths[name]) for name in self.names]
        low = [
            np.full(1, action.u_min) if name == "u" else -each
            for name, each in zip(self.names, high, strict=True)
        ]
        self.high: Vector = np.concatenate(high).astype(np.float64)
        self.low: Vector = np.concatenate(low).astype(np.float64)
        every = range(sum(widths.values()))
        chosen = [every[columns_of(loop.channels, name)] for name in self.names]
        self.columns = np.array([k for columns in chosen for k in columns])

    def of(self, rows: Any) -> Any:
        """Return the observations of rows (…, channels), clipped to the bounds."""
        return np.clip(rows[..., self.columns], self.low, self.high)


def _bounds(loop: Loops, action: Action, x_limit: Any) -> dict[str, Any]:
    """Return the bounds that are not the limit, by channel."""
    order, limit = loop.plant.order, loop.limit
    x = np.full(order, limit) if x_limit is None else np.atleast_1d(x_limit)
    if x.size == 1:
        x = np.full(order, x[0])
    found: dict[str, Any] = {"u": action.u_max}
    found["x"] = checks.positive_vector("x_limit", x)
    if x.size != order:
        raise ValueError(f"x_limit has {x.size} entries: must be a number, or one for each state")
    if isinstance(loop.controller, ADRC):
        observer = loop.controller.observer
        rates = limit * observer.omega_o ** np.arange(observer.estimates + 0.0)
        n = observer.order
        f = max(float(rates[n]), action.reach)
        found |= dict.fromkeys(("f_residual", "f_learned", "error_plain", "error_learned"), f)
        found |= {"x_hat": rates[:n], "f_derivatives": rates[n + 1 :]}
        found |= {"authority": 1.0, "status": _FLAGS, "reason": _FLAGS}
    return found
