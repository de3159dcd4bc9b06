"""A residual policy of 37 numbers on the torsional testbed, trained behind a guard and without.

    python benchmarks/residual_policy.py [--seconds 20] [--generations 90] [--trainings 2]

The environment is ``quell/torsional-residual-v0`` (extra ``envs``): the disks follow a sinusoid of
up to a quarter turn, an ADRC controls them, and the action is the f_L that is fed forward. Its own
episodes last 4 s; the guard hears a learner after 5 to 30 lags of 56 ms, so they are longer here.
The policy is a network with one hidden layer of four tanh units. It sees r, y_measured, x_hat and
f_residual, seven numbers, so it has 7 · 4 + 4 + 4 + 1 = 37 parameters. Inputs are divided by their
RMS in the training episodes without policy, and the output 1 is the RMS of f_residual there. CMA-ES
(package ``cmaes``, extra ``tuning``) minimises the mean cost ∫ (r − y)² dt of the training
episodes, from a policy whose output is zero.

Each training is done once with the guard and once without, with its own seed of CMA-ES and its own
episodes. All costs that are printed are those of 64 episodes that no training has seen. *None* is
the controller without policy. *Design* is the response that the controller is designed for,
``(omega_c/(s + omega_c))^4 r``: a policy that costs less has become a part of the control law,
because no knowledge of the disturbance makes the loop better than its design. ``feedforward=True``
is the way to remove the design's lag, without any policy.
The last row runs the policies that were trained without guard behind the guard: it tells what the
guard forbids from what CMA-ES has not found.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from cmaes import CMA
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table
from scipy.signal import lsim

import quell as ql
from quell.envs import Policy
from quell.envs.library import arguments, torsional_scenario
from quell.types import Vector

NAME, OBSERVED = "torsional-residual", ("r", "y_measured", "x_hat", "f_residual")
INPUTS, HIDDEN = 7, 4
SIZE = HIDDEN * (INPUTS + 2) + 1
EPISODES, FIRST_UNSEEN = 6, 1_000_000
SPREAD = 0.3  # standard deviation with which CMA-ES begins; a weight of 1 is that of an RMS
BAR = 0.32  # of the cost without policy, with the guard


def episode(seconds: float) -> Any:
    """Return the environment's scenarios, with another duration."""
    return lambda rng: replace(torsional_scenario(rng), duration=seconds)


class Loops:
    """Many loops of the environment, with the guard or without."""

    def __init__(
        self, count: int, guard: ql.Guard | None, seconds: float, feedforward: bool = False
    ) -> None:
        own = arguments(NAME, {})["controller"]
        controller = ql.ADRC(
            own.observer,
            own.omega_c,
            learner=Policy(),
            guard=guard,
            feedforward=feedforward,
            u_min=own.limits.low,
            u_max=own.limits.high,
        )
        given = {"controller": controller, "observe": OBSERVED, "scenario": episode(seconds)}
        self.env: Any = gymnasium.make_vec(f"quell/{NAME}-v0", num_envs=count, **given)
        self.most = 0.5 * own.observer.b0 * (own.limits.high - own.limits.low)

    def run(self, policy: Any, seeds: list[int]) -> tuple[Vector, int, Vector]:
        """Return the cost of an episode in each loop, how many are lost, and the RMS of inputs."""
        observations, _ = self.env.reset(seed=seeds)
        costs, lost, running = np.zeros(len(seeds)), 0, np.ones(len(seeds), bool)
        square, steps = np.zeros(INPUTS), 0
        while running.any():
            square += np.mean(observations**2, axis=0)
            steps += 1
            actions = policy(observations)
            observations, rewards, terminated, truncated, _ = self.env.step(actions[:, None])
            costs -= np.where(running, rewards, 0.0)
            lost += int(np.sum(running & terminated))
            running &= ~(terminated | truncated)
        return costs, lost, np.sqrt(square / steps)


def network(points: Any, scale: Vector, unit: float) -> Any:
    """Return the policy of rows of parameters (loops, ``SIZE``), one for each loop."""
    inner = points[:, : HIDDEN * INPUTS].reshape(-1, HIDDEN, INPUTS) / scale
    bias, outer, offset = np.split(points[:, HIDDEN * INPUTS :], [HIDDEN, 2 * HIDDEN], axis=1)

    def policy(observations: Any) -> Any:
        hidden = np.tanh(np.einsum("lhi,li->lh", inner, observations) + bias)
        return unit * (np.sum(outer * hidden, axis=1) + offset[:, 0])

    return policy


def idle(observations: Any) -> Any:
    """Return the action zero: no policy."""
    return np.zeros(observations.shape[0])


class Trained:
    """A policy that was trained, and what the training saw."""

    def __init__(self, guard: ql.Guard | None, seed: int, given: Any) -> None:
        population, generations = given.population, given.generations
        loops = Loops(population * EPISODES, guard, given.seconds)
        seeds = [EPISODES * seed + i for i in range(EPISODES)] * population
        _, _, self.scale = loops.run(idle, seeds)
        self.unit, self.lost = float(self.scale[-1]) / loops.most, 0
        strategy = CMA(np.zeros(SIZE), SPREAD, seed=seed, population_size=population)
        for _ in range(generations):
            points = np.array([strategy.ask() for _ in range(population)])
            policy = network(np.repeat(points, EPISODES, axis=0), self.scale, self.unit)
            costs, lost, _ = loops.run(policy, seeds)
            self.lost += lost
            strategy.tell(list(zip(points, costs.reshape(-1, EPISODES).mean(axis=1), strict=True)))
        loops.env.close()
        self.point, self.share = strategy.mean, self.lost / (generations * len(seeds))

    def on(self, loops: Loops, seeds: list[int]) -> tuple[float, int]:
        """Return the mean cost of episodes, and how many are lost."""
        policy = network(np.tile(self.point, (len(seeds), 1)), self.scale, self.unit)
        costs, lost, _ = loops.run(policy, seeds)
        return float(costs.mean()), lost


def design_cost(seconds: float, seeds: list[int]) -> float:
    """Return the mean cost of the response that the controller is designed for."""
    omega_c, costs = arguments(NAME, {})["controller"].omega_c, []
    t: Vector = 1e-3 * np.arange(round(seconds / 1e-3) + 1)
    for seed in seeds:
        r = episode(seconds)(np.random.default_rng(seed)).reference(t)
        asked = lsim(([omega_c**4], np.poly([-omega_c] * 4)), r, t)[1]
        costs.append(float(np.sum((r - asked) ** 2)) * 1e-3)
    return float(np.mean(costs))


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of an episode")
    parser.add_argument("--generations", type=int, default=90)
    parser.add_argument("--trainings", type=int, default=2)
    parser.add_argument("--unseen", type=int, default=64, help="episodes that judge")
    parser.add_argument("--population", type=int, default=16)
    options = options_of(parser, seconds=0.3, generations=1, trainings=1, unseen=4, population=4)
    count, seconds = options.unseen, options.seconds
    unseen = list(range(FIRST_UNSEEN, FIRST_UNSEEN + count))
    guarded, unguarded = Loops(count, ql.Guard(), seconds), Loops(count, None, seconds)
    none = float(guarded.run(idle, unseen)[0].mean())
    rows: dict[str, list[tuple[float, int]]] = {}
    lost: dict[str, list[float]] = {}
    for seed in range(options.trainings):
        began = time.process_time()
        with_guard = Trained(ql.Guard(), seed, options)
        without = Trained(None, seed, options)
        for name, trained, loops in (
            ("guarded", with_guard, guarded),
            ("unguarded", without, unguarded),
            ("trained unguarded, then guarded", without, guarded),
        ):
            rows.setdefault(name, []).append(trained.on(loops, unseen))
            lost.setdefault(name, []).append(trained.share)
        print(f"training {seed}: {time.process_time() - began:.0f} s of CPU", flush=True)
    title = f"Mean cost of {count} unseen episodes, {SIZE} numbers, {options.trainings} trainings"
    table = Table(title=title)
    for heading in ("policy", "cost: mean, least, most", "over none", "lost", "lost in training"):
        table.add_column(heading)
    design = design_cost(seconds, unseen)
    table.add_row("none", f"{none:.4g}", "1", "0", "")
    table.add_row("(design)", f"{design:.4g}", f"{design / none:.3f}", "", "")
    forward = float(Loops(count, None, seconds, feedforward=True).run(idle, unseen)[0].mean())
    table.add_row("none, feedforward=True", f"{forward:.4g}", f"{forward / none:.3f}", "", "")
    figures: dict[str, Any] = {
        "episodes": count,
        "cost without policy": none,
        "design over none": design / none,
        "feedforward over none": forward / none,
    }
    for name, found in rows.items():
        costs, gone = np.array([cost for cost, _ in found]), sum(count for _, count in found)
        table.add_row(
            name,
            f"{costs.mean():.4g}, {costs.min():.4g}, {costs.max():.4g}",
            f"{costs.mean() / none:.3f}",
            f"{gone} of {count * len(found)}",
            f"{100.0 * np.mean(lost[name]):.2g} %",
        )
        figures[name] = {
            "cost": costs.mean(),
            "least": costs.min(),
            "most": costs.max(),
            "over none": costs.mean() / none,
            "lost": gone,
            "lost in training [%]": 100.0 * np.mean(lost[name]),
        }
    Console(width=110).print(table)
    share = float(np.mean([cost for cost, _ in rows["guarded"]])) / none
    verdict = "met" if share <= BAR else "NOT met"
    write(options, figures)
    print(f"Guarded over none: {share:.3f}, bar {BAR:g}: {verdict}.")


if __name__ == "__main__":
    main()
