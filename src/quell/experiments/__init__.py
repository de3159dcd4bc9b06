"""Published experiments, run again and judged, and trials of our own: one folder for each."""

from quell.experiments import acc, compare, stress, torsional, two_mass_spring

__all__ = ["acc", "compare", "stress", "torsional", "two_mass_spring"]
