"""Search for the frequencies of a load in the past of f_plain.

The rotation of a pair (``oscillators.py``) finds a frequency from a start that is near, and one at
a time: it needs many periods of the beat to separate sinusoids that are close to each other,
because each oscillator follows all of them. A least-squares fit over a window separates them within
a fraction of the beat. Its input is f_plain, the estimate of an ESO without learner, whose
frequencies are those of the load whatever the learner feeds forward.

* f_plain passes a first-order lag of ``1/omega_c``, because f shows the loop's quick motion more
  than y does: without the lag, transients of learner and loop cover a slow load. A search for
  several orders has no lag: the higher ones tell the frequency best. The result is averaged over
  entries of ``2/omega_o``, of which the last 512 are kept.
* A search begins with the shortest window and no sinusoid. It looks for the strongest line in what
  is left (*scan*), adds it, fits all frequencies (*fit*, ``line_fit.py``), and so on: relaxation
  after Li & Stoica, *Efficient mixed-spectrum estimation with applications to target feature
  extraction*, IEEE Trans. Signal Processing 44 (1996). If the result is not good, the next search
  has a window of twice the length, and after the longest the shortest again.
* A result is good if it leaves a small share of the variance. The oscillators take over those of
  its frequencies that the window resolves. If they had left four times as much (*check*), their
  amplitudes are learned anew. The window grows and the fit is continued as long as it is good, so
  its frequencies become ever more exact; a window that contains a change of the load does not fit,
  and shrinks (``search_verdict.py``).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell.kernels.dispatch import generic, kernel
from quell.kernels.functions import is_single, sin
from quell.kernels.scalars import clear
from quell.learners.kalman.line_fit import (
    add_row,
    fitted,
    line_fit,
    next_row,
    solve,
    write_deviations,
)
from quell.learners.kalman.oscillators import Oscillators
from quell.learners.kalman.search_state import (
    CHECK,
    ENTRIES,
    SCAN,
    SHORTEST,
    FrequencySearch,
    SearchLoop,
    SearchMemory,
    begin_check,
    begin_fit,
    begin_scan,
    search_from_nothing,
)
from quell.learners.kalman.search_verdict import COMPLETE, NOTHING, judge
from quell.observers.eso import ESO
from quell.types import Vector

# Lines of a scan between the limits: 9 % apart for the default limits, a third of the width of a
# line in the window in which it is found.
_LINES = 64
# Gauss-Newton steps of a fit at most; a step of the phase over the window that ends it [rad]; and
# the largest step, a third of the distance of two lines [rad].
_MOST_PASSES, _CONVERGED, _LARGEST_STEP = 8, 0.02, 2.0
# Share of the variance that a fit may leave: if it is continued, and if its frequencies are used.
# Of a sawtooth with eight orders the higher ones are 7 %.
_GOOD, _CERTAIN, _GOOD_ORDERS = 0.02, 0.005, 0.1
# Least share that counts as noise: what the loop's transients leave is not white.
_LEAST_LEFT = 1e-3
# Shortest window whose frequencies are used, in units of 1/omega_c: transients of the loop, also
# those that a learner causes, last some ten.
_LOOP_TIMES = 16.0
# Numbers of entries are counted up to this, and then are less by a multiple of the ring's length:
# in single precision a count ends at 2²⁴.
_WRAP = 4096.0 * ENTRIES
_MOST_ENTRIES = 2.0 * _WRAP
# The square of f_plain, summed over a window, is still finite; in single precision, too.
_ABSURD, _ABSURD_SINGLE = 1e100, 1e16


class NoSearch(NamedTuple):
    """Parameters and state of a learner that does not search."""


def frequency_search(observer: ESO, omega_c: float, oscillators: Oscillators) -> FrequencySearch:
    """Return a search for the frequencies of oscillators."""
    # In units of the observer's bandwidth, whatever its tuning: N over its lag.
    spacing = max(round(2.0 * observer.lag_time / ((observer.order + 1) * observer.dt)), 1)
    step = spacing * observer.dt
    low, high = oscillators.low * step, oscillators.high * step
    lines = np.geomspace(low, high, _LINES) * oscillators.orders[0]
    several = oscillators.orders.size > 1
    return FrequencySearch(
        orders=oscillators.orders,
        lines=lines,
        spacing=float(spacing),
        step=step,
        follow=1.0 if several else -math.expm1(-omega_c * observer.dt),
        rows=math.ceil(ENTRIES / spacing),
        good=_GOOD_ORDERS if several else _GOOD,
        certain=_GOOD_ORDERS if several else _CERTAIN,
        shortest=_LOOP_TIMES / (omega_c * step),
        low=low,
        high=high,
    )


def search_memory(search: Any, oscillators: Oscillators) -> Any:
    """Return the state before the first sample."""
    if isinstance(search, NoSearch):
        return search
    return SearchMemory(
        past=np.zeros(ENTRIES),
        wave=np.zeros(2 * _LINES),
        turn=np.zeros(2 * _LINES),
        score=np.zeros(2 * _LINES),
        fit=line_fit(oscillators.omega.size, oscillators.orders.size),
        adopted=np.zeros(oscillators.omega.size),
        loop=SearchLoop.zeros(),
    )


@generic
def advance_search(search: Any, memory: Any, f_plain: float, omega: Vector) -> int:
    """Continue the search with a sample.

    Write frequencies into ``omega`` (m,) [rad/s] when there is a good fit, and return whether.
    """
    raise TypeError


@generic
def is_locked(search: Any, memory: Any, j: int) -> bool:
    """Return whether oscillator ``j`` has its frequency from a fit."""
    raise TypeError


@generic
def start_search_again(search: Any, memory: Any) -> None:
    """Forget the past: the plant was put somewhere else."""
    raise TypeError


@advance_search.register(NoSearch)
def _advance_nothing(search: NoSearch, memory: NoSearch, f_plain: float, omega: Vector) -> int:
    return NOTHING


@is_locked.register(NoSearch)
def _is_never_locked(search: NoSearch, memory: NoSearch, j: int) -> bool:
    return False


@start_search_again.register(NoSearch)
def _start_nothing(search: NoSearch, memory: NoSearch) -> None:
    pass


@is_locked.register(FrequencySearch)
def _is_locked(search: FrequencySearch, memory: SearchMemory, j: int) -> bool:
    return bool(memory.adopted[j] > 0.0)


@start_search_again.register(FrequencySearch)
def _start_again(search: FrequencySearch, memory: SearchMemory) -> None:
    clear(memory.loop)
    for j in range(memory.adopted.size):
        memory.adopted[j] = 0.0


@advance_search.register(FrequencySearch)
def _advance(search: FrequencySearch, memory: SearchMemory, f_plain: float, omega: Vector) -> int:
    loop = memory.loop[0]
    if not abs(f_plain) < (_ABSURD_SINGLE if is_single(search.step) else _ABSURD):
        start_search_again(search, memory)
        return NOTHING
    if loop.entries == 0.0 and loop.samples == 0.0:
        loop.late = f_plain
    loop.late += search.follow * (f_plain - loop.late)
    loop.total += loop.late
    loop.samples += 1.0
    if loop.samples >= search.spacing:
        memory.past[int(loop.entries) % ENTRIES] = loop.total / loop.samples
        loop.entries += 1.0
        loop.total = loop.samples = 0.0
        if loop.entries >= _MOST_ENTRIES:
            loop.entries -= _WRAP
            loop.newest -= _WRAP
    if loop.stage == 0.0:
        if loop.entries < SHORTEST:
            return NOTHING
        search_from_nothing(search, memory, float(SHORTEST))
    if loop.row >= loop.window:
        return _finish_pass(search, memory, omega)
    for _ in range(search.rows):
        if loop.row < loop.window:
            _take_row(search, memory)
    return NOTHING


@kernel
def _take_row(search: FrequencySearch, memory: SearchMemory) -> None:
    loop, fit = memory.loop[0], memory.fit
    value = memory.past[(int(loop.newest) - 1 - int(loop.row)) % ENTRIES]
    found = fit.omega.size if loop.stage == CHECK else int(loop.found)
    pairs = 2 * search.orders.size * found
    if loop.stage == SCAN:
        rest = value - fit.solution[0] - fitted(fit, pairs)
        _add_to_scores(memory, rest * sin(math.pi * (loop.row + 0.5) / loop.window) ** 2)
    else:
        add_row(search.orders, fit, found, -loop.row, value)
    next_row(fit, pairs)
    loop.row += 1.0


@kernel
def _add_to_scores(memory: SearchMemory, value: float) -> None:
    """Add a sample, weighted with the window of Hann, to the correlations with all lines."""
    wave, turn, score = memory.wave, memory.turn, memory.score
    for at in range(0, score.size, 2):
        sine, cosine = wave[at], wave[at + 1]
        score[at] += value * sine
        score[at + 1] += value * cosine
        wave[at] = sine * turn[at + 1] + cosine * turn[at]
        wave[at + 1] = cosine * turn[at + 1] - sine * turn[at]


@kernel
def _finish_pass(search: FrequencySearch, memory: SearchMemory, omega: Vector) -> int:
    loop, fit = memory.loop[0], memory.fit
    orders, count = search.orders, fit.omega.size
    if loop.stage == SCAN:
        _add_strongest_line(search, memory)
        begin_fit(search, memory, 0.0)
        return NOTHING
    if loop.stage == CHECK:
        pairs = 2 * orders.size * count
        _, left = solve(fit, 1 + pairs, 1 + pairs)
        return judge(search, memory, left, omega)
    is_done = _finish_fit(search, memory)
    if not is_done:
        begin_fit(search, memory, loop.passes)
    elif loop.found < count and loop.left > COMPLETE * loop.variance:
        begin_scan(search, memory)
    else:
        begin_check(search, memory, omega)
    return NOTHING


@kernel
def _finish_fit(search: FrequencySearch, memory: SearchMemory) -> bool:
    """Take a step of Gauss and Newton; return whether it was the last."""
    loop, fit, found = memory.loop[0], memory.fit, int(memory.loop[0].found)
    linear = 1 + 2 * search.orders.size * found
    loop.variance, loop.left = solve(fit, linear, linear + found)
    noise = max(loop.left, _LEAST_LEFT * loop.variance) / loop.window
    write_deviations(fit, linear, linear + found, noise)
    for i in range(linear - 1):
        fit.amplitude[i] = fit.solution[1 + i]
    largest, most = 0.0, _LARGEST_STEP / loop.window
    for j in range(found):
        step = min(max(fit.solution[linear + j], -most), most)
        before = fit.omega[j]
        fit.omega[j] = min(max(before + step, search.low), search.high)
        largest = max(largest, abs(fit.omega[j] - before))
    loop.passes += 1.0
    # The first pass with a new frequency finds only its amplitude.
    is_still = loop.passes > 1.0 and largest * loop.window < _CONVERGED
    return bool(found == 0 or is_still or loop.passes >= _MOST_PASSES)


@kernel
def _add_strongest_line(search: FrequencySearch, memory: SearchMemory) -> None:
    loop, fit, score = memory.loop[0], memory.fit, memory.score
    best, largest = 0, 0.0
    for i in range(search.lines.size):
        size = score[2 * i] * score[2 * i] + score[2 * i + 1] * score[2 * i + 1]
        if size > largest and search.lines[i] * loop.window >= 2.0 * math.pi:
            best, largest = i, size
    j, p = int(loop.found), search.orders.size
    fit.omega[j] = min(max(search.lines[best] / search.orders[0], search.low), search.high)
    for i in range(2 * j * p, 2 * (j + 1) * p):
        fit.amplitude[i] = 0.0
    loop.found += 1.0
