"""Speed of batch simulation in runs per second.

    python benchmarks/batch.py [--runs 1000]

Random two-mass plants, 30 s at 10 ms, with an ADRC and a model-based ESO: as a batch on all cores
and in one thread and as a Python loop over ``simulate``. Each time is the
best of several interleaved trials, because single times on a shared machine vary.
"""

from __future__ import annotations

import argparse
import os
import timeit

import numpy as np

import quell as ql


def main() -> None:
    """Print runs per second, and the ratio to a loop over ``simulate``."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=1000)
    runs = parser.parse_args().runs
    rng = np.random.default_rng(0)
    m1, m2, k = rng.uniform(0.8, 1.25, (3, runs))
    observer = ql.ESO.model_based(ql.plants.two_mass_spring(), omega_o=10.0, dt=0.01)
    controller = ql.ADRC(observer, omega_c=1.0)
    scenario = ql.Scenario(
        reference=1.0,
        disturbances=(0.0, ql.signals.Step(height=0.1, at=15.0)),
        noise=ql.signals.BandLimitedNoise(power=1e-12, sample_time=0.01),
        duration=30.0,
    )
    plants = ql.plants.batch(ql.plants.two_mass_spring, m1=m1, m2=m2, k=k)
    result = ql.simulate(plants, controller, scenario)
    print(
        f"{runs} runs of {scenario.duration:g} s at {controller.dt * 1e3:g} ms, "
        f"{np.count_nonzero(result.diverged)} diverged"
    )
    # Elapsed time, because several threads are measured.
    candidates = (
        lambda: ql.plants.batch(ql.plants.two_mass_spring, m1=m1, m2=m2, k=k),
        lambda: ql.simulate(plants, controller, scenario),
        lambda: ql.simulate(plants, controller, scenario, workers=1),
        lambda: [ql.simulate(plant, controller, scenario) for plant in plants],
    )
    times = np.min(
        [[timeit.timeit(candidate, number=1) for candidate in candidates] for _ in range(5)], axis=0
    ).tolist()
    labels = (
        "making the plants",
        f"batch on all {os.cpu_count()} cores",
        "batch on one core",
        "loop over simulate",
    )
    for label, time in zip(labels, times, strict=True):
        print(
            f"{label:26s} {time:7.3f} s {runs / time:9.0f} runs/s {times[-1] / time:7.1f} × "
            f"the loop"
        )


if __name__ == "__main__":
    main()
