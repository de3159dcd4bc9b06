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

from .benchmark_module import benchmark

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


def test_a_known_friction_is_fed_forward_and_the_rest_is_learned() -> None:
    """LuGre's friction with the exact model leaves less than 0.6 of the error without, and with ``Kalman`` less than half of ``Kalman`` alone."""
    trial = benchmark("friction")
    plant = ql.plants.NonlinearPlant(trial.bristled, order=3, substeps=8)
    reference, observer = (
        trial.REFERENCES["two sinusoids"],
        ql.ESO.model_free(order=2, b0=2.0, omega_o=30.0, dt=trial.DT),
    )
    forces = {"nothing": 0.0, "LuGre": trial.fed_forward(reference, 5.0, trial.STATIC, 1.0)}
    found = {}
    for label, force in forces.items():
        for name in ("none", "linear"):
            controller = ql.ADRC(observer, omega_c=OMEGA_C, learner=LEARNERS[name])
            scenario = ql.Scenario(reference, 5.0, (force,))
            run = ql.simulate(plant, controller, scenario, interpret=True)
            found[label, name] = trial.rms_error(run, 2.5)
    assert found["LuGre", "none"] < 0.6 * found["nothing", "none"]
    assert found["LuGre", "linear"] < 0.5 * found["nothing", "linear"]


def test_lugres_friction_along_a_motion_is_that_of_sliding_and_gives_way_at_a_reversal() -> None:
    """Far from a reversal it is the sliding force with the sign of the speed; forces 20 % larger are 20 % larger there."""
    trial = benchmark("friction")
    reference = 0.5 * ql.signals.Sinusoid(omega=1.0)
    exact, off = (trial.fed_forward(reference, 12.0, trial.STATIC, share) for share in (1.0, 1.2))
    t = np.arange(0.0, 12.0, trial.DT)
    system = ([OMEGA_C**2, 0.0], [1.0, 2.0 * OMEGA_C, OMEGA_C**2])
    v = signal.lsim(system, reference(t), t)[1]
    fast = np.abs(v) > 0.4
    np.testing.assert_allclose(exact(t)[fast], np.sign(v[fast]), atol=5e-3)
    np.testing.assert_allclose(off(t)[fast], 1.2 * np.sign(v[fast]), atol=5e-3)
    assert np.max(np.abs(exact(t))) > 1.1  # the static force, as it begins to slide
