"""Two sinusoidal loads whose frequencies are close to each other, in random loops.

python benchmarks/close_frequencies.py [--loops 50] [--seed 1]

The plants and designs are those of ``quell.experiments.stress.random_loops``. From 90 s on two
sinusoids act on m2: the slower one of 0.15 to 0.8 rad/s, the other faster by the factor in the
table, with amplitudes of 0.2 to 2 N and random phases. The figures are the largest errors over 40
s, from one minute or one beat period after the start of the load on, whichever is later, over those
of MF-ESO. Seed 0 was for tuning.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.experiments.stress.random_loops import LOAD_AT, Loop, draw_loops
from quell.learners import Harmonic, Learner
from quell.signals import Sinusoid
from quell.types import Vector

FACTORS = (1.2, 1.3, 1.5, 2.0)
LEARNERS = {"Harmonic(2)": Harmonic(count=2), "with search": Harmonic(count=2, search=True)}
JUDGED, BAR = 40.0, 0.02


def late_peak(
    loop: Loop, load: tuple[Sinusoid, Sinusoid], learner: Learner | None, guard: bool
) -> float:
    """Return the largest error after a minute or beat period of load; infinity if lost."""
    start = LOAD_AT + max(60.0, 2.0 * math.pi / abs(load[1].omega - load[0].omega))
    scenario = replace(
        loop.scenario,
        disturbances=(0.0, load[0] + load[1]),
        duration=math.ceil((start + JUDGED) / 0.01) * 0.01,
    )
    controller = loop.controller(learner, ql.Guard() if guard else None)
    run = ql.simulate(loop.plant, controller, scenario, record_every=5)
    late = run.window(start, start + JUDGED)
    return math.inf if run.diverged else float(np.max(np.abs(run["y"][late] - 1.0)))


def ratios(factor: float, loops: int, seed: int) -> dict[tuple[str, bool], Vector]:
    """Return the ratios to MF-ESO for each learner without and with guard."""
    rng = np.random.default_rng([seed, round(100 * factor)])
    found: dict[tuple[str, bool], list[float]] = {
        (name, guard): [] for name in LEARNERS for guard in (False, True)
    }
    for loop in draw_loops(loops, rng):
        slow = math.exp(rng.uniform(math.log(0.15), math.log(0.8)))
        amplitudes = np.exp(rng.uniform(math.log(0.2), math.log(2.0), 2))
        phases = rng.uniform(0.0, 2.0 * math.pi, 2)
        load = (
            Sinusoid(amplitudes[0], slow, phases[0], LOAD_AT),
            Sinusoid(amplitudes[1], slow * factor, phases[1], LOAD_AT),
        )
        plain = late_peak(loop, load, None, False)
        for (name, guard), values in found.items():
            values.append(late_peak(loop, load, LEARNERS[name], guard) / plain)
    return {key: np.array(values) for key, values in found.items()}


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--loops", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    table = Table(
        *("factor", "learner", "guard", "median", "90 %", "largest", f"at most {BAR:g}"),
        title=f"peak over MF-ESO's, {options.loops} loops a row, seed {options.seed}",
    )
    for factor in FACTORS:
        for (name, guard), values in ratios(factor, options.loops, options.seed).items():
            quantiles = np.quantile(values, (0.5, 0.9, 1.0), method="higher")
            table.add_row(
                *(f"{factor:g}", name, "yes" if guard else "no"),
                *(f"{value:.4f}" for value in quantiles),
                f"{np.mean(values <= BAR):.0%}",
            )
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
