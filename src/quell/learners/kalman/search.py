"""Search for the frequencies of a load in the past of f_plain.

The rotation of a pair (``oscillators.py``) finds a frequency from a start that is near, and one at
a time: it needs many periods of the beat to separate sinusoids that are close to each other,
because each oscillator follows all of them. A least-squares fit over a window separates them within
a fraction of the beat. What is fitted is f_plain, the estimate of an ESO without learner, which is
the same whatever the learner feeds forward. For a plant that is linear in its state,

    f_plain = c + W x^F + (b − b0) u^F + load^F,

with the lag F of the observer. While the loop or the learner is not yet steady, the terms of state
and u are no sinusoids of the load, so they are fitted, too, with x̂^F and u^F as given signals.

* **The ridge.** In the steady state x and u consist of the load's frequencies, so W and u would
  explain all of f_plain without a sinusoid. A ridge μ (``line_fit.py``) makes sinusoids explain
  what both can. Lines are looked for with μ = 1, and refined with 1e-5.
* All signals pass a first-order lag of ``1/(3 omega_c)``, because f_plain is y differentiated n
  times, and noise covers a small load in it. A search for several orders has no lag: the higher
  ones tell the frequency best. The results are averaged over entries of ``2/omega_o``, of which the
  last 512 are kept.
* A search begins with the shortest window and no sinusoid. It looks for the strongest line in what
  is left (*scan*), adds it, fits all frequencies (*fit*), and so on: relaxation after Li & Stoica,
  *Efficient mixed-spectrum estimation with applications to target feature extraction*, IEEE Trans.
  Signal Processing 44 (1996). Then it *refines* all of them with the small ridge.
* A fit is good if it leaves a small share of what state and u leave without sinusoids: either with
  μ = 0.1, which shows it in the steady state, or with 1e-5, which shows it where the loop
  moves more than the load makes it. The window grows and the fit is continued as long as it is
  good, so its frequencies become ever more exact; a window that contains a change of the load does
  not fit. If nothing fits, the next search begins anew with a longer window, and after the longest
  with the shortest (``search_verdict.py``).
* The oscillators take over those frequencies of a good fit that the window resolves. If one differs
  much from the oscillator's, its amplitude is learned anew.
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
    ENTRIES,
    FIT,
    MARGIN,
    REFINE,
    SCAN,
    SHORTEST,
    FrequencySearch,
    SearchLoop,
    SearchMemory,
    begin_fit,
    begin_rows,
    begin_scan,
    search_from_nothing,
)
from quell.learners.kalman.search_verdict import COMPLETE, NOTHING, judge
from quell.learners.lag import lag_memory, lag_of, lag_push, reset_lag
from quell.observers.eso import ESO
from quell.types import Vector

# Bandwidth of the signals' lag as a multiple of omega_c.
_BANDWIDTH = 3.0
# Lines of a scan between the limits: 9 % apart for the default limits, a third of the width of a
# line in the window in which it is found.
_LINES = 64
# Gauss-Newton steps of a fit at most; a step of the phase over the window that ends it [rad]; and
# the largest step, a third of the distance of two lines [rad].
_MOST_PASSES, _CONVERGED, _LARGEST_STEP = 12, 0.02, 2.0
# Ridges with which lines are looked for; with which they are refined, also in single precision,
# where sums are less exact; and with which a fit is judged besides: with the small ridge, state and
# u leave little more than noise in the steady state.
_LOOKING, _REFINING, _REFINING_SINGLE, _JUDGING = 1.0, 1e-5, 1e-4, 0.1
# Least share of what state and u leave that counts as noise: rounding.
_ROUNDING, _ROUNDING_SINGLE = 1e-9, 1e-5
# Shortest window, in units of 1/omega_c: transients of the loop last some ten.
_LOOP_TIMES = 16.0
# Numbers of entries are counted up to this, and then are less by a multiple of the ring's length:
# in single precision a count ends at 2²⁴.
_WRAP = 4096.0 * ENTRIES
_MOST_ENTRIES = 2.0 * _WRAP
# The square of f_plain, summed over a window, is still finite; in single precision, too.
_ABSURD, _ABSURD_SINGLE = 1e100, 1e16


class NoSearch(NamedTuple):
    """Parameters and state of a learner that does not search."""


def frequency_search(
    observer: ESO, omega_c: float, oscillators: Oscillators, states: int
) -> FrequencySearch:
    """Return a search for the frequencies of oscillators, with n ``states`` as given signals."""
    # In units of the observer's bandwidth, whatever its tuning: N over its lag.
    spacing = max(round(2.0 * observer.lag_time / (observer.estimates * observer.dt)), 1)
    step = spacing * observer.dt
    low, high = oscillators.low * step, oscillators.high * step
    lines = np.geomspace(low, high, _LINES) * oscillators.orders[0]
    several = oscillators.orders.size > 1
    shortest = max(float(SHORTEST), math.floor(_LOOP_TIMES / (omega_c * step)))
    return FrequencySearch(
        lag=lag_of(observer),
        states=states,
        orders=oscillators.orders,
        lines=lines,
        spacing=float(spacing),
        step=step,
        follow=1.0 if several else -math.expm1(-_BANDWIDTH * omega_c * observer.dt),
        rows=math.ceil(ENTRIES / spacing),
        shortest=float(min(shortest, ENTRIES - MARGIN)),
        low=low,
        high=high,
    )


def search_memory(search: Any, oscillators: Oscillators) -> Any:
    """Return the state before the first sample."""
    if isinstance(search, NoSearch):
        return search
    count, signals = oscillators.omega.size, 2 + search.states
    return SearchMemory(
        past=np.zeros(ENTRIES * signals),
        chain=lag_memory(search.lag, 1),
        late=np.zeros(signals),
        total=np.zeros(signals),
        wave=np.zeros(2 * _LINES),
        turn=np.zeros(2 * _LINES),
        score=np.zeros(2 * _LINES),
        fit=line_fit(count, oscillators.orders.size, signals - 1),
        good=np.zeros(count),
        adopted=np.zeros(count),
        taken=np.zeros(count),
        loop=SearchLoop.zeros(),
    )


@generic
def advance_search(
    search: Any, memory: Any, f_plain: float, filtered: Vector, u: float, omega: Vector
) -> int:
    """Continue the search with a sample.

    ``filtered`` begins with the lag-filtered state, and ``u`` acted before the sample. Write
    frequencies into ``omega`` (m,) [rad/s] when there is a good fit, and return what is new.
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
def _advance_nothing(
    search: NoSearch, memory: NoSearch, f_plain: float, filtered: Vector, u: float, omega: Vector
) -> int:
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
    reset_lag(memory.chain)
    for i in range(memory.total.size):
        memory.total[i] = 0.0
    for j in range(memory.adopted.size):
        memory.adopted[j] = 0.0


@advance_search.register(FrequencySearch)
def _advance(
    search: FrequencySearch,
    memory: SearchMemory,
    f_plain: float,
    filtered: Vector,
    u: float,
    omega: Vector,
) -> int:
    loop = memory.loop[0]
    absurd = _ABSURD_SINGLE if is_single(search.step) else _ABSURD
    if not (abs(f_plain) < absurd and abs(u) < absurd):
        start_search_again(search, memory)
        return NOTHING
    _add_sample(search, memory, f_plain, filtered, u)
    if loop.entries >= _MOST_ENTRIES:
        loop.entries -= _WRAP
        loop.newest -= _WRAP
        loop.start -= _WRAP
    if loop.stage == 0.0:
        if loop.entries < search.shortest:
            return NOTHING
        search_from_nothing(search, memory, search.shortest)
    if loop.row >= loop.window:
        return _finish_pass(search, memory, omega)
    for _ in range(search.rows):
        if loop.row < loop.window:
            _take_row(search, memory)
    return NOTHING


@kernel
def _add_sample(
    search: FrequencySearch, memory: SearchMemory, f_plain: float, filtered: Vector, u: float
) -> None:
    """Add f_plain, the state and u to the entry that is not complete."""
    loop, total = memory.loop[0], memory.total
    _add_signal(search, memory, 0, f_plain)
    for i in range(search.states):
        _add_signal(search, memory, 1 + i, filtered[i])
    _add_signal(search, memory, total.size - 1, lag_push(search.lag, memory.chain, 0, u))
    loop.samples += 1.0
    if loop.samples >= search.spacing:
        at = int(loop.entries) % ENTRIES * total.size
        for i in range(total.size):
            memory.past[at + i] = total[i] / loop.samples
            total[i] = 0.0
        loop.entries += 1.0
        loop.samples = 0.0


@kernel
def _add_signal(search: FrequencySearch, memory: SearchMemory, i: int, value: float) -> None:
    """Add ``value`` through the lag, which begins at the first one, to the sum of signal ``i``."""
    late = memory.late
    if memory.loop[0].entries == 0.0 and memory.loop[0].samples == 0.0:
        late[i] = value
    late[i] += search.follow * (value - late[i])
    memory.total[i] += late[i]


@kernel
def _take_row(search: FrequencySearch, memory: SearchMemory) -> None:
    loop, fit, past = memory.loop[0], memory.fit, memory.past
    width, newest = memory.late.size, int(loop.newest) - 1
    at, last = (newest - int(loop.row)) % ENTRIES * width, newest % ENTRIES * width
    value = past[at]
    # Less the newest values, so that a set-point far from zero costs no digits.
    for i in range(fit.signal.size):
        fit.signal[i] = past[at + 1 + i] - past[last + 1 + i]
    pairs = 2 * search.orders.size * int(loop.found)
    if loop.stage == SCAN:
        rest = value - fit.solution[0] - fitted(fit, pairs)
        for i in range(fit.signal.size):
            rest -= fit.solution[1 + i] * fit.signal[i]
        _add_to_scores(memory, rest * sin(math.pi * (loop.row + 0.5) / loop.window) ** 2)
    else:
        add_row(search.orders, fit, int(loop.found), -loop.row, value)
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
    loop = memory.loop[0]
    if loop.stage == SCAN:
        _add_strongest_line(search, memory)
        begin_fit(search, memory, FIT)
    elif not _finish_fit(search, memory):
        begin_rows(search, memory)
    elif loop.stage == REFINE:
        return judge(search, memory, omega)
    elif loop.found < memory.fit.omega.size and loop.share > COMPLETE:
        begin_scan(search, memory)
    else:
        begin_fit(search, memory, REFINE)
    return NOTHING


@kernel
def _finish_fit(search: FrequencySearch, memory: SearchMemory) -> bool:
    """Take a step of Gauss and Newton; return whether it was the last."""
    loop, fit, found = memory.loop[0], memory.fit, int(memory.loop[0].found)
    first = 1 + fit.signal.size
    linear = first + 2 * search.orders.size * found
    size = linear + found
    loop.without, left = solve(fit, linear, size, _JUDGING if loop.stage == REFINE else _LOOKING)
    without, loop.rest = loop.without, left
    if loop.stage == REFINE:
        refining = _REFINING_SINGLE if is_single(search.step) else _REFINING
        rounding = _ROUNDING_SINGLE if is_single(search.step) else _ROUNDING
        without, loop.rest = solve(fit, linear, size, refining)
        variance = max(loop.rest, rounding * loop.without) / loop.window
        write_deviations(fit, linear, size, variance)
    loop.share = 1.0
    if loop.without > 0.0 and without > 0.0:
        loop.share = min(left / loop.without, loop.rest / without)
    for i in range(linear - first):
        fit.amplitude[i] = fit.solution[first + i]
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
