"""A recorded run through the same controller, and through others."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.baselines import PID, ZV
from quell.controllers.prefilters import Prefiltered
from quell.plants.base import advance, measure
from quell.realtime import CsvSink, McapSink
from quell.realtime.recordings import Event, Header, load, row_channels, trajectory_of
from quell.realtime.replaying import replay
from quell.realtime.supervisor import Mode
from tests import scripted
from tests.recordings import DT, OBSERVER, PLANT, controller, header_of, rows_of, simulated
from tests.scripted import ScriptedDevice
from tests.test_telemetry import recorded


def check_same_estimates(again: ql.Trajectory, run: ql.Trajectory, tolerance: float = 0.0) -> None:
    """Compare the estimates, relative to their size."""
    for name in {"x_hat", "f_residual", "f_learned", "theta", "authority"} & set(run.names):
        np.testing.assert_allclose(
            again[name],
            run[name],
            rtol=0.0,
            atol=tolerance * np.max(np.abs(run[name])),
            err_msg=name,
        )


@pytest.mark.trial
@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, id="free"),
        pytest.param({"u_min": -0.3, "u_max": 0.4}, id="limited"),
        pytest.param(
            {"u_max": 0.4, "learner": None, "guard": None},
            id="compiled",
            marks=pytest.mark.compiled,
        ),
    ],
)
def test_the_controller_that_made_a_run_gives_the_same_estimates(options: dict[str, Any]) -> None:
    """Estimates and u are equal to the last bit."""
    run = simulated(**options)
    again = replay(run, controller(**options))
    check_same_estimates(again, run)
    np.testing.assert_array_equal(again["u_wished"], run["u"])
    for name in ("r", "y", "y_measured", "u"):
        np.testing.assert_array_equal(again[name], run[name])
    assert (again.dt, again.features, again.ended) == (run.dt, run.features, run.ended)
    again.plot()
    assert again.metrics(1.0) == run.metrics(1.0)


@pytest.mark.parametrize("make", [CsvSink, McapSink])
def test_it_does_so_from_a_file(make: Any, tmp_path: Path) -> None:
    """A run recorded, loaded and replayed."""
    run = simulated()
    path = tmp_path / "run"
    recorded(header_of(run, controller()), rows_of(run, controller()), make(path))
    check_same_estimates(replay(load(path), controller()), run)


def test_a_prefilter_is_replayed_too() -> None:
    """The shaped reference is equal too."""
    shaped = Prefiltered(ql.ADRC(OBSERVER, omega_c=3.0), ZV(omega=3.0))
    run = ql.simulate(PLANT, shaped, ql.Scenario(reference=ql.signals.Step(at=0.5), duration=3.0))
    again = replay(run, shaped)
    check_same_estimates(again, run)
    np.testing.assert_array_equal(again["r_shaped"], run["r_shaped"])


def test_a_run_of_the_loop_is_replayed_from_its_first_cycle_to_its_last() -> None:
    """All modes and missing samples: the estimates and the wished u are those of the rig."""
    missing = dict.fromkeys((3, 80, 81, 82, 150), math.nan)
    rig = scripted.run(ScriptedDevice(scripted.PLANT, y=missing), reference=1.0, approach=0.5)
    run = trajectory_of(Header(row_channels(scripted.adrc().channels), DT), rig.rows)
    again = replay(run, scripted.adrc())
    awake = run["mode"] != Mode.STOPPED
    for name in ("x_hat", "f_residual"):
        np.testing.assert_allclose(
            again[name][awake], run[name][awake], rtol=0.0, atol=1e-12 * np.max(np.abs(run[name]))
        )
    ruled = run["mode"] == Mode.RUN
    assert {int(mode) for mode in run["mode"]} == set(Mode)
    np.testing.assert_allclose(again["u_wished"][ruled], run["u"][ruled], rtol=0.0, atol=1e-12)
    assert ql.Status.MEASUREMENT_HELD in again.status


def test_a_start_under_load_is_replayed_with_u_before() -> None:
    """Without ``u_before`` the observer has to find the load first."""
    rig = controller()
    model, x, scratch = PLANT.sampled(DT), np.array([0.5, 0.0]), np.zeros(12)
    rig.start(0.5, 3.25, r=0.7)
    rows = []
    for k in range(200):
        y = measure(model, x)
        u = rig.step(0.7, y)
        row = np.zeros(sum(width for _, width in rig.channels))
        ql.controllers.base.write_row(rig.parameters, rig._state, row)
        rows.append([k, 0.0, 0.0, 0.0, 0.0, 0.7, y, y, u, *row])
        advance(model, x, scratch, 0.0, u, np.array([-3.0]))
    run = trajectory_of(header_of(simulated(1.0), rig), np.array(rows))
    check_same_estimates(replay(run, controller(), u_before=3.25), run, tolerance=1e-12)
    assert np.max(np.abs(replay(run, controller())["f_hat"] - run["f_hat"])) > 1.0


def test_another_observer_sees_what_happened() -> None:
    """Equal to ``step`` and ``applied`` by hand; a faster observer follows f more closely."""
    run = simulated()
    other, by_hand = (
        ql.ADRC(ql.ESO.model_free(order=2, b0=2.0, omega_o=60.0, dt=DT), omega_c=5.0)
        for _ in range(2)
    )
    again = replay(run, other)
    for k in range(300):
        assert by_hand.step(run["r"][k], run["y_measured"][k]) == pytest.approx(
            again["u_wished"][k], rel=1e-9, abs=1e-12
        )
        np.testing.assert_allclose(by_hand.estimate.x, again["x_hat"][k], rtol=1e-9, atol=1e-12)
        by_hand.applied(run["u"][k])
    f = -1.0 * run["x"][:, 0] - 0.6 * run["x"][:, 1]
    late = slice(300, None)
    error = {}
    for omega_o in (10.0, 40.0):
        observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=omega_o, dt=DT)
        error[omega_o] = np.sqrt(
            np.mean((replay(run, ql.ADRC(observer, omega_c=3.0))["f_hat"] - f)[late] ** 2)
        )
    assert error[40.0] < 0.5 * error[10.0]


def test_controllers_of_other_kinds_are_replayed_too() -> None:
    """A PID controller gives its own u again, and follows an ADRC's run."""
    pid = PID(kp=2.0, ki=1.0, dt=DT, u_min=-1.0, u_max=1.0)
    run = ql.simulate(PLANT, pid, ql.Scenario(reference=1.0, duration=2.0))
    np.testing.assert_array_equal(replay(run, pid)["u_wished"], run["u"])
    assert np.max(np.abs(replay(simulated(2.0), pid)["u_wished"])) <= 1.0


def test_the_controller_that_is_passed_stays_as_it_is() -> None:
    """The replay uses a state of its own."""
    run, design = simulated(2.0), controller()
    design.step(1.0, 0.3)
    before = design.state
    first, second = replay(run, design), replay(run, design)
    np.testing.assert_array_equal(first.log, second.log)
    assert all(np.array_equal(value, before[name]) for name, value in design.state.items())


def test_skipped_deadlines_are_replayed_as_on_the_rig() -> None:
    """They are samples without a measurement, as on the rig."""
    rig = scripted.run(
        ScriptedDevice(scripted.PLANT, stall={40: 35_000_000}, moves={41: 3}), reference=1.0
    )
    run = trajectory_of(Header(row_channels(scripted.adrc().channels), DT), rig.rows)
    again = replay(run, scripted.adrc())
    gaps = run["events"].astype(int) == Event.GAP
    assert np.count_nonzero(gaps) == 3
    there = (run["mode"] != Mode.STOPPED) & ~gaps
    for name in ("x_hat", "f_residual"):
        np.testing.assert_allclose(
            again[name][there], run[name][there], rtol=0.0, atol=1e-12 * np.max(np.abs(run[name]))
        )


def widened(run: ql.Trajectory, signal: str) -> ql.Trajectory:
    """Return a run with one more column of a signal, as a file that somebody made may have."""
    at = [name for name, _ in run.channels].index(signal)
    column = sum(width for _, width in run.channels[:at])
    channels = tuple((name, width + (name == signal)) for name, width in run.channels)
    return replace(run, log=np.insert(run.log, column, 7.0, axis=1), channels=channels)


def test_what_can_not_be_replayed_is_refused() -> None:
    """The message says what to do."""
    run = simulated(1.0)
    thin = ql.simulate(
        PLANT, controller(), ql.Scenario(reference=1.0, duration=1.0), record_every=5
    )
    slow = ql.ADRC(ql.ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=2 * DT), omega_c=3.0)
    blind = trajectory_of(header_of(run, controller()), rows_of(run, controller()))
    blind.log[:, 7] = np.nan
    unknown = trajectory_of(header_of(run, controller()), rows_of(run, controller()))
    unknown.log[30, 8] = np.nan
    for given, other, rule in [
        (thin, controller(), "run has every 5th sample: .* record_every=1"),
        (run, slow, "controller has dt = 0.02 s: must have that of the run, 0.01 s"),
        (run, ql.ADRC, "controller = .*: must be a controller"),
        ("run.mcap", controller(), "run = 'run.mcap': must be a Trajectory"),
        (blind, controller(), "run has no finite y_measured"),
        (unknown, controller(), "run has no finite u at 0.3 s"),
        (run, ql.Compensator(OBSERVER), "controller = Compensator: takes u_0 of a host"),
        (widened(run, "y"), controller(), "run has 2 measurements and one control signal, the"),
        (widened(run, "u"), controller(), "run has one measurement and 2 control signals, the"),
        (widened(run, "r"), controller(), "run has 2 columns of r and 1 of y: must be as many"),
        (widened(run, "y_measured"), controller(), "run has 2 columns of y_measured and 1 of y"),
    ]:
        with pytest.raises(ValueError, match=rule):
            replay(given, other)
    for other, u, rule in [
        (controller(), math.nan, "u_before = nan"),
        (PID(kp=1.0, dt=DT), 1.0, "u = 1.0 at y = .*: the law has no integral action"),
        (Prefiltered(PID(kp=1.0, dt=DT), ZV(omega=3.0)), 1.0, "must be an ADRC"),
    ]:
        with pytest.raises(ValueError, match=rule):
            replay(run, other, u_before=u)
