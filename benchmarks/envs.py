"""Steps a second of vectorised environments (extra ``envs``).

    python benchmarks/envs.py [--lanes 1000] [--seconds 5]

Each row is an environment of many loops under one random action for each loop and step, for some
seconds after the compilation, with new episodes where they end. A *sample* is a sample of the
controller; a step of the environment has ``action_repeat`` of them. Wall time depends on what else
the machine does; CPU time, of all threads together, hardly. A million steps a second on two cores
take 2 µs of CPU a step. *fixed* environments have the same signals in all episodes; *drawn* ones
get scenarios of their own, whose signals Python evaluates when an episode begins. The last rows
are two coupled axes, with a residual action for each.
"""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np
from measured import options_of, parser_of, write

import quell as ql
import quell.envs

FIXED = ql.Scenario(ql.signals.Step(), disturbances=(0.0, ql.signals.Sinusoid()), duration=20.0)
NAMES = ("quell/two-mass-v0", "quell/two-mass-residual-v0")


def timed(env: Any, seconds: float) -> tuple[float, float]:
    """Return steps a second and CPU time a step [s]."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.1, 0.1, (64, *env.action_space.shape))
    env.reset(seed=0)
    env.step(actions[0])
    steps, wall, cpu = 0, time.perf_counter(), time.process_time()
    while time.perf_counter() - wall < seconds:
        for action in actions:
            env.step(action)
        steps += actions.shape[0]
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return steps * env.num_envs / wall, cpu / (steps * env.num_envs)


def two_axes(lanes: int, repeat: int) -> Any:
    """Return loops of a gantry whose drives act on both axes, each with an ADRC and a policy."""
    A = [[0, 1, 0, 0], [0, -2, 0, 0], [0, 0, 0, 1], [0, 0, 0, -3]]
    B = [[0, 0], [5, 0.5], [0, 0], [0.4, 6]]
    plant = ql.plants.LinearPlant(A, B, np.eye(4)[[0, 2]])
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3)
    one = ql.ADRC(observer, omega_c=8.0, learner=quell.envs.Policy(), guard=ql.Guard())
    limits = {"u_min": -25.0, "u_max": 25.0}
    axes = ql.Axes({"x": one, "y": one}, B0=[[5.0, 0.5], [0.4, 6.0]], **limits)
    references = (ql.signals.Sinusoid(0.1, 5.0), ql.signals.Sinusoid(0.2, 3.0))
    scenario = ql.Scenario(references, 2.0)
    return quell.envs.VectorEnv(lanes, plant, scenario, axes, action_repeat=repeat)


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--lanes", type=int, default=1000, help="loops at once")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each environment")
    options = options_of(parser, lanes=20, seconds=0.1)
    figures: dict[str, Any] = {"loops": options.lanes}
    print(f"{options.lanes} loops")
    head = ("environment", "signals", "repeat", "steps/s", "samples/s", "CPU ns/step", "/sample")
    print("{:28} {:>8} {:>7} {:>12} {:>12} {:>12} {:>8}".format(*head))
    for name in NAMES:
        for signals, changes in (("fixed", {"scenario": FIXED}), ("drawn", {})):
            for repeat in (1, 10):
                given = {"action_repeat": repeat, "limit": 10.0} | changes
                env = gymnasium.make_vec(name, num_envs=options.lanes, **given)
                row = show(name, signals, repeat, *timed(env, options.seconds))
                figures[f"{name}, {signals}, repeat {repeat}"] = row
                env.close()
    for repeat in (1, 10):
        env = two_axes(options.lanes, repeat)
        row = show("two axes, residual", "fixed", repeat, *timed(env, options.seconds))
        figures[f"two axes, residual, fixed, repeat {repeat}"] = row
        env.close()
    write(options, figures)


def show(name: str, signals: str, repeat: int, rate: float, cpu: float) -> dict[str, float]:
    """Print a row, and return it."""
    row = (rate, rate * repeat, 1e9 * cpu, 1e9 * cpu / repeat)
    print(
        f"{name:28} {signals:>8} {repeat:7d} {row[0]:12.3g} {row[1]:12.3g} "
        f"{row[2]:12.0f} {row[3]:8.0f}",
        flush=True,
    )
    return dict(zip(("steps/s", "samples/s", "CPU ns/step", "CPU ns/sample"), row, strict=True))


if __name__ == "__main__":
    main()
