"""Figures of the guard that no trial of ``quell stress`` has: rare steps, cogging behind a spring.

*Rare steps.* A step of load every 60 lags of the observer, of random size, 20 of them; the learner
is an oracle that returns the load itself. The measure is the RMS error of the second half, over
that without learner. The plants are the paper's two masses behind the model-based observer
(omega_c = 1, omega_o = 10 rad/s, dt = 5 ms) with a force on m1, which f is proportional to, and the
slow process 1.5/(120 s + 1) of the general trial (omega_o = 0.15, omega_c = 0.025 rad/s, dt = 1 s),
which has no noise. An RMS error is set by the first lags after each step, which the oracle removes
unguarded.

*Cogging, two masses.* A force of two harmonics in the position of m2, with random amplitudes,
phases and pitch, acts on m2 of the paper's plant, whose reference is a sinusoid; the learner is
``RLS`` with the state and the harmonics of that pitch. The measure is the RMS error of the second
half with the guard, over that without guard. Errors are against the response that the design asks
for.

Errors of two masses are means over four draws of the noise. Run: ``python
benchmarks/guard_bars.py`` (a minute).
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table
from scipy.signal import lsim

import quell as ql
from quell.experiments.stress.adversaries import INPUTS, Program, Watched
from quell.experiments.stress.loops import Table as Values
from quell.parallel import in_parallel
from quell.types import Vector

DRAWS, LAGS_APART, STEPS = 4, 60.0, 20
NOISE = 1e-5  # standard deviation of the noise of y on two masses [m]
LOOPS = 6


def rms(values: Vector) -> float:
    """Return the RMS of the second half."""
    return float(np.sqrt(np.mean(values[values.size // 2 :] ** 2)))


def rare_steps(name: str, seed: int, quick: bool) -> tuple[float, float, float]:
    """Return the late errors without learner, with the oracle, and with oracle and guard."""
    if name == "two masses":
        plant, dt, omega_c, noise = ql.plants.two_mass_spring(), 5e-3, 1.0, NOISE
        observer = ql.ESO.model_based(plant, 10.0, dt)
        to_f = observer.b0
    else:
        plant, dt, omega_c, noise = ql.plants.LinearPlant.of(([1.5], [120.0, 1.0])), 1.0, 0.025, 0.0
        observer = ql.ESO.model_free(1, 1.5 / 120.0, 0.15, dt)
        to_f = observer.b0
    rng, apart = (
        np.random.default_rng(seed),
        round((3.0 if quick else LAGS_APART) * observer.lag_time / dt),
    )
    load = np.repeat(rng.uniform(-1.0, 1.0, 4 if quick else STEPS), apart)
    weights = np.zeros((2, len(INPUTS)))
    weights[:, INPUTS.index("load")] = 1.0

    def late(controller: Any, draw: int) -> float:
        values = noise * np.random.default_rng([seed, draw]).standard_normal(load.size)
        scenario = ql.Scenario(
            0.0, (load.size - 1) * dt, (Values(load, dt),), Values(values, dt) if noise else 0.0
        )
        return rms(ql.simulate(plant, controller, scenario, interpret=quick)["y"])

    def mean(guard: ql.Guard | None, learns: bool = True) -> float:
        learner = Program(weights, load=to_f * load, guard=guard)  # type: ignore[arg-type]
        controller: Any = ql.ADRC(observer, omega_c)
        if learns:
            controller = Watched(observer, omega_c, learner=learner, guard=guard)
        return float(
            np.mean([late(controller, draw) for draw in range(DRAWS if noise and not quick else 1)])
        )

    return mean(None, False), mean(None), mean(ql.Guard())


def behind_a_spring(t: float, x: Any, u: float, w: Any, pitch: Any, a: Any, b: Any, c: Any) -> Any:
    """Return the motion of the paper's two masses, with a force on m2 that depends on x2."""
    spring, phase = x[1] - x[0], 2.0 * math.pi * x[1] / pitch
    cogging = a * math.sin(phase) + b * math.cos(phase) + c * math.sin(2.0 * phase)
    return x[2], x[3], u + spring, cogging - spring


def cogging(seed: int, quick: bool) -> tuple[float, float, float]:
    """Return the late errors without learner, with ``RLS``, and with ``RLS`` and guard."""
    rng = np.random.default_rng(seed)
    pitch = float(rng.uniform(0.5, 1.5))
    forces = dict(zip("abc", rng.uniform(-0.1, 0.1, 3).tolist(), strict=True))
    plant = ql.plants.NonlinearPlant(
        behind_a_spring,
        order=4,
        output=[0.0, 1.0, 0.0, 0.0],
        parameters={"pitch": pitch, **forces},
    )
    dt, omega, end = 5e-3, float(rng.uniform(0.1, 0.5)), 2.0 if quick else 240.0
    observer = ql.ESO.model_free(4, 1.0, 10.0, dt)
    features = ql.features.State() + ql.features.Periodic(pitch, orders=(1, 2)) + ql.features.Bias()
    learner = ql.learners.RLS(features=features)
    t = dt * np.arange(round(end / dt) + 1)
    asked = lsim(([1.0], [1.0, 4.0, 6.0, 4.0, 1.0]), np.sin(omega * t), t)[1]

    def mean(learner: Any, guard: ql.Guard | None) -> float:
        found = []
        for draw in range(1 if quick else DRAWS):
            values = NOISE * np.random.default_rng([seed, draw]).standard_normal(t.size)
            scenario = ql.Scenario(ql.signals.Sinusoid(omega=omega), end, (), Values(values, dt))
            controller = ql.ADRC(observer, 1.0, learner=learner, guard=guard)
            run = ql.simulate(plant, controller, scenario, interpret=quick)
            found.append(rms(run["y"] - asked))
        return float(np.mean(found))

    return mean(None, None), mean(learner, None), mean(learner, ql.Guard())


def main() -> None:
    """Print the table."""
    options = options_of(parser_of(__doc__))
    loops = 1 if options.quick else LOOPS
    figures: dict[str, Any] = {"draws": loops}
    cases: dict[str, Any] = {
        "rare steps, oracle, two masses": partial(rare_steps, "two masses"),
        "rare steps, oracle, process without noise": partial(rare_steps, "process"),
        "cogging, two masses, RLS": cogging,
    }
    table = Table(title=f"Late RMS errors, {loops} draws: median, largest")
    headings = ("unguarded over none", "guarded over none", "guarded over unguarded")
    for heading in ("case", *headings):
        table.add_column(heading)
    for name, case in cases.items():
        found = np.array(
            in_parallel([partial(case, seed, quick=options.quick) for seed in range(loops)])
        )
        none, unguarded, guarded = found.T
        ratios = (unguarded / none, guarded / none, guarded / unguarded)
        figures[name] = {
            heading: {"median": np.median(each), "largest": np.max(each)}
            if np.all(np.isfinite(each))
            else "without noise the unguarded oracle leaves nothing"
            for heading, each in zip(headings, ratios, strict=True)
        }
        table.add_row(name, *(f"{np.median(each):.3f}, {np.max(each):.3f}" for each in ratios))
    Console().print(table)
    write(options, figures)


if __name__ == "__main__":
    main()
