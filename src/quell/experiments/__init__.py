"""Published experiments, run again and judged, and trials of our own: one module for each."""

from quell.experiments import (
    adversaries,
    compare,
    gradient_range,
    random_loops,
    stress,
    torsional,
    torsional_study,
    two_mass_spring,
    two_mass_study,
)

__all__ = [
    "adversaries",
    "compare",
    "gradient_range",
    "random_loops",
    "stress",
    "torsional",
    "torsional_study",
    "two_mass_spring",
    "two_mass_study",
]
