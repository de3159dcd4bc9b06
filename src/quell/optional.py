"""Import of packages that only extras of quell install."""

from __future__ import annotations

import importlib
from typing import Any


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Return a third-party module; an ``ImportError`` names the ``extra`` that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{purpose} needs {module}, which can't be imported ({error}): "
            f"pip install 'quell[{extra}]'"
        ) from error
