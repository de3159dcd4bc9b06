"""Measures of a run: RMS error, largest error, worst window."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.types import Vector

WINDOW_LAGS = 10.0
"""Length of a window in lags N/omega_o of the observer."""
LATE_SHARE = 0.5
"""The late part of a run begins here, as a share of its duration."""


class Measures(NamedTuple):
    """Measures of an error e(t), all in its unit."""

    rms: float  #: RMS of the whole run
    peak: float  #: largest ``|e|``
    window: float  #: largest RMS over a window of ``WINDOW_LAGS``
    late: float  #: RMS of the second half

    def over(self, other: Measures) -> Measures:
        """Return the ratios to those of another run."""
        return Measures(*(a / max(b, 1e-300) for a, b in zip(self, other, strict=True)))


def measure_error(error: Vector, window: int) -> Measures:
    """Return the measures of an error, for windows of so many of its samples."""
    square = error**2
    total = np.concatenate([[0.0], np.cumsum(square)])
    size = min(max(window, 1), error.size)
    in_windows = (total[size:] - total[:-size]) / size
    late = square[int(LATE_SHARE * error.size) :]
    return Measures(
        rms=float(np.sqrt(np.mean(square))),
        peak=float(np.max(np.abs(error))),
        window=float(np.sqrt(max(np.max(in_windows), 0.0))),
        late=float(np.sqrt(np.mean(late))),
    )
