"""Files."""

from __future__ import annotations

import math
import resource
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import quell as ql
from quell.files import (
    check_writable,
    csv_rows,
    new_folder,
    nonfinite_to_none,
    whole_text,
    write_json,
    written_atomically,
)


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    """A failure leaves the old file and no other."""
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), written_atomically(path, overwrite=True) as part:
        part.write_text(f"new {1 / 0}")
    assert [p.name for p in tmp_path.iterdir()] == ["file.txt"]
    assert path.read_text() == "old"
    with written_atomically(path, overwrite=True) as part:
        part.write_text("new")
    assert path.read_text() == "new"
    with written_atomically(tmp_path / "other.txt") as part:
        part.write_text("other")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file.txt", "other.txt"]
    assert (tmp_path / "other.txt").read_text() == "other"


@pytest.mark.parametrize("links", [True, False])
def test_no_file_is_replaced_unless_asked(
    links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither one that is there before, nor one that comes meanwhile; on any file system."""

    def no_link(part: Path, target: Path) -> None:
        raise PermissionError(1, "Operation not permitted")

    if not links:
        monkeypatch.setattr("quell.files.os.link", no_link)
    path = tmp_path / "file.txt"
    writing = written_atomically(path)
    writing.__enter__().write_text("new")
    path.write_text("came meanwhile")
    with pytest.raises(ValueError, match="the file exists; choose another name, or ask"):
        writing.__exit__(None, None, None)
    (tmp_path / "link.txt").symlink_to("nothing.txt")
    for name in ("file.txt", "link.txt"):
        with pytest.raises(ValueError, match=f"path = .*{name}.: the file exists"):
            check_writable(tmp_path / name)
        with pytest.raises(ValueError, match="the file exists"):
            write_json(tmp_path / name, {})
    assert path.read_text() == "came meanwhile"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file.txt", "link.txt"]
    with written_atomically(tmp_path / "free.txt") as part:
        part.write_text("new")
    assert (tmp_path / "free.txt").read_text() == "new"
    write_json(path, {}, overwrite=True)
    assert path.read_text() == "{}\n"


def test_a_device_is_not_replaced_by_a_file() -> None:
    """Where root could, too."""
    for overwrite in (False, True):
        with pytest.raises(ValueError, match="path = '/dev/null': "):
            write_json("/dev/null", {}, overwrite)
    assert Path("/dev/null").is_char_device()


def test_each_new_folder_has_a_name_of_its_own(tmp_path: Path) -> None:
    """Also if nothing was written yet, as while two commands run at the same time."""
    (tmp_path / "figures-2").touch()
    with ThreadPoolExecutor(4) as pool:
        folders = [pool.submit(new_folder, tmp_path / "figures") for _ in range(4)]
        names = sorted(each.result().name for each in folders)
    assert names == ["figures", "figures-3", "figures-4", "figures-5"]


def test_a_new_folder_that_stays_empty_is_removed_at_the_end(tmp_path: Path) -> None:
    """After an error nothing is left; what is written stays."""
    code = (
        "from quell.files import new_folder\n"
        "new_folder('empty'), (new_folder('used') / 'one.png').touch()\n"
        "raise SystemExit(3)"
    )
    ended = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False)
    assert ended.returncode == 3
    assert [each.name for each in tmp_path.iterdir()] == ["used"]


def test_a_full_disk_is_named_with_the_file_in_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    """A limit on the file size acts as a full disk; HDF5's own text has a page."""
    run = ql.Trajectory(np.zeros((2000, 3)), (("r", 1), ("y", 1), ("u", 1)), 0.01)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    try:
        for name, write in (
            ("out.json", lambda path: write_json(path, list(range(9999)))),
            ("run.nc", run.save),
        ):
            with pytest.raises(OSError, match=f"File too large: '.*{name}'") as failed:
                write(tmp_path / name)
            assert "\n" not in str(failed.value)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


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
    """Empty lines count, and are left out; a cell is one line."""
    assert [*csv_rows(['"a\n', ' b",c\n'], "file")] == [(2, ["a b", "c"])]
    assert [*csv_rows(["a; b\n", "\n", " ;\n", "1;2\n"], "file", ";")] == [
        (1, ["a", "b"]),
        (4, ["1", "2"]),
    ]
