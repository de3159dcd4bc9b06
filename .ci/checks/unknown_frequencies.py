"""Loads of unknown frequencies are rejected; Algorithm 1 does no harm behind the guard."""

from dataclasses import replace
from functools import partial
from math import pi

import numpy as np

import quell as ql
from quell.experiments import two_mass_spring as study
from quell.parallel import in_parallel

settings, at, Sine, Harmonic = (
    study.Settings(),
    study.FORCE_AT,
    ql.signals.Sinusoid,
    ql.learners.Harmonic,
)
observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=settings.dt)


def late_peak(scenario, learner=None, guard=None):
    """Return the peak of y - 1 after 210 s."""
    law = ql.ADRC(observer, omega_c=1.0, learner=learner, guard=guard)
    run = ql.simulate(ql.plants.two_mass_spring(), law, scenario, record_every=10)
    return np.max(np.abs(run["y"][run.window(210.0, 250.1)] - 1.0))


def worst_share(scenario, learners, guards=(None,)):
    """Return the largest of those peaks over MF-ESO's."""
    others = [
        partial(late_peak, scenario, learner, guard) for learner in learners for guard in guards
    ]
    plain, *found = in_parallel([partial(late_peak, scenario), *others])
    return max(found) / plain


for slow, fast, size in ((0.1 * pi, 0.8, 0.5), (0.3, 1.3, 1.0), (0.27, 0.69, 0.9)):
    load = Sine(omega=slow, start=at) + Sine(size, fast, start=at) + 0.5 * ql.signals.Step(at=at)
    found = worst_share(
        replace(study.scenario(settings), disturbances=(0.0, load)), [Harmonic(count=2)]
    )
    assert found <= 1.0 / 50.0, (slow, fast, found)
starts = [Harmonic(omegas=(start,)) for start in (0.1, 0.17, 0.3, 0.55, 1.0, 1.7, 3.0)]
found = worst_share(study.scenario(settings), starts, (None, ql.Guard()))
assert found <= 1.0 / 500.0, found
print("frequencies a factor of two apart are found, and one from any start, guarded, too")


def rms(rate):
    """RMS error from the step on, with Algorithm 1 at a rate per sample."""
    learner = None if rate is None else ql.learners.BatchGradient(rate=rate)
    guard = None if rate is None else ql.Guard()
    law = ql.ADRC(observer, omega_c=1.0, learner=learner, guard=guard)
    return study.score(study.quick_run(settings, law))["rms_from_step"]


plain, *found = in_parallel(
    [partial(rms, rate) for rate in (None, *10.0 ** np.arange(-7.0, 0.5, 0.5))]
)
assert max(found) <= 1.1 * plain, (plain, found)
print("Algorithm 1 at any rate is as good as MF-ESO behind the guard")
