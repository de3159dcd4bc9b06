"""``quell rank`` on logs of simulated loops whose truth is known.

    python benchmarks/ranking.py               # some six minutes
    python benchmarks/ranking.py --draws 20    # a look

Each log is a simulated loop: an oven at 1 Hz (600 s, 0.8 K/W) under a drifting load, or a servo of
2e-4 kg m² at 1 kHz with moves that repeat, or a servo with moves that do not. *Alike* are two logs
of one tuning with other draws of load and noise: in 95 % of the draws at least they must not be
decided. *Better* are bandwidths that are higher: by so much that the RMS error over a long log is
lower by the share that is shown. *Another load* are logs of one tuning under twice the load.
"""

from __future__ import annotations

import time
import warnings
from typing import Any, NamedTuple

import numpy as np
from measured import options_of, parser_of, write

import quell as ql
from quell.identification import Measured
from quell.monitoring import rank


class Case(NamedTuple):
    """A machine and two tunings of it."""

    plant: Any
    order: int
    b0: float
    omega_c: float  # of A
    omega_c_better: float  # of B
    dt: float
    duration: float  # of a log [s]
    load: tuple[float, float]  # size, and time between its draws [s]
    noise: float
    moves: float  # time of a move [s]; 0 for a constant reference
    repeat: bool


J = 2e-4
OVEN = ([0.8 / 600.0], [1.0, 1.0 / 600.0])
SERVO = ([1.0 / J], [1.0, 0.5, 0.0])
CASES = {
    "oven": Case(OVEN, 1, 0.8 / 600.0, 0.01, 0.012, 1.0, 40_000.0, (2.0, 400.0), 0.02, 0.0, False),
    "servo, moves that repeat": Case(
        SERVO, 2, 1.0 / J, 30.0, 33.0, 1e-3, 40.0, (2e-3, 0.02), 2e-5, 0.5, True
    ),
    "servo, other moves": Case(
        SERVO, 2, 1.0 / J, 30.0, 40.0, 1e-3, 120.0, (2e-3, 0.02), 2e-5, 0.5, False
    ),
}


def reference(case: Case, t: Any, rng: np.random.Generator) -> Any:
    """Return moves with the least jerk between drawn places; the same two if they repeat."""
    r = np.zeros(t.size)
    if case.moves == 0.0:
        return r + 200.0
    position = 0.0
    for i, begin in enumerate(np.arange(0.0, t[-1], 2.0 * case.moves)):
        k = round(begin / case.dt)
        goal = float(1 - i % 2) if case.repeat else rng.uniform(-1.0, 1.0)
        end = k + round(2.0 * case.moves / case.dt) + 1
        s = np.clip((t[k:end] - t[k]) / case.moves, 0.0, 1.0)
        r[k:end] = position + (goal - position) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        position = goal
    return r


def log(case: Case, omega_c: float, seed: int, load: float = 1.0, length: float = 1.0) -> Measured:
    """Return a simulated log."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(length * case.duration / case.dt) + 1) * case.dt
    size, every = case.load
    times = np.arange(0.0, t[-1] + 2.0 * every, every)
    drawn = np.interp(t, times, load * size * rng.normal(size=times.size))
    r = reference(case, t, rng)
    observer = ql.ESO.model_free(order=case.order, b0=case.b0, omega_o=6.0 * omega_c, dt=case.dt)
    controller = ql.ADRC(observer, omega_c=omega_c)
    plant = ql.plants.LinearPlant.of(case.plant)
    if case.moves == 0.0:
        start = np.array([200.0]) / plant.C[0]
        rest = 200.0 / 0.8
    scenario = ql.Scenario(
        ql.signals.Samples(t, r - r[0]),
        float(t[-1]),
        (ql.signals.Samples(t, drawn),),
        noise=ql.signals.BandLimitedNoise(case.noise**2 * case.dt, case.dt),
        seed=int(rng.integers(2**31)),
    )
    run = ql.simulate(plant, controller, scenario)  # around the operating point
    skip = len(run) // 50
    offset = (rest, start[0] * plant.C[0, 0]) if case.moves == 0.0 else (0.0, 0.0)
    return Measured(
        run["u"][skip:] + offset[0],
        run["y_measured"][skip:] + offset[1],
        case.dt,
        run["r"][skip:] + offset[1],
    )


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    given = options_of(parser, draws=2, only="oven")
    warnings.simplefilter("ignore")
    began, n = time.perf_counter(), given.draws
    heads = ("A best", "B best", "NOT decided", "NOT comparable")
    print(f"{'share of the draws [%]':44}" + "".join(f"{head:>15}" for head in heads))
    figures: dict[str, Any] = {"draws": n}
    for number, (name, case) in enumerate(CASES.items()):
        if given.only not in name:
            continue
        seeds = given.seed + 100_000 * number + 10 * np.arange(n)
        truth = [
            np.std(part.reference - part.y)
            for part in (log(case, w, given.seed + 7, length=8.0) for w in case[3:5])
        ]
        lower = 100.0 * (1.0 - truth[1] / truth[0])
        kinds = {
            "alike": (case.omega_c, 1.0),
            f"better by {lower:.0f} %": (case.omega_c_better, 1.0),
            "another load": (case.omega_c, 2.0),
        }
        for kind, (omega_c, load) in kinds.items():
            found = {"A": 0, "B": 0, "not": 0, "other": 0}
            for seed in map(int, seeds):
                logs = {"A": log(case, case.omega_c, seed), "B": log(case, omega_c, seed + 1, load)}
                (pair,) = rank(logs).comparisons
                if pair.reasons:
                    found["other"] += 1
                else:
                    found[pair.better if pair.decided else "not"] += 1
            shares = [100.0 * value / n for value in found.values()]
            row = "".join(f"{share:15.1f}" for share in shares)
            print(f"{name + ': ' + kind:44}{row}", flush=True)
            figures[f"{name}: {kind}"] = dict(zip(heads, shares, strict=True))
    write(given, figures)
    print(f"{n} draws, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
