"""``RLS``: recursive least squares, with directional forgetting, relearning and selection.

Recursive least squares with directional forgetting, O(p²) a sample.

With ``ζ = φ·Pφ/R`` and ``λ = exp(−dt/T)`` for the memory time T,

    θ ← θ + Pφ ε / (R (1 + ζ)),      P ← P − c Pφ (Pφ)ᵀ,      c = (λ − (1−λ)/ζ) / (R λ (1 + ζ))

Only what is known along φ is forgotten: after a sample the uncertainty along φ is ``ζ/(λ(1 + ζ))``,
and orthogonal to φ it is unchanged. With exponential forgetting of everything, P grows without
bound along directions that are not excited, and a closed loop in normal operation excites few. A
small φ still increases P slowly, so P stops growing when its trace reaches that of the prior.

Least squares that starts again where its error shows that the plant has changed.

The uncertainty P of least squares shrinks with the data. So after an abrupt change, for example of
the origin of a position, θ follows with the memory time at best, and where the data of that time do
not excite all features much later. Setting P back to the prior keeps θ as the first guess, but
learns from new data as quickly as at the start (covariance resetting: Goodwin & Sin, *Adaptive
Filtering, Prediction and Control*, Prentice Hall 1984, section 3.4).

A change is concluded where the mean square of the error over a short time is larger by a factor
than its usual size, which follows a larger error slowly, and a smaller one very slowly.

Recursive least squares on the strongest of many features, O(p + k²) a sample.

Of p features k are *active*: least squares finds their coefficients θ. What
these leave of the target, normalised gradient descent assigns to the others,

    ψ ← ψ + rate dt · φ ε'/(ρ + φ·φ),        ε' = target − θ·φ − ψ·φ

where θ and ψ are zero for the features that the other has. ψ only ranks them: f_L contains θ alone.
Once in an interval the inactive feature with the largest ``|ψ|`` takes the place of the active one
with the smallest ``|θ|``, if it is more than twice as large; features are O(1), so coefficients can
be compared. This is orthogonal matching pursuit (Pati, Rezaiifar & Krishnaprasad, Asilomar 1993)
over data that keep coming: an exchange can be undone.

Recursive least squares as a rule of linear learners.

The variance of noise is ``R = τ/dt`` with the observer's lag τ = N/omega_o, because the noise in f̂
is correlated over that time; so the result does not depend on dt. R is larger where measurement
noise hides what is to be learned (``confidence`` of ``learners/base.py``).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.features import Features, Joined, Periodic
from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single
from quell.kernels.single import add_symmetrically
from quell.kernels.sized import Scalars, Work, clear
from quell.learners.recall import RecallMemory, RecallRule, recall_memory, recall_rule
from quell.learners.regression import (
    GAIN_INTERVAL,
    Linear,
    reset_uncertainty,
    share_excess,
    update_theta,
)
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# ---- Recursive least squares with directional forgetting, O(p²) a sample ----

# A larger φ·Pφ could overflow in what follows; in single precision earlier.
_LARGEST_SPREAD, _LARGEST_SPREAD_SINGLE = 1e100, 1e15


class RlsRule(NamedTuple):
    """Parameters."""

    noise: float  # R
    forget: float  # 1 − λ
    prior: float  # variance of θ before anything is known


@kernel
def excess_share(covariance: Matrix, i: int, j: int) -> float:
    """Return how much θ_j must change with θ_i, which a limit moves by one: ``P_ij / P_ii``.

    The nearest θ in the metric of P⁻¹, for which the data are as likely as they can be: Simon &
    Chia, "Kalman filtering with state equality constraints", *IEEE Trans. Aerospace and Electronic
    Systems* 38, 2002, eq. (13). If θ_i alone were cut off, the error that this leaves would move
    the others in every sample.
    """
    return float(covariance[max(i, j), min(i, j)] / covariance[i, i])


@kernel
def reduce_row(covariance: Matrix, i: int, share: float, gain: Vector) -> None:
    """Subtract ``share · gain`` from row ``i`` of P; after all rows P is less by ``g (Pφ)ᵀ``.

    Rounding makes P asymmetric, and the asymmetric part does not shrink with the data. In single
    precision it would exceed what the data leave of P, so there only the lower triangle exists.
    """
    if is_single(share):
        for j in range(i + 1):
            add_symmetrically(covariance, i, j, -share * gain[j])
    else:
        for j in range(covariance.shape[0]):
            covariance[i, j] -= share * gain[j]


@kernel
def multiply_lower(covariance: Matrix, features: Vector, gain: Vector) -> None:
    """Write Pφ into ``gain`` for a P of which only the lower triangle exists."""
    for i in range(gain.size):
        total = 0.0
        for j in range(i):
            total += covariance[i, j] * features[j]
            gain[j] += covariance[i, j] * features[i]
        gain[i] = total + covariance[i, i] * features[i]


@kernel
def least_squares_gain(
    rule: RlsRule, covariance: Matrix, gain: Vector, features: Vector, noise: float
) -> float:
    """Update P for a sample with the variance R = ``noise``.

    Write Pφ into ``gain`` and return its factor ``1/(R (1 + ζ))`` in the update of θ.
    """
    size = gain.size
    spread = trace = length = 0.0
    for i in range(size):
        total = 0.0
        for j in range(size):
            total += covariance[i, j] * features[j]
        gain[i] = total
        spread += total * features[i]
        length += total * total
        trace += covariance[i, i]
    largest = _LARGEST_SPREAD_SINGLE if is_single(rule.prior) else _LARGEST_SPREAD
    if not 0.0 < spread < largest:  # φ is zero, or P is no covariance any more: learn nothing
        for i in range(size):
            gain[i] = 0.0  # zero times what is not finite would be NaN
        return 0.0
    inverse = 1.0 / (noise + spread)
    share = (1.0 - rule.forget - rule.forget * noise / spread) * inverse / (1.0 - rule.forget)
    if share < 0.0 and trace - share * length > rule.prior * size:
        share = 0.0
    for i in range(size):
        part = share * gain[i]
        for j in range(i + 1):
            value = covariance[i, j] - part * gain[j]
            covariance[i, j] = covariance[j, i] = value
    return inverse


# ---- Least squares that starts again where its error shows that the plant has changed ----

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


# ---- Recursive least squares on the strongest of many features, O(p + k²) a sample ----

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
    chosen: Work  # work space for the active features (k,)
    covariance: Matrix  # P (k, k)
    gain: Work  # work space (k,)
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


@kernel
def _active(memory: SelectionMemory, k: int) -> int:
    """Return the index of active feature ``k``; it is that of a feature whatever the state has."""
    return min(max(int(memory.active[k]), 0), memory.weak.size - 1)


@update_theta.register(SelectionRule)
def _update_theta_selection(
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
        chosen[k] = features[_active(memory, k)]
    noise = rule.rls.noise / confidence
    inverse = least_squares_gain(rule.rls, memory.covariance, gain, chosen, noise)
    for k in range(chosen.size):
        theta[_active(memory, k)] += gain[k] * inverse * error
    memory.loop[0].samples += 1.0
    if memory.loop[0].samples >= rule.interval:
        memory.loop[0].samples = 0.0
        _exchange(rule, memory, theta)


@kernel
def _exchange(rule: SelectionRule, memory: SelectionMemory, theta: Vector) -> None:
    """Let the strongest inactive feature take the place of the weakest active one."""
    place = enters = 0
    for k in range(memory.active.size):
        if abs(theta[_active(memory, k)]) < abs(theta[_active(memory, place)]):
            place = k
    for i in range(theta.size):
        if abs(memory.weak[i]) > abs(memory.weak[enters]):
            enters = i
    leaves = _active(memory, place)
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
def _reset_uncertainty_selection(rule: SelectionRule, memory: SelectionMemory) -> None:
    for i in range(memory.weak.size):
        memory.weak[i] = 0.0
    for i in range(memory.covariance.shape[0]):
        for j in range(memory.covariance.shape[1]):
            memory.covariance[i, j] = rule.rls.prior if i == j else 0.0


@share_excess.register(SelectionRule)
def _share_excess_selection(
    rule: SelectionRule, memory: SelectionMemory, theta: Vector, i: int, excess: float
) -> None:
    for k in range(memory.active.size):
        if _active(memory, k) == i and memory.covariance[k, k] > 0.0:
            for j in range(memory.active.size):
                share = excess_share(memory.covariance, k, j)
                theta[_active(memory, j)] -= share * excess


# ---- Recursive least squares as a rule of linear learners ----

# Default of memory_time in units of 1/omega_c; chosen by hand, not tuned further.
_MEMORY = 100.0


class RlsMemory(NamedTuple):
    """State besides θ."""

    covariance: Matrix  # P (p, p)
    gain: Work  # work space for Pφ (p,)


@update_theta.register(RlsRule)
def _update_theta_rls(
    rule: RlsRule,
    memory: RlsMemory,
    theta: Vector,
    features: Vector,
    error: float,
    confidence: float,
) -> None:
    covariance, gain = memory.covariance, memory.gain
    inverse = least_squares_gain(rule, covariance, gain, features, rule.noise / confidence)
    for i in range(theta.size):
        theta[i] += gain[i] * inverse * error


@reset_uncertainty.register(RlsRule)
def _reset_uncertainty_rls(rule: RlsRule, memory: RlsMemory) -> None:
    for i in range(memory.covariance.shape[0]):
        for j in range(memory.covariance.shape[1]):
            memory.covariance[i, j] = rule.prior if i == j else 0.0


@share_excess.register(RlsRule)
def _share_excess_rls(
    rule: RlsRule, memory: RlsMemory, theta: Vector, i: int, excess: float
) -> None:
    if memory.covariance[i, i] > 0.0:
        for j in range(theta.size):
            theta[j] -= excess_share(memory.covariance, i, j) * excess


def _periodic_blocks(features: Features) -> list[tuple[list[Features], Periodic]]:
    """Return the blocks that are periodic in position, each with the blocks before it."""
    blocks: list[Features] = []
    waiting = [features]
    while waiting:
        block = waiting.pop(0)
        if isinstance(block, Joined):
            waiting = [block.first, block.second, *waiting]
        else:
            blocks.append(block)
    found = enumerate(blocks)
    return [(blocks[:i], block) for i, block in found if isinstance(block, Periodic)]


def _finite_or(time: float | None, default: float) -> float:
    """Return a time that is given and finite, or the default [s]."""
    return default if time is None or not math.isfinite(time) else time


class RLS(Linear):
    """Recursive least squares on any features, with a memory of limited length.

    Parameters
    ----------
    memory_time
        T, the time after which a sample has the weight 1/e [s]; ``inf`` forgets nothing,
        ``100/omega_c`` by default.
    prior
        standard deviation of θ before anything is known; features and f are O(1).
    strongest
        number of features that are used at once, the strongest of all that are given; all by
        default. With many features it saves time and noise; others have the
        coefficient zero.
    relearn
        ratio of the RMS error to its usual size from which the plant counts as changed: then θ is
        learned again as quickly as at the start, for example 4; by default
        never.
    recall
        whether the position has another origin after each start from rest, as that of an encoder
        without index pulse. The map of the ``Periodic`` features, of which there must be one block,
        is then looked for at all shifts and is used again within half a period, if it fits
        (``learners/recall.py``); else it is learned anew.

    The other parameters are described in the base classes ``Linear`` and ``FeatureLearner``.

    Raises
    ------
    ValueError
        for an argument out of range.

    References
    ----------
    Kulhavý & Kárný, *Tracking of slowly varying parameters by directional forgetting*, IFAC World
    Congress 1984; Ljung & Söderström, *Theory and Practice of Recursive Identification*, MIT Press
    1983.
    """

    def __init__(
        self,
        features: Features | None = None,
        *,
        memory_time: float | None = None,
        prior: float = 10.0,
        strongest: int | None = None,
        relearn: float | None = None,
        recall: bool = False,
        frequency: float | None = None,
        scale: Any = None,
        gain_interval: tuple[float, float] = GAIN_INTERVAL,
        bias_bandwidth: float | None = None,
    ) -> None:
        super().__init__(features, frequency, scale, gain_interval, bias_bandwidth)
        self.memory_time = checks.optional(checks.time_constant, "memory_time", memory_time)
        self.prior = checks.positive("prior", prior)
        self.strongest = checks.optional(checks.whole, "strongest", strongest, 1)
        self.relearn = checks.optional(checks.positive, "relearn", relearn)
        if self.relearn is not None and self.relearn <= 1.0:
            raise ValueError(f"relearn = {relearn!r}: must be greater than 1, the usual error")
        self.recall = checks.flag("recall", recall)
        if self.recall and self.strongest is not None:
            raise ValueError(
                f"recall = True, strongest = {strongest!r}: a map is recalled as a whole; leave "
                "one of them out, or name the map's orders, Periodic(orders=...)"
            )
        if self.recall and len(_periodic_blocks(self.features)) != 1:
            raise ValueError(
                "recall = True: the features must have one block Periodic, whose map is looked "
                "for, for example features=Periodic(orders=(7, 28)) + Bias()"
            )

    def rule(self, observer: ESO, omega_c: float, features: int) -> Any:
        """Return noise, forgetting and prior, and how features are selected and learned again."""
        dt, lag_time = observer.dt, observer.lag_time
        forget = -math.expm1(-dt / (self.memory_time or _MEMORY / omega_c))
        rule: Any = RlsRule(lag_time / dt, forget, self.prior**2)
        if self.strongest is not None and self.strongest >= features:
            raise ValueError(
                f"strongest = {self.strongest}: has no effect, as there are {features} features; "
                "leave it out, or give fewer"
            )
        if self.strongest is not None:
            interval = round(EXCHANGE_LAGS * lag_time / dt)
            rule = SelectionRule(rule, min(omega_c * dt, 1.0), max(interval, 1))
        if self.relearn is not None:
            rule = relearning_rule(rule, self.relearn, dt, lag_time, omega_c)
        if not self.recall:
            return rule
        (before, block), order = _periodic_blocks(self.features)[0], observer.order
        first = sum(len(each.names(order)) for each in before)
        constant, orders = self.features.constant(order), block.design(order).orders
        follow = -math.expm1(-dt / _finite_or(self.memory_time, _MEMORY / omega_c))
        return recall_rule(rule, first, constant, orders, follow)

    def rule_memory(
        self, rule: Any, features: int
    ) -> RlsMemory | SelectionMemory | RelearningMemory | RecallMemory:
        """Return the prior covariance and work space."""
        if isinstance(rule, RecallRule):
            return recall_memory(self.rule_memory(rule.inner, features), rule, features)
        if isinstance(rule, RelearningRule):
            inner = self.rule_memory(rule.inner, features)
            return RelearningMemory(inner, RelearningLoop.zeros())
        if isinstance(rule, SelectionRule):
            return selection_memory(rule, self.strongest or features, features)
        return RlsMemory(rule.prior * np.eye(features), np.zeros(features))
