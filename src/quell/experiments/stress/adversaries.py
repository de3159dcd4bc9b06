"""Hostile learners, which a guard has to withstand.

One type serves for most of them, so that a trial compiles once; ``kind`` selects the behaviour.
Algorithm 1 is the real one (``learners.BatchGradient``), and ``Turncoat`` is a ``Kalman`` or
``Harmonic`` learner that turns hostile later.

A learner that sees everything, and does what a table of numbers says: an adversary, or perfect.

It has two modes, each a weighted sum of the same ``INPUTS``; it changes from the first to the
second when the guard trusts it, and back when the guard does not, or after a time. So it can earn
trust with what is right and spend it on what does harm. It knows the load in advance and reads the
guard's authority and the typical error e in the guard's own memory, through ``Watched``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers import ADRC
from quell.controllers.law import AdrcState, law_gains
from quell.guard import GUARD_CHANNELS, Guard, UnguardedDesign, UnguardedMemory, write_channels
from quell.kernels.dispatch import kernel
from quell.kernels.sized import Buffer
from quell.learners import BatchGradient, Harmonic, Kalman, Learner
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    lag_memory,
    lag_of,
    lag_push,
    no_coefficients,
    nothing_to_restart,
    predict,
    restart,
)
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# ---- A learner that turns hostile after it was honest for a while ----


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
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    memory.samples[0] += 1.0
    adapt(learner.honest, memory.honest, estimates, y, u_before, f_plain)


@predict.register(TurncoatDesign)
def _predict_turncoat(
    learner: TurncoatDesign, memory: TurncoatMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    constant, slope = predict(learner.honest, memory.honest, estimates, u_before)
    return (constant if memory.samples[0] < learner.turns else learner.size * constant), slope


@commit.register(TurncoatDesign)
def _commit_turncoat(
    learner: TurncoatDesign, memory: TurncoatMemory, estimates: Vector, u: float, f_learned: float
) -> None:
    commit(learner.honest, memory.honest, estimates, u, f_learned)


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


# ---- Hostile learners, which a guard has to withstand ----

# Kinds of ``Adversary``.
MULTIPLE, WHITE, CONSTANT, EXPONENTIAL, DELAYED, MINUS_U = range(6)
FLIPPING, NAN, INF, FEATURES, PLAIN = range(6, 11)


class AdversaryDesign(NamedTuple):
    """Parameters of an adversary."""

    kind: int
    size: float  # a factor, a standard deviation or an amplitude
    time: float  # a time constant or mean time between events [samples]
    weights: Vector  # factors of (x̂_1 … x̂_n, u, 1) (n + 2,)
    delay: int  # [samples]


class AdversaryMemory(NamedTuple):
    """State of an adversary."""

    past: Buffer  # ring buffer of the last estimates f̂ (delay + 1,)
    now: Vector
    """(5,): place in ``past``, number of samples, f_L, f̂ of an ESO without learner, sign."""
    seed: Vector  # (1,): state of the random numbers


_AT, _COUNT, _F_L, _F_PLAIN, _SIGN = range(5)


@kernel
def uniform(seed: Vector) -> float:
    """Return a uniform number in [0, 1) (Park & Miller 1988), exact in floating point."""
    seed[0] = (16807.0 * seed[0]) % 2147483647.0
    return seed[0] / 2147483647.0


@kernel
def normal(seed: Vector) -> float:
    """Return a standard normal number (Box & Muller 1958)."""
    return math.sqrt(-2.0 * math.log(1.0 - uniform(seed))) * math.cos(2.0 * math.pi * uniform(seed))


@adapt.register(AdversaryDesign)
def _adapt_adversaries(
    learner: AdversaryDesign,
    memory: AdversaryMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    now = memory.now
    now[_F_PLAIN] = f_plain
    now[_COUNT] += 1.0
    if uniform(memory.seed) * learner.time < 1.0:
        now[_SIGN] = -now[_SIGN]


@predict.register(AdversaryDesign)
def _predict_adversaries(
    learner: AdversaryDesign, memory: AdversaryMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    kind, size, now = learner.kind, learner.size, memory.now
    n = estimates.size - 1
    f_hat = estimates[n] + now[_F_L]
    out = 0.0
    if kind == MULTIPLE:
        out = size * f_hat
    elif kind == PLAIN:
        out = size * now[_F_PLAIN]
    elif kind == WHITE:
        out = size * normal(memory.seed)
    elif kind == CONSTANT:
        out = size
    elif kind == EXPONENTIAL:
        out = size * math.exp(min(now[_COUNT] / learner.time, 600.0))
    elif kind == DELAYED:
        out = size * memory.past[int(now[_AT])]
    elif kind == MINUS_U:
        out = -size * u_before
    elif kind == FLIPPING:
        out = size * now[_SIGN] * f_hat
    elif kind == NAN:
        out = size * f_hat if now[_SIGN] > 0.0 else math.nan
    elif kind == INF:
        out = size * f_hat if now[_SIGN] > 0.0 else math.inf
    else:
        out = learner.weights[n] * u_before + learner.weights[n + 1]
        for i in range(n):
            out += learner.weights[i] * estimates[i]
    return out, 0.0


@commit.register(AdversaryDesign)
def _commit_adversaries(
    learner: AdversaryDesign, memory: AdversaryMemory, estimates: Vector, u: float, f_learned: float
) -> None:
    at = int(memory.now[_AT])
    memory.past[at] = estimates[estimates.size - 1] + f_learned
    memory.now[_AT] = 0.0 if at + 1 >= memory.past.size else at + 1
    memory.now[_F_L] = f_learned


restart.register(AdversaryDesign)(nothing_to_restart)
coefficients.register(AdversaryDesign)(no_coefficients)


@dataclass(frozen=True)
class Adversary:
    """A hostile learner; its kind selects what it returns. f̂ = Δf̂ + f_L is the total estimate.

    - ``MULTIPLE``: ``size · f̂``; ``PLAIN``: the same of the estimate of an ESO without learner
    - ``WHITE``: white noise of standard deviation ``size``
    - ``CONSTANT``: ``size``; ``EXPONENTIAL``: ``size · exp(t/time)``
    - ``DELAYED``: ``size · f̂`` of ``delay`` samples before
    - ``MINUS_U``: ``−size · b0 u``
    - ``FLIPPING``: ``± size · f̂``; the sign changes every ``time`` seconds on average
    - ``NAN``, ``INF``: ``size · f̂``, and bursts of NaN or Inf; the mean time between changes is
      ``time`` seconds
    - ``FEATURES``: ``weights · (x̂_1 … x̂_n, u, 1)``
    """

    kind: int
    size: float = 1.0
    time: float = math.inf
    weights: tuple[float, ...] = ()
    delay: int = 0
    seed: int = 1

    def design(self, observer: ESO, omega_c: float) -> AdversaryDesign:
        """Return the parameters."""
        n = observer.order
        weights = np.zeros(n + 2)
        given = self.weights[: weights.size]
        weights[: len(given)] = given
        size = self.size * (observer.b0 if self.kind == MINUS_U else 1.0)
        return AdversaryDesign(self.kind, size, self.time / observer.dt, weights, self.delay)

    def memory(self, parameters: AdversaryDesign) -> AdversaryMemory:
        """Return the state at the start."""
        now = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
        return AdversaryMemory(np.zeros(parameters.delay + 1), now, np.array([float(self.seed)]))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names."""
        return ()


# Hostile learners by name. Ranges are chosen by hand: from harmless to far beyond the size of f in
# these loops.
_DRAWS: dict[str, Callable[[np.random.Generator], Learner]] = {
    "opposite sign": lambda rng: Adversary(MULTIPLE, -log_uniform(rng, 0.1, 10.0)),
    "over-prediction": lambda rng: Adversary(_one_of(rng, MULTIPLE, PLAIN), rng.uniform(1.5, 10.0)),
    "white noise": lambda rng: Adversary(WHITE, log_uniform(rng, 1e-2, 1e3), seed=_seed(rng)),
    "constant": lambda rng: Adversary(CONSTANT, _sign(rng) * log_uniform(rng, 0.1, 1e3)),
    "exponential": lambda rng: Adversary(
        EXPONENTIAL, _sign(rng) * log_uniform(rng, 1e-3, 1.0), rng.uniform(1.0, 30.0)
    ),
    "delay": lambda rng: Adversary(
        DELAYED, rng.uniform(0.5, 1.5), delay=round(log_uniform(rng, 1.0, 5000.0))
    ),
    "minus u": lambda rng: Adversary(MINUS_U, rng.uniform(0.3, 2.0)),
    "sign flips": lambda rng: Adversary(
        FLIPPING, rng.uniform(0.5, 2.0), log_uniform(rng, 0.1, 20.0), seed=_seed(rng)
    ),
    "NaN and Inf": lambda rng: Adversary(
        _one_of(rng, NAN, INF), rng.uniform(0.5, 1.2), log_uniform(rng, 0.05, 30.0), seed=_seed(rng)
    ),
    "Algorithm 1": lambda rng: BatchGradient(rate=log_uniform(rng, 1e-7, 1.0)),
    "turncoat": lambda rng: Turncoat(
        Kalman() if rng.random() < 0.5 else Harmonic(),
        rng.uniform(20.0, 130.0),
        float(rng.choice([-3.0, -1.0, 1.5, 3.0, 10.0])),
    ),
    "random features": lambda rng: Adversary(
        FEATURES, weights=tuple((rng.normal(size=6) * log_uniform(rng, 0.1, 10.0)).tolist())
    ),
}
KINDS = tuple(_DRAWS)


def draw_adversary(kind: str, rng: np.random.Generator) -> Learner:
    """Return a random hostile learner of one of the ``KINDS``."""
    return _DRAWS[checks.one_of("kind", kind, KINDS)](rng)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _one_of(rng: np.random.Generator, *kinds: int) -> int:
    return int(rng.choice(kinds))


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1, 2**31 - 1))


# ---- A learner that sees everything, and does what a table of numbers says ----

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
_COUNT_PROGRAM, _MODE, _SINCE, _F_PLAIN_PROGRAM, _SHOWN, _Q, _Q_SHOWN, _F_L_PROGRAM = range(8)
_STATES = 4  # of which the inputs know


class ProgramDesign(NamedTuple):
    """Parameters of the learner."""

    weights: Matrix  # of the two modes (2, inputs)
    trusted: float
    distrusted: float
    least_time: float  # [samples]
    most_time: float  # [samples]
    scale: Vector  # factors of the estimates (N,), zero beyond the order
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
def _adapt_program(
    learner: ProgramDesign,
    memory: ProgramMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    now = memory.now
    memory.inputs[14] = learner.rate * (f_plain - now[_F_PLAIN_PROGRAM])
    now[_F_PLAIN_PROGRAM], now[_Q] = f_plain, f_plain - now[_SHOWN]
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
def _predict_program(
    learner: ProgramDesign, memory: ProgramMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    now, inputs, last = memory.now, memory.inputs, estimates.size - 1
    typical = memory.channels[1]
    inputs[0] = now[_F_PLAIN_PROGRAM]
    for i in range(min(last, _STATES)):
        inputs[3 + i] = learner.scale[i] * estimates[i]
    inputs[7] = learner.b0 * u_before
    inputs[8] = typical
    at = min(int(now[_COUNT_PROGRAM]), learner.load.size - 1)
    inputs[9] = learner.load[at]
    inputs[10] = typical * _sign_program(now[_Q])
    inputs[11] = typical * _sign_program(estimates[1] if last > 1 else estimates[0])
    inputs[12] = typical * math.sin(learner.omega * now[_COUNT_PROGRAM])
    inputs[13] = now[_F_L_PROGRAM]
    now[_COUNT_PROGRAM] += 1.0
    mode, output = int(now[_MODE]), 0.0
    for i in range(inputs.size):
        output += learner.weights[mode, i] * inputs[i]
    return output, 0.0


@kernel
def _sign_program(value: float) -> float:
    return 1.0 if value > 0.0 else -1.0 if value < 0.0 else 0.0


@commit.register(ProgramDesign)
def _commit_program(
    learner: ProgramDesign, memory: ProgramMemory, estimates: Vector, u: float, f_learned: float
) -> None:
    memory.now[_F_L_PROGRAM] = f_learned


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
