"""Files that are written whole or not at all, and replace no other file unless asked to.

The rule of all outputs: an existing file is replaced only where the caller asks for it, with
``overwrite=True`` or ``--overwrite``, and that is checked before the work begins.
"""

from __future__ import annotations

import atexit
import itertools
import json
import math
import os
import shutil
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


def check_writable(path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Check that ``written_atomically`` can write ``path``; a file there is not changed.

    Raises
    ------
    ValueError
        if the file exists and is not to be replaced, or can't be written.
    """
    check_free(path, overwrite)
    _new_file_beside(Path(path)).unlink()


def check_free(path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Check that no file would be replaced, or only a regular one that may be."""
    target = Path(path)
    if target.is_dir() or not os.path.lexists(target):
        return
    if not overwrite:
        raise ValueError(
            f"path = {str(target)!r}: the file exists; choose another name, or ask to replace it "
            "(--overwrite on the command line, overwrite=True in Python)"
        )
    if target.exists() and not target.is_file():
        raise ValueError(f"path = {str(target)!r}: must be a file, is a device or a pipe")


@contextmanager
def written_atomically(path: str | os.PathLike[str], overwrite: bool = False) -> Iterator[Path]:
    """Yield a path to write to; at the end it becomes ``path``, or is removed after an error.

    A ``ValueError`` says that ``path`` exists and is not to be replaced, also if it came into being
    meanwhile; an ``OSError`` names it and the reason, such as a full disk.
    """
    target = Path(path)
    check_free(target, overwrite)
    part = _new_file_beside(target)
    try:
        yield part
        if overwrite:
            part.replace(target)
        else:
            _link(part, target)
    except OSError as error:  # of a library, its text may be a page
        if error.errno is None:
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(target)) from None
    finally:
        part.unlink(missing_ok=True)


def write_folder(
    path: str | os.PathLike[str], files: Mapping[str, str], overwrite: bool = False
) -> tuple[Path, ...]:
    """Write text files into a folder, all of them or none; return their paths.

    Parameters
    ----------
    path
        the folder; it is created if its parent exists. With files in it, it needs ``overwrite``.
    files
        text by path inside the folder, as ``src/servo.c``.
    overwrite
        whether to replace files of these names; others in the folder are left alone.

    Raises
    ------
    ValueError
        if the folder is a file, has files and is not to be changed, or can't be written.
    """
    target = Path(path)
    check_folder(target, overwrite)
    part = target.with_name(f".{target.name}-{uuid.uuid4().hex[:12]}")
    try:
        for name, text in files.items():
            (part / name).parent.mkdir(parents=True, exist_ok=True)
            (part / name).write_text(text, encoding="utf-8", newline="\n")
        if target.exists() and any(target.iterdir()):
            _move_into(part, target, files)
        else:
            if target.exists():
                target.rmdir()
            part.rename(target)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ValueError(f"path = {str(target)!r}: can't be written ({reason})") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return tuple(target / name for name in files)


def check_folder(path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Check that ``write_folder`` can write; raise a ``ValueError`` if not."""
    target = Path(path).absolute()
    if os.path.lexists(target) and not target.is_dir():
        raise ValueError(f"path = {str(path)!r}: must be a folder, is a file")
    if not target.parent.is_dir():
        raise ValueError(f"path = {str(path)!r}: the folder {str(target.parent)!r} must exist")
    found = next(target.iterdir(), None) if target.is_dir() else None
    if found is not None and not overwrite:
        raise ValueError(
            f"path = {str(path)!r}: the folder has files ({found.name}); choose another folder, or "
            "ask to replace files of the same names (--overwrite on the command line, "
            "overwrite=True in Python)"
        )


def _move_into(part: Path, target: Path, names: Iterable[str]) -> None:
    """Move files into a folder, over those of the same names, after a check that all can be."""
    for name in names:
        for place in [target / name, *(target / name).parents]:
            if place == target:
                break
            if os.path.lexists(place) and place.is_dir() == (place == target / name):
                raise ValueError(f"path = {str(place)!r}: is in the way of a file to write")
    for name in names:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (part / name).replace(target / name)


def new_folder(path: str | os.PathLike[str]) -> Path:
    """Create and return the first of ``path``, ``path-2``, ``path-3`` … that does not exist.

    A folder that exists is not taken even if it is empty: another program may be about to write
    into it. If the new folder is still empty when this program ends, it is removed.
    """
    first = Path(path)
    first.parent.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        folder = first if number == 1 else first.with_name(f"{first.name}-{number}")
        with suppress(FileExistsError):
            folder.mkdir()
            remove_if_empty_at_exit(folder)
            return folder
    raise AssertionError


def remove_if_empty_at_exit(folder: Path) -> None:
    """Remove a folder when this program ends, if it is empty then."""
    atexit.register(_remove_if_empty, folder.absolute())


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


def write_json(path: str | os.PathLike[str], value: Any, overwrite: bool = False) -> None:
    """Write dictionaries, lists, strings and finite numbers to a JSON file, whole or not at all."""
    with written_atomically(path, overwrite) as part:
        text = json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False)
        part.write_text(text + "\n", encoding="utf-8")


def nonfinite_to_none(value: Any) -> Any:
    """Return a value for ``write_json``: non-finite numbers become None, and tuples lists."""
    if isinstance(value, dict):
        return {key: nonfinite_to_none(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return [nonfinite_to_none(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _link(part: Path, target: Path) -> None:
    """Name the file ``part`` as ``target``, unless there is such a file already."""
    try:
        os.link(part, target)
    except FileExistsError:
        check_free(target)
    except OSError:  # a file system without hard links
        check_free(target)
        part.replace(target)


def _new_file_beside(target: Path) -> Path:
    if not target.parent.is_dir():
        raise ValueError(f"path = {str(target)!r}: the folder {str(target.parent)!r} must exist")
    if target.is_dir():
        raise ValueError(f"path = {str(target)!r}: must be a file, is a folder")
    part = target.with_name(f".{target.stem}-{uuid.uuid4().hex[:12]}{target.suffix}")
    try:
        part.touch(exist_ok=False)
    except OSError as error:
        raise ValueError(f"path = {str(target)!r}: can't be written ({error.strerror})") from None
    return part
