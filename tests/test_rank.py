"""Which of several tunings was best, from logs."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from quell.identification import Measured
from quell.monitoring import rank
from quell.monitoring.rank import correlation_time, period_of
from quell.records.gains import gain_factor, one_gain
from quell.records.trajectory import Trajectory
from tests.commands import in_this_process

from .cases import cases

DT = 0.01


def log(
    seed: int,
    size: float = 1.0,
    *,
    samples: int = 8000,
    memory: float = 0.9,
    r: Any = None,
    load: float = 1.0,
    mean: float = 0.0,
    gain: float = 1.0,
) -> Measured:
    """Return a log whose error has a memory: an autoregression of this size, and a slow load."""
    rng = np.random.default_rng(seed)
    error = size * lfilter([1.0], [1.0, -memory], rng.normal(size=samples + 500))[500:]
    slow = load * lfilter([0.1], [1.0, -0.98], rng.normal(size=samples + 500))[500:]
    reference = np.zeros(samples) if r is None else r
    return Measured(mean - slow + 0.01 * gain * error, reference - error, DT, reference)


@pytest.mark.trial
@pytest.mark.parametrize("memory", [0.0, 0.9, 0.97])
def test_tunings_that_are_alike_are_not_decided(memory: float) -> None:
    """In 95 of 100 draws at least, but for the chance of the draws; whatever the correlation."""
    decided = [
        rank({"A": log(2 * seed, memory=memory), "B": log(2 * seed + 1, memory=memory)}).best
        for seed in range(120)
    ]
    wrong = sum(each is not None for each in decided)
    assert wrong <= 11  # of 120: at 5 % more in 1 of 100 cases (binomial)


@pytest.mark.trial
def test_three_tunings_that_are_alike_are_not_decided_either() -> None:
    """The level is shared by the pairs."""
    wrong = 0
    for seed in range(60):
        found = rank({name: log(3 * seed + i) for i, name in enumerate("ABC")})
        wrong += any(each.decided for each in found.comparisons)
    assert wrong <= 7


@pytest.mark.trial
def test_a_better_tuning_is_found_and_its_interval_holds() -> None:
    """Errors of 0.8 of the other's: found in most draws, never the wrong way round."""
    found = [rank({"A": log(seed), "B": log(seed + 500, 0.8)}) for seed in range(60)]
    best = [each.best for each in found]
    assert best.count("B") >= 54
    assert "A" not in best
    held = [
        each.comparisons[0].least <= 0.2 <= each.comparisons[0].most
        for each in found
        if each.comparisons[0].better == "B"
    ]
    assert sum(held) >= 0.9 * len(held)


@pytest.mark.trial
def test_the_time_asked_for_is_enough() -> None:
    """Logs that are longer by it decide a difference as large as the one that was seen, mostly."""
    enough = tried = 0
    for seed in range(40):
        found = rank({"A": log(seed), "B": log(seed + 500, 0.93)}).comparisons[0]
        if found.decided or math.isnan(found.needed) or found.better == "A":
            continue
        assert found.describe().endswith(f"log at least {found.needed:.3g} s more of each")
        samples = min(8000 + round(found.needed / DT), 400_000)
        longer = {"A": log(seed + 1000, samples=samples)}
        longer["B"] = log(seed + 2000, 1.0 - found.lower, samples=samples)
        tried += 1
        enough += rank(longer).best == "B"
    assert tried >= 8
    assert enough >= 0.55 * tried


def test_the_same_reference_cancels_in_pairs() -> None:
    """What it makes of the error is the same in both: a difference of 3 % is found."""
    t = DT * np.arange(8000)
    r = np.sin(0.05 * t**1.7)
    moving = np.abs(np.sin(0.11 * t)) * 20.0
    logs = {}
    for seed, (name, size) in enumerate({"A": 1.0, "B": 0.97}.items()):
        noise = log(seed, 0.05, r=r)
        error = size * moving + (r - noise.y)
        logs[name] = noise._replace(y=r - error)
    assert rank(logs).best == "B"
    apart = {
        "A": logs["A"],
        "B": logs["B"]._replace(reference=r[::-1], y=logs["B"].y - r + r[::-1]),
    }
    assert rank(apart).best is None


def test_batches_are_whole_periods_of_a_reference_that_repeats() -> None:
    """The error after a step is large in each period, in both tunings."""
    r = np.tile(np.repeat([0.0, 1.0], 150), 30)
    assert period_of(r) == 300
    assert period_of(np.zeros(500)) == 0
    assert period_of(np.random.default_rng(1).normal(size=2000)) == 0
    assert abs(period_of(np.round(np.sin(np.arange(4000) * 2 * math.pi / 250.3), 6)) - 250) <= 1
    after = np.tile(np.exp(-np.arange(150) / 20.0), 60)
    found = {}
    for seed, (name, size) in enumerate({"A": 1.0, "B": 0.9}.items()):
        noise = log(seed, 0.02, samples=9000, r=r)
        jump = np.where(np.tile(np.repeat([0, 1], 150), 30) == 1, 1.0, -1.0)
        found[name] = noise._replace(y=noise.y - size * jump * after)
    ranking = rank(found)
    assert ranking.best == "B"
    assert ranking.scores["A"].batches * 300 <= 9000
    assert ranking.comparisons[0].lower == pytest.approx(0.1, abs=0.03)


@cases(
    ("change", "reason"),
    [
        ({"r": np.full(8000, 2.0)}, "the reference is 2 and 0"),
        ({"r": np.sin(0.01 * np.arange(8000))}, "of the reference is"),
        ({"load": 5.0}, "the slow part of u swings"),
        ({"mean": 9.0}, "the mean of u is 9"),
    ],
)
def test_another_task_is_named_as_the_reason(change: dict[str, Any], reason: str) -> None:
    """Nothing is decided then, however large the difference."""
    found = rank({"A": log(1, 0.3, **change), "B": log(2)})
    assert found.best is None
    line = found.comparisons[0].describe()
    assert line.startswith("NOT comparable: A and B: ")
    assert reason in line


def test_a_load_behind_moves_that_repeat_is_seen() -> None:
    """What the moves make of u is the same in each period, and is taken out."""
    r = np.tile(np.repeat([0.0, 1.0], 150), 30)
    logs = {}
    for seed, (name, load) in enumerate({"A": 0.3, "B": 0.9}.items()):
        one = log(seed, samples=9000, r=r, load=load)
        logs[name] = one._replace(u=one.u + 20.0 * np.gradient(r))
    assert "the slow part of u swings" in rank(logs).comparisons[0].describe()
    same = {name: one._replace(u=logs["A"].u) for name, one in logs.items()}
    assert rank(same).comparisons[0].reasons == ()


@pytest.mark.trial
def test_the_same_load_under_another_tuning_is_comparable() -> None:
    """False alarms of the tests of reference and load: one in 100 at most."""
    alarms = 0
    for seed in range(60):
        logs = {"A": log(2 * seed), "B": log(2 * seed + 1, 0.5, gain=3.0)}
        alarms += bool(rank(logs).comparisons[0].reasons)
    assert alarms <= 2


def test_a_log_that_is_too_short_says_how_long_it_must_be() -> None:
    """Ten batches of ten correlation times."""
    found = rank({"A": log(1, samples=600, memory=0.99), "B": log(2, samples=600, memory=0.99)})
    line = found.comparisons[0].describe()
    needed = float(re.findall(r"at least ([\d.]+) s of each", line)[0])
    assert line.startswith("NOT decided")
    assert needed > 6.0


def test_a_difference_that_logs_like_these_do_not_show_is_called_alike() -> None:
    """Rather than asking for months."""
    one = log(1)
    other = one._replace(y=one.y * (1.0 + 1e-6), u=one.u)
    shifted = other._replace(y=np.roll(other.y, 400))
    line = rank({"A": one, "B": shifted}).comparisons[0].describe()
    assert line.startswith("NOT decided")
    assert "alike" in line


def test_the_correlation_time_is_that_of_the_closed_form() -> None:
    """(1 + ρ)/(1 − ρ) of an autoregression of first order, and one for white noise."""
    rng = np.random.default_rng(4)
    for rho in (0.0, 0.8, 0.95):
        values = lfilter([1.0], [1.0, -rho], rng.normal(size=200_000))
        assert correlation_time(values) == pytest.approx((1.0 + rho) / (1.0 - rho), rel=0.1)
    assert correlation_time(np.ones(100)) == 1.0


def test_the_overshoot_is_that_of_the_steps() -> None:
    """Steps that rest for a while; a reference that always moves has none."""
    r = np.repeat([0.0, 1.0, 0.0, 1.0], 2000)
    y = r.copy()
    for k in (2000, 4000, 6000):
        y[k + 50] += 0.2 * (r[k] - r[k - 1])
    measured = log(1)._replace(reference=r, y=y + 1e-6 * log(3).y)
    found = rank({"A": measured, "B": log(2)})
    assert found.scores["A"].overshoot == pytest.approx(0.2, abs=1e-3)
    assert math.isnan(found.scores["B"].overshoot)


@cases(
    ("logs", "message"),
    [
        ({"A": log(1)}, "give logs of two or more"),
        ({"A": log(1), "B": log(2)._replace(reference=None)}, r"logs['B']: has no reference r"),
        ({"A": log(1), "B": log(2)._replace(dt=0.02)}, "sample times from 0.01 to 0.02 s"),
        ({"A": log(1), "B": []}, "logs['B']: no log"),
        ({"A": log(1), "B": [log(2), 3.0]}, "logs['B'][1]: must be a quell"),
        ({"A": log(1), "B": log(2, samples=10)}, "10 samples; must have"),
    ],
)
def test_bad_logs_are_named(logs: Any, message: str) -> None:
    """With the tuning, and what to do."""
    with pytest.raises(ValueError, match=re.escape(message)):
        rank(logs)
    with pytest.raises(ValueError, match="criterion = 'best'"):
        rank({"A": log(1), "B": log(2)}, criterion="best")


# ---- quell rank ----


def written(path: Path, measured: Measured) -> str:
    """Write a log as a table and return its path."""
    t = DT * np.arange(measured.y.size)
    table = np.column_stack([t, measured.u, measured.y, measured.reference])
    np.savetxt(path, table, delimiter=",", header="t,u,y,r", comments="", fmt="%.9g")
    return str(path)


@pytest.mark.trial
def test_the_command_names_the_best_and_takes_parts_of_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One day on which the tunings alternate is a log of both, by parts."""
    parts = [log(1), log(2, 0.8), log(3), log(4, 0.8)]
    day = Measured(*(np.concatenate(each) for each in zip(*[(p.u, p.y) for p in parts], strict=True)),
                   DT, np.zeros(32000))  # fmt: skip
    file, json_file = written(tmp_path / "day.csv", day), tmp_path / "found.json"
    spans = {"old": ("0:80", "160:240"), "new": ("80:160", "240:320")}
    logs = [f"{name}={file}@{span}" for name, each in spans.items() for span in each]
    shown = in_this_process(["rank", *logs, "--json", str(json_file)], monkeypatch, capsys)
    assert shown.code == 0
    assert "best: new, at 95 % for all together" in shown.out
    assert "NOT protected" not in shown.out
    assert json.loads(json_file.read_text())["best"] == "new"
    alike = in_this_process(["rank", f"{file}@0:80", f"b={file}@160:240"], monkeypatch, capsys)
    assert "NOT decided which is best" in alike.out
    assert "NOT protected against drift" in alike.out
    beyond = in_this_process(["rank", f"{file}@0:80", f"b={file}@160:900"], monkeypatch, capsys)
    assert beyond.code == 2
    assert "must be a part of the 320 s of the log" in beyond.err


def axes_log(
    path: Path, sizes: tuple[float, float], seed: int, *, effort: float = 0.1, B0: Any = 1.0
) -> str:
    """Write a saved run of two axes whose errors have these sizes, under the same load; B0 (or of each sample) times u is v."""
    noise = np.random.default_rng(seed).normal(size=(4, 6000))
    errors = np.column_stack([size * each for size, each in zip(sizes, noise, strict=False)])
    u = 1.0 + effort * noise[2:].T
    log = np.column_stack([np.zeros((6000, 2)), errors, errors, u, B0 * u])
    channels = (("r", 2), ("y", 2), ("y_measured", 2), ("u", 2), ("v", 2))
    Trajectory(log, channels, 0.1, axis_names=("x", "y")).save(path)
    return str(path)


@pytest.mark.trial
def test_tunings_of_several_axes_are_judged_for_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that is best for all is best; where axes disagree, or one is open, a line says NOT."""
    before = [axes_log(tmp_path / f"a{k}.nc", (1.0, 1.0), k) for k in range(2)]
    for sizes, verdict in (
        ((0.7, 0.8), "best for all axes: B, at 95 % for all axes together"),
        ((0.7, 1.4), "NOT one best tuning, at 95 % for all axes together: B for x, A for y"),
        ((0.7, 1.0), "NOT decided for y, at 95 % for all axes together"),
    ):
        after = [axes_log(tmp_path / f"b{k}{sizes}.nc", sizes, 10 + k) for k in range(2)]
        logs = [
            f"{n}={p}" for p, q in zip(before, after, strict=True) for n, p in (("A", p), ("B", q))
        ]
        file = tmp_path / f"{sizes}.json"
        shown = in_this_process(["rank", *logs, "--json", str(file)], monkeypatch, capsys)
        assert shown.code == 0, shown.err
        assert verdict in shown.out
        assert "x: Tunings, the lowest criterion first" in shown.out
        found = json.loads(file.read_text())
        assert found["axes"]["x"]["best"] == "B"
        assert found["axes"]["x"]["confidence"] == pytest.approx(0.975)
        assert found["verdict"].startswith(verdict)
    one = tmp_path / "one.csv"
    np.savetxt(one, np.ones((600, 4)), delimiter=",", header="t,u,y,r", comments="")
    table = np.column_stack([0.1 * np.arange(600), *np.random.default_rng(1).normal(size=(3, 600))])
    np.savetxt(one, table, delimiter=",", header="t,u,y,r", comments="")
    shown = in_this_process(["rank", f"A={before[0]}", f"B={one}"], monkeypatch, capsys)
    assert (shown.code, "has one y, the logs before x, y: must be the same" in shown.err) == (
        2,
        True,
    )


@pytest.mark.trial
def test_efforts_and_loads_of_axes_are_those_of_the_actuators_whatever_b0_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of B0 halves v: what moves the motors more is not called better, and the load is not called another one."""
    gains = {"A": 1.0, "B": 0.5, "C": 0.5 + 0.4 * np.sin(np.arange(6000.0))[:, None]}
    efforts = {"A": 0.1, "B": 0.13, "C": 0.1}
    logs = {
        name: axes_log(tmp_path / f"{name}.nc", (1.0, 1.0), i, effort=efforts[name], B0=gain)
        for i, (name, gain) in enumerate(gains.items())
    }
    for order in ("AB", "BA"):
        given = [f"{name}={logs[name]}" for name in order]
        file = tmp_path / f"{order}.json"
        arguments = ["rank", *given, "--criterion", "effort", "--json", str(file)]
        shown = in_this_process(arguments, monkeypatch, capsys)
        assert "best for all axes: A, at 95 %" in shown.out, shown.err
        assert "A is better than B: mean |du/dt| lower by 2" in shown.out
        b = gains[order[0]]
        line = f"u of an axis is B u with B = [[{b:g}, 0], [0, {b:g}]] for all, as their B0 differ"
        assert line in shown.out
        assert np.allclose(json.loads(file.read_text())["B"], b * np.eye(2))
        shown = in_this_process(["rank", *given], monkeypatch, capsys)
        assert "another load" not in shown.out
    shown = in_this_process(["rank", f"A={logs['A']}", f"C={logs['C']}"], monkeypatch, capsys)
    assert shown.code == 2
    assert "C.nc is not one, and follows the state: v = B0 u is in other units" in shown.err
    assert "take runs with one B0" in shown.err


def run_of(u: Any, B0: Any) -> Trajectory:
    """Return a record with these u and v = B0 u of one axis."""
    v = np.sum(np.broadcast_to(B0, u.shape) * u, axis=1, keepdims=True)
    return Trajectory(np.column_stack([u, v]), (("u", u.shape[1]), ("v", 1)), 0.1)


def test_v_of_one_b0_is_taken_as_it_is_and_another_b0_needs_all_actuators_to_have_moved() -> None:
    """Of three actuators for an axis: other weights are no other B0; a B0 that one run shows in part can't be taken for another run."""
    rng = np.random.default_rng(4)
    B0, wish = np.array([1.0, 2.0, 0.5]), rng.normal(size=(400, 1))
    even, uneven = wish @ [[1.0, 1.0, 1.0]], wish @ [[5.0, 0.1, 0.0]]
    free = rng.normal(size=(400, 3))

    def found(**runs: Any) -> Any:
        return one_gain({name: gain_factor(run_of(*run)) for name, run in runs.items()}, 3)

    assert found(a=(even, B0), b=(1e3 * uneven, B0)) == (None, True)
    assert found(a=(0.0 * even, B0), b=(uneven, B0)).B is None
    with pytest.raises(
        ValueError, match="B0 of a, b, c is not one, and can't be seen in full in any"
    ):
        found(a=(even, B0), b=(np.roll(uneven, 1, axis=1), [3.0, 1.0, 1.0]), c=(even, 3.0 * B0))
    B, constant = found(a=(even, B0), b=(free, 3.0 * B0), c=(free, B0))
    assert np.allclose(B, 3.0 * B0)
    assert constant
    slow = 1.0 + 0.3 * np.sin(0.01 * np.arange(400.0))[:, None]
    same, other = found(a=(free, slow * B0), b=(rng.normal(size=(400, 3)), slow * B0)), B0 * slow
    assert same.B is None
    assert same.describe()[0].startswith("NOT protected against another B0: it follows the state")
    with pytest.raises(ValueError, match="B0 of a, b is not one, and follows the state"):
        found(a=(free, other), b=(free, 1.2 * other))


def test_a_tuning_with_which_y_runs_away_has_no_rank() -> None:
    """Its u lies at a limit, so its effort is the lowest of all; it stands last, in a line with NOT."""
    good = [log(seed, r=np.zeros(8000)) for seed in (1, 2)]
    away = Measured(np.full(8000, -10.0), -0.1 * DT * np.arange(8000.0), DT, np.ones(8000))
    found = rank({"A": away, "B": good[0], "C": good[1]}, criterion="effort")
    assert list(found.scores)[-1] == "A"
    assert found.lost == ("A",)
    assert math.isnan(found.scores["A"].overshoot)
    assert "NOT ranked: A: y ran away from r in 1 of 1 logs" in found.describe()
    assert all("A" not in (each.better, each.worse) for each in found.comparisons)
    assert found.to_json()["lost"] == ["A"]
    both = rank({"A": away, "B": away})
    assert both.best is None
    assert both.describe().startswith("NOT ranked: A")


def test_the_best_tuning_says_in_what_it_is_worse() -> None:
    """A better RMS error that costs ten times the effort."""
    found = rank({"A": log(1, memory=0.0), "B": log(2, 0.7, memory=0.0, gain=30.0)})
    assert found.best == "B"
    assert re.search(
        r"^B is worse than A in mean \|du/dt\| [\d.]+ → [\d.]+$", found.describe(), re.M
    )
