"""Sweeps: plans, results in a folder, what fails, and what goes on after a kill."""

from __future__ import annotations

import itertools
import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.plants import two_mass_spring
from quell.setup import SetupError, made, varied
from quell.setup.description import read
from quell.setup.sweeps import sweep_of
from quell.sweeping import Measure, Normal, Plan, Range, Sweep, sweep

from .cases import cases
from .commands import Shown
from .setups import TWO_MASS

ESO = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=0.01)
LAWS: Mapping[str, Any] = {
    "adrc": ql.ADRC(ESO, omega_c=1.0),
    "learning": ql.ADRC(ESO, omega_c=1.0, learner=ql.learners.Kalman()),
    "pid": ql.baselines.PID(0.1, 0.01, 0.2, tf=0.1, dt=0.01),
}
SCENARIO = ql.Scenario(
    1.0, duration=0.3, noise=ql.signals.BandLimitedNoise(power=1e-8, sample_time=0.01)
)
PARAMETERS: Mapping[str, Any] = {"m1": Range(-0.1, 1.4), "law": ["adrc", "learning", "pid"]}

SETUP = (
    TWO_MASS
    + """\
[scenario]
reference = 1.0
duration = 0.5
noise = { kind = "noise", power = 1e-8, sample_time = 0.01 }
[sweep]
draws = 4
seed = 3
metrics = ["iae", "rms"]
[sweep.parameters]
plant.m1 = { low = 0.6, high = 1.4 }
"scenario.reference" = [1.0, 2.0]
[sweep.cases]
mine = {}
pid = { observer = "none", controller = { kind = "pid", kp = 0.1 } }
"""
)


def build(m1: float, law: str = "adrc", k: float = 1.0) -> tuple[Any, Any, ql.Scenario]:
    """Two masses with a mass and a controller; a mass below zero is an error."""
    return two_mass_spring(m1=m1, k=k), LAWS[law], SCENARIO


def values_of(result: Sweep) -> dict[str, bytes]:
    """All that a sweep found, as bytes."""
    data = result.dataset
    return {
        str(name): data[name].values.astype(bytes if name == "message" else None).tobytes()
        for name in data
    }


def setup_of(folder: Path, text: str = SETUP) -> Path:
    """A setup file with a sweep."""
    path = folder / "drive.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_plan_combines_each_draw_with_all_values_of_all_lists() -> None:
    """The last list changes first; a Latin hypercube has one draw in each of as many strata."""
    plan = Plan(
        {"a": Range(0.0, 1.0), "b": [1, 2], "c": ["x", None], "d": Normal(5.0, 2.0)}, draws=50
    )
    assert plan.runs == 200
    first = [plan.values(i) for i in range(4)]
    assert [(v["b"], v["c"]) for v in first] == [*itertools.product([1, 2], ["x", None])]
    assert len({v["a"] for v in first}) == 1
    a, d = plan.drawn["a"], plan.drawn["d"]
    assert sorted(np.floor(50 * a).astype(int).tolist()) == list(range(50))
    assert abs(np.mean(d) - 5.0) < 0.1
    assert abs(np.std(d) - 2.0) < 0.2
    assert len(set(plan.seeds.tolist())) == 50
    part = plan.part(7, 31)
    assert [part.values(i) for i in range(7, 31)] == [plan.values(i) for i in range(7, 31)]
    assert part.columns()["a"].tolist() == [plan.values(i)["a"] for i in range(7, 31)]


def test_steps_are_a_grid_and_random_draws_are_independent() -> None:
    """Steps include both ends, on a logarithmic scale, too."""
    grid = Plan({"a": Range(1.0, 100.0, steps=3, log=True), "b": Range(0.0, 1.0, steps=2)})
    assert [tuple(grid.values(i).values()) for i in range(6)] == [
        *itertools.product([1.0, 10.0, 100.0], [0.0, 1.0])
    ]
    drawn = Plan({"a": Range(1.0, 100.0, log=True)}, draws=2000, sampling="random", seed=1).drawn[
        "a"
    ]
    assert 0.45 < np.mean(drawn < 10.0) < 0.55
    assert np.min(drawn) >= 1.0
    other = Plan({"a": Range(1.0, 100.0, log=True)}, draws=2000, sampling="random", seed=2).drawn[
        "a"
    ]
    assert not np.any(drawn == other)


@pytest.mark.trial
@pytest.mark.lost
def test_each_run_of_a_sweep_is_the_run_alone_and_failing_ones_are_recorded(tmp_path: Path) -> None:
    """Controllers of three types in one sweep; each draw has its noise, and its runs share it."""
    metrics = {"iae": Measure("iae"), "late": Measure("peak_error", start=0.2), "end": last_u}
    shares: list[float] = []
    result = sweep(
        build,
        PARAMETERS,
        folder=tmp_path / "runs",
        metrics=metrics,
        limits={"late": 0.99},
        draws=7,
        progress=shares.append,
    )
    data, failed = result.dataset, result.failed
    assert data.sizes == {"run": 21}
    assert data["law"].values[:3].tolist() == ["adrc", "learning", "pid"]
    assert shares[-1] == 1.0
    light = data["m1"].values < 0.0
    assert np.any(light)
    assert np.all(failed[light])
    for i in range(21):
        if light[i]:
            assert data["message"][i].item().startswith("m1 = -")
            assert data["status"][i] == -1
            assert np.isnan(data["iae"][i])
            continue
        parts = build(data["m1"][i].item(), data["law"][i].item())
        noise = ql.Scenario(1.0, duration=0.3, noise=SCENARIO.noise, seed=data["seed"][i].item())
        run = ql.simulate(parts[0], parts[1], noise)
        again = result.repeat(i)
        assert data["iae"][i].item() == run.metrics()["iae"] == again.metrics()["iae"]
        assert data["late"][i].item() == run.metrics(start=0.2)["peak_error"]
        assert data["end"][i].item() == run["u"][-1]
        assert failed[i] == (run.metrics(start=0.2)["peak_error"] > 0.99)
    assert len(set(data["seed"].values.tolist())) == 7
    worst = result.worst("iae", 21)
    assert np.all(light[worst[: np.sum(light)]])
    assert np.all(np.diff(data["iae"].values[worst[np.sum(light) :]]) <= 0.0)
    assert result.describe(4) == result.plan.describe(4)  # type: ignore[union-attr]
    assert result.describe(4).startswith(
        f"run 4: m1 = {data['m1'][4].item():.6g}, law = learning, seed"
    )


def last_u(run: ql.Trajectory) -> float:
    """A measure of one's own."""
    return float(run["u"][-1])


@pytest.mark.lost
def test_errors_of_measures_and_of_whole_batches_are_those_of_single_runs(tmp_path: Path) -> None:
    """Runs beside them are complete; an unstable run has its status."""

    def judge(run: ql.Trajectory) -> float:
        if run["y"][0] > 0.5:
            raise ArithmeticError("too far")
        return float(run["y"][-1])

    def start(x: float, b0: float, w: int) -> tuple[Any, Any, ql.Scenario]:
        law = ql.ADRC(ql.ESO.model_free(order=1, b0=b0, omega_o=40.0, dt=0.01), omega_c=10.0)
        plant = ql.plants.LinearPlant([[1.0]], [1.0], [1.0])
        return plant, law, ql.Scenario(1.0, 1.0, x0=[x], disturbances=(0.1,) * w)

    grid = {"x": [0.0, 1.0], "b0": [1.0, -1.0], "w": [1, 3]}
    result = sweep(start, grid, folder=tmp_path / "a", metrics={"end": judge}, runs_per_file=3)
    data = result.dataset
    messages = data["message"].values
    three = data["w"].values == 3.0
    assert all("disturbances has 3 signals" in text for text in messages[three])
    far = ~three & (data["x"].values == 1.0)
    assert set(messages[far]) == {"ArithmeticError: too far"}
    fine = ~three & (data["x"].values == 0.0)
    assert np.all(messages[fine] == "")
    wrong = fine & (data["b0"].values == -1.0)
    assert np.all((data["status"].values[wrong] & int(ql.Status.DIVERGED)) != 0)
    assert np.array_equal(result.failed, three | far | wrong)


@pytest.mark.trial
def test_threads_processes_and_parts_of_any_size_give_the_same_bits(tmp_path: Path) -> None:
    """And so does a given executor."""
    found = [
        values_of(
            sweep(
                build,
                PARAMETERS,
                folder=tmp_path / str(size),
                draws=5,
                runs_per_file=size,
                workers=workers,
            )
        )
        for size, workers in ((1, 2), (4, 1), (100, 1))
    ]
    assert found[0] == found[1] == found[2]


@pytest.mark.trial
@pytest.mark.lost
def test_a_sweep_that_stopped_goes_on_with_what_is_missing(tmp_path: Path) -> None:
    """What is done stays as it is; until then the results have what is done."""
    whole = sweep(build, PARAMETERS, folder=tmp_path / "whole", draws=4, runs_per_file=2)
    calls: list[float] = []

    def counted(**values: Any) -> Any:
        calls.append(values["m1"])
        return build(**values)

    def stop(share: float) -> None:
        if share > 0.3:
            raise KeyboardInterrupt

    options: dict[str, Any] = {"folder": tmp_path / "part", "draws": 4, "runs_per_file": 2}
    with pytest.raises(KeyboardInterrupt):
        sweep(counted, PARAMETERS, **options, progress=stop, workers=1)
    assert len(calls) < 36  # of 12 runs three times: tried, timed, done
    part = Sweep.open(tmp_path / "part")
    done, missing = part.done, part.missing
    assert 0 < missing < 12
    assert np.array_equal(
        part.dataset["iae"].values[done], whole.dataset["iae"].values[done], equal_nan=True
    )
    assert np.all(part.dataset["status"].values[~done] == -2)
    assert not np.any(part.failed[~done])
    assert set(part.worst(count=12)) == set(np.flatnonzero(done).tolist())
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "part").iterdir()}
    calls.clear()
    rest = sweep(counted, PARAMETERS, **options)
    assert len(calls) == missing + 1  # one that is done is repeated, to compare
    assert values_of(rest) == values_of(whole)
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())
    calls.clear()
    assert values_of(sweep(counted, PARAMETERS, **options)) == values_of(whole)
    assert calls == []


@pytest.mark.trial
def test_a_killed_process_leaves_whole_files_and_its_sweep_goes_on(tmp_path: Path) -> None:
    """With SIGKILL, in the middle of the sweep, so that nothing can be cleaned up."""
    setup = setup_of(tmp_path, SETUP.replace("draws = 4", "draws = 12"))
    code = (
        "import quell as ql; from quell.kernels import dispatch; dispatch.interpret_all = True\n"
        "from quell.setup import load; from quell.setup.loading import sweep_of\n"
        "ql.sweep(**sweep_of(load('drive.toml')), folder='killed', runs_per_file=5, workers=1)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path)
    deadline = time.monotonic() + 60.0
    while len([*tmp_path.glob("killed/runs-*.nc")]) < 2:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert 0 < Sweep.open(tmp_path / "killed").missing < 48
    arguments = sweep_of(made(*read(setup)))
    rest = sweep(**arguments, folder=tmp_path / "killed")
    assert rest.missing == 0
    assert values_of(rest) == values_of(sweep(**arguments, folder=tmp_path / "whole"))


def test_folders_of_other_sweeps_and_other_files_are_refused(tmp_path: Path) -> None:
    """The error says what differs; nothing is changed."""
    folder = tmp_path / "runs"
    sweep(build, {"m1": [1.0, 2.0]}, folder=folder)
    files = sorted(folder.iterdir())
    for change, what in (
        ({"parameters": {"m1": [1.0, 3.0]}}, "parameters, values of the parameters"),
        ({"seed": 1}, "seed"),
        ({"metrics": ["rms"]}, "metrics"),
        ({"limits": {"iae": 1.0}}, "limits"),
        ({"build": lambda m1: build(m1)}, "build"),
    ):
        given: dict[str, Any] = {"build": build, "parameters": {"m1": [1.0, 2.0]}} | change
        with pytest.raises(
            ValueError, match=f"the results of another sweep, which differs in {what}"
        ):
            sweep(**given, folder=folder)
    assert sorted(folder.iterdir()) == files
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="holds other files"):
        sweep(build, {"m1": [1.0]}, folder=tmp_path)
    with pytest.raises(ValueError, match="must be a folder, is a file"):
        sweep(build, {"m1": [1.0]}, folder=tmp_path / "notes.txt")
    with pytest.raises(ValueError, match="holds no sweep: sweep.json can't be read"):
        Sweep.open(tmp_path)
    (tmp_path / "sweep.json").write_text('{"format": "other"}')
    with pytest.raises(ValueError, match="holds no sweep: sweep.json is none of quell's"):
        Sweep.open(tmp_path)


def test_a_build_function_whose_surroundings_changed_does_not_go_on(tmp_path: Path) -> None:
    """Its source is the same, but a run that is done has other numbers now."""
    weights = [1.0]

    def heavy(m1: float) -> Any:
        return build(m1 * weights[0])

    result = sweep(heavy, {"m1": [1.0, 2.0]}, folder=tmp_path / "runs", runs_per_file=1)
    result.store.file(1).unlink()
    weights[0] = 2.0
    with pytest.raises(ValueError, match="run 0 has .* what build uses has changed"):
        sweep(heavy, {"m1": [1.0, 2.0]}, folder=tmp_path / "runs")
    weights[0] = 1.0
    assert sweep(heavy, {"m1": [1.0, 2.0]}, folder=tmp_path / "runs").missing == 0


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    """With what to do, whatever HDF5 says."""
    result = sweep(build, {"m1": [1.0, 2.0]}, folder=tmp_path / "runs")
    path = result.store.file(0)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"runs-0000000000.nc'.*can't be read.*remove it"):
        _ = Sweep.open(tmp_path / "runs").failed
    path.unlink()
    assert sweep(build, {"m1": [1.0, 2.0]}, folder=tmp_path / "runs").missing == 0


@cases(
    ("change", "message"),
    [
        (
            {"parameters": {"m2": [1.0]}},
            r"parameters\['m2'\]: build has no such parameter, must be one of m1, law, k",
        ),
        ({"parameters": {"law": ["pid"]}}, "build can't be called with them: missing a required"),
        ({"parameters": {"m1": []}}, r"parameters\['m1'\] is empty"),
        ({"parameters": {"m1": [float("nan")]}}, r"parameters\['m1'\] = nan: must be a finite"),
        ({"parameters": {"m1": [-1.0, -2.0]}}, "none of 2 runs that were tried works: m1 = -1.0"),
        ({"parameters": [1.0]}, "must be a dictionary of values by name"),
        ({"parameters": {"m1": Range(0.0, 1.0)}, "draws": 0}, "draws = 0"),
        ({"draws": 10**9, "parameters": {"m1": [1.0, 2.0]}}, "must be at most 1e"),
        ({"sampling": "sobol"}, "sampling = 'sobol': must be one of latin-hypercube, random"),
        ({"metrics": ["rmse"]}, "metrics: 'rmse' is unknown, did you mean rms?"),
        ({"metrics": []}, "metrics is empty"),
        ({"metrics": {"a": 3}}, r"metrics\['a'\] = 3"),
        ({"limits": {"ise": 1.0}}, r"limits\['ise'\]: is none of the metrics"),
        ({"build": 3}, "build = 3: must be a function"),
        ({"build": lambda m1: m1}, "none of 1 runs that were tried works: build returned 1.0"),
        (
            {"executor": "processes", "build": lambda m1: build(m1)},
            "build and functions in metrics must be functions",
        ),
        ({"executor": "tcp://127.0.0.1"}, "no scheduler answers there"),
        ({"runs_per_file": 0}, "runs_per_file = 0"),
    ],
)
def test_bad_arguments_are_named_before_anything_is_written(
    change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    """One error, and no folder."""
    given: dict[str, Any] = {"build": build, "parameters": {"m1": [1.0]}} | change
    with pytest.raises(ValueError, match=message):
        sweep(**given, folder=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("change", [{"high": 0.0}, {"low": -1.0, "log": True}, {"steps": 1}])
def test_ranges_without_values_are_refused(change: dict[str, Any]) -> None:
    """The error names the argument."""
    with pytest.raises(ValueError, match=next(iter(change))):
        Range(**{"low": 0.5, "high": 1.0, **change})


def test_a_setup_in_a_sweep_is_the_one_with_these_values(tmp_path: Path) -> None:
    """Parts that did not change are not built again, and have the same numbers."""
    setup = made(*read(setup_of(tmp_path)))
    arguments = sweep_of(setup)
    variation = arguments["build"]
    for changes in (
        {"plant.m1": 0.7},
        {"plant.m1": 0.8, "controller.omega_c": 2.0},
        {"plant.m1": 0.8, "observer.omega_o": 20.0},
        {"plant.m1": 0.8, "dt": 0.02},
        {"scenario.noise.power": 1e-6},
    ):
        mine, other = variation(**changes), varied(setup, changes)
        assert np.array_equal(mine.plant.A, other.plant.A)
        assert str(mine.controller.parameters) == str(other.controller.parameters)
        assert mine.scenario == other.scenario
    first, second = variation(**{"plant.m1": 0.9}), variation(**{"plant.m1": 1.0})
    assert first.controller is second.controller
    assert first.scenario is second.scenario
    result = sweep(**arguments, folder=tmp_path / "runs")
    data = result.dataset
    assert data["case"].values[:2].tolist() == ["mine", "pid"]
    assert data["scenario.reference"].values[:4].tolist() == [1.0, 1.0, 2.0, 2.0]
    assert not np.any(result.failed)


@cases(
    ("old", "new", "message"),
    [
        ("plant.m1", "plant.m3", "sweep.parameters, case mine: plant.m3: unknown; must be one of"),
        ("low = 0.6", "low = 1.6", "sweep: parameters.plant.m1: low = 1.6"),
        ("low = 0.6", "steps = 3", "sweep: parameters.plant.m1: .*low"),
        ("low = 0.6", "low = -3.0", "sweep.parameters, case mine: plant.m1 = -0.7"),
        (
            '"scenario.reference"',
            '"scenario.x.y"',
            "sweep.parameters, case mine: scenario.x: unknown",
        ),
        (
            "plant.m1",
            "observer.b0",
            "sweep.parameters, case pid: observer.kind: missing; observer.b0 fits the case mine, "
            "but a parameter must fit all cases",
        ),
        ("kp = 0.1", "kq = 0.1", "sweep.cases.pid: controller.kq: unknown"),
        ('"rms"', '"rmse"', "sweep.metrics: 'rmse' is unknown, did you mean rms?"),
        ("seed = 3", "limits = { ise = 1.0 }", "sweep.limits.ise: is none of the metrics"),
        (
            "plant.m1 = { low = 0.6, high = 1.4 }",
            '"tune.m_s" = { low = 1.0, high = 2.0 }',
            "sweep.parameters: tune.m_s: no run uses it; sweep keys of dt, plant, observer",
        ),
        (
            "plant.m1 = { low = 0.6, high = 1.4 }",
            '"scenario.seed" = [1, 2]',
            "sweep.parameters: scenario.seed: no run uses it; seed and draws of .sweep. are",
        ),
        ("mine = {}", 'mine = { title = "a" }', "sweep.cases.mine: title: no run uses it"),
        ("draws = 4", "drows = 4", "sweep.drows: unknown; did you mean draws?"),
    ],
)
def test_what_a_sweep_varies_and_the_setup_does_not_have_is_named(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    """With the file and the place in it."""
    assert old in SETUP
    with pytest.raises(SetupError, match=f"^drive.toml: {message}"):
        sweep_of(made(*read(setup_of(tmp_path, SETUP.replace(old, new)))))


def test_draws_need_something_that_is_drawn_or_random(tmp_path: Path) -> None:
    """Noise in one of the scenarios, a distribution, or a seed that the function takes."""
    still = ql.Scenario(1.0, duration=0.1)
    plant, law = two_mass_spring(), LAWS["adrc"]

    def noisy(scenario: Any) -> Any:
        return plant, law, scenario

    def seeded(seed: int) -> Any:
        return plant, law, still

    options: dict[str, Any] = {"draws": 3, "executor": None}
    with pytest.raises(ValueError, match=r"^draws = 3: nothing in the scenario is random and no"):
        sweep(noisy, {"scenario": [still, still]}, folder=tmp_path / "a", **options)
    assert not (tmp_path / "a").exists()
    sweep(noisy, {"scenario": [still, SCENARIO]}, folder=tmp_path / "b", **options)
    sweep(seeded, {}, folder=tmp_path / "c", **options)


@pytest.mark.trial
def test_the_command_does_a_sweep_and_repeats_a_run(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """A summary, figures, JSON, and the command for the worst run."""
    setup_of(tmp_path)
    shown = quell(
        "sweep", "drive.toml", "--workers", "1", "--json", "found.json", "--figures", "figures"
    )
    assert shown.code == 0
    assert "16 runs, 0 fail" in shown.out
    found = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    worst = found["worst"][0]["run"]
    assert f"To repeat one: quell sweep drive.toml --repeat {worst}" in shown.out
    figures = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert figures == {"drive-plant-m1", "drive-scenario-reference", "drive-case"}
    again = quell(
        "sweep", "drive.toml", "--repeat", str(worst), "--no-figures", "--json", "run.json"
    )
    assert again.code == 0
    assert "In drive-sweep/: the same, bit for bit." in again.out
    run = json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    assert run["metrics"][0]["iae"] == found["worst"][0]["iae"]
    assert run["as_stored"] is True
    for arguments, message in (
        (("--repeat", "16"), "run = 16: must be a whole number from 0 to 15"),
        (("--save", "a.nc"), "--save is for the record of one run"),
        (("--dask", "tcp://127.0.0.1", "--folder", "other"), "no scheduler answers there"),
        (("--dask", "127.0.0.1", "--folder", "other"), "dask = '127.0.0.1': must be the address"),
    ):
        refused = quell("sweep", "drive.toml", "--no-figures", *arguments)
        assert refused.code == 2
        assert message in refused.err
    (tmp_path / "plain.toml").write_text(SETUP.partition("[sweep]")[0], encoding="utf-8")
    assert "sweep: missing; give a table [sweep]" in quell("sweep", "plain.toml").err


@pytest.mark.parametrize(
    ("varied", "told"),
    [
        ("[sweep.parameters]\ndt = [0.01, 0.02]\n", True),
        ("[sweep.parameters]\nplant.m1 = [0.9]\n[sweep.cases]\na = {}\nb = { dt = 0.02 }\n", True),
        ("[sweep.parameters]\nplant.m1 = [0.9]\ndt = [0.01]\n", False),
    ],
)  # fmt: skip
def test_what_varies_dt_is_told_as_not_comparable(
    varied: str, told: bool, quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """Measures are of samples; a parameter or a case may be the dt."""
    before = SETUP.partition("draws")[0].replace("duration = 0.5", "duration = 0.2")
    setup_of(tmp_path, f'{before}metrics = ["rms"]\n{varied}')
    shown = quell("sweep", "drive.toml", "--workers", "1", "--no-figures", "--json", "a.json")
    assert shown.code == 0, shown.err
    assert ("NOT comparable over dt" in shown.out) == told
    notes = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))["notes"]
    assert [note[:22] for note in notes] == ["NOT comparable over dt"] * told


@pytest.mark.trial
def test_a_cluster_that_loses_a_worker_finds_what_this_machine_finds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit for bit, for controllers of two types, with one of two workers killed.

    The killed one is a process and is not started again; the other is a thread of this process.
    """
    distributed = pytest.importorskip("distributed")
    arguments = sweep_of(made(*read(setup_of(tmp_path, SETUP.replace("draws = 4", "draws = 10")))))
    local = sweep(**arguments, folder=tmp_path / "local")
    killed: list[int] = []
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")  # the process runs plain Python, as this one
    options = {"nthreads": 1, "local_directory": str(tmp_path)}
    workers = {
        "process": {"cls": distributed.Nanny, "options": options},
        "thread": {"cls": distributed.Worker, "options": options},
    }
    scheduler = {"cls": distributed.Scheduler, "options": {"port": 0, "dashboard": False}}
    with distributed.SpecCluster(workers, scheduler, silence_logs=logging.ERROR) as cluster:

        def kill(share: float) -> None:
            if 0.2 < share < 0.8 and not killed:
                process = cluster.workers["process"]
                process.auto_restart = False
                killed.append(process.pid)
                os.kill(killed[0], signal.SIGKILL)

        address = cluster.scheduler_address
        where: dict[str, Any] = {"folder": tmp_path / "cluster", "executor": address}
        remote = sweep(**arguments, **where, runs_per_file=2, progress=kill)
    assert killed
    assert remote.missing == 0
    assert values_of(remote) == values_of(local)


def counted(n: Any, gain: float) -> Any:
    """A loop with a whole number as a parameter, of which 3 has no plant and 2 the wrong sign."""
    assert type(n) is int, f"n = {n!r}"
    if n == 3:
        raise ValueError("there is no plant with n = 3")
    plant = ql.plants.LinearPlant.of(([50.0 * gain], [1.0, 4.0, 0.0]))
    observer = ql.ESO.model_free(order=2, b0=-50.0 if n == 2 else 50.0, omega_o=20.0, dt=0.01)
    controller = ql.ADRC(observer, omega_c=4.0, u_min=-10.0, u_max=10.0)
    return plant, controller, ql.Scenario(reference=ql.signals.Step(at=0.2), duration=3.0)


def test_whole_numbers_stay_whole_and_failed_runs_are_named(tmp_path: Path) -> None:
    """0 as 0, not 0.0; the warning has counts, parameters and reasons, and stands at the caller."""
    options: dict[str, Any] = {"folder": tmp_path / "runs", "workers": 1}
    options |= {"metrics": ["overshoot", "rms"], "limits": {"overshoot": 0.5}}
    options |= {"parameters": {"n": [0, 1, 2, 3], "gain": 1.0}}
    with pytest.warns(RuntimeWarning, match="2 of 4 runs failed: run 2: n = 2, gain = 1") as seen:
        found = sweep(counted, **options)
    assert [each.filename for each in seen] == [__file__]
    text = str(seen[0].message)
    assert "y ran away from r" in text
    assert "run 3: n = 3" in text
    assert text.endswith("there is no plant with n = 3")
    assert found.failed.tolist() == [False, False, True, True]
    assert found.complete.tolist() == [True, True, False, False]
    assert found.errors.tolist() == [3]
    assert [bool(found.reason(run)) for run in range(4)] == [False, False, True, True]
    assert np.isnan(found.dataset["overshoot"].values).tolist() == [False, False, True, True]
    assert found.worst("rms", 2) == [2, 3]


def test_the_command_names_failed_runs_and_its_exit_code_does_so(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """An order of 0 is refused by the observer; b0 of the wrong sign makes y run away."""
    text = SETUP.partition("[sweep]")[0].replace("duration = 0.5", "duration = 0.2")
    more = '[sweep]\nmetrics = ["rms"]\n[sweep.parameters]\n"observer.order" = [4, 0]\n'
    setup_of(tmp_path, text + more)
    shown = quell("sweep", "drive.toml", "--workers", "1", "--no-figures", "--json", "a.json")
    assert shown.code == 8
    assert "2 runs, 1 fail" in shown.out
    assert "NOT done: run 1: observer.order = 0" in shown.out
    found = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))
    assert found["errors"] == 1
    (failed,) = found["failed_runs"]
    assert failed["run"] == 1
    assert "order = 0:" in failed["reason"]
