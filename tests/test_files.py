"""Files."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from quell.files import nonfinite_to_none, write_json, written_atomically
from quell.reading import csv_rows, whole_text


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    """A failure leaves the old file and no other."""
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), written_atomically(path) as part:
        part.write_text(f"new {1 / 0}")
    assert [p.name for p in tmp_path.iterdir()] == ["file.txt"]
    assert path.read_text() == "old"
    with written_atomically(path) as part:
        part.write_text("new")
    assert path.read_text() == "new"


def test_json_has_no_numbers_that_are_not_finite(tmp_path: Path) -> None:
    """They become null, tuples lists; the file is not begun otherwise."""
    value = {"a": (1.0, math.inf), "b": {"c": math.nan, "d": "nan", "e": 3}}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "out.json", value)
    assert list(tmp_path.iterdir()) == []
    write_json(tmp_path / "out.json", nonfinite_to_none(value))
    text = whole_text(tmp_path / "out.json")
    assert "".join(text.split()) == '{"a":[1.0,null],"b":{"c":null,"d":"nan","e":3}}'


def test_rows_of_a_csv_file_have_the_numbers_of_its_lines() -> None:
    """Empty lines count, and are left out."""
    assert [*csv_rows(["a; b\n", "\n", " ;\n", "1;2\n"], "file", ";")] == [
        (1, ["a", "b"]),
        (4, ["1", "2"]),
    ]
