"""A move that is repeated fifty times, on an arm with gravity and friction.

    python benchmarks/repeated_moves.py [--repeats 50]

The arm is ``y'' = 20 (u − 0.1 y' − 2 sin y − F) + w`` with dry friction F = 0.5 tanh(y'/0.02), and
moves by 1.5 rad along a trapezoid of 1 s and back, once every 4 s. The loop has dt = 1 ms, a
model-free ESO with b0 wrong by the factor in the table, and noise of 20 µrad. The figures are RMS
errors ``y − r`` of a repetition.
"""

from __future__ import annotations

import math

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.kernels import dispatch
from quell.learners import Kalman, Learner, Repetitive
from quell.signals import BandLimitedNoise, Repeated, Trapezoid
from quell.types import Vector

DT, PERIOD = 1e-3, 4.0
MOVE = Trapezoid(1.5, 1.0, start=0.2) - Trapezoid(1.5, 1.0, start=2.2)
ARM = ql.plants.NonlinearPlant(
    lambda t, x, u, w: (
        x[1],
        20.0 * (u - 0.1 * x[1] - 2.0 * math.sin(x[0]) - 0.5 * math.tanh(x[1] / 0.02)) + w[0],
    ),
    order=2,
    substeps=4,
)
LEARNERS: dict[str, Learner | None] = {
    "none": None,
    "Kalman": Kalman(),
    "Repetitive": Repetitive(period=PERIOD),
}


def errors(
    learner: Learner | None,
    repeats: int,
    *,
    guard: bool = False,
    feedforward: bool = True,
    b0: float = 16.0,
    omega_o: float = 80.0,
    noise: float = 2e-5,
) -> Vector:
    """Return the RMS error of each repetition."""
    controller = ql.ADRC(
        ql.ESO.model_free(order=2, b0=b0, omega_o=omega_o, dt=DT),
        omega_c=15.0,
        learner=learner,
        guard=ql.Guard() if guard else None,
        feedforward=feedforward,
    )
    scenario = ql.Scenario(
        reference=Repeated(MOVE, PERIOD),
        noise=BandLimitedNoise(noise**2 * DT, DT) if noise else 0.0,
        duration=repeats * PERIOD,
    )
    run = ql.simulate(ARM, controller, scenario)
    away = (run["y"] - run["r"])[:-1].reshape(repeats, -1)
    found: Vector = np.sqrt(np.mean(away**2, axis=1))
    return found


def main() -> None:
    """Print a table."""
    parser = parser_of(__doc__)
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--b0", type=float, nargs="+", default=[16.0, 20.0, 26.0])
    parser.add_argument("--learners", nargs="+", choices=LEARNERS, default=[*LEARNERS])
    options = options_of(parser, repeats=2, b0=[16.0], learners=["Repetitive"])
    dispatch.interpret_all |= options.quick  # the plant is a user's: compiled in each process
    repeats, figures = options.repeats, {}
    shown = {
        f"{k + 1}{'st' if k == 0 else 'nd' if k == 1 else 'th'}": k
        for k in (0, 1, 4, 9, repeats - 1)
        if k < repeats
    }
    table = Table(
        "b0/b",
        "feedforward",
        "learner",
        "guard",
        *shown,
        "last/first",
        title="RMS errors [mrad]",
    )
    for b0 in options.b0:
        for feedforward in (True, False):
            for name in options.learners:
                learner = LEARNERS[name]
                for guard in (False, True)[: 1 if learner is None else 2]:
                    rms = errors(learner, repeats, guard=guard, feedforward=feedforward, b0=b0)
                    table.add_row(
                        *(
                            f"{b0 / 20.0:g}",
                            "yes" if feedforward else "no",
                            name,
                            "yes" if guard else "no",
                        ),
                        *(f"{1e3 * rms[k]:.4f}" for k in shown.values()),
                        f"{rms[-1] / rms[0]:.4f}",
                    )
                    label = f"b0/b {b0 / 20.0:g}, {name}{', guard' * guard}"
                    label += ", feedforward" * feedforward
                    figures[label] = {each: 1e3 * rms[k] for each, k in shown.items()}
                    figures[label]["last/first"] = rms[-1] / rms[0]
    Console(width=120).print(table)
    write(options, figures)


if __name__ == "__main__":
    main()
