"""Running the command line in tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest


class Shown(NamedTuple):
    """What a command did."""

    code: int
    out: str
    err: str


def in_this_process(
    arguments: tuple[str, ...], patch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Shown:
    """Run the command here: that spares the imports."""
    from quell.cli import app as cli

    whole, code = cli.app, 0
    try:
        with patch.context() as context:
            context.setattr(cli, "app", lambda: whole(list(arguments)))
            cli.main()
    except SystemExit as ended:
        code = int(ended.code or 0)
    return Shown(code, *capsys.readouterr())


def in_its_own_process(*arguments: str, cwd: Path) -> Shown:
    """Run the command as a user does."""
    command = [sys.executable, "-m", "quell", *arguments]
    ended = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    return Shown(ended.returncode, ended.stdout, ended.stderr)
