"""Recursive least squares on the strongest of many features, O(p + k²) a sample.

Of p features k are *active*: least squares (``least_squares.py``) finds their coefficients θ. What
these leave of the target, normalised gradient descent assigns to the others,

    ψ ← ψ + rate dt · φ ε'/(ρ + φ·φ),        ε' = target − θ·φ − ψ·φ

where θ and ψ are zero for the features that the other has. ψ only ranks them: f_L contains θ alone.
Once in an interval the inactive feature with the largest ``|ψ|`` takes the place of the active one
with the smallest ``|θ|``, if it is more than twice as large; features are O(1), so coefficients can
be compared. This is orthogonal matching pursuit (Pati, Rezaiifar & Krishnaprasad, Asilomar 1993)
over data that keep coming: an exchange can be undone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import kernel
from quell.kernels.scalars import Scalars
from quell.learners.least_squares import RlsRule, excess_share, least_squares_gain
from quell.learners.regression.kernels import reset_uncertainty, share_excess, update_theta
from quell.types import Matrix, Vector

# An inactive feature must be so many times stronger than the active one that it replaces: less, and
# features that are equally strong would change places all the time. Chosen by hand.
_STRONGER = 2.0
# Interval of exchanges in lags of the observer: in it least squares finds a new coefficient. Of 3,
# 10 and 50 lags the best for 16 of 180 waves of cogging at 0.03 to 1 rev/s (benchmarks/cogging.py).
EXCHANGE_LAGS = 50.0
# ρ: far below φ·φ of many features of O(1).
_FLOOR = 1e-3


class SelectionRule(NamedTuple):
    """Parameters."""

    rls: RlsRule
    gain: float  # rate · dt
    interval: int  # samples between exchanges


class SelectionLoop(Scalars):
    """Scalars of the selection."""

    samples: float  # since the last exchange


class SelectionMemory(NamedTuple):
    """State besides θ, for k active ones of p features."""

    active: Vector  # indices of the active features (k,)
    inactive: Vector  # (p,): 1 if a feature is inactive, else 0
    weak: Vector  # ψ (p,)
    chosen: Vector  # work space for the active features (k,)
    covariance: Matrix  # P (k, k)
    gain: Vector  # work space (k,)
    loop: NDArray[SelectionLoop]


def selection_memory(rule: SelectionRule, count: int, features: int) -> SelectionMemory:
    """Return the state before anything is learned: ``count`` of the features are active."""
    inactive = np.ones(features)
    inactive[:count] = 0.0
    return SelectionMemory(
        active=np.arange(float(count)),
        inactive=inactive,
        weak=np.zeros(features),
        chosen=np.zeros(count),
        covariance=rule.rls.prior * np.eye(count),
        gain=np.zeros(count),
        loop=SelectionLoop.zeros(),
    )


@update_theta.register(SelectionRule)
def _update_theta(
    rule: SelectionRule,
    memory: SelectionMemory,
    theta: Vector,
    features: Vector,
    error: float,
    confidence: float,
) -> None:
    chosen, gain = memory.chosen, memory.gain
    left, power = error, _FLOOR
    for i in range(theta.size):
        left -= memory.weak[i] * features[i]
        power += memory.inactive[i] * features[i] * features[i]
    step = rule.gain * confidence * left / power
    for i in range(theta.size):
        memory.weak[i] += step * memory.inactive[i] * features[i]
    for k in range(chosen.size):
        chosen[k] = features[int(memory.active[k])]
    noise = rule.rls.noise / confidence
    inverse = least_squares_gain(rule.rls, memory.covariance, gain, chosen, noise)
    for k in range(chosen.size):
        theta[int(memory.active[k])] += gain[k] * inverse * error
    memory.loop[0].samples += 1.0
    if memory.loop[0].samples >= rule.interval:
        memory.loop[0].samples = 0.0
        _exchange(rule, memory, theta)


@kernel
def _exchange(rule: SelectionRule, memory: SelectionMemory, theta: Vector) -> None:
    """Let the strongest inactive feature take the place of the weakest active one."""
    place = enters = 0
    for k in range(memory.active.size):
        if abs(theta[int(memory.active[k])]) < abs(theta[int(memory.active[place])]):
            place = k
    for i in range(theta.size):
        if abs(memory.weak[i]) > abs(memory.weak[enters]):
            enters = i
    leaves = int(memory.active[place])
    if not abs(memory.weak[enters]) > _STRONGER * abs(theta[leaves]):
        return
    memory.active[place] = enters
    memory.inactive[enters], memory.inactive[leaves] = 0.0, 1.0
    theta[enters], memory.weak[leaves] = memory.weak[enters], theta[leaves]
    memory.weak[enters] = theta[leaves] = 0.0
    for k in range(memory.active.size):
        memory.covariance[place, k] = memory.covariance[k, place] = 0.0
    memory.covariance[place, place] = rule.rls.prior


@reset_uncertainty.register(SelectionRule)
def _reset_uncertainty(rule: SelectionRule, memory: SelectionMemory) -> None:
    for i in range(memory.weak.size):
        memory.weak[i] = 0.0
    for i in range(memory.covariance.shape[0]):
        for j in range(memory.covariance.shape[1]):
            memory.covariance[i, j] = rule.rls.prior if i == j else 0.0


@share_excess.register(SelectionRule)
def _share_excess(
    rule: SelectionRule, memory: SelectionMemory, theta: Vector, i: int, excess: float
) -> None:
    for k in range(memory.active.size):
        if int(memory.active[k]) == i and memory.covariance[k, k] > 0.0:
            for j in range(memory.active.size):
                share = excess_share(memory.covariance, k, j)
                theta[int(memory.active[j])] -= share * excess
