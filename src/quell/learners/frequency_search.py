"""The search of ``Harmonic`` for the frequencies of a load in the past.

Parameters and state of the search for frequencies, and the beginnings of its passes.

Search for the frequencies of a load in the past of f_plain.

The rotation of a pair (``learners/oscillators.py``) finds a frequency from a start that is near,
and one at a time: it needs many periods of the beat to separate sinusoids that are close to each
other, because each oscillator follows all of them. A least-squares fit over a window separates
them within a fraction of the beat. What is fitted is f_plain, the estimate of an ESO without
learner, which is the same whatever the learner feeds forward. For a plant that is linear in its
state,

    f_plain = c + W x^F + (b − b0) u^F + load^F,

with the lag F of the observer. While the loop or the learner is not yet steady, the terms of state
and u are no sinusoids of the load, so they are fitted, too, with x̂^F and u^F as given signals.

* **The ridge.** In the steady state x and u consist of the load's frequencies, so W and u would
  explain all of f_plain without a sinusoid. A ridge μ (``learners/oscillators.py``) makes
  sinusoids explain what both can. Lines are looked for with μ = 1, and refined with 1e-5.
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
  with the shortest.
* The oscillators take over those frequencies of a good fit that the window resolves. If one differs
  much from the oscillator's, its amplitude is learned anew.

The verdict on a fit of frequencies: what the oscillators take over, and what is fitted next.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import generic, kernel
from quell.kernels.functions import cos, is_single, sin
from quell.kernels.sized import Buffer, Scalars, Scratch, Size, clear
from quell.learners.base import lag_memory, lag_of, lag_push, reset_lag
from quell.learners.oscillators import (
    LineFit,
    Oscillators,
    add_row,
    begin_pass,
    fitted,
    line_fit,
    next_row,
    shift_amplitudes,
    solve,
    write_deviations,
)
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# ---- Parameters and state of the search for frequencies, and the beginnings of its passes ----

# Entries that are kept: 100 s at omega_o = 10 rad/s, a beat period of 0.3 and 0.36 rad/s; and those
# of the shortest window. The margin is not used, because a pass lasts up to an entry.
ENTRIES, SHORTEST, MARGIN = 520, 32, 8

SCAN, FIT, REFINE = 1.0, 2.0, 3.0


class FrequencySearch(NamedTuple):
    """Parameters."""

    lag: Any  # lag filter of u
    states: Size  # number n of state features
    orders: Vector  # multiples of each frequency (p,)
    lines: Buffer  # frequencies of a scan [rad/entry] (K,)
    spacing: float  # samples of an entry
    step: float  # duration of an entry [s]
    follow: float  # share by which the lag of the signals follows in a sample, 1 without
    rows: int  # entries of a pass in each sample
    shortest: float  # entries of the shortest window
    low: float  # least frequency [rad/entry]
    high: float  # largest frequency [rad/entry]


class SearchLoop(Scalars):
    """Scalars of the search."""

    samples: float  # samples of the entry that is not complete
    entries: float  # number of complete entries
    stage: float  # scan, fit or refine; 0 before the first
    newest: float  # number of entries at the beginning of the pass
    row: float  # row of the pass
    window: float  # rows of a pass
    found: float  # number of frequencies in the fit
    passes: float  # of a fit or refinement
    without: float  # sum of squares that state and u leave without sinusoids
    share: float  # share of it that the fit leaves
    rest: float  # sum of squares that the fit leaves with the ridge of its stage
    continues: float  # 1 if the last fit was good
    level: float  # ``rest`` of the last good fit for each entry
    start: float  # number of entries before its window
    good_found: float  # number of its frequencies


class SearchMemory(NamedTuple):
    """State of a search for m frequencies."""

    # f_plain, state and u of the last entries, as a ring (L (2 + n),)
    past: Buffer
    chain: Matrix  # lag filter of u (1, …)
    late: Vector  # the signals through their lag (2 + n,)
    total: Vector  # sums of that over the samples of the entry that is not complete (2 + n,)
    wave: Buffer  # sin and cos of each line at this row (2K,)
    turn: Buffer  # sin and cos of the angle from one row to the next (2K,)
    score: Buffer  # correlation of the rest with each line (2K,)
    fit: LineFit
    good: Vector  # frequencies of the last good fit [rad/entry] (m,)
    # Standard deviation [rad/entry] of the frequency that an oscillator has from a fit, else 0 (m,)
    adopted: Vector
    taken: Scratch  # 1 for an oscillator that has a frequency of this fit (m,)
    loop: NDArray[SearchLoop]  # (1,)


@kernel
def _count(memory: SearchMemory) -> int:
    """Return the number of frequencies in the fit; one that there can be whatever the state has."""
    return min(max(int(memory.loop[0].found), 0), memory.good.size)


@kernel
def search_from_nothing(search: FrequencySearch, memory: SearchMemory, window: float) -> None:
    """Begin with no sinusoid, in the newest ``window`` entries."""
    loop = memory.loop[0]
    loop.window, loop.found, loop.continues = window, 0.0, 0.0
    begin_fit(search, memory, FIT)


@kernel
def begin_fit(search: FrequencySearch, memory: SearchMemory, stage: float) -> None:
    """Begin to fit the frequencies found so far, or to refine them, as ``stage`` says."""
    memory.loop[0].stage, memory.loop[0].passes = stage, 0.0
    begin_rows(search, memory)


@kernel
def begin_scan(search: FrequencySearch, memory: SearchMemory) -> None:
    """Begin the pass that looks for the strongest line in what the fit leaves."""
    memory.loop[0].stage = SCAN
    begin_rows(search, memory)
    for i in range(search.lines.size):
        angle = -search.lines[i]
        memory.turn[2 * i], memory.turn[2 * i + 1] = sin(angle), cos(angle)
        memory.wave[2 * i], memory.wave[2 * i + 1] = 0.0, 1.0
        memory.score[2 * i] = memory.score[2 * i + 1] = 0.0


@kernel
def begin_rows(search: FrequencySearch, memory: SearchMemory) -> None:
    """Begin a pass over the window with its newest row."""
    loop, fit = memory.loop[0], memory.fit
    shift_amplitudes(search.orders, fit, _count(memory), loop.entries - loop.newest)
    loop.row, loop.newest = 0.0, loop.entries
    begin_pass(search.orders, fit, _count(memory))


# ---- The verdict on a fit of frequencies ----

# The constants were chosen by hand on 50 random loops each for four factors between two frequencies
# (`benchmarks/close_frequencies.py --seed 2` to 5; studies/notes/harmonic.md).
# Share of what state and u leave that a good fit may leave. The fits with right frequencies in 60
# loops left 0.07 at most in nine of ten, those of windows that contain the start of the load 0.3 or
# more, and those of coloured loads 0.8.
_GOOD = 0.1
# By how much a window grows while the fit is good, and how many times more it may then leave for
# each sample: a window with the start of the load leaves several times more.
_GROWTH, _WORSE = 1.25, 1.3
# By how much the window of the next search is longer.
_LONGER = 1.5
# Share of what state and u leave that does not count as worse: the rounding of a fit without noise.
COMPLETE = 1e-4
# What a window resolves: phase of a frequency over the window, of the difference of two, and of the
# standard deviation of a frequency [rad]. An oscillator that is off by more than that is wrong.
_PHASE, _APART, _DOUBT = 4.0, 3.0, 0.3

NOTHING, ADOPT, LEARN_ANEW = 0, 1, 2
"""Results of a search: none; frequencies; frequencies that need other amplitudes."""


@kernel
def judge(search: FrequencySearch, memory: SearchMemory, omega: Vector) -> int:
    """Decide about a refined fit: write frequencies into ``omega``, and begin the next one."""
    loop, fit = memory.loop[0], memory.fit
    longest = min(loop.entries, float(ENTRIES - MARGIN))
    good = loop.share <= _GOOD
    if loop.continues > 0.0:
        least = COMPLETE * loop.without / loop.window
        good = good and loop.rest <= loop.window * max(_WORSE * loop.level, least)
    if good:
        result = _adopt(search, memory, omega)
        loop.continues, loop.level = 1.0, loop.rest / loop.window
        loop.start, loop.good_found = loop.newest - loop.window, loop.found
        for j in range(_count(memory)):
            memory.good[j] = fit.omega[j]
        loop.found = _resolved(memory)
        loop.window = float(math.floor(min(_GROWTH * loop.window, longest)))
        _fit_again(search, memory)
        return result
    if loop.continues > 0.0:
        # From where the last good window began, with its frequencies.
        loop.continues, loop.found = 0.0, loop.good_found
        for j in range(_count(memory)):
            fit.omega[j] = memory.good[j]
        loop.window = min(loop.entries - loop.start, longest)
        _fit_again(search, memory)
        return NOTHING
    longer = float(math.floor(_LONGER * loop.window))
    if longer > longest:
        longer = search.shortest
        for j in range(memory.adopted.size):
            memory.adopted[j] = 0.0
    search_from_nothing(search, memory, longer)
    return NOTHING


@kernel
def _fit_again(search: FrequencySearch, memory: SearchMemory) -> None:
    """Continue with the frequencies that there are; look for more if some are missing."""
    some_missing = memory.loop[0].found < memory.fit.omega.size
    begin_fit(search, memory, FIT if some_missing else REFINE)


@kernel
def _resolved(memory: SearchMemory) -> float:
    """Return the number of frequencies up to the last one that the window resolves; at least 1."""
    found = 1.0
    for j in range(1, _count(memory)):
        if _is_resolved(memory.loop[0], memory.fit, j):
            found = j + 1.0
    return found


@kernel
def _adopt(search: FrequencySearch, memory: SearchMemory, omega: Vector) -> int:
    """Set the oscillators to the frequencies of the fit that are certain."""
    loop, fit, adopted = memory.loop[0], memory.fit, memory.adopted
    result, taken = NOTHING, memory.taken
    for i in range(omega.size):
        taken[i] = 0.0
    for j in range(_count(memory)):
        if not _is_resolved(loop, fit, j):
            continue
        i = max(_oscillator_for(search, memory, omega, taken, fit.omega[j]), 0)
        taken[i] = 1.0
        is_new = abs(omega[i] * search.step - fit.omega[j]) * loop.window > _DOUBT
        if is_new or adopted[i] == 0.0 or fit.deviation[j] < _WORSE * adopted[i]:
            omega[i] = fit.omega[j] / search.step
            adopted[i] = fit.deviation[j]
            result = LEARN_ANEW if is_new else max(result, ADOPT)
    return result


@kernel
def _oscillator_for(
    search: FrequencySearch, memory: SearchMemory, omega: Vector, taken: Vector, frequency: float
) -> int:
    """Return the oscillator that is not taken and follows a frequency of the fit [rad/entry].

    It is the one that has this frequency already, as far as the window resolves, or else one that
    has none from a fit, or else the nearest. The fit may find the frequencies in another order than
    before, and amplitudes belong to their oscillators.
    """
    nearest, free, least = -1, -1, 0.0
    for i in range(omega.size):
        if taken[i] > 0.0:
            continue
        if memory.adopted[i] == 0.0:
            free = i if free < 0 else free
            continue
        away = abs(omega[i] * search.step - frequency)
        if nearest < 0 or away < least:
            nearest, least = i, away
    if free < 0 or (nearest >= 0 and least * memory.loop[0].window < _APART):
        return nearest
    return free


@kernel
def _is_resolved(loop: SearchLoop, fit: LineFit, j: int) -> bool:
    """Return whether the window is long enough for frequency ``j``."""
    resolved = fit.deviation[j] * loop.window < _DOUBT and fit.omega[j] * loop.window >= _PHASE
    for k in range(min(max(int(loop.found), 0), fit.omega.size)):
        apart = abs(fit.omega[j] - fit.omega[k]) * loop.window
        resolved = resolved and (k == j or apart >= _APART)
    return bool(resolved)


# ---- Search for the frequencies of a load in the past of f_plain ----

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
    width, newest = memory.late.size, int(loop.newest) % ENTRIES + ENTRIES - 1
    row = min(max(int(loop.row), 0), ENTRIES - 1)
    at, last = (newest - row) % ENTRIES * width, newest % ENTRIES * width
    value = past[at]
    # Less the newest values, so that a set-point far from zero costs no digits.
    for i in range(fit.signal.size):
        fit.signal[i] = past[at + 1 + i] - past[last + 1 + i]
    pairs = 2 * search.orders.size * _count(memory)
    if loop.stage == SCAN:
        rest = value - fit.solution[0] - fitted(fit, pairs)
        for i in range(fit.signal.size):
            rest -= fit.solution[1 + i] * fit.signal[i]
        _add_to_scores(memory, rest * sin(math.pi * (loop.row + 0.5) / loop.window) ** 2)
    else:
        add_row(search.orders, fit, _count(memory), -loop.row, value)
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
    loop, fit, found = memory.loop[0], memory.fit, _count(memory)
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
    j, p = min(_count(memory), fit.omega.size - 1), search.orders.size
    fit.omega[j] = min(max(search.lines[best] / search.orders[0], search.low), search.high)
    for i in range(2 * j * p, 2 * (j + 1) * p):
        fit.amplitude[i] = 0.0
    loop.found += 1.0
