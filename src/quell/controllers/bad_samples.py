"""Bad samples: what a controller works with where the reference or the measurement is no number."""

from __future__ import annotations

from quell.controllers.limits import Limits
from quell.kernels.dispatch import is_finite, kernel
from quell.types import Status, Vector

_MEASUREMENT_HELD = int(Status.MEASUREMENT_HELD)
_REFERENCE_HELD = int(Status.REFERENCE_HELD)


@kernel
def hold_last_good(loop: Vector, first: int, r: float, y: float) -> int:
    """Take in a sample, or hold the last good one in its place; return the status flags of what was held.

    Four places of ``loop`` are for it, from ``first`` on: last good r and y, whether there was a good y (which the controller sets when it
    has started), whether a good r.
    """
    status = 0
    if is_finite(y):
        loop[first + 1] = y
    else:
        status |= _MEASUREMENT_HELD
    if is_finite(r):
        loop[first] = r
        loop[first + 3] = 1.0
    else:
        status |= _REFERENCE_HELD
        if loop[first + 3] == 0.0:
            loop[first] = loop[first + 1]  # no reference yet: stay
    return status


@kernel
def control_at_rest(limits: Limits) -> float:
    """Return the u to wait with for a first good measurement: zero, or as near as the limits let it."""
    return min(max(0.0, limits.low), limits.high)
