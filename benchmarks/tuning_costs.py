"""What bandwidths, poles of their own and a model cost or gain against PID; and how long it takes.

    python benchmarks/tuning_costs.py

Four plants of the batch of ``tuning.py``, at ten times the M_ks of the optimal PI controller, with
M_s = 1.4 and no bound of M_t: k_i and 1/IAE over those of that PI controller. Then the time for one
plant with all structures, and for a set of 20.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table
from tuning import batch, sample_time

import quell as ql
from quell.tuning import Constraints

PLANTS = ("4: 1/(s+1)^3", "4: 1/(s+1)^4", "5: alpha = 0.2", "2: e^-s/(1+1s)^2")
NAMES = ("pid", "bandwidths", "poles", "model-based")
NOISE = 10.0


def costs(
    plant: tuple[str, list[float], list[float], float], names: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Return k_i and 1/IAE of each structure over those of the optimal PI controller."""
    _, num, den, delay = plant
    dt = sample_time(num, den, delay)
    free = Constraints(m_s=1.4, m_t=None, noise_over_pi=None, damping=None)
    how = {"delay": delay, "objective": "load"}
    pi = ql.tune((num, den), dt, structure="pi-unfiltered", constraints=free, compare=(), **how)
    unit = pi.design
    design = "poles" if "poles" in names else names[-1]
    bounds = Constraints(m_s=1.4, m_t=None, m_ks=NOISE * unit.measures["M_ks"], damping=None)
    tuned = ql.tune((num, den), dt, structure=design, constraints=bounds, compare=names, **how)
    return {
        name: {
            "k_i": tuned.designs[name].k_i / unit.k_i,
            "1/IAE": unit.measures["iae"] / tuned.designs[name].measures["iae"],
        }
        for name in names
    }


def seconds(plants: object, how: dict[str, Any]) -> dict[str, float]:
    """Return how long a tuning takes [s], in wall and CPU time."""
    wall, cpu = time.perf_counter(), time.process_time()
    ql.tune(plants, 0.02, **how)
    return {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}


def main() -> None:
    """Print the table and the times."""
    parser = parser_of(__doc__)
    parser.add_argument("--plants", nargs="+", choices=PLANTS, default=PLANTS)
    parser.add_argument("--set", type=int, default=20, help="plants of the set")
    parser.add_argument("--names", nargs="+", choices=NAMES, default=NAMES, help="structures")
    parser.add_argument("--timed", choices=NAMES, help="time this structure alone, not all")
    options = options_of(
        parser, plants=[PLANTS[0]], set=2, names=["pid", "bandwidths"], timed="bandwidths"
    )
    figures: dict[str, object] = {}
    warnings.simplefilter("ignore")
    console, table = Console(), Table(title="k_i (1/IAE) over those of the optimal PI controller")
    for heading in ("plant", *options.names):
        table.add_column(heading)
    for plant in batch():
        if plant[0] in options.plants:
            found = costs(plant, options.names)
            cells = (f"{each['k_i']:.2f} ({each['1/IAE']:.2f})" for each in found.values())
            table.add_row(plant[0], *cells)
            figures[plant[0]] = found
    console.print(table)
    drawn = np.random.default_rng(0).uniform(0.8, 1.25, (options.set, 4))
    plants = [
        ([float(k)], np.polymul([a, 1], np.polymul([b, 1], [c, 1])).tolist())
        for k, a, b, c in drawn
    ]
    how = {"structure": options.timed, "compare": ()} if options.timed else {}
    ql.tune(plants[0], 0.02, **how)
    for name, each in (("one plant, warm", plants[0]), (f"a set of {options.set}", plants)):
        took = seconds(each, how)
        console.print(f"{name}: {took['wall']:.1f} s, {took['cpu']:.1f} s of CPU")
        figures[f"{name} [s]"] = took
    write(options, figures)


if __name__ == "__main__":
    main()
