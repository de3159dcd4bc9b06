"""Aliases of types, the status of a step or a run, and the warning for unwise designs."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping
from enum import IntFlag
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Vector: TypeAlias = NDArray[np.float64]  # one-dimensional, contiguous, float64

Matrix: TypeAlias = NDArray[np.float64]  # two-dimensional, C-contiguous, float64

Channels: TypeAlias = tuple[tuple[str, int], ...]
"""Name and width of the channels that are side by side in a log, in order."""

Progress: TypeAlias = Callable[[str, float], None]
"""Called with the name of the present part of the work and the share of it done, 0 to 1."""


class DesignWarning(UserWarning):
    """A design is possible but unwise; the text has the number, its limit and what to do."""


class Status(IntFlag):
    """Flags of a controller's last step, or of all steps of a run; ``OK`` is zero."""

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
    POORLY_INTEGRATED = 512
    CONTROL_HELD = 1024
    SAFE_SET_ACTED = 2048
    UNSAFE = 4096
    HELD = 8192
    SCHEDULE_HELD = 16384
    GAIN_HELD = 32768
    RAN_AWAY = 65536

    @property
    def message(self) -> str:
        """A sentence for each flag: what happened and what to do."""
        return self.explained({})

    def explained(self, shares: Mapping[Status, float]) -> str:
        """Return ``message`` with the shares of the samples that have a flag, where they are known.

        Parameters
        ----------
        shares
            Share of the samples, from 0 to 1, by flag; 0 is not shown.
        """
        if Status.DIVERGED | Status.POORLY_INTEGRATED in self:
            others = self & ~(Status.DIVERGED | Status.POORLY_INTEGRATED)
            sentences = [others.explained(shares)] if others else []
            return " ".join([*sentences, _INTEGRATION_DIVERGED])
        sentences = []
        for flag, text in _MESSAGES.items():
            if flag in self:
                share = shares.get(flag, 0.0)
                sentences.append(f"{100.0 * share:.3g} % of the samples: {text}" if share else text)
        return " ".join(sentences) or _NOTHING


_MESSAGES = {
    Status.MEASUREMENT_HELD: (
        "The measurement was not finite; the expected or the last good one was used instead: "
        "check the sensor."
    ),
    Status.REFERENCE_HELD: (
        "The reference was not finite; the last good one was used instead: check its source."
    ),
    Status.SATURATED: (
        "The control signal is at u_min or u_max; the controller got the applied value."
    ),
    Status.RATE_LIMITED: (
        "The control signal moves as fast as rate_limit allows; the controller got the applied "
        "value."
    ),
    Status.OVERFLOWED: (
        "The observer or the learner overflowed and was reset: lower the learning rate, omega_o or "
        "omega_c, or check b0 and the sensor."
    ),
    Status.LEARNER_CUT: (
        "The learner's output was not finite; the guard cut it off and the learner started anew: "
        "check the learner."
    ),
    Status.DIVERGED: (
        "The loop diverged and the run ended early: check the sign and size of b0, lower omega_c "
        "or omega_o, or the learning rate."
    ),
    Status.RAN_AWAY: (
        "The output ran away from r: at the end |r − y| is far beyond what r asks for, or grows "
        "with u at a limit: check the sign and size of b0 and whether u can hold the load, or "
        "lower omega_c or omega_o."
    ),
    Status.LEARNER_LATE: (
        "The learner took longer than its budget and the loop went on with its last prediction: "
        "raise budget or period, or take a smaller model."
    ),
    Status.LEARNER_FAILED: (
        "The learner raised an error or returned no finite number and was ignored; a warning gave "
        "the reason, and last_problem of the learner has it: correct the model or lower its "
        "learning rate."
    ),
    Status.POORLY_INTEGRATED: (
        "The plant is integrated with too few sub-steps, its states have errors of more than 1 % "
        "in a sample: raise its substeps, or lower dt."
    ),
    Status.CONTROL_HELD: (
        "The applied control signal that was given was not finite; the one before stands: check "
        "what reads it back."
    ),
    Status.SAFE_SET_ACTED: (
        "The safe set changed the control signal to keep y and its rate in their bands."
    ),
    Status.UNSAFE: (
        "NOT safe: limits of u did not allow what the safe set needs, or y moved as f_rate, noise "
        "and gain_error do not allow; raise u_max, rate_limit or these bounds, or lower alpha."
    ),
    Status.HELD: (
        "The plant is held, as the machine says, or y rests although u should move it, as with a "
        "brake or an end stop, or a load that is compensated: check whether u acts."
    ),
    Status.SCHEDULE_HELD: (
        "A signal of the schedule was not finite or not given; the last good one was used, or the "
        "gains without a schedule: check its source."
    ),
    Status.GAIN_HELD: (
        "The function of B0 or M returned a matrix that is not finite or has no inverse; the last "
        "good one was used: check it where the machine was."
    ),
}
_NOTHING = "No step reported a problem."
_INTEGRATION_DIVERGED = (
    "The integration of the plant diverged and the run ended early; the cause is not the loop but "
    "too few sub-steps: raise the plant's substeps, or lower dt."
)


LOST = Status.DIVERGED | Status.RAN_AWAY
"""The flags of a run that did not do its task: none of its measures is one of a loop that works."""


# Modules whose frames are between the user's call and the warning.
_BETWEEN = ("quell", "functools")


def warn(message: str, category: type[Warning] = DesignWarning) -> None:
    """Issue a warning; its source is the nearest line outside of quell."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and _package(frame.f_globals) in _BETWEEN:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


def called_by_quell(depth: int) -> bool:
    """Return whether the function this number of calls above was called from inside quell.

    1 is the function that asks. What is inside judges the results of its runs itself, and needs no
    warning.
    """
    frame: Any = sys._getframe(depth + 1)
    while frame.f_globals.get("__name__") == "quell.hints":  # the frame of a decorator
        frame = frame.f_back
    return _package(frame.f_globals) in (*_BETWEEN, "concurrent")


def _package(names: dict[str, object]) -> str:
    """Return the package of a frame with these global names."""
    return str(names.get("__name__", "")).partition(".")[0]
