"""Learners that mean no good: what a guard has to stand.

One type for all, so that a trial compiles once; ``kind`` says which. Algorithm 1 is the real one (``learners.BatchGradient``), and
``Turncoat`` a ``Kalman`` learner that turns when it has been trusted for a while.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.kernels.dispatch import kernel
from quell.learners import BatchGradient, Harmonic, Kalman, Learner
from quell.learners.base import adapt, coefficients, commit, predict, restart
from quell.observers.eso import ESO
from quell.types import Vector

# What an ``Adversary`` does.
MULTIPLE, WHITE, CONSTANT, EXPONENTIAL, DELAYED, MINUS_U, FLIPPING, NAN, INF, FEATURES, PLAIN = (
    range(11)
)


class AdversaryDesign(NamedTuple):
    """Parameters of an adversary."""

    kind: int
    """What it does."""
    size: float
    """A factor, a standard deviation or an amplitude."""
    time: float
    """A time constant or mean time between events [samples]."""
    weights: Vector
    """Of (x̂_1 … x̂_n, u, 1) (n + 2,)."""
    delay: int
    """Samples."""


class AdversaryMemory(NamedTuple):
    """State of an adversary."""

    ring: Vector
    """The last estimates (delay + 1,)."""
    moment: Vector
    """(5,): place in the ring, samples so far, f_L, what of f̂ a plain ESO would have, sign or whether in a burst."""
    dice: Vector
    """(1,): state of the random numbers."""


@kernel
def roll(dice: Vector) -> float:
    """Return a uniform number in [0, 1): a linear congruence modulo 2^31 − 1 (Park & Miller 1988), exact in floating point."""
    dice[0] = (16807.0 * dice[0]) % 2147483647.0
    return dice[0] / 2147483647.0


@kernel
def normal(dice: Vector) -> float:
    """Return a standard normal number (Box & Muller 1958)."""
    return math.sqrt(-2.0 * math.log(1.0 - roll(dice))) * math.cos(2.0 * math.pi * roll(dice))


_AT, _COUNT, _F_L, _F_PLAIN, _SIGN = range(5)


@adapt.register(AdversaryDesign)
def _adapt(
    learner: AdversaryDesign,
    memory: AdversaryMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    moment = memory.moment
    moment[_F_PLAIN] = f_plain
    moment[_COUNT] += 1.0
    if roll(memory.dice) * learner.time < 1.0:
        moment[_SIGN] = -moment[_SIGN]


@predict.register(AdversaryDesign)
def _predict(
    learner: AdversaryDesign, memory: AdversaryMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    kind, size, moment = learner.kind, learner.size, memory.moment
    n = seen.size - 1
    f_hat = seen[n] + moment[_F_L]
    out = 0.0
    if kind == MULTIPLE:
        out = size * f_hat
    elif kind == PLAIN:
        out = size * moment[_F_PLAIN]
    elif kind == WHITE:
        out = size * normal(memory.dice)
    elif kind == CONSTANT:
        out = size
    elif kind == EXPONENTIAL:
        out = size * math.exp(min(moment[_COUNT] / learner.time, 600.0))
    elif kind == DELAYED:
        out = size * memory.ring[int(moment[_AT])]
    elif kind == MINUS_U:
        out = -size * u_before
    elif kind == FLIPPING:
        out = size * moment[_SIGN] * f_hat
    elif kind == NAN:
        out = size * f_hat if moment[_SIGN] > 0.0 else math.nan
    elif kind == INF:
        out = size * f_hat if moment[_SIGN] > 0.0 else math.inf
    else:
        out = learner.weights[n] * u_before + learner.weights[n + 1]
        for i in range(n):
            out += learner.weights[i] * seen[i]
    return out, 0.0


@commit.register(AdversaryDesign)
def _commit(
    learner: AdversaryDesign, memory: AdversaryMemory, seen: Vector, u: float, f_learned: float
) -> None:
    at = int(memory.moment[_AT])
    memory.ring[at] = seen[seen.size - 1] + f_learned
    memory.moment[_AT] = 0.0 if at + 1 >= memory.ring.size else at + 1
    memory.moment[_F_L] = f_learned


@restart.register(AdversaryDesign)
def _restart(learner: AdversaryDesign, memory: AdversaryMemory) -> None:
    pass


@coefficients.register(AdversaryDesign)
def _coefficients(learner: AdversaryDesign, memory: AdversaryMemory, theta: Vector) -> None:
    pass


@dataclass(frozen=True)
class Adversary:
    """A learner that returns what its kind says, f̂ = Δf̂ + f_L being the total estimate.

    ``MULTIPLE``
        ``size · f̂``; ``PLAIN`` the same multiple of what an ESO without learner would have estimated.
    ``WHITE``
        white noise of standard deviation ``size``.
    ``CONSTANT``
        ``size``.
    ``EXPONENTIAL``
        ``size · exp(t/time)``.
    ``DELAYED``
        ``size · f̂``, ``delay`` samples later than it is known.
    ``MINUS_U``
        ``−size · b0 u``.
    ``FLIPPING``
        ``± size · f̂``, the sign changing at random times, ``time`` seconds apart on average.
    ``NAN``, ``INF``
        ``size · f̂``, and NaN or Inf in bursts that begin and end at random times.
    ``FEATURES``
        ``weights · (x̂_1 … x̂_n, u, 1)``.
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
        weights[: len(self.weights)] = self.weights
        size = self.size * (observer.b0 if self.kind == MINUS_U else 1.0)
        return AdversaryDesign(self.kind, size, self.time / observer.dt, weights, self.delay)

    def memory(self, parameters: AdversaryDesign) -> AdversaryMemory:
        """Return the state at the start."""
        moment = np.zeros(5)
        moment[_SIGN] = 1.0
        return AdversaryMemory(np.zeros(parameters.delay + 1), moment, np.array([float(self.seed)]))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names."""
        return ()


class TurncoatDesign(NamedTuple):
    """Parameters of ``Turncoat``."""

    honest: Any
    turns: float
    """After so many samples."""
    size: float
    """What it returns then: so many times what it believes."""


class TurncoatMemory(NamedTuple):
    """State of ``Turncoat``."""

    honest: Any
    so_far: Vector
    """(1,)."""


@adapt.register(TurncoatDesign)
def _adapt_turncoat(
    learner: TurncoatDesign,
    memory: TurncoatMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    memory.so_far[0] += 1.0
    adapt(learner.honest, memory.honest, seen, y, u_before, f_plain)


@predict.register(TurncoatDesign)
def _predict_turncoat(
    learner: TurncoatDesign, memory: TurncoatMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    constant, slope = predict(learner.honest, memory.honest, seen, u_before)
    return (constant if memory.so_far[0] < learner.turns else learner.size * constant), slope


@commit.register(TurncoatDesign)
def _commit_turncoat(
    learner: TurncoatDesign, memory: TurncoatMemory, seen: Vector, u: float, f_learned: float
) -> None:
    commit(learner.honest, memory.honest, seen, u, f_learned)


@restart.register(TurncoatDesign)
def _restart_turncoat(learner: TurncoatDesign, memory: TurncoatMemory) -> None:
    restart(learner.honest, memory.honest)


@coefficients.register(TurncoatDesign)
def _coefficients_turncoat(learner: TurncoatDesign, memory: TurncoatMemory, theta: Vector) -> None:
    pass


@dataclass(frozen=True)
class Turncoat:
    """A learner that is honest for ``turns`` seconds, and then returns ``size`` times what it believes."""

    honest: Any
    turns: float
    size: float

    def design(self, observer: ESO, omega_c: float) -> TurncoatDesign:
        """Return the parameters."""
        return TurncoatDesign(
            self.honest.design(observer, omega_c), self.turns / observer.dt, self.size
        )

    def memory(self, parameters: TurncoatDesign) -> TurncoatMemory:
        """Return the state at the start."""
        return TurncoatMemory(self.honest.memory(parameters.honest), np.zeros(1))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names."""
        return ()


# Kinds of adversaries for a trial, and how to draw one.
_DRAWS: dict[str, Callable[[np.random.Generator], Learner]] = {
    "opposite sign": lambda rng: Adversary(MULTIPLE, -_log_uniform(rng, 0.1, 10.0)),
    "over-prediction": lambda rng: Adversary(
        int(rng.choice([MULTIPLE, PLAIN])), float(rng.uniform(1.5, 10.0))
    ),
    "white noise": lambda rng: Adversary(WHITE, _log_uniform(rng, 1e-2, 1e3), seed=_seed(rng)),
    "constant": lambda rng: Adversary(CONSTANT, _sign(rng) * _log_uniform(rng, 0.1, 1e3)),
    "exponential": lambda rng: Adversary(
        EXPONENTIAL, _sign(rng) * _log_uniform(rng, 1e-3, 1.0), float(rng.uniform(1.0, 30.0))
    ),
    "delay": lambda rng: Adversary(
        DELAYED, float(rng.uniform(0.5, 1.5)), delay=round(_log_uniform(rng, 1.0, 5000.0))
    ),
    "minus u": lambda rng: Adversary(MINUS_U, float(rng.uniform(0.3, 2.0))),
    "sign flips": lambda rng: Adversary(
        FLIPPING, float(rng.uniform(0.5, 2.0)), _log_uniform(rng, 0.1, 20.0), seed=_seed(rng)
    ),
    "NaN and Inf": lambda rng: Adversary(
        int(rng.choice([NAN, INF])),
        float(rng.uniform(0.5, 1.2)),
        _log_uniform(rng, 0.05, 30.0),
        seed=_seed(rng),
    ),
    "Algorithm 1": lambda rng: BatchGradient(_log_uniform(rng, 1e-7, 1.0)),
    "turncoat": lambda rng: Turncoat(
        Kalman() if rng.random() < 0.5 else Harmonic(),
        float(rng.uniform(20.0, 130.0)),
        float(rng.choice([-3.0, -1.0, 1.5, 3.0, 10.0])),
    ),
    "random features": lambda rng: Adversary(
        FEATURES, weights=tuple((rng.normal(size=6) * _log_uniform(rng, 0.1, 10.0)).tolist())
    ),
}
KINDS = tuple(_DRAWS)


def draw(kind: str, rng: np.random.Generator) -> Learner:
    """Return a random adversary of a kind."""
    return _DRAWS[checks.one_of("kind", kind, KINDS)](rng)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1, 2**31 - 1))
