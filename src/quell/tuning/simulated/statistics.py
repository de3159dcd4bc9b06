"""Statistics of the scores on many samples: one number, and its confidence interval.

A score is better if it is lower; one that is not a number counts as infinite. All intervals have
95 % confidence, are two-sided and hold for samples that were not used for the search.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from quell import checks
from quell.sweeping.shares import share_interval
from quell.types import Vector

_CONFIDENCE = 0.95


class Statistic(Protocol):
    """A number that stands for the scores on all samples."""

    def value(self, scores: Vector) -> float:
        """Return the number for scores (samples,)."""
        ...

    def interval(self, scores: Vector) -> tuple[float, float]:
        """Return the ends of its confidence interval."""
        ...


@dataclass(frozen=True)
class Mean:
    """The mean; its interval is that of the central limit theorem."""

    def value(self, scores: Vector) -> float:
        """Return the mean of scores (samples,)."""
        return float(np.mean(_numbers(scores)))

    def interval(self, scores: Vector) -> tuple[float, float]:
        """Return mean ± t s/√n; infinite with one sample."""
        from scipy.stats import t

        scores = _numbers(scores)
        n, middle = scores.size, self.value(scores)
        if n < 2 or not math.isfinite(middle):
            return -math.inf, math.inf
        half = float(t.ppf(0.5 + 0.5 * _CONFIDENCE, n - 1) * np.std(scores, ddof=1) / math.sqrt(n))
        return middle - half, middle + half


@dataclass(frozen=True)
class Quantile:
    """The least score that a share ``level`` of the samples does not exceed.

    Its interval is free of assumptions on the distribution: its ends are the scores whose ranks are
    the binomial distribution's quantiles (David & Nagaraja, *Order Statistics*, 3rd ed., 7.1).
    """

    level: float

    def __post_init__(self) -> None:
        if not 0.0 < checks.finite("level", self.level) < 1.0:
            raise ValueError(f"level = {self.level!r}: must be between 0 and 1, without them")

    def value(self, scores: Vector) -> float:
        """Return the quantile of scores (samples,)."""
        ordered = np.sort(_numbers(scores))
        # Rounding must not move 0.9 · 10 to the tenth score.
        return float(ordered[max(math.ceil(self.level * ordered.size - 1e-9), 1) - 1])

    def interval(self, scores: Vector) -> tuple[float, float]:
        """Return two of the scores, or infinite ends if there are too few samples."""
        from scipy.stats import binom

        ordered = np.sort(_numbers(scores))
        n, tail = ordered.size, 0.5 * (1.0 - _CONFIDENCE)
        # P(S_(i) ≤ q ≤ S_(j)) ≥ F(j − 1) − F(i − 1), with F of Binomial(n, level).
        i = int(binom.ppf(tail, n, self.level))
        j = int(binom.ppf(1.0 - tail, n, self.level)) + 1
        low = float(ordered[i - 1]) if i >= 1 else -math.inf
        return low, float(ordered[j - 1]) if j <= n else math.inf


@dataclass(frozen=True)
class Worst:
    """The largest score; nothing bounds that of further samples, so its interval is open."""

    def value(self, scores: Vector) -> float:
        """Return the largest of scores (samples,)."""
        return float(np.max(_numbers(scores)))

    def interval(self, scores: Vector) -> tuple[float, float]:
        """Return the largest score and infinity."""
        return self.value(scores), math.inf


@dataclass(frozen=True)
class FailureRate:
    """The share of samples whose score is above ``limit``.

    A score may be a truth value: True, a failure, is above the default limit. The interval is that
    of Clopper & Pearson (*Biometrika* 26, 1934).
    """

    limit: float = 0.5

    def value(self, scores: Vector) -> float:
        """Return the share of scores (samples,) above the limit."""
        return float(np.mean(_numbers(scores) > self.limit))

    def interval(self, scores: Vector) -> tuple[float, float]:
        """Return the exact interval of a binomial share."""
        return share_interval(int(np.sum(_numbers(scores) > self.limit)), scores.size)


def _numbers(scores: Vector) -> Vector:
    return np.where(np.isnan(scores), np.inf, scores)
