"""The ACC robust-control benchmark: published controllers and ours on uncertain plants.

May import ``tuning``, ``experiments.common`` and ``experiments.compare``.
"""

from quell.experiments.acc.loops import (
    DT,
    PUBLISHED,
    CaseResult,
    Judged,
    TransferFunction,
    boxed,
    designs,
    generated,
    judge,
    judge_published,
    plant,
    read,
    study_cases,
    unstable,
    widened,
)
from quell.experiments.acc.study import (
    SPRINGS,
    Result,
    against_spread,
    draw,
    judge_sampled,
    records,
    run,
    save,
)
from quell.sweeping.sweep import share_interval as interval

__all__ = [
    "DT", "PUBLISHED", "SPRINGS", "CaseResult", "Judged", "Result", "TransferFunction",
    "against_spread", "boxed", "designs", "draw", "generated", "interval", "judge",
    "judge_published", "judge_sampled", "plant", "read", "records", "run", "save", "study_cases",
    "unstable", "widened"
]  # fmt: skip
