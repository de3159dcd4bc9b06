"""The guard's trial on flexible axes: loops within their ranges, paired draws of the noise, plain data."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse
from quell.experiments.stress import axes
from quell.experiments.stress.axes import loops, trial
from quell.experiments.stress.axes.trial import AxesResult, AxisErrors, AxisOutcome
from tests.commands import Shown


@pytest.mark.parametrize("structure", axes.STRUCTURES)
def test_axes_are_drawn_within_their_ranges(structure: str, rng: np.random.Generator) -> None:
    """Each has the margin that it states, the model that its structure asks for, and the same loop again for the same seed."""
    axis = axes.draw_axis(rng, structure)
    found = analyse(axis.linear, axis.controller(), delay=loops.DT)
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


def test_a_trial_is_paired_and_plain_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short runs: without learner in both loops the ratios are one to the bit; results are for ``json.dump``."""
    monkeypatch.setattr(loops, "_RUN_LAGS", 4.0)
    monkeypatch.setattr(loops, "_PERIODS", 0.1)
    monkeypatch.setattr(trial, "DRAWS", 2)
    monkeypatch.setattr(trial, "HONEST", {"none": None, "Kalman": ql.learners.Kalman()})
    result = axes.run(2, 3, guard=None)
    assert [outcome.learner for outcome in result.outcomes] == ["none", "Kalman"]
    assert result.outcomes[0].unguarded == AxisErrors(1.0, 1.0)
    assert result.outcomes[0].chance != AxisErrors(1.0, 1.0)
    assert all(bar.figure is not None for bar in result.bars())
    found = result.to_json()
    assert json.loads(json.dumps(found)) == found
    assert found["all"]["loops"] == 2


def outcome(guarded: float, unguarded: float) -> AxisOutcome:
    """A loop with these ratios."""
    ratios = (AxisErrors(ratio, ratio) for ratio in (guarded, unguarded, 1.001))
    return AxisOutcome("Kalman", "a loop", "model-free", "motor", *ratios)


def test_bars_tell_harm_and_lost_benefit() -> None:
    """The largest ratio to no learner, and the median over the unguarded loop, which is zero where that is lost."""
    result = AxesResult({}, [outcome(0.3, 0.2), outcome(1.5, 1.0), outcome(0.9, math.inf)])
    lost, rms, late, over, _ = result.bars()
    assert (lost.figure, lost.met) == (0, True)
    assert (rms.figure, rms.met, rms.other_noise) == (1.5, False, 1.001)
    assert late.figure == 1.5
    assert over.figure == pytest.approx(1.5)
    assert not over.met
    assert AxesResult({}, [outcome(math.inf, 1.0)]).bars()[0].figure == 1
    assert AxesResult({}, []).bars() == []


def test_the_trial_on_axes_has_no_hostile_learners(quell: Callable[..., Any]) -> None:
    """Their number is refused."""
    shown: Shown = quell("stress", "--loops", "axes", "--runs", "3")
    assert shown.code == 2
    assert "runs = 3: the trial on axes has no hostile learners" in shown.err
