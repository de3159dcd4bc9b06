"""Files that are written whole or not at all."""

from __future__ import annotations

import json
import math
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def check_writable(path: str | os.PathLike[str]) -> None:
    """Check that ``written_atomically`` can write ``path``; a file there is not changed."""
    _new_file_beside(Path(path)).unlink()


def check_new_file(path: Path) -> None:
    """Check that a recording can be written to ``path``."""
    if path.exists() and not path.is_dir():
        raise ValueError(
            f"path = {str(path)!r}: the file exists; recordings are not overwritten: "
            "move it, or choose another name"
        )
    check_writable(path)


@contextmanager
def written_atomically(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path to write to; at the end it replaces ``path``, or is removed after an error."""
    target = Path(path)
    part = _new_file_beside(target)
    try:
        yield part
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write dictionaries, lists, strings and finite numbers to a JSON file, whole or not at all."""
    with written_atomically(path) as part:
        text = json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False)
        part.write_text(text + "\n", encoding="utf-8")


def nonfinite_to_none(value: Any) -> Any:
    """Return a value for ``write_json``: non-finite numbers become None, and tuples lists."""
    if isinstance(value, dict):
        return {key: nonfinite_to_none(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return [nonfinite_to_none(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


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
