"""Functions of a guard, registered for the type of its parameters; their defaults limit nothing.

In each sample the controller calls ``assess`` before the learner adapts, ``limit`` after it has
predicted, ``confine`` for each u that it tries, and ``record_output`` when the applied u is known.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from quell.kernels.dispatch import generic_with_default
from quell.types import Vector

GUARD_CHANNELS = (("authority", 1), ("error_plain", 1), ("error_learned", 1), ("reason", 1))
"""Name and width of what ``write_channels`` writes, in order."""


class UnguardedDesign(NamedTuple):
    """Parameters of a controller without guard: none."""


class UnguardedMemory(NamedTuple):
    """State of a controller without guard."""

    nothing: Vector  # (0,)


@generic_with_default
def assess(guard: Any, memory: Any, f_plain: float) -> None:
    """Update the averages with ``f_plain``, the estimate of an ESO without learner."""


@generic_with_default
def limit(
    guard: Any,
    memory: Any,
    f_plain: float,
    f_shown: float,
    constant: float,
    slope: float,
    u_before: float,
) -> tuple[float, float, bool]:
    """Return the permitted ``(constant, slope)`` of the output ``constant + slope · u``.

    ``f_shown`` is f_L^F. The third value is true if the output is not finite: then the learner has
    to be restarted.
    """
    return constant, slope, False


@generic_with_default
def confine(guard: Any, memory: Any, f_learned: float) -> float:
    """Return the permitted f_L next to ``f_learned``, after ``limit``."""
    return f_learned


@generic_with_default
def record_output(guard: Any, memory: Any, f_learned: float) -> None:
    """Store the output of this sample and the ``f_learned`` that the observer receives."""


@generic_with_default
def write_channels(guard: Any, memory: Any, row: Vector) -> int:
    """Write ``GUARD_CHANNELS`` to the start of ``row``; return how many numbers were written."""
    return 0


@generic_with_default
def start_again(guard: Any, memory: Any) -> None:
    """Return to the state before the first sample."""


@generic_with_default
def reset_filters(guard: Any, memory: Any) -> None:
    """Set the filters to zero; keep the learner's averages."""
