"""In which range of learning rates Algorithm 1 is stable, in the scenario of the two-mass study."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from quell.learners import BatchGradient

if TYPE_CHECKING:
    from quell.experiments.two_mass_spring import Settings

BATCHES = (1, 10, 1000)
RATES = tuple(float(rate) for rate in np.geomspace(1e-3, 1.0, 13))
"""rate · batch / dt [1/s]: how fast θ moves, whatever the sample time and the batch."""


@dataclass(frozen=True)
class Trial:
    """One run of Algorithm 1."""

    batch: int
    rate: float
    """rate · batch / dt [1/s]."""
    stable: bool
    ended: float
    """When the run ended [s]."""
    overshoot: float | None
    disturbance_peak: float | None


def trials(settings: Settings, tell: Callable[[str, float], None], rates: Sequence[float] = RATES) -> tuple[Trial, ...]:
    """Run Algorithm 1 with every batch and rate."""
    from quell.experiments.two_mass_spring import controller, in_parallel, quick_run, score

    def trial(batch: int, rate: float) -> Trial:
        run = quick_run(settings, controller(settings, learner=BatchGradient(rate * settings.dt / batch, batch)))
        found = score(run)
        return Trial(batch, rate, not run.status, run.ended, found["overshoot"], found["disturbance_peak"])

    cases = [(batch, rate) for batch in BATCHES for rate in rates]
    done = []
    for i in range(0, len(cases), 13):
        tell("learning rates", i / len(cases))
        done += in_parallel([partial(trial, *case) for case in cases[i : i + 13]])
    tell("learning rates", 1.0)
    return tuple(done)


def stable_below(found: Sequence[Trial], batch: int) -> float | None:
    """Return the largest rate up to which every trial with ``batch`` was stable [1/s]; None where not even the least was."""
    largest = None
    for trial in sorted((t for t in found if t.batch == batch), key=lambda t: t.rate):
        if not trial.stable:
            break
        largest = trial.rate
    return largest
