"""Batches of several axes: run i is the run alone, bit for bit, and an axis of all runs is a batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.plants import LinearPlant, PlantBatch, batch

from .cases import cases

DT = 1e-3
SINES = (ql.signals.Sinusoid(0.1, 5.0), ql.signals.Sinusoid(0.2, 3.0))
NOISE = ql.signals.BandLimitedNoise(1e-11, DT)
SCENARIO = ql.Scenario(SINES, 0.4, (0.0, ql.signals.Step(at=0.2)), NOISE, rest_at=(0.1,), seed=4)


def gantry(gain: float = 5.0, lag: float = 2.0) -> LinearPlant:
    """Two axes whose drives act on both."""
    A = [[0, 1, 0, 0], [0, -lag, 0, 0], [0, 0, 0, 1], [0, 0, 0, -3]]
    B = [[0, 0], [gain, 0.5], [0, 0], [0.4, 6]]
    return LinearPlant(A, B, np.eye(4)[[0, 2]], name="gantry")


def axes(omega_c: float = 8.0, sign: float = 1.0, learner: bool = True) -> ql.Axes:
    """An ADRC with feedforward for each axis; one of them learns behind a guard."""
    parts: list[Any] = [
        (ql.learners.Harmonic(), ql.Guard()) if learner else (None, None),
        (None, None),
    ]
    made = [
        ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=DT), omega_c=omega_c, feedforward=True, learner=part, guard=guard)
        for part, guard in parts
    ]  # fmt: skip
    B0 = sign * np.array([[5.0, 0.5], [0.4, 6.0]])
    return ql.Axes(dict(zip("xy", made, strict=True)), B0=B0, u_min=-25.0, u_max=25.0)


PLANTS = batch(gantry, gain=[4.5, 5.0, 6.0], lag=2.0)


def check_run(runs: ql.BatchTrajectory, i: int, alone: ql.Trajectory) -> None:
    """Compare a run of a batch with the run alone."""
    mine = runs.run(i)
    assert mine.names == alone.names
    np.testing.assert_array_equal(mine.log, alone.log)
    for name in (
        "dt",
        "every",
        "status",
        "ended",
        "limit",
        "plant",
        "axis_names",
        "axis_features",
        "message",
    ):
        assert getattr(mine, name) == getattr(alone, name)


@pytest.mark.trial
@pytest.mark.compiled
def test_each_run_of_a_batch_is_the_run_alone() -> None:
    """In all channels, with rests, noise, a learner and a thinned record; how many threads work leaves no trace."""
    law = axes()
    runs, one = (
        ql.simulate(PLANTS, law, SCENARIO, record="all", record_every=3, workers=n) for n in (2, 1)
    )
    assert isinstance(runs, ql.BatchTrajectory)
    assert runs["y"].shape == (3, len(runs.t), 2)
    assert runs.names == one.names
    np.testing.assert_array_equal(runs.log, one.log)
    for i, plant in enumerate(PLANTS):
        check_run(runs, i, ql.simulate(plant, law, SCENARIO, record_every=3))


@pytest.mark.trial
@pytest.mark.compiled
def test_arms_with_their_own_inertia_are_batches_too() -> None:
    """Nonlinear plants and a B0 that is a function: bit for bit, in two threads."""
    robot = ql.plants.arm(lengths=(0.4, 0.3), masses=(2.0, 1.0), viscous=0.1)
    law = ql.Axes([axes(learner=False).axes[0]] * 2, M=robot.inertia, u_min=-40.0, u_max=40.0)
    scenarios = [replace(SCENARIO, seed=seed, duration=0.1, rest_at=()) for seed in (1, 2, 3)]
    runs = ql.simulate(robot, law, scenarios, record="all", workers=2)
    for i, scenario in enumerate(scenarios):
        check_run(runs, i, ql.simulate(robot, law, scenario))


def test_any_part_of_the_loop_may_differ_from_run_to_run() -> None:
    """Plants, axes with other bandwidths, and scenarios of other seeds, one for each run."""
    laws = [axes(omega_c, learner=False) for omega_c in (6.0, 8.0, 9.0)]
    scenarios = [replace(SCENARIO, seed=seed, duration=0.1, rest_at=()) for seed in (1, 2, 3)]
    runs = ql.simulate(list(PLANTS), laws, scenarios)
    assert runs.names == ("r", "y", "u", "v")
    for i, parts in enumerate(zip(PLANTS, laws, scenarios, strict=True)):
        alone = ql.simulate(*parts)
        for name in runs.names:
            np.testing.assert_array_equal(runs[name][i], alone[name])
    assert np.any(runs["y"][0] != runs["y"][1])


@pytest.mark.trial
def test_an_axis_of_all_runs_is_a_batch_of_one_axis(tmp_path: Path) -> None:
    """Its measures are those of the single runs, also from a file; the parameters of the plants stay."""
    short = replace(SCENARIO, duration=0.2, rest_at=())
    runs = ql.simulate(PLANTS, axes(learner=False), short)
    runs.save(tmp_path / "runs.nc")
    again = ql.BatchTrajectory.load(tmp_path / "runs.nc")
    np.testing.assert_array_equal(again.log, runs.log)
    assert again.axis_names == ("x", "y")
    for some in (runs, again):
        np.testing.assert_array_equal(some.parameters["gain"], [4.5, 5.0, 6.0])
        measures = some.metrics(0.05)
        for i in range(3):
            expected = ql.simulate(PLANTS[i], axes(learner=False), short).metrics(0.05)
            for name in ("x", "y"):
                for measure in ("rms", "peak_error", "total_variation"):
                    assert measures[name][measure][i] == expected[name][measure]
        np.testing.assert_array_equal(some.axis("y")["y"], runs["y"][..., 1])
        np.testing.assert_array_equal(some.axis("y")["u"], runs["v"][..., 1])
    assert runs.to_xarray()["y"].dims == ("run", "time", "y_index")
    ql.simulate(gantry(), axes(learner=False), short).save(tmp_path / "one.nc")
    with pytest.raises(ValueError, match="it was not written by BatchTrajectory.save"):
        ql.BatchTrajectory.load(tmp_path / "one.nc")


def test_batches_run_in_single_precision_too() -> None:
    """Bit for bit as the run alone; axes that are single already, too."""
    short = replace(SCENARIO, duration=0.02, rest_at=())
    law = axes(learner=False)
    runs = ql.simulate(PLANTS, law, short, precision="single", record="all")
    for i, plant in enumerate(PLANTS):
        check_run(runs, i, ql.simulate(plant, law, short, precision="single"))
    given = ql.simulate(PLANTS, ql.controllers.in_single_precision(law), short)
    np.testing.assert_array_equal(given["y"], runs["y"])
    assert np.any(runs["u"] != ql.simulate(PLANTS, law, short)["u"])


@pytest.mark.lost
def test_a_run_that_diverges_ends_alone() -> None:
    """The others reach the end; its samples are NaN from there on, and its measures those up to there."""
    laws = [axes(learner=False), axes(sign=-1.0, learner=False)]
    long = replace(SCENARIO, duration=0.5, rest_at=())
    runs = ql.simulate(gantry(), laws, long, limit=0.3)
    assert runs.diverged.tolist() == [False, True]
    assert np.all(np.isnan(runs["y"][1, runs.lengths[1] :]))
    np.testing.assert_array_equal(
        runs.run(1)["y"], ql.simulate(gantry(), laws[1], long, limit=0.3)["y"]
    )
    assert "1 of 2 runs" in runs.message
    ends = runs.metrics(0.45)["x"]
    assert np.isnan(ends["rms"][1])
    assert ends["rms"][0] > 0.0


def test_state_feedback_runs_in_batches() -> None:
    """Without axes: channels are compared, and measures of axes are refused."""
    plant = gantry()
    B = np.array([[0, 0], [5, 0.5], [0, 0], [0.4, 6]])
    A = np.array([[0, 1, 0, 0], [0, -2, 0, 0], [0, 0, 0, 1], [0, 0, 0, -3]])
    observer = ql.ESO.state_space(A, B, np.eye(4)[[0, 2]], B, omega_o=60.0, dt=DT)
    law = ql.controllers.StateFeedback(observer, ql.controllers.state_feedback(A, B, 8.0, DT))
    short = replace(SCENARIO, duration=0.05, rest_at=())
    runs = ql.simulate([plant] * 2, law, short)
    np.testing.assert_array_equal(runs["y"][1], ql.simulate(plant, law, short)["y"])
    with pytest.raises(ValueError, match="which has no axes"):
        runs.axis(0)


def test_a_plot_has_two_rows_of_axes() -> None:
    """Outputs and v, a column for each axis; another number of matplotlib axes is refused."""
    import matplotlib.pyplot as plt

    runs = ql.simulate(PLANTS, axes(learner=False), replace(SCENARIO, duration=0.02, rest_at=()))
    drawn = runs.plot()
    assert [ax.get_title() for ax in drawn[:2]] == [
        "x: 3 runs, 0 diverged",
        "y: 3 runs, 0 diverged",
    ]
    with pytest.raises(ValueError, match="axes: must be 4 matplotlib axes, got 1"):
        runs.plot(ax=plt.figure().subplots())
    plt.close("all")


@cases(
    ("call", "message"),
    [
        (partial(ql.simulate, [gantry()] * 2, [axes(), axes()], [SCENARIO] * 3), "controller has 2 entries, plant 2|scenario has 3 entries"),
        (partial(ql.simulate, gantry(), [axes(), axes().axes[1]], SCENARIO), r"controller\[1\] has channels"),
        (partial(ql.simulate, [ql.plants.two_mass_spring()], axes(), SCENARIO), "has 1 control signal and 1 output, the controller 2 and 2"),
        (partial(ql.simulate, PlantBatch([gantry()]), axes().axes[1], SCENARIO), "has 2 control signals and 2 outputs, the controller 1 and 1"),
        (partial(ql.simulate, [gantry()], axes(), SCENARIO, record=["q"]), "record = 'q'"),
        (partial(ql.simulate, gantry(), axes(), SCENARIO, record=["y"]), r"record = \['y'\]: is for a batch"),
        (lambda: ql.simulate([gantry()], axes(learner=False), replace(SCENARIO, duration=0.01, rest_at=()), record=["y"]).metrics(), "channel 'r' is not recorded; add it to record"),
    ],
)  # fmt: skip
def test_what_cannot_be_a_batch_is_refused(call: Callable[[], Any], message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        call()
