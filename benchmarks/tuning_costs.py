"""What bandwidths, poles of their own and a model cost or gain against PID; and how long it takes.

    python benchmarks/tuning_costs.py

Four plants of the batch of ``tuning.py``, at ten times the M_ks of the optimal PI controller, with
M_s = 1.4 and no bound of M_t: k_i and 1/IAE over those of that PI controller. Then the time for one
plant with all structures, and for a set of 20.
"""

from __future__ import annotations

import time
import warnings

import numpy as np
from rich.console import Console
from rich.table import Table
from tuning import batch, sample_time

import quell as ql
from quell.tuning import Constraints

PLANTS = ("4: 1/(s+1)^3", "4: 1/(s+1)^4", "5: alpha = 0.2", "2: e^-s/(1+1s)^2")
NAMES = ("pid", "bandwidths", "poles", "model-based")
NOISE = 10.0


def costs(plant: tuple[str, list[float], list[float], float]) -> list[str]:
    """Return ``k_i (1/IAE)`` of each structure over those of the optimal PI controller."""
    _, num, den, delay = plant
    dt = sample_time(num, den, delay)
    free = Constraints(m_s=1.4, m_t=None, noise_over_pi=None, damping=None)
    how = {"delay": delay, "objective": "load"}
    pi = ql.tune((num, den), dt, structure="pi-unfiltered", constraints=free, compare=(), **how)
    unit = pi.design
    bounds = Constraints(m_s=1.4, m_t=None, m_ks=NOISE * unit.measures["M_ks"], damping=None)
    tuned = ql.tune((num, den), dt, structure="poles", constraints=bounds, compare=NAMES, **how)
    found = []
    for name in NAMES:
        design = tuned.designs[name]
        iae = unit.measures["iae"] / design.measures["iae"]
        found.append(f"{design.k_i / unit.k_i:.2f} ({iae:.2f})")
    return found


def seconds(plants: object) -> str:
    """Return how long a tuning takes, in wall and CPU time."""
    wall, cpu = time.perf_counter(), time.process_time()
    ql.tune(plants, 0.02)
    return f"{time.perf_counter() - wall:.1f} s, {time.process_time() - cpu:.1f} s of CPU"


def main() -> None:
    """Print the table and the times."""
    warnings.simplefilter("ignore")
    console, table = Console(), Table(title="k_i (1/IAE) over those of the optimal PI controller")
    for heading in ("plant", *NAMES):
        table.add_column(heading)
    for plant in batch():
        if plant[0] in PLANTS:
            table.add_row(plant[0], *costs(plant))
    console.print(table)
    drawn = np.random.default_rng(0).uniform(0.8, 1.25, (20, 4))
    plants = [
        ([float(k)], np.polymul([a, 1], np.polymul([b, 1], [c, 1])).tolist())
        for k, a, b, c in drawn
    ]
    ql.tune(plants[0], 0.02)
    console.print(f"one plant, warm: {seconds(plants[0])}; a set of 20: {seconds(plants)}")


if __name__ == "__main__":
    main()
