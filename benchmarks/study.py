"""Ranges of the results of the two-mass study over ten seeds and four sample times.

Also of L-ESO with its bias or its states only, and of observers that estimate f and f'.

python benchmarks/study.py
"""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from quell.experiments import two_mass_spring as study
from quell.learners import Kalman

COLUMNS = ("overshoot", "settling_time", "disturbance_peak", "control_variation")
PARTS = {"L-ESO, bias only": Kalman(state=False), "L-ESO, states only": Kalman(bias=False)}


def main() -> None:
    """Run the main controllers with every seed and sample time, L-ESO also without reset."""
    table = Table("dt [s]", "controller", *COLUMNS)
    names = (study.MF, study.MB, study.L, *PARTS, study.MF3, study.MF_2, study.MB_2)
    cases = [(name, True) for name in names] + [(study.L, False)]
    for dt in (1e-3, 2e-3, 5e-3, 1e-2):
        for name, reset in cases:
            found = []
            for seed in range(10):
                settings = study.Settings(dt=dt, seed=seed, reset=reset)
                controllers = study.controllers(settings) | {
                    part: study.controller(settings, learner=learner)
                    for part, learner in PARTS.items()
                }
                run = study.simulate(
                    study.two_mass_spring(), controllers[name], study.scenario(settings)
                )
                found.append(study.score(run))
            ranges = [
                f"{min(s[c] for s in found):.5g} – {max(s[c] for s in found):.5g}" for c in COLUMNS
            ]
            table.add_row(f"{dt:g}", name if reset else f"{name}, no reset", *ranges)
    Console().print(table)


if __name__ == "__main__":
    main()
