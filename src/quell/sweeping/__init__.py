"""Sweeps: many runs over parameters of plant, controller and scenario, stored on disk (docs/scale).

May import ``simulation``, ``records``, ``plants`` and what these import.
"""

from quell.sweeping.measures import Measure
from quell.sweeping.runs import Normal, Plan, Range
from quell.sweeping.sweep import Sweep, sweep

__all__ = ["Measure", "Normal", "Plan", "Range", "Sweep", "sweep"]
