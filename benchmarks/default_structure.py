"""The default of ``quell.tune`` on the test batch of Astrom and Hagglund, without an option.

    python benchmarks/default_structure.py                 all 133 plants: about an hour
    python benchmarks/default_structure.py --every 11      each eleventh plant

Each plant is tuned with its dead time as the only option. A row has the structure that was chosen,
its integral of ``|y|`` after a step of the load, from a simulation, over that of the best of all
structures that were tried, and overshoot and settling of a step of the reference.
"""

from __future__ import annotations

import time
import warnings
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from tuning import batch, sample_time

import quell as ql

# A chosen structure is at most so much worse than the best one.
BAR = 1.05


def simulated_iae(
    num: list[float], den: list[float], delay: float, tuned: ql.Tuned, of: Any
) -> float:
    """Return the integral of ``|y|`` after a unit step of the load, as long as the tuner's."""
    dt = tuned.plants.dt
    plant: Any = ql.plants.LinearPlant.of((num, den))
    if delay > 0.0:
        plant = ql.plants.delayed(plant, delay, dt)
    load = ql.signals.Step()
    scenario = ql.Scenario(disturbances=(load,), duration=tuned.task.inputs.d.size * dt)
    return dt * float(np.sum(np.abs(ql.simulate(plant, of, scenario)["y"])))


def trial(plant: tuple[str, list[float], list[float], float]) -> dict[str, Any]:
    """Return what the default chose for a plant, and how good it is."""
    name, num, den, delay = plant
    dt, began = sample_time(num, den, delay), time.process_time()
    tuned = ql.tune((num, den), dt, delay=delay)
    cpu = time.process_time() - began
    made = {key: each for key, each in tuned.designs.items() if each.controller is not None}
    iae = {
        key: simulated_iae(num, den, delay, tuned, each.controller) for key, each in made.items()
    }
    chosen = next(key for key, each in made.items() if each is tuned.design)
    step = tuned.reference_step
    return {
        "plant": name,
        "chosen": chosen,
        "best": min(iae, key=lambda key: iae[key]),
        "ratio": iae[chosen] / min(iae.values()),
        "overshoot": step.overshoot,
        "settling": step.settling / dt,
        "cpu": cpu,
    }


def main() -> None:
    """Print a row for each plant, and the worst."""
    parser = parser_of(__doc__)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    given = options_of(parser, first=100, every=1000)
    warnings.simplefilter("ignore")
    rows = []
    for plant in batch()[given.first :: given.every]:
        row = trial(plant)
        rows.append(row)
        print(
            f"{row['plant']:26} {row['chosen']:12} IAE {row['ratio']:.3f} of the best "
            f"({row['best']}), overshoot {100.0 * row['overshoot']:.0f} %, settling "
            f"{row['settling']:.0f} samples, {row['cpu']:.1f} s",
            flush=True,
        )
    ratios = np.array([row["ratio"] for row in rows])
    cpu = np.median([row["cpu"] for row in rows])
    print(
        f"{ratios.size} plants: IAE over the best at most {np.max(ratios):.3f} (bar {BAR}), median "
        f"{np.median(ratios):.3f}; CPU {cpu:.1f} s in the median"
    )
    figures = {
        "plants": ratios.size,
        "IAE over the best": {"median": np.median(ratios), "largest": np.max(ratios)},
        "above the bar": np.count_nonzero(ratios > BAR),
        "CPU [s]": {"median": cpu},
    }
    write(given, figures | {"rows": rows})


if __name__ == "__main__":
    main()
