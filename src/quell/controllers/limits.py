"""Limits of the control signal."""

from __future__ import annotations

import math
from typing import NamedTuple

from quell import checks
from quell.kernels.dispatch import kernel
from quell.types import Status

_SATURATED = int(Status.SATURATED)
_RATE_LIMITED = int(Status.RATE_LIMITED)

# A law that asks for so many times its limits has a state that absurd samples have left: an
# integrator would need 28 times its tracking time to return, and no signal spans such a range.
_LARGEST_WISH = 2.0**40


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
def largest_wish(limits: Limits) -> float:
    """Return the u beyond which the state of a law is of no use; infinite without limits."""
    return _LARGEST_WISH * max(abs(limits.low), abs(limits.high))


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
