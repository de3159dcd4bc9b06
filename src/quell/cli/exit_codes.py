"""Exit codes of all commands."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from enum import IntEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quell.records.trajectory import Trajectory


class ExitCode(IntEnum):
    """Exit codes of all commands; ``about`` says what each means."""

    DONE = 0
    INTERNAL = 1
    ERROR = 2
    ENDED_BY_SAFETY = 3
    DIVERGED = 4
    NOT_PROVED = 5
    INTERRUPTED = 130
    TERMINATED = 143

    @property
    def about(self) -> str:
        """The meaning of the code, in a line."""
        return _MEANINGS[self]


_MEANINGS = {
    ExitCode.DONE: "the command did its work",
    ExitCode.INTERNAL: "an error of quell itself, with a traceback: please report it",
    ExitCode.ERROR: (
        "an error in the arguments or a file, or a file or device that does not work: one line "
        "says which; no run was finished"
    ),
    ExitCode.ENDED_BY_SAFETY: (
        "quell run-rig, quell tune --device: a limit of safety or a fault ended the run; u was "
        "ramped to zero"
    ),
    ExitCode.DIVERGED: (
        "quell run, compare, reproduce two-mass and torsional: a simulated run diverged; all "
        "results were written"
    ),
    ExitCode.NOT_PROVED: (
        "quell export --prove: something is not proved, or there is no Frama-C; all files were "
        "written"
    ),
    ExitCode.INTERRUPTED: "stopped by Ctrl-C; quell run-rig ramps u to zero before",
    ExitCode.TERMINATED: "stopped by SIGTERM",
}
HELP = "Exit codes: " + "; ".join(f"{code.value} {code.about}" for code in ExitCode) + "."
"""The table, for the help text of the command."""


def exit_if_diverged(runs: Iterable[Trajectory]) -> None:
    """End the process with the code for diverged runs if one of them diverged."""
    if any(run.diverged for run in runs):
        sys.exit(ExitCode.DIVERGED)
