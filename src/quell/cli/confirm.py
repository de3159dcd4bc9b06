"""Questions before something is applied to a real plant."""

from __future__ import annotations

import sys

from quell.cli.output import Console, print_line


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
