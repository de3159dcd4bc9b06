"""Divergence of Algorithm 1 with and without the control signal among its features.

    python benchmarks/algorithm_1.py

The two-mass scenario at dt = 10 ms, extended to 2000 s, with a batch of one, in plain numpy. The
implementation is independent of that in quell.
"""

from __future__ import annotations

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.experiments import two_mass_spring as study

DT, HORIZON = 0.01, 2000.0


def run(rate: float, with_u: bool, horizon: float = HORIZON) -> tuple[float, np.ndarray, float]:
    """Return the end of the run, and θ and the gain ratio (b0 + θ_u)/b0 at 99 % of this time."""
    settings = study.Settings(dt=DT)
    observer, scenario = (
        ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=DT).model,
        study.scenario(settings),
    )
    plant, law = (
        ql.plants.two_mass_spring().sampled(DT),
        study.controllers(settings)[study.MF].parameters.law,
    )
    t = np.arange(round(horizon / DT)) * DT
    r, w2, noise = scenario.reference(t), scenario.disturbances[1](t), scenario.noise(t)
    x, z, theta, u, learned = np.zeros(4), np.zeros(5), np.zeros(6), 0.0, 0.0
    mask = np.array([1.0, 1.0, 1.0, 1.0, float(with_u), 1.0])
    history = []
    for k in range(t.size):
        if k == round(study.STEP_AT / DT):
            x[:], z[:], u, learned = 0.0, 0.0, 0.0, 0.0
        y = x[1]
        if not abs(y) < 1e6:
            break
        predicted = observer.transition @ z + observer.input * u + observer.feed * learned
        z = predicted + observer.gain * (y + noise[k] - predicted[0])
        feature = np.array([*z[:4], u, 1.0]) * mask
        theta = theta + rate * DT * z[4] * feature
        learned = theta @ feature
        u = law[0] * (r[k] - z[0]) - law[1:] @ z[1:4] - learned - z[4]
        x = plant.transition @ x + plant.input * u + plant.disturbance[:, 1] * w2[k]
        history.append(theta)
    return (
        t[k],
        history[int(0.99 * len(history)) - 1],
        1.0 + history[int(0.99 * len(history)) - 1][4],
    )


def main() -> None:
    """Print both cases for several rates."""
    parser = parser_of(__doc__)
    parser.add_argument("--horizon", type=float, default=HORIZON, help="longest run [s]")
    options = options_of(parser, horizon=112.0)
    figures: dict[str, dict[str, float]] = {}
    table = Table(
        "rate · batch / dt [1/s]", "features", "lasts [s]", "θ at 99 % of that", "(b0 + θ_u)/b0"
    )
    for rate in (0.001, 0.01, 0.03, 0.1, 0.3):
        for with_u in (True, False):
            ended, theta, gain = run(rate, with_u, options.horizon)
            whole = ended > options.horizon - 1.0
            figures[f"{rate:g}/s, {'with' if with_u else 'without'} u"] = {
                "lasts [s]": ended,
                "to the end": int(whole),
                **{f"theta[{i}]": value for i, value in enumerate(theta)},
                "(b0 + theta_u)/b0": gain,
            }
            lasts = f"all {options.horizon:g}" if whole else f"{ended:.0f}"
            table.add_row(
                f"{rate:g}",
                "x̂, u, 1" if with_u else "x̂, 1",
                lasts,
                np.array2string(theta, precision=2),
                f"{gain:.2f}",
            )
    Console().print(table)
    write(options, figures)


if __name__ == "__main__":
    main()
