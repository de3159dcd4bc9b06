"""Deviation of batches over lanes from the exact loop, in random linear loops.

    python benchmarks/lanes.py [--designs 60] [--seed 1]

Each design is an ADRC (model-free, model-based or a cascade), a PID controller or an LQG controller
for a random plant of order 1 to 6, with noise, a step and a load, for 20 or 200 s; some with tight
limits of u and its rate. It runs on 32 plants that differ from its own by up to 20 %, some of them
so much that the loop is unstable. Of each run the largest deviation of any channel counts, relative
to the channel's range in that run. Beside it stands the deviation of exact runs of plants whose A
is changed by 2⁻⁵² of itself, its last digit: no less can be expected of rounded numbers.
"""

from __future__ import annotations

import argparse
import warnings
from collections import defaultdict

import numpy as np

import quell as ql
from quell.analysis.linearise import linear_law
from quell.analysis.subsystems import closed_loop_matrix

RUNS = 32


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


def stable(plants: list[ql.plants.LinearPlant], law: object, dt: float) -> list[bool]:
    """Return whether the loops are stable without limits."""
    found, stable = linear_law(law), []
    inner = found.A + np.outer(found.B_u, found.C)
    for plant in plants:
        phi, gamma, _, C = plant.sampled(dt)
        poles = np.linalg.eigvals(closed_loop_matrix(phi, gamma, C, found, inner))
        stable.append(bool(np.all(np.abs(poles) < 1.0)))
    return stable


def main() -> None:
    """Print the largest deviations by controller and by what its loop does."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--designs", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    found: dict[tuple[str, str], list[np.ndarray]] = defaultdict(list)
    warnings.simplefilter("ignore", ql.DesignWarning)
    for design in range(given.designs):
        dt = float(rng.choice([0.001, 0.01]))
        plant, others = plants(rng)
        changed = [
            ql.plants.LinearPlant(each.A * (1.0 + 2.0**-52), each.B, each.C) for each in others
        ]
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
            shifted = ql.simulate(changed, law, scenario, **options)
            pairs = np.column_stack([deviations(exact, lanes), deviations(exact, shifted)])
            cut = exact.status & int(ql.Status.SATURATED | ql.Status.RATE_LIMITED)
            for i, settles in enumerate(stable(others, law, dt)):
                does = ("stable" if settles else "unstable") + (", at limits" if cut[i] else "")
                found[name, "diverged" if exact.diverged[i] else does].append(pairs[i])
    print(f"{'':36s} over lanes                    A changed by 2^-52")
    columns = "    median      99 %   largest"
    print(f"{'controller':10s} {'loop':20s} {'runs':>5s}{columns}{columns}")
    for (name, does), values in sorted(found.items()):
        shares = np.quantile(values, [0.5, 0.99, 1.0], axis=0).T.ravel()
        print(f"{name:10s} {does:20s} {len(values):5d}" + "".join(f"{v:10.1e}" for v in shares))


if __name__ == "__main__":
    main()
