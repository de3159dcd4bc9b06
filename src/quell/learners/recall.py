"""A map that is periodic in position, found again after a start whose origin is another one.

An encoder without index pulse counts from where the axis stands when the power comes. A map
``f = Σ a_m sin(mρx) + b_m cos(mρx)`` that was learned before is then shifted by an unknown angle φ:
with x' = x + φ/ρ the same force has the coefficients

    a'_m = a_m cos(mφ) + b_m sin(mφ),        b'_m = b_m cos(mφ) − a_m sin(mφ)

So a single number has to be found instead of all of them. After a start from rest the map is set
aside, θ is zero and is learned anew; meanwhile sums of the filtered pairs ψ and of the target z,
less the share of other features, are kept about their means (Welford, *Technometrics* 4, 1962).
What the map shifted by φ leaves of the target, with any constant, is

    E(φ) = S_zz − 2 θ(φ)·S_ψz + θ(φ)·S_ψψ θ(φ)

which is the squares of z times ``1 − c²`` where c is the correlation, if the size of the map is
right. One shift is tried in a sample: 8 for each wave of the highest order, then 17 about the best
with an eighth of the distance, and 17 with an eighth of that.

*The decision.* From a quarter of a period on the best shift is accepted if ``E ≤ min(0.02 S_zz + 2
n e², 0.1 S_zz)``, where e² is the mean square of the error before the stop and n the number of
samples. The true shift of a measured map of cogging leaves 0.004 of its squares at most; of 4000
maps with the same amplitudes and random phases 2 to 7 leave less than 0.02 after a quarter or half
of a revolution (``benchmarks/lost_index.py``). A map of two or three orders fits such data more
often; what is accepted then leaves as little of f. If no shift is accepted within half a period,
the map is forgotten, and what is learned anew stays: the load is another one. Least squares go on
from the map that was found, and a guard judges its output all the time as that of any learner.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import kernel
from quell.kernels.functions import cos, sin
from quell.kernels.sized import Scalars, Size, Work, clear
from quell.learners.regression import (
    convert_rule,
    forget_rule,
    reset_uncertainty,
    restart_rule,
    share_excess,
    update_theta,
)
from quell.types import Matrix, Vector

# Shifts for each wave of the highest order: at the worst one, that order is wrong by a fifth of its
# amplitude. And the factor of the two finer passes, each of so many shifts to either side.
_PER_WAVE, _FINER = 8, 8
# Passes: all shifts, finer ones, finest ones.
_PASSES = 3
# Share of a period from which a shift is accepted, and by which one must be found.
_LEAST, _MOST = 0.25, 0.5
# Limits of the decision, see above.
_SHARE, _USUAL, _LARGEST = 0.02, 2.0, 0.1


class RecallRule(NamedTuple):
    """Parameters for a map of k orders among p features."""

    inner: Any  # the rule that finds θ
    first: Size  # index in θ of the first pair
    constant: Size  # index in θ of the constant 1; −1 without one
    orders: NDArray[np.int64]  # m (k,), increasing
    shifts: int  # of a pass over the whole period
    follow: float  # dt over the time of the mean square of the error


class RecallLoop(Scalars):
    """Scalars of the search."""

    searching: float  # 1 while the map is set aside
    usual: float  # mean square of the error, in units of the scaled f
    count: float  # samples in the sums
    average: float  # of the target
    squares: float  # of the target about its mean
    sine: float  # the first pair in the last sample
    cosine: float
    turned: float  # angle by which it has turned since the start [rad]
    low: float  # least of ``turned``
    high: float  # largest of ``turned``
    stage: float  # of the passes
    at: float  # number of the shift in the pass
    centre: float  # about which a finer pass looks [rad]
    best: float  # shift that leaves least in this pass [rad]
    left: float  # what it leaves


class RecallMemory(NamedTuple):
    """State besides θ."""

    inner: Any
    stored: Vector  # θ before the start (p,)
    shifted: Work  # work space for the pairs of a shifted map (2k,)
    means: Vector  # of the filtered pairs (2k,)
    away: Work  # work space (2k,)
    products: Vector  # S_ψz (2k,)
    moments: Matrix  # S_ψψ, the lower triangle (2k, 2k)
    loop: NDArray[RecallLoop]  # (1,)


def recall_rule(
    inner: Any, first: int, constant: int, orders: NDArray[np.int64], follow: float
) -> RecallRule:
    """Return the rule for pairs from index ``first`` on, of the given orders."""
    return RecallRule(inner, first, constant, orders, _PER_WAVE * int(orders[-1]), follow)


def recall_memory(inner: Any, rule: RecallRule, features: int) -> RecallMemory:
    """Return the state before anything is learned."""
    pairs = 2 * rule.orders.size
    return RecallMemory(
        inner=inner,
        stored=np.zeros(features),
        shifted=np.zeros(pairs),
        means=np.zeros(pairs),
        away=np.zeros(pairs),
        products=np.zeros(pairs),
        moments=np.zeros((pairs, pairs)),
        loop=RecallLoop.zeros(),
    )


@update_theta.register(RecallRule)
def _update_theta(
    rule: RecallRule,
    memory: RecallMemory,
    theta: Vector,
    features: Vector,
    error: float,
    confidence: float,
) -> None:
    loop = memory.loop[0]
    if loop.searching == 0.0:
        loop.usual += rule.follow * (error * error - loop.usual)
        update_theta(rule.inner, memory.inner, theta, features, error, confidence)
        return
    target = error
    for i in range(theta.size):
        target += theta[i] * features[i]
    update_theta(rule.inner, memory.inner, theta, features, error, confidence)
    _add(rule, memory, features, target)
    if _try_shift(rule, memory):
        _decide(rule, memory, theta)


@kernel
def _add(rule: RecallRule, memory: RecallMemory, features: Vector, target: float) -> None:
    """Add a sample to the sums about the means, and follow the angle."""
    loop, means, away, size = memory.loop[0], memory.means, memory.away, memory.means.size
    for i in range(memory.stored.size):
        if (i < rule.first or i >= rule.first + size) and i != rule.constant:
            target -= memory.stored[i] * features[i]
    loop.count += 1.0
    before = target - loop.average
    loop.average += before / loop.count
    after = target - loop.average
    loop.squares += before * after
    for i in range(size):
        away[i] = features[rule.first + i] - means[i]
    for i in range(size):
        means[i] += away[i] / loop.count
        new = features[rule.first + i] - means[i]
        memory.products[i] += new * before
        for j in range(i + 1):
            memory.moments[i, j] += new * away[j]
    sine, cosine = features[rule.first], features[rule.first + 1]
    power = sine * sine + cosine * cosine + loop.sine * loop.sine + loop.cosine * loop.cosine
    if loop.count > 1.0 and power > 0.0:
        # The sine of the angle, which is small in a sample, and never larger than the angle.
        loop.turned += 2.0 * (sine * loop.cosine - cosine * loop.sine) / power
        loop.low, loop.high = min(loop.low, loop.turned), max(loop.high, loop.turned)
    loop.sine, loop.cosine = sine, cosine


@kernel
def _shift(rule: RecallRule, memory: RecallMemory, shift: float) -> None:
    """Write the pairs of the map, shifted by an angle, into ``memory.shifted``."""
    for k in range(rule.orders.size):
        angle = float(rule.orders[k]) * shift
        sine, cosine = sin(angle), cos(angle)
        a, b = memory.stored[rule.first + 2 * k], memory.stored[rule.first + 2 * k + 1]
        memory.shifted[2 * k] = a * cosine + b * sine
        memory.shifted[2 * k + 1] = b * cosine - a * sine


@kernel
def _left(memory: RecallMemory) -> float:
    """Return what the shifted map leaves of the squares of the target."""
    shifted = memory.shifted
    total = memory.loop[0].squares
    for i in range(shifted.size):
        inside = memory.moments[i, i] * shifted[i] - 2.0 * memory.products[i]
        for j in range(i):
            inside += 2.0 * memory.moments[i, j] * shifted[j]
        total += shifted[i] * inside
    return total


@kernel
def _try_shift(rule: RecallRule, memory: RecallMemory) -> bool:
    """Try the next shift; return whether it was the last of the finest pass."""
    loop = memory.loop[0]
    step = 2.0 * math.pi / rule.shifts
    if loop.stage > 0.0:
        step = step / _FINER if loop.stage < 2.0 else step / (_FINER * _FINER)
    shift = loop.centre + step * loop.at
    _shift(rule, memory, shift)
    left = _left(memory)
    if loop.left < 0.0 or left < loop.left:
        loop.best, loop.left = shift, max(left, 0.0)
    loop.at += 1.0
    last = float(rule.shifts - 1) if loop.stage == 0.0 else float(_FINER)
    if loop.at <= last:
        return False
    loop.stage += 1.0
    if loop.stage < _PASSES:
        loop.centre, loop.at, loop.left = loop.best, -float(_FINER), -1.0
        return False
    return True


@kernel
def _decide(rule: RecallRule, memory: RecallMemory, theta: Vector) -> None:
    """Use the map with the best shift, or forget it, or look again with more samples."""
    loop = memory.loop[0]
    span = (loop.high - loop.low) / (2.0 * math.pi * float(rule.orders[0]))
    most = _SHARE * loop.squares + _USUAL * loop.usual * loop.count
    fits = loop.left <= min(most, _LARGEST * loop.squares)
    if span >= _LEAST and fits:
        _shift(rule, memory, loop.best)
        constant = loop.average
        for i in range(memory.shifted.size):
            constant -= memory.shifted[i] * memory.means[i]
        for i in range(theta.size):
            theta[i] = memory.stored[i]
        for i in range(memory.shifted.size):
            theta[rule.first + i] = memory.shifted[i]
        if rule.constant >= 0:
            theta[rule.constant] = constant
        loop.searching = 0.0
        # What was learned anew began in the transient of the start.
        reset_uncertainty(rule.inner, memory.inner)
    elif span >= _MOST:
        loop.searching = loop.usual = 0.0
    _begin_passes(loop)


@kernel
def _begin_passes(loop: RecallLoop) -> None:
    loop.stage = loop.at = loop.centre = loop.best = 0.0
    loop.left = -1.0


@kernel
def _clear_sums(memory: RecallMemory) -> None:
    loop = memory.loop[0]
    loop.count = loop.average = loop.squares = 0.0
    loop.sine = loop.cosine = loop.turned = loop.low = loop.high = 0.0
    for i in range(memory.means.size):
        memory.means[i] = memory.products[i] = 0.0
        for j in range(memory.means.size):
            memory.moments[i, j] = 0.0
    _begin_passes(loop)


@reset_uncertainty.register(RecallRule)
def _reset_uncertainty(rule: RecallRule, memory: RecallMemory) -> None:
    _clear_sums(memory)
    reset_uncertainty(rule.inner, memory.inner)


@restart_rule.register(RecallRule)
def _restart(rule: RecallRule, memory: RecallMemory, theta: Vector) -> None:
    """Set the map aside, if there is one; a search that has not ended begins again."""
    loop = memory.loop[0]
    if loop.searching == 0.0:
        for i in range(rule.first, rule.first + memory.means.size):
            if theta[i] != 0.0:
                loop.searching = 1.0
        if loop.searching == 0.0:
            return
        for i in range(theta.size):
            memory.stored[i] = theta[i]
    for i in range(theta.size):
        theta[i] = 0.0
    reset_uncertainty(rule, memory)


@forget_rule.register(RecallRule)
def _forget(rule: RecallRule, memory: RecallMemory) -> None:
    clear(memory.loop)
    for i in range(memory.stored.size):
        memory.stored[i] = 0.0
    _clear_sums(memory)
    forget_rule(rule.inner, memory.inner)


@convert_rule.register(RecallRule)
def _convert(rule: RecallRule, memory: RecallMemory, ratio: float) -> None:
    loop = memory.loop[0]
    for i in range(memory.stored.size):
        memory.stored[i] *= ratio
    loop.usual *= ratio * ratio
    _clear_sums(memory)
    convert_rule(rule.inner, memory.inner, ratio)


@share_excess.register(RecallRule)
def _share_excess(
    rule: RecallRule, memory: RecallMemory, theta: Vector, i: int, excess: float
) -> None:
    share_excess(rule.inner, memory.inner, theta, i, excess)
