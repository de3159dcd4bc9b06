"""A nonlinear learner against friction and a stiffening spring, where a linear one can do little (benchmarks/friction.py)."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy import signal

import quell as ql
from quell.features import Bias, Friction, Polynomial, State

pytestmark = pytest.mark.trial

OMEGA_C = 5.0
LEARNERS: dict[str, Any] = {
    "none": None,
    "linear": ql.learners.Kalman(),
    "friction": ql.learners.RLS(State() + Polynomial() + Friction() + Bias()),
}


def stage(t: float, x: np.ndarray, u: float, w: np.ndarray) -> tuple[float, float]:
    """A mass on a spring that stiffens, with friction."""
    return x[1], 2.0 * u - x[0] - 2.0 * x[0] ** 3 - math.tanh(x[1] / 0.05)


PLANT = ql.plants.NonlinearPlant(stage, order=2, substeps=2)


@cache
def error(name: str) -> float:
    """RMS of y less the ideal closed loop's response, from 8 s on.

    As Python: to compile three loops takes longer.
    """
    s = ql.signals
    controller = ql.ADRC(
        ql.ESO.model_free(order=2, b0=2.0, omega_o=30.0, dt=1e-2),
        omega_c=OMEGA_C,
        learner=LEARNERS[name],
    )
    reference = 0.5 * s.Sinusoid(omega=1.0) + 0.3 * s.Sinusoid(omega=2.3)
    scenario = ql.Scenario(reference, 16.0, noise=s.BandLimitedNoise(1e-12, 0.01))
    run = ql.simulate(PLANT, controller, scenario, interpret=True)
    ideal = signal.lsim(([OMEGA_C**2], [1.0, 2.0 * OMEGA_C, OMEGA_C**2]), run["r"], run.t)[1]
    return float(np.sqrt(np.mean((run["y"] - ideal)[run.t >= 8.0] ** 2)))


def test_a_nonlinear_learner_rejects_friction_better_than_a_linear_one() -> None:
    """And a linear one better than none; the benchmark has a network, too."""
    assert error("linear") < error("none")
    assert error("friction") <= 0.25 * error("linear")
