"""A learner whose correction e_L is given, or as large as a guard may let it be; it records q."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

import quell as ql
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    lag_memory,
    lag_of,
    lag_push,
    nothing_to_restart,
    predict,
    restart,
)
from quell.types import Matrix, Vector


class InjectedDesign(NamedTuple):
    """Parameters."""

    lag: Any  # of the observer
    sequence: Vector  # e_L of each sample, or what it is multiplied by
    kappa: float  # zero if the sequence is e_L itself


class InjectedMemory(NamedTuple):
    """State: the filters of f_plain and of f_L."""

    chain: Matrix  # (2, …)
    now: Vector  # (6,): f_plain^F, f_L^F, number of samples, q, e_L, e


class Injected:
    """A learner whose f_L is e_L + f_L^F; beyond its sequence e_L is zero. Its θ are q and e_L.

    With ``kappa``, e_L is the sequence times κ e, with e the largest |q| so far: whatever a guard
    with the bound κ could let pass, if the sequence stays within ±1.
    """

    def __init__(self, sequence: Any, kappa: float = 0.0) -> None:
        self.sequence, self.kappa = np.array(sequence, dtype=np.float64), kappa

    def design(self, observer: ql.ESO, omega_c: float) -> InjectedDesign:
        """Return the parameters."""
        return InjectedDesign(lag_of(observer), self.sequence, self.kappa)

    def memory(self, parameters: InjectedDesign) -> InjectedMemory:
        """Return the state at rest."""
        return InjectedMemory(lag_memory(parameters.lag, 2), np.zeros(6))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return the names of what is recorded."""
        return ("q", "e_L")


@adapt.register(InjectedDesign)
def _adapt(
    learner: InjectedDesign,
    memory: InjectedMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    now = memory.now
    now[3] = f_plain - now[0]
    now[5] = max(now[5], abs(now[3]))
    now[0] = lag_push(learner.lag, memory.chain, 0, f_plain)


@predict.register(InjectedDesign)
def _predict(
    learner: InjectedDesign, memory: InjectedMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    now = memory.now
    place = int(now[2])
    now[4] = learner.sequence[place] if place < learner.sequence.size else 0.0
    if learner.kappa > 0.0:
        now[4] *= learner.kappa * now[5]
    return now[1] + now[4], 0.0


@commit.register(InjectedDesign)
def _commit(
    learner: InjectedDesign, memory: InjectedMemory, seen: Vector, u: float, f_learned: float
) -> None:
    memory.now[1] = lag_push(learner.lag, memory.chain, 1, f_learned)
    memory.now[2] += 1.0


restart.register(InjectedDesign)(nothing_to_restart)


@coefficients.register(InjectedDesign)
def _coefficients(learner: InjectedDesign, memory: InjectedMemory, theta: Vector) -> None:
    theta[0], theta[1] = memory.now[3], memory.now[4]
