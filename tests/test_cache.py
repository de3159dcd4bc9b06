"""The disk cache of compiled code: what it keeps, what it removes, and faults of its files.

That a second process loads the code of the first is in tests/test_sized.py.
"""

from __future__ import annotations

import errno
import os
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile

import quell
from quell.kernels import cache, dispatch

pytestmark = pytest.mark.compiled

PACKAGE = Path(quell.__file__).parent


def double(x: Any) -> Any:
    """A small entry point."""
    return 2 * x


def compilations(argument: float = 1.0) -> int:
    """Return how many compilations a new dispatcher of ``double`` needs for an argument's type."""
    entry = dispatch.compiled(double)
    assert entry(argument) == 2 * argument
    return dispatch.compilations(entry)


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A cache folder with the code of ``double`` for floats."""
    monkeypatch.setattr(cache, "cache_path", lambda: tmp_path)
    assert [compilations(), compilations()] == [1, 0]
    return tmp_path


def test_without_a_place_for_the_cache_the_code_is_compiled_by_each_dispatcher(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A directory can't be created under a file."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr(cache, "cache_path", cache.cache_path.__wrapped__)
    assert cache.cache_path() is None
    assert [compilations(), compilations()] == [1, 1]


def test_folders_of_the_user_are_never_removed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """``NUMBA_CACHE_DIR`` may be a project's folder with names like ours."""
    theirs = [tmp_path / f"quell-{name}" for name in ("figures", "data", "a", "b", "c", "d")]
    theirs += [tmp_path / "quell-compiled" / name for name in ("notes", "0123456789abcdef")]
    for folder in theirs:
        folder.mkdir(parents=True)
        (folder / "precious.txt").write_text("mine")
    (theirs[-1] / "CACHEDIR.TAG").write_text("Signature: 8a477f597d28d172789f06886806bc55")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    path = cache.cache_path.__wrapped__()
    assert path is not None
    assert path.is_relative_to(tmp_path)
    assert all((folder / "precious.txt").exists() for folder in theirs)


def test_only_the_versions_used_last_are_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Old versions do not pile up, and the current one is never removed."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    paths = []
    for i in range(8):
        monkeypatch.setattr(cache, "cache_key", lambda package, i=i: f"version{i}")
        paths.append(cache.cache_path.__wrapped__())
        os.utime(paths[-1], (i, i))
    assert [path.exists() for path in paths] == [False] * 4 + [True] * 4


@pytest.mark.parametrize("suffix", ["nbi", "nbc", "nb?"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_damaged_files_lead_to_a_new_compilation(folder: Path, suffix: str, share: float) -> None:
    """Truncated or empty, index or data; afterwards the cache is whole again."""
    files = list(folder.rglob(f"*.{suffix}"))
    assert files
    for file in files:
        content = file.read_bytes()
        file.write_bytes(content[: int(share * len(content))])
    assert [compilations(), compilations()] == [1, 0]


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_unreadable_files_lead_to_a_new_compilation(folder: Path, suffix: str) -> None:
    """A folder in the place of a file can neither be read nor replaced."""
    for file in folder.rglob(f"*.{suffix}"):
        file.unlink()
        file.mkdir()
    assert compilations() == 1


def test_with_a_full_disk_the_code_is_compiled_in_each_process(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is on the disk is still loaded."""

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(IndexDataCacheFile, "_open_for_write", full)
        assert [compilations(1), compilations(1), compilations(1.0)] == [1, 1, 0]
        for index in folder.rglob("*.nbi"):
            index.write_bytes(b"")
        assert compilations() == 1
    assert [compilations(), compilations()] == [1, 0]


def test_code_is_never_replaced_by_that_of_another_signature(folder: Path) -> None:
    """Two processes may both find no index: each then writes a data file of its own."""
    before = {file: file.read_bytes() for file in folder.rglob("*.nbc")}
    for index in folder.rglob("*.nbi"):
        index.unlink()
    assert compilations(np.float32(1.0)) == 1
    assert before == {file: file.read_bytes() for file in before}


def test_the_key_changes_only_with_what_compiled_code_depends_on(tmp_path: Path) -> None:
    """Kernels and all that their files import; not the command line, studies and plots."""
    ignore = shutil.ignore_patterns("__pycache__")
    package = Path(shutil.copytree(PACKAGE, tmp_path / "quell", ignore=ignore))
    before = cache.cache_key(package)
    assert before == cache.cache_key(PACKAGE)

    def key_changes_with(path: str) -> bool:
        file = package / path
        source = file.read_bytes()
        file.write_bytes(source + b"\n")
        changes = cache.cache_key(package) != before
        file.write_bytes(source)
        return changes

    with_kernels = [
        "plants/linear.py",
        "learners/base.py",
        "kernels/dispatch.py",
        "simulation/driver.py",
    ]
    imported = ["types.py", "checks.py", "kernels/linking.py", "kernels/numba_internals.py"]
    others = [
        "cli/app.py",
        "experiments/torsional.py",
        "tuning/report.py",
        "setup/loading.py",
    ]
    assert all(map(key_changes_with, with_kernels + imported))
    assert not any(map(key_changes_with, others))


def test_every_module_with_compiled_code_is_part_of_the_key() -> None:
    """Numba's decorators are used in modules that the key covers."""
    covered = cache.kernel_sources(PACKAGE)
    for file in PACKAGE.rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        if "\nimport numba" in text or "\nfrom numba" in text:
            module = ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts)
            assert module.removesuffix(".__init__") in covered


def test_code_that_another_user_could_have_written_is_not_loaded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Numba unpickles it: the folder is this user's, and only this user writes to it."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    path = cache.cache_path.__wrapped__()
    assert path is not None
    assert path.stat().st_mode & 0o077 == 0
    path.chmod(0o777)
    assert cache.cache_path.__wrapped__() == path
    assert path.stat().st_mode & 0o022 == 0
    monkeypatch.setattr(cache.os, "geteuid", lambda: os.getuid() + 1)
    assert cache.cache_path.__wrapped__() is None
    monkeypatch.undo()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "other"))
    (tmp_path / "other").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "other" / "quell-compiled").symlink_to(tmp_path / "elsewhere")
    assert cache.cache_path.__wrapped__() is None


def test_a_long_compilation_is_announced_with_what_and_how_long(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """While it goes on, and at its end; short ones, and those that nobody wants to hear of, are not."""
    from types import SimpleNamespace
    from typing import NamedTuple

    from numba import typeof

    from quell.kernels import cache as module

    class RlsModel(NamedTuple):
        rate: float

    def run_block() -> None:
        pass

    kept = object.__new__(module.FunctionCache)
    listener = module.CompileTime()
    monkeypatch.setattr(module, "_LONG", 0.02)
    for on, place in ((True, kept), (True, None), (False, kept)):
        dispatcher = SimpleNamespace(py_func=run_block, _cache=place)
        data = {"dispatcher": dispatcher, "args": (typeof(RlsModel(1.0)),)}
        told = SimpleNamespace(data=data)
        listener.announced = on
        listener.on_start(told)
        time.sleep(0.1)
        listener.on_end(told)
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == (2 if on else 0)
        if on:
            once = ", once" if place else ""
            assert lines[0] == f"quell: compiling run block for Rls: takes up to a minute{once}"
            assert lines[1].startswith("quell: compiled in 0.")
            assert ("later runs load it" in lines[1]) == (place is not None)
    assert listener.seconds > listener.told > 0.0
