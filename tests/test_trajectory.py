"""The record of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import quell as ql
from quell.records.plotting import thinned


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
        "overshoot", "settling_time", "rise_time", "peak_error", "rms", "iae", "ise", "itae", "control_variation",
    }  # fmt: skip
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
    assert data["u"].attrs["long_name"] == "control signal as applied"
    assert data.attrs["plant"] == "two-mass-spring"
    assert float(data["y"].sel(time=5.0, method="nearest")) == run["y"][1000]


def test_a_saved_record_is_loaded_back_whole(run: ql.Trajectory, tmp_path: Path) -> None:
    """All channels, names, times and the status."""
    run.save(tmp_path / "run.nc")
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


def test_a_plot_has_three_axes_and_draws_into_given_ones(run: ql.Trajectory) -> None:
    """Output, control signal and estimates."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    axes = run.plot()
    assert [len(ax.lines) for ax in axes] == [2, 1, 3]
    _, mine = plt.subplots(3, 1)
    assert run.plot(mine) is mine
    plt.close("all")


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
