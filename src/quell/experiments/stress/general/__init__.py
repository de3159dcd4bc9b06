"""The trial in loops of all kinds: orders 1 to 4, nonlinear, delayed, under loads of all kinds.

May import ``experiments.stress`` beside it and what that imports.
"""

from quell.experiments.stress.general.attacks import (
    KINDS,
    adversary_at,
    centre,
    draw_attack,
    exact_weights,
    spread,
)
from quell.experiments.stress.general.cross_entropy import Found, harm, judge, search
from quell.experiments.stress.general.loops import GeneralLoop, draw_loop
from quell.experiments.stress.general.loops.plant import GeneralPlant
from quell.experiments.stress.general.loops.random_plants import FAMILIES
from quell.experiments.stress.general.measures import Measures, measure_error
from quell.experiments.stress.general.named import Case, run_named
from quell.experiments.stress.general.program import INPUTS, Program, Watched
from quell.experiments.stress.general.result import Bar, GeneralResult, summary
from quell.experiments.stress.general.study import run
from quell.experiments.stress.general.trial import GeneralOutcome, error_of, run_one

__all__ = [
    "FAMILIES",
    "INPUTS",
    "KINDS",
    "Bar",
    "Case",
    "Found",
    "GeneralLoop",
    "GeneralOutcome",
    "GeneralPlant",
    "GeneralResult",
    "Measures",
    "Program",
    "Watched",
    "adversary_at",
    "centre",
    "draw_attack",
    "draw_loop",
    "error_of",
    "exact_weights",
    "harm",
    "judge",
    "measure_error",
    "run",
    "run_named",
    "run_one",
    "search",
    "spread",
    "summary",
]
