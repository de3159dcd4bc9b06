"""The ACC benchmark on a box of plants: tune by simulation, judge on fresh plants.

python benchmarks/acc_box.py                      # judges the designs on 4000 fresh plants
python benchmarks/acc_box.py --tune 900          # repeats the search, then judges its result
python benchmarks/acc_box.py --tune 900 --storage box.log   # continues if it is interrupted
"""

from __future__ import annotations

import time
from typing import Any

from measured import options_of, parser_of, write

from quell.experiments.acc import DT, SPRINGS, designs, interval, judge_sampled, study
from quell.experiments.acc.loops import FREE_POLES, OURS, boxed
from quell.tuning.structures.base import vector

# Seeds of the plants for the search, and of the fresh ones, which nothing else uses.
SEARCHED, FRESH = 301, 1_000_000


def main() -> None:
    """Judge, after a search if there is to be one."""
    parser = parser_of(__doc__)
    parser.add_argument("--tune", type=int, metavar="TRIALS", help="candidates of a search")
    parser.add_argument("--plants", type=int, default=400, help="plants of the search")
    parser.add_argument("--storage", help="Optuna's journal file")
    parser.add_argument("--executor", default="threads", help="threads, processes, tcp://…")
    parser.add_argument("--count", type=int, default=4000, help="fresh plants")
    options = options_of(parser, count=20)
    figures: dict[str, Any] = {"plants": options.count}
    chosen = {
        name: controller for name, controller in designs(DT).items() if name in (*OURS, FREE_POLES)
    }
    if options.tune:
        began = time.perf_counter()
        samples = boxed(options.plants, SEARCHED)
        where = {"storage": options.storage, "executor": options.executor}
        found, controller = study.tune(samples, trials=options.tune, **where)
        best, made = found.best, study.build()
        print(
            f"{len(found.candidates)} candidates in {time.perf_counter() - began:.0f} s;", end=" "
        )
        print(f"number {best.number} is the best one, {best.values}")
        print(made.structure.tables(vector(made.structure, best.parameters)))
        chosen = {"as found": controller}
        figures["search"] = {"candidates": len(found.candidates), **best.values}
    samples = boxed(options.count, FRESH)
    print(
        f"{options.count} fresh plants of the box, failures [%] (95 % interval); noise gain [N/m]"
    )
    for name, controller in chosen.items():
        row, figures[name] = f"{name:24}", {}
        for spring, cubic in SPRINGS.items():
            judged = judge_sampled(controller, samples, cubic)
            failures = int(judged.fails.sum())
            low, high = interval(failures, options.count)
            rate = 100.0 * failures / options.count
            figures[name][f"{spring} spring [%]"] = {
                "failures": rate, "low": 100.0 * low, "high": 100.0 * high,
            }  # fmt: skip
            row += f"  {spring} {rate:5.1f} ({100.0 * low:.1f}–{100.0 * high:.1f})"
        figures[name]["noise gain [N/m]"] = study.noise_gain(controller)
        print(f"{row}  {figures[name]['noise gain [N/m]']:9.0f}", flush=True)
    write(options, figures)


if __name__ == "__main__":
    main()
