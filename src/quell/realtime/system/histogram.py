"""How long things took: histograms that the loop fills without allocating, and what is read from them.

Durations are counted in bins that grow with them: each power of two is divided into 32, so that a bin is at most 3.1 % wide (Gil Tene's
HdrHistogram is made like this). Up to 64 ns a bin is a nanosecond. The longest duration is kept as it is.
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

_PARTS = 32
_LINEAR = 2 * _PARTS
# Up to some four hours.
_OCTAVES = 38
BINS = _LINEAR + _PARTS * _OCTAVES
# Behind the bins stands the longest duration.
LONGEST = BINS

_BAR = 48


def empty_counts() -> NDArray[np.int64]:
    """Return an empty histogram (BINS + 1,) for ``count``."""
    return np.zeros(BINS + 1, dtype=np.int64)


@kernel
def count_duration(tally: NDArray[np.int64], nanoseconds: int) -> None:
    """Count a duration [ns]."""
    size, place = max(nanoseconds, 0), 0
    while size >= _LINEAR:
        size >>= 1
        place += _PARTS
    tally[min(place + size, BINS - 1)] += 1
    if nanoseconds > tally[LONGEST]:
        tally[LONGEST] = nanoseconds


def _edges() -> Vector:
    """Return where the bins end [s]; the last one's end is the next one's beginning."""
    first = np.arange(1, _LINEAR + 1, dtype=np.float64)
    rest = [
        (np.arange(_PARTS, 2 * _PARTS) + 1.0) * 2.0**octave for octave in range(1, _OCTAVES + 1)
    ]
    return np.concatenate([first, *rest]) * 1e-9


@dataclass(frozen=True, eq=False)
class Histogram:
    """Durations of many cycles.

    Attributes
    ----------
    counts : (bins,) array
        how many fell into which bin.
    edges : (bins,) array
        where each bin ends [s].
    max : float
        the longest [s]; NaN where there was none.
    """

    counts: NDArray[np.int64]
    edges: Vector
    max: float

    @classmethod
    def of(cls, tally: NDArray[np.int64]) -> Histogram:
        """Return what was counted."""
        counts = tally[:BINS].copy()
        return cls(counts, _edges(), float(tally[LONGEST]) * 1e-9 if counts.any() else math.nan)

    def __len__(self) -> int:
        """Return how many durations were counted."""
        return int(self.counts.sum())

    def percentile(self, percent: float) -> float:
        """Return the duration [s] that so many percent did not exceed, rounded up by at most 3.1 %; NaN where nothing was counted.

        Raises
        ------
        ValueError
            for a share outside of (0, 100].
        """
        if not 0.0 < checks.finite("percent", percent) <= 100.0:
            raise ValueError(f"percent = {percent!r}: must be above 0 and at most 100")
        if not len(self):
            return math.nan
        needed = math.ceil(round(percent / 100.0 * len(self), 6))
        return min(float(self.edges[np.searchsorted(np.cumsum(self.counts), needed)]), self.max)

    @property
    def p50(self) -> float:
        """Median [s]."""
        return self.percentile(50.0)

    @property
    def p99(self) -> float:
        """What one in a hundred exceeds [s]."""
        return self.percentile(99.0)

    @property
    def p999(self) -> float:
        """What one in a thousand exceeds [s]."""
        return self.percentile(99.9)

    def summary(self) -> dict[str, float]:
        """Return p50, p99, p99.9 and the longest [s]."""
        return {"p50": self.p50, "p99": self.p99, "p99.9": self.p999, "max": self.max}

    def text(self, title: str = "") -> str:
        """Return the histogram as lines of text, a line for each quarter of a decade that has something in it."""
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
        return "\n".join(lines)

    def plot(self, ax: Any = None, label: str | None = None) -> Any:
        """Draw how many cycles took longer than so many microseconds, both logarithmic; return the axes.

        Parameters
        ----------
        ax
            matplotlib axes to draw into; a new figure by default.
        label
            for the legend.
        """
        if ax is None:
            import matplotlib.pyplot as plt

            _, ax = plt.subplots()
        longer = len(self) - np.cumsum(self.counts)
        shown = slice(
            max(int(np.argmax(self.counts > 0)) - 1, 0), int(np.searchsorted(-longer, 0)) + 1
        )
        share = np.maximum(longer[shown], 0.5) / max(len(self), 1)
        ax.loglog(1e6 * self.edges[shown], share, drawstyle="steps-post", label=label)
        ax.set(xlabel="duration [µs]", ylabel="share of cycles that took longer")
        ax.grid(True, which="both", alpha=0.3)
        return ax


@dataclass(frozen=True, eq=False)
class Timing:
    """How punctual a run was.

    Attributes
    ----------
    lateness : Histogram
        from a deadline until the loop was awake.
    step : Histogram
        from then until u was written, less what was waited for the device: measurement, supervision, controller, command.
    """

    lateness: Histogram
    step: Histogram

    def text(self) -> str:
        """Return both histograms as text."""
        return f"{self.lateness.text('lateness')}\n{self.step.text('step time')}"

    def plot(self, ax: Any = None) -> Any:
        """Draw both; return the axes."""
        ax = self.step.plot(self.lateness.plot(ax, "lateness"), "step time")
        ax.legend()
        return ax
