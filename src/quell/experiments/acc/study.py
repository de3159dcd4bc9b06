"""The ACC benchmark, a test designed by others: fixed controllers on a thousand uncertain plants.

Two masses on a spring, moved through an actuator with lag; all parameters are uncertain. After a
unit impulse on m2 the output must be within 0.1 m from 15 s on, with ``|u| ≤ 0.5`` N always
(Rocchetta, Crespo & Kenny, DSCC 2019). Each plant is simulated twice, without and with the cubic
part of its spring, for 30 s at dt = 10 ms.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from quell.controllers import Controller
from quell.experiments.acc.cases import CaseResult, study_cases
from quell.experiments.acc.controllers import DT, PUBLISHED, designs
from quell.experiments.acc.criteria import DURATION, Judged, judge
from quell.experiments.acc.published import judge_published
from quell.experiments.acc.samples import plant
from quell.experiments.acc.stability import unstable
from quell.plants import CubicSpringPlant, LinearPlant, PlantBatch
from quell.simulation import Scenario, simulate
from quell.types import Matrix, Progress, Vector

SPRINGS = {"linear": False, "cubic": True}
# Number of plants for the timing on one core: about a second on the machines used here.
_ONE_CORE = 100
# |y| at which a run ends [m]: a softening spring can break. Chosen by hand; any |y| far above 0.1 m
# is a failure.
_LOST = 1e3


@dataclass(frozen=True)
class Result:
    """The results, by spring and controller."""

    samples: Matrix
    source: str  #: origin of the samples
    judged: Mapping[str, Mapping[str, Judged]]
    cases: Mapping[str, CaseResult]  #: design cases of the original problem, by controller
    runs_per_second: float  #: judged runs of 30 s, of all sampled controllers, on all cores
    runs_per_second_one_core: float

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``."""
        rates: dict[str, Any] = {}
        for spring, found in self.judged.items():
            rates[spring] = {name: judged.to_json() for name, judged in found.items()}
        return rates | {
            "cases": {name: case.to_json() for name, case in self.cases.items()},
            "samples": {"source": self.source, "count": len(self.samples)},
            "runs_per_second": self.runs_per_second,
            "runs_per_second_one_core": self.runs_per_second_one_core,
        }


def run(samples: Matrix, source: str = "given", progress: Progress | None = None) -> Result:
    """Run the benchmark on samples (count, 6), and the design cases of the original problem."""
    report = progress or (lambda part, share: None)
    sampled, judged, spent, count = designs(DT), {}, 0.0, 0
    for spring, cubic in SPRINGS.items():
        found = {}
        for i, (name, published) in enumerate(PUBLISHED.items()):
            report(f"{name}, {spring}", i / len(PUBLISHED))
            found[name] = judge_published(published, samples, cubic)
        for name, controller in sampled.items():
            began = time.perf_counter()
            part = partial(report, f"{name}, {spring}")
            found[name] = judge_sampled(controller, samples, cubic, part)
            spent, count = spent + time.perf_counter() - began, count + len(samples)
        judged[spring] = found
    report("one core", 0.0)
    few, began = samples[:_ONE_CORE], time.perf_counter()
    for cubic in SPRINGS.values():
        for controller in sampled.values():
            judge_sampled(controller, few, cubic, workers=1)
    alone = len(few) * len(SPRINGS) * len(sampled) / (time.perf_counter() - began)
    report("design cases", 0.0)
    return Result(samples, source, judged, study_cases(), count / spent, alone)


def judge_sampled(
    controller: Controller,
    samples: Matrix,
    cubic: bool,
    progress: Callable[[float], None] | None = None,
    workers: int | None = None,
) -> Judged:
    """Simulate one controller on every plant and judge it; on all cores by default."""
    plants = [plant(sample, cubic) for sample in samples]
    recorded = records(controller, plants, 1.0 / samples[:, 1], progress, workers)
    return judge(*recorded, unstable(plants, controller))


def records(
    controller: Controller,
    plants: Sequence[LinearPlant | CubicSpringPlant],
    speeds: Vector,
    progress: Callable[[float], None] | None = None,
    workers: int | None = None,
) -> tuple[Vector, Matrix, Matrix]:
    """Return times (samples,), y and u (count, samples); m2 starts with ``speeds`` [m/s]."""
    starts = ([0.0, 0.0, 0.0, speed, 0.0] for speed in speeds.tolist())
    impulses = [Scenario(duration=DURATION, x0=x0) for x0 in starts]
    options: dict[str, Any] = {"limit": _LOST, "progress": progress, "workers": workers}
    runs = simulate(PlantBatch(plants), controller, impulses, record=("y", "u"), **options)
    return runs.t, runs["y"], runs["u"]
