"""Deviation of batches over lanes from the exact loop, in random linear loops.

    python benchmarks/lanes.py [--designs 200] [--seed 0]

Each design is an ADRC (model-free, model-based or a cascade), a PID controller or an LQG controller
for a random plant of order 1 to 6, with noise, a step and a load, for 20 or 200 s; some with tight
limits of u and its rate. It runs on 32 plants that differ from its own by up to 20 %, some of them
so late that the loop is unstable. Of each run the largest deviation of any channel counts, relative
to the channel's range in that run.
"""

from __future__ import annotations

import argparse
import warnings
from collections import defaultdict

import numpy as np

import quell as ql
from quell.analysis import analyse

RUNS = 32
TOLERANCE = 1e-9  # what the docstring of simulate promises for stable loops


def plants(rng: np.random.Generator) -> tuple[ql.plants.LinearPlant, list[ql.plants.LinearPlant]]:
    """Return a plant and others like it: a chain with poles of up to 3 rad/s, gains around one."""
    order = int(rng.integers(1, 7))
    a, b = rng.uniform(0.0, 1.5, order) ** np.arange(order, 0, -1.0), rng.uniform(0.5, 2.0)

    def made(spread: float) -> ql.plants.LinearPlant:
        A = np.diag(np.ones(order - 1), 1)
        A[-1] = -a * rng.uniform(1.0 - spread, 1.0 + spread, order)
        gain = b * rng.uniform(1.0 - spread, 1.0 + spread)
        return ql.plants.LinearPlant(A, gain * np.eye(order)[-1], np.eye(order)[0])

    return made(0.0), [made(0.2) for _ in range(RUNS)]


def controllers(
    plant: ql.plants.LinearPlant, rng: np.random.Generator, dt: float
) -> dict[str, object]:
    """Return one of each kind for a plant."""
    omega_c = rng.uniform(0.5, 2.0)
    omega_o, b0 = omega_c * rng.uniform(3.0, 10.0), float(plant.B[-1, 0])
    limits: dict[str, float] = {}
    if rng.random() < 0.5:
        largest = 10.0 ** rng.uniform(-1.0, 1.0)
        limits = {"u_min": -largest, "u_max": largest, "rate_limit": 10.0 ** rng.uniform(0.0, 2.0)}
    order = plant.order
    free = ql.ESO.model_free(order, b0, omega_o, dt)
    based = ql.ESO.model_based(plant, omega_o, dt)
    cascade = ql.ESO.cascade(order, b0, omega_o, dt)
    time = 1.0 / omega_c
    pid = ql.baselines.PID.simc(b0 * time, time, 0.2 * time, 0.5 * time, dt=dt, **limits)
    return {
        "MF-ESO": ql.ADRC(free, omega_c, **limits),
        "MB-ESO": ql.ADRC(based, omega_c, **limits),
        "cascade": ql.ADRC(cascade, omega_c, **limits),
        "PID": pid,
        "LQG": ql.baselines.LQG(plant, omega_c, omega_o, dt, **limits),
    }


def deviations(exact: ql.BatchTrajectory, lanes: ql.BatchTrajectory) -> np.ndarray:
    """Return the largest relative deviation of each run, infinite if it ended at another time."""
    found = np.where(exact.lengths == lanes.lengths, 0.0, np.inf)
    for i in np.flatnonzero(found == 0.0):
        one, other = exact.run(i), lanes.run(i)
        for name in (name for name in one.names if name != "status"):
            size = np.max(np.abs(one[name]), initial=0.0)
            if size > 0.0:
                found[i] = max(found[i], np.max(np.abs(one[name] - other[name])) / size)
    return found


def main() -> None:
    """Print the largest deviations by controller and by what its loop does."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--designs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    found: dict[tuple[str, str], list[float]] = defaultdict(list)
    warnings.simplefilter("ignore", ql.DesignWarning)
    for design in range(given.designs):
        dt = float(rng.choice([0.001, 0.01]))
        plant, others = plants(rng)
        scenario = ql.Scenario(
            ql.signals.Step(at=1.0),
            duration=2e4 * dt,
            disturbances=(ql.signals.Step(height=0.1, at=5.0),),
            noise=ql.signals.BandLimitedNoise(power=1e-8 * dt, sample_time=dt),
            seed=design,
        )
        for name, law in controllers(plant, rng, dt).items():
            options = {"record": "all", "record_every": 7}
            exact = ql.simulate(others, law, scenario, **options)
            lanes = ql.simulate(others, law, scenario, exact=False, **options)
            cut = int(ql.Status.SATURATED | ql.Status.RATE_LIMITED)
            for i, deviation in enumerate(deviations(exact, lanes).tolist()):
                does = "at limits" if exact.status[i] & cut else "linear"
                stable = analyse(others[i], law).stable
                does = f"{'stable' if stable else 'unstable'}, {does}"
                found[name, "diverged" if exact.diverged[i] else does].append(deviation)
    print(
        f"{'controller':12s} {'loop':22s} {'runs':>6s} {'median':>9s} {'99 %':>9s} {'largest':>9s}"
    )
    for (name, does), values in sorted(found.items()):
        row = (np.median(values), np.quantile(values, 0.99), np.max(values))
        print(f"{name:12s} {does:22s} {len(values):6d} " + " ".join(f"{v:9.1e}" for v in row))


if __name__ == "__main__":
    main()
