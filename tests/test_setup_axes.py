"""Setups with a table [[axis]] for each axis: the objects in Python, and errors that name key and rule."""

from __future__ import annotations

import copy
import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.setup import EXAMPLES, SetupError, load, made
from quell.setup.loading import unchecked
from quell.tuning.report import toml_text

from .cases import cases
from .commands import Shown
from .setups import GANTRY


def gantry(**changes: Any) -> dict[str, Any]:
    """Return the tables of a gantry with other ones."""
    data = copy.deepcopy(tomllib.loads(GANTRY))
    return {key: value for key, value in (data | changes).items() if value is not None}


@pytest.mark.trial
@pytest.mark.compiled
def test_the_run_of_a_file_is_that_of_the_objects_in_python() -> None:
    """Plant, B0, limits of the actuators, references, noise and disturbances."""
    setup = made("gantry.toml", gantry())
    plant = ql.plants.LinearPlant(
        [[0, 1, 0, 0], [0, -2, 0, 0], [0, 0, 0, 1], [0, 0, 0, -3]],
        [[0, 0], [5, 0.5], [0, 0], [0.4, 6]],
        [[1, 0, 0, 0], [0, 0, 1, 0]],
    )
    parts = [
        ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3), 8.0) for _ in range(2)
    ]
    axes = ql.Axes(
        {"x": parts[0], "y": parts[1]}, [[5, 0.5], [0.4, 6]], u_max=[20.0, 30.0], u_min=-25.0
    )
    scenario = ql.Scenario(
        reference=(ql.signals.Step(0.1), 0.0),
        noise=(0.0, ql.signals.BandLimitedNoise(1e-12, 1e-3)),
        disturbances=(0.0, ql.signals.Step(at=0.2)),
        duration=0.5,
        seed=3,
    )
    assert (setup.title, setup.controller.names) == ("gantry", ("x", "y"))
    ours = ql.simulate(setup.plant, setup.controller, setup.needed("scenario"))
    theirs = ql.simulate(plant, axes, scenario)
    np.testing.assert_array_equal(ours.log, theirs.log)
    assert setup.windows == ({"start": 0.1},)


def test_a_setup_is_made_again_of_its_tables() -> None:
    """As dictionaries, as TOML and as JSON; so is the example that comes along."""
    for setup in (made("gantry.toml", gantry()), load(EXAMPLES / "arm.toml")):
        again = made(setup.file, setup.tables())
        assert again.description == setup.description
        written = made(setup.file, tomllib.loads(toml_text(setup.tables(), "again")))
        assert written.description == setup.description
        assert json.loads(json.dumps(setup.as_json()))["axis"][0]["controller"]
        assert repr(written.controller) == repr(setup.controller)


def test_an_axis_has_a_safe_set() -> None:
    """A table in its controller, with weights of the actuators beside it."""
    data = gantry()
    bands = {"y_min": -0.5, "y_max": 0.5, "alpha": 6.0, "gain_error": 0.01, "largest_u": 150.0}
    data["axis"][0]["controller"]["safe_set"] = bands
    data["axes"]["weights"] = [1.0, 2.0]
    found = made("a.toml", data).controller
    assert found.axes[0].safe_set == ql.SafeSet(**bands)
    assert found.axes[1].safe_set is None
    assert found.parameters.safe.weights.tolist() == [1.0, 2.0]
    del data["axis"][0]["controller"]["safe_set"]
    with pytest.raises(SetupError, match="weights = .*leave them out"):
        made("a.toml", data)


def test_axes_are_compensators_above_drives() -> None:
    """The same as the objects in Python; a table of an axis that does not fit is named."""
    data = gantry()
    for axis in data["axis"]:
        del axis["controller"]
        axis["compensator"] = {"omega_c": 8.0}
        axis["drive"] = {"kp": 100.0, "ki": 50.0, "kd": 20.0, "tf": 0.005}
    setup = made("a.toml", data)
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3)
    each = {name: ql.Compensator(observer, omega_c=8.0) for name in "xy"}
    pid = ql.baselines.PID(kp=100.0, ki=50.0, kd=20.0, tf=0.005, dt=1e-3)
    limits: dict[str, Any] = {"u_max": [20.0, 30.0], "u_min": -25.0}
    axes = ql.Axes(each, [[5, 0.5], [0.4, 6]], drives=[pid, pid], **limits)
    r, y = [0.1, 0.0], [0.02, 0.01]
    assert setup.controller.step(r, y).tolist() == axes.step(r, y).tolist()
    again = made("a.toml", tomllib.loads(toml_text(setup.tables(), "again")))
    assert again.description == setup.description
    data["axis"][1]["controller"] = {"omega_c": 8.0}
    with pytest.raises(SetupError, match=r"axis\[1\]: has both; give a controller"):
        made("a.toml", data)
    del data["axis"][1]["controller"], data["axis"][1]["drive"]
    with pytest.raises(SetupError, match="drives = .*must be a controller for each axis"):
        made("a.toml", data)
    data["axis"][0]["compensator"] = {"u_max": 3.0}
    with pytest.raises(SetupError, match=r"axis\[0\].compensator.u_max: belongs into \[axes\]"):
        made("a.toml", data)


def test_b0_of_the_plant_is_that_of_each_kind() -> None:
    """Of an arm M(q) in place of it, also behind encoders; of a craft that near the horizontal; of a linear plant C A B."""
    linear = made("a.toml", gantry()).controller
    np.testing.assert_allclose(linear.B0, [[5, 0.5], [0.4, 6]])
    arm = {"kind": "encoded-outputs", "resolution": 1e-5, "plant": {"kind": "arm"}}
    found = made("a.toml", gantry(plant=arm, scenario=None)).controller
    np.testing.assert_allclose(
        found.M(np.zeros((2, 2))), ql.plants.arm().mass_matrix([0.0, 0.0]), rtol=1e-12
    )
    axis = gantry()["axis"][0]
    three = [axis | {"name": name} for name in ("roll", "pitch", "yaw")]
    craft = gantry(
        plant="quadrotor-attitude",
        axis=three,
        axes={"B0": "plant", "wished": [2.0] * 4},
        scenario=None,
    )
    B0 = made("a.toml", craft).controller.B0
    expected = ql.plants.rotor_levers(0.17, 0.015) / np.array([[0.012], [0.012], [0.022]])
    np.testing.assert_allclose(B0, expected)


@cases(
    ("change", "message"),
    [
        ({"controller": {"omega_c": 1.0}}, "controller: belongs into each"),
        (
            {"axes": {"actuators": ["force [N]"]}},
            "axes.actuators = .*there are 2; give one for each",
        ),
        ({"tune": {"m_s": 0.5}}, "tune.m_s = 0.5: must be above 1"),
        ({"tune": {"B0_of": 0.1}}, "tune.B0_of: unknown; did you mean B0_off"),
        ({"axes": {"B1": 1}}, "axes.B1: unknown; "),
        ({"axes": {"B0": "model"}}, "axes.B0 = 'model'"),
        ({"axes": {"B0": [[1, 2], [2, 4]]}}, "axes.*singular"),
        (
            {"axes": {"B0": [[1, 0, 0], [0, 1, 0]]}},
            "plant.*2 control signals and 2 outputs, the controller 3",
        ),
        ({"axes": {"B0": "plant", "M": [[1, 0], [0, 1]]}}, 'B0 = "plant" and M'),
        ({"axes": {"u_max": [1.0, 2.0, 3.0]}}, "axes.u_max"),
        ({"plant": {"kind": "amr"}}, "plant.kind = 'amr': unknown; did you mean arm"),
        (
            {"plant": {"kind": "linear", "num": [1.0], "den": [1.0, 1.0]}},
            "plant has 1 outputs, there are 2 axes",
        ),
        ({"scenario": {"reference": 1.0}}, r"scenario.reference: belongs into each \[\[axis\]\]"),
        ({"scenario": {"disturbances": [0, 0, 1.0]}}, "disturbances has 3 signals"),
        ({"axis": []}, "axis: is empty; give a table"),
        ({"plant": None}, 'B0 = "plant": there is no plant'),
        ({"metrics": [{"target": 1.0}]}, "metrics.0..target: unknown"),
    ],
)
def test_a_mistake_is_named(change: dict[str, Any], message: str) -> None:
    """One line with the file, the path of the key and the rule."""
    with pytest.raises(SetupError, match=f"^a.toml: .*{message}"):
        made("a.toml", gantry(**change))


@cases(
    ("change", "message"),
    [
        ({"observer": {"kind": "model-free", "order": 2, "omega_o": 9.0, "b0": 2.0}}, r"axis\[1\].observer.b0: is 1 for an axis"),
        ({"observer": {"kind": "model-free", "order": 2, "omega_0": 9.0}}, r"axis\[1\].observer.omega_0: unknown; did you mean omega_o"),
        ({"controller": {"omega_c": 8.0, "u_max": 3.0}}, r"axis\[1\].controller.u_max: belongs into \[axes\]"),
        ({"controller": {"omega_c": -8.0}}, r"axis\[1\].controller.omega_c"),
        ({"learner": "kalmann"}, r"axis\[1\].learner.kind = 'kalmann': unknown; did you mean kalman"),
        ({"guard": {"bund": 1.0}}, r"axis\[1\].guard.bund: unknown; did you mean bound"),
        ({"reference": {"kind": "stepp"}}, r"axis\[1\].reference.kind = 'stepp'"),
        ({"name": "x"}, "axis: names x, x must be different"),
        ({"name": "a.b"}, "axes: name 'a.b' must be a text without a dot"),
    ],
)  # fmt: skip
def test_a_mistake_in_an_axis_is_named(change: dict[str, Any], message: str) -> None:
    """With the number of the axis."""
    data = gantry()
    data["axis"][1] |= change
    with pytest.raises(SetupError, match=f"^a.toml: .*{message}"):
        made("a.toml", data)


def test_load_and_made_take_any_number_of_axes() -> None:
    """Several are ``Axes``; what works on one axis refuses them, and one axis has no plant with several signals."""
    assert isinstance(made("gantry.toml", gantry()).controller, ql.Axes)
    assert load(EXAMPLES / "arm.toml").controller.names == ("shoulder", "elbow")
    assert load(EXAMPLES / "two_mass.toml").controller.observer.order == 4
    with pytest.raises(SetupError, match="gantry.toml: NOT for several axes yet: .*load"):
        unchecked("gantry.toml", gantry())
    single = "dt = 0.01\nplant = 'arm'\ncontroller = {kind = 'pid', kp = 1.0}"
    with pytest.raises(SetupError, match=r"plant.kind = 'arm'.* a setup with a table \[\[axis\]\]"):
        made("a.toml", tomllib.loads(single))
    with pytest.raises(SetupError, match="axis: missing"):
        made("a.toml", {"dt": 0.01, "axes": {}})


def test_a_command_of_one_axis_says_so(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """In a line with NOT, with the exit code of a wrong input; no file is written."""
    (tmp_path / "gantry.toml").write_text(GANTRY, encoding="utf-8")
    t = np.arange(50) * 1e-3
    np.savetxt(
        tmp_path / "run.csv", np.column_stack([t, t, t]), delimiter=",", header="t,u,y", comments=""
    )
    shown = quell("b0", "run.csv", "--loop", "gantry.toml")
    assert shown.code == 2
    assert "gantry.toml: NOT for several axes yet" in shown.err
    assert {path.name for path in tmp_path.iterdir()} == {"gantry.toml", "run.csv"}


@pytest.mark.trial
def test_the_controller_of_several_axes_is_exported_as_an_fmu(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """``quell export --to fmu`` takes its file; an FMU of its plant, or of both, is refused."""
    pytest.importorskip("fmpy")
    (tmp_path / "gantry.toml").write_text(GANTRY, encoding="utf-8")
    shown = quell("export", "gantry.toml", "--to", "fmu", "--out", "gantry.fmu")
    assert shown.code == 0, shown.err
    assert (tmp_path / "gantry.fmu").exists()
    for what, reason in (("plant", "has 2 and 2; write"), ("loop", "2 axes: an FMU with a plant")):
        shown = quell("export", "gantry.toml", "--to", "fmu", "--what", what, "--out", "p.fmu")
        assert shown.code == 2
        assert reason in shown.err.replace("\n", " ")
    assert not (tmp_path / "p.fmu").exists()


def test_what_is_missing_is_shown_as_a_setup_of_axes_has_it() -> None:
    """The scenario without a reference, which belongs into each [[axis]], and a plant with several signals."""
    data = gantry()
    del data["scenario"], data["plant"]
    data["axes"] = {"B0": [[5.0, 0.5], [0.4, 6.0]]}
    setup = made("a.toml", data)
    with pytest.raises(
        SetupError, match=r"scenario: missing.* reference = .* in each \[\[axis\]\]"
    ):
        setup.needed("scenario")
    with pytest.raises(SetupError, match="plant: missing.*linear"):
        setup.needed("plant")


@pytest.mark.trial
def test_the_controller_of_several_axes_is_exported_to_c(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """``quell export`` takes its file; single precision is compared in its scenario, axis by axis."""
    (tmp_path / "gantry.toml").write_text(GANTRY, encoding="utf-8")
    shown = quell("export", "gantry.toml", "--out", "c", "--name", "gantry")
    assert shown.code == 0, shown.err
    header = (tmp_path / "c" / "src" / "gantry.h").read_text()
    assert "gantry_step" in header
    single = quell("export", "gantry.toml", "--out", "d", "--precision", "single")
    assert single.code == 0, single.err
    for signal in ("u[0]", "u[1]", "v[x]", "v[y]", "y[x]", "y[y]"):
        assert f"Single precision changes {signal} by " in single.out
    assert "the measurement noise changes it by" in single.out


@pytest.mark.trial
@pytest.mark.compiled
def test_the_command_simulates_several_axes(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """Metrics of each axis, figure, record and JSON; the record is read back with its names."""
    (tmp_path / "gantry.toml").write_text(GANTRY, encoding="utf-8")
    shown = quell("run", "gantry.toml", "--json", "out.json", "--save", "run.nc", "--figures", "f")
    assert shown.code == 0, shown.err
    assert "gantry: x, dt = 0.001 s" in shown.out
    told = json.loads((tmp_path / "out.json").read_text())
    assert told["metrics"]["x"][0]["rms"] > told["metrics"]["y"][0]["rms"] > 0.0
    assert (tmp_path / "f" / "gantry.png").exists()
    run = ql.Trajectory.load(tmp_path / "run.nc")
    assert run.axis_names == ("x", "y")
    assert run["u"].shape == (501, 2)
    (tmp_path / "late.toml").write_text(
        GANTRY.replace("start = 0.1", "start = 0.7"), encoding="utf-8"
    )
    late = quell("run", "late.toml")
    assert late.code == 2
    assert "metrics[0].start = 0.7: must be less than the scenario's duration" in late.err


ALL_AXES = {"kind": "all-axes", "features": ["state", {"kind": "polynomial", "degree": 2}]}
LEARNS = {"kind": "rls", "features": [ALL_AXES, "bias"]}


def test_learners_of_all_axes_are_those_in_python() -> None:
    """One in ``[axes]`` for all, or one in each ``[[axis]]``; with guards."""
    features = ql.features.AllAxes(ql.features.State() + ql.features.Polynomial(2))
    learner = ql.learners.RLS(features + ql.features.Bias())
    tables = gantry()
    parts = {"learner": learner, "guard": ql.Guard(bound=5.0)}
    shared = gantry(axes=tables["axes"] | {"learner": LEARNS, "guard": {"bound": 5.0}})
    axis = [each | {"learner": LEARNS, "guard": {"bound": 5.0}} for each in tables["axis"]]
    for data, given in (
        (shared, parts),
        (gantry(axis=axis), {k: [v, v] for k, v in parts.items()}),
    ):
        setup = made("gantry.toml", data)
        plain = made("gantry.toml", gantry()).controller
        expected = ql.Axes(
            dict(zip(plain.names, plain.axes, strict=True)),
            plain.B0, u_min=plain.limits.low, u_max=plain.limits.high, **given,
        )  # fmt: skip
        found = setup.controller
        assert [repr(each) for each in found.axes] == [repr(each) for each in expected.axes]
        assert found.memory() == expected.memory()
        again = made("gantry.toml", tomllib.loads(toml_text(setup.tables(), "again")))
        assert repr(again.controller) == repr(found)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"learner": "rls"}, r"axes.learner.*has no features of all axes"),
        ({"guard": {}}, "axes.guard.*has no effect"),
        ({"learner": LEARNS | {"strongest": 3}}, "axes.*decide by the error of one"),
    ],
)
def test_a_learner_of_axes_that_does_not_fit_is_named(change: Any, message: str) -> None:
    """With the table that has it."""
    with pytest.raises(SetupError, match=message):
        made("a.toml", gantry(axes=gantry()["axes"] | change))


def test_features_of_all_axes_need_axes() -> None:
    """In a setup of one axis they are refused."""
    data = {
        "dt": 1e-3,
        "observer": {"kind": "model-free", "order": 2, "omega_o": 60.0, "b0": 1.0},
        "controller": {"omega_c": 8.0},
        "learner": LEARNS,
    }
    with pytest.raises(SetupError, match="give the learner to quell.Axes"):
        made("one.toml", data)
