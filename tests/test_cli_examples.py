"""Help of commands: lines to copy at its begin, the page at its end."""

from __future__ import annotations

import shlex
from collections.abc import Callable

import pytest

from quell.cli.app import app
from quell.cli.examples import USAGES
from quell.cli.pages import folder_of_pages

from .commands import Shown, in_this_process
from .contracts.test_options import OPTIONS

Quell = Callable[..., Shown]


@pytest.fixture
def quell(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Quell:
    """Run a command line."""
    return lambda *arguments: in_this_process(arguments, monkeypatch, capsys)


@pytest.mark.parametrize("command", OPTIONS)
def test_examples_of_a_command_are_command_lines(command: str) -> None:
    """Each of them is taken as it stands: options that exist, values of their types."""
    for line in USAGES[command].lines:
        program, *words = shlex.split(line)
        assert program == "quell"
        assert words[: len(command.split())] == command.split()
        function, _, _ = app.parse_args(words, print_error=False, exit_on_error=False)
        assert callable(function)


def test_every_command_names_a_page_that_exists() -> None:
    """Which `quell docs` shows; and no example is of a command that is gone."""
    assert USAGES.keys() == OPTIONS.keys()
    for usage in USAGES.values():
        assert (folder_of_pages() / f"{usage.page}.md").is_file(), usage.page


def test_help_begins_with_lines_to_copy_and_ends_with_the_page(quell: Quell) -> None:
    """`quell help COMMAND` shows it; an unknown topic has a line with the nearest."""
    shown = quell("help", "completion").out
    assert shown.splitlines()[2:4] == [f"    {line}" for line in USAGES["completion"].lines]
    assert shown.rstrip().endswith("More: quell docs commands. Exit codes: quell help exit-codes.")
    refused = quell("help", "rnak")
    assert refused.code == 2
    assert "did you mean rank?" in refused.err
