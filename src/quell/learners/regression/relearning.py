"""Least squares that starts again where its error shows that the plant has changed.

The uncertainty P of least squares shrinks with the data. So after an abrupt change, for example of
the origin of a position, θ follows with the memory time at best, and where the data of that time do
not excite all features much later. Setting P back to the prior keeps θ as the first guess, but
learns from new data as quickly as at the start (covariance resetting: Goodwin & Sin, *Adaptive
Filtering, Prediction and Control*, Prentice Hall 1984, section 3.4).

A change is concluded where the mean square of the error over a short time is larger by a factor
than its usual size, which follows a larger error slowly, and a smaller one very slowly.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from numpy.typing import NDArray

from quell.kernels.dispatch import kernel
from quell.kernels.scalars import Scalars, clear
from quell.learners.regression.kernels import reset_uncertainty, share_excess, update_theta
from quell.types import Vector

# The short time in lags of the observer: the error of one sample is noise. Chosen by hand.
_SHORT_LAGS = 5.0
# The usual size follows a larger error in so many short times, so that an abrupt change exceeds it,
# and a smaller one in so many units of 1/omega_c. Chosen by hand (benchmarks/cogging.py).
_RISE, _DECAY = 10.0, 1000.0


class RelearningRule(NamedTuple):
    """Parameters."""

    inner: Any  # the rule that finds θ
    ratio: float  # least ratio of mean squares that is a change
    short: float  # dt over the short time
    rise: float  # share by which the usual mean square follows a larger one in a sample
    decay: float  # the same for a smaller one


class RelearningLoop(Scalars):
    """Scalars of the comparison."""

    error: float  # mean square of the error over the short time
    usual: float  # its usual size


class RelearningMemory(NamedTuple):
    """State besides θ."""

    inner: Any
    loop: NDArray[RelearningLoop]


def relearning_rule(
    inner: Any, ratio: float, dt: float, lag_time: float, omega_c: float
) -> RelearningRule:
    """Return the rule for a least ``ratio`` of RMS errors; times in s, ``omega_c`` in rad/s."""
    times = (_SHORT_LAGS * lag_time, _RISE * _SHORT_LAGS * lag_time, _DECAY / omega_c)
    short, rise, decay = (-math.expm1(-dt / time) for time in times)
    return RelearningRule(inner, ratio * ratio, short, rise, decay)


@update_theta.register(RelearningRule)
def _update_theta(
    rule: RelearningRule,
    memory: RelearningMemory,
    theta: Vector,
    features: Vector,
    error: float,
    confidence: float,
) -> None:
    if _has_changed(rule, memory, error):
        reset_uncertainty(rule.inner, memory.inner)
    update_theta(rule.inner, memory.inner, theta, features, error, confidence)


@kernel
def _has_changed(rule: RelearningRule, memory: RelearningMemory, error: float) -> bool:
    loop = memory.loop[0]
    loop.error += rule.short * (error * error - loop.error)
    changed = loop.usual > 0.0 and loop.error > rule.ratio * loop.usual
    larger = loop.error > loop.usual
    loop.usual += (loop.error - loop.usual) * (rule.rise if larger else rule.decay)
    return changed


@reset_uncertainty.register(RelearningRule)
def _reset_uncertainty(rule: RelearningRule, memory: RelearningMemory) -> None:
    clear(memory.loop)
    reset_uncertainty(rule.inner, memory.inner)


@share_excess.register(RelearningRule)
def _share_excess(
    rule: RelearningRule, memory: RelearningMemory, theta: Vector, i: int, excess: float
) -> None:
    share_excess(rule.inner, memory.inner, theta, i, excess)
