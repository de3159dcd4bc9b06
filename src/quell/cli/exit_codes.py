"""How a command ends: exit codes, questions before it acts, Ctrl-C."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from typing import TYPE_CHECKING, Any

from quell.cli.output import Console, print_line

if TYPE_CHECKING:
    from quell.records.trajectory import Trajectory

# ---- Exit codes of all commands ----


class ExitCode(IntEnum):
    """Exit codes of all commands; ``about`` says what each means."""

    DONE = 0
    INTERNAL = 1
    ERROR = 2
    ENDED_BY_SAFETY = 3
    DIVERGED = 4
    NOT_PROVED = 5
    ALARM = 6
    BROKEN = 7
    RUNS_FAILED = 8
    NOT_VALID = 9
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
        "quell run-rig, proxy, tune --device: a limit of safety or a fault ended the run, of the "
        "proxy also the loss of its host; u was ramped to zero"
    ),
    ExitCode.DIVERGED: (
        "quell run, sweep, compare, reproduce two-mass and torsional: a simulated run diverged, or "
        "its y ran away from r; all results were written"
    ),
    ExitCode.NOT_PROVED: (
        "quell export --prove: something is not proved, or there is no Frama-C; all files were "
        "written"
    ),
    ExitCode.ALARM: (
        "quell watch: a number of the machine has changed, now or before; the state was written"
    ),
    ExitCode.BROKEN: (
        "quell doctor: something that quell needs does not work here; a line with NOT says what"
    ),
    ExitCode.RUNS_FAILED: (
        "quell sweep: a run could not be made, simulated or judged; a line with NOT says why, and "
        "all results were written"
    ),
    ExitCode.NOT_VALID: (
        "quell identify: on samples that were held out, or on the record of --validate, the model "
        "is worse than the mean of y; all results were written"
    ),
    ExitCode.INTERRUPTED: (
        "stopped by Ctrl-C, quell run-rig in its loop also by SIGTERM or SIGHUP; it ramps u to zero"
    ),
    ExitCode.TERMINATED: "stopped by SIGTERM, quell run-rig before its loop",
}


def exit_if_diverged(runs: Iterable[Trajectory]) -> None:
    """End the process with the code for diverged runs if one diverged, or its y ran away."""
    if any(run.lost for run in runs):
        sys.exit(ExitCode.DIVERGED)


# ---- Questions before something is applied to a real plant ----


def confirm(console: Console, question: str, yes: bool) -> bool:
    """Ask a question that ``yes`` answers at once; return whether the answer is yes.

    Raises ``ValueError`` where nobody can answer.
    """
    if yes:
        print_line(console, f"{question} yes (--yes)")
        return True
    if not sys.stdin.isatty():
        raise ValueError("yes = False: there is no terminal to ask at; give --yes in scripts")
    return input(f"{question} [y/N] ").strip().lower() in ("y", "yes")


# ---- Ctrl-C and other signals that end a program, while code is compiled or loaded ----


@contextmanager
def exit_on_signal(close: Callable[[], Any]) -> Iterator[None]:
    """Make signals that end a program call ``close`` and exit with 128 plus the signal's number.

    An exception could be lost: compiling and loading run through callbacks that ignore exceptions.
    """
    from quell.realtime.system import termination_handler

    def end(number: int, frame: Any) -> None:
        close()
        print("quell: interrupted", file=sys.stderr, flush=True)
        os._exit(128 + number)

    with termination_handler(end):
        yield
