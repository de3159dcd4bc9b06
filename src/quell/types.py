"""Array aliases, the status that a step or a run reports, and the warning for unwise designs."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntFlag
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Vector: TypeAlias = NDArray[np.float64]
"""One-dimensional, contiguous, float64."""

Matrix: TypeAlias = NDArray[np.float64]
"""Two-dimensional, C-contiguous, float64."""

Progress: TypeAlias = Callable[[str, float], None]
"""Called with the name of the present part of the work and the share of it that is done, from 0 to 1."""


class DesignWarning(UserWarning):
    """A design is possible but unwise; the text has the number, its limit and what to do."""


class Status(IntFlag):
    """What a controller's last step, or a run as a whole, has to report; flags add up.

    ``OK`` is zero. ``message`` says in words what happened and what to do.
    """

    OK = 0
    MEASUREMENT_HELD = 1
    REFERENCE_HELD = 2
    SATURATED = 4
    RATE_LIMITED = 8
    OVERFLOWED = 16
    DIVERGED = 32
    LEARNER_CUT = 64
    LEARNER_LATE = 128
    LEARNER_FAILED = 256

    @property
    def message(self) -> str:
        """All that is reported, as sentences."""
        return " ".join(text for flag, text in _MESSAGES.items() if flag in self) or "All is well."


_MESSAGES = {
    Status.MEASUREMENT_HELD: "The measurement was not finite; the expected or the last good one was used instead: look at the sensor.",
    Status.REFERENCE_HELD: "The reference was not finite; the last good one was used instead: look at its source.",
    Status.SATURATED: "The control signal lies on u_min or u_max; the observer was told the applied value.",
    Status.RATE_LIMITED: "The control signal moves as fast as rate_limit allows; the observer was told the applied value.",
    Status.OVERFLOWED: "The observer or the learner left the range of numbers and was started afresh: "
    "lower the learning rate, omega_o or omega_c, or check b0.",
    Status.LEARNER_CUT: "The learner's output was not a number; the guard cut it off and it began anew: look at the learner.",
    Status.DIVERGED: "The loop diverged and the run ended early: check the sign and size of b0, lower omega_c or omega_o, "
    "or the learning rate.",
    Status.LEARNER_LATE: "The learner took longer than its budget and the loop went on with its last prediction: "
    "raise budget or period, or take a smaller model.",
    Status.LEARNER_FAILED: "The learner raised an error or returned no finite number and was not listened to; a warning said why, "
    "and last_problem of the learner keeps it: mend the model or lower its learning rate.",
}
