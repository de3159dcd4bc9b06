"""The trial of the guard: hostile and honest learners in random loops, beside MF-ESO.

May import ``experiments.common``.
"""

from quell.experiments.stress.adversaries import KINDS, Adversary, Turncoat, draw_adversary
from quell.experiments.stress.figures import draw, save
from quell.experiments.stress.study import (
    DRAWS,
    HONEST,
    Bar,
    Errors,
    Loop,
    Outcome,
    Result,
    draw_loops,
    errors,
    run,
    run_one,
    summary,
)

__all__ = [
    "DRAWS", "HONEST", "KINDS", "Adversary", "Bar", "Errors", "Loop", "Outcome", "Result",
    "Turncoat", "draw", "draw_adversary", "draw_loops", "errors", "run", "run_one", "save",
    "summary"
]  # fmt: skip
