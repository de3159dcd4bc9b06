"""The inner loop of linear runs, 32 at a time: linear plants with linear laws and limits.

In each lane, with the sampled plant (``plants/linear.py``) and the linear form of the controller
(``controllers/linear/form.py``)::

    y = C x,   y_m = y + noise,   e = y_m − p_1 or y_m
    u_wished = C_p p + D_y e + D_r r + D_d (r', …),      u = limited(u_wished)
    p⁺ = A p + B_y e + B_r r + B_u u(k − d_c),           x⁺ = Φ x + Γ u(k − d_p) + Γ_w w

Loops over lanes are written so that LLVM makes vector code of them: few arrays in each, and their
length taken from an array, because loops of constant length are unrolled before.

All quantities of a sample are rows of one array over the lanes (``Rows``), ordered so that each
equation is a product with rows that lie side by side. Sums begin with the last of them, so that
small increments are added up before a state is added to them.

A lane whose run diverges ends. A lane in which something happens that these equations do not have
(a reference or measurement that the controller would hold, a state that it would reset) is marked
as irregular and ends, too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.checks import LARGEST_SIGNAL
from quell.kernels.dispatch import compiled, kernel
from quell.kernels.lanes import LANES, set_products
from quell.types import Matrix, Status, Vector

_SATURATED = float(Status.SATURATED)
_RATE_LIMITED = float(Status.RATE_LIMITED)
# Recorded samples that are collected before they are written to the log, run by run: enough that
# most of a line of the processor's cache is written at once. Chosen by hand.
COLLECTED = 64


class Rows(NamedTuple):
    """First row of each quantity; p to u_law lie side by side, and x to u_plant."""

    p: int
    e: int
    v: int  # r, r', …
    u_law: int  # u that reaches the law's state
    x: int
    w: int
    u_plant: int  # u that reaches the plant
    noise: int
    y: int
    y_measured: int
    u_wished: int
    u: int
    status: int
    estimates: int
    plant_delay: int  # values of u on their way to the plant, newest first
    law_delay: int
    end: int


class Lanes(NamedTuple):
    """A group of runs: coefficients, limits and state; the last axis is that of the lanes."""

    rows: Rows
    output: NDArray[np.float64]  # y from x (1, n)
    wish: NDArray[np.float64]  # u_wished from p, e, v (1, m + 1 + v)
    law: NDArray[np.float64]  # p⁺ from p, e, v, u_law (m, m + 2 + v)
    plant: NDArray[np.float64]  # x⁺ from x, w, u_plant (n, n + d + 1)
    estimates: NDArray[np.float64]  # recorded estimates from p, e (k, m + 1)
    predicts: Vector  # 1 if p_1 is the predicted y
    start: Matrix  # p at the first sample for y_m = 1 (m,)
    low: Vector
    high: Vector
    most_change: Vector
    least_change: Vector
    largest_wish: Vector
    limit: Vector  # |y| beyond which a run has diverged
    values: Matrix  # all rows
    next: Matrix  # room for p⁺ or x⁺
    starting: Vector  # 1 where the controller starts at the next sample
    seen: Matrix  # largest of the status flags (saturated, rate limited) up to now (2,)
    ended: NDArray[np.int64]  # sample at which a run diverged; −1 if it has not
    lengths: NDArray[np.int64]  # rows of its log
    irregular: NDArray[np.int64]  # 1 if this loop can't represent the run


@kernel
def _spread(values: Matrix, row: int, count: int, samples: Any, k: int, column: int) -> None:
    """Copy ``count`` columns of a sample into rows; they are one for all lanes, or one for each."""
    for c in range(count):
        target, source = values[row + c], samples[k, column + c]
        if source.size == 1:
            value = source[0]
            for i in range(target.size):
                target[i] = value
        else:
            for i in range(target.size):
                target[i] = source[i]


@kernel
def _clear_ended(lanes: Lanes) -> None:
    """Set all that belongs to lanes that have ended to zero, and their limits to infinity."""
    for lane in range(LANES):
        if lanes.ended[lane] >= 0:
            for coefficients in (lanes.output, lanes.wish, lanes.law, lanes.plant, lanes.estimates):
                for i in range(coefficients.shape[0]):
                    for j in range(coefficients.shape[1]):
                        coefficients[i, j, lane] = 0.0
            for i in range(lanes.values.shape[0]):
                lanes.values[i, lane] = 0.0
            lanes.low[lane] = lanes.least_change[lane] = -np.inf
            lanes.high[lane] = lanes.most_change[lane] = np.inf


@kernel
def _measure(lanes: Lanes, sample: int, row: int) -> int:
    """Set y and the measurement; return how many lanes have diverged in this sample."""
    values, rows = lanes.values, lanes.rows
    set_products(values, rows.y, lanes.output, values, rows.x)
    y, noise, measured = values[rows.y], values[rows.noise], values[rows.y_measured]
    outside = 0
    for i in range(lanes.limit.size):
        measured[i] = y[i] + noise[i]
        outside += 0 if abs(y[i]) <= lanes.limit[i] else 1
    ended = 0
    if outside > 0:
        for i in range(LANES):
            if lanes.ended[i] < 0 and not abs(y[i]) <= lanes.limit[i]:
                lanes.ended[i], lanes.lengths[i] = sample, row
                ended += 1
    return ended


@kernel
def _control(lanes: Lanes, sample: int) -> int:
    """Set u and status from the measurement; return how many lanes are irregular."""
    values, rows = lanes.values, lanes.rows
    wished, u, status = values[rows.u_wished], values[rows.u], values[rows.status]
    error, measured, r = values[rows.e], values[rows.y_measured], values[rows.v]
    predicted, applied = values[rows.p], lanes.next[0]
    for i in range(error.size):
        error[i] = measured[i] - lanes.predicts[i] * predicted[i]
    set_products(values, rows.u_wished, lanes.wish, values, rows.p)
    irregular = 0
    for i in range(u.size):
        regular = _is_regular(wished[i], lanes.largest_wish[i], measured[i], r[i])
        irregular += 0 if regular else 1
    if irregular > 0:
        irregular = _end_irregular(lanes, sample)
    for i in range(u.size):
        fastest, slowest = u[i] + lanes.most_change[i], u[i] + lanes.least_change[i]
        limited = fastest if wished[i] > fastest else wished[i]
        applied[i] = slowest if wished[i] < slowest else limited
    cut = 0
    for i in range(u.size):
        limited = lanes.high[i] if applied[i] > lanes.high[i] else applied[i]
        u[i] = lanes.low[i] if applied[i] < lanes.low[i] else limited
        status[i] = 0.0
        cut += 0 if u[i] == wished[i] else 1
    if cut > 0:
        _set_flags(lanes, applied)
    return irregular


@kernel
def _is_regular(wished: float, largest_wish: float, measured: float, r: float) -> bool:
    """Return whether the controller neither holds a value nor starts anew; without branches."""
    small = (abs(measured) <= LARGEST_SIGNAL) & (abs(r) <= LARGEST_SIGNAL)
    return (abs(wished) <= largest_wish) & small


@kernel
def _end_irregular(lanes: Lanes, sample: int) -> int:
    """End the lanes in which the controller would hold a value or start anew; count them."""
    values, rows, count = lanes.values, lanes.rows, 0
    wished, measured, r = values[rows.u_wished], values[rows.y_measured], values[rows.v]
    for i in range(LANES):
        regular = _is_regular(wished[i], lanes.largest_wish[i], measured[i], r[i])
        if lanes.ended[i] < 0 and not regular:
            lanes.ended[i], lanes.irregular[i] = sample, 1
            count += 1
    return count


@kernel
def _set_flags(lanes: Lanes, within_rates: Vector) -> None:
    """Set the status of the lanes that have not ended, and keep its largest flags."""
    values, rows = lanes.values, lanes.rows
    wished, u, status = values[rows.u_wished], values[rows.u], values[rows.status]
    for i in range(LANES):
        if lanes.ended[i] < 0:
            saturated = _SATURATED if u[i] != within_rates[i] else 0.0
            rate_limited = _RATE_LIMITED if within_rates[i] != wished[i] else 0.0
            status[i] = saturated + rate_limited
            lanes.seen[0, i] = max(lanes.seen[0, i], saturated)
            lanes.seen[1, i] = max(lanes.seen[1, i], rate_limited)


@kernel
def _arrive(values: Matrix, u: int, target: int, delay: int, count: int) -> None:
    """Write u, or the one of ``count`` samples ago, into the row ``target``."""
    last = u if count == 0 else delay + count - 1
    for i in range(values.shape[1]):
        values[target, i] = values[last, i]
    for j in range(count - 1, -1, -1):
        source = u if j == 0 else delay + j - 1
        for i in range(values.shape[1]):
            values[delay + j, i] = values[source, i]


@kernel
def _advance(lanes: Lanes) -> None:
    """Advance the states of law and plant."""
    values, rows, following = lanes.values, lanes.rows, lanes.next
    _arrive(values, rows.u, rows.u_plant, rows.plant_delay, rows.law_delay - rows.plant_delay)
    _arrive(values, rows.u, rows.u_law, rows.law_delay, rows.end - rows.law_delay)
    n, m = lanes.plant.shape[0], lanes.law.shape[0]
    set_products(following, 0, lanes.plant, values, rows.x)
    set_products(following, n, lanes.law, values, rows.p)
    for j in range(n):
        for i in range(lanes.limit.size):
            values[rows.x + j, i] = following[j, i]
    for j in range(m):
        for i in range(lanes.limit.size):
            values[rows.p + j, i] = following[n + j, i]


@kernel
def _write(collected: Any, log: Any, targets: Any, runs: Any, row: int, count: int) -> None:
    """Write the collected samples into the log, from ``row`` on."""
    for c in range(targets.size):
        for i in range(runs.size):
            target = log[targets[c], runs[i]]
            for k in range(count):
                target[row + k] = collected[k, c, i]


@kernel
def _collect(lanes: Lanes, channels: NDArray[np.int64], sample: Matrix) -> None:
    """Copy the recorded rows of a sample, after the estimates are computed."""
    values, rows = lanes.values, lanes.rows
    set_products(values, rows.estimates, lanes.estimates, values, rows.p)
    for c in range(channels.size):
        source, target = values[channels[c]], sample[c]
        for i in range(lanes.limit.size):
            target[i] = source[i]


@kernel
def _start(lanes: Lanes) -> None:
    """Start the laws of the lanes that are to start, from their first measurement."""
    values, rows = lanes.values, lanes.rows
    for j in range(lanes.start.shape[0]):
        for i in range(lanes.limit.size):
            if lanes.starting[i] != 0.0:
                values[rows.p + j, i] = lanes.start[j, i] * values[rows.y_measured, i]


@compiled
def run_lanes(
    lanes: Lanes,
    inputs: NDArray[np.float64],
    first: int,
    log: NDArray[np.float64],
    channels: NDArray[np.int64],
    targets: NDArray[np.int64],
    runs: NDArray[np.int64],
    collected: NDArray[np.float64],
    row: int,
    until_next: int,
    every: int,
) -> tuple[int, int]:
    """Run all lanes through ``inputs`` from the sample ``first`` on.

    ``inputs`` are w, r, its derivatives and noise (samples, …), for all lanes or for each. Every
    ``every``-th sample is logged: ``log[targets[c], runs[i], row]`` gets the row ``channels[c]`` of
    lane i. ``collected`` (COLLECTED, channels, LANES) is memory. Returns the next row, and the
    number of samples until it is written.
    """
    values, rows, count = lanes.values, lanes.rows, 0
    disturbances, references = rows.u_plant - rows.w, rows.u_law - rows.v
    for k in range(inputs.shape[0]):
        _spread(values, rows.w, disturbances, inputs, k, 0)
        _spread(values, rows.v, references, inputs, k, disturbances)
        _spread(values, rows.noise, 1, inputs, k, disturbances + references)
        ended = _measure(lanes, first + k, row + count)
        if k == 0:
            _start(lanes)
        ended += _control(lanes, first + k)
        if ended > 0:
            _clear_ended(lanes)
        if until_next == 0:
            _collect(lanes, channels, collected[count])
            count += 1
            if count == COLLECTED:
                _write(collected, log, targets, runs, row, count)
                row, count = row + count, 0
            until_next = every
        until_next -= 1
        _advance(lanes)
    _write(collected, log, targets, runs, row, count)
    return row + count, until_next
