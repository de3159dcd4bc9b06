"""Functions of a guard, for each type of its parameters, and the case without guard.

In each sample the controller calls ``assess`` before the learner adapts, ``limit`` after it has
predicted, and ``record_output`` when the applied u is known.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from quell.kernels.dispatch import generic
from quell.types import Vector

GUARD_CHANNELS = (("authority", 1), ("error_plain", 1), ("error_learned", 1), ("reason", 1))
"""Name and width of what ``write_channels`` writes, in order."""


@generic
def assess(guard: Any, memory: Any, f_plain: float) -> None:
    """Update the averages with ``f_plain``, the estimate of an ESO without learner."""
    raise TypeError


@generic
def limit(
    guard: Any, memory: Any, f_plain: float, constant: float, slope: float, u_before: float
) -> tuple[float, float, bool]:
    """Return the permitted ``(constant, slope)`` of the output ``constant + slope · u``.

    The third value is true if the output is not finite: then the learner has to be restarted.
    """
    raise TypeError


@generic
def record_output(guard: Any, memory: Any, f_learned: float) -> None:
    """Store the output of this sample and the ``f_learned`` that the observer receives."""
    raise TypeError


@generic
def write_channels(guard: Any, memory: Any, row: Vector) -> int:
    """Write ``GUARD_CHANNELS`` to the start of ``row``; return how many numbers were written."""
    raise TypeError


@generic
def reset_filters(guard: Any, memory: Any) -> None:
    """Set the filters to zero; keep the learner's averages."""
    raise TypeError


class UnguardedDesign(NamedTuple):
    """Parameters of a controller without guard: none."""


class UnguardedMemory(NamedTuple):
    """State of a controller without guard."""

    nothing: Vector
    """(0,)."""


@assess.register(UnguardedDesign)
def _assess_nothing(guard: UnguardedDesign, memory: UnguardedMemory, f_plain: float) -> None:
    pass


@limit.register(UnguardedDesign)
def _limit_nothing(
    guard: UnguardedDesign,
    memory: UnguardedMemory,
    f_plain: float,
    constant: float,
    slope: float,
    u_before: float,
) -> tuple[float, float, bool]:
    return constant, slope, False


@record_output.register(UnguardedDesign)
def _record_nothing(guard: UnguardedDesign, memory: UnguardedMemory, f_learned: float) -> None:
    pass


@write_channels.register(UnguardedDesign)
def _write_nothing(guard: UnguardedDesign, memory: UnguardedMemory, row: Vector) -> int:
    return 0


@reset_filters.register(UnguardedDesign)
def _reset_nothing(guard: UnguardedDesign, memory: UnguardedMemory) -> None:
    pass
