"""Limits of the control signal."""

from __future__ import annotations

import math
from typing import NamedTuple

from quell import checks
from quell.kernels.dispatch import kernel
from quell.types import Status

_SATURATED = int(Status.SATURATED)
_RATE_LIMITED = int(Status.RATE_LIMITED)


class Limits(NamedTuple):
    """Magnitude and rate limits; infinite if there are none."""

    low: float
    high: float
    most_change: float  # largest change in a sample


def checked_limits(u_min: float, u_max: float, rate_limit: float, dt: float) -> Limits:
    """Check and return limits; ``rate_limit`` in u-units a second."""
    low, high = checks.interval("u_min", u_min, "u_max", u_max)
    if rate_limit != math.inf:
        rate_limit = checks.positive("rate_limit", rate_limit, "u-unit/s")
    return Limits(low, high, float(rate_limit) * dt)


@kernel
def apply_limits(limits: Limits, unlimited: float, before: float) -> tuple[float, int]:
    """Return the control signal that is possible after ``before``, and the status flags."""
    status = 0
    applied = unlimited
    if applied > before + limits.most_change:
        applied = before + limits.most_change
        status = _RATE_LIMITED
    elif applied < before - limits.most_change:
        applied = before - limits.most_change
        status = _RATE_LIMITED
    if applied > limits.high:
        applied = limits.high
        status |= _SATURATED
    elif applied < limits.low:
        applied = limits.low
        status |= _SATURATED
    return applied, status
