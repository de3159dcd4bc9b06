"""Ranges of the results of the two-mass study over ten seeds and four sample times.

Also of L-ESO with its bias or its states only, and of observers that estimate f and f'.

python benchmarks/study.py
"""

from __future__ import annotations

import math

from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

from quell.experiments import two_mass_spring as study
from quell.learners import Kalman

COLUMNS = ("overshoot", "settling_time", "disturbance_peak", "control_variation")
PARTS = {"L-ESO, bias only": Kalman(state=False), "L-ESO, states only": Kalman(bias=False)}


def main() -> None:
    """Run the main controllers with every seed and sample time, L-ESO also without reset."""
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--dt", type=float, nargs="+", default=[1e-3, 2e-3, 5e-3, 1e-2])
    options = options_of(parser, seeds=1, dt=[1e-2])
    figures: dict[str, dict[str, object]] = {}
    table = Table("dt [s]", "controller", *COLUMNS)
    names = (study.MF, study.MB, study.L, *PARTS, study.MF3, study.MF_2, study.MB_2)
    cases = [(name, True) for name in names] + [(study.L, False)]
    for dt in options.dt:
        for name, reset in cases:
            found = []
            for seed in range(options.seeds):
                settings = study.Settings(dt=dt, seed=seed, reset=reset)
                controllers = study.controllers(settings) | {
                    part: study.controller(settings, learner=learner)
                    for part, learner in PARTS.items()
                }
                run = study.simulate(
                    study.two_mass_spring(), controllers[name], study.scenario(settings)
                )
                found.append(study.score(run))
            label = name if reset else f"{name}, no reset"
            ends = {c: (min(s[c] for s in found), max(s[c] for s in found)) for c in COLUMNS}
            table.add_row(
                f"{dt:g}", label, *(f"{low:.5g} – {high:.5g}" for low, high in ends.values())
            )
            figures[f"{label}, {dt:g} s"] = {
                c: [low, high] if math.isfinite(low + high) else "does not settle"
                for c, (low, high) in ends.items()
            }
    Console().print(table)
    write(options, figures)


if __name__ == "__main__":
    main()
