"""The guard's trial on flexible axes: loops within their ranges, paired draws of the noise, plain data."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse
from quell.experiments.stress import axes, study
from quell.experiments.stress.axes import AxesResult, AxisErrors, AxisOutcome, RestOutcome, Settling
from quell.plants.base import advance
from tests.commands import Shown


@pytest.mark.trial
@pytest.mark.parametrize("structure", axes.STRUCTURES)
def test_axes_are_drawn_within_their_ranges(structure: str, rng: np.random.Generator) -> None:
    """Each has the margin that it states, the model that its structure asks for, and the same loop again for the same seed."""
    axis = axes.draw_axis(rng, structure)
    found = analyse(axis.linear, axis.controller(), delay=axes.DT)
    assert found.stable
    assert found.margins.modulus == pytest.approx(axis.margin)
    assert axis.margin >= 0.45
    assert 3.0 <= axis.omega_o / axis.omega_c <= 8.0
    assert 0.3 <= axis.inertias[-1] / axis.inertias[0] <= 10.0
    assert 1.0 <= axis.frequency <= 16.0
    at_motor, observer = axis.sensor == "motor", axis.observer
    if structure == "model-free":
        assert (observer.order, observer.degree) == ((2, 2) if at_motor else (4, 4))
    else:
        assert observer.order == 2 * len(axis.inertias)
        assert (observer.degree < observer.order) == at_motor
    assert axis.describe().startswith(f"{len(axis.inertias)} inertias")
    one, again = (axes.draw_axis(np.random.default_rng(3)) for _ in range(2))
    assert one.describe() == again.describe()


@pytest.mark.trial
def test_a_trial_is_paired_and_plain_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short runs: without learner in both loops the ratios are one to the bit; results are for ``json.dump``."""
    monkeypatch.setattr(axes, "_RUN_LAGS", 4.0)
    monkeypatch.setattr(axes, "_PERIODS", 0.1)
    monkeypatch.setattr(study, "USUAL", range(2))
    monkeypatch.setattr(study, "OTHERS", range(2, 4))
    monkeypatch.setattr(axes, "_DURATION", 0.2)
    monkeypatch.setattr(axes, "_JUDGED_AT", 0.1)
    monkeypatch.setattr(axes, "settle", lambda learner, guard, draws: Settling(16.6, 0.004))
    monkeypatch.setattr(axes, "HONEST", {"none": None, "Kalman": ql.learners.Kalman()})
    result = axes.run(2, 3, guard=None)
    assert [outcome.learner for outcome in result.outcomes] == ["none", "Kalman"]
    assert result.outcomes[0].unguarded == AxisErrors(1.0, 1.0)
    assert result.outcomes[0].chance != AxisErrors(1.0, 1.0)
    assert [outcome.structure for outcome in result.arms] == [
        "arm",
        "arm, b0 2.4 times too small",
    ]
    assert (result.arms[0].chance.rms, len(result.rest)) != (1.0, 0)
    assert all(bar.figure is not None for bar in result.bars())
    found = result.to_json()
    assert json.loads(json.dumps(found)) == found
    assert found["honest"]["loops"] == 2


def outcome(guarded: float, unguarded: float) -> AxisOutcome:
    """A loop with these ratios."""
    ratios = (AxisErrors(ratio, ratio) for ratio in (guarded, unguarded, 1.001))
    return AxisOutcome("Kalman", "a loop", "model-free", "motor", *ratios)


def test_bars_tell_harm_and_lost_benefit() -> None:
    """The largest ratio to no learner, and the median over the unguarded loop, which is zero where that is lost."""
    result = AxesResult({}, [outcome(0.3, 0.2), outcome(1.5, 1.0), outcome(0.9, math.inf)])
    lost, rms, late, over, *_ = result.bars()
    assert (lost.figure, lost.met) == (0, True)
    assert (rms.figure, rms.met, rms.other_noise) == (1.5, False, 1.001)
    assert late.figure == 1.5
    assert over.figure == pytest.approx(1.5)
    assert not over.met
    lost, rms, *_ = AxesResult({}, [outcome(math.inf, 1.0)]).bars()
    assert (lost.figure, rms.figure, rms.met) == (1, None, False)
    assert AxesResult({}, []).bars() == []


def test_an_arm_and_a_step_near_rest_have_bars_of_their_own() -> None:
    """The worse joint of the worst arm; settling time and overshoot beside the better of the two loops without guard or learner."""
    kind = "arm, b0 2.4 times too small"
    arms = [replace(outcome(ratio, 2.0), structure=kind) for ratio in (0.4, 1.3)]
    plain, unguarded = Settling(16.0, 0.004), Settling(11.0, 0.006)
    rest = [RestOutcome(0, Settling(12.1, 0.0045), unguarded, plain, Settling(16.8, 0.004))]
    lost, joint, slow, far = AxesResult({}, [], arms, rest).bars()
    assert (lost.figure, joint.over, joint.figure, joint.met) == (0, kind, 1.3, False)
    assert slow.figure == pytest.approx(12.1 / 11.0)
    assert slow.other_noise == pytest.approx(16.8 / 16.0)
    assert (slow.met, far.met) == (False, True)
    assert far.figure == pytest.approx(0.0005)


@pytest.mark.parametrize("too_small", axes.LEAST_MARGIN)
def test_arms_are_drawn_within_their_ranges(too_small: float, rng: np.random.Generator) -> None:
    """Each loop of an eigenvalue over the motion is stable with the margin that the arm states; b0 is the gain of each joint alone."""
    drawn = axes.draw_arm(rng, too_small)
    assert drawn.margin >= axes.LEAST_MARGIN[too_small]
    gains = drawn.gains()
    one = drawn.controller(None, None).axes[0]
    for gain in (gains.min(), float(np.median(gains)), gains.max()):
        plant = ql.plants.LinearPlant.of(([gain * one.observer.b0], [1.0, 0.0, 0.0]))
        assert analyse(plant, one).margins.modulus >= drawn.margin - 1e-3
    alone = np.linalg.inv(drawn.inertia(drawn.elbow))
    np.testing.assert_allclose(too_small * drawn.b0, np.diag(alone))
    again = (axes.draw_arm(np.random.default_rng(5), too_small) for _ in range(2))
    assert len({each.describe() for each in again}) == 1


def test_the_arm_moves_as_two_rods_do() -> None:
    """Free under gravity its energy stays the same, where that is the sum over points of the rods, of which the equations know nothing."""
    drawn = replace(axes.draw_arm(np.random.default_rng(2)), gravity=9.81)
    points = (np.arange(2000) + 0.5) / 2000.0

    def energy(x: np.ndarray) -> float:
        total = 0.0
        corner, velocity, angle, turn = np.zeros(2), np.zeros(2), 0.0, 0.0
        for i in range(2):
            angle, turn = angle + x[i], turn + x[2 + i]
            length, mass = drawn.lengths[i], drawn.masses[i]
            along = length * np.array([math.cos(angle), math.sin(angle)])
            across = length * turn * np.array([-math.sin(angle), math.cos(angle)])
            speeds = velocity[:, None] + across[:, None] * points
            heights = corner[1] + along[1] * points
            total += mass * np.mean(0.5 * np.sum(speeds**2, axis=0) + drawn.gravity * heights)
            corner, velocity = corner + along, velocity + across
        return total

    x, scratch, torque = np.array([0.4, 1.1, 0.5, -2.0]), np.zeros(24), np.zeros(2)
    plant, first = drawn.plant.sampled(axes.ARM_DT, True), energy(x)
    start = x.copy()
    for _ in range(500):
        advance(plant, x, scratch, 0.0, torque, torque)
    assert np.abs(x - start).max() > 0.5
    assert energy(x) == pytest.approx(first, abs=1e-6 * drawn.gravity)


@pytest.mark.trial
@pytest.mark.compiled
def test_a_step_of_the_paper_settles_as_published(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without learner after 16.6 s with 4.5 ‰ of overshoot (docs/theory); the learner of the trial settles sooner."""
    plain = axes.settle(None, None, range(2))
    assert plain == pytest.approx((16.61, 0.0045), rel=0.02)
    monkeypatch.setattr(axes, "USUAL", range(1))
    monkeypatch.setattr(axes, "OTHERS", range(1, 2))
    found = axes.run_near_rest(3, None)
    assert found.guarded == found.unguarded
    assert found.unguarded.time < 0.8 * plain.time
    assert (found.longer, found.further) == (1.0, pytest.approx(0.0, abs=1e-3))


def test_the_trial_on_axes_has_no_hostile_learners(quell: Callable[..., Any]) -> None:
    """Their number is refused."""
    shown: Shown = quell("stress", "--loops", "axes", "--runs", "3")
    assert shown.code == 2
    assert "runs = 3: the trial on axes has no hostile learners" in shown.err
