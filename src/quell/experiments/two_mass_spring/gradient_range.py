"""How long Algorithm 1 lasts at which learning rate, in the scenario of the two-mass study drawn out to ten times its length."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from quell.experiments.two_mass_spring import setup as setting
from quell.learners import BatchGradient
from quell.parallel import in_parallel
from quell.plants import two_mass_spring
from quell.simulation.simulate import simulate

BATCHES = (1, 10, 1000)
RATES = tuple(float(rate) for rate in np.geomspace(1e-3, 1.0, 13))
"""rate · batch / dt [1/s]: how fast θ moves, whatever the sample time and the batch."""
HORIZON = 2500.0
"""How long a run goes on [s], if it does."""


@dataclass(frozen=True)
class Trial:
    """One run of Algorithm 1."""

    batch: int
    rate: float
    """rate · batch / dt [1/s]."""
    ended: float
    """When the run ended [s]: ``HORIZON``, or where it diverged."""
    stable: bool
    """Whether it outlasted the study."""
    disturbance_peak: float | None


def trials(
    settings: setting.Settings,
    progress: Callable[[str, float], None],
    rates: Sequence[float] = RATES,
) -> tuple[Trial, ...]:
    """Run Algorithm 1 with every batch and rate.

    At a sample time of 10 ms, where the observer allows it: what happens depends on the rate a second, not a sample.
    """
    coarse = replace(settings, dt=max(settings.dt, min(0.01, 0.1 / settings.omega_o)))
    plant, what = two_mass_spring(), replace(setting.scenario(coarse), duration=HORIZON)
    every = max(round(0.1 / coarse.dt), 1)

    def trial(batch: int, rate: float) -> Trial:
        candidate = setting.controller(
            coarse, learner=BatchGradient(rate * coarse.dt / batch, batch)
        )
        run = simulate(plant, candidate, what, record_every=every)
        return Trial(
            batch, rate, run.ended, run.ended > setting.END, setting.score(run)["disturbance_peak"]
        )

    cases = [(batch, rate) for batch in BATCHES for rate in rates]
    done = []
    for i in range(0, len(cases), len(rates)):
        progress("learning rates", i / len(cases))
        done += in_parallel([partial(trial, *case) for case in cases[i : i + len(rates)]])
    progress("learning rates", 1.0)
    return tuple(done)


def stable_up_to(found: Sequence[Trial], batch: int) -> float | None:
    """Return the largest rate up to which every trial with ``batch`` outlasted the study [1/s]; None where not even the least did."""
    largest = None
    for trial in sorted((t for t in found if t.batch == batch), key=lambda t: t.rate):
        if not trial.stable:
            break
        largest = trial.rate
    return largest
