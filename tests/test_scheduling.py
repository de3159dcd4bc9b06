"""Which worker runs which test files."""

from __future__ import annotations

from pathlib import Path

import pytest

from .scheduling import GROUPS


@pytest.mark.parametrize("name", GROUPS)
def test_the_files_of_a_group_exist(name: str) -> None:
    """A file that was renamed would compile the group's loops again in another process."""
    tests = Path(__file__).parent
    assert [file for file in GROUPS[name] if not (tests / f"{file}.py").is_file()] == []
