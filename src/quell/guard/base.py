"""The contract of a guard: functions that a controller calls, and reasons that a guard gives.

Functions of a guard, registered for the type of its parameters; their defaults limit nothing.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

from quell.kernels.dispatch import generic_with_default
from quell.types import Vector

# ---- Functions of a guard, registered for the type of its parameters ----

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
    f_filtered: float,
    constant: float,
    slope: float,
    u_before: float,
) -> tuple[float, float, bool]:
    """Return the permitted ``(constant, slope)`` of the output ``constant + slope · u``.

    ``f_filtered`` is f_L^F. The third value is true if the output is not finite: then the learner
    has to be restarted.
    """
    return constant, slope, False


@generic_with_default
def nearest_permitted(guard: Any, memory: Any, f_learned: float) -> float:
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


# ---- Reasons for a learner's authority ----


class Reason(IntEnum):
    """Reason for a learner's authority."""

    TRUSTED = 0
    UNPROVEN = 1
    TOO_LOUD = 2
    OUT_OF_BOUNDS = 3
    WITHHELD = 4
    EXPLODED = 5
    NOT_FINITE = 6
    FAILED = 7

    @property
    def message(self) -> str:
        """The reason as a sentence."""
        return _MESSAGES[self]


_MESSAGES = {
    Reason.TRUSTED: "The learner explains what the observer would have missed; full authority.",
    Reason.UNPROVEN: "The learner has so far explained too little of what the observer misses.",
    Reason.TOO_LOUD: "The learner's output is larger than what it should explain; scaled down.",
    Reason.OUT_OF_BOUNDS: "The learner would change the estimate by more than its bound; clipped.",
    Reason.WITHHELD: "The error is much larger than what is certainly not the learner's; "
    "authority is withheld until it is seen whether the loop keeps it up without the learner.",
    Reason.EXPLODED: "The learner's output is a hundred times larger than f; "
    "it was cut off and starts again without authority.",
    Reason.NOT_FINITE: "The learner's output is not finite; "
    "it was cut off, and the learner was reset and starts again without authority.",
    Reason.FAILED: "Twice the error fell when authority was withheld: the learner drives what "
    "it explains. b0 is likely below half of the gain (OnlineGain and quell b0 find it), "
    "or loops move each other; authority is withheld for a time that doubles.",
}
