"""The verdict on a fit of frequencies: what the oscillators take over, and what is fitted next."""

from __future__ import annotations

import math

from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single
from quell.learners.kalman.line_fit import LineFit
from quell.learners.kalman.search_state import (
    ENTRIES,
    MARGIN,
    SHORTEST,
    FrequencySearch,
    SearchLoop,
    SearchMemory,
    begin_fit,
    search_from_nothing,
)
from quell.types import Vector

# The constants were chosen by hand on 25 random loops each for four factors between two frequencies
# (`benchmarks/close_frequencies.py --seed 0`).
# By how much a window grows while the fit is good, and how many times more it may then leave for
# each sample: a window with the start of the load leaves several times more.
_GROWTH, _WORSE = 1.25, 1.3
# Share of the variance that does not count as worse: the rounding of a fit without noise.
COMPLETE = 1e-4
# How many times more the frequencies of the oscillators leave if they count as wrong.
_WRONG = 4.0
# Share of the variance that rounding leaves in single precision.
_ROUNDING_SINGLE = 1e-5
# What a window resolves: phase of a frequency over the window, of the difference of two, and of the
# standard deviation of a frequency [rad].
_PHASE, _APART, _DOUBT = 5.0, 1.5, 0.2

NOTHING, ADOPT, LEARN_ANEW = 0, 1, 2
"""Results of a search: none; frequencies; frequencies that need other amplitudes."""


@kernel
def judge(search: FrequencySearch, memory: SearchMemory, left: float, omega: Vector) -> int:
    """Decide about a fit; ``left`` is what the frequencies ``omega`` of the oscillators leave."""
    loop = memory.loop[0]
    longest = min(loop.entries, float(ENTRIES - MARGIN))
    good = loop.found > 0.0 and loop.left <= search.good * loop.variance
    if loop.continues > 0.0:
        least = COMPLETE * loop.variance / loop.window
        good = good and loop.left <= loop.window * max(_WORSE * loop.level, least)
    if good:
        loop.level = loop.left / loop.window
        result = _adopt(search, memory, left, omega)
        loop.continues = 1.0
        _fit_again(search, memory, float(math.floor(min(_GROWTH * loop.window, longest))))
        return result
    if loop.continues > 0.0:
        loop.continues = 0.0
        shorter = float(math.floor(loop.window / _GROWTH))
        _fit_again(search, memory, max(shorter, float(SHORTEST)))
        return NOTHING
    if loop.found > 0.0:
        for j in range(memory.adopted.size):
            memory.adopted[j] = 0.0
    following = 2.0 * loop.window
    shortest = float(SHORTEST)
    search_from_nothing(search, memory, following if following <= longest else shortest)
    return NOTHING


@kernel
def _fit_again(search: FrequencySearch, memory: SearchMemory, window: float) -> None:
    """Continue with another window, from the frequencies that are certain."""
    loop, found = memory.loop[0], 1
    for j in range(1, int(loop.found)):
        if _is_resolved(loop, memory.fit, j):
            found = j + 1
    loop.window, loop.found = window, float(found)
    begin_fit(search, memory, 0.0)


@kernel
def _adopt(search: FrequencySearch, memory: SearchMemory, left: float, omega: Vector) -> int:
    """Set the oscillators to the frequencies of the fit that are certain."""
    loop, fit, adopted = memory.loop[0], memory.fit, memory.adopted
    result = NOTHING
    if loop.window < search.shortest or loop.left > search.certain * loop.variance:
        return result
    least = max(loop.left, _ROUNDING_SINGLE * loop.variance) if is_single(left) else loop.left
    for j in range(int(loop.found)):
        if not _is_resolved(loop, fit, j):
            continue
        is_new = adopted[j] == 0.0 or left > _WRONG * least
        if is_new or fit.deviation[j] < _WORSE * adopted[j]:
            omega[j] = fit.omega[j] / search.step
            adopted[j] = fit.deviation[j]
            result = LEARN_ANEW if is_new else max(result, ADOPT)
    return result


@kernel
def _is_resolved(loop: SearchLoop, fit: LineFit, j: int) -> bool:
    """Return whether the window is long enough for frequency ``j``."""
    resolved = fit.deviation[j] * loop.window < _DOUBT and fit.omega[j] * loop.window >= _PHASE
    for k in range(int(loop.found)):
        apart = abs(fit.omega[j] - fit.omega[k]) * loop.window
        resolved = resolved and (k == j or apart >= _APART)
    return bool(resolved)
