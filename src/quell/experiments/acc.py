"""The ACC benchmark as an outside test: fixed controllers against a thousand uncertain plants.

Two masses on a spring, pushed through an actuator with lag; all of it uncertain. From a unit impulse on m2 the output must be within
0.1 m from 15 s on, with |u| ≤ 0.5 N always (Rocchetta, Crespo & Kenny, DSCC 2019). Every plant is simulated twice, without and with
the cubic part of its spring, for 30 s at dt = 10 ms.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from quell.controllers import ADRC
from quell.experiments import acc_samples
from quell.experiments.acc_cases import CaseResult, study_cases
from quell.experiments.acc_criteria import DURATION, Judged, judge
from quell.experiments.acc_designs import DT, PUBLISHED, designs
from quell.experiments.acc_loops import unstable
from quell.experiments.acc_published import judge_published
from quell.experiments.parallel import in_parallel
from quell.plants import CubicSpringPlant, LinearPlant
from quell.simulation import Scenario, simulate
from quell.types import Matrix, Vector

SPRINGS = {"linear": False, "cubic": True}
# Runs in a job.
_TOGETHER = 50
# Where a plant has flown apart; a spring that softens can break.
_LOST = 1e3

Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class Result:
    """What came out, by spring and controller."""

    samples: Matrix
    source: str
    """Where the samples come from."""
    judged: Mapping[str, Mapping[str, Judged]]
    cases: Mapping[str, CaseResult]
    """The original problem's design cases, by controller."""
    runs_per_second: float
    """30 s runs of our controllers, on all cores."""

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``."""
        rates = {spring: {name: judged.to_json() for name, judged in found.items()} for spring, found in self.judged.items()}
        return rates | {
            "cases": {name: case.to_json() for name, case in self.cases.items()},
            "samples": {"source": self.source, "count": len(self.samples)},
            "runs_per_second": self.runs_per_second,
        }


def run(samples: Matrix, source: str = "given", tell: Tell | None = None) -> Result:
    """Run the benchmark on samples (count, 6), and the original problem's cases; ``tell`` hears what is done, and the share that is."""
    say = tell or (lambda what, share: None)
    ours, judged, spent, count = designs(DT), {}, 0.0, 0
    for spring, cubic in SPRINGS.items():
        found = {}
        for i, (name, published) in enumerate(PUBLISHED.items()):
            say(f"{name}, {spring}", i / len(PUBLISHED))
            found[name] = judge_published(published, samples, cubic)
        for name, controller in ours.items():
            began = time.perf_counter()
            found[name] = judge_sampled(controller, samples, cubic, partial(say, f"{name}, {spring}"))
            spent, count = spent + time.perf_counter() - began, count + len(samples)
        judged[spring] = found
    say("design cases", 0.0)
    return Result(samples, source, judged, study_cases(), count / spent)


def judge_sampled(controller: ADRC, samples: Matrix, cubic: bool, tell: Callable[[float], None] | None = None) -> Judged:
    """Simulate one controller on every plant and judge it; on all cores."""
    plants = [acc_samples.plant(sample, cubic) for sample in samples]
    return judge(*records(controller, plants, 1.0 / samples[:, 1], tell), unstable(plants, controller))


def records(
    controller: ADRC, plants: Sequence[LinearPlant | CubicSpringPlant], speeds: Vector, tell: Callable[[float], None] | None = None
) -> tuple[Vector, Matrix, Matrix]:
    """Return times (samples,), y and u (count, samples) after m2 was hit to the ``speeds`` [m/s]; no numbers after a run's early end."""
    samples = round(DURATION / controller.dt) + 1
    y, u = np.full((2, len(plants), samples), np.nan)

    def some(first: int) -> None:
        for i in range(first, min(first + _TOGETHER, len(plants))):
            impulse = Scenario(duration=DURATION, x0=[0.0, 0.0, 0.0, speeds[i], *[0.0] * (plants[i].order - 4)])
            run = simulate(plants[i], controller, impulse, limit=_LOST)
            y[i, : len(run)], u[i, : len(run)] = run["y"], run["u"]

    in_parallel([partial(some, first) for first in range(0, len(plants), _TOGETHER)], tell)
    return np.arange(samples, dtype=np.float64) * controller.dt, y, u
