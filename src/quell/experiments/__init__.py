"""Published experiments, run again and judged: one module for each."""

from quell.experiments import two_mass_spring

__all__ = ["two_mass_spring"]
