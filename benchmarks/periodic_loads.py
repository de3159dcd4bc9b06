"""Loads that are periodic but not sinusoidal: square, triangle and sawtooth waves.

    python benchmarks/periodic_loads.py [--loops 32] [--seed 1]

The plant is ``y'' = u − y'/2 + w``; the loop has dt = 5 ms, a model-free ESO of 20 rad/s with b0
wrong by a factor in [0.7, 1.4], omega_c = 4 rad/s, and noise of 1e-12 held for 10 ms. The load of
±3 has a random period of 4 to 16 s and acts from 20 s on. The figures are RMS errors from 70 s to
100 s over those of MF-ESO, medians and largest values, without and with guard. Seed 0 was for
tuning.
"""

from __future__ import annotations

import math

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.kernels import dispatch
from quell.learners import Harmonic, Kalman, Learner, Repetitive
from quell.signals import BandLimitedNoise, Constant, Ramp, Repeated, Signal

DT, SHAPES = 5e-3, ("square", "triangle", "sawtooth")
PLANT = ql.plants.NonlinearPlant(
    lambda t, x, u, w: (x[1], u - 0.5 * x[1] + w[0]), order=2, substeps=4
)
ODD, ALL = tuple(range(1, 31, 2)), tuple(range(1, 17))


def wave(shape: str, period: float, start: float) -> Signal:
    """Return a wave of ±3 that begins at ``start``."""
    rising = Ramp(6.0 / period) - 3.0
    cycles = {
        "square": Constant(3.0).until(0.5 * period, then=-3.0),
        "triangle": Ramp(12.0 / period) - Ramp(24.0 / period, start=0.5 * period) - 3.0,
        "sawtooth": rising,
    }
    repeated = Repeated(cycles[shape], period, start=start)
    return Constant(0.0).until(start, then=repeated)


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


def late_error(
    load: Signal, b0: float, seed: int, learner: Learner | None, guard: bool, end: float
) -> float:
    """Return the RMS error of the last 30 % of a run; infinity after divergence."""
    controller = ql.ADRC(
        ql.ESO.model_free(order=2, b0=b0, omega_o=20.0, dt=DT),
        omega_c=4.0,
        learner=learner,
        guard=ql.Guard() if guard else None,
    )
    noise = BandLimitedNoise(1e-12, 0.01)
    scenario = ql.Scenario(0.0, end, (load,), noise=noise, seed=seed)
    run = ql.simulate(PLANT, controller, scenario, record_every=2)
    late = run["y"][run.window(0.7 * end, end)]
    return math.inf if run.diverged else float(np.sqrt(np.mean(late**2)))


def main() -> None:
    """Print a table."""
    parser = parser_of(__doc__)
    parser.add_argument("--loops", type=int, default=32)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--end", type=float, default=100.0, help="of a run [s]")
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=SHAPES)
    parser.add_argument("--learners", nargs="+", choices=learners(1.0), default=[*learners(1.0)])
    few = ["Kalman()", "Repetitive(period)"]
    options = options_of(parser, loops=1, end=6.0, shapes=["square"], learners=few)
    dispatch.interpret_all |= options.quick  # the plant is a user's: compiled in each process
    figures: dict[str, dict[str, float]] = {}
    table = Table("load", "learner", "median", "largest", "guarded: median", "largest")
    for shape in options.shapes:
        rng = np.random.default_rng(options.seed)
        found: dict[str, list[tuple[float, float]]] = {}
        for i in range(options.loops):
            period = round(math.exp(rng.uniform(math.log(4.0), math.log(16.0))) / 0.1) * 0.1
            load, b0 = wave(shape, period, 0.2 * options.end), float(rng.uniform(0.7, 1.4))
            plain = late_error(load, b0, i, None, False, options.end)
            for name in options.learners:
                learner = learners(period)[name]
                pair = [
                    late_error(load, b0, i, learner, guard, options.end) / plain
                    for guard in (False, True)
                ]
                found.setdefault(name, []).append((pair[0], pair[1]))
        for name, pairs in found.items():
            free, guarded = np.array(pairs).T
            row = (np.median(free), np.max(free), np.median(guarded), np.max(guarded))
            table.add_row(shape, name, *(f"{each:.3f}" for each in row))
            names = ("median", "largest", "guarded: median", "guarded: largest")
            figures[f"{shape}, {name}"] = dict(zip(names, map(float, row), strict=True))
    Console(width=110).print(table)
    write(options, figures)


if __name__ == "__main__":
    main()
