"""Tuning by simulation: any controller, plant and criterion, with Optuna (extra ``tuning``).

``search`` is below ``quell.tune``: it knows parameters with ranges, a function that builds a
controller from them, and a ``Problem``. May import ``executors`` and what stands before ``tuning``.
"""

from quell.tuning.simulated.problem import Checked, Objective, Problem, Sample
from quell.tuning.simulated.result import Candidate, Search
from quell.tuning.simulated.search import search
from quell.tuning.simulated.space import SearchRange, Space
from quell.tuning.simulated.statistics import FailureRate, Mean, Quantile, Statistic, Worst

__all__ = [
    "Candidate",
    "Checked",
    "FailureRate",
    "Mean",
    "Objective",
    "Problem",
    "Quantile",
    "Sample",
    "Search",
    "SearchRange",
    "Space",
    "Statistic",
    "Worst",
    "search",
]
