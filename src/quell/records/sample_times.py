"""Conversion of times to sample numbers, unaffected by rounding."""

from __future__ import annotations

import math


def check_times(samples: int, step: float) -> None:
    """Raise a ``ValueError`` if the times of ``samples`` samples are beyond all numbers."""
    if not math.isfinite(samples * step):
        raise ValueError(f"its samples are {step:g} s apart: its times are beyond all numbers")


def first_sample_at(time: float, step: float, samples: int) -> int:
    """Return the first of ``samples`` samples, ``step`` apart, that is not before ``time``.

    Returns ``samples`` if all are. A time that is a whole number of steps but for rounding is at
    that sample.
    """
    if math.isnan(time):
        raise ValueError(f"time = {time!r}: must be a number")
    return math.ceil(in_steps(min(max(time, 0.0), samples * step), step))


def in_steps(time: float, step: float) -> float:
    """Return ``time / step``, rounded to a whole number if it is one but for rounding errors."""
    count = time / step
    nearest = float(round(count))
    # Far above the rounding of a quotient (2e-16), far below any time that is meant to be between
    # samples.
    return nearest if math.isclose(count, nearest, rel_tol=1e-12, abs_tol=1e-9) else count
