"""Packages that only some rigs need."""

from __future__ import annotations

import importlib
from typing import Any


def needed(module: str, extra: str, purpose: str) -> Any:
    """Import a third-party module, or say which extra brings it.

    Raises
    ------
    ImportError
        where it is missing.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f'{purpose} needs {module}, which can\'t be imported ({error}): pip install "quell[{extra}]"'
        ) from error
