"""A hostile learner that knows plant and load: it earns trust with f, and spends it on harm.

For ``certified_attack.py``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell.kernels.sized import Buffer
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
from quell.lti.models import System
from quell.observers.eso import ESO
from quell.types import Matrix, Vector


class SpenderDesign(NamedTuple):
    """Parameters."""

    lag: Any
    load: Buffer  # of each sample [y-unit/s^n]
    gain_error: float  # b − b0
    push: Buffer  # what it adds to g^F, in units of the largest |q| so far; NaN while it earns


class SpenderMemory(NamedTuple):
    """State."""

    chain: Matrix  # lag filters of f_plain and of g
    now: Vector  # (5,): f_plain^F, g^F, g, largest |q|, number of samples


class Spender:
    """A learner that returns f, or ``g^F + push e``, so that a guard gets ``e_L = push e`` to see.

    Parameters
    ----------
    load, push
        a value for each sample; where ``push`` is NaN it returns f.
    gain_error
        b − b0 of a chain of integrators.
    """

    def __init__(self, load: Any, push: Any, gain_error: float) -> None:
        self.load, self.push = np.array(load, dtype=float), np.array(push, dtype=float)
        self.gain_error = gain_error

    def design(self, observer: ESO, omega_c: float) -> SpenderDesign:
        """Return the parameters."""
        return SpenderDesign(lag_of(observer), self.load, self.gain_error, self.push)

    def memory(self, parameters: SpenderDesign) -> SpenderMemory:
        """Return the state at rest."""
        return SpenderMemory(lag_memory(parameters.lag, 2), np.zeros(5))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names."""
        return ()


def draw_push(rng: np.random.Generator, pulse: Vector, samples: int, lag: float) -> Vector:
    """Return what a random spender adds to g^F, in units of the largest |q| so far (samples,).

    It earns for 20 to 60 lags of the observer, and then pushes in stages with the signs of the
    pulse response backwards, the worst for q at the end of a stage; in half of the draws it earns
    again between them.

    Parameters
    ----------
    rng
        of the draw.
    pulse
        response of q to a pulse of the correction.
    samples
        of the run.
    lag
        N/omega_o [samples].
    """
    push = np.full(samples, np.nan)
    at, length = round(rng.uniform(20.0, 60.0) * lag), round(rng.uniform(0.3, 12.0) * lag)
    # A guard clips what is larger than 1.2 e, or does not listen to what is far larger.
    size, turn = (
        rng.choice([0.5, 1.0, 1.2, 2.0, 2.9]) * rng.choice([-1.0, 1.0]),
        rng.choice([-1, 1]),
    )
    rest = round(rng.uniform(0.0, 10.0) * lag) * int(rng.integers(2))
    backwards = np.sign(pulse[:length][::-1])
    while at < samples:
        stage = push[at : at + length]
        stage[:] = size * backwards[: stage.size]
        at += length + rest
        size *= turn
    return push


@adapt.register(SpenderDesign)
def _adapt(
    learner: SpenderDesign,
    memory: SpenderMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    now = memory.now
    now[3] = max(now[3], abs(f_plain - now[0]))
    now[0] = lag_push(learner.lag, memory.chain, 0, f_plain)


@predict.register(SpenderDesign)
def _predict(
    learner: SpenderDesign, memory: SpenderMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    now = memory.now
    at = min(int(now[4]), learner.push.size - 1)
    push = learner.push[at]
    now[2] = now[1] + push * now[3]
    if np.isnan(push):
        now[2] = learner.load[min(at, learner.load.size - 1)] + learner.gain_error * u_before
    return now[2], 0.0


@commit.register(SpenderDesign)
def _commit(
    learner: SpenderDesign, memory: SpenderMemory, estimates: Vector, u: float, f_learned: float
) -> None:
    now = memory.now
    now[1] = lag_push(learner.lag, memory.chain, 1, now[2])
    now[4] += 1.0


restart.register(SpenderDesign)(nothing_to_restart)
coefficients.register(SpenderDesign)(no_coefficients)


def pulse_response(system: System, samples: int) -> Vector:
    """Return ``D, C B, C A B, …`` (samples,)."""
    N, B, C, D = System.balanced(*system)
    found, x = np.zeros(samples), B.copy()
    found[:1] = D
    for k in range(1, samples):
        found[k] = C @ x
        x = x + N @ x
    return found
