"""Rules and state of the supervisor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.scalars import Scalars

# Number of changes of mode that are kept (96 KiB). The last ones are reserved for the end of the
# run, which takes two: RAMP and STOPPED.
_KEPT, RESERVED = 4096, 4


class Rules(NamedTuple):
    """The supervisor's rules; ``Safety.rules`` makes them."""

    low: float  #: lower limit of u [u-unit], ≤ 0
    high: float  #: upper limit, ≥ 0
    most_error: float  #: largest ``|r − y|`` [y-unit]
    most_f: float  #: largest ``|f̂|`` [y-unit/s^n]
    hold: int
    ramp: int
    settle: int
    most_saturated: int
    most_overruns: int
    y_low: float = -np.inf  #: plausible range of y [y-unit]
    y_high: float = np.inf
    longest_start: int = 1 << 60  #: samples after which START is given up
    direction: float = 0.0  #: sign of b0; 0 for no check of the first motion
    reach: float = np.nan  #: error at which the law puts u to its limit [y-unit]

    def text(self, dt: float) -> str:
        """Return the rules as a line of text, for a sample time ``dt`` [s]."""
        parts = [f"u from {self.low:.6g} to {self.high:.6g}"]
        if np.isfinite([self.y_low, self.y_high]).any():
            parts.append(f"y from {self.y_low:.6g} to {self.y_high:.6g}")
        if np.isfinite(self.most_error):
            parts.append(f"|r − y| up to {self.most_error:.6g}")
        if np.isfinite(self.most_f):
            parts.append(f"|f̂| up to {self.most_f:.6g}")
        parts.append("first motion checked" if self.direction else "first motion not checked")
        for name in ("settle", "hold", "ramp", "most_overruns", "most_saturated"):
            samples = getattr(self, name)
            if samples * dt < 1e9:
                parts.append(f"{name} {samples} samples ({samples * dt:.6g} s)")
        return ", ".join(parts)


class Memory(Scalars):
    """State of the supervisor from one cycle to the next."""

    mode: int
    samples: int  #: good samples in a row in START, cycles so far in RAMP and STOPPED
    began: int  #: index k of the scenario's first sample; −1 before it
    missed_in_row: int  #: deadlines without a good sample, those that were skipped included
    skipped_in_row: int
    at_limit_in_row: int  #: samples with u at a limit
    overruns_in_row: int
    unsent_in_row: int
    tripped: int  #: not zero if the device has set u to zero for good
    u: float  #: as applied [u-unit]
    ramp_start: float  #: u at the beginning of the ramp [u-unit]
    y: float  #: last good measurement [y-unit]; NaN before the first
    offset: float  #: distance from the reference to y at the scenario's first sample [y-unit]
    y_rest_low: float  #: least y since the first cycle, before the scenario [y-unit]
    y_rest_high: float  #: largest
    y_began: float  #: y at the scenario's first sample [y-unit]
    pushed: float  #: sum of u since then, with the sign of b0 [u-unit]
    watching: int  #: how the first motion is judged, see ``quell.realtime.loop.direction``


class Counters(Scalars):
    """Counters of a run; the first fields of ``quell.realtime.loop.result.Tally``, in its order."""

    cycles: int
    overruns: int
    skipped: int
    missed: int
    clipped: int
    unsent: int


class SupervisorState(NamedTuple):
    """State of the supervisor, which the loop writes and another thread may read."""

    memory: NDArray[Memory]
    counters: NDArray[Counters]
    changes: NDArray[np.int64]  #: k, mode and cause of each change of mode (·, 3)
    changed: NDArray[np.int64]  #: number of changes of mode that are kept (1,), an atomic word
    requests: NDArray[np.int64]  #: a ``Request`` (1,), an atomic word that another thread writes


def initial_state() -> SupervisorState:
    """Return the state before the first cycle."""
    memory, changed, requests = Memory.zeros(), np.zeros(1, np.int64), np.zeros(1, np.int64)
    memory[0].began, memory[0].y = -1, np.nan
    memory[0].y_rest_low, memory[0].y_rest_high = np.inf, -np.inf
    changes = np.zeros((_KEPT, 3), np.int64)
    return SupervisorState(memory, Counters.zeros(), changes, changed, requests)
