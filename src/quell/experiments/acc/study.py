"""The ACC benchmark as an outside test: fixed controllers against a thousand uncertain plants.

Two masses on a spring, pushed through an actuator with lag; all of it uncertain. From a unit impulse on m2 the output must be within
0.1 m from 15 s on, with ``|u| ≤ 0.5`` N always (Rocchetta, Crespo & Kenny, DSCC 2019). Every plant is simulated twice, without and with
the cubic part of its spring, for 30 s at dt = 10 ms.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from quell.experiments.acc import samples as acc_samples
from quell.experiments.acc.cases import CaseResult, study_cases
from quell.experiments.acc.controllers import DT, PUBLISHED, designs
from quell.experiments.acc.criteria import DURATION, Judged, judge
from quell.experiments.acc.loops import unstable
from quell.experiments.acc.published import judge_published
from quell.plants import CubicSpringPlant, LinearPlant, PlantBatch
from quell.simulation import Scenario, simulate
from quell.types import Matrix, Vector

SPRINGS = {"linear": False, "cubic": True}
# So many plants are timed on one core.
_ONE_CORE = 100
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
    """Runs of 30 s, judged, of all sampled controllers, on all cores."""
    runs_per_second_one_core: float

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``."""
        rates = {
            spring: {name: judged.to_json() for name, judged in found.items()}
            for spring, found in self.judged.items()
        }
        return rates | {
            "cases": {name: case.to_json() for name, case in self.cases.items()},
            "samples": {"source": self.source, "count": len(self.samples)},
            "runs_per_second": self.runs_per_second,
            "runs_per_second_one_core": self.runs_per_second_one_core,
        }


def run(samples: Matrix, source: str = "given", progress: Tell | None = None) -> Result:
    """Run the benchmark on samples (count, 6), and the original problem's cases; ``progress`` hears what is done, and the share that is."""
    say = progress or (lambda what, share: None)
    sampled, judged, spent, count = designs(DT), {}, 0.0, 0
    for spring, cubic in SPRINGS.items():
        found = {}
        for i, (name, published) in enumerate(PUBLISHED.items()):
            say(f"{name}, {spring}", i / len(PUBLISHED))
            found[name] = judge_published(published, samples, cubic)
        for name, controller in sampled.items():
            began = time.perf_counter()
            found[name] = judge_sampled(
                controller, samples, cubic, partial(say, f"{name}, {spring}")
            )
            spent, count = spent + time.perf_counter() - began, count + len(samples)
        judged[spring] = found
    say("one core", 0.0)
    few, began = samples[:_ONE_CORE], time.perf_counter()
    for cubic in SPRINGS.values():
        for controller in sampled.values():
            judge_sampled(controller, few, cubic, workers=1)
    alone = len(few) * len(SPRINGS) * len(sampled) / (time.perf_counter() - began)
    say("design cases", 0.0)
    return Result(samples, source, judged, study_cases(), count / spent, alone)


def judge_sampled(
    controller: Any,
    samples: Matrix,
    cubic: bool,
    progress: Callable[[float], None] | None = None,
    workers: int | None = None,
) -> Judged:
    """Simulate one controller on every plant and judge it; on all cores by default."""
    plants = [acc_samples.plant(sample, cubic) for sample in samples]
    return judge(
        *records(controller, plants, 1.0 / samples[:, 1], progress, workers),
        unstable(plants, controller),
    )


def records(
    controller: Any,
    plants: Sequence[LinearPlant | CubicSpringPlant],
    speeds: Vector,
    progress: Callable[[float], None] | None = None,
    workers: int | None = None,
) -> tuple[Vector, Matrix, Matrix]:
    """Return times (samples,), y and u (count, samples) after m2 was hit to the ``speeds`` [m/s]; no numbers after a run's early end."""
    impulses = [
        Scenario(duration=DURATION, x0=[0.0, 0.0, 0.0, speed, 0.0]) for speed in speeds.tolist()
    ]
    runs = simulate(
        PlantBatch(plants),
        controller,
        impulses,
        limit=_LOST,
        record=("y", "u"),
        progress=progress,
        workers=workers,
    )
    return runs.t, runs["y"], runs["u"]
