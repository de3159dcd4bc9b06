"""Effect of a long sinusoidal load on the learned model, with and without a feature for the load.

python benchmarks/forgetting.py
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell import signals
from quell.experiments import two_mass_spring as study

TRAINED = 90.0


def main() -> None:
    """Train on sin t, load m2 for a while, then step from rest without the load."""
    options = options_of(parser_of(__doc__))
    figures: dict[str, Any] = {}
    table = Table("learner", "load lasts [s]", "θ1", "θ3", "overshoot", "settling ±0.2 % [s]")
    settings = study.Settings()
    learners = {"none": None, "Kalman": ql.learners.Kalman(), "Harmonic": ql.learners.Harmonic()}
    for name, learner in learners.items():
        controller = study.controller(settings, learner=learner)
        for lasts in (0.0, 20.0) if options.quick else (0.0, 300.0, 900.0, 3000.0):
            step_at = TRAINED + lasts + 110.0
            load = signals.Constant(0.0).until(
                TRAINED, then=signals.Sinusoid(omega=0.3, start=TRAINED)
            )
            scenario = ql.Scenario(
                reference=signals.Sinusoid().until(step_at, then=signals.Step(at=step_at)),
                disturbances=(0.0, load.until(TRAINED + lasts, then=0.0) if lasts else 0.0),
                noise=signals.BandLimitedNoise(power=1e-12, sample_time=0.01),
                duration=step_at + 40.0,
                rest_at=(step_at,),
            )
            run = ql.simulate(ql.plants.two_mass_spring(), controller, scenario, record_every=10)
            found = run.metrics(step_at, band=0.002)
            theta = np.zeros(4)
            if learner is not None:
                theta = run["theta"][run.window(step_at, step_at + 1.0)][0]
            settling = found["settling_time"]
            figures[f"{name}, {lasts:g} s"] = {
                "theta_1": theta[0],
                "theta_3": theta[2],
                "overshoot": found["overshoot"],
                "settling [s]": settling if math.isfinite(settling) else "it does not settle",
            }
            cells = (
                f"{theta[0]:.2f}",
                f"{theta[2]:.2f}",
                f"{found['overshoot']:.5f}",
                f"{settling:.1f}",
            )
            table.add_row(name, f"{lasts:g}", *cells)
    Console().print(table)
    write(options, figures)


if __name__ == "__main__":
    main()
