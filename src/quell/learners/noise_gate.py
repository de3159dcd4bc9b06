"""A gate that separates motion from measurement noise.

The observer's estimates of higher derivatives are noisy, and at rest they are only noise. From
noise, a regression slowly learns coefficients that mean nothing. So a signal counts as moving only
while its variance exceeds ``SIGNAL_TO_NOISE²`` times the variance that measurement noise, estimated
from y − x̂_1, causes in it; rounding counts as noise. Otherwise it is replaced by its running mean,
an exponential one over ``AVERAGING_LAGS`` lags of the observer.

The same noise is in the learning target f̂, where it grows with the power n + 1 of omega_o.
``confidence`` compares it with what a motion at a frequency ω of the plant would show,
``F = ω^n |x_1|``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single
from quell.kernels.sums import add_small
from quell.observers.eso import ESO
from quell.observers.noise import noise_gains
from quell.types import Vector

# Least ratio of a moving signal's standard deviation to that of its noise. White noise has ratio 1,
# noise that is constant for ten samples 3; with a margin of two above that, not tuned further.
SIGNAL_TO_NOISE = 6.0
# Standard deviations of noise in f that ``confidence`` counts: a three-sigma bound.
_NOISE_DEVIATIONS = 3.0
# Rounding in y counts as noise of this share of y: no sensor resolves better. In single precision
# y itself is rounded, by 2⁻²⁶ to 2⁻²⁵ of it in the root mean square.
_RESOLUTION, _RESOLUTION_SINGLE = 1e-8, 2.0**-25
# Averaging time of means and variances in lags of the observer; chosen by hand, not tuned further.
AVERAGING_LAGS = 10.0


class NoiseGate(NamedTuple):
    """Parameters for a plant of order n."""

    # Least variance of moving x_1 … x_n and u, in units of the variance of y − x̂_1 (n + 1,).
    threshold: Vector
    forget: float  # dt over the averaging time
    f_noise: float  # variance that white noise of unit variance in y causes in f̂
    power: float  # ω^n


class NoiseGateMemory(NamedTuple):
    """Running means of the signals and of the noise."""

    mean: Vector  # of x_1 … x_n and u (n + 1,); in single precision with carries (2n + 2,)
    variance: Vector  # (n + 1,)
    noise: Vector  # (2,): mean square of y − x̂_1; sum of its weights, which grows from 0 to 1


def relative_noise(observer: ESO) -> Vector:
    """Return the variances of noise in x̂ and f̂ (n + 1,), in units of that of ``y − x̂_1``.

    Raises ``ValueError`` for an observer of reduced form: its x̂_1 is y, so y − x̂_1 does not show
    the noise.
    """
    if observer.form == "reduced":
        raise ValueError(
            "form = 'reduced': x̂_1 = y, so this learner cannot separate motion from noise; "
            "use form='current'"
        )
    return noise_gains(observer)


def noise_gate(observer: ESO, frequency: float) -> NoiseGate:
    """Return the gate for an observer and a frequency of the plant [rad/s]."""
    noise = relative_noise(observer)
    f_noise = float(noise[-1])
    noise[-1] /= observer.b0**2  # noise in f̂ reaches u through u = −f̂/b0
    return NoiseGate(
        SIGNAL_TO_NOISE**2 * noise,
        -math.expm1(-observer.dt / (AVERAGING_LAGS * observer.lag_time)),
        f_noise,
        frequency**observer.f_degree,
    )


def noise_gate_memory(order: int) -> NoiseGateMemory:
    """Return the state before the first sample."""
    return NoiseGateMemory(np.zeros(order + 1), np.zeros(order + 1), np.zeros(2))


@kernel
def resolution(like: float) -> float:
    """Return the share of y that counts as rounding, in the precision of ``like``."""
    return _RESOLUTION_SINGLE if is_single(like) else _RESOLUTION


@kernel
def grown(weight: float, forget: float) -> float:
    """Return the sum of weights of an exponential mean after a sample; it grows from 0 to 1."""
    more = weight + forget * (1.0 - weight)
    # Rounding would stop it before, and all means would be too large.
    return 1.0 if is_single(weight) and more == weight else more


@kernel
def update_gate(gate: NoiseGate, memory: NoiseGateMemory, seen: Vector, y: float, u: float) -> bool:
    """Update the means with a sample; return whether any state moves."""
    rounding, error = resolution(gate.forget) * y, y - seen[0]
    memory.noise[0] += gate.forget * (error * error + rounding * rounding - memory.noise[0])
    memory.noise[1] = grown(memory.noise[1], gate.forget)
    size = memory.variance.size
    order = size - 1
    moves = False
    for i in range(order + 1):
        away = (seen[i] if i < order else u) - memory.mean[i]
        add_small(memory.mean, size, i, gate.forget * away)
        memory.variance[i] += gate.forget * (away * away - memory.variance[i])
        # u alone does not count: without motion it is the answer to a load.
        moves = moves or (i < order and is_moving(gate, memory, i))
    return moves


@kernel
def is_moving(gate: NoiseGate, memory: NoiseGateMemory, i: int) -> bool:
    """Return whether signal ``i`` moves."""
    return memory.variance[i] * memory.noise[1] > gate.threshold[i] * memory.noise[0]


@kernel
def gated(gate: NoiseGate, memory: NoiseGateMemory, i: int, value: float) -> float:
    """Return ``value`` of signal ``i`` if it moves, else its mean."""
    return value if is_moving(gate, memory, i) else memory.mean[i]


@kernel
def confidence(gate: NoiseGate, memory: NoiseGateMemory, size: float) -> float:
    """Return ``F²/(F² + (3σ)²)`` with the noise σ in f; ``size`` is that of x_1."""
    motion = gate.power * size
    noise = _NOISE_DEVIATIONS * _NOISE_DEVIATIONS * gate.f_noise * memory.noise[0]
    return motion * motion * memory.noise[1] / (motion * motion * memory.noise[1] + noise)


@kernel
def reset_gate(memory: NoiseGateMemory) -> None:
    """Go back to the state before the first sample."""
    for i in range(memory.mean.size):
        memory.mean[i] = 0.0
    for i in range(memory.variance.size):
        memory.variance[i] = 0.0
    memory.noise[0] = memory.noise[1] = 0.0
