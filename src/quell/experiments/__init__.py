"""Published experiments, repeated and judged, and experiments of our own: one folder for each.

May import every folder but ``setup`` and ``cli``.

A folder has the setting (``setup``: plants, controllers, scenarios), the ``study`` that runs and
judges it, and its ``figures``; ``common`` has what several of them use. Nothing in here prints.
An experiment is imported when it is first used: whoever repeats one does not wait for the others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from quell.lazy import imported_on_use, public_names

if TYPE_CHECKING:
    from quell.experiments import acc, compare, over_seeds, stress, torsional, two_mass_spring

__all__ = ["acc", "compare", "over_seeds", "stress", "torsional", "two_mass_spring"]

__getattr__ = imported_on_use(__name__, {}, __all__)

__dir__ = public_names(__name__)
