"""Reasons for a learner's authority."""

from __future__ import annotations

from enum import IntEnum


class Reason(IntEnum):
    """Reason for a learner's authority."""

    TRUSTED = 0
    UNPROVEN = 1
    TOO_LOUD = 2
    OUT_OF_BOUNDS = 3
    WITHHELD = 4
    EXPLODED = 5
    NOT_FINITE = 6

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
}
