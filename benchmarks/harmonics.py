"""Loads of unknown frequency: one sinusoid with different initial frequencies, and two sinusoids.

python benchmarks/harmonics.py
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.experiments import two_mass_spring as study
from quell.learners import Harmonic
from quell.signals import Signal, Sinusoid

LOAD_AT, JUDGED_AT, END = 150.0, 210.0, 250.0


def peaks(learner: ql.learners.Learner | None, omegas: Sequence[float]) -> tuple[float, float]:
    """Return the largest error over the last 40 s of the study, and 240 s later.

    The load has 1 N at each of ``omegas``. A load of 1 rad/s has no effect on y, because m1 and the
    spring absorb it.
    """
    settings = study.Settings()
    paper = study.scenario(settings)
    load: Signal = Sinusoid(omega=omegas[0], start=LOAD_AT)
    for omega in omegas[1:]:
        load = load + Sinusoid(omega=omega, start=LOAD_AT)
    scenario = ql.Scenario(
        reference=paper.reference,
        disturbances=(0.0, load),
        noise=paper.noise,
        duration=END + 240.0,
        rest_at=paper.rest_at,
        seed=paper.seed,
    )
    run = ql.simulate(
        ql.plants.two_mass_spring(),
        study.controller(settings, learner=learner),
        scenario,
        record_every=10,
    )
    away = np.abs(run["y"] - 1.0)
    first, last = (
        float(away[run.window(at, at + END - JUDGED_AT)].max()) for at in (JUDGED_AT, END + 200.0)
    )
    return (math.nan, math.nan) if run.diverged else (first, last)


def main() -> None:
    """Print a table for one sinusoid, and one for two."""
    options = options_of(parser_of(__doc__))
    figures: dict[str, Any] = {"one": {}, "two": {}}
    one = Table(
        "starts at [rad/s]",
        "peak 60 s after the load, MF-ESO/500",
        title="one sinusoid, π/10 rad/s",
    )
    plain = peaks(None, (0.1 * math.pi,))
    for start in (0.5,) if options.quick else (0.1, 0.2, 0.3, 0.5, 1.0, 1.5, 2.0, 3.0):
        found = peaks(Harmonic(omegas=(start,)), (0.1 * math.pi,))
        figures["one"][f"starts at {start:g}"] = {"peak over MF-ESO's": found[0] / plain[0]}
        one.add_row(f"{start:g}", f"{500.0 * found[0] / plain[0]:.2f}")
    two = Table(
        "load [rad/s]",
        "MF-ESO [m]",
        "Kalman()",
        "Harmonic()",
        "Harmonic(2)",
        "the same, 300 s after",
        "with search",
        title="two sinusoids of 1 N: peak 60 s after the load came, over MF-ESO's",
    )
    for omegas in (
        (0.2, 0.4),
        (0.2, 0.6),
        (0.3, 0.6),
        (0.4, 0.8),
        (0.4, 1.3),
        (0.7, 1.4),
        (0.3, 0.4),
        (0.5, 0.7),
        (0.6, 0.8),
        (0.5, 0.6),
        (0.3, 0.36),
    )[: 1 if options.quick else None]:
        plain = peaks(None, omegas)
        shares = [
            peaks(learner, omegas)
            for learner in (ql.learners.Kalman(), Harmonic(), Harmonic(count=2))
        ]
        searched = peaks(Harmonic(count=2, search=True), omegas)
        figures["two"][", ".join(f"{omega:g}" for omega in omegas)] = {
            "MF-ESO [m]": plain[0],
            "Kalman()": shares[0][0] / plain[0],
            "Harmonic()": shares[1][0] / plain[0],
            "Harmonic(2)": shares[2][0] / plain[0],
            "Harmonic(2), 300 s after": shares[2][1] / plain[1],
            "with search": searched[0] / plain[0],
        }
        two.add_row(
            ", ".join(f"{omega:g}" for omega in omegas),
            f"{plain[0]:.3f}",
            *(f"{share[0] / plain[0]:.4f}" for share in shares),
            f"{shares[-1][1] / plain[1]:.4f}",
            f"{searched[0] / plain[0]:.4f}",
        )
    console = Console(width=120)
    console.print(one)
    console.print(two)
    write(options, figures)


if __name__ == "__main__":
    main()
