"""Channels of a row, which the loop writes each cycle, and its event flags."""

from __future__ import annotations

from enum import IntFlag

from quell.types import Channels

LOOP_CHANNELS = (
    ("k", 1),  # index of the deadline, its time is k dt; it jumps where deadlines were skipped
    ("lateness", 1),  # time from the deadline until the loop woke [s]
    ("step_time", 1),  # time from then until u was written [s]
    ("mode", 1),  # state of the supervisor
    ("events", 1),  # Event flags of this cycle
    ("r", 1),
    ("y", 1),  # last good measurement
    ("y_measured", 1),  # as received; NaN if nothing was
    ("u", 1),  # applied from this cycle to the next
)
"""Names and widths of the first channels of every row; ``controller.channels`` follow."""

K, LATENESS, STEP_TIME, MODE, EVENTS, R, Y, Y_MEASURED, U = range(len(LOOP_CHANNELS))
LOOP_WIDTH = len(LOOP_CHANNELS)


class Event(IntFlag):
    """Events of a cycle; flags add up. The low sixteen bits are the loop's."""

    MISSED = 1  #: no finite measurement came in time
    OVERRUN = 2  #: the loop woke, or ended its cycle, after the next deadline and skipped it
    CLIPPED = 4  #: the supervisor's limits changed the controller's u
    UNSENT = 8  #: the command could not be sent
    CHANGED = 16  #: the mode changed
    GAP = 1 << 16  #: no recorded cycle: deadline skipped, or row lost; ``load`` filled it in


def row_channels(controller_channels: Channels) -> Channels:
    """Return the channels of a row for a controller with these channels."""
    return (*LOOP_CHANNELS, *controller_channels)
