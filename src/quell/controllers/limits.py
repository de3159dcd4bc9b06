"""Limits of the control signal."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from quell import checks
from quell.kernels.dispatch import is_finite, kernel
from quell.types import Status

_SATURATED = int(Status.SATURATED)
_RATE_LIMITED = int(Status.RATE_LIMITED)
_OVERFLOWED = int(Status.OVERFLOWED)

RateLimit = float | tuple[float, float]
"""Largest rate of u, in either direction; or its range (lowest, highest) [u-unit/s]."""

# A law that asks for so many times its limits has a state that absurd samples have left: an
# integrator would need 28 times its tracking time to return, and no signal spans such a range.
_LARGEST_WISH = 2.0**40


class Limits(NamedTuple):
    """Limits of magnitude and rate; infinite if there are none."""

    low: float
    high: float
    most_change: float  # largest increase in a sample
    least_change: float  # largest decrease in a sample, as a negative number


NO_LIMITS = Limits(-math.inf, math.inf, math.inf, -math.inf)


def limits_of(controller: Any) -> tuple[float, float]:
    """Return the limits of u of a controller, also behind a prefilter; infinite if it has none."""
    limits = getattr(controller, "limits", None)
    return (-math.inf, math.inf) if limits is None else (float(limits.low), float(limits.high))


def checked_limits(u_min: float, u_max: float, rate_limit: RateLimit, dt: float) -> Limits:
    """Check and return limits; ``rate_limit`` in u-units a second."""
    low, high = checks.interval("u_min", u_min, "u_max", u_max)
    slowest, fastest = _rates(rate_limit)
    return Limits(low, high, fastest * dt, slowest * dt)


def _rates(rate_limit: Any) -> tuple[float, float]:
    """Return the lowest rate, at most zero, and the highest, at least zero."""
    if not checks.is_sequence(rate_limit):
        if rate_limit != math.inf:
            rate_limit = checks.positive("rate_limit", rate_limit, "u-unit/s")
        return -float(rate_limit), float(rate_limit)
    rule = "must be a number, or (lowest, highest) with lowest <= 0 <= highest, not both zero"
    try:
        lowest, highest = map(float, rate_limit)
    except (TypeError, ValueError):
        raise ValueError(f"rate_limit = {rate_limit!r}: {rule}") from None
    if not (lowest <= 0.0 <= highest and lowest < highest):
        raise ValueError(f"rate_limit = {rate_limit!r}: {rule}")
    return lowest, highest


def changed_limits(
    limits: Limits,
    dt: float,
    u_min: float | None,
    u_max: float | None,
    rate_limit: RateLimit | None,
) -> Limits:
    """Return ``limits`` with new values for what is not None."""
    u_min = limits.low if u_min is None else u_min
    u_max = limits.high if u_max is None else u_max
    new = checked_limits(u_min, u_max, math.inf if rate_limit is None else rate_limit, dt)
    if rate_limit is None:
        changes = {"most_change": limits.most_change, "least_change": limits.least_change}
        new = new._replace(**changes)
    return new


@kernel
def largest_magnitude(limits: Limits) -> float:
    """Return the largest ``|u|`` within the limits; infinite without limits."""
    return max(abs(limits.low), abs(limits.high))


@kernel
def largest_wish(limits: Limits) -> float:
    """Return the u beyond which the state of a law is of no use; infinite without limits."""
    return _LARGEST_WISH * largest_magnitude(limits)


@kernel
def control_at_rest(limits: Limits) -> float:
    """Return u where nothing gives one: zero, or the limit nearest to it."""
    return min(max(0.0, limits.low), limits.high)


@kernel
def apply_limits(limits: Limits, unlimited: float, before: float) -> tuple[float, int]:
    """Return the control signal that is possible after ``before``, and the status flags.

    The limits of magnitude are applied last: u is always within them, even if it has to change
    faster for that, and always a number: without one it is that of rest.
    """
    status = 0
    applied = unlimited
    if applied > before + limits.most_change:
        applied = before + limits.most_change
        status = _RATE_LIMITED
    elif applied < before + limits.least_change:
        applied = before + limits.least_change
        status = _RATE_LIMITED
    if applied > limits.high:
        applied = limits.high
        status |= _SATURATED
    elif applied < limits.low:
        applied = limits.low
        status |= _SATURATED
    if not is_finite(applied):
        applied = control_at_rest(limits)
        status |= _OVERFLOWED
    return applied, status
