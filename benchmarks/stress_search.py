"""Search for the learners that harm guarded loops most, for the trial's kind "searched".

    python benchmarks/stress_search.py [--write] [--searches 2] [--generations 16]

For each order a few searches by the cross-entropy method (``stress.general.cross_entropy``)
over learners that see everything, each in its own random loops of that order, drawn from seeds for
tuning. A score of 1 is that of the trial's bars for the largest of all runs: RMS error 1.2 or worst
window 2.5 times MF-ESO's; half of it is the mean over the loops, half the worst of them.
The last column is the score in loops that the search has not seen. ``--write`` replaces the file
that the trial reads; do that for each new guard, and then judge with seeds that were not used.
"""

from __future__ import annotations

import argparse
import json
import math
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from quell.experiments.stress.general import FOUND, HEALTHY, error_of, is_fragile, judge, search
from quell.experiments.stress.loops import GeneralLoop, draw_loop
from quell.guard import Guard

ORDERS = (1, 2, 3, 4)
LOOPS, UNSEEN = 10, 30


def healthy_loops(order: int, count: int, *seed: int) -> list[GeneralLoop]:
    """Return random loops of an order for which the trial's bars hold."""
    rng, found = np.random.default_rng([*seed, order]), []
    while len(found) < count:
        loop = draw_loop(rng, order=order)
        if loop.margin < HEALTHY:
            continue
        plain = error_of(loop, None, None)
        if math.isfinite(plain.rms) and not is_fragile([loop], plain):
            found.append(loop)
    return found


def main() -> None:
    """Search for all orders, print what was found, and write it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true", help="replace the file of the trial")
    parser.add_argument("--searches", type=int, default=2, help="searches for each order")
    parser.add_argument("--generations", type=int, default=16)
    parser.add_argument("--population", type=int, default=40)
    arguments = parser.parse_args()
    guard, points = Guard(), {}
    table = Table("order", "search", "score by generation", "unseen loops", "CPU [s]")
    for order in ORDERS:
        points[str(order)] = []
        unseen = healthy_loops(order, UNSEEN, 9999)
        for seed in range(arguments.searches):
            began = time.process_time()
            found = search(
                healthy_loops(order, LOOPS, seed),
                guard,
                np.random.default_rng([seed, order]),
                generations=arguments.generations,
                population=arguments.population,
            )
            points[str(order)].append([float(f"{x:.4g}") for x in found.point])
            score = judge(found.point[None], unseen, guard)[0]
            history = " ".join(f"{x:.2f}" for x in found.history)
            spent = f"{time.process_time() - began:.0f}"
            table.add_row(str(order), str(seed), history, f"{score:.2f}", spent)
    Console(width=140).print(table)
    if arguments.write:
        FOUND.write_text(json.dumps(points, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
