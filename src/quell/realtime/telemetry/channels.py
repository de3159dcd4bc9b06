"""What a cycle of the loop tells: the channels of a row, and its events."""

from __future__ import annotations

from enum import IntFlag

LOOP_CHANNELS = (
    ("k", 1),  # index of the deadline, its time is k dt; it jumps where deadlines were skipped
    ("lateness", 1),  # of the wake-up, behind the deadline [s]
    ("step_time", 1),  # from the wake-up until u was written [s]
    ("mode", 1),  # state of the supervisor
    ("events", 1),  # Event flags of this cycle
    ("r", 1),
    ("y", 1),  # the last good measurement
    ("y_measured", 1),  # as it came; NaN where it did not
    ("u", 1),  # as applied from this cycle to the next
)
"""Name and width of what every row begins with; what the controller reports (``controller.channels``) follows."""

K, LATENESS, STEP_TIME, MODE, EVENTS, R, Y, Y_MEASURED, U = range(len(LOOP_CHANNELS))
LOOP_WIDTH = len(LOOP_CHANNELS)


class Event(IntFlag):
    """What befell a cycle; flags add up. The low sixteen bits are the loop's."""

    MISSED = 1
    """No measurement came in time, or one that is no number."""
    OVERRUN = 2
    """The loop woke, or was done, after the next deadline: deadlines were skipped."""
    CLIPPED = 4
    """The supervisor's limits changed the controller's u."""
    UNSENT = 8
    """The device could not be reached."""
    CHANGED = 16
    """The mode changed."""
    GAP = 1 << 16
    """There was no such cycle: its deadline was skipped, or its row found the ring full. The row was filled in when it was loaded."""


def row_channels(controller_channels: tuple[tuple[str, int], ...]) -> tuple[tuple[str, int], ...]:
    """Return the channels of a row, for a controller that reports these."""
    return (*LOOP_CHANNELS, *controller_channels)
