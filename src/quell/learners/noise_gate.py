"""What of the state and the control signal stands clear of noise.

The observer's estimates of higher derivatives are noisy, and at rest all of them are nothing but noise. A regression on noise finds
something, slowly and confidently. So a signal counts as moving only while its variance is ``CLEAR²`` times what the measurement noise,
seen in y − x̂_1, puts into it; rounding counts as noise too. Of a signal that does not move its running mean is shown. Means are
exponential ones, over ten lags of the observer.

The same noise is in what is to be learned, f as the observer shows it, and there it grows with the power n + 1 of omega_o. ``trust`` weighs
it with what a motion at a frequency of the plant would show, ``F = ω^n |x_1|``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quell.kernels.dispatch import kernel
from quell.observers.eso import ESO
from quell.observers.noise import noise_gains
from quell.types import Vector

# How many times its noise a signal must be. White noise of each sample makes 1, noise held for ten samples 3.
CLEAR = 6.0
# So many standard deviations of noise count against what is to be learned.
_SURE = 3.0
# No sensor resolves better than this share of what it measures.
RESOLUTION = 1e-8
# Means are taken over so many lags of the observer.
AVERAGE = 10.0


class Sight(NamedTuple):
    """Parameters, for a plant of order n."""

    threshold: Vector
    """Least variance of x_1 … x_n and u, in units of that of y − x̂_1 (n + 1,)."""
    forget: float
    """dt over the averaging time."""
    f_noise: float
    """Variance that white noise of unit variance in y leaves in f̂."""
    power: float
    """ω^n."""


class SightMemory(NamedTuple):
    """State."""

    mean: Vector
    """Of x_1 … x_n and u (n + 1,)."""
    variance: Vector
    """(n + 1,)."""
    noise: Vector
    """(2,): mean square of y − x̂_1; how much of the mean is filled."""


def noise_shown(observer: ESO) -> Vector:
    """Return ``noise_gains``, as multiples of what ``y − x̂_1`` shows of the noise in y.

    Raises
    ------
    ValueError
        for an observer of reduced form, whose x̂_1 is y: what is noise can not be told there.
    """
    if observer.form == "reduced":
        raise ValueError(
            "form = 'reduced': x̂_1 = y shows this learner no noise to tell motion from; use form='current'"
        )
    return noise_gains(observer)


def sight(observer: ESO, frequency: float) -> Sight:
    """Return the thresholds for an observer and a frequency the plant has [rad/s]."""
    noise = noise_shown(observer)
    f_noise = float(noise[-1])
    noise[-1] /= observer.b0**2  # what noise leaves in f̂ is also in b0 u
    return Sight(
        CLEAR**2 * noise,
        -math.expm1(-observer.dt / (AVERAGE * observer.lag_time)),
        f_noise,
        frequency**observer.f_degree,
    )


def sight_memory(order: int) -> SightMemory:
    """Return a state before anything was seen."""
    return SightMemory(np.zeros(order + 1), np.zeros(order + 1), np.zeros(2))


@kernel
def look(sight: Sight, memory: SightMemory, seen: Vector, y: float, u: float) -> bool:
    """Take note of a sample; return whether anything moves."""
    rounding, error = RESOLUTION * y, y - seen[0]
    memory.noise[0] += sight.forget * (error * error + rounding * rounding - memory.noise[0])
    memory.noise[1] += sight.forget * (1.0 - memory.noise[1])
    order = memory.mean.size - 1
    moves = False
    for i in range(order + 1):
        away = (seen[i] if i < order else u) - memory.mean[i]
        memory.mean[i] += sight.forget * away
        memory.variance[i] += sight.forget * (away * away - memory.variance[i])
        # u alone does not count: without a motion it is an answer to a load.
        moves = moves or (i < order and is_clear(sight, memory, i))
    return moves


@kernel
def is_clear(sight: Sight, memory: SightMemory, i: int) -> bool:
    """Return whether signal ``i`` moves."""
    return memory.variance[i] * memory.noise[1] > sight.threshold[i] * memory.noise[0]


@kernel
def clear_of_noise(sight: Sight, memory: SightMemory, i: int, value: float) -> float:
    """Return ``value`` of signal ``i``, or its mean where it does not move."""
    return value if is_clear(sight, memory, i) else memory.mean[i]


@kernel
def trust(sight: Sight, memory: SightMemory, size: float) -> float:
    """Return the share of F² in ``F² + (3σ)²``, σ being the noise in f; ``size`` is that of x_1."""
    motion = sight.power * size
    noise = _SURE * _SURE * sight.f_noise * memory.noise[0]
    return motion * motion * memory.noise[1] / (motion * motion * memory.noise[1] + noise)


@kernel
def look_anew(memory: SightMemory) -> None:
    """Go back to the state before anything was seen."""
    for i in range(memory.mean.size):
        memory.mean[i] = memory.variance[i] = 0.0
    memory.noise[0] = memory.noise[1] = 0.0
