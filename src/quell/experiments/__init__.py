"""Published experiments, run again and judged: one module for each."""

from quell.experiments import gradient_range, two_mass_spring, two_mass_study

__all__ = ["gradient_range", "two_mass_spring", "two_mass_study"]
