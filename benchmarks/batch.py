"""Speed of batch simulation in runs per second.

    python benchmarks/batch.py [--runs 1000] [--trials 5] [--axes]

Random two-mass plants, 30 s at 10 ms, with an ADRC and a model-based ESO, or (--axes) gantries of
two coupled axes, 2 s at 1 ms: as a batch on all cores
and in one thread and as a Python loop over ``simulate``. Each time is the
best of several interleaved trials, because single times on a shared machine vary.
"""

from __future__ import annotations

import os
import timeit
from typing import Any

import numpy as np
from measured import options_of, parser_of, write

import quell as ql


def two_masses(runs: int) -> tuple[Any, ...]:
    """Return plants, controller and scenario of one axis."""
    rng = np.random.default_rng(0)
    m1, m2, k = rng.uniform(0.8, 1.25, (3, runs))
    observer = ql.ESO.model_based(ql.plants.two_mass_spring(), omega_o=10.0, dt=0.01)
    scenario = ql.Scenario(
        reference=1.0,
        disturbances=(0.0, ql.signals.Step(height=0.1, at=15.0)),
        noise=ql.signals.BandLimitedNoise(power=1e-12, sample_time=0.01),
        duration=30.0,
    )
    plants = ql.plants.batch(ql.plants.two_mass_spring, m1=m1, m2=m2, k=k)
    return plants, ql.ADRC(observer, omega_c=1.0), scenario


def gantry(gain: float, friction: float) -> Any:
    """Return a machine whose drives act on both axes."""
    A = [[0, 1, 0, 0], [0, -friction, 0, 0], [0, 0, 0, 1], [0, 0, 0, -3]]
    B = [[0, 0], [gain, 0.5], [0, 0], [0.4, 6]]
    return ql.plants.LinearPlant(A, B, np.eye(4)[[0, 2]])


def gantries(runs: int) -> tuple[Any, ...]:
    """Return plants, controller and scenario of two axes."""
    rng = np.random.default_rng(0)
    one = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3), omega_c=8.0)
    axes = ql.Axes({"x": one, "y": one}, B0=[[5.0, 0.5], [0.4, 6.0]])
    noise = ql.signals.BandLimitedNoise(power=1e-12, sample_time=1e-3)
    load = ql.signals.Step(at=1.0)
    scenario = ql.Scenario((0.1, 0.2), 2.0, disturbances=(0.0, load), noise=noise)
    gain, friction = rng.uniform(3.0, 7.0, runs), rng.uniform(1.0, 3.0, runs)
    return ql.plants.batch(gantry, gain=gain, friction=friction), axes, scenario


def main() -> None:
    """Print runs per second, and the ratio to a loop over ``simulate``."""
    parser = parser_of(__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--axes", action="store_true", help="machines of two axes")
    parser.add_argument("--trials", type=int, default=5, help="of which the best counts")
    given = options_of(parser, runs=20, trials=1)
    runs = given.runs
    plants, controller, scenario = (gantries if given.axes else two_masses)(runs)
    result = ql.simulate(plants, controller, scenario)
    print(
        f"{runs} runs of {scenario.duration:g} s at {controller.dt * 1e3:g} ms, "
        f"{np.count_nonzero(result.diverged)} diverged"
    )
    # Elapsed time, because several threads are measured.
    candidates = (
        lambda: (gantries if given.axes else two_masses)(runs),
        lambda: ql.simulate(plants, controller, scenario),
        lambda: ql.simulate(plants, controller, scenario, workers=1),
        lambda: [ql.simulate(plant, controller, scenario) for plant in plants],
    )
    times = np.min(
        [
            [timeit.timeit(candidate, number=1) for candidate in candidates]
            for _ in range(given.trials)
        ],
        axis=0,
    ).tolist()
    labels = (
        "making the plants",
        f"batch on all {os.cpu_count()} cores",
        "batch on one core",
        "loop over simulate",
    )
    figures: dict[str, Any] = {"runs": runs, "diverged": np.count_nonzero(result.diverged)}
    for label, time in zip(labels, times, strict=True):
        print(
            f"{label:26s} {time:7.3f} s {runs / time:9.0f} runs/s {times[-1] / time:7.1f} × "
            f"the loop"
        )
        figures[label] = {"runs/s": runs / time, "times the loop": times[-1] / time}
    write(given, figures)


if __name__ == "__main__":
    main()
