"""Confidence intervals of shares, such as failure rates."""

from __future__ import annotations

_CONFIDENCE = 0.95


def share_interval(found: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Clopper & Pearson, *Biometrika* 26, 1934).

    Of nothing it is 0 to 1.
    """
    from scipy.stats import binomtest

    if count == 0:
        return 0.0, 1.0
    ends = binomtest(found, count).proportion_ci(_CONFIDENCE, method="exact")
    return float(ends.low), float(ends.high)
