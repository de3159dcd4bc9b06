"""Simulation: a scenario, one compiled driver, single runs and batches.

May import ``controllers``, ``plants``, ``signals``, ``records`` and what they import.
"""

from quell.simulation.scenario import Scenario
from quell.simulation.simulate import simulate

__all__ = ["Scenario", "simulate"]
