"""The verdict on a fit of frequencies: what the oscillators take over, and what is fitted next."""

from __future__ import annotations

import math

from quell.kernels.dispatch import kernel
from quell.learners.kalman.line_fit import LineFit
from quell.learners.kalman.search_state import (
    ENTRIES,
    FIT,
    MARGIN,
    REFINE,
    FrequencySearch,
    SearchLoop,
    SearchMemory,
    begin_fit,
    search_from_nothing,
)
from quell.types import Vector

# The constants were chosen by hand on 50 random loops each for four factors between two frequencies
# (`benchmarks/close_frequencies.py --seed 2` to 5; docs/theory).
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
        for j in range(int(loop.found)):
            memory.good[j] = fit.omega[j]
        loop.found = _resolved(memory)
        loop.window = float(math.floor(min(_GROWTH * loop.window, longest)))
        _fit_again(search, memory)
        return result
    if loop.continues > 0.0:
        # From where the last good window began, with its frequencies.
        loop.continues, loop.found = 0.0, loop.good_found
        for j in range(int(loop.found)):
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
    for j in range(1, int(memory.loop[0].found)):
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
    for j in range(int(loop.found)):
        if not _is_resolved(loop, fit, j):
            continue
        i = _oscillator_for(search, memory, omega, taken, fit.omega[j])
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
    for k in range(int(loop.found)):
        apart = abs(fit.omega[j] - fit.omega[k]) * loop.window
        resolved = resolved and (k == j or apart >= _APART)
    return bool(resolved)
