"""A learner that turns hostile after it was honest for a while."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell.learners import Learner
from quell.learners.base import adapt, coefficients, commit, no_coefficients, predict, restart
from quell.observers.eso import ESO
from quell.types import Vector


class TurncoatDesign(NamedTuple):
    """Parameters of ``Turncoat``."""

    honest: Any
    turns: float  # number of honest samples
    size: float  # factor of its prediction afterwards


class TurncoatMemory(NamedTuple):
    """State of ``Turncoat``."""

    honest: Any
    samples: Vector  # samples so far (1,)


@adapt.register(TurncoatDesign)
def _adapt_turncoat(
    learner: TurncoatDesign,
    memory: TurncoatMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    memory.samples[0] += 1.0
    adapt(learner.honest, memory.honest, seen, y, u_before, f_plain)


@predict.register(TurncoatDesign)
def _predict_turncoat(
    learner: TurncoatDesign, memory: TurncoatMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    constant, slope = predict(learner.honest, memory.honest, seen, u_before)
    return (constant if memory.samples[0] < learner.turns else learner.size * constant), slope


@commit.register(TurncoatDesign)
def _commit_turncoat(
    learner: TurncoatDesign, memory: TurncoatMemory, seen: Vector, u: float, f_learned: float
) -> None:
    commit(learner.honest, memory.honest, seen, u, f_learned)


@restart.register(TurncoatDesign)
def _restart_turncoat(learner: TurncoatDesign, memory: TurncoatMemory) -> None:
    restart(learner.honest, memory.honest)


coefficients.register(TurncoatDesign)(no_coefficients)


@dataclass(frozen=True)
class Turncoat:
    """A learner that returns ``size`` times its prediction after ``turns`` seconds."""

    honest: Learner
    turns: float
    size: float

    def design(self, observer: ESO, omega_c: float) -> TurncoatDesign:
        """Return the parameters."""
        honest = self.honest.design(observer, omega_c)
        return TurncoatDesign(honest, self.turns / observer.dt, self.size)

    def memory(self, parameters: TurncoatDesign) -> TurncoatMemory:
        """Return the state at the start."""
        return TurncoatMemory(self.honest.memory(parameters.honest), np.zeros(1))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names."""
        return ()
