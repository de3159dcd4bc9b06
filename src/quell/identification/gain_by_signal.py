"""b0 over a signal: bins of a record in which a machine has different gains.

A record in which an axis was extended, loaded or sped up has another b0 in each part. The samples
are divided by the value of a signal into bins; in each bin ``identify_b0`` is applied to each
stretch of samples that follow one another, and the results are averaged with weights 1/σ². Where
stretches of a bin differ by more than their deviations say, the deviation grows with their scatter
(Birge, *Physical Review* 40, 1932)::

    b0 = Σ b_i/σ_i² / Σ 1/σ_i²,    σ² = max(1, χ²/(k − 1)) / Σ 1/σ_i²
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.identification.input_gain import identify_b0, least_samples
from quell.types import Vector

# Stretches of a bin that are used, the longest ones: each takes a second and more.
_MOST_STRETCHES = 6
# Half width of a 95 % interval in deviations, and its share of b0 from which on b0 is not known.
_WITHIN_95, _POOR = 1.96, 0.3


class GainBin(NamedTuple):
    """b0 in one bin of a signal."""

    low: float  #: of the signal
    high: float  #: of the signal
    mean: float  #: of the signal over the samples that were used; its middle without any
    samples: int  #: number of samples in the bin
    used: int  #: number of samples in stretches that were used
    b0: float  #: [y-unit/u-unit/s^n]; nan if no stretch told anything
    b0_std: float  #: its standard deviation; infinite without any
    reason: str  #: why b0 is not known; empty if it is

    @property
    def interval(self) -> tuple[float, float]:
        """Interval in which b0 lies with a probability of 95 %."""
        half = _WITHIN_95 * self.b0_std
        return self.b0 - half, self.b0 + half

    @property
    def is_known(self) -> bool:
        """Whether b0 is known, within ±30 % at 95 %."""
        return not self.reason

    def __str__(self) -> str:
        """Return the bin as a line; it begins with NOT if b0 is not known there."""
        where = f"{self.low:.4g} … {self.high:.4g}"
        if not self.is_known:
            return f"NOT known at {where}: {self.reason}"
        low, high = self.interval
        return (
            f"{where} (mean {self.mean:.4g}): b0 = {self.b0:.5g}, 95 % interval {low:.4g} … "
            f"{high:.4g}, from {self.used} of {self.samples} samples"
        )


def identify_b0_by(
    u: Any,
    y: Any,
    signal: Any,
    dt: float,
    order: int,
    *,
    bins: int | Any = 5,
    max_delay: float | None = None,
) -> tuple[GainBin, ...]:
    """Find b0 in each bin of a signal, in a record of a running loop.

    Parameters
    ----------
    u, y, dt, order, max_delay
        as for ``identify_b0``.
    signal
        the signal by which the record is divided (N,), speed or extension for instance.
    bins
        number of bins of equal width between its least and largest value; or their edges,
        increasing.

    Raises
    ------
    ValueError
        for arguments out of range, a signal of another length, one that is not finite, and one
        that does not change.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(4000) * 0.01
    >>> extension = np.where(t < 20.0, 0.0, 1.0)
    >>> u, y = np.sin(0.3 * t**1.5), np.zeros(t.size)
    >>> for k in range(t.size - 1):
    ...     y[k + 1] = y[k] + 0.01 * (1.0 if extension[k] else 3.0) * u[k]
    >>> [round(each.b0, 3) for each in identify_b0_by(u, y, extension, 0.01, 1, bins=2)]
    [3.0, 1.0]
    """
    u, y = checks.vector("u", u), checks.vector("y", y)
    checks.vector("y", y, u.size)
    signal = checks.vector("signal", signal, u.size)
    order = checks.whole("order", order, 1, 4)
    edges = _edges(signal, bins)
    least = least_samples(order)
    place = np.clip(np.searchsorted(edges, signal, "right") - 1, 0, edges.size - 2)
    inside = (signal >= edges[0]) & (signal <= edges[-1])
    found = []
    for i in range(edges.size - 1):
        mask = (place == i) & inside
        parts = [part for part in _stretches(mask) if part.stop - part.start >= least]
        parts = sorted(parts, key=lambda part: part.start - part.stop)[:_MOST_STRETCHES]
        estimates, used, last = [], [], ""
        for part in parts:
            try:
                one = identify_b0(u[part], y[part], dt, order, max_delay=max_delay)
            except ValueError as error:
                last = str(error)
                continue
            if math.isfinite(one.b0_std) and one.b0_std > 0.0:
                estimates.append((one.b0, one.b0_std))
                used.append(part)
        bounds = float(edges[i]), float(edges[i + 1])
        if not estimates:
            reason = last or (
                f"no stretch of {least} samples in a row has the signal there; hold it longer, "
                "or take fewer bins"
            )
            count = int(np.sum(mask))
            found.append(GainBin(*bounds, sum(bounds) / 2, count, 0, math.nan, math.inf, reason))
            continue
        b0, std = _average(np.array(estimates))
        reason = ""
        if not std < _POOR / _WITHIN_95 * abs(b0):
            low, high = b0 - _WITHIN_95 * std, b0 + _WITHIN_95 * std
            reason = (
                f"the excitation is too poor, b0 may be anything from {low:.4g} to {high:.4g}; "
                "move faster and farther there, or for a longer time"
            )
        inner = np.concatenate([signal[part] for part in used])
        count, mean = int(np.sum(mask)), float(np.mean(inner))
        found.append(GainBin(*bounds, mean, count, inner.size, b0, std, reason))
    return tuple(found)


def _edges(signal: Vector, bins: Any) -> Vector:
    """Return the edges of the bins, checked."""
    if checks.is_sequence(bins) or isinstance(bins, np.ndarray):
        edges = checks.vector("bins", bins)
        if edges.size < 2 or np.any(np.diff(edges) <= 0.0):
            raise ValueError(f"bins = {bins!r}: edges must be two or more increasing numbers")
        return edges
    count = checks.whole("bins", bins, 1, 100)
    low, high = float(np.min(signal)), float(np.max(signal))
    if low == high:
        raise ValueError(f"signal is {low:g} all through: there is nothing to divide by")
    return np.linspace(low, high, count + 1)


def _stretches(mask: Any) -> list[slice]:
    """Return the runs of true values."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    pairs = ends.reshape(-1, 2).tolist()
    return [slice(begin, end) for begin, end in pairs]


def _average(estimates: Any) -> tuple[float, float]:
    """Return the mean with weights 1/σ², and its deviation."""
    values, spreads = estimates.T
    weights = 1.0 / spreads**2
    total = float(np.sum(weights))
    mean = float(weights @ values) / total
    scatter = 1.0
    if values.size > 1:
        scatter = max(1.0, float(weights @ (values - mean) ** 2) / (values.size - 1))
    return mean, math.sqrt(scatter / total)
