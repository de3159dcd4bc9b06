"""The record of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import quell as ql
from quell.records.plotting import thinned

from .cases import cases


@pytest.fixture(scope="module")
def run() -> ql.Trajectory:
    """A step with the Kalman learner, and a force after 10 s."""
    controller = ql.ADRC(
        ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=5e-3),
        omega_c=1.0,
        learner=ql.learners.Kalman(),
    )
    scenario = ql.Scenario(
        reference=1.0, duration=20.0, disturbances=(0.0, ql.signals.Step(at=10.0))
    )
    return ql.simulate(ql.plants.two_mass_spring(), controller, scenario)


@pytest.mark.trial
def test_channels_are_read_by_name_with_their_shapes(run: ql.Trajectory) -> None:
    """One value a sample is a vector, several are a matrix."""
    assert run["y"].shape == (len(run),)
    assert run["x"].shape == (len(run), 4)
    assert run["w"].shape == (len(run), 2)
    assert run["theta"].shape == (len(run), 5)
    np.testing.assert_array_equal(run["f_hat"], run["f_learned"] + run["f_residual"])
    np.testing.assert_array_equal(run["y"], run["x"][:, 1])


def test_an_unknown_channel_is_named_and_the_known_ones_listed(run: ql.Trajectory) -> None:
    """A ``ValueError`` with the choice."""
    with pytest.raises(
        ValueError, match="channel = 'position': must be one of r, y, y_measured, u, w, x, x_hat"
    ):
        run["position"]


def test_a_window_takes_its_first_sample_and_leaves_its_last(run: ql.Trajectory) -> None:
    """Half open, in seconds."""
    part = run.window(1.0, 2.0)
    np.testing.assert_allclose(run.t[part][[0, -1]], [1.0, 1.995])
    assert run.window(-5.0, 99.0) == slice(0, len(run))


def test_metrics_judge_the_window_as_a_step(run: ql.Trajectory) -> None:
    """The target is where the reference ends; a window at rest has no overshoot to speak of."""
    found = run.metrics(0.0, 10.0)
    assert set(found) == {
        "overshoot", "settling_time", "rise_time", "peak_error", "rms", "iae", "ise", "itae", "control_variation", "total_variation", "control_energy",
    }  # fmt: skip
    assert found.missing == {}
    assert found["peak_error"] == 1.0
    assert 2.0 < found["rise_time"] < 8.0
    assert run.metrics()["rms"] < 1.0
    assert "overshoot" not in run.metrics(15.0)
    assert "overshoot" in run.metrics(0.0, 10.0, target=1.0)
    assert run.metrics(0.0, np.inf)["rms"] == run.metrics()["rms"]
    with pytest.raises(ValueError, match="start = 30.0, stop = None: the record ends at 20 s"):
        run.metrics(30.0)
    with pytest.raises(ValueError, match="time = nan: must be a number"):
        run.metrics(np.nan)


def record_of(r: object, y: object, u: object = 0.0, **fields: object) -> ql.Trajectory:
    """A record of few samples, 0.1 s apart."""
    columns = np.broadcast_arrays(np.asarray(r, dtype=float), y, u)
    log = np.column_stack(columns).astype(float)
    channels = (("r", 1), ("y", 1), ("u", 1))
    return ql.Trajectory(log, channels, 0.1, ended=0.1 * (len(log) - 1), **fields)


STEP = ("overshoot", "settling_time", "rise_time")


@cases(
    ("r", "y", "window", "missing"),
    [
        ([1, 1, 1, 1], [0, 0.5, 1, 1], (), {}),
        ([1, 1, 1, 1], [1, 1.1, 1, 1], (), dict.fromkeys(STEP, "y is at the target at the start of the window: no step")),
        ([0, 1, 2, 2], [0, 1, 2, 2], (), dict.fromkeys(STEP, "r changes within the window: give target to judge it as a move to there")),
        ([0, 0, 2, 2], [0, 0, 1, 2], (), {}),
        ([0, 0, 2, 1], [0, 0, 1, 2], (), dict.fromkeys(STEP, "r changes within the window: give target to judge it as a move to there")),
        ([0, 0, 2], [0, 0, 0], (), dict.fromkeys(STEP, "there is only one sample in the window: no step response")),
        ([2, 2, 2, 2], [0, 1, 2, 2], (0.2,), dict.fromkeys(STEP, "y is at the target at the start of the window: no step")),
        ([2, 2, 2, 2, 2], [0, 0, 0, 1, 2], (0.2,), dict.fromkeys(STEP, "r does not step at the start of the window: no step")),
        ([0, 0, 2, 2, 2], [0, 0, 0, 1, 2], (0.2,), {}),
        ([0, 2, 2, 2, 2], [0, 0, 0, 1, 2], (0.2,), {}),  # a sample off
        ([0, 2, 2, 2, 2], [0, 0, 0, 0, 2], (0.3,), dict.fromkeys(STEP, "r does not step at the start of the window: no step")),
        ([0, 0, 2, 2, 2], [0, 0, 0, 1, 2], (0.1,), {}),
        ([1, 1, 1], [0, 0.5, 0.97], (), {"settling_time": "at the end of the window y is not within ±2 % of the step"}),
        ([1, 1, 1], [0, 0.5, 0.9801], (), {}),
        ([1, 1, 1], [0, 0.5, 0.8], (), {
            "settling_time": "at the end of the window y is not within ±2 % of the step",
            "rise_time": "y does not reach 90 % of the step in the window",
            "overshoot": "at the end of the window y does not rest at the target (RMS to 5 %)",
        }),
        ([1, 1, 1, 1], [0, 1, 1.5, 3.5], (), {
            "settling_time": "at the end of the window y is not within ±2 % of the step",
            "rise_time": "at the end of the window y is further from the target than at its start",
            "overshoot": "at the end of the window y does not rest at the target (RMS to 5 %)",
        }),
    ],
)  # fmt: skip
def test_each_measure_that_is_missing_has_its_reason(
    r: list[float], y: list[float], window: tuple[float, ...], missing: dict[str, str]
) -> None:
    """It is not in the result, or NaN; and nothing else is missing."""
    found = record_of(r, y).metrics(*window)
    assert found.missing == missing
    assert {name for name in STEP if np.isnan(found.get(name, np.nan))} == set(missing)
    assert found.band == 0.02


def test_a_move_is_judged_when_its_target_is_given() -> None:
    """A trapezoid does not step; the band of 2 % can be another one."""
    move = record_of([0, 1, 2, 2, 2], [0, 1, 2.1, 2.01, 2.0])
    assert move.metrics(target=2.0)["settling_time"] == pytest.approx(0.3)
    assert move.metrics(target=2.0, band=0.002)["settling_time"] == pytest.approx(0.4)
    assert move.metrics(target=2.0, band=0.1)["settling_time"] == pytest.approx(0.2)
    with pytest.raises(ValueError, match="band = -1.0: must be finite and greater than zero"):
        move.metrics(15.0 * 0.01, band=-1.0)


def test_a_run_that_diverged_in_the_window_has_no_step_there() -> None:
    """Though y may not have passed the target; before its end there are windows that are whole."""
    run = record_of([1, 1, 1, 1], [0, 0.99, -1, -1e6], status=ql.Status.DIVERGED)
    reason = "the run diverged at 0.3 s, in the window"
    assert run.metrics().missing == dict.fromkeys(STEP, reason)
    assert run.metrics()["peak_error"] == 1e6 + 1
    assert run.metrics(0.0, 0.2)["overshoot"] == 0.0
    assert run.metrics(0.0, run.ended).missing.keys() == set(STEP)
    with pytest.raises(ValueError, match=r"the record ends at 0.3 s .*The loop diverged"):
        run.metrics(0.5)


def test_the_message_says_in_how_many_samples_a_flag_is_set() -> None:
    """A move that touches a limit once is not one that stands there."""
    flags = ql.Status.SATURATED, ql.Status.SATURATED | ql.Status.HELD, 0, 0
    log, channels = np.array([flags], dtype=float).T, (("status", 1),)
    status = ql.Status.SATURATED | ql.Status.HELD | ql.Status.RAN_AWAY
    said = ql.Trajectory(log, channels, 0.1, ended=0.3, status=status).message
    assert said.startswith("50 % of the samples: The control signal is at u_min or u_max")
    assert f" 25 % of the samples: {ql.Status.HELD.message}" in said
    assert f" {ql.Status.RAN_AWAY.message}" in said
    assert said.count("%") == 2  # that y ran away is said of the whole run
    empty = ql.Trajectory(log[:0], channels, 0.1, ended=0.0, status=ql.Status.SATURATED)
    assert empty.message == ql.Status.SATURATED.message
    log[0] = np.nan  # of a damaged recording: no flag
    assert ql.Trajectory(log, channels, 0.1, ended=0.3, status=status).message.startswith("25 %")


def test_a_limit_near_to_the_reference_is_no_sign_of_an_unstable_loop() -> None:
    """The message says so, and does not blame b0; far from it, it does."""
    near = record_of([1, 1], [0, 5], status=ql.Status.DIVERGED | ql.Status.SATURATED, limit=9.9)
    assert "need not mean that the loop is unstable. The control signal is at" in near.message
    assert "b0" not in near.message
    far = record_of([1, 1], [0, 5], status=ql.Status.DIVERGED, limit=10.1)
    assert "b0" in far.message
    assert "b0" not in record_of([-2, 1], [0, 5], status=ql.Status.DIVERGED, limit=19.9).message
    nothing = record_of([], [], status=ql.Status.DIVERGED, limit=9.9)
    assert "need not mean" in nothing.message


def test_a_measure_beyond_all_numbers_says_so() -> None:
    """Squares of 1e200, for instance; no warning of numpy's."""
    found = record_of([1e200, 1e200], [0.0, 1e200]).metrics()
    assert found.missing == dict.fromkeys(("rms", "ise"), "the number is too large for a float")
    assert found["peak_error"] == 1e200


def test_the_total_variation_has_the_first_jump_of_u() -> None:
    """From zero at the start of the run, from the u before the window later."""
    run = record_of([1] * 5, [0] * 5, [3, 5, 4, 4, 4])
    assert (run.metrics()["control_variation"], run.metrics()["total_variation"]) == (3.0, 6.0)
    later = run.metrics(0.1)
    assert (later["control_variation"], later["total_variation"]) == (1.0, 3.0)


def test_the_energy_of_u_is_that_of_a_held_u() -> None:
    """Each sample counts until the next one, and the last one, which lasts for no time, not."""
    run = record_of([1] * 5, [0] * 5, [3, 5, 4, 4, 7])
    assert run.metrics()["control_energy"] == pytest.approx(0.1 * (9 + 25 + 16 + 16))
    assert run.metrics(0.1, 0.3)["control_energy"] == pytest.approx(0.1 * 25)
    assert record_of([1.0], [0.0], [2.0]).metrics()["control_energy"] == 0.0
    huge = record_of([1.0] * 2, [0.0] * 2, [1e200] * 2).metrics()
    assert huge.missing["control_energy"] == "the number is too large for a float"


@cases(
    ("window", "message"),
    [
        ((0.3, 0.1), "start = 0.3, stop = 0.1: start must be less than stop"),
        ((0.3, 0.3), "start = 0.3, stop = 0.3: start must be less than stop"),
        ((0.11, 0.19), "must hold at least one sample; they are 0.1 s apart, from 0 s on"),
        ((-2.0, -1.0), "must hold at least one sample; they are 0.1 s apart, from 0 s on"),
        ((0.41,), "the record ends at 0.4 s; the window must hold at least one sample"),
    ],
)
def test_a_window_without_samples_says_why(window: tuple[float, ...], message: str) -> None:
    """Reversed, between two samples, before or after the record; nothing is said of the loop."""
    with pytest.raises(ValueError, match=message) as raised:
        record_of([1] * 5, [0] * 5).metrics(*window)
    assert "problem" not in str(raised.value)


def test_a_step_within_the_window_is_judged_from_where_it_begins() -> None:
    """As in a window that begins there: overshoot and times from the step on; the integrals are those of the whole window."""
    r, y = [0.0] * 5 + [1.0] * 6, [0.0] * 6 + [0.6, 1.2, 1.0, 1.0, 1.0]
    whole, part = record_of(r, y).metrics(), record_of(r, y).metrics(start=0.5)
    assert whole["overshoot"] == pytest.approx(0.2)
    assert {name: whole[name] for name in STEP} == {name: part[name] for name in STEP}
    assert whole["rms"] < part["rms"]


def test_a_record_without_samples_says_so() -> None:
    """And what happened."""
    nothing = record_of([], [], status=ql.Status.DIVERGED)
    with pytest.raises(ValueError, match=r"the record has no sample \(.*The loop diverged"):
        nothing.metrics()


def test_a_record_of_one_sample_has_measures() -> None:
    """No step can have settled in it."""
    one = record_of([1.0], [0.0], [2.0]).metrics()
    assert (one["rms"], one["iae"], one["control_variation"], one["total_variation"]) == (
        1,
        0,
        0,
        2,
    )
    assert set(one.missing.values()) == {"there is only one sample in the window: no step response"}
    assert one.missing.keys() == set(STEP)


def test_the_record_becomes_a_labelled_dataset(run: ql.Trajectory) -> None:
    """With time, units, feature names and what happened."""
    data = run.to_xarray()
    assert dict(data.sizes) == {
        "time": len(run),
        "w_index": 2,
        "x_index": 4,
        "x_hat_index": 4,
        "theta_index": 5,
    }
    np.testing.assert_array_equal(data["y"].values, run["y"])
    assert list(data["theta_index"].values) == ["x1", "x2", "x3", "x4", "bias"]
    assert data["time"].attrs["units"] == "s"
    assert data["u"].attrs == {"long_name": "force as applied", "units": "N"}
    assert data["x_hat"].attrs["units"] == "m, m/s, m/s², m/s³"
    assert data["f_hat"].attrs["units"] == "m/s⁴"
    assert data.attrs["plant"] == "two-mass-spring"
    assert float(data["y"].sel(time=5.0, method="nearest")) == run["y"][1000]


def test_a_saved_record_is_loaded_back_whole(run: ql.Trajectory, tmp_path: Path) -> None:
    """All channels, names, times and the status."""
    run.save(tmp_path / "run.nc")
    with pytest.raises(ValueError, match="run.nc': the file exists; choose another name"):
        run.save(tmp_path / "run.nc")
    run.save(tmp_path / "run.nc", overwrite=True)
    again = ql.Trajectory.load(tmp_path / "run.nc")
    assert again.names == run.names
    for name in run.names:
        np.testing.assert_array_equal(again[name], run[name])
    np.testing.assert_array_equal(again.t, run.t)
    assert (again.status, again.ended, again.plant, again.features) == (
        run.status,
        run.ended,
        run.plant,
        run.features,
    )


@pytest.mark.lost
def test_an_empty_record_is_saved_too(tmp_path: Path) -> None:
    """That of a run which diverged at once."""
    controller = ql.ADRC(ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=5e-3), omega_c=1.0)
    nothing = ql.simulate(
        ql.plants.two_mass_spring(), controller, ql.Scenario(x0=[0.0, 9.0, 0.0, 0.0]), limit=1.0
    )
    assert len(nothing) == 0
    nothing.save(tmp_path / "nothing.nc")
    again = ql.Trajectory.load(tmp_path / "nothing.nc")
    assert len(again) == 0
    assert again.diverged
    assert again["x"].shape == (0, 4)


@pytest.mark.trial
def test_a_file_that_is_no_record_is_refused(tmp_path: Path) -> None:
    """Rubbish, and another program's NetCDF."""
    import xarray

    (tmp_path / "text.nc").write_text("not a record")
    with pytest.raises(ValueError, match="must be a NetCDF file written by Trajectory.save"):
        ql.Trajectory.load(tmp_path / "text.nc")
    xarray.Dataset({"a": ("x", [1.0])}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(ValueError, match="it was not written by Trajectory.save"):
        ql.Trajectory.load(tmp_path / "other.nc")
    with pytest.raises(FileNotFoundError):
        ql.Trajectory.load(tmp_path / "missing.nc")


def test_a_place_that_cannot_be_written_is_named(run: ql.Trajectory, tmp_path: Path) -> None:
    """Before any work is done."""
    with pytest.raises(ValueError, match=r"the folder .* must exist"):
        run.save(tmp_path / "nowhere" / "run.nc")
    with pytest.raises(ValueError, match="must be a file, is a folder"):
        run.save(tmp_path)


def test_a_plot_has_an_error_panel_and_draws_into_given_axes(run: ql.Trajectory) -> None:
    """Output, control signal, estimates, and the error, which three given axes have no place for."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    axes = run.plot()
    learner = bool(run.features)
    assert [len(ax.lines) for ax in axes] == [2, 1, 3 if learner else 1, 2]
    assert axes[3].get_position().y0 > axes[1].get_position().y0  # below the output
    _, mine = plt.subplots(3, 1)
    assert run.plot(mine) is mine
    _, four = plt.subplots(4, 1)
    assert run.plot(ax=four) is four
    assert run.plot(four.reshape(2, 2)).tolist() == four.tolist()
    with pytest.raises(ValueError, match="axes and ax: are two names of the same"):
        run.plot(mine, ax=four)
    plt.close("all")


def test_a_plot_marks_limits_and_saturation_and_has_names_and_units() -> None:
    """Lines at the limits, spans where u is at one; r is drawn above y."""
    import matplotlib.pyplot as plt

    plant = ql.plants.labelled(ql.plants.two_mass_spring(), y="position [m]", u="force [N]")
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=0.01)
    controller = ql.ADRC(observer, omega_c=1.0, u_min=-0.2, u_max=0.2)
    run = ql.simulate(plant, controller, ql.Scenario(1.0, 2.0))
    axes = run.plot()
    assert [ax.get_ylabel() for ax in axes[[0, 1, 3]]] == ["position [m]", "force [N]", "error [m]"]
    y, r = axes[0].lines
    assert (r.get_label(), r.get_zorder() >= y.get_zorder()) == ("r", True)
    heights = [line.get_ydata()[0] for line in axes[1].lines[1:]]
    assert heights == [-0.2, 0.2]
    (spans,) = axes[1].collections
    assert spans.get_label() == "saturated"
    held = (run["status"].astype(int) & int(ql.Status.SATURATED)) != 0
    assert spans.get_paths()[0].get_extents().x0 == pytest.approx(run.t[np.argmax(held)])
    plt.close("all")


def test_a_data_frame_has_a_row_for_each_sample_and_units(
    run: ql.Trajectory, tmp_path: Path
) -> None:
    """From xarray, by to_pandas and in CSV: the same numbers under the same names."""
    frame, direct = run.to_xarray().to_dataframe(), run.to_pandas()
    assert len(frame) == len(direct) == len(run)
    assert set(frame.columns) == set(direct.columns)
    np.testing.assert_array_equal(frame[direct.columns].to_numpy(), direct.to_numpy())
    np.testing.assert_array_equal(direct["x[1]"], run["x"][:, 1])
    assert direct.attrs["units"]["u"] == "N"
    assert direct.attrs["units"] == frame.attrs["units"]
    path = tmp_path / "run.csv"
    run.to_csv(path)
    head, *lines = path.read_text(encoding="utf-8").splitlines()
    assert head.split(",")[:3] == ["time [s]", "r [m]", "y [m]"]
    table = np.array([[float(cell) for cell in line.split(",")] for line in lines])
    np.testing.assert_array_equal(table[:, 1:], direct.to_numpy())
    with pytest.raises(ValueError, match="exists"):
        run.to_csv(path)


def test_names_and_units_are_in_files_and_come_back(tmp_path: Path) -> None:
    """In NetCDF, xarray and CSV; the limits of u, too."""
    plant = ql.plants.labelled(ql.plants.two_mass_spring(), "position [m]", "force [N]", "push [N]")
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=0.01)
    controller = ql.ADRC(observer, omega_c=1.0, u_min=-0.2, u_max=0.3)
    run = ql.simulate(plant, controller, ql.Scenario(1.0, 0.1))
    run.save(tmp_path / "run.nc")
    again = ql.Trajectory.load(tmp_path / "run.nc")
    assert (again.signals, again.u_limits) == (run.signals, (-0.2, 0.3))
    data = again.to_xarray()
    assert data["y"].attrs == {"long_name": "position", "units": "m"}
    assert data["f_hat"].attrs["units"] == "m/s⁴"
    run.to_csv(tmp_path / "run.csv")
    assert "y [m],y_measured [m],u [N]" in (tmp_path / "run.csv").read_text().splitlines()[0]


def test_a_thinned_line_keeps_its_extremes_and_ends(rng: np.random.Generator) -> None:
    """What the eye would see is all there."""
    t, values = np.arange(100_003.0), rng.normal(size=100_003)
    few_t, few = thinned(t, values)
    assert few_t.size < 2200
    assert (few.min(), few.max(), few_t[0], few_t[-1]) == (
        values.min(),
        values.max(),
        0.0,
        100_002.0,
    )
    np.testing.assert_array_equal(values[few_t.astype(int)], few)


@cases("names", [(), ("iae",), ("settling_time", "rms"), ("rise_time", "ise")])
@cases("diverged", [False, True])
@pytest.mark.lost
def test_some_of_the_measures_are_those_of_all(names: tuple[str, ...], diverged: bool) -> None:
    """With the same values, and the same reasons for those that do not exist."""
    law = ql.ADRC(ql.ESO.model_free(1, -1.0 if diverged else 1.0, 20.0, 0.01), omega_c=5.0)
    plant = ql.plants.LinearPlant([[0.0]], [1.0], [1.0])
    run = ql.simulate(plant, law, ql.Scenario(1.0, duration=0.5), limit=3.0)
    assert run.diverged == diverged
    every, some = run.metrics(), run.metrics_of(names)
    assert str(dict(sorted(some.items()))) == str(
        {k: every[k] for k in sorted(names) if k in every}
    )
    assert some.missing == {name: why for name, why in every.missing.items() if name in names}
