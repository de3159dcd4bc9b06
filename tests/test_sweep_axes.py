"""Sweeps over setups of several axes: each run is that of ``simulate``, each measure that of its axis."""

from __future__ import annotations

import copy
import json
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.setup import SetupError, made
from quell.setup.sweeps import sweep_of
from quell.sweeping.measures import Measure, as_measures
from quell.sweeping.runs import Plan
from quell.tuning.report import toml_text

from .cases import cases
from .commands import Shown
from .setups import GANTRY

SWEEP = {
    "parameters": {"axis[1].controller.omega_c": [4.0, 8.0, -1.0], "plant.B": [[[0, 0], [5, 0.5], [0, 0], [0.4, 6]]]},
    "metrics": ["rms", "peak_error"],
    "limits": {"rms": 0.05},
}  # fmt: skip


def gantry(**changes: Any) -> dict[str, Any]:
    """Return the tables of a short run of a gantry with a sweep."""
    data = copy.deepcopy(tomllib.loads(GANTRY))
    data["scenario"] = data["scenario"] | {"duration": 0.3}
    return data | {"sweep": SWEEP} | changes


@pytest.mark.trial
def test_each_run_is_that_of_simulate(tmp_path: Path) -> None:
    """Measures of both axes, bit for bit; a run that cannot be built is recorded, and the others are done."""
    setup = made("gantry.toml", gantry())
    with pytest.warns(
        RuntimeWarning, match=r"1 of 3 runs failed: run 2: axis\[1\]\.controller\.omega_c"
    ):
        found = ql.sweep(**sweep_of(setup), folder=tmp_path / "sweep", workers=1)
    assert sorted(sweep_of(setup)["metrics"]) == [
        "x.peak_error",
        "x.rms",
        "y.peak_error",
        "y.rms",
    ]
    for i, omega_c in enumerate((4.0, 8.0)):
        data = gantry()
        data["axis"][1]["controller"]["omega_c"] = omega_c
        one = made("gantry.toml", data)
        # The run has the seed of its draw.
        plan = Plan(setup.sweep["parameters"], 1, "latin-hypercube", 0)  # type: ignore[index]
        scenario = replace(one.needed("scenario"), seed=plan.part(i, i + 1).seed(i))
        run = ql.simulate(one.plant, one.controller, scenario)
        for name in ("x", "y"):
            expected = run.metrics(0.1)[name]["rms"]
            assert float(found.dataset[f"{name}.rms"][i]) == expected
    assert int(found.dataset["status"][2]) == -1
    assert np.isnan(float(found.dataset["x.rms"][2]))


def test_a_measure_names_its_axis() -> None:
    """Before the name of the measure; without an axis, or with one too many, the error says so."""
    assert as_measures(["elbow.rms"]) == {"elbow.rms": Measure("rms", axis="elbow")}
    with pytest.raises(ValueError, match="'rsm' is unknown"):
        as_measures(["elbow.rsm"])
    with pytest.raises(SetupError, match="sweep.limits.iae: is none of the metrics"):
        sweep_of(made("a.toml", gantry(sweep=SWEEP | {"limits": {"iae": 1.0}})))
    with pytest.raises(SetupError, match="sweep.parameters: axis.9..controller.omega_c"):
        sweep_of(
            made("a.toml", gantry(sweep={"parameters": {"axis[9].controller.omega_c": [1.0]}}))
        )
    with pytest.raises(SetupError, match="sweep: missing"):
        sweep_of(made("a.toml", {k: v for k, v in gantry().items() if k != "sweep"}))


@cases(
    ("metrics", "message"),
    [
        ([".rms"], r"metrics: '.rms': has no axis before the point; give rms, or AXIS.rms"),
        ({"a": ".rms"}, r"'.rms': has no axis before the point"),
        (["elbow."], "metrics: '' is unknown"),
        (["rms", Measure("rms")], r"metrics\[1\] = Measure.*: a list has names"),
        ([np.max], r"metrics\[0\] = <.*: a list has names"),
        ({Measure("rms"): "rms"}, "the name of a measure must be a text"),
        ({"": "rms"}, "the name of a measure must be a text"),
        ({3: Measure("rms")}, "metrics: 3: the name of a measure must be a text"),
    ],
)
def test_measures_without_a_name_of_their_own_are_refused(metrics: Any, message: str) -> None:
    """A variable of the results needs one that is a text."""
    with pytest.raises(ValueError, match=message):
        as_measures(metrics)
    with pytest.raises(ValueError, match="axis = 3: must be the name of an axis"):
        Measure("rms", axis=3)  # type: ignore[arg-type]


def test_an_unknown_axis_is_refused_before_anything_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The line has the name that was meant; nothing is written."""
    setup = made("gantry.toml", gantry())
    given = sweep_of(setup)
    monkeypatch.setattr("quell.sweeping.runs.simulate", lambda *parts: pytest.fail("a run"))
    given |= {"limits": {}, "workers": 1, "folder": tmp_path / "sweep"}
    for metrics, message in (
        (["xx.rms"], "metrics: xx.rms: the run has no axis 'xx', did you mean x"),
        ({"late": Measure("rms", axis="z")}, "metrics: z.rms: the run has no axis 'z'"),
        (["rms"], "metrics: rms: the run has several axes; name one, x.rms"),
    ):
        with pytest.raises(ValueError, match=message):
            ql.sweep(**given | {"metrics": metrics})
    assert not (tmp_path / "sweep").exists()


@pytest.mark.trial
def test_the_command_sweeps_and_repeats_a_run(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """Of two axes; the run that is repeated has the stored measures."""
    (tmp_path / "gantry.toml").write_text(toml_text(gantry()))
    shown = quell("sweep", "gantry.toml", "--workers", "1", "--no-figures", "--json", "a.json")
    assert shown.code == 8, shown.err  # one of the runs cannot be built
    assert "y.rms" in shown.out
    assert json.loads((tmp_path / "a.json").read_text())["setup"]["axis"]
    again = quell("sweep", "gantry.toml", "--repeat", "1", "--no-figures")
    assert again.code == 0, again.err
    assert "the same, bit for bit" in again.out


@pytest.mark.trial
def test_the_variation_of_v_over_another_b0_is_told_as_not_comparable(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """The plant's B0 and a B0 of its own are in other units; without a measure of u, or of another parameter, no line."""
    for metrics, parameters, told in (
        (["control_variation"], {"plant.B[1][0]": [5.0, 6.0]}, "plant.B[1][0]: x.control_var"),
        (["control_variation"], {"axis[0].controller.omega_c": [7.0, 8.0]}, ""),
        (["rms"], {"plant.B[1][0]": [5.0, 6.0]}, ""),
    ):
        data = gantry()
        data["sweep"] = {"metrics": metrics, "parameters": parameters}
        data["scenario"]["duration"] = 0.12
        (tmp_path / "gantry.toml").write_text(toml_text(data))
        folder = str(tmp_path / f"{len(list(tmp_path.iterdir()))}")
        shown = quell("sweep", "gantry.toml", "--workers", "1", "--no-figures", "--folder", folder)
        assert shown.code == 0, shown.err
        assert (f"NOT comparable over {told}" in shown.out) == bool(told)
        assert ("NOT comparable" in shown.out) == bool(told)
