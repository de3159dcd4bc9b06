"""Replacement of references and measurements that are not numbers of any physical quantity.

What is not finite, or beyond 1e60, counts as missing. Arithmetic with larger numbers would overflow
in squares, and an observer would need longer to return from them. In single precision, whose
numbers end at 3.4e38, the limit is 1e12.
"""

from __future__ import annotations

from typing import Any

from quell.checks import LARGEST_SIGNAL
from quell.controllers.limits import Limits, largest_magnitude
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.functions import is_single
from quell.types import Status

_MEASUREMENT_HELD = int(Status.MEASUREMENT_HELD)
_REFERENCE_HELD = int(Status.REFERENCE_HELD)

# f is larger than y by the power of omega_o with the order of the plant, and squares of f must be
# finite: so they are up to 2e7 y-units/s^n for each of y. No sensor has so many steps. Where
# they overflow all the same, learner and guard start again.
LARGEST_SINGLE_SIGNAL = 1e12


@kernel
def is_usable(value: float) -> bool:
    """Return whether ``value`` can be a reference, one of its derivatives or a measurement."""
    return abs(value) <= (LARGEST_SINGLE_SIGNAL if is_single(value) else LARGEST_SIGNAL)


@kernel
def is_usable_control(limits: Limits, unlimited: float) -> bool:
    """Return whether a law's output is finite and, where no limit cuts it, not out of range.

    Without limits a larger u would drive y to where measurements count as missing, and the
    controller would never see it again.
    """
    if is_usable(unlimited):
        return True
    return is_finite(unlimited) and is_finite(largest_magnitude(limits))


@kernel
def hold_last_good(loop: Any, r: float, y: float) -> int:
    """Store the usable values of a sample in ``loop``; return the status flags of the others.

    The fields ``r``, ``y`` and ``has_reference`` of ``loop`` are set. Before the first usable
    reference r is the last y, so that the loop stays where it is.
    """
    status = 0
    if is_usable(y):
        loop.y = y
    else:
        status |= _MEASUREMENT_HELD
    if is_usable(r):
        loop.r = r
        loop.has_reference = 1.0
    else:
        status |= _REFERENCE_HELD
        if loop.has_reference == 0.0:
            loop.r = loop.y
    return status
