"""Figures as files: each as PNG and SVG, whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from quell.files import written_atomically


def made(folder: str | os.PathLike[str]) -> Path:
    """Return a folder for figures, made if need be; a ``ValueError`` says why it can't be."""
    where = Path(folder)
    try:
        where.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"figures = {str(where)!r}: must be a folder that can be made ({error.strerror})") from None
    return where


def save_figure(figure: Any, where: Path, name: str) -> list[Path]:
    """Write a figure to ``where`` as PNG and SVG; return the paths. The same figure gives the same files."""
    import matplotlib

    written = []
    with matplotlib.rc_context({"svg.hashsalt": "quell"}):
        for suffix in ("png", "svg"):
            path = where / f"{name}.{suffix}"
            with written_atomically(path) as part:
                figure.savefig(part, dpi=130, metadata={"Date": None} if suffix == "svg" else None)
            written.append(path)
    return written
