"""Scores of runs for tables and JSON files; None stands for a number that a run does not have."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from quell.records import metrics
from quell.records.trajectory import Trajectory
from quell.types import Vector

Scores = dict[str, float | None]

# Names of the scores in the experiments of the paper.
METRICS = (
    *("overshoot", "settling_time", "disturbance_peak"),
    *("disturbance_rms", "control_variation", "rms_from_step"),
)


def step_scores(t: Vector, y: Vector, target: float, band: float, initial: float = 0.0) -> Scores:
    """Return overshoot (fraction) and settling time [s], None if y does not settle."""
    settling = metrics.settling_time(t, y, target, band, initial)
    return {
        "overshoot": metrics.overshoot(y, target, initial),
        "settling_time": None if math.isnan(settling) else settling,
    }


def quantiles(values: Iterable[float]) -> Scores:
    """Return median, 90 %, 99 % and maximum of the finite values; None for those of no numbers."""
    array = np.array(list(values))
    finite = array[np.isfinite(array)]
    shares = {"median": 0.5, "p90": 0.9, "p99": 0.99, "max": 1.0}
    if finite.size == 0:
        return dict.fromkeys(shares)
    return {key: float(np.quantile(finite, share)) for key, share in shares.items()}


def ended_early(runs: Mapping[str, Trajectory]) -> dict[str, dict[str, Any]]:
    """Return time and message of the runs that diverged, by name."""
    ended = {name: run for name, run in runs.items() if run.diverged}
    return {name: {"at": run.ended, "message": run.message} for name, run in ended.items()}
