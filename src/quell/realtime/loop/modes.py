"""Modes of the supervisor, causes of a change of mode, and requests to the loop."""

from __future__ import annotations

from enum import IntEnum


class Mode(IntEnum):
    """State of the supervisor, the channel ``mode``; see ``quell.realtime.loop.supervisor``."""

    START = 0
    RUN = 1
    HOLD = 2
    RAMP = 3
    STOPPED = 4


class Request(IntEnum):
    """A request of another thread to the loop; a higher one prevails."""

    NONE = 0
    RAMP = 1  #: ramp u to zero
    ZERO = 2  #: set u to zero at once


class Ending(IntEnum):
    """The way in which a cause ends the run."""

    NO = 0  #: it does not: the run goes on, or had ended already
    COMPLETED = 1  #: the scenario was run to its end
    REQUESTED = 2  #: the run was asked to stop
    FAULT = 3  #: a limit or a fault stopped it


class Cause(IntEnum):
    """Cause of a change of mode."""

    text: str  #: the cause as a clause
    ending: Ending  #: how it ends the run

    def __new__(cls, number: int, text: str = "", ending: Ending = Ending.FAULT) -> Cause:
        """Return the member with this number."""
        member = int.__new__(cls, number)
        member._value_, member.text, member.ending = number, text, ending
        return member

    NONE = 0, "it began", Ending.NO
    SETTLED = 1, "enough good samples were seen", Ending.NO
    MISSED = 2, "no measurement came in time, or one that is not finite", Ending.NO
    RECOVERED = 3, "a good measurement came", Ending.NO
    LOST = 4, "too many samples in a row were missed: look at the device and the wire"
    STALLED = 5, "the loop stood still for too many samples: look at the load of the machine"
    OVERRUN = (
        6,
        "too many cycles in a row took longer than a sample: take a longer dt, or less work",
    )
    UNREACHABLE = 7, "too many commands in a row could not be sent: look at the wire"
    WATCHDOG = 8, "the device set u to zero for good: commands came too late, or it was ended"
    TRACKING_ERROR = 9, "|r − y| went beyond most_error"
    F_HAT = 10, "|f_hat| went beyond most_f"
    SATURATED = 11, "u lay at a limit for longer than most_saturated samples"
    NOT_A_NUMBER = 12, "the controller's u was not finite"
    STOP_REQUESTED = 13, "it was asked to stop", Ending.REQUESTED
    ZERO_REQUESTED = 14, "it was asked to stop at once", Ending.REQUESTED
    COMPLETED = 15, "the scenario is over", Ending.COMPLETED
    RAMPED = 16, "u is zero", Ending.NO
    NO_MEASUREMENT = 17, "no measurement ever came: is the device running?"
    UNSETTLED = 18, "there were never enough good samples in a row to begin with"
    IMPLAUSIBLE = (
        19,
        "y went beyond y_min … y_max: look at the sensor; set them where the plant may go further",
    )
    WRONG_WAY = (
        20,
        "y ran away against u: look at the sign of y, of u and of b0, or for a load beyond u's "
        "limits",
    )
