"""Linear laws and frozen learners."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell import analysis
from quell.learners.base import predict
from tests.analysed_loops import LEARNED, TRAINING, Held, adrc, chain


@pytest.mark.parametrize("learner", [None, Held(LEARNED, 0.1, 0.3)])
@pytest.mark.parametrize("form", ["current", "predictor"])
def test_a_law_does_what_the_controller_does_at_its_limits_too(form: str, learner: Any) -> None:
    """It is told the applied u, as the observer is: fed with the run's y and u, it wishes what the controller applied or had cut."""
    controller = adrc(3, form, learner=learner, u_min=-1.0, u_max=1.6)
    run = ql.simulate(
        chain(3),
        controller,
        ql.Scenario(reference=ql.signals.Sinusoid(amplitude=2.0, omega=1.0), duration=10.0),
    )
    law = analysis.linear_law(controller)
    assert np.any(run["u"] == 1.6)
    assert np.any(run["u"] == -1.0)
    x = np.zeros(law.A.shape[0])
    for r, y, u in zip(run["r"], run["y"], run["u"], strict=True):
        wished = law.C @ x + law.D_r * r + law.D_y * y
        assert min(max(wished, -1.0), 1.6) == pytest.approx(u, abs=1e-9)
        x = law.A @ x + law.B_r * r + law.B_y * y + law.B_u * u


def test_a_law_that_changes_from_sample_to_sample_is_refused(monkeypatch: Any) -> None:
    """The gain of this learner grows a little with each call."""
    learner, calls = analysis.Frozen(np.ones(4), 0.0, 0.0), itertools.count()

    def grow(learner: Any, memory: Any, seen: Any, u_before: float) -> tuple[float, float]:
        return (1.0 + 1e-6 * next(calls)) * float(learner.gain @ seen), 0.0

    analysis.linear_law(adrc(3), learner)
    monkeypatch.setitem(predict.implementations, analysis.Frozen, grow)
    with pytest.raises(ValueError, match="changes from sample to sample"):
        analysis.linear_law(adrc(3), learner)


@pytest.mark.parametrize(
    "learner", [ql.learners.Kalman(), ql.learners.Kalman(u=True), ql.learners.Harmonic()]
)
def test_what_the_record_says_of_a_learner_is_what_its_state_says(learner: Any) -> None:
    """For learners that are linear in state and u, θ is the gain, whatever they call the bias or add as a feedforward."""
    controller = adrc(2, learner=learner)
    run = ql.simulate(chain(2), controller, TRAINING)
    recorded, final = analysis.frozen(controller, run, 10.0), analysis.frozen(controller, run)
    np.testing.assert_allclose(recorded.gain, final.gain, atol=1e-8 * np.max(np.abs(final.gain)))
    assert recorded.slope == pytest.approx(final.slope, rel=1e-9)
    assert recorded.gain[0] == pytest.approx(-1.0, abs=0.6)


@pytest.mark.trial
def test_a_guard_s_authority_scales_what_is_fed_back() -> None:
    """At 8 s the learner is only half heard."""
    controller = ql.ADRC(
        adrc(2).observer, omega_c=2.0, learner=ql.learners.Kalman(), guard=ql.Guard(time=10.0)
    )
    run = ql.simulate(chain(2), controller, replace(TRAINING, duration=20.0))
    authority = run["authority"]
    half = int(np.flatnonzero((authority > 0.1) & (authority < 0.9))[0])
    np.testing.assert_allclose(
        analysis.frozen(controller, run, run.t[half]).gain[:2],
        authority[half] * run["theta"][half, :2],
    )
    assert not np.any(analysis.frozen(controller, run, 0.0).gain)


@pytest.mark.trial
def test_a_network_is_what_it_is_for_small_motions() -> None:
    """Its gains are the slope of its own prediction, and asking for them leaves it as it was."""
    controller = adrc(2, learner=ql.learners.MLP(hidden=4))
    run = ql.simulate(chain(2), controller, TRAINING)
    memory, before = (
        run.final_state.learner,
        [array.copy() for array in run.final_state.learner.model],
    )
    gain = analysis.frozen(controller, run).gain
    seen, small = run.final_state.estimates, np.array([1e-5, -2e-5, 0.0])
    moved = [
        predict(controller.parameters.learner, memory, seen + sign * small, 0.0)[0]
        for sign in (1.0, -1.0)
    ]
    assert 0.5 * (moved[0] - moved[1]) == pytest.approx(gain @ small, rel=1e-5)
    assert np.any(gain != 0.0)
    for array, old in zip(memory.model, before, strict=True):
        np.testing.assert_array_equal(array, old)
    (loop,) = analysis.loops_over_time(chain(2), controller, TRAINING, [10.0])
    np.testing.assert_allclose(loop.poles, analysis.analyse(chain(2), controller, at=run).poles)


def test_a_learner_that_knows_the_plant_leaves_the_poles_of_the_design() -> None:
    """There are n at −omega_c, as with a model; the observer's are those of the plant with the model-free gain, not all at −omega_o."""
    loop = analysis.analyse(chain(2), adrc(2, learner=Held([-1.0, -2.0], 0.0, 0.3), dt=1e-4))
    observer = np.array([[-36.0, 1.0, 0.0], [-1.0 - 432.0, -2.0, 1.0], [-1728.0, 0.0, 0.0]])
    poles = loop.s_poles[np.isfinite(loop.s_poles)]
    np.testing.assert_allclose(
        np.poly(poles), np.polymul([1.0, 4.0, 4.0], np.poly(observer)), rtol=5e-3
    )


@pytest.mark.trial
def test_margins_over_time_are_those_of_each_instant() -> None:
    """From the record; the same from the scenario, simulated up to there."""
    controller = adrc(2, learner=ql.learners.Kalman())
    run = ql.simulate(chain(2), controller, TRAINING, record_every=10)
    times = [1.0, 4.0, 10.0]
    recorded, again = (
        analysis.loops_over_time(chain(2), controller, source, times) for source in (run, TRAINING)
    )
    modulus = [loop.margins.modulus for loop in recorded]
    np.testing.assert_allclose(modulus, [loop.margins.modulus for loop in again], rtol=1e-7)
    assert modulus[0] != pytest.approx(modulus[2], rel=1e-3)


@pytest.mark.parametrize("block", [ql.features.Polynomial(2), ql.features.Periodic(orders=(3,))])
def test_a_feature_that_is_not_linear_needs_more_than_its_coefficient(block: Any) -> None:
    """The record of θ does not do; the state at the end of a run does."""
    controller = adrc(2, learner=ql.learners.RLS(block))
    run = ql.simulate(chain(2), controller, replace(TRAINING, duration=4.0), interpret=True)
    with pytest.raises(ValueError, match=r"is not linear.*pass the scenario to loops_over_time,"):
        analysis.frozen(controller, run, 3.0)
    assert np.any(analysis.frozen(controller, run).gain != 0.0)
