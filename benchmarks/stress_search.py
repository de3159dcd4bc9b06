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

import json
import math
import time

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

from quell.experiments.stress.general import FOUND, HEALTHY, error_of, is_fragile, judge, search
from quell.experiments.stress.loops import GeneralLoop, draw_loop
from quell.guard import Guard

ORDERS = (1, 2, 3, 4)


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
    parser = parser_of(__doc__)
    parser.add_argument("--write", action="store_true", help="replace the file of the trial")
    parser.add_argument("--searches", type=int, default=2, help="searches for each order")
    parser.add_argument("--generations", type=int, default=16)
    parser.add_argument("--population", type=int, default=40)
    parser.add_argument("--orders", type=int, nargs="+", choices=ORDERS, default=ORDERS)
    parser.add_argument("--loops", type=int, default=10, help="of a search")
    parser.add_argument("--unseen", type=int, default=30, help="loops that judge")
    arguments = options_of(
        parser, orders=[1], searches=1, generations=2, population=4, loops=1, unseen=1
    )
    if arguments.write and tuple(arguments.orders) != ORDERS:
        parser.error("--write needs all orders: leave out --orders and --quick")
    figures: dict[str, object] = {}
    guard, points = Guard(), {}
    table = Table("order", "search", "score by generation", "unseen loops", "CPU [s]")
    for order in arguments.orders:
        points[str(order)] = []
        unseen = healthy_loops(order, arguments.unseen, 9999)
        for seed in range(arguments.searches):
            began = time.process_time()
            found = search(
                healthy_loops(order, arguments.loops, seed),
                guard,
                np.random.default_rng([seed, order]),
                generations=arguments.generations,
                population=arguments.population,
            )
            points[str(order)].append([float(f"{x:.4g}") for x in found.point])
            score = judge(found.point[None], unseen, guard)[0]
            history = " ".join(f"{x:.2f}" for x in found.history)
            spent = time.process_time() - began
            table.add_row(str(order), str(seed), history, f"{score:.2f}", f"{spent:.0f}")
            figures[f"order {order}, search {seed}"] = {
                "scores": found.history,
                "unseen": score,
                "cpu": spent,
            }
    Console(width=140).print(table)
    write(arguments, figures)
    if arguments.write:
        FOUND.write_text(json.dumps(points, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
