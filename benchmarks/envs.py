"""Steps a second of vectorised environments (extra ``envs``).

    python benchmarks/envs.py [--lanes 1000] [--seconds 5]

Each row is an environment of many loops under one random action for each loop and step, for some
seconds after the compilation, with new episodes where they end. A *sample* is a sample of the
controller; a step of the environment has ``action_repeat`` of them. Wall time depends on what else
the machine does; CPU time, of all threads together, hardly. A million steps a second on two cores
take 2 µs of CPU a step. *fixed* environments have the same signals in all episodes; *drawn* ones
get scenarios of their own, whose signals Python evaluates when an episode begins.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium
import numpy as np

import quell as ql
import quell.envs

FIXED = ql.Scenario(ql.signals.Step(), disturbances=(0.0, ql.signals.Sinusoid()), duration=20.0)
NAMES = ("quell/two-mass-v0", "quell/two-mass-residual-v0")


def measured(env: Any, seconds: float) -> tuple[float, float]:
    """Return steps a second and CPU time a step [s]."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.1, 0.1, (64, env.num_envs, 1))
    env.reset(seed=0)
    env.step(actions[0])
    steps, wall, cpu = 0, time.perf_counter(), time.process_time()
    while time.perf_counter() - wall < seconds:
        for action in actions:
            env.step(action)
        steps += actions.shape[0]
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return steps * env.num_envs / wall, cpu / (steps * env.num_envs)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lanes", type=int, default=1000, help="loops at once")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each environment")
    options = parser.parse_args()
    print(f"{options.lanes} loops")
    head = ("environment", "signals", "repeat", "steps/s", "samples/s", "CPU ns/step", "/sample")
    print("{:28} {:>8} {:>7} {:>12} {:>12} {:>12} {:>8}".format(*head))
    for name in NAMES:
        for signals, changes in (("fixed", {"scenario": FIXED}), ("drawn", {})):
            for repeat in (1, 10):
                given = {"action_repeat": repeat, "limit": 10.0} | changes
                env = gymnasium.make_vec(name, num_envs=options.lanes, **given)
                rate, cpu = measured(env, options.seconds)
                env.close()
                row = (rate, rate * repeat, 1e9 * cpu, 1e9 * cpu / repeat)
                print(
                    f"{name:28} {signals:>8} {repeat:7d} {row[0]:12.3g} {row[1]:12.3g} "
                    f"{row[2]:12.0f} {row[3]:8.0f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
