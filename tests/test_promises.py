"""The page of promises names tests and scripts that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/promises.md").read_text(encoding="utf-8")


def test_every_promise_is_checked_by_something_that_exists() -> None:
    """Each row names a test by file and function, a script of ``benchmarks``, a proof or a command."""
    rows = [
        line for line in PAGE.splitlines() if line.startswith("| ") and "checked by" not in line
    ]
    assert len(rows) > 25
    for row in rows:
        check = row.rsplit(" | ", 1)[1]
        tests = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", check)
        scripts = re.findall(r"`(benchmarks/\w+\.py)`", check)
        assert tests or scripts or "`quell " in check, row
        for file, name in tests:
            text = (ROOT / file).read_text(encoding="utf-8")
            assert f"\ndef {name}(" in text, f"{file} has no {name}"
        assert all((ROOT / file).is_file() for file in scripts), row
