"""Parameters and state of the search for frequencies, and the beginnings of its passes."""

from __future__ import annotations

from typing import NamedTuple

from numpy.typing import NDArray

from quell.kernels.dispatch import kernel
from quell.kernels.functions import cos, sin
from quell.kernels.scalars import Scalars
from quell.kernels.sized import Buffer
from quell.learners.kalman.line_fit import LineFit, begin_pass, shift_amplitudes
from quell.types import Vector

# Entries that are kept: 100 s at omega_o = 10 rad/s, a beat period of 0.3 and 0.36 rad/s; and those
# of the shortest window. The margin is not used, because a pass lasts up to an entry.
ENTRIES, SHORTEST, MARGIN = 520, 32, 8

SCAN, FIT, CHECK = 1.0, 2.0, 3.0


class FrequencySearch(NamedTuple):
    """Parameters."""

    orders: Vector  # multiples of each frequency (p,)
    lines: Buffer  # frequencies of a scan [rad/entry] (K,)
    spacing: float  # samples of an entry
    step: float  # duration of an entry [s]
    follow: float  # share by which the lag of 1/omega_c follows in a sample, 1 without
    rows: int  # entries of a pass in each sample
    good: float  # share of the variance that a fit may leave which is continued
    certain: float  # the same for a fit whose frequencies are used
    shortest: float  # entries of the shortest window whose frequencies are used
    low: float  # least frequency [rad/entry]
    high: float  # largest frequency [rad/entry]


class SearchLoop(Scalars):
    """Scalars of the search."""

    late: float  # f_plain through that lag
    total: float  # sum of that over the samples of the entry that is not complete
    samples: float  # their number
    entries: float  # number of complete entries
    stage: float  # scan, fit or check; 0 before the first
    newest: float  # number of entries at the beginning of the pass
    row: float  # row of the pass
    window: float  # rows of a pass
    found: float  # number of frequencies in the fit
    passes: float  # since a frequency was added
    level: float  # mean square that the last good fit left
    continues: float  # 1 if the fit of the last window was good
    variance: float  # sum of squares about the mean in the window
    left: float  # sum of squares that the fit leaves


class SearchMemory(NamedTuple):
    """State of a search for m frequencies."""

    past: Buffer  # the last entries, as a ring (L,)
    wave: Buffer  # sin and cos of each line at this row (2K,)
    turn: Buffer  # sin and cos of the angle from one row to the next (2K,)
    score: Buffer  # correlation of the rest with each line (2K,)
    fit: LineFit
    # Standard deviation [rad/entry] of the frequency that an oscillator has from a fit, else 0 (m,)
    adopted: Vector
    loop: NDArray[SearchLoop]  # (1,)


@kernel
def search_from_nothing(search: FrequencySearch, memory: SearchMemory, window: float) -> None:
    """Begin with no sinusoid, in the newest ``window`` entries."""
    loop = memory.loop[0]
    loop.window, loop.found, loop.continues = window, 0.0, 0.0
    begin_fit(search, memory, 0.0)


@kernel
def begin_fit(search: FrequencySearch, memory: SearchMemory, passes: float) -> None:
    """Begin a pass of the fit; ``passes`` were made since a frequency was added."""
    loop, fit = memory.loop[0], memory.fit
    shift_amplitudes(search.orders, fit, int(loop.found), loop.entries - loop.newest)
    _begin(loop, FIT)
    loop.passes = passes
    begin_pass(search.orders, fit, fit.omega, 1.0, int(loop.found))


@kernel
def begin_scan(search: FrequencySearch, memory: SearchMemory) -> None:
    """Begin the pass that looks for the strongest line in what the fit leaves."""
    loop, fit = memory.loop[0], memory.fit
    shift_amplitudes(search.orders, fit, int(loop.found), loop.entries - loop.newest)
    _begin(loop, SCAN)
    begin_pass(search.orders, fit, fit.omega, 1.0, int(loop.found))
    for i in range(search.lines.size):
        angle = -search.lines[i]
        memory.turn[2 * i], memory.turn[2 * i + 1] = sin(angle), cos(angle)
        memory.wave[2 * i], memory.wave[2 * i + 1] = 0.0, 1.0
        memory.score[2 * i] = memory.score[2 * i + 1] = 0.0


@kernel
def begin_check(search: FrequencySearch, memory: SearchMemory, omega: Vector) -> None:
    """Begin a pass with the frequencies ``omega`` of the oscillators (m,) [rad/s]."""
    _begin(memory.loop[0], CHECK)
    begin_pass(search.orders, memory.fit, omega, search.step, omega.size)


@kernel
def _begin(loop: SearchLoop, stage: float) -> None:
    loop.stage, loop.row, loop.newest = stage, 0.0, loop.entries
