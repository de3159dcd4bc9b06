"""The time until Algorithm 1 diverges, in the two-mass study's scenario, ten times as long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from quell.experiments.two_mass_spring.setup import END, Settings, controller, scenario, score
from quell.learners import BatchGradient
from quell.parallel import in_parallel
from quell.plants import two_mass_spring
from quell.simulation.simulate import simulate
from quell.types import Progress

BATCHES = (1, 10, 1000)
"""Samples in a batch: chosen by hand, to show that the limit does not depend on it."""
RATES = tuple(float(rate) for rate in np.geomspace(1e-3, 1.0, 13))
"""rate · batch / dt [1/s], the speed of θ: a range around the limit of 0.015/s."""
HORIZON = 2500.0  # duration of a run that does not diverge [s]: ten times that of the study


@dataclass(frozen=True)
class Trial:
    """One run of Algorithm 1."""

    batch: int
    rate: float  #: rate · batch / dt [1/s]
    ended: float  #: end of the run [s]: ``HORIZON``, or the time of divergence
    stable: bool  #: true if the run did not diverge within the study's duration
    disturbance_peak: float | None


def trials(
    settings: Settings, progress: Progress, rates: Sequence[float] = RATES
) -> tuple[Trial, ...]:
    """Run Algorithm 1 with every batch and rate.

    The sample time is 10 ms if the observer allows it: the result depends on the rate per second,
    not per sample.
    """
    coarse = replace(settings, dt=max(settings.dt, min(0.01, 0.1 / settings.omega_o)))
    plant, long = two_mass_spring(), replace(scenario(coarse), duration=HORIZON)
    every = max(round(0.1 / coarse.dt), 1)

    def trial(batch: int, rate: float) -> Trial:
        learner = BatchGradient(rate=rate * coarse.dt / batch, batch=batch)
        run = simulate(plant, controller(coarse, learner=learner), long, record_every=every)
        return Trial(batch, rate, run.ended, run.ended > END, score(run)["disturbance_peak"])

    cases = [(batch, rate) for batch in BATCHES for rate in rates]
    done = []
    for i in range(0, len(cases), len(rates)):
        progress("learning rates", i / len(cases))
        done += in_parallel([partial(trial, *case) for case in cases[i : i + len(rates)]])
    progress("learning rates", 1.0)
    return tuple(done)


def stable_up_to(found: Sequence[Trial], batch: int) -> float | None:
    """Return the largest rate up to which all trials with ``batch`` are stable [1/s], or None."""
    largest = None
    for trial in sorted((t for t in found if t.batch == batch), key=lambda t: t.rate):
        if not trial.stable:
            break
        largest = trial.rate
    return largest
