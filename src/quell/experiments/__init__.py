"""Published experiments, repeated and judged, and experiments of our own: one folder for each.

May import every folder but ``setup`` and ``cli``.

A folder has the setting (``setup``: plants, controllers, scenarios), the ``study`` that runs and
judges it, and its ``figures``; ``common`` has what several of them use. Nothing in here prints.
An experiment is imported when it is first used: whoever repeats one does not wait for the others.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quell.experiments import acc, compare, stress, torsional, two_mass_spring

__all__ = ["acc", "compare", "stress", "torsional", "two_mass_spring"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'quell.experiments' has no attribute {name!r}")
    return import_module(f"quell.experiments.{name}")
