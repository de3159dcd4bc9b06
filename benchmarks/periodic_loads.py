"""Loads that are periodic but not sinusoidal: square, triangle and sawtooth waves.

    python benchmarks/periodic_loads.py [--loops 32] [--seed 1]

The plant is ``y'' = u − y'/2 + w``; the loop has dt = 5 ms, a model-free ESO of 20 rad/s with b0
wrong by a factor in [0.7, 1.4], omega_c = 4 rad/s, and noise of 1e-12 held for 10 ms. The load of
±3 has a random period of 4 to 16 s and acts from 20 s on. The figures are RMS errors from 70 s to
100 s over those of MF-ESO, medians and largest values, without and with guard. Seed 0 was for
tuning.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.learners import Harmonic, Kalman, Learner, Repetitive
from quell.signals import BandLimitedNoise, Constant, Ramp, Repeated, Signal

DT, START, SINCE, END = 5e-3, 20.0, 70.0, 100.0
PLANT = ql.plants.NonlinearPlant(
    lambda t, x, u, w: (x[1], u - 0.5 * x[1] + w[0]), order=2, substeps=4
)
ODD, ALL = tuple(range(1, 31, 2)), tuple(range(1, 17))


def wave(shape: str, period: float) -> Signal:
    """Return a wave of ±3 that begins at ``START``."""
    rising = Ramp(6.0 / period) - 3.0
    cycles = {
        "square": Constant(3.0).until(0.5 * period, then=-3.0),
        "triangle": Ramp(12.0 / period) - Ramp(24.0 / period, start=0.5 * period) - 3.0,
        "sawtooth": rising,
    }
    repeated = Repeated(cycles[shape], period, start=START)
    return Constant(0.0).until(START, then=repeated)


def learners(period: float) -> dict[str, Learner]:
    """Return the learners; the last one is told the period."""
    limits = (0.2, 2.0)
    return {
        "Kalman()": Kalman(),
        "Harmonic()": Harmonic(),
        "Harmonic(orders=1, 3 … 29, search)": Harmonic(orders=ODD, search=True, limits=limits),
        "Harmonic(orders=1, 2 … 16, search)": Harmonic(orders=ALL, search=True, limits=limits),
        "Repetitive(period)": Repetitive(period),
    }


def late_error(load: Signal, b0: float, seed: int, learner: Learner | None, guard: bool) -> float:
    """Return the RMS error of the last 30 s; infinity after divergence."""
    controller = ql.ADRC(
        ql.ESO.model_free(order=2, b0=b0, omega_o=20.0, dt=DT),
        omega_c=4.0,
        learner=learner,
        guard=ql.Guard() if guard else None,
    )
    noise = BandLimitedNoise(1e-12, 0.01)
    scenario = ql.Scenario(0.0, END, (load,), noise=noise, seed=seed)
    run = ql.simulate(PLANT, controller, scenario, record_every=2)
    late = run["y"][run.window(SINCE, END)]
    return math.inf if run.diverged else float(np.sqrt(np.mean(late**2)))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--loops", type=int, default=32)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    table = Table("load", "learner", "median", "largest", "guarded: median", "largest")
    for shape in ("square", "triangle", "sawtooth"):
        rng = np.random.default_rng(options.seed)
        found: dict[str, list[tuple[float, float]]] = {}
        for i in range(options.loops):
            period = round(math.exp(rng.uniform(math.log(4.0), math.log(16.0))) / 0.1) * 0.1
            load, b0 = wave(shape, period), float(rng.uniform(0.7, 1.4))
            plain = late_error(load, b0, i, None, False)
            for name, learner in learners(period).items():
                pair = [late_error(load, b0, i, learner, guard) / plain for guard in (False, True)]
                found.setdefault(name, []).append((pair[0], pair[1]))
        for name, pairs in found.items():
            free, guarded = np.array(pairs).T
            figures = (np.median(free), np.max(free), np.median(guarded), np.max(guarded))
            table.add_row(shape, name, *(f"{figure:.3f}" for figure in figures))
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
