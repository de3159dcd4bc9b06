"""Histograms of durations, which the loop fills without allocating memory.

The width of the bins grows with the duration, as in Gil Tene's HdrHistogram: each power of two is
divided into 32 bins, so that a bin is at most 3.1 % wide. Up to 64 ns a bin is 1 ns wide. The
longest duration is stored exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.kernels.dispatch import kernel
from quell.types import Vector

# Bins per power of two; a percentile is rounded by at most 1/32 = 3.1 %. Chosen by hand.
_PARTS = 32
# Below this duration [ns] a bin is 1 ns wide.
_LINEAR = 2 * _PARTS
# Powers of two above that: up to 2^44 ns, which is 4.9 hours.
_OCTAVES = 38
BINS = _LINEAR + _PARTS * _OCTAVES
# The entry after the bins is the longest duration.
LONGEST = BINS

# Width of the longest bar in text, in characters: a line then fits into 80 columns.
_BAR = 48


def empty_counts() -> NDArray[np.int64]:
    """Return the counts of an empty histogram (BINS + 1,), for ``count_duration``."""
    return np.zeros(BINS + 1, dtype=np.int64)


@kernel
def count_duration(counts: NDArray[np.int64], nanoseconds: int) -> None:
    """Add a duration [ns] to a histogram."""
    size, index = max(nanoseconds, 0), 0
    while size >= _LINEAR:
        size >>= 1
        index += _PARTS
    counts[min(index + size, BINS - 1)] += 1
    if nanoseconds > counts[LONGEST]:
        counts[LONGEST] = nanoseconds


def _edges() -> Vector:
    """Return the upper edges of the bins [s]."""
    first = np.arange(1, _LINEAR + 1, dtype=np.float64)
    upper = np.arange(_PARTS, 2 * _PARTS) + 1.0
    rest = [upper * 2.0**octave for octave in range(1, _OCTAVES + 1)]
    return np.concatenate([first, *rest]) * 1e-9


def _scale(total: int) -> str:
    """Return marks below logarithmic bars: 1, 10, 100, …, at the ends of bars of as many."""
    line = ""
    for power in range(int(math.log10(total)) + 1):
        at = math.ceil(_BAR * math.log1p(10**power) / math.log1p(total)) - 1
        if at >= len(line) + (power > 0):  # else there is no room for it
            line = f"{line:<{at}}|{10**power}"
    return line


@dataclass(frozen=True, eq=False)
class Histogram:
    """Durations of many cycles."""

    counts: NDArray[np.int64]  #: number of durations in each bin (bins,)
    edges: Vector  #: upper edge of each bin [s] (bins,)
    max: float  #: longest duration [s]; NaN for an empty histogram

    @classmethod
    def of(cls, counts: NDArray[np.int64]) -> Histogram:
        """Return the histogram of what ``count_duration`` counted."""
        bins = counts[:BINS].copy()
        return cls(bins, _edges(), float(counts[LONGEST]) * 1e-9 if bins.any() else math.nan)

    def __len__(self) -> int:
        """Return the number of durations."""
        return int(self.counts.sum())

    def percentile(self, percent: float) -> float:
        """Return a percentile [s], rounded up by at most 3.1 %; NaN for an empty histogram."""
        if not 0.0 < checks.finite("percent", percent) <= 100.0:
            raise ValueError(f"percent = {percent!r}: must be above 0 and at most 100")
        if not len(self):
            return math.nan
        rank = math.ceil(round(percent / 100.0 * len(self), 6))
        return min(float(self.edges[np.searchsorted(np.cumsum(self.counts), rank)]), self.max)

    @property
    def p50(self) -> float:
        """Median [s]."""
        return self.percentile(50.0)

    @property
    def p99(self) -> float:
        """99th percentile [s]."""
        return self.percentile(99.0)

    @property
    def p999(self) -> float:
        """99.9th percentile [s]."""
        return self.percentile(99.9)

    def summary(self) -> dict[str, float]:
        """Return p50, p99, p99.9 and the longest duration [s]."""
        return {"p50": self.p50, "p99": self.p99, "p99.9": self.p999, "max": self.max}

    def text(self, title: str = "") -> str:
        """Return the histogram as text, a line for each quarter of a decade."""
        head = ", ".join(f"{name} {1e6 * value:.3g} µs" for name, value in self.summary().items())
        lines = [f"{title + ': ' if title else ''}{head} of {len(self)}"]
        if not len(self):
            return lines[0]
        filled = np.flatnonzero(self.counts)
        step = np.floor(4.0 * np.log10(self.edges) - 1e-9).astype(int)
        for part in range(step[filled[0]], step[filled[-1]] + 1):
            inside = int(self.counts[step == part].sum())
            bar = "#" * math.ceil(_BAR * math.log1p(inside) / math.log1p(len(self)))
            lines.append(f"  up to {1e6 * 10 ** ((part + 1) / 4):9.3g} µs {inside:9d} {bar}")
        return "\n".join([*lines, f"{'number:':>30} {_scale(len(self))}"])

    def plot(self, ax: Any = None, label: str | None = None) -> Any:
        """Plot the share of cycles that took longer than a duration, both logarithmic.

        Return the matplotlib axes, by default of a new figure; ``label`` is for the legend.
        """
        if ax is None:
            import matplotlib.pyplot as plt

            _, ax = plt.subplots()
        longer = len(self) - np.cumsum(self.counts)
        first = max(int(np.argmax(self.counts > 0)) - 1, 0)
        shown = slice(first, int(np.searchsorted(-longer, 0)) + 1)
        share = np.maximum(longer[shown], 0.5) / max(len(self), 1)
        ax.loglog(1e6 * self.edges[shown], share, drawstyle="steps-post", label=label)
        ax.set(xlabel="duration [µs]", ylabel="share of cycles that took longer")
        ax.grid(True, which="both", alpha=0.3)
        return ax


@dataclass(frozen=True, eq=False)
class Timing:
    """Punctuality of a run."""

    lateness: Histogram  #: time from a deadline until the loop woke
    step: Histogram  #: time from then until u was written, without waiting for the device

    def text(self) -> str:
        """Return both histograms as text."""
        return f"{self.lateness.text('lateness')}\n{self.step.text('step time')}"

    def plot(self, ax: Any = None) -> Any:
        """Plot both histograms and return the axes."""
        ax = self.step.plot(self.lateness.plot(ax, "lateness"), "step time")
        ax.legend()
        return ax
