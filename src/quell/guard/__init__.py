"""Guard: the authority of a learner.

May import ``learners`` and what they import.
"""

from quell.guard.guard import Guard
from quell.guard.kernels import (
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
