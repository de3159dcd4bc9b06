"""Published experiments, repeated and judged, and experiments of our own: one folder for each.

May import every folder but ``setup`` and ``cli``.

A folder has the setting (``setup``: plants, controllers, scenarios), the ``study`` that runs and
judges it, and its ``figures``; ``common`` has what several of them use. Nothing in here prints.
"""

from quell.experiments import acc, compare, stress, torsional, two_mass_spring

__all__ = ["acc", "compare", "stress", "torsional", "two_mass_spring"]
