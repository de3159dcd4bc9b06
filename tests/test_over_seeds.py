"""Controllers over seeds: each number is that of a single run, and what the seeds do not decide begins with NOT."""

from __future__ import annotations

import copy
import json
import math
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

import quell as ql
from quell.experiments import over_seeds
from quell.experiments.over_seeds import ALL_AXES, _verdicts
from quell.records.metrics import MEASURES
from quell.setup import made
from quell.setup.loading import Setup
from quell.tuning.report import toml_text

from .cases import cases
from .commands import Shown
from .setups import GANTRY

NOISY = {"kind": "noise", "power": 1e-9, "sample_time": 1e-3}


def gantry(omega_c: float = 8.0, noise: Any = NOISY, **scenario: Any) -> dict[str, Any]:
    """Return the tables of a gantry of two axes, of which the first is quicker or slower."""
    data = copy.deepcopy(tomllib.loads(GANTRY))
    data["scenario"] |= {"duration": 0.3} | scenario
    data["axis"][0]["controller"]["omega_c"] = omega_c
    for axis in data["axis"]:
        axis["noise"] = noise
        axis["signal"] = "way [m]"
    return data


def setups(*omega_c: float, **options: Any) -> dict[str, Setup]:
    """Return setups by name."""
    return {f"c{omega:g}": made(f"c{omega:g}", gantry(omega, **options)) for omega in omega_c}


@pytest.mark.trial
def test_each_number_is_that_of_a_single_run() -> None:
    """Every measure of each axis, setup and seed, bit for bit; mean, interval and total are those of SciPy."""
    given = setups(8.0, 12.0)
    found = over_seeds.of_setups(given, seeds=4)
    assert (found.seeds, found.axes, found.units) == ((3, 4, 5, 6), ("x", "y"), ("m", "m"))
    first = given["c8"]
    for j, setup in enumerate(given.values()):
        for s, seed in enumerate(found.seeds):
            scenario = replace(first.needed("scenario"), seed=seed)
            run = ql.simulate(first.plant, setup.controller, scenario).metrics(0.1)
            for i, axis in enumerate(found.axes):
                for name in MEASURES:
                    value = found.values[name][j, 0, i, s]
                    expected = run[axis].get(name, math.nan)
                    assert value == expected or (np.isnan(value) and np.isnan(expected))
    x = found.values["rms"][:, 0, 0]
    middle, half = found.mean("rms", "c12", 0, 0)
    interval = stats.t.interval(0.95, 3, np.mean(x[1]), stats.sem(x[1]))
    assert (middle - half, middle + half) == pytest.approx(interval)
    pair = found.verdicts[0].pairs[0]
    level = 0.05 / 3  # one pair for each of x, y, and all axes
    d = np.log(x[0]) - np.log(x[1])
    ends = stats.t.interval(1.0 - level, 3, np.mean(d), stats.sem(d))
    assert (pair.least, pair.most) == pytest.approx(tuple(1.0 - np.exp(-np.array(ends))))
    ratio, _ = found.ratio("c12", 0)
    rms = found.values["rms"][:, 0]
    assert ratio == pytest.approx(stats.gmean((rms[1] / rms[0]).ravel()))


@pytest.mark.trial
def test_what_the_seeds_do_not_decide_begins_with_not() -> None:
    """The quicker axis is better; the other axis is NOT decided, with the seeds that would do, or alike."""
    found = over_seeds.of_setups(setups(8.0, 12.0), seeds=5)
    x, y, together = found.verdicts
    assert (x.best, y.best, together.axis) == ("c12", None, ALL_AXES)
    lines = found.describe().splitlines()
    assert lines[0].startswith("x, 0.1 to 0.3 s: best is c12: RMS error ")
    assert lines[1].startswith("NOT decided: y, 0.1 to 0.3 s: ")
    assert "seeds" in lines[1]
    same = over_seeds.of_setups({"a": (one := made("a", gantry())), "b": replace(one)}, seeds=3)
    assert all(verdict.best is None for verdict in same.verdicts)
    assert same.describe().count("alike, as far as 3 seeds show") == 3


@pytest.mark.trial
@pytest.mark.parametrize("coupled", [True, False])
@pytest.mark.parametrize(("noise", "seeds"), [(NOISY, 3), (0.0, 1)])
def test_an_axis_at_rest_is_alike_and_left_out_of_all_axes(
    coupled: bool, noise: Any, seeds: int
) -> None:
    """Its criterion is zero or the rounding of the other axis, 1e-20 here; a line with NOT says that it has no ratio."""
    given = {}
    for omega in (8.0, 12.0):
        data = gantry(omega)
        data["scenario"]["disturbances"] = [0.0, 0.0]
        data["axis"][0]["noise"], data["axis"][1]["noise"] = noise, 0.0
        if not coupled:
            data["plant"]["B"] = [[0, 0], [5, 0], [0, 0], [0, 6]]
        given[f"c{omega:g}"] = made("gantry", data)
    found = over_seeds.of_setups(given, seeds=seeds)
    still = found.values["rms"][:, 0, 1]
    assert np.all(still < 1e-17)
    assert np.all(still > 0.0) if coupled else np.all(still == 0.0)
    x, y, together = found.verdicts
    assert (x.best, y.best, together.best) == ("c12", None, "c12")
    assert y.pairs[0].lower == 0.0
    assert together.left_out == ("y",)
    assert together.pairs[0].lower == pytest.approx(x.pairs[0].lower, abs=1e-12)
    assert found.ratio("c12", 0)[0] == pytest.approx(found.values["rms"][1, 0, 0].mean() / found.values["rms"][0, 0, 0].mean(), rel=1e-3)  # fmt: skip
    line = "NOT in all axes, 0.1 to 0.3 s: y: RMS error is zero or rounding there, and has no ratio"
    assert line in found.describe().splitlines()


def test_a_criterion_of_zero_beside_one_that_is_not_decides_its_own_axis_only() -> None:
    """Without any axis that has a ratio there is no verdict on all axes, and none is called best."""
    values = np.array([[[[0.0, 1e-13], [1.1, 1.1]]], [[[0.5, 0.6], [1.0, 1.0]]]])
    lost = np.zeros((2, 2), bool)
    given = ("a", "b"), ("x", "y"), [(0.0, 1.0)]
    x, y, together = _verdicts(*given, values, lost, 0.05, np.full((1, 2), 1e-9))
    assert (x.best, y.best, together.best, together.left_out) == ("a", "b", "b", ("x",))
    values[0, 0, 1] = 0.0
    *_, together = _verdicts(*given, values, lost, 0.05, np.full((1, 2), 1e-9))
    assert (together.best, together.left_out) == (None, ("x", "y"))
    line = "NOT in all axes, 0 to 1 s: x, y: RMS error is zero or rounding there, and has no ratio"
    assert together.describe("rms", 2) == [line]


def test_small_real_errors_are_no_rounding() -> None:
    """Of 1e-10 m with r = 0 beside an axis of 100 degrees, and where one controller is far off."""
    largest = np.array([[[[3e-10], [100.0]]], [[[5e-10], [1e8]]]])
    no = np.zeros((2, 1), bool)
    found = over_seeds._rounding(largest, no, [(0.0, 2.0)], "rms")
    assert found[0] == pytest.approx([1e-12, 1e-10])
    assert over_seeds._rounding(largest, no, [(0.0, 2.0)], "iae") == pytest.approx(2.0 * found)


@pytest.mark.trial
def test_differences_of_rounding_are_alike_in_all_seeds() -> None:
    """An omega_c of 8 and one of 8.0000000001 differ by 1e-9 % in each seed, which no model has."""
    given = {"a": made("a", gantry(8.0)), "b": made("b", gantry(8.0000000001))}
    found = over_seeds.of_setups(given, seeds=3)
    pair = found.verdicts[0].pairs[0]
    assert 0.0 < pair.least < pair.most < 1e-9
    assert (pair.decided, pair.needed) == (False, 0)
    assert [verdict.best for verdict in found.verdicts] == [None] * 3
    assert found.describe().count("alike, as far as 3 seeds show") == 3


@pytest.mark.trial
def test_in_95_of_100_cases_no_controller_is_called_better_that_is_not() -> None:
    """Of three that are alike, in skewed and correlated criteria of two axes: at most 5 % of draws have a verdict."""
    rng = np.random.default_rng(2)
    count, wrong = 1000, 0
    for _ in range(count):
        shared = rng.normal(size=(1, 1, 2, 10))
        values = np.exp(0.3 * shared + 0.2 * rng.gamma(2.0, size=(3, 1, 2, 10)))
        lost = np.zeros((3, 10), bool)
        given = values, lost, 0.05 / 9, np.zeros((1, 2))
        found = _verdicts(("a", "b", "c"), ("x", "y"), [(0.0, 1.0)], *given)
        wrong += any(pair.decided for verdict in found for pair in verdict.pairs)
    assert wrong / count < 0.06
    assert wrong > 0


def test_without_anything_random_there_is_one_run_and_that_is_said() -> None:
    """Several seeds are refused there, one seed where noise is drawn."""
    quiet = setups(8.0, 12.0, noise=0.0)
    found = over_seeds.of_setups(quiet)
    assert found.seeds == (3,)
    assert found.verdicts[0].best == "c12"
    assert found.describe().splitlines()[-1].startswith("NOT shown for other noise")
    with pytest.raises(ValueError, match="seeds = 5: nothing in the scenario is random"):
        over_seeds.of_setups(quiet, seeds=5)
    with pytest.raises(ValueError, match="seeds = 1: one run cannot tell luck from better"):
        over_seeds.of_setups(setups(8.0, 12.0), seeds=1)


@pytest.mark.trial
def test_a_setup_that_diverges_is_named_and_has_no_verdict() -> None:
    """Its numbers are NaN, and a line with NOT counts its runs."""
    wrong = gantry(8.0)
    wrong["axes"] |= {"B0": [[-5.0, 0.0], [0.0, -6.0]], "u_max": 1e9, "u_min": -1e9}
    wrong["axis"][0]["observer"]["omega_o"] = wrong["axis"][1]["observer"]["omega_o"] = 400.0
    given = setups(8.0) | {"wrong": made("wrong", wrong)}
    found = over_seeds.of_setups(given, seeds=2)
    assert found.diverged.tolist() == [[False, False], [True, True]]
    assert np.all(np.isnan(found.values["rms"][1]))
    assert found.verdicts[0].best == "c8"
    assert found.verdicts[0].pairs == ()
    text = found.describe()
    assert "c8 is the only one that never diverged" in text
    assert "NOT stable: wrong diverged or ran away in 2 of 2 runs, 15.8 to 100 % of all" in text


def test_one_axis_is_compared_in_the_same_way() -> None:
    """Two PID controllers on a lag; without axes there is no total."""
    lag = ql.plants.LinearPlant([[-1.0]], [1.0], [1.0])
    scenario = ql.Scenario(1.0, 2.0, noise=ql.signals.BandLimitedNoise(1e-6, 0.01))
    some = {f"k{k:g}": ql.baselines.PID(kp=k, ki=k, dt=0.01) for k in (2.0, 6.0)}
    found = over_seeds.over_seeds(lag, some, scenario, seeds=3, criterion="iae")
    run = ql.simulate(lag, some["k6"], replace(scenario, seed=2))
    assert found.values["iae"][1, 0, 0, 2] == run.metrics()["iae"]
    assert [verdict.axis for verdict in found.verdicts] == [""]
    assert found.verdicts[0].best == "k6"
    assert found.describe().startswith("0 to 2 s: best is k6: ∫|error| ")


@pytest.mark.trial
def test_the_variation_of_u_is_that_of_the_actuators_whatever_b0_is() -> None:
    """Half of B0 halves v of the same motors, so all have the B of the first; the rest of the measures stays."""
    half = gantry(8.0)
    half["axes"]["B0"] = [[2.5, 0.25], [0.2, 3.0]]
    given = {"one": made("one", gantry(8.0)), "half": made("half", half)}
    found = over_seeds.of_setups(given, seeds=2)
    first = given["one"]
    B = np.array([[5.0, 0.5], [0.4, 6.0]])
    for s, seed in enumerate(found.seeds):
        scenario = replace(first.needed("scenario"), seed=seed)
        run = ql.simulate(first.plant, given["half"].controller, scenario)
        moved = np.abs(np.diff(run["u"][run.t >= 0.1 - 1e-9] @ B.T, axis=0)).sum(axis=0)
        assert found.values["control_variation"][1, 0, :, s] == pytest.approx(moved)
        assert found.values["rms"][1, 0, 0, s] == run.metrics(0.1)["x"]["rms"]
    assert (
        "u of an axis is B u with B = [[5, 0.5], [0.4, 6]] for all, as their B0 differ"
        in found.notes
    )
    assert over_seeds.of_setups(setups(8.0, 9.0), seeds=2).notes == ()


@pytest.mark.trial
def test_a_variation_of_u_that_cannot_be_compared_is_no_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where B0 differ and follow the state; the errors are compared all the same."""

    def refuse(factors: Any, inputs: int) -> Any:
        raise ValueError("B0 of one, half is not one, and follows the state")

    monkeypatch.setattr(over_seeds, "one_gain", refuse)
    half = gantry(8.0)
    half["axes"]["B0"] = [[2.5, 0.25], [0.2, 3.0]]
    given = {"one": made("one", gantry(8.0)), "half": made("half", half)}
    found = over_seeds.of_setups(given, seeds=2)
    assert np.all(np.isnan(found.values["control_variation"]))
    assert np.all(np.isnan(found.values["total_variation"]))
    assert np.all(found.values["rms"] > 0.0)
    assert (
        found.describe()
        .splitlines()[-1]
        .startswith("NOT compared: variation and ∫u² dt of u: B0 of one")
    )


def in_windows(*windows: Any) -> Any:
    """Compare two controllers in these windows."""
    lag = ql.plants.LinearPlant([[-1.0]], [1.0], [1.0])
    some = {name: ql.baselines.PID(kp=2.0, dt=0.01) for name in "ab"}
    return over_seeds.over_seeds(lag, some, ql.Scenario(1.0, 2.0), windows=windows)


@cases(
    ("call", "message"),
    [
        (lambda: over_seeds.of_setups(setups(8.0)), "setups has 1: give two or more"),
        (
            lambda: over_seeds.of_setups(setups(8.0, 9.0), criterion="rsm"),
            "criterion = 'rsm'.*rms",
        ),
        (
            lambda: over_seeds.of_setups(
                setups(8.0) | {"other": made("o", gantry() | {"axis": [a | {"name": n} for a, n in zip(gantry()["axis"], "xz", strict=True)]})}
            ),
            "other has x, z, c8 x, y: must have the same axes",
        ),
        (
            lambda: over_seeds.over_seeds(
                ql.plants.arm(), {"a": ql.baselines.PID(1.0, dt=0.01), "b": setups(8.0)["c8"].controller}, ql.Scenario()
            ),
            "b has x, y, a one axis",
        ),
        (
            lambda: over_seeds.of_setups(setups(8.0, 9.0, duration=0.1)),
            r"metrics\[0\].start = 0.1: must be less than the scenario's duration",
        ),
        (
            lambda: in_windows({"start": 50.0}),
            r"windows\[0\].start = 50: must be less than the scenario's duration",
        ),
        (
            lambda: over_seeds.of_setups(setups(8.0) | {"longer": made("l", gantry() | {"dt": 2e-3})}),
            r"c8 has dt = 0.001 s, longer 0.002 s: must have one dt, as the errors between samples",
        ),
        (
            lambda: over_seeds.over_seeds(
                ql.plants.LinearPlant([[-1.0]], [1.0], [1.0]), {f"{dt}": ql.baselines.PID(2.0, dt=dt) for dt in (0.02, 0.01)}, ql.Scenario()
            ),
            r"0.01 has dt = 0.01 s, 0.02 0.02 s: must have one dt",
        ),
        (lambda: in_windows({"start": None}), r"windows\[0\]: start = None: must be a number"),
        (lambda: in_windows({}, {"begin": 1.0}), r"windows\[1\]: 'begin' is unknown; .*start"),
        (lambda: in_windows({"start": -1.0}), r"windows\[0\]: start = -1.0: must be .*not negative"),
        (lambda: in_windows({"start": 0.5, "stop": 0.2}), r"windows\[0\]: start = 0.5, stop = 0.2"),
        (lambda: in_windows(1.0), r"windows\[0\] = 1.0: must be a table, such as"),
    ],
)  # fmt: skip
def test_what_cannot_be_compared_is_refused(call: Callable[[], Any], message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.trial
def test_the_command_shows_which_is_best_per_axis(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """A table with a row an axis, JSON and a figure; another plant, scenario or reference of a later setup is told."""
    other = gantry(12.0)
    other["scenario"]["duration"] = 0.4
    other["axis"][0]["reference"] = 0.2
    for name, data in (("slow", gantry()), ("quick", other)):
        (tmp_path / f"{name}.toml").write_text(toml_text(data), encoding="utf-8")
    shown = quell(
        "compare", "slow.toml", "quick.toml", "--seeds", "3", "--json", "out.json", "--figures", "p"
    )
    assert shown.code == 0, shown.err
    assert "…" not in shown.out.replace(" … ", "")
    rows = [line.split() for line in shown.out.splitlines()]
    assert any(row[:2] == ["x", "[m]"] and row[-1] == "quick" for row in rows)
    assert (
        "NOT its own scenario, reference: quick runs with the scenario, reference of slow"
        in shown.out
    )
    told = json.loads((tmp_path / "out.json").read_text())
    found = over_seeds.of_setups(
        {"slow": made("slow", gantry()), "quick": made("quick", other)}, seeds=3
    )
    assert told["values"]["rms"] == found.values["rms"].tolist()
    assert told["verdicts"][0]["best"] == "quick"
    assert {path.name for path in (tmp_path / "p").iterdir()} == {
        f"slow-compare.{suffix}" for suffix in ("png", "svg", "pdf")
    }
    for arguments, message in (
        (("slow.toml",), "slow.toml: NOT for a setup of several axes alone"),
        (("slow.toml", "slow.toml"), "setups: slow.toml, slow.toml: must be different files"),
        (("slow.toml", "quick.toml", "--m-s", "2"), "--m-s = 2.0: is for one setup"),
        (("--seeds", "2"), "--seeds = 2: is for a comparison of several setups"),
    ):
        refused = quell("compare", *arguments, "--no-figures")
        assert refused.code == 2
        assert message in refused.err


def test_setups_of_one_axis_are_compared_by_the_command_too(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """The row is y; the exit code of a run that diverges is 4."""
    text = """dt = 0.02
plant = {{ kind = "linear", num = [2.0], den = [1.0, 1.0] }}
observer = {{ kind = "model-free", order = 1, b0 = {}, omega_o = 8.0 }}
controller = {{ omega_c = 2.0 }}
scenario = {{ duration = {}, reference = {{ kind = "step" }} }}
"""
    for name, b0 in (("right", 2.0), ("high", 4.0), ("wrong", -0.01)):
        content = text.format(b0, 2.0)
        assert made(name, tomllib.loads(content)).scenario is not None
        (tmp_path / f"{name}.toml").write_text(content, encoding="utf-8")
    shown = quell("compare", "high.toml", "right.toml", "--no-figures")
    assert shown.code == 0, shown.err
    assert "0 to 2 s: best is right" in shown.out
    longer = text.format(4.0, 2.0).replace("dt = 0.02", "dt = 0.1")
    (tmp_path / "longer.toml").write_text(longer, encoding="utf-8")
    shown = quell("compare", "high.toml", "longer.toml", "--no-figures")
    assert (shown.code, "high has dt = 0.02 s, longer 0.1 s: must have one dt" in shown.err) == (2, True)  # fmt: skip
    shown = quell("compare", "high.toml", "wrong.toml", "--no-figures")
    assert shown.code == 4
    assert "NOT stable: wrong diverged or ran away in 1 of 1 runs" in shown.out
