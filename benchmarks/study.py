"""Ranges of the results of the two-mass study over ten seeds and four sample times.

python benchmarks/study.py
"""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from quell.experiments.two_mass_spring import setup as study

COLUMNS = ("overshoot", "settling_time", "disturbance_peak", "control_variation")


def main() -> None:
    """Run the main controllers with every seed and sample time, L-ESO also without reset."""
    table = Table("dt [s]", "controller", *COLUMNS)
    cases = [(name, True) for name in (study.MF, study.MB, study.L, study.MF3)] + [(study.L, False)]
    for dt in (1e-3, 2e-3, 5e-3, 1e-2):
        for name, reset in cases:
            found = []
            for seed in range(10):
                settings = study.Settings(dt=dt, seed=seed, reset=reset)
                run = study.simulate(
                    study.two_mass_spring(),
                    study.controllers(settings)[name],
                    study.scenario(settings),
                )
                found.append(study.score(run))
            ranges = [
                f"{min(s[c] for s in found):.5g} – {max(s[c] for s in found):.5g}" for c in COLUMNS
            ]
            table.add_row(f"{dt:g}", name if reset else f"{name}, no reset", *ranges)
    Console().print(table)


if __name__ == "__main__":
    main()
