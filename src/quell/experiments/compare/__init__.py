"""Controllers side by side: on any plant, and on the benchmark of ``quell compare``.

May import ``tuning`` and ``experiments.common``.
"""

from quell.experiments.compare.benchmark import (
    END,
    FORCE,
    FORCE_AT,
    NAMES,
    Benchmark,
    controller,
    scenario,
    tuned_controllers,
    two_mass,
)
from quell.experiments.compare.figures import draw, save
from quell.experiments.compare.of_setup import SetupComparison, of_setup
from quell.experiments.compare.study import BAND, Comparison, compare, score
from quell.experiments.compare.tuned import (
    STRUCTURES,
    Entry,
    Sensitivities,
    sensitivities,
    shaped,
    tuned,
)

__all__ = [
    "BAND",
    "END",
    "FORCE",
    "FORCE_AT",
    "NAMES",
    "STRUCTURES",
    "Benchmark",
    "Comparison",
    "Entry",
    "Sensitivities",
    "SetupComparison",
    "compare",
    "controller",
    "draw",
    "of_setup",
    "save",
    "scenario",
    "score",
    "sensitivities",
    "shaped",
    "tuned",
    "tuned_controllers",
    "two_mass",
]
