"""Any controllers on any plant in one scenario, and their scores."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from quell import checks
from quell.controllers import Controller
from quell.experiments.common.scores import Scores, step_scores
from quell.parallel import in_parallel
from quell.plants import Plant
from quell.records import metrics
from quell.records.trajectory import Trajectory
from quell.simulation import Scenario, simulate

BAND = metrics.SETTLING_BAND  # half width of the settling band, as a fraction of the step

_KEYS = (
    *("overshoot", "settling_time", "disturbance_peak", "rms"),
    *("control_variation", "total_variation"),
)


@dataclass(frozen=True)
class Comparison:
    """The result of ``compare``, by name of the controller."""

    runs: dict[str, Trajectory]
    scores: dict[str, Scores]  #: None for a number that a run does not have

    def to_json(self) -> dict[str, Any]:
        """Return scores and statuses, for programs."""
        ends = {
            name: {"status": run.status.name or "OK", "diverged": run.diverged}
            for name, run in self.runs.items()
        }
        return {"controllers": {name: score | ends[name] for name, score in self.scores.items()}}


def compare(
    plant: Plant,
    controllers: Mapping[str, Controller],
    scenario: Scenario,
    *,
    load_at: float | None = None,
    band: float = BAND,
    record_every: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Comparison:
    """Run controllers on a plant through one scenario with the same noise, and score the runs.

    Parameters
    ----------
    plant, scenario, record_every
        as for ``simulate``; with ``record_every`` above 1 there is no control variation.
    controllers
        by name, any number, with any sample times.
    load_at
        time from which on a disturbance is scored [s]. The run before it is scored as a step, from
        its first value to the last reference before ``load_at``. By default the whole run is the
        step.
    band
        half width of the settling band, as a fraction of the step.
    progress
        called with the finished share, 0 to 1.

    Returns
    -------
    Comparison
        with ``overshoot`` (fraction), ``settling_time`` [s], ``disturbance_peak`` (largest ``|r −
        y|`` from ``load_at`` on) and ``rms`` of r − y over the whole run [y-unit], and
        ``control_variation`` and ``total_variation`` over the whole run [u-unit]; the latter has
        the first jump of u from zero.

    Examples
    --------
    >>> from quell.controllers.baselines import PID
    >>> from quell.plants import LinearPlant
    >>> lag = LinearPlant([[-1.0]], [1.0], [1.0])
    >>> step = Scenario(reference=1.0, duration=5.0)
    >>> result = compare(lag, {"PI": PID(kp=4.0, ki=4.0, dt=0.01)}, step)
    >>> round(result.scores["PI"]["settling_time"], 2)
    0.96
    """
    if not controllers:
        raise ValueError("controllers is empty: must have at least one, as {name: controller}")
    checks.positive("band", band)
    if load_at is not None and not 0.0 < checks.finite("load_at", load_at) < scenario.duration:
        raise ValueError(
            f"load_at = {load_at!r}: must lie within (0, duration = {scenario.duration!r})"
        )
    jobs = [
        partial(simulate, plant, controller, scenario, record_every=record_every)
        for controller in controllers.values()
    ]
    runs = dict(zip(controllers, in_parallel(jobs, progress), strict=True))
    duration = scenario.duration
    scores = {name: score(run, duration, load_at, band) for name, run in runs.items()}
    return Comparison(runs, scores)


def score(
    run: Trajectory, duration: float, load_at: float | None = None, band: float = BAND
) -> Scores:
    """Return the scores of one run; None if it ended too early, or y did not settle."""
    found: Scores = dict.fromkeys(_KEYS)
    step_ends = duration if load_at is None else load_at
    t, y, r = run.t, run["y"], run["r"]
    if run.ended >= step_ends - 2.0 * run.dt:
        part = run.window(0.0, math.inf if load_at is None else load_at)
        target, initial = float(r[part][-1]), float(y[0])
        if target != initial:
            found |= step_scores(t[part], y[part], target, band, initial)
    if not run.diverged:
        error = r - y
        if load_at is not None:
            found["disturbance_peak"] = metrics.peak(error[run.window(load_at, math.inf)])
        found["rms"] = metrics.rms(error)
        if run.every == 1:
            found["control_variation"] = metrics.control_variation(run["u"])
            found["total_variation"] = metrics.total_variation(run["u"])
    return found
