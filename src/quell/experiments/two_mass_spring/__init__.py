"""The paper's simulation study on two masses and a spring, every claim judged.

May import ``experiments.common``.
"""

from quell.experiments.two_mass_spring.figures import draw, save
from quell.experiments.two_mass_spring.gradient_range import Trial, stable_up_to, trials
from quell.experiments.two_mass_spring.ranges import Range, ranges
from quell.experiments.two_mass_spring.setup import (
    Settings,
    controller,
    controllers,
    further_controllers,
    gradient_rate,
    scenario,
    score,
)
from quell.experiments.two_mass_spring.study import Result, run

__all__ = [
    "Range",
    "Result",
    "Settings",
    "Trial",
    "controller",
    "controllers",
    "draw",
    "further_controllers",
    "gradient_rate",
    "ranges",
    "run",
    "save",
    "scenario",
    "score",
    "stable_up_to",
    "trials",
]
