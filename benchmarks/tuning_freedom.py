"""Fewer constraints never give a worse objective: constraints removed one by one.

    python benchmarks/tuning_freedom.py [--tunings N] [--seed S] [--verbose]

Each tuning draws a plant of the test batch of ``benchmarks/tuning.py``, a structure, an objective
and bounds: M_s and M_t of 1.3 to 2, M_ks of 2 to 100 times that of the optimal PI controller, and a
delay margin of a tenth to one radian of the plant's phase crossover. Then each bound but M_s is
removed. A removal is *worse* if the objective is by more than 0.1 %, the tolerance of the bounds.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from tuning import batch, sample_time

import quell as ql
from quell.tuning import Constraints

STRUCTURES = ("pid", "bandwidths", "poles", "model-based", "model-based-poles")
TOLERANCE = 1e-3


def drawn(
    rng: np.random.Generator, structures: Sequence[str]
) -> tuple[str, Any, float, dict[str, Any], dict[str, float]]:
    """Return a name, a plant, dt, options of ``tune``, and bounds."""
    plants = batch()
    name, num, den, delay = plants[int(rng.integers(len(plants)))]
    dt = sample_time(num, den, delay)
    options = {
        "structure": str(rng.choice(structures)),
        "objective": str(rng.choice(["load", "load-iae"])),
        "delay": delay,
        "compare": (),
    }
    free = Constraints(noise_over_pi=None)
    first = {"structure": "pi-unfiltered", "objective": "load", "constraints": free}
    pi = ql.tune((num, den), dt, **options | first).design
    bounds = {
        "m_s": float(rng.uniform(1.3, 2.0)),
        "m_t": float(rng.uniform(1.3, 2.0)),
        "m_ks": float(np.exp(rng.uniform(np.log(2.0), np.log(100.0)))) * pi.measures["M_ks"],
        "delay_margin": float(rng.uniform(0.1, 1.0)) * dt / 0.02,
    }
    return name, (num, den), dt, options, bounds


def cost(plant: Any, dt: float, options: dict[str, Any], bounds: dict[str, Any]) -> float:
    """Return the objective as what is to be small; infinite without a controller."""
    constraints = Constraints(**{"m_s": None, "m_t": None} | bounds, noise_over_pi=None)
    try:
        found = ql.tune(plant, dt, constraints=constraints, **options).design
    except ValueError:
        return np.inf
    return 1.0 / found.k_i if options["objective"] == "load" else found.objective


def main() -> None:
    """Print how many removals make the objective worse."""
    parser = parser_of(__doc__)
    parser.add_argument("--tunings", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--structures", nargs="+", choices=STRUCTURES, default=STRUCTURES)
    args = options_of(parser, tunings=1, structures=["pid"])
    removals, worse, began = 0, [], time.process_time()
    for i in range(args.tunings):
        rng = np.random.default_rng([args.seed, i])
        name, plant, dt, options, bounds = drawn(rng, args.structures)
        with_all = cost(plant, dt, options, bounds)
        for key in ("m_t", "m_ks", "delay_margin"):
            fewer = cost(plant, dt, options, {k: v for k, v in bounds.items() if k != key})
            removals += 1
            if fewer > (1.0 + TOLERANCE) * with_all:
                text = f"{name}, {options['structure']}, {options['objective']}, without {key}"
                worse.append(f"{i}: {text}: {fewer / with_all:.4f}")
                if args.verbose:
                    print(worse[-1], flush=True)
    print(f"{args.tunings} tunings, {removals} removals, {len(worse)} worse")
    print("\n".join(worse))
    each = (time.process_time() - began) / args.tunings
    print(f"{each:.1f} s of processor time a tuning")
    figures = {"tunings": args.tunings, "removals": removals, "worse": len(worse), "cpu": each}
    write(args, figures)


if __name__ == "__main__":
    main()
