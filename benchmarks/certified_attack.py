"""Attacks certified loops with the worst learners that a search finds; no bound may be exceeded.

Random linear loops of the trial (``quell.experiments.stress.general``: stable, unstable, lagged,
delayed, two masses; modulus margin 0.35 and more; their references, loads and noise). Their guard
is certified for the plant. The learners see everything, the guard's state included: random ones
that earn trust and spend it, and for each loop what the cross-entropy method makes of them. In
chains of integrators there are also spenders (``spender.py``), which push with the signs of the
pulse response backwards.

A run's score is the larger of sup |q| and sup |y − y_0|, each over its bound from the certificate
and from sup |q_0| of the same loop without learner: it must stay below 1. q is computed from y and
u alone.

python benchmarks/certified_attack.py [--loops 40] [--seed 1] [--generations 5] [--population 24]
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table
from spender import Spender, draw_push, pulse_response

import quell as ql
from quell.analysis import Certificate, certify, observer_error
from quell.experiments.stress.general import adversary_at, earn_and_spend
from quell.experiments.stress.loops import GeneralLoop, draw_loop
from quell.guard import Guard
from quell.guard.guard import plain_loop, state_path
from quell.parallel import in_parallel
from quell.plants.linear import sampled_plant
from quell.simulation.simulate import simulate

FAMILIES = ("stable", "unstable", "lagged", "delayed", "two masses")
CHAINS = ("chain, ramp", "chain, sine")
LEAST_MARGIN = 0.35
ELITE = 4


class Case:
    """A certified loop: its run without learner, and the score of a learner in it."""

    def __init__(self, plant: Any, scenario: Any, model: Any, make: Any) -> None:
        self.plant, self.scenario, self.make = plant, scenario, make
        self.guard = Guard(certified_for=model)
        self.proof: Certificate = certify(model, make(ql.learners.Harmonic(), self.guard))
        self.alone = simulate(plant, make(None, None), scenario)
        q_0 = float(np.max(np.abs(observer_error(make(None, None), self.alone))))
        self.bounds = self.proof.error_bound(q_0), self.proof.output_bound(q_0)

    def score(self, learner: Any) -> tuple[float, float, float]:
        """Return sup |q| and sup |y − y_0| over their bounds, and the largest authority."""
        controller = self.make(learner, self.guard)
        run = simulate(self.plant, controller, self.scenario, limit=1e12)
        q = float(np.max(np.abs(observer_error(controller, run))))
        moved = float(np.max(np.abs(run["y"] - self.alone["y"][: len(run)])))
        return q / self.bounds[0], moved / self.bounds[1], float(np.max(run["authority"]))


def general_case(loop: GeneralLoop) -> Case:
    """Return a loop of the trial."""
    model = loop.plant.linear
    if loop.plant.delay:
        model = ql.plants.delayed(model, loop.plant.delay * loop.dt, loop.dt)
    return Case(loop.plant, loop.scenario, model, loop.controller)


def searched(loop: GeneralLoop, case: Case, rng: Any, generations: int, population: int) -> Any:
    """Return the worst scores of learners that see everything: the largest of each column."""
    points = np.array([earn_and_spend(rng) for _ in range(population)])
    worst = np.zeros(3)
    for _ in range(generations):
        jobs = [partial(case.score, adversary_at(point, loop, case.guard)) for point in points]
        scores = np.array(in_parallel(jobs))
        worst = np.maximum(worst, scores.max(axis=0))
        elite = points[np.argsort(-scores[:, :2].max(axis=1))[:ELITE]]
        spread = elite.std(axis=0) + 0.05
        points = elite.mean(axis=0) + spread * rng.normal(size=points.shape)
        points[:ELITE] = elite
    return worst


def spent(order: int, load: str, rng: Any, count: int) -> tuple[Case, Any]:
    """Return a chain of integrators with random numbers, and the worst scores of spenders."""
    while True:
        omega_o, b = rng.uniform(5.0, 20.0), 1.0 / rng.uniform(0.6, 1.6)
        dt = 0.1 / omega_o
        model = ql.plants.LinearPlant.of(([b], [1.0] + [0.0] * order))
        observer = ql.ESO.model_free(order, 1.0, omega_o, dt)
        if ql.analysis.analyse(model, ql.ADRC(observer, 1.0)).margins.modulus >= LEAST_MARGIN:
            break
    lag = observer.lag_time
    duration = max(250.0 * lag, 40.0)
    signal = {
        "chain, ramp": ql.signals.Ramp(1.0),
        "chain, sine": ql.signals.Sinusoid(1.0, rng.uniform(0.1, 0.2 * omega_o)),
    }[load]
    scenario = ql.Scenario(duration=round(duration / dt) * dt, disturbances=(signal,))

    def make(learner: Any, guard: Any) -> ql.ADRC:
        return ql.ADRC(observer, 1.0, learner=learner, guard=guard)

    case = Case(model, scenario, model, make)
    samples = len(case.alone)
    law = make(None, None).parameters.law
    to_error, _ = plain_loop(sampled_plant(model, dt), observer, law)
    pulse = pulse_response(state_path(observer, law).then(to_error), samples + 1)[1:]
    f = b * signal.evaluate(dt * np.arange(samples))
    pushes = [draw_push(rng, pulse, samples, lag / dt) for _ in range(count)]
    jobs = [partial(case.score, Spender(f, push, b - 1.0)) for push in pushes]
    return case, np.array(in_parallel(jobs)).max(axis=0)


def main() -> None:
    """Attack, and print the worst scores of each family."""
    parser = parser_of(__doc__)
    parser.add_argument("--loops", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--generations", type=int, default=5)
    parser.add_argument("--population", type=int, default=24)
    options = options_of(parser, loops=7, generations=1, population=2)
    rng, names = np.random.default_rng(options.seed), FAMILIES + CHAINS
    rows: dict[str, list[Any]] = {name: [] for name in names}
    for i in range(options.loops):
        name = names[i % len(names)]
        if name in CHAINS:
            count = options.generations * options.population
            case, worst = spent(1 + (i // len(names)) % 4, name, rng, count)
        else:
            loop = draw_loop(rng, name)
            while loop.margin < LEAST_MARGIN:
                loop = draw_loop(rng, name)
            case = general_case(loop)
            worst = searched(loop, case, rng, options.generations, options.population)
        rows[name].append([case.proof.kappa, case.proof.error_factor, *worst])
    write(options, show(rows, options.generations * options.population))


def show(rows: dict[str, list[Any]], each: int) -> dict[str, Any]:
    """Print the table, and return it."""
    figures: dict[str, Any] = {"learners a loop": each}
    table = Table(title=f"Worst of {each} learners a loop, over the bound: must be below 1")
    headings = (
        "",
        "loops",
        "κ: least",
        "bound on q: median",
        "q: median, worst",
        "y: median, worst",
    )
    for heading in (*headings, "trusted"):
        table.add_column(heading)
    for name, part in rows.items():
        if part:
            values = np.array(part)
            median, worst = np.median(values, axis=0), values.max(axis=0)
            table.add_row(
                name,
                str(len(part)),
                f"{values[:, 0].min():.2f}",
                f"{median[1]:.2f}",
                f"{median[2]:.3f}, {worst[2]:.3f}",
                f"{median[3]:.3f}, {worst[3]:.3f}",
                f"{np.mean(values[:, 4] > 0.5):.0%}",
            )
            figures[name] = {
                "loops": len(part),
                "kappa": {"least": values[:, 0].min(), "largest": worst[0]},
                "bound on q": {"median": median[1]},
                "q": {"median": median[2], "largest": worst[2]},
                "y": {"median": median[3], "largest": worst[3]},
                "trusted": np.mean(values[:, 4] > 0.5),
            }
    Console(width=110).print(table)
    return figures


if __name__ == "__main__":
    main()
