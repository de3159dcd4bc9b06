"""Controllers in single precision.

May import all of ``controllers`` but ``baselines``, and what these import.
"""

from quell.controllers.single.single import SinglePrecision, in_single_precision

__all__ = ["SinglePrecision", "in_single_precision"]
