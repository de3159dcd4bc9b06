"""The quantity that a policy sets in each sample: f_L of an ADRC, or u itself.

Both are controllers for the loop of ``block.py``, which calls ``set_action`` before each sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell.checks import positive
from quell.controllers.adrc.law import AdrcDesign, AdrcState
from quell.controllers.base import control, reset_loop, status_flags, write_row
from quell.controllers.limits import Limits
from quell.kernels.dispatch import generic
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
from quell.types import Channels, Vector


@generic
def set_action(controller: Any, state: Any, action: float) -> None:
    """Set the action of the next sample: u [u-unit], or f_L [y-unit/s^n]."""
    raise TypeError


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
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    pass


@predict.register(PolicyDesign)
def _predict(
    learner: PolicyDesign, memory: PolicyMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    return memory.output[0], 0.0


@commit.register(PolicyDesign)
def _commit(
    learner: PolicyDesign, memory: PolicyMemory, seen: Vector, u: float, f_learned: float
) -> None:
    pass


restart.register(PolicyDesign)(nothing_to_restart)
coefficients.register(PolicyDesign)(no_coefficients)


@set_action.register(AdrcDesign)
def _set_feedforward(design: AdrcDesign, state: AdrcState, action: float) -> None:
    state.learner.output[0] = action


class GivenDesign(NamedTuple):
    """Parameters of ``GivenControl``."""

    limits: Limits  # of magnitude only


class GivenState(NamedTuple):
    """State of ``GivenControl``."""

    u: Vector  # (1,)


@dataclass(frozen=True)
class GivenControl:
    """The absence of a controller: u comes from outside, within limits."""

    dt: float
    parameters: GivenDesign
    features: tuple[str, ...] = ()
    channels: Channels = ()

    def initial_state(self) -> GivenState:
        """Return the state before the first sample."""
        return GivenState(np.zeros(1))


@control.register(GivenDesign)
def _control(design: GivenDesign, state: GivenState, r: float, y: float) -> float:
    return min(max(state.u[0], design.limits.low), design.limits.high)


@set_action.register(GivenDesign)
def _set_control(design: GivenDesign, state: GivenState, action: float) -> None:
    state.u[0] = action


@write_row.register(GivenDesign)
def _write_row(design: GivenDesign, state: GivenState, row: Vector) -> None:
    pass


@status_flags.register(GivenDesign)
def _status_flags(design: GivenDesign, state: GivenState) -> int:
    return 0


@reset_loop.register(GivenDesign)
def _reset_loop(design: GivenDesign, state: GivenState) -> None:
    state.u[0] = 0.0
