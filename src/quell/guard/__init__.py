"""Guard: the authority of a learner.

May import ``learners`` and what they import.
"""

from quell.guard.base import (
    GUARD_CHANNELS,
    Reason,
    UnguardedDesign,
    UnguardedMemory,
    assess,
    limit,
    nearest_permitted,
    record_output,
    reset_filters,
    start_again,
    write_channels,
)
from quell.guard.guard import Guard

__all__ = [
    "GUARD_CHANNELS",
    "Guard",
    "Reason",
    "UnguardedDesign",
    "UnguardedMemory",
    "assess",
    "limit",
    "nearest_permitted",
    "record_output",
    "reset_filters",
    "start_again",
    "write_channels",
]
