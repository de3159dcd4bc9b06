"""A learner that sees everything, and does what a table of numbers says: an adversary, or perfect.

It has two modes, each a weighted sum of the same ``INPUTS``; it changes from the first to the
second when the guard trusts it, and back when the guard does not, or after a time. So it can earn
trust with what is right and spend it on what does harm. It knows the load in advance and reads the
guard's authority and the typical error e in the guard's own memory, through ``Watched``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell.controllers import ADRC
from quell.controllers.adrc.law import AdrcState, law_gains
from quell.guard import (
    GUARD_CHANNELS,
    Guard,
    UnguardedDesign,
    UnguardedMemory,
    write_channels,
)
from quell.kernels.dispatch import kernel
from quell.kernels.sized import Buffer
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    no_coefficients,
    nothing_to_restart,
    predict,
    restart,
)
from quell.learners.lag import lag_memory, lag_of, lag_push
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

INPUTS = (
    "f_plain",  # what an ESO without learner estimates
    "q",  # f_plain − f_plain^F
    "q − q^F",
    "k1 x1",  # the estimates, times the gains of the law
    "k2 x2",
    "k3 x3",
    "k4 x4",
    "b0 u",
    "e",  # the guard's typical error
    "load",  # the load's table, in the sample that begins
    "e sign(q)",
    "e sign(x2)",
    "e sin(omega t)",
    "f_L",  # of the sample before
    "f_plain'/omega_o",
)
"""Signals that the two modes weigh, all in the unit of f."""
RULES = ("trusted", "distrusted", "least_time", "most_time")
"""Authority from which it attacks, and at which it stops; least time [lags] in the first mode, and
longest time in the second."""
# Entries of ProgramMemory.now: f_plain, q and their lagged values, and the state of the modes.
_COUNT, _MODE, _SINCE, _F_PLAIN, _SHOWN, _Q, _Q_SHOWN, _F_L = range(8)
_STATES = 4  # of which the inputs know


class ProgramDesign(NamedTuple):
    """Parameters of the learner."""

    weights: Matrix  # of the two modes (2, inputs)
    trusted: float
    distrusted: float
    least_time: float  # [samples]
    most_time: float  # [samples]
    scale: Vector  # factors of seen (N,), zero beyond the order
    b0: float
    rate: float  # 1/(omega_o dt)
    omega: float  # [rad/sample]
    lag: Any
    load: Buffer  # a value for each sample
    guard: Any


class ProgramMemory(NamedTuple):
    """State of the learner."""

    now: Vector
    chain: Matrix  # lag filters of f_plain and of q
    channels: Vector  # what the guard writes
    inputs: Vector
    guard: Any  # the guard's memory


@adapt.register(ProgramDesign)
def _adapt(
    learner: ProgramDesign,
    memory: ProgramMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    now = memory.now
    memory.inputs[14] = learner.rate * (f_plain - now[_F_PLAIN])
    now[_F_PLAIN], now[_Q] = f_plain, f_plain - now[_SHOWN]
    memory.inputs[1], memory.inputs[2] = now[_Q], now[_Q] - now[_Q_SHOWN]
    now[_SHOWN] = lag_push(learner.lag, memory.chain, 0, f_plain)
    now[_Q_SHOWN] = lag_push(learner.lag, memory.chain, 1, now[_Q])
    write_channels(learner.guard, memory.guard, memory.channels)
    now[_SINCE] += 1.0
    if now[_MODE] == 0.0:
        if memory.channels[0] >= learner.trusted and now[_SINCE] >= learner.least_time:
            now[_MODE], now[_SINCE] = 1.0, 0.0
    elif memory.channels[0] <= learner.distrusted or now[_SINCE] >= learner.most_time:
        now[_MODE], now[_SINCE] = 0.0, 0.0


@predict.register(ProgramDesign)
def _predict(
    learner: ProgramDesign, memory: ProgramMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    now, inputs, last = memory.now, memory.inputs, seen.size - 1
    typical = memory.channels[1]
    inputs[0] = now[_F_PLAIN]
    for i in range(min(last, _STATES)):
        inputs[3 + i] = learner.scale[i] * seen[i]
    inputs[7] = learner.b0 * u_before
    inputs[8] = typical
    at = min(int(now[_COUNT]), learner.load.size - 1)
    inputs[9] = learner.load[at]
    inputs[10] = typical * _sign(now[_Q])
    inputs[11] = typical * _sign(seen[1] if last > 1 else seen[0])
    inputs[12] = typical * math.sin(learner.omega * now[_COUNT])
    inputs[13] = now[_F_L]
    now[_COUNT] += 1.0
    mode, output = int(now[_MODE]), 0.0
    for i in range(inputs.size):
        output += learner.weights[mode, i] * inputs[i]
    return output, 0.0


@kernel
def _sign(value: float) -> float:
    return 1.0 if value > 0.0 else -1.0 if value < 0.0 else 0.0


@commit.register(ProgramDesign)
def _commit(
    learner: ProgramDesign, memory: ProgramMemory, seen: Vector, u: float, f_learned: float
) -> None:
    memory.now[_F_L] = f_learned


restart.register(ProgramDesign)(nothing_to_restart)
coefficients.register(ProgramDesign)(no_coefficients)


@dataclass(frozen=True, eq=False)
class Program:
    """A learner that sees everything; see the module.

    Parameters
    ----------
    weights
        of the ``INPUTS`` in the two modes (2, inputs).
    rules
        the ``RULES``. Without trust at infinity it stays in its first mode.
    omega
        of the input ``e sin(omega t)`` [rad/s].
    load
        a value for each sample [y-unit/s^n].
    guard
        of the controller that it is to watch.
    """

    weights: Sequence[Sequence[float]]
    rules: tuple[float, float, float, float] = (math.inf, -1.0, 0.0, math.inf)
    omega: float = 1.0
    load: Any = (0.0,)
    guard: Guard | None = None

    def __repr__(self) -> str:
        shown = [[float(f"{w:.3g}") for w in mode] for mode in self.weights]
        rules = tuple(float(f"{rule:.3g}") for rule in self.rules)
        return f"Program({shown}, rules={rules}, omega={self.omega:.3g})"

    def design(self, observer: ESO, omega_c: float) -> ProgramDesign:
        """Return the parameters."""
        law = law_gains(observer.order, omega_c)
        lag = observer.lag_time / observer.dt
        guard = UnguardedDesign() if self.guard is None else self.guard.design(observer, law)
        return ProgramDesign(
            weights=np.array(self.weights, dtype=np.float64),
            trusted=self.rules[0],
            distrusted=self.rules[1],
            least_time=self.rules[2] * lag,
            most_time=self.rules[3] * lag,
            scale=np.append(law, 1.0),
            b0=observer.b0,
            rate=1.0 / (observer.omega_o * observer.dt),
            omega=self.omega * observer.dt,
            lag=lag_of(observer),
            load=np.array(self.load, dtype=np.float64),
            guard=guard,
        )

    def memory(self, parameters: ProgramDesign) -> ProgramMemory:
        """Return the state at the start; ``Watched`` puts the guard's memory in."""
        nothing = UnguardedMemory(np.zeros(0))
        channels = np.zeros(sum(width for _, width in GUARD_CHANNELS))
        channels[0] = float(self.guard is None)  # full authority, until a guard writes another
        return ProgramMemory(
            now=np.zeros(8),
            chain=lag_memory(parameters.lag, 2),
            channels=channels,
            inputs=np.zeros(len(INPUTS)),
            guard=nothing if self.guard is None else self.guard.memory(parameters.guard),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names."""
        return ()


class Watched(ADRC):
    """A controller whose learner, a ``Program``, sees the guard's memory."""

    def initial_state(self) -> AdrcState:
        """Return the state; the learner's memory refers to the guard's arrays."""
        state = super().initial_state()
        if self.guard is None:
            return state
        return state._replace(learner=state.learner._replace(guard=state.guard))
