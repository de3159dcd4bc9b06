"""What an actuator does to a control signal, and how the controller knows."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from quell import checks
from quell.kernels.dispatch import kernel
from quell.types import Status

_SATURATED = int(Status.SATURATED)
_RATE_LIMITED = int(Status.RATE_LIMITED)


class Limits(NamedTuple):
    """Magnitude and rate limits; infinite where there is none."""

    low: float
    high: float
    most_change: float
    """In a sample."""


def checked_limits(u_min: Any, u_max: Any, rate_limit: Any, dt: float) -> Limits:
    """Check and return limits; ``rate_limit`` in u-units a second."""
    low, high = checks.interval("u_min", u_min, "u_max", u_max)
    if rate_limit != math.inf:
        rate_limit = checks.positive("rate_limit", rate_limit, "u-unit/s")
    return Limits(low, high, float(rate_limit) * dt)


@kernel
def apply_limits(limits: Limits, wished: float, before: float) -> tuple[float, int]:
    """Return the control signal that can be applied after ``before``, and the status flags of what was cut."""
    status = 0
    applied = wished
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
