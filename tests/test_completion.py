"""Shells complete the commands and options that there are."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from quell.cli.app import app

from .commands import in_this_process

SHELLS = ("bash", "zsh", "fish")


_MADE: dict[str, str] = {}


@pytest.fixture
def program(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[str], str]:
    """Return a function that returns the program for a shell, which is made once."""

    def of(shell: str) -> str:
        if shell not in _MADE:
            shown = in_this_process(("completion", shell), monkeypatch, capsys)
            assert (shown.code, shown.err) == (0, "")
            _MADE[shell] = shown.out
        return _MADE[shell]

    return of


def commands() -> Iterator[str]:
    """Yield the names of all commands."""
    yield from (name for name in app if not name.startswith("-"))


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash here")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("quell ", {*commands()}),
        ("quell st", {"stress", "studio"}),
        ("quell reproduce t", {"two-mass", "torsional"}),
        ("quell doctor --j", {"--json"}),
        ("quell export --precision s", {"single"}),
        ("quell completion ", {*SHELLS}),
    ],
)
def test_bash_completes(
    program: Callable[[str], str], tmp_path: Path, words: str, expected: set[str]
) -> None:
    """A real bash, with the words of a line as it hands them to the program."""
    (tmp_path / "quell.bash").write_text(program("bash"), encoding="utf-8")
    code = """
    source ./quell.bash
    read -ra COMP_WORDS <<< "$1"
    if [[ "$1" == *" " ]]; then COMP_WORDS+=(""); fi
    COMP_CWORD=$((${#COMP_WORDS[@]} - 1)) COMP_LINE="$1" COMP_POINT=${#1}
    _quell
    printf '%s\\n' "${COMPREPLY[@]}"
    """
    done = subprocess.run(
        ["bash", "-c", code, "bash", words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    found = {each.strip() for each in done.stdout.splitlines()} - {""}
    assert expected <= found, done
    assert len(found) <= len(expected) + 3  # --help and the like


@pytest.mark.trial
@pytest.mark.parametrize("shell", SHELLS)
def test_the_program_of_each_shell_knows_all_commands(
    program: Callable[[str], str], shell: str
) -> None:
    """And is free of errors of syntax, where the shell is here."""
    text = program(shell)
    assert all(name in text for name in commands())
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=text, text=True, check=True)
