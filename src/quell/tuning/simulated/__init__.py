"""Tuning by simulation: any controller, plant and criterion, with Optuna (extra ``tuning``).

``search`` is below ``quell.tune``: it knows parameters with ranges, a function that builds a
controller from them, and a ``Problem``. May import ``executors`` and what stands before ``tuning``.
"""

from quell.tuning.simulated.problem import (
    Checked,
    FailureRate,
    Mean,
    Objective,
    Problem,
    Quantile,
    Sample,
    SearchRange,
    Space,
    Statistic,
    Worst,
)
from quell.tuning.simulated.search import Candidate, Search, search

__all__ = [
    "Candidate", "Checked", "FailureRate", "Mean", "Objective", "Problem", "Quantile", "Sample",
    "Search", "SearchRange", "Space", "Statistic", "Worst", "search"
]  # fmt: skip
