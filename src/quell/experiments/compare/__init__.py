"""Controllers side by side: on any plant, and on the benchmark of ``quell compare``.

May import ``experiments.common``.
"""

from quell.experiments.compare.benchmark import (
    END,
    FORCE,
    FORCE_AT,
    NAMES,
    Benchmark,
    controller,
    scenario,
    two_mass,
)
from quell.experiments.compare.figures import draw, save
from quell.experiments.compare.study import BAND, Comparison, compare, score

__all__ = [
    "BAND",
    "END",
    "FORCE",
    "FORCE_AT",
    "NAMES",
    "Benchmark",
    "Comparison",
    "compare",
    "controller",
    "draw",
    "save",
    "scenario",
    "score",
    "two_mass",
]
