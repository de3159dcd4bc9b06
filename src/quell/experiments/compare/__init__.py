"""Controllers side by side on one plant."""

from quell.experiments.compare.study import (
    Benchmark,
    Comparison,
    compare,
    controller,
    scenario,
    score,
    two_mass,
)

__all__ = ["Benchmark", "Comparison", "compare", "controller", "scenario", "score", "two_mass"]
