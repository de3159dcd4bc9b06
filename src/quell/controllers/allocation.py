"""From what the axes ask for to what the actuators do: B0, its inverse, and limits.

The axes are ``y_i^(n_i) = f_i + (B0 u)_i``, B0 (n, m). Each asks for its own input v_i, with a gain
b0_i of its own, ``y_i^(n_i) = f_i + b0_i v_i``, so that ``v = diag(1/b0) B0 u``; in what follows B0
stands for that product, which is 1 for one axis with the b0 of its actuator. With the weights W of
the actuators (diagonal) and a wished u_r, the u that comes nearest to u_r is

    u = u_r + B0⁺ (v − B0 u_r),        B0⁺ = W⁻¹ B0ᵀ (B0 W⁻¹ B0ᵀ)⁻¹

which is ``B0⁻¹ v`` for as many actuators as axes. Every observer then receives (B0 u)_i with the u
that was applied after all limits (docs/axes).

*Limits.* In a sample each actuator has a range, from its limits of magnitude and of rate. What to
do with a u outside of it:

``"each"``
    cut each actuator by itself. With more actuators than axes the others make up for those that
    are cut: u is the weighted least-squares solution within the range,

        min  γ Σ_i ((B0 u − v)_i / ‖B0_i‖)² + Σ_k W_k (u_k − u_r,k)²,      γ = 10⁸

    with W of largest entry 1, by an active set (Härkegård, *IEEE Conf. Decision and Control* 2002,
    "Efficient active set algorithms for solving constrained least squares problems in aircraft
    control allocation"). Rows are scaled, so axes in metres and radians count alike.
``"direction"``
    go from the point of the range that is nearest to u_r towards u as far as the range allows: v
    keeps its direction.
axes in order of priority
    weighted least squares within the range, as with ``"each"``, in which the square of what an axis
    misses counts ρ times that of the next one in the order (Smeur, Höppener & De Wagter, *Int.
    Micro Air Vehicle Conf.* 2017, "Prioritized control allocation for quadrotors subject to
    saturation"),

        min  γ Σ_i ρ^(n−place_i) ((B0 u − v̄)_i / ‖B0_i‖)² + Σ_k W_k (u_k − u_r,k)²,
        γ = 10⁶, ρ = 10² up to three axes, ρ^(n−1) = 10⁴ from then on

    v̄_i is v_i within what the range allows axis i alone: an axis that asks for ten times of what
    there is does not count ten times. An actuator is taken from the later axes for the sake of an
    earlier one, unless it gives that less than about 1/√ρ = 0.1 of what its own actuators do. In
    the trial of a quadrotor ρ from 10 to 1000 gives one result to 2 % (docs/axes).

The sum of squares is not formed, it would need twice the digits: the rows of all axes are turned
into a triangle. In single precision u then differs from double by less than 10⁻⁵ of its range in
99.9 % of drawn cases (``benchmarks/axes.py --part single``).

*B0 as a function* of the estimates, or its inverse M, is evaluated in each sample. One that is not
finite or has no inverse is not used: the last good one stays, and the status has ``GAIN_HELD``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types as nb_types

from quell import checks
from quell.controllers.base import RateLimit, checked_limits
from quell.kernels import user_functions
from quell.kernels.dispatch import generic, is_finite, kernel
from quell.kernels.frozen import frozen, kept_code
from quell.kernels.functions import is_single, sqrt
from quell.kernels.sized import Buffer, Flag, Work
from quell.kernels.user_functions import POINTER, call
from quell.learners.base import meaning
from quell.types import Matrix, Status, Vector, warn

_SATURATED = int(Status.SATURATED)
_RATE_LIMITED = int(Status.RATE_LIMITED)
_OVERFLOWED = int(Status.OVERFLOWED)
_GAIN_HELD = int(Status.GAIN_HELD)

# Condition number of B0, each axis and each actuator scaled to one, from which a warning is issued:
# an error of a percent in B0 then makes one of 30 % in a direction of v. And that from which B0
# counts as singular. Chosen by hand.
_POOR, _SINGULAR = 30.0, 1e8
# Weight of what the axes miss over that of u, and rounds of the active set for each actuator: it
# ends by itself after about as many as there are actuators. An actuator is freed if its slope is
# above this share of its parts. Chosen by hand.
_GAMMA, _ROUNDS, _RELEASE, _RELEASE_SINGLE = 1e8, 4, 1e-12, 1e-6
# By priority: the weight of the last axis over that of u, that of an axis over the next one, and
# at most that of the first over the last, so that u has digits left. Chosen by hand.
_GAMMA_LAST, _RANK, _ALL_RANKS = 1e6, 1e2, 1e4
# The least square of a pivot of the factor, so that it is never divided by zero.
_TINY, _TINY_SINGLE = 1e-300, 1e-30
# A pivot below this share of the largest entry of a matrix that a function returned counts as zero.
_LEAST_PIVOT = 1e-12


class GainMemory(NamedTuple):
    """B0 of the present sample, with its inverse and room to calculate it."""

    B: Matrix  # (n, m)
    inverse: Matrix  # B0⁺ (m, n)
    fresh: Work  # what a function returned (n, m), or M (n, n)
    work: Work  # (n, 2 n)


@kernel
def apply_to_axes(memory: GainMemory, u: Vector, v: Vector) -> None:
    """Write ``B0 u`` into ``v``."""
    for i in range(v.size):
        v[i] = 0.0
        for k in range(u.size):
            v[i] += memory.B[i, k] * u[k]


class ConstantGain(NamedTuple):
    """A constant B0: the memory has it from the start."""

    B0: Matrix  # (n, m)


class FunctionGain(NamedTuple):
    """B0, or its inverse M, as a function of the estimates, by address."""

    address: int
    is_inverse: Flag
    weights: Vector  # of the actuators (m,)
    numbers: Buffer  # parameters of the function


@meaning.register(FunctionGain)
def _meaning(gain: FunctionGain) -> Any:
    return gain.address, gain.is_inverse, *([gain.numbers] if gain.numbers.size else [])


@kernel
def inverted(matrix: Matrix, work: Matrix, inverse: Matrix) -> bool:
    """Write the inverse of a square matrix by Gauss-Jordan elimination; return whether it has one.

    ``work`` has room for (n, 2 n) numbers.
    """
    n = matrix.shape[0]
    largest = 0.0
    for i in range(n):
        for j in range(n):
            if not is_finite(matrix[i, j]):
                return False
            largest = max(largest, abs(matrix[i, j]))
            work[i, j] = matrix[i, j]
            work[i, n + j] = 1.0 if i == j else 0.0
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(work[i, k]) > abs(work[pivot, k]):
                pivot = i
        if not abs(work[pivot, k]) > _LEAST_PIVOT * largest:
            return False
        for j in range(2 * n):
            swapped = work[k, j]
            work[k, j] = work[pivot, j]
            work[pivot, j] = swapped
        scale = 1.0 / work[k, k]
        for j in range(2 * n):
            work[k, j] *= scale
        for i in range(n):
            if i != k:
                factor = work[i, k]
                for j in range(2 * n):
                    work[i, j] -= factor * work[k, j]
    for i in range(n):
        for j in range(n):
            inverse[i, j] = work[i, n + j]
    return True


@generic
def update_gain(gain: Any, memory: GainMemory, x: Matrix) -> int:
    """Set B0 for the estimates ``x[axis, derivative]``; return the status flag."""
    raise TypeError


@update_gain.register(ConstantGain)
def _constant(gain: ConstantGain, memory: GainMemory, x: Matrix) -> int:
    return 0


@update_gain.register(FunctionGain)
def _by_function(gain: FunctionGain, memory: GainMemory, x: Matrix) -> int:
    call(gain.address, x, gain.numbers, memory.fresh)
    n, m = memory.B.shape
    fresh = memory.fresh
    if n == m:
        target = memory.B if gain.is_inverse else memory.inverse
        if not inverted(fresh, memory.work, target):
            return _GAIN_HELD
        kept = memory.inverse if gain.is_inverse else memory.B
        for i in range(n):
            for j in range(n):
                kept[i, j] = fresh[i, j]
        return 0
    if not weighted_inverse(fresh, gain.weights, memory.work, memory.inverse):
        weighted_inverse(memory.B, gain.weights, memory.work, memory.inverse)
        return _GAIN_HELD
    for i in range(n):
        for j in range(m):
            memory.B[i, j] = fresh[i, j]
    return 0


@kernel
def weighted_inverse(B: Matrix, weights: Vector, work: Matrix, inverse: Matrix) -> bool:
    """Write ``W⁻¹ Bᵀ (B W⁻¹ Bᵀ)⁻¹`` (m, n), m ≥ n; return False if there is none.

    Then ``inverse`` is of no use.
    """
    n, m = B.shape
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(m):
                total += B[i, k] * B[j, k] / weights[k]
            inverse[j, i] = total  # m ≥ n: room for (n, n)
    if not inverted(inverse[:n], work, inverse[:n]):
        return False
    for i in range(n):
        for j in range(n):
            work[i, j] = inverse[i, j]
    for k in range(m):
        for j in range(n):
            total = 0.0
            for i in range(n):
                total += B[i, k] * work[i, j]
            inverse[k, j] = total / weights[k]
    return True


# ---- Limits ----


class ActuatorLimits(NamedTuple):
    """Limits of magnitude and of the change in a sample of each actuator (m,)."""

    low: Vector
    high: Vector
    most_change: Vector
    least_change: Vector


class RangeMemory(NamedTuple):
    """The range of the actuators in a sample, and room to calculate."""

    low: Work  # (m,)
    high: Work  # (m,)
    step: Work  # (m,)
    rest: Work  # v that is left (n,)
    target: Work  # v that the least squares go for (n,), as rows for those that solve any
    row: Work  # weight of what an axis misses (n,)
    free: Work  # (m,) 1 for actuators that are not at an end of their range
    turned: Work  # an axis while it is turned into the triangle (m,)
    R: Work  # triangle of the free actuators (m, m)


def range_memory(n: int, m: int, rule: Any) -> RangeMemory:
    """Return room for n axes, m actuators and what is done at the limits."""
    solves = isinstance(rule, ByPriority) or (m > n and isinstance(rule, CutEach))
    k, rows = (m, n) if solves else (0, 0)
    low, high, step, free, turned = (np.zeros(size) for size in (m, m, m, k, k))
    rest, target, row = (np.zeros(size) for size in (n, rows, rows))
    return RangeMemory(low, high, step, rest, target, row, free, turned, np.zeros((k, k)))


class CutEach(NamedTuple):
    """Each actuator is cut by itself."""

    wished: Vector  # u_r (m,), empty for as many actuators as axes: zero
    weights: Vector  # (m,)


class KeepDirection(NamedTuple):
    """All actuators are scaled together."""

    wished: Vector  # as for CutEach


class ByPriority(NamedTuple):
    """What an earlier axis misses counts more than what a later one does."""

    wished: Vector  # as for CutEach
    weights: Vector  # (m,)
    order: Any  # axes, the most important first (n,), integers
    rank: float  # how much more it counts than what the next one misses


@kernel
def set_range(limits: ActuatorLimits, before: Vector, memory: RangeMemory) -> None:
    """Set the range of each actuator after ``before``; limits of magnitude go before those of rate.

    As for one actuator, u is within its limits even if it has to change faster for that.
    """
    for i in range(before.size):
        low, high = limits.low[i], limits.high[i]
        memory.low[i] = min(max(before[i] + limits.least_change[i], low), high)
        memory.high[i] = max(min(before[i] + limits.most_change[i], high), low)


@kernel
def _clamped(memory: RangeMemory, i: int, wish: float) -> float:
    """Return the value within the range of actuator i that is nearest to a wish."""
    value = wish
    if value > memory.high[i]:
        value = memory.high[i]
    elif value < memory.low[i]:
        value = memory.low[i]
    return value


@kernel
def _cut(memory: RangeMemory, limits: ActuatorLimits, i: int, wish: float) -> tuple[float, int]:
    """Return a value of actuator i within its range, and the flag of what cut it.

    It is always a number: without one it is that of rest, as for one actuator.
    """
    value, flag = wish, 0
    if value > memory.high[i]:
        value = memory.high[i]
        flag = _SATURATED if value == limits.high[i] else _RATE_LIMITED
    elif value < memory.low[i]:
        value = memory.low[i]
        flag = _SATURATED if value == limits.low[i] else _RATE_LIMITED
    if not is_finite(value):
        value, flag = min(max(0.0, limits.low[i]), limits.high[i]), _OVERFLOWED
    return value, flag


@kernel
def cut_to_range(limits: ActuatorLimits, before: Vector, memory: RangeMemory, u: Vector) -> int:
    """Cut each control signal in ``u`` to its range after ``before``; return the flags."""
    set_range(limits, before, memory)
    flags = 0
    for k in range(u.size):
        u[k], cut = _cut(memory, limits, k, u[k])
        flags |= cut
    return flags


@kernel
def _wish(memory: GainMemory, wished: Vector, v: Vector, rest: Vector, u: Vector) -> None:
    """Write ``u_r + B0⁺ (v − B0 u_r)`` into ``u`` (m,)."""
    n, m = memory.B.shape
    for i in range(n):
        rest[i] = v[i]
        for k in range(wished.size):
            rest[i] -= memory.B[i, k] * wished[k]
    for k in range(m):
        u[k] = wished[k] if wished.size > 0 else 0.0
        for i in range(n):
            u[k] += memory.inverse[k, i] * rest[i]


@generic
def allocate(
    rule: Any,
    limits: ActuatorLimits,
    gain: GainMemory,
    memory: RangeMemory,
    v: Vector,
    before: Vector,
    u: Vector,
) -> int:
    """Write the control signals ``u`` (m,) for ``v`` (n,) after ``before``; return the flags."""
    raise TypeError


@allocate.register(CutEach)
def _cut_each(
    rule: CutEach,
    limits: ActuatorLimits,
    gain: GainMemory,
    memory: RangeMemory,
    v: Vector,
    before: Vector,
    u: Vector,
) -> int:
    n, m = gain.B.shape
    _wish(gain, rule.wished, v, memory.rest, u)
    flags = cut_to_range(limits, before, memory, u)
    usable = flags & _OVERFLOWED == 0
    for i in range(n):
        usable = usable and is_finite(v[i])
    if m > n and flags != 0 and usable:
        for i in range(n):
            memory.target[i], memory.row[i] = v[i], _GAMMA
        flags |= _least_squares(rule.wished, rule.weights, limits, gain, memory, u)
    return flags


@kernel
def _least_squares(
    wished: Vector,
    weights: Vector,
    limits: ActuatorLimits,
    gain: GainMemory,
    memory: RangeMemory,
    u: Vector,
) -> int:
    """Write the least-squares solution within the range into ``u``, which begins inside of it.

    The memory has the target of v and the weight of each axis. In each round the solution for the
    actuators that are free is found. Either one of them meets the end of its range and is free no
    more, or one that is at an end and wants to go back is freed (Nocedal & Wright, *Numerical
    Optimization*, algorithm 16.3). What the axes miss
    is followed by the steps of u: as a difference of B0 u and v it would be rounding where it is
    small. Return the flag of a u that is no number.
    """
    n, m = gain.B.shape
    free = memory.free
    release = _RELEASE_SINGLE if is_single(u[0]) else _RELEASE
    largest = 0.0
    for k in range(m):
        largest = max(largest, weights[k])
        free[k] = 1.0 if memory.low[k] < u[k] < memory.high[k] else 0.0
    for i in range(n):
        size = 0.0
        memory.rest[i] = -memory.target[i]
        for k in range(m):
            size += gain.B[i, k] * gain.B[i, k]
            memory.rest[i] += gain.B[i, k] * u[k]
        memory.row[i] = sqrt(memory.row[i] / size)
    for _ in range(_ROUNDS * m):
        _solve_rows(wished, weights, largest, gain, memory, u)
        share, end = 1.0, -1
        for k in range(m):
            step = memory.step[k]
            room = memory.high[k] - u[k] if step > 0.0 else memory.low[k] - u[k]
            if free[k] != 0.0 and abs(step) * share > abs(room):
                share, end = room / step, k
        for k in range(m):
            if free[k] != 0.0:
                step = share * memory.step[k]
                u[k] = min(max(u[k] + step, memory.low[k]), memory.high[k])
                for i in range(n):
                    memory.rest[i] += gain.B[i, k] * step
        if end >= 0:
            u[end] = memory.high[end] if memory.step[end] > 0.0 else memory.low[end]
            free[end] = 0.0
            continue
        worst, wish = -1, 0.0
        for k in range(m):
            if free[k] == 0.0 and memory.low[k] < memory.high[k]:
                point = wished[k] if wished.size > 0 else 0.0
                slope = weights[k] / largest * (u[k] - point)
                least = release * abs(slope)
                for i in range(n):
                    part = memory.row[i] * memory.rest[i] * (memory.row[i] * gain.B[i, k])
                    slope += part
                    least += release * abs(part)
                back = -slope if u[k] <= memory.low[k] else slope
                if back > max(wish, least):
                    worst, wish = k, back
        if worst < 0:
            break
        free[worst] = 1.0
    flags = 0
    for k in range(m):
        u[k], cut = _cut(memory, limits, k, u[k])
        flags |= cut & _OVERFLOWED
    return flags


@kernel
def _solve_rows(
    wished: Vector,
    weights: Vector,
    largest: float,
    gain: GainMemory,
    memory: RangeMemory,
    u: Vector,
) -> None:
    """Write the step of u to the least sum of squares of the free actuators, else 0.

    By a triangle R and rotations (Golub & Van Loan, *Matrix Computations*, 5.3 and 5.1.8): it
    begins with the weights of u, and each axis is turned into it. The sum of squares itself would
    need twice the digits.
    """
    n, m = gain.B.shape
    R, row, step, free = memory.R, memory.turned, memory.step, memory.free
    for k in range(m):
        point = wished[k] if wished.size > 0 else 0.0
        R[k, k] = sqrt(weights[k] / largest)
        step[k] = R[k, k] * (point - u[k]) if free[k] != 0.0 else 0.0
        for j in range(k + 1, m):
            R[k, j] = 0.0
    for i in range(n):
        missed = -memory.row[i] * memory.rest[i]
        for k in range(m):
            row[k] = memory.row[i] * gain.B[i, k]
        for k in range(m):
            if free[k] == 0.0:
                continue
            square = R[k, k] * R[k, k] + row[k] * row[k]
            long = sqrt(max(square, _TINY_SINGLE if is_single(square) else _TINY))
            c, s = R[k, k] / long, row[k] / long
            R[k, k] = long
            for j in range(k + 1, m):
                before = R[k, j]
                R[k, j] = c * before + s * row[j]
                row[j] = c * row[j] - s * before
            before = step[k]
            step[k] = c * before + s * missed
            missed = c * missed - s * before
    for k in range(m - 1, -1, -1):
        if free[k] != 0.0:
            for j in range(k + 1, m):
                step[k] -= R[k, j] * step[j]
            step[k] /= R[k, k]


@kernel
def solve_free(H: Matrix, L: Matrix, slope: Vector, free: Vector, step: Vector) -> None:
    """Write the solution of ``H step = −slope`` for the free actuators, by Cholesky; else 0."""
    m = slope.size
    for i in range(m):
        step[i] = 0.0
        if free[i] == 0.0:
            continue
        total = -slope[i]
        for j in range(i + 1):
            if free[j] == 0.0:
                continue
            entry = H[i, j]
            for k in range(j):
                if free[k] != 0.0:
                    entry -= L[i, k] * L[j, k]
            if j < i:
                L[i, j] = entry / L[j, j]
                total -= L[i, j] * step[j]
            else:
                L[i, i] = sqrt(max(entry, _TINY_SINGLE if is_single(entry) else _TINY))
        step[i] = total / L[i, i]
    for i in range(m - 1, -1, -1):
        if free[i] == 0.0:
            continue
        for j in range(i + 1, m):
            if free[j] != 0.0:
                step[i] -= L[j, i] * step[j]
        step[i] /= L[i, i]


@kernel
def _share_within(memory: RangeMemory, i: int, at: float, share: float) -> float:
    """Return how much of a share of ``memory.step`` from ``at`` keeps actuator i in its range."""
    step = memory.step[i]
    if step > memory.high[i] - at:
        return min(share, max(memory.high[i] - at, 0.0) / step)
    if step < memory.low[i] - at:
        return min(share, max(at - memory.low[i], 0.0) / -step)
    return share


@kernel
def _go(memory: RangeMemory, limits: ActuatorLimits, share: float, u: Vector) -> int:
    """Move u by a share of ``memory.step``, the largest that its range allows; return the flags."""
    flags = 0
    for k in range(u.size):
        value = _clamped(memory, k, u[k] + share * memory.step[k])
        if not is_finite(value):
            value = min(max(0.0, limits.low[k]), limits.high[k])
            flags |= _OVERFLOWED
        u[k] = value
    if share < 1.0:
        for k in range(u.size):
            if u[k] == memory.high[k] or u[k] == memory.low[k]:
                at_end = u[k] == limits.high[k] or u[k] == limits.low[k]
                flags |= _SATURATED if at_end else _RATE_LIMITED
        if flags == 0:  # rounding left u just inside of the range
            flags = _SATURATED
    return flags


@allocate.register(KeepDirection)
def _keep_direction(
    rule: KeepDirection,
    limits: ActuatorLimits,
    gain: GainMemory,
    memory: RangeMemory,
    v: Vector,
    before: Vector,
    u: Vector,
) -> int:
    set_range(limits, before, memory)
    _wish(gain, rule.wished, v, memory.rest, u)
    flags, share = 0, 1.0
    for k in range(u.size):
        wish = u[k]
        if not is_finite(wish):
            wish = 0.0
            flags |= _OVERFLOWED
        u[k] = _clamped(memory, k, rule.wished[k] if rule.wished.size > 0 else 0.0)
        memory.step[k] = wish - u[k]
        share = _share_within(memory, k, u[k], share)
    return flags | _go(memory, limits, share, u)


@allocate.register(ByPriority)
def _by_priority(
    rule: ByPriority,
    limits: ActuatorLimits,
    gain: GainMemory,
    memory: RangeMemory,
    v: Vector,
    before: Vector,
    u: Vector,
) -> int:
    n, m = gain.B.shape
    set_range(limits, before, memory)
    for k in range(m):
        u[k] = _clamped(memory, k, rule.wished[k] if rule.wished.size > 0 else 0.0)
    flags = 0
    for i in range(n):
        memory.target[i] = v[i]
        if not is_finite(v[i]):
            flags = _OVERFLOWED
            memory.target[i] = 0.0
            for k in range(m):
                memory.target[i] += gain.B[i, k] * u[k]
    _wish(gain, rule.wished, memory.target, memory.rest, u)
    cut = cut_to_range(limits, before, memory, u)
    if cut == 0:
        return flags
    weight = _GAMMA_LAST
    for back in range(n):
        i = rule.order[n - 1 - back]
        least, most = 0.0, 0.0
        for k in range(m):
            if gain.B[i, k] != 0.0:
                one, other = gain.B[i, k] * memory.low[k], gain.B[i, k] * memory.high[k]
                least += min(one, other)
                most += max(one, other)
        memory.target[i] = min(max(memory.target[i], least), most)
        memory.row[i] = weight
        weight *= rule.rank
    return flags | cut | _least_squares(rule.wished, rule.weights, limits, gain, memory, u)


# ---- What users give, checked ----


def checked_actuator_limits(
    u_min: Any, u_max: Any, rate_limit: Any, count: int, dt: float
) -> ActuatorLimits:
    """Return the limits of ``count`` actuators: one value for all, or one for each."""
    lows, highs = (
        [each] * count if np.ndim(each) == 0 else np.asarray(each).tolist()
        for each in (u_min, u_max)
    )
    rates: Sequence[RateLimit]
    rates = list(rate_limit) if checks.is_sequence(rate_limit) else [rate_limit] * count
    for name, values in (("u_min", lows), ("u_max", highs), ("rate_limit", rates)):
        if len(values) != count:
            raise ValueError(
                f"{name} has {len(values)} values, there are {count} actuators: must be one for "
                "all, or one for each"
            )
    found = []
    for i in range(count):
        try:
            found.append(checked_limits(lows[i], highs[i], rates[i], dt))
        except ValueError as error:
            raise ValueError(f"u[{i}]: {error}") from None
    return ActuatorLimits(*(np.array(part, dtype=float) for part in zip(*found, strict=True)))


def changed_actuator_limits(
    old: ActuatorLimits, u_min: Any, u_max: Any, rate_limit: Any, count: int, dt: float
) -> ActuatorLimits:
    """Return limits with new values for what is not None."""
    low = old.low if u_min is None else u_min
    high = old.high if u_max is None else u_max
    rates = np.inf if rate_limit is None else rate_limit
    new = checked_actuator_limits(low, high, rates, count, dt)
    if rate_limit is None:
        new = new._replace(most_change=old.most_change, least_change=old.least_change)
    return new


class Gain(NamedTuple):
    """B0 as given: the parameters, and the memory before the first sample."""

    design: Any
    code: Any  # the compiled function, kept as long as its address
    shape: tuple[int, int]  # (n, m)
    first: Matrix  # diag(1/b0) B0 before the first sample
    weights: Vector

    def memory(self) -> GainMemory:
        """Return the memory before the first sample."""
        n, m = self.shape
        inverse: Matrix = np.zeros((m, n))
        work = np.zeros((n, 2 * n))
        is_inverse = getattr(self.design, "is_inverse", False)
        if n == m:
            inverse = np.asarray(np.linalg.inv(self.first), dtype=np.float64)
        else:
            weighted_inverse(self.first, self.weights, work, inverse)
        fresh = np.zeros((n, n) if is_inverse else (n, m))
        return GainMemory(self.first.copy(), inverse, fresh, work)


def checked_gain(
    B0: Any,
    M: Any,
    weights: Any,
    names: Sequence[str],
    most: int,
    weighs_change: bool = False,
    b0: Vector | None = None,
) -> Gain:
    """Return ``diag(1/b0) B0`` of axes with these names; B0 is given, or its inverse M.

    Parameters
    ----------
    B0, M
        a matrix or a function of the estimates (n, most), one of them; neither is ``diag(b0)``: an
        actuator for each axis.
    weights
        of the actuators, or None for ones.
    names
        of the n axes.
    most
        largest order of an axis.
    weighs_change
        whether weights have a use with as many actuators as axes, too.
    b0
        of the n axes, the gains of their own inputs; ones by default, and where B0 is a function.

    Raises
    ------
    ValueError
        for both, shapes that do not fit, a matrix that is singular or a function that fails.
    """
    if B0 is not None and M is not None:
        raise ValueError("B0 and M are both given: M is the inverse of B0; give one of them")
    name, given = ("M", M) if M is not None else ("B0", B0)
    n = len(names)
    b0 = np.ones(n) if b0 is None else b0
    if given is None:
        given = np.diag(b0)
    x = np.zeros((n, most))
    if callable(given):
        for axis, own in zip(names, b0, strict=True):
            if own != 1.0:
                raise ValueError(
                    f"axes: {axis} has an observer with b0 = {float(own)!r}: must be 1 where "
                    f"{name} is a function, which knows the gains of the actuators"
                )
        rule = f"it takes x, an array ({n}, {most}) of estimates x[axis, derivative]"
        plain, values = user_functions.separated(name, given, 1)
        frozen(plain)  # compiles helpers again whose globals have changed
        first = user_functions.attempt(f"{name}(zeros)", rule, partial(plain, **values), x)
        first = checks.matrix(f"{name}(zeros)", first)
    else:
        first = checks.matrix(name, given)
    of_axes = ", ".join(names)
    columns = n if name == "M" else first.shape[1]
    if first.shape != (n, columns) or first.shape[1] < n:
        what = "a row and a column" if name == "M" else "a row"
        raise ValueError(
            f"{name} has shape {first.shape}, there are {n} axes ({of_axes}): must have {what} for "
            f"each axis{'' if name == 'M' else ' and at least as many columns, one per actuator'}"
        )
    count = first.shape[1]
    of_actuators = np.ones(count) if weights is None else checks.vector("weights", weights, count)
    if np.any(of_actuators <= 0.0):
        raise ValueError(f"weights = {weights!r}: must be positive")
    if weights is not None and count == n and not weighs_change:
        raise ValueError(
            f"weights = {weights!r}: there are as many actuators as axes, so u has no freedom for "
            "them; leave them out"
        )
    _check_condition(name, first, names)
    start: Matrix = np.asarray(np.linalg.inv(first) if name == "M" else first, dtype=np.float64)
    if not callable(given):
        start = start / b0[:, None]
        return Gain(ConstantGain(start), None, (n, count), start, of_actuators)
    shapes = user_functions.shapes_of(values)
    try:
        code = _compiled_gain(plain, shapes, (n, most), first.shape)
    except user_functions.NotCompilableError as error:
        raise ValueError(
            f"{name} can't be compiled ({error}): it must be a function of numbers and arrays that "
            "returns a matrix, as nested tuples or an array, without Python objects"
        ) from None
    numbers = user_functions.as_array(values)
    design = FunctionGain(code.address, name == "M", of_actuators, numbers)
    return Gain(design, code, (n, count), start, of_actuators)


def _check_condition(name: str, matrix: Matrix, names: Sequence[str]) -> None:
    """Refuse a matrix that is singular, and warn of one that is nearly so.

    Rows and columns are scaled first: axes in metres and radians have B0 of other sizes, which says
    nothing about their coupling.
    """
    scaled: Any = np.array(matrix, dtype=float)
    for _ in range(10):
        for axis in (0, 1):
            size = np.max(np.abs(scaled), axis=axis, keepdims=True)
            if np.any(size == 0.0) and axis == 1:
                row = names[int(np.argmin(size))]
                raise ValueError(f"{name} = {matrix.tolist()!r}: no actuator moves axis {row!r}")
            scaled = scaled / np.sqrt(np.where(size > 0.0, size, 1.0))
    values = np.linalg.svd(scaled, compute_uv=False)
    condition = math.inf if values[-1] == 0.0 else float(values[0] / values[-1])
    if not condition < _SINGULAR:
        raise ValueError(
            f"{name} = {matrix.tolist()!r} is singular (condition number {condition:.3g}, axes and "
            "actuators scaled): the actuators can not move the axes independently"
        )
    if condition > _POOR:
        warn(
            f"{name} is badly conditioned, {condition:.3g} with axes and actuators scaled, above "
            f"{_POOR:g}: an error of 1 % in it makes one of {condition:.0f} % in some direction; "
            "identify it well, or use fewer axes"
        )


# Functions whose code is kept, for axes that are made again with other parameters. Chosen by hand:
# more than the functions of a study.
_KEPT = 32


@kept_code(_KEPT)
def _compiled_gain(
    function: Callable[..., Any],
    shapes: user_functions.Shapes,
    inner: tuple[int, int],
    outer: tuple[int, int],
) -> Any:
    """Return the compiled function that writes the matrix for estimates and parameters.

    Raises ``NotCompilableError`` if Numba can't compile it.
    """
    own, parameters = user_functions.jit_user_function(function), user_functions.reader(shapes)

    def write(px, pp, pout):  # type: ignore[no-untyped-def]
        out = numba.carray(pout, outer)
        matrix = own(numba.carray(px, inner), *parameters(pp))
        for i in range(outer[0]):
            for j in range(outer[1]):
                out[i, j] = matrix[i][j]

    code = user_functions.compile_cfunc(nb_types.void(POINTER, POINTER, POINTER), write)
    user_functions.set_origin(code.address, function, numbers=(0, shapes))
    return code


def checked_rule(
    saturation: Any, wished: Any, gain: Gain, names: Sequence[str]
) -> CutEach | KeepDirection | ByPriority:
    """Return what is done with u outside of its limits."""
    count = gain.shape[1]
    none = np.zeros(count if count > gain.shape[0] else 0)
    point = none if wished is None else checks.vector("wished", wished, count)
    if wished is not None and count == gain.shape[0]:
        raise ValueError(
            f"wished = {wished!r}: there are as many actuators as axes, so u has no freedom for "
            "it; leave it out"
        )
    if isinstance(saturation, str):
        if checks.one_of("saturation", saturation, ("each", "direction")) == "each":
            return CutEach(point, gain.weights)
        return KeepDirection(point)
    order = list(saturation) if checks.is_sequence(saturation) else [saturation]
    places = [names.index(each) if each in names else each for each in order]
    if sorted(map(str, places)) != sorted(map(str, range(len(names)))):
        raise ValueError(
            f"saturation = {saturation!r}: must be 'each', 'direction', or all axes in the order "
            f"of their priority, of {', '.join(names)}"
        )
    rank = min(_RANK, _ALL_RANKS ** (1.0 / max(len(names) - 1, 1)))
    return ByPriority(point, gain.weights, np.array(places, dtype=np.int64), rank)
