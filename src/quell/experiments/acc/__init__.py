"""The ACC robust-control benchmark: published controllers and ours on uncertain plants.

May import ``tuning``, ``experiments.common`` and ``experiments.compare``.
"""

from quell.experiments.acc.cases import CaseResult, study_cases
from quell.experiments.acc.controllers import DT, PUBLISHED, TransferFunction, designs
from quell.experiments.acc.criteria import Judged, judge
from quell.experiments.acc.figures import against_spread, draw, save
from quell.experiments.acc.published import judge_published
from quell.experiments.acc.samples import boxed, generated, plant, read, widened
from quell.experiments.acc.stability import unstable
from quell.experiments.acc.study import SPRINGS, Result, judge_sampled, records, run
from quell.sweeping.shares import share_interval as interval

__all__ = [
    "DT",
    "PUBLISHED",
    "SPRINGS",
    "CaseResult",
    "Judged",
    "Result",
    "TransferFunction",
    "against_spread",
    "boxed",
    "designs",
    "draw",
    "generated",
    "interval",
    "judge",
    "judge_published",
    "judge_sampled",
    "plant",
    "read",
    "records",
    "run",
    "save",
    "study_cases",
    "unstable",
    "widened",
]
