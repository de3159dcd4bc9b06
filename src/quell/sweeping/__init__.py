"""Sweeps: many runs over parameters of plant, controller and scenario, stored on disk (docs/scale).

May import ``simulation``, ``records``, ``plants`` and what these import.
"""

from quell.sweeping.measures import Measure
from quell.sweeping.plan import Plan
from quell.sweeping.result import Sweep
from quell.sweeping.sweep import sweep
from quell.sweeping.values import Normal, Range

__all__ = ["Measure", "Normal", "Plan", "Range", "Sweep", "sweep"]
