"""Failure rates on the 1000 published samples of small uncertainty (Rocchetta, Crespo & Kenny, DSCC 2019).

The samples are not part of this repository; they are looked for beside it, in
``shared/benchmarks/acc``. ``.ci/run`` has the failure rates of our controllers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from quell.experiments import acc
from quell.experiments.acc import PUBLISHED, judge_published

SAMPLES = Path(__file__).resolve().parents[3] / "shared" / "benchmarks" / "acc" / "theta_small.csv"
pytestmark = [
    pytest.mark.compiled,
    pytest.mark.skipif(not SAMPLES.is_file(), reason=f"the published samples are not at {SAMPLES}"),
]


@pytest.mark.parametrize(
    ("name", "rate"),
    [("published nominal", 0.625), ("published SP1(0.05)", 0.865), ("published SP2", 0.047)],
)
def test_the_published_designs_fail_as_often_as_listed(name: str, rate: float) -> None:
    """To the last of 1000 plants, strictly read, with a horizon of 25 s."""
    found = judge_published(PUBLISHED[name], acc.read(SAMPLES), cubic=False, duration=25.0)
    assert np.mean(found.fails) == rate
