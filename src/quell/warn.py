"""Warnings whose source is the line of the user's program that called quell."""

from __future__ import annotations

import sys
import warnings

from quell.types import DesignWarning

# Modules whose frames are between the user's call and the warning.
_BETWEEN = ("quell", "functools")


def warn(message: str, category: type[Warning] = DesignWarning) -> None:
    """Issue a warning; its source is the nearest line outside of quell."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and _package(frame.f_globals) in _BETWEEN:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


def _package(names: dict[str, object]) -> str:
    """Return the package of a frame with these global names."""
    return str(names.get("__name__", "")).partition(".")[0]
