"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def written_atomically(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a path beside ``path`` to write to; put it in the place of ``path`` at the end, or remove it where something failed.

    Raises
    ------
    ValueError
        where the folder of ``path`` does not exist, or ``path`` is a folder.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise ValueError(f"path = {str(target)!r}: the folder {str(target.parent)!r} must exist")
    if target.is_dir():
        raise ValueError(f"path = {str(target)!r}: must be a file, is a folder")
    handle, name = tempfile.mkstemp(prefix=f".{target.stem}-", suffix=target.suffix, dir=target.parent)
    os.close(handle)
    part = Path(name)
    try:
        yield part
        # mkstemp makes files that only the owner can read; give the usual permissions.
        mask = os.umask(0)
        os.umask(mask)
        part.chmod(0o666 & ~mask)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
