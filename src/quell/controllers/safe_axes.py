"""The safe sets of several axes together: the nearest u within actuators' limits and all bands.

Each axis may have a ``SafeSet`` (``controllers/safe_set.py``): a band for y_i, and for its rate, is
a bound of what acts on the axis, from an observer of its own::

    lo_i ≤ v_i ≤ hi_i,      v = B0 u

The axes ask for v within these bounds, and where no limit of an actuator is in the way that is what
they get. At a limit, ``controllers/allocation.py`` returns a u_a with other v. Then u is the
solution of::

    min Σ_k W_k (u_k − u_a,k)²      with  low_k ≤ u_k ≤ high_k,  lo_i ≤ (B0 u)_i ≤ hi_i         (1)

where [low, high] is what limits of magnitude and rate allow in this sample. So what keeps the bands
is the smallest change of u, and none where the bands allow u_a.

*Where (1) has no solution*, limits of actuators go first. The bands of the rates are left out; if
that is not enough, each band gets a slack ε_i::

    min γ Σ_i ε_i² / (B0 W⁻¹ B0ᵀ)_ii + Σ_k W_k (u_k − u_a,k)²,      γ = 10⁸

as the least squares of ``allocation.py`` weigh what axes miss. In both cases ``UNSAFE`` is in the
status, and in that of each axis whose v is outside of its bounds.

**The solver** is the dual method of Goldfarb & Idnani (*Mathematical Programming* 27, 1983). It
begins at u_a, takes up the bound that is farthest from being kept, and keeps those that it holds,
until all are kept or a bound can not be kept together with others: that proves that (1) has no
solution. With signed multipliers μ of the rows R = [I; B0]::

    u = u_a − W⁻¹ Rᵀ μ,      G = R W⁻¹ Rᵀ

each round solves ``G_AA r = G_Ap`` for the rows A that are held, by the same factor as the least
squares. A slack is ``G_ii (1 + 1/γ)`` in place of G_ii. Each round raises the dual value, so no set
of rows returns; a limit of rounds bounds the time all the same, and beyond it the case counts as
one without a solution.

A general solver such as OSQP is not used: the same loop has to run in Python, in compiled runs and
in C without allocation, with the same bits and a bound on its rounds; and it has to prove that
there is no solution. The tests compare it with solvers of SciPy.

**What holds.** As long as (1) has a solution in each sample, what ``safe_set.py`` guarantees for a
single loop holds for each axis, because v_i is within its bounds in each sample, but for 1e-9 of
the sum of ``|B0_ik u_k|``. The margin ε of an axis has to cover what its plant
``y_i^(n) = f_i + (B0 u)_i`` does beyond B0: ``f_rate`` is that of f_i with everything that the
other axes do to it. For a B0 whose entries are wrong by a share, v is wrong by as much of the sum
of ``|B0_ik u_k|``: give the share as ``gain_error``, and ``largest_u`` for the sum. A constant B0
keeps to it, which is checked beforehand. Where B0 is a function, an axis has ``UNSAFE`` in its
status in each sample in which the sum is larger: its margin is then too small. From a start outside
of a band the axis returns as ``safe_set.py`` has it. That (1) has a solution in the next sample
does not follow from this one: the actuators need enough authority for the α of all bands at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.allocation import ActuatorLimits, GainMemory, RangeMemory, solve_free
from quell.controllers.safe_set import BOUNDS, write_bounds
from quell.kernels.dispatch import for_each, generic_with_default, is_finite, kernel
from quell.kernels.functions import is_single, sqrt
from quell.kernels.sized import Work
from quell.types import Matrix, Status, Vector

_OVERFLOWED = int(Status.OVERFLOWED)
_SATURATED = int(Status.SATURATED)
_RATE_LIMITED = int(Status.RATE_LIMITED)
_SAFE_SET_ACTED = int(Status.SAFE_SET_ACTED)
_UNSAFE = int(Status.UNSAFE)

# ---- The kernels ----

# Share of the sum of |R_jk u_k| by which a bound may be missed: what rounding does with a B0 that
# is badly conditioned. And that of G_pp below which a row depends on those that are held.
_ROUNDING, _ROUNDING_SINGLE = 1e-9, 1e-5
_DEPENDENT, _DEPENDENT_SINGLE = 1e-10, 1e-5
# 1/γ. In single precision γ is what its digits allow.
_SOFTNESS, _SOFTNESS_SINGLE = 1e-8, 1e-3
# Rounds for each row: 60 000 drawn cases needed 2.2 at most, which tests/test_safe_axes.py repeats.
_ROUNDS = 8


class NoSafeAxes(NamedTuple):
    """No axis has a safe set."""


class NoSafeAxesMemory(NamedTuple):
    """The room that nothing needs."""

    nothing: Work  # (0,)


class SafeAxesDesign(NamedTuple):
    """Parameters of the safe sets of several axes."""

    weights: Vector  # W of the actuators (m,)
    largest: Vector  # sum of |B0_ik u_k| with which the margin of an axis reckons, or inf (n,)


class SafeAxesMemory(NamedTuple):
    """Room to calculate; a row is an actuator, or behind them an axis."""

    bounds: Work  # of v: by bands of y (low, high), and by those of y and its rate (n, 4)
    low: Work  # bounds of the rows (m + n,)
    high: Work
    multipliers: Work  # μ (m + n,)
    held: Work  # 1 where a row is held at its upper bound, −1 at its lower one, else 0 (m + n,)
    slope: Work  # (m + n,)
    step: Work  # (m + n,)
    G: Work  # (m + n, m + n)
    L: Work  # (m + n, m + n)
    start: Work  # u_a (m,)
    flags: Work  # ``UNSAFE`` for axes whose v is outside of its bounds, else 0 (n,)


def check_safe_sets(
    safe_sets: Sequence[Any], names: Sequence[str], B0: Matrix, limits: ActuatorLimits
) -> None:
    """Check that the largest v, of which the errors of B0 are a share, is that of the actuators.

    ``B0`` is that before the first sample; where it is a function, each sample is checked, too.
    """
    reach = np.maximum(np.abs(limits.low), np.abs(limits.high))
    for name, row, safe_set in zip(names, B0, safe_sets, strict=True):
        if safe_set is None or safe_set.gain_error == 0.0:
            continue
        moves = row != 0.0
        needed = float(np.abs(row[moves]) @ reach[moves])
        if not needed <= safe_set.largest_u * (1.0 + 1e-9):
            what = (
                f"must be at least {needed:.6g}, the sum of |B0_ik u_k| at the limits of u"
                if np.isfinite(needed)
                else "the actuators have no limits, so no v is the largest; give u_min and u_max"
            )
            raise ValueError(f"axes: {name}: safe_set.largest_u = {safe_set.largest_u!r}: {what}")


def safe_axes_design(safe_sets: Sequence[Any], weights: Vector) -> Any:
    """Return the parameters for the safe set of each axis, None for one without."""
    if all(each is None for each in safe_sets):
        return NoSafeAxes()
    reckons = [each is not None and each.gain_error > 0.0 for each in safe_sets]
    largest = [
        each.largest_u if known else math.inf
        for each, known in zip(safe_sets, reckons, strict=True)
    ]
    return SafeAxesDesign(weights, np.array(largest))


def safe_axes_memory(design: Any, n: int, m: int) -> Any:
    """Return room for n axes and m actuators."""
    if isinstance(design, NoSafeAxes):
        return NoSafeAxesMemory(np.zeros(0))
    rows = m + n
    low, high, multipliers, held, slope, step = (np.zeros(rows) for _ in range(6))
    G, L = (np.zeros((rows, rows)) for _ in range(2))
    bounds, start, flags = np.zeros((n, BOUNDS)), np.zeros(m), np.zeros(n)
    return SafeAxesMemory(bounds, low, high, multipliers, held, slope, step, G, L, start, flags)


def write_axis_bounds(axis: Any, state: Any, i: int, bounds: Matrix) -> None:
    """Write the bounds of v that the safe set of an axis has."""
    write_bounds(axis.safe_set, state.safe_set, bounds[i])


def add_axis_flags(axis: Any, state: Any, i: int, flags: Vector) -> None:
    """Add flags to the status of an axis."""
    loop = state.loop[0]
    loop.status = int(loop.status) | int(flags[i])


write_axes_bounds = for_each("write_axes_bounds", write_axis_bounds)
add_axes_flags = for_each("add_axes_flags", add_axis_flags)


@generic_with_default
def keep_in_bands(
    design: Any,
    memory: Any,
    axes: Any,
    states: Any,
    limits: ActuatorLimits,
    gain: GainMemory,
    within: RangeMemory,
    u: Vector,
) -> int:
    """Change u, that the axes were given, so that each v stays in its bounds; return the flags."""
    return 0


@keep_in_bands.register(SafeAxesDesign)
def _keep_in_bands(
    design: SafeAxesDesign,
    memory: SafeAxesMemory,
    axes: Any,
    states: Any,
    limits: ActuatorLimits,
    gain: GainMemory,
    within: RangeMemory,
    u: Vector,
) -> int:
    n, m = gain.B.shape
    for k in range(m):
        memory.low[k], memory.high[k], memory.start[k] = within.low[k], within.high[k], u[k]
    write_axes_bounds(axes, states, memory.bounds)
    _take_bounds(memory, 2)
    outside = False
    for i in range(n):
        outside = outside or missed(gain, memory, m + i, u) != 0.0
    if not outside:
        return _flag_axes(design, memory, axes, states, gain, u)
    if not nearest(gain, design.weights, memory, False, u):
        rates = False
        for i in range(n):
            rates = rates or memory.bounds[i, 0] != memory.bounds[i, 2]
            rates = rates or memory.bounds[i, 1] != memory.bounds[i, 3]
        _take_bounds(memory, 0)
        if not rates or not nearest(gain, design.weights, memory, False, u):
            nearest(gain, design.weights, memory, True, u)
        _take_bounds(memory, 2)
    flags = _SAFE_SET_ACTED
    for k in range(m):
        value = min(max(u[k], memory.low[k]), memory.high[k])
        if memory.held[k] != 0.0:  # rounding has left it just inside
            value = memory.high[k] if memory.held[k] > 0.0 else memory.low[k]
            at_end = value == limits.high[k] or value == limits.low[k]
            flags |= _SATURATED if at_end else _RATE_LIMITED
        if is_finite(value):
            u[k] = value
        else:  # sums have overflowed; what the axes were given is a number within the limits
            u[k] = memory.start[k]
            flags |= _OVERFLOWED
    return flags | _flag_axes(design, memory, axes, states, gain, u)


@kernel
def _flag_axes(
    design: SafeAxesDesign,
    memory: SafeAxesMemory,
    axes: Any,
    states: Any,
    gain: GainMemory,
    u: Vector,
) -> int:
    """Flag axes whose v is outside of its bounds, or larger than their margin reckons with."""
    n, m = gain.B.shape
    flags = 0
    for i in range(n):
        memory.flags[i] = 0.0
        size = 0.0
        for k in range(m):
            size += abs(gain.B[i, k] * u[k])
        share = _ROUNDING_SINGLE if is_single(size) else _ROUNDING
        beyond = size > design.largest[i] * (1.0 + share)
        if beyond or missed(gain, memory, m + i, u) != 0.0:
            memory.flags[i] = _UNSAFE
            flags |= _UNSAFE
    if flags != 0:
        add_axes_flags(axes, states, memory.flags)
    return flags


@kernel
def _take_bounds(memory: SafeAxesMemory, first: int) -> None:
    """Take the bounds of the axes from two columns."""
    n, m = memory.flags.size, memory.start.size
    for i in range(n):
        memory.low[m + i] = memory.bounds[i, first]
        memory.high[m + i] = memory.bounds[i, first + 1]


@kernel
def _entry(gain: GainMemory, j: int, k: int) -> float:
    """Return the entry of the row j and the actuator k of R = [I; B0]."""
    m = gain.B.shape[1]
    if j < m:
        return 1.0 if j == k else 0.0
    return gain.B[j - m, k]


@kernel
def missed(gain: GainMemory, memory: SafeAxesMemory, j: int, u: Vector) -> float:
    """Return by how much u is above (positive) or below the bounds of a row; 0 within rounding."""
    value, size = 0.0, 0.0
    for k in range(u.size):
        part = _entry(gain, j, k) * u[k]
        value += part
        size += abs(part)
    share = _ROUNDING_SINGLE if is_single(value) else _ROUNDING
    over, under = value - memory.high[j], value - memory.low[j]
    if over > share * (size + abs(memory.high[j])):
        return over
    if under < -share * (size + abs(memory.low[j])):
        return under
    return 0.0


@kernel
def nearest(
    gain: GainMemory, weights: Vector, memory: SafeAxesMemory, soft: bool, u: Vector
) -> bool:
    """Write the u nearest to ``memory.start`` that keeps all bounds; return False if none does.

    With ``soft`` the bounds of the axes have a slack, and there always is one.
    """
    n, m = gain.B.shape
    rows = m + n
    held, multipliers, G = memory.held, memory.multipliers, memory.G
    single = is_single(weights[0])
    dependent = _DEPENDENT_SINGLE if single else _DEPENDENT
    softness = 0.0
    if soft:
        softness = _SOFTNESS_SINGLE if single else _SOFTNESS
    for j in range(rows):
        held[j] = multipliers[j] = 0.0
        for i in range(j + 1):
            total = 0.0
            for k in range(m):
                total += _entry(gain, i, k) * _entry(gain, j, k) / weights[k]
            G[i, j] = G[j, i] = total
    for j in range(m, rows):
        G[j, j] += softness * G[j, j]
    _from_multipliers(gain, weights, memory, u)
    row, side = -1, 0.0
    for _ in range(_ROUNDS * rows):
        if row < 0:
            row, side = _farthest(gain, memory, u)
            if row < 0:
                return True
        for j in range(rows):
            memory.slope[j] = -G[j, row]
        solve_free(G, memory.L, memory.slope, held, memory.step)
        left, count = G[row, row], 0
        for j in range(rows):
            if held[j] != 0.0:
                left -= G[row, j] * memory.step[j]
                count += 1
        if count >= m and not soft:  # any other row depends on m of them, whatever rounding says
            left = 0.0
        # The multiplier of a row that is held must not change its sign.
        share, end = math.inf, -1
        for j in range(rows):
            falls = held[j] * side * memory.step[j]
            if falls > 0.0 and held[j] * multipliers[j] < share * falls:
                share, end = held[j] * multipliers[j] / falls, j
        if left > dependent * G[row, row]:
            distance = -softness / (1.0 + softness) * G[row, row] * multipliers[row]
            if row < m:
                distance = 0.0
            distance -= memory.high[row] if side > 0.0 else memory.low[row]
            for k in range(m):
                distance += _entry(gain, row, k) * u[k]
            whole = side * distance / left
            if whole <= share:
                share, end = whole, row
        if end < 0 or not is_finite(share):  # share is infinite then; a proof does not see it
            return False
        for j in range(rows):
            if held[j] != 0.0:
                multipliers[j] -= side * share * memory.step[j]
        multipliers[row] += side * share
        if end == row:
            held[row] = side
            row = -1
        else:
            held[end] = multipliers[end] = 0.0
        _from_multipliers(gain, weights, memory, u)
    return False


@kernel
def _from_multipliers(gain: GainMemory, weights: Vector, memory: SafeAxesMemory, u: Vector) -> None:
    """Write ``u_a − W⁻¹ Rᵀ μ``."""
    n, m = gain.B.shape
    for k in range(m):
        total = memory.multipliers[k]
        for i in range(n):
            total += gain.B[i, k] * memory.multipliers[m + i]
        u[k] = memory.start[k] - total / weights[k]


@kernel
def _farthest(gain: GainMemory, memory: SafeAxesMemory, u: Vector) -> tuple[int, float]:
    """Return the row whose bounds u misses by most, in the norm of W, and the side; −1 for none."""
    row, side, worst = -1, 0.0, 0.0
    for j in range(memory.held.size):
        if memory.held[j] == 0.0:
            over = missed(gain, memory, j, u)
            size = abs(over) / sqrt(memory.G[j, j])
            if size > worst:
                row, worst = j, size
                side = 1.0 if over > 0.0 else -1.0
    return row, side
