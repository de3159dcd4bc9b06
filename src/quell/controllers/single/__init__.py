"""Controllers in single precision.

May import all of ``controllers`` but ``baselines``, and what these import.
"""

from quell.controllers.single.single import SinglePrecision, check_compilable, in_single_precision

__all__ = ["SinglePrecision", "check_compilable", "in_single_precision"]
