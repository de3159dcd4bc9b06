"""Hostile learners, which a guard has to withstand.

One type serves for most of them, so that a trial compiles once; ``kind`` selects the behaviour.
Algorithm 1 is the real one (``learners.BatchGradient``), and ``Turncoat`` is a ``Kalman`` or
``Harmonic`` learner that turns hostile later.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.experiments.stress.turncoat import Turncoat
from quell.kernels.dispatch import kernel
from quell.kernels.sized import Buffer
from quell.learners import BatchGradient, Harmonic, Kalman, Learner
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
from quell.types import Vector

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
def _adapt(
    learner: AdversaryDesign,
    memory: AdversaryMemory,
    seen: Vector,
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
def _predict(
    learner: AdversaryDesign, memory: AdversaryMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    kind, size, now = learner.kind, learner.size, memory.now
    n = seen.size - 1
    f_hat = seen[n] + now[_F_L]
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
            out += learner.weights[i] * seen[i]
    return out, 0.0


@commit.register(AdversaryDesign)
def _commit(
    learner: AdversaryDesign, memory: AdversaryMemory, seen: Vector, u: float, f_learned: float
) -> None:
    at = int(memory.now[_AT])
    memory.past[at] = seen[seen.size - 1] + f_learned
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
        _one_of(rng, NAN, INF),
        rng.uniform(0.5, 1.2),
        log_uniform(rng, 0.05, 30.0),
        seed=_seed(rng),
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
