"""Figures of learners and guard on the benchmark.

The trial of hostile and of honest learners, with its bars, is a command, ``quell stress``, of which ``.ci/run``
runs a part; loads of two sinusoids and a step are rejected there, too.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

import quell as ql
from quell.experiments.two_mass_spring import setup as study
from quell.parallel import in_parallel

pytestmark = pytest.mark.compiled

SETTINGS = study.Settings()


def late_peaks(learners: list[object], guard: ql.Guard | None, scenario: ql.Scenario) -> np.ndarray:
    """Return the peaks of y − 1 after 210 s, relative to MF-ESO's."""
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=SETTINGS.dt)

    def peak(learner: object) -> float:
        controller = ql.ADRC(
            observer, omega_c=1.0, learner=learner, guard=guard if learner else None
        )
        run = ql.simulate(ql.plants.two_mass_spring(), controller, scenario, record_every=10)
        return float(np.max(np.abs(run["y"][run.window(210.0, 250.1)] - 1.0)))

    plain, *learned = in_parallel([partial(peak, learner) for learner in (None, *learners)])
    return np.array(learned) / plain


@pytest.mark.parametrize("guard", [None, ql.Guard()])
def test_a_load_of_unknown_frequency_is_rejected_to_a_five_hundredth(
    guard: ql.Guard | None,
) -> None:
    """The paper's scenario, from any start."""
    learners = [
        ql.learners.Harmonic(omegas=(start,)) for start in (0.1, 0.17, 0.3, 0.55, 1.0, 1.7, 3.0)
    ]
    assert np.max(late_peaks(learners, guard, study.scenario(SETTINGS))) <= 1.0 / 500.0


def test_algorithm_1_is_harmless_at_any_rate_behind_the_guard() -> None:
    """Rates from 1e-7 to 1 a sample: RMS error from the step on at most 1.1 times MF-ESO's."""
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=SETTINGS.dt)

    def rms(rate: float | None) -> float:
        learner = None if rate is None else ql.learners.BatchGradient(rate)
        controller = ql.ADRC(
            observer, omega_c=1.0, learner=learner, guard=None if rate is None else ql.Guard()
        )
        return study.score(study.quick_run(SETTINGS, controller))["rms_from_step"]

    plain, *found = in_parallel(
        [partial(rms, rate) for rate in (None, *10.0 ** np.arange(-7.0, 0.5, 0.5))]
    )
    assert max(found) <= 1.1 * plain
