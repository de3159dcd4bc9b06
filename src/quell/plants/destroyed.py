"""States from which a simulated plant can't go on."""

from __future__ import annotations

from quell.kernels.dispatch import kernel
from quell.types import Vector

# Largest entry of a state, times the largest of 1 and |x0|: at 100 rad/s an angle needs four months
# to get there, and an unstable loop less than a second.
_LARGEST = 1e9


@kernel
def is_destroyed(x: Vector, x0: Vector) -> bool:
    """Return whether a state is not finite or beyond a thousand million times ``x0`` or 1."""
    largest = 1.0
    for i in range(x0.size):
        largest = max(largest, abs(x0[i]))
    for i in range(x.size):  # noqa: SIM110  kernels keep to loops
        if not abs(x[i]) <= _LARGEST * largest:
            return True
    return False
