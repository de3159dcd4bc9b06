"""Parameters and state of the search for frequencies, and the beginnings of its passes."""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

from quell.kernels.dispatch import kernel
from quell.kernels.functions import cos, sin
from quell.kernels.scalars import Scalars
from quell.kernels.sized import Buffer, Scratch, Size
from quell.learners.kalman.line_fit import LineFit, begin_pass, shift_amplitudes
from quell.types import Matrix, Vector

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
    shift_amplitudes(search.orders, fit, int(loop.found), loop.entries - loop.newest)
    loop.row, loop.newest = 0.0, loop.entries
    begin_pass(search.orders, fit, int(loop.found))
