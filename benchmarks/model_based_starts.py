"""The optima of ``model-based`` on stiff plants, compared with searches from a dense grid.

    python benchmarks/model_based_starts.py [--first SEED] [--plants N]

Each plant has two to four poles, which are up to a factor of 3000 apart: real ones, some of them
with an integrator, a pair or a zero. The reference has 28 × 28 shapes, each with the best of 80
gains; the search goes on from the 25 best that keep to the bounds, and the 25 best of all. M_s is
1.4, 1.6 or 2, M_ks ten times that of the optimal PI controller. It takes 10 s a plant.
"""

from __future__ import annotations

import sys
import time
import warnings
from typing import Any

import numpy as np
from measured import options_of, parser_of, write

import quell as ql
from quell.tuning import Constraints, designs
from quell.tuning.optimiser.search import limits, search, starts

STARTS, ROUNDS = 50, 8


def drawn_plant(seed: int) -> tuple[list[float], list[float], float]:
    """Return numerator and denominator, and M_s."""
    rng = np.random.default_rng(seed)
    order, spread = int(rng.integers(2, 5)), float(10.0 ** rng.uniform(1.0, 3.5))
    times = np.exp(rng.uniform(0.0, np.log(spread), order))
    times[:2] = 1.0, spread
    kind = str(rng.choice(["real", "integrator", "pair"], p=[0.5, 0.25, 0.25]))
    den, real = np.array([1.0]), list(times)
    if kind == "integrator":
        den, real = np.array([1.0, 0.0]), real[:-1] if order > 2 else real
    elif kind == "pair":
        omega = 1.0 / np.exp(rng.uniform(0.0, np.log(spread)))
        den = np.array([omega**-2.0, 2.0 * rng.uniform(0.1, 0.9) / omega, 1.0])
        real = real[: max(order - 2, 1)]
    for each in real:
        den = np.polymul(den, [each, 1.0])
    num = [1.0]
    if rng.random() < 0.2 and den.size > 3:
        num = [float(np.exp(rng.uniform(0.0, np.log(spread)))), 1.0]
    return num, den.tolist(), float(rng.choice([1.4, 1.6, 2.0]))


def sample_time(num: list[float], den: list[float]) -> float:
    """Return a fiftieth of a radian at the phase crossover, or of the fastest pole."""
    omega = np.geomspace(1e-6, 1e6, 20_000)
    phase = np.unwrap(np.angle(np.polyval(num, 1j * omega) / np.polyval(den, 1j * omega)))
    phase -= 2.0 * np.pi * round((phase[0] + np.pi / 4.0) / (2.0 * np.pi))
    late = np.flatnonzero(phase <= -np.pi + 1e-9)
    fast = omega[late[0]] if late.size else np.max(np.abs(np.roots(den)))
    return 0.02 / float(fast)


def reference(problem: Any, structure: Any, count: int) -> float:
    """Return the largest k_i of the searches from a grid."""
    low, high = limits(structure)
    axes = [np.geomspace(low[i], high[i], count) for i in (1, 2)]
    b0 = structure.shapes()[0, 0]
    shapes = np.array([[b0, *pair] for pair in np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)])
    best = 0.0
    for row in starts(problem, structure, shapes, STARTS):
        found = search(problem, structure, row, ROUNDS, roughly=True)
        if found is not None and found.feasible:
            best = max(best, float(np.exp(-found.cost)))
    return best


def main() -> None:
    """Tune for the plants, and print those whose optimum was missed."""
    parser = parser_of(__doc__)
    parser.add_argument("--first", type=int, default=0, help="seed of the first plant")
    parser.add_argument("--plants", type=int, default=40)
    parser.add_argument("--shapes", type=int, default=28, help="of the reference, on each axis")
    arguments = options_of(parser, plants=1, shapes=6)
    warnings.simplefilter("ignore")
    given: list[Any] = []
    original = designs._best

    def noted(task: Any, structure: Any, known: Any) -> Any:
        given.append((task.problem(), structure))
        return original(task, structure, known)

    designs._best = noted
    shares, seconds = [], 0.0
    for seed in range(arguments.first, arguments.first + arguments.plants):
        num, den, m_s = drawn_plant(seed)
        given.clear()
        bounds, began = Constraints(m_s=m_s, m_t=None, damping=None), time.process_time()
        options: dict[str, Any] = {"structure": "model-based", "constraints": bounds, "compare": ()}
        options["objective"] = "load"
        try:
            k_i = ql.tune((num, den), sample_time(num, den), **options).design.k_i
        except ValueError:
            k_i = 0.0
        seconds += time.process_time() - began
        best = max(reference(*given[-1], arguments.shapes), k_i)
        if best == 0.0:
            continue  # neither has found any
        shares.append(k_i / best)
        if shares[-1] < 0.98:
            print(
                f"{seed}: {num}/{den}, M_s = {m_s}: k_i = {k_i:.4g}, {shares[-1]:.3f} of the best"
            )
    if not shares:
        sys.exit("none of these plants can be controlled")
    found = np.array(shares)
    share, each = np.mean(found >= 0.98), seconds / arguments.plants
    print(
        f"{found.size} plants that can be controlled: k_i at least 0.98 of the best for "
        f"{share:.1%}, least {np.min(found):.3f}; {each:.2f} s of CPU for each"
    )
    write(
        arguments,
        {
            "plants": found.size,
            "share with 0.98 of the best": share,
            "least of the best": np.min(found),
            "cpu of each": each,
        },
    )


if __name__ == "__main__":
    main()
