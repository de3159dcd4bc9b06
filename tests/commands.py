"""Running the command line, and programs in an interpreter of their own, in tests."""

from __future__ import annotations

import subprocess
import sys
from typing import Any, NamedTuple

import pytest


class Shown(NamedTuple):
    """What a command did."""

    code: int
    out: str
    err: str


def in_this_process(
    arguments: tuple[str, ...], patch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Shown:
    """Run the command here: that spares the imports.

    Figures are made, and written without their axes, which take 0.1 to 0.6 s a file.
    """
    from matplotlib.figure import Figure

    from quell.cli import app as cli

    whole, code = cli.app, 0
    savefig = Figure.savefig

    def save_bare(figure: Figure, *arguments: Any, **options: Any) -> None:
        for axes in figure.axes:
            axes.set_visible(False)
        savefig(figure, *arguments, **options)

    try:
        with patch.context() as context:
            context.setattr(Figure, "savefig", save_bare)
            context.setattr(cli, "app", lambda: whole(list(arguments)))
            cli.main()
    except SystemExit as ended:
        code = int(ended.code or 0)
    return Shown(code, *capsys.readouterr())


def run_python(code: str, check: bool = True, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a program in a fresh interpreter; what it prints is in the result."""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, check=check, capture_output=True, text=True, **options)
