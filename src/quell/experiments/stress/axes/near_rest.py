"""Settling near rest: a learner whose features change with every small motion.

On the paper's study (``experiments.two_mass_spring``) MF-ESO takes a unit step from rest, after
110 s of training. The learner is ``RLS`` with 30 random Fourier features of the state. Near rest q
is small, and an authority that changes can shake a loop that would come to rest: no RMS error
shows that. Settling time (to ±0.2 %) and overshoot are each the mean over the draws of the noise.
The guarded loop is compared with the *better* of the loops without learner and without guard, for
each of the two measures.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from quell.controllers import ADRC
from quell.experiments.common.scores import step_scores
from quell.experiments.two_mass_spring import setup
from quell.features import RandomFourier
from quell.guard import Guard
from quell.learners import RLS, Learner
from quell.plants import two_mass_spring
from quell.simulation.simulate import simulate

FEATURES = 30
"""Number of random Fourier features."""


class Settling(NamedTuple):
    """How a step ends, in means over draws of the noise."""

    time: float  #: settling time [s]; infinite if one of the runs does not settle
    overshoot: float  #: as a fraction of the step


class RestOutcome(NamedTuple):
    """The steps with one draw of the features."""

    features: int  #: seed of the features
    guarded: Settling
    unguarded: Settling
    plain: Settling  #: without learner
    other_noise: Settling  #: the same, with other draws of the noise

    @property
    def longer(self) -> float:
        """Settling time of the guarded loop over that of the better of the two others."""
        return self.guarded.time / min(self.unguarded.time, self.plain.time)

    @property
    def further(self) -> float:
        """Overshoot of the guarded loop less that of the better of the two others."""
        return self.guarded.overshoot - min(self.unguarded.overshoot, self.plain.overshoot)


def settle(learner: Learner | None, guard: Guard | None, draws: range) -> Settling:
    """Return how the step ends, in the mean over these draws of the noise."""
    found = []
    for seed in draws:
        settings = setup.Settings(seed=seed)
        observer = setup.controller(settings).observer
        controller = ADRC(observer, settings.omega_c, learner=learner, guard=guard)
        scenario = replace(setup.scenario(settings), duration=setup.FORCE_AT)
        run = simulate(two_mass_spring(), controller, scenario, record_every=10)
        if run.diverged:
            return Settling(math.inf, math.inf)
        part = run.window(*setup.STEP_WINDOW)
        scores = step_scores(run.t[part], run["y"][part], 1.0, setup.BAND)
        pair = scores["settling_time"], scores["overshoot"]
        found.append([math.inf if value is None else value for value in pair])
    return Settling(*np.mean(found, axis=0).tolist())


def run_one(features: int, draws: int, guard: Guard | None) -> RestOutcome:
    """Run the steps with the features of a seed, for so many draws of the noise."""
    learner = RLS(features=RandomFourier(FEATURES, seed=features))
    usual = range(draws)
    unguarded = settle(learner, None, usual)
    return RestOutcome(
        features=features,
        guarded=unguarded if guard is None else settle(learner, guard, usual),
        unguarded=unguarded,
        plain=settle(None, None, usual),
        other_noise=settle(None, None, range(draws, 2 * draws)),
    )
