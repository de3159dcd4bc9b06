"""The paper's hardware experiment on a twin of its torsional testbed, every claim judged.

May import ``experiments.common``.
"""

from quell.experiments.torsional.figures import draw, save
from quell.experiments.torsional.setup import (
    CASES,
    NAMES,
    PLANTS,
    STARTS,
    Settings,
    controllers,
    model_off,
    plant,
    scenarios,
    score,
)
from quell.experiments.torsional.study import Case, Outcome, Result, run

__all__ = [
    "CASES",
    "NAMES",
    "PLANTS",
    "STARTS",
    "Case",
    "Outcome",
    "Result",
    "Settings",
    "controllers",
    "draw",
    "model_off",
    "plant",
    "run",
    "save",
    "scenarios",
    "score",
]
