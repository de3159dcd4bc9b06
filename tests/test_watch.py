"""What changes in a machine over months: windows, evidence, alarms, the state on disk."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.monitoring import Alarm, Machine, Signals, Watch, WatchSink, features_of, windows_of
from quell.monitoring.windows import signals_of
from quell.realtime.recordings import CsvSink
from tests.commands import in_this_process
from tests.recordings import controller, header_of, rows_of, simulated
from tests.scripted_axes import Outcome, gantry

from .cases import cases

NAMES = ("a", "b", "c")


def fed(watch: Watch, values: Any) -> list[Alarm]:
    """Feed rows of numbers and return the alarms."""
    return [
        alarm
        for k, row in enumerate(values)
        for alarm in watch.update(dict(zip(watch.features, row, strict=True)), f"hour {k}")
    ]


# ---- Evidence ----


@pytest.mark.trial
def test_false_alarms_are_as_rare_as_alpha_says_whatever_the_distribution() -> None:
    """Of 150 runs of 150 windows at alpha = 0.1: 15 on average at most; heavy tails, steps, ties."""
    wrong = 0
    draws = (
        lambda rng: rng.normal(size=(150, 3)),
        lambda rng: rng.standard_cauchy(size=(150, 3)),
        lambda rng: np.round(rng.normal(size=(150, 3))),
    )
    for run in range(150):
        rng = np.random.default_rng(run)
        watch = Watch(NAMES, alpha=0.1, seed=run)
        wrong += bool(fed(watch, draws[run % 3](rng)))
    assert wrong <= 24  # in 99 of 100 cases, at a rate of 0.1


def test_the_sum_over_begins_is_that_of_its_definition() -> None:
    """Σ_s w_s Π L, for each shift, and the weight of what has not begun."""
    import random

    from scipy.special import ndtri

    rng, watch = np.random.default_rng(5), Watch(("a",), seed=3)
    values = rng.normal(size=12)
    fed(watch, values[:, None])
    factors = []
    for t, value in enumerate(values, start=1):
        rank = np.sum(values[: t - 1] < value) + random.Random(f"3/a/{t}").random()
        z = ndtri(rank / t)
        factors.append({d: math.exp(d * z - d * d / 2) for h in (0.5, 1, 2, 3) for d in (h, -h)})

    def left(s: int) -> float:
        return 1.0 / (1.0 + math.log(s))

    total = left(13)
    for d in factors[0]:
        for s in range(1, 13):
            product = math.prod(factors[t - 1][d] for t in range(s, 13))
            total += (left(s) - left(s + 1)) * product / len(factors[0])
    assert watch.evidence("a") == pytest.approx(math.log(total), rel=1e-12)


@pytest.mark.parametrize(("shift", "most"), [(-4.0, 8), (4.0, 8), (2.0, 22)])
def test_a_shift_alarms_and_is_told_with_its_begin_and_its_size(shift: float, most: int) -> None:
    """Within windows that the theory of the bets gives, for the right feature and no other."""
    rng, watch = np.random.default_rng(7), Watch(NAMES)
    values = rng.normal(size=(300, 3)) * 0.1 + 5.0
    values[200:, 1] += 0.1 * shift
    alarms = fed(watch, values)
    assert [alarm.feature for alarm in alarms] == ["b"]
    (alarm,) = alarms
    assert 201 <= alarm.window <= 200 + most
    assert abs(alarm.since - 201) <= 3
    assert alarm.since_at == f"hour {alarm.since - 1}"
    assert alarm.before == pytest.approx(5.0, abs=0.03)
    assert alarm.after - alarm.before == pytest.approx(0.1 * shift, abs=0.1)
    assert alarm.spread == pytest.approx(0.1, rel=0.2)
    verb = "rose" if shift > 0.0 else "fell"
    assert f"ALARM: b {verb} from {alarm.before:.4g}" in watch.describe()
    assert fed(watch, values[200:]) == []  # told once


@pytest.mark.parametrize("line", [False, True])
def test_a_change_below_the_drift_of_converters_is_no_alarm(line: bool) -> None:
    """Of a machine without noise, 1e-7, also across a line of the grid; 0.02 % alarms soon, with digits that differ."""
    value = math.exp((round(math.log(10.24) * 1e4) + (0.5 if line else 0.0)) * 1e-4)
    watch = Watch(("u_rms",))
    steps = value * (1.0 + 5e-8 * np.where(np.arange(60) >= 30, 1.0, -1.0))
    assert fed(watch, steps[:, None]) == []
    lines = watch.describe().splitlines()
    assert lines[0].startswith("no alarm in 60 windows")
    small = "too small for an alarm, below 0.01% of the value, which converters drift by: u_rms (+1e-05 %)"
    assert ("NOT exchangeable" in lines[-1]) == line
    assert lines[1:2] == [small] * line
    (alarm,) = fed(watch, np.full((60, 1), 1.0002 * value))
    if not line:
        assert abs(alarm.since - 61) <= 3
        assert alarm.window < 70
        assert f"rose from {value:.4g} " in alarm.describe()
    before, after = alarm.describe().partition("from ")[2].split(" to ")
    assert before.split()[0] != after.split()[0]


def test_what_no_window_shows_is_told_at_once_with_what_would_show_it() -> None:
    """More windows like these do not help; a number that some windows show needs more of them."""
    watch = Watch(("a: b0", "a: resonance", "a: noise", "other"))
    for value in np.random.default_rng(11).normal(size=16):
        watch.update({"a: noise": value, "a: b0": math.nan})
    never, unable = watch.describe().splitlines()[1:3]
    assert never.startswith(
        "NOT watched: a: b0, a: resonance, other: none of 16 windows shows them"
    )
    assert "b0 and friction need windows in which u moves y" in never
    assert "a resonance needs a peak in the spectrum of y" in never
    assert unable.startswith("NOT enough windows yet: a: noise: ")


def test_what_is_rounding_is_zero() -> None:
    """The error of a loop that stands at 1000, its noise, and the mean of an f that swings."""
    t = np.arange(2000.0)
    y = np.full(2000, 1e3) + np.where(t % 3 == 0, 1.2e-13, 0.0)
    f = np.sin(2.0 * np.pi * t / 100.0)
    found = features_of(Signals(np.ones(2000), y, np.full(2000, 1e3), f, {}, 1e-3), 2)
    assert (found["error"], found["noise"], found["f_mean"]) == (0.0, 0.0, 0.0)
    assert found["f_rms"] == pytest.approx(math.sqrt(0.5))


def test_a_slow_drift_alarms_too() -> None:
    """A wear of five deviations over 300 windows."""
    rng, watch = np.random.default_rng(8), Watch(("a",))
    values = rng.normal(size=(500, 1))
    values[200:, 0] += 5.0 * np.arange(300) / 300.0
    assert len(fed(watch, values)) == 1


def test_too_few_windows_are_told_and_the_number_that_is_enough() -> None:
    """With fewer before a change few alarms come; with so many all do, when it is said."""
    watch = Watch(NAMES)
    rng = np.random.default_rng(9)
    fed(watch, rng.normal(size=(5, 3)))
    line = next(line for line in watch.describe().splitlines() if "NOT enough" in line)
    needed = int(line.rpartition("; ")[2].split()[0])
    assert watch.windows_to_alarm("a") is None
    fed(watch, 100.0 + rng.normal(size=(300, 3)))
    assert len(watch.alarms) <= 1
    enough = Watch(NAMES)
    fed(enough, rng.normal(size=(needed + 5, 3)))
    predicted = enough.windows_to_alarm("a")
    assert predicted is not None
    alarms = fed(enough, 100.0 + rng.normal(size=(300, 3)))
    assert {alarm.feature for alarm in alarms} == set(NAMES)
    assert np.median([alarm.window for alarm in alarms]) - needed - 5 <= 2 * predicted
    assert enough.windows_to_alarm("a") == 0


def test_what_can_not_be_said_is_said() -> None:
    """Correlated windows, features that are hardly seen, and names that came later."""
    rng = np.random.default_rng(10)
    watch = Watch(("slow", "rare"))
    slow = 0.0
    for k in range(120):
        slow = 0.8 * slow + rng.normal()
        watch.update({"slow": slow, "rare": rng.normal() if k % 5 == 0 else math.nan, "new": 1.0})
    text = watch.describe()
    assert "NOT exchangeable" in text or watch.alarms
    assert "NOT watched well: rare (in 24 of 120 windows)" in text
    assert "NOT watched: new" in text


@pytest.mark.parametrize("alpha", [0.0, 1.0, math.nan])
def test_bad_arguments_are_refused(alpha: float) -> None:
    """With name, value and rule."""
    with pytest.raises(ValueError, match="alpha"):
        Watch(alpha=alpha)
    with pytest.raises(ValueError, match="must be different names"):
        Watch(("a", "a"))
    with pytest.raises(ValueError, match="must be different names"):
        Watch().update({})
    with pytest.raises(ValueError, match="feature = 'z'"):
        Watch(("a",)).evidence("z")


# ---- Windows ----

DT = 1e-3


def driven(seed: int, gain: float = 500.0, dry: float = 50.0, k: float = 0.0) -> Signals:
    """Return 20 s of an inertia with friction that moves, under a PD controller."""
    rng = np.random.default_rng(seed)
    n = 20_000
    t = np.arange(n) * DT
    r = np.sin(2.0 * t) + 0.5 * np.sin(5.3 * t + rng.uniform(0.0, 6.0))
    noise = 1e-4 * rng.normal(size=n)
    y, u, x, v = np.empty(n), np.empty(n), 0.0, 0.0
    for i in range(n):
        y[i] = x + noise[i]
        u[i] = 4.0 * (r[i] - x) - 0.3 * v
        v += DT * (gain * u[i] - 25.0 * v - dry * np.tanh(v / 0.01) - k * x)
        x += DT * v
    return Signals(u, y, r, None, {}, DT)


def test_the_numbers_are_those_of_the_machine() -> None:
    """b_0, friction, spring, noise and error of a machine whose equation is known."""
    found = features_of(driven(1, k=300.0), order=2)
    assert found["b0"] == pytest.approx(500.0, rel=0.05)
    assert found["viscous"] == pytest.approx(25.0, rel=0.15)
    assert found["coulomb"] == pytest.approx(50.0, rel=0.1)
    assert found["stiffness"] == pytest.approx(300.0, rel=0.1)
    assert found["noise"] == pytest.approx(1e-4, rel=0.05)
    still = Signals(
        np.zeros(500), 1e-4 * np.random.default_rng(0).normal(size=500), None, None, {}, DT
    )
    nothing = features_of(still, order=2)
    assert math.isnan(nothing["b0"])
    assert nothing["noise"] == pytest.approx(1e-4, rel=0.1)
    assert "error" not in nothing


def test_the_gain_of_an_oven_is_found_at_one_hertz() -> None:
    """Order 1, 600 s and 0.8 K/W, at 1 Hz."""
    rng = np.random.default_rng(2)
    u = 50.0 + 10.0 * np.repeat(rng.choice([-1.0, 1.0], size=60), 60)
    y = np.zeros(u.size)
    a = math.exp(-1.0 / 600.0)
    for i in range(u.size - 1):
        y[i + 1] = a * y[i] + 0.8 * (1.0 - a) * u[i]
    signals = Signals(u, y + 0.01 * rng.normal(size=u.size), None, None, {}, 1.0)
    found = features_of(signals, order=1)
    assert found["b0"] == pytest.approx(0.8 / 600.0, rel=0.03)
    assert found["stiffness"] == pytest.approx(1.0 / 600.0, rel=0.1)


def test_a_resonance_is_found_between_the_lines_of_the_spectrum() -> None:
    """A peak above its trend; white noise has none."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(3)
    zeta, omega = 0.02, 231.7
    pole = np.exp((-zeta + 1j * math.sqrt(1.0 - zeta**2)) * omega * DT)
    y = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.normal(size=60_000))
    found = features_of(Signals(np.ones(y.size), y, None, None, {}, DT), order=2)
    assert found["resonance"] == pytest.approx(omega, rel=0.01)
    white = Signals(np.ones(60_000), rng.normal(size=60_000), None, None, {}, DT)
    assert math.isnan(features_of(white, order=2)["resonance"])


def test_windows_are_whole_and_learned_coefficients_belong_to_them() -> None:
    """What is left at the end is left out."""
    u = np.arange(2500.0)
    parts = [*windows_of(Signals(u, u, None, u, {"1": u, "u": -u}, DT), 1.0)]
    assert [part.u[0] for part in parts] == [0.0, 1000.0]
    assert features_of(parts[1], 1)["theta u"] == pytest.approx(-1499.5)
    assert features_of(parts[1], 1)["f_mean"] == pytest.approx(1499.5)
    with pytest.raises(ValueError, match="a window of 100 samples: must have 200"):
        features_of(parts[0].part(0, 100), 2)
    with pytest.raises(ValueError, match=r"band = 9000.0 rad/s: must be below"):
        features_of(parts[0], 2, band=9000.0)


# ---- The state, the command, and the real-time loop ----


def rows(seed: int, count: int, shift: float = 0.0) -> Any:
    """Return rows of a machine's numbers."""
    rng = np.random.default_rng(seed)
    return [
        {"b0": 500.0 + 10.0 * (rng.normal() + shift), "noise": rng.normal()} for _ in range(count)
    ]


def test_a_state_goes_on_where_it_was(tmp_path: Path) -> None:
    """Through a file, in the middle, it is the watch that was not interrupted."""
    whole, parts, path = Machine(window=30.0), Machine(window=30.0), tmp_path / "state.json"
    for k, row in enumerate(rows(1, 60) + rows(2, 30, -4.0)):
        whole.watch.update(row, str(k))
        parts.watch.update(row, str(k))
        if k % 17 == 0:
            parts.save(path)
            parts = Machine.load(path)
    assert parts.watch.alarms == whole.watch.alarms != []
    assert parts.watch.describe() == whole.watch.describe()
    assert parts.settings == whole.settings
    for name in whole.watch.features:
        assert parts.watch.evidence(name) == whole.watch.evidence(name)
        np.testing.assert_array_equal(parts.watch.values(name), whole.watch.values(name))


@cases(
    "damage",
    [
        lambda state: state.pop("labels"),
        lambda state: state.update(quell_watch=9),
        lambda state: state.update(alpha="much"),
        lambda state: state["settings"].update(window=-1.0),
        lambda state: state["settings"].update(colour="red"),
        lambda state: state["features"]["b0"].update(values=[1.0, None]),
        lambda state: state["features"]["b0"].update(windows=[1]),
        lambda state: state["features"]["b0"].update(begins=[1]),
        lambda state: state["features"]["b0"].update(alarm={"colour": 1}),
        lambda state: state.update(features=[]),
    ],
)
def test_a_damaged_state_is_refused_and_named(tmp_path: Path, damage: Any) -> None:
    """Nothing of it is guessed."""
    machine, path = Machine(), tmp_path / "state.json"
    for row in rows(1, 5):
        machine.watch.update(row)
    machine.save(path)
    state = json.loads(path.read_text())
    damage(state)
    path.write_text(json.dumps(state))
    with pytest.raises(ValueError, match=r"state\.json': no state of quell watch"):
        Machine.load(path)
    path.write_text("[" * 100)
    with pytest.raises(ValueError, match="no state of quell watch"):
        Machine.load(path)


def test_a_few_missing_samples_are_interpolated_and_many_leave_a_window_out() -> None:
    """One in a thousand at most; the numbers hardly move."""
    whole = driven(1)
    few, many = whole.y.copy(), whole.y.copy()
    few[[100, 7000, 7001]] = math.nan
    many[5000:5100] = math.nan
    names = ("b0", "coulomb", "noise")
    machine = Machine(window=20.0)
    for y in (whole.y, few, many):
        machine.take(whole._replace(y=y), "day")
    assert machine.left_out == 1
    for name in names:
        first, second = machine.watch.values(name)
        assert second == pytest.approx(first, rel=0.02)
    assert "NOT watched: 1 windows" in machine.describe()


def written(path: Path, signals: list[Signals]) -> str:
    """Write records, one behind the other, as a table."""
    u, y, r = (np.concatenate([getattr(s, name) for s in signals]) for name in "uyr")
    table = np.column_stack([np.arange(u.size) * DT, u, y, r])
    np.savetxt(path, table, delimiter=",", header="t,u,y,r", comments="", fmt="%.9g")
    return str(path)


@pytest.mark.trial
def test_the_command_is_run_day_by_day_and_ends_with_6_where_there_is_an_alarm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Records that are in the state are left out; another window length is refused."""
    state = tmp_path / "watch.json"
    days = [
        written(tmp_path / f"day{k}.csv", [driven(4 * k + i) for i in range(4)]) for k in range(2)
    ]
    options = ["--state", str(state), "--window", "2", "--columns", "t,u,y,r"]
    first = in_this_process(["watch", days[0], *options], monkeypatch, capsys)
    assert first.code == 0
    assert "day0.csv: 40 windows" in first.out
    assert "no alarm in 40 windows" in first.out
    again = in_this_process(["watch", *days, *options], monkeypatch, capsys)
    assert "day0.csv: is in the state already, left out" in again.out
    assert "no alarm in 80 windows" in again.out
    other = in_this_process(["watch", days[1], *options[:2], "--window", "3"], monkeypatch, capsys)
    assert other.code == 2
    assert "--window 3: the state" in other.err
    bad = written(tmp_path / "bad.csv", [driven(9, dry=120.0)])
    found = tmp_path / "found.json"
    alarm = in_this_process(["watch", bad, *options, "--json", str(found)], monkeypatch, capsys)
    assert alarm.code == 6
    assert "ALARM: coulomb rose" in alarm.out
    assert "bearings" in alarm.out
    names = [each["feature"] for each in json.loads(found.read_text())["alarms"]]
    assert "coulomb" in names
    short = in_this_process(["watch", bad, "--window", "60"], monkeypatch, capsys)
    assert (short.code, "must have a window of 60 s at least" in short.err) == (2, True)


def test_the_sink_of_a_running_loop_sees_what_its_recording_has(tmp_path: Path) -> None:
    """Rows in blocks of any size: its windows are those of the file, and the state is there."""
    run, design = simulated(5.0), controller()
    rows_in_all = rows_of(run, design)
    state, told = tmp_path / "watch.json", []
    sink = WatchSink(state, Machine(window=2.0), told.append)
    csv = CsvSink(tmp_path / "run.csv")
    for each in (sink, csv):
        each.open(header_of(run, design))
        for begin in range(0, len(run), 37):
            each.write(rows_in_all[begin : begin + 37])
        each.flush()
        each.close()
    assert "watched: 2 windows of 2 s" in sink.describe()
    kept, again = Machine.load(state).watch, Machine(window=2.0)
    again.take(signals_of(tmp_path / "run.csv"), "run.csv")
    assert kept.features == again.watch.features
    assert "f_rms" in kept.features
    assert any(name.startswith("theta ") for name in kept.features)
    for name in kept.features:
        np.testing.assert_allclose(kept.values(name), again.watch.values(name), rtol=1e-6)
    assert told == []


@pytest.mark.trial
def test_the_sink_leaves_out_windows_with_gaps_and_goes_on_with_a_state(tmp_path: Path) -> None:
    """A skipped deadline, a missing measurement; cycles before the scenario are no window at all."""
    run, design = simulated(12.0), controller()
    rows_in_all, state = rows_of(run, design), tmp_path / "watch.json"
    broken = rows_in_all.copy()
    broken[500:, 0] += 1.0  # a deadline was skipped
    broken[900, 7] = math.nan  # one in 200 samples is too many
    for given, taken, left_out in ((rows_in_all, 6, 0), (broken, 4, 2)):
        sink = WatchSink(state, Machine(window=2.0))
        sink.open(header_of(run, design))
        waiting = given.copy()
        waiting[:, 3] = 0.0  # START
        sink.write(waiting)
        sink.write(given)
        sink.close()
        assert (sink.windows, sink.machine.left_out) == (taken, left_out)
    assert "NOT watched: 2 windows in which more than 0.1% of the samples" in sink.describe()
    assert len(Machine.load(state).watch.labels) == 10
    short = WatchSink(tmp_path / "short.json", Machine(window=1.0))
    with pytest.raises(ValueError, match="a window of 100 samples: must have 200"):
        short.open(header_of(run, design))  # before the loop runs


@pytest.mark.parametrize("change", [-0.3, 0.5])
def test_the_sink_tells_an_alarm_at_once(tmp_path: Path, change: float) -> None:
    """While the loop runs, in the window that decides it."""
    told: list[Alarm] = []
    machine = Machine(window=2.0)
    run, design = simulated(5.0), controller()
    row = features_of(next(windows_of(signals_of_rows(run), 2.0)), 2)
    rng = np.random.default_rng(6)
    for _ in range(60):
        machine.watch.update({n: v * (1.0 + change + 0.01 * rng.normal()) for n, v in row.items()})
    sink = WatchSink(tmp_path / "watch.json", machine, told.append)
    for _ in range(6):
        sink.open(header_of(run, design))
        sink.write(rows_of(run, design))
    assert told
    assert told == sink.machine.watch.alarms
    assert "ALARM" in sink.describe()


def signals_of_rows(run: ql.Trajectory) -> Signals:
    """Return the samples of a run, as the sink has them."""
    theta = {name: run["theta"][:, i] for i, name in enumerate(run.features)}
    return Signals(run["u"], run["y_measured"], run["r"], run["f_hat"], theta, run.dt)


# ---- Several axes ----


@pytest.mark.trial
def test_each_axis_is_judged_by_its_own_numbers() -> None:
    """The alarm names the axis; axes that change together may have one cause, which is said."""
    for changed, told in ((("y",), "y"), (("x", "y"), "x, y")):
        machine = Machine(window=2.0)
        for k in range(11):
            dry = {name: 120.0 if k >= 8 and name in changed else 50.0 for name in ("x", "y")}
            day = {name: driven(20 * k + i, dry=dry[name]) for i, name in enumerate(("x", "y"))}
            machine.take(day, f"day {k}")
        text = machine.describe()
        alarmed = {alarm.feature for alarm in machine.watch.alarms}
        assert {f"{name}: coulomb" for name in changed} <= alarmed
        assert {name.partition(": ")[0] for name in alarmed} == set(changed)
        assert f"ALARM: {changed[-1]}: coulomb rose" in text
        assert "bearings" in text
        if len(changed) == 1:
            assert "no alarm in 110 windows: x" in text
            assert "NOT decided which" not in text
        else:
            assert f"NOT decided which of the axes it is: {told} changed within" in text


def test_other_axes_are_refused_and_orders_may_differ(tmp_path: Path) -> None:
    """The state knows its axes, through a file, too; one written before has one y."""
    day = driven(1)
    machine, path = Machine(window=20.0, order=[2, 1]), tmp_path / "state.json"
    machine.take({"x": day, "y": day}, "day")
    assert "y: viscous" not in machine.watch.features
    assert "x: viscous" in machine.watch.features
    machine.save(path)
    again = Machine.load(path)
    assert again.axes == ("x", "y")
    assert again.settings == machine.settings
    for other in (day, {"y": day, "x": day}, {"x": day}):
        with pytest.raises(ValueError, match="record: has .*, the state x, y: must be the same"):
            again.take(other, "day 2")
    with pytest.raises(ValueError, match=r"order = \[2, 1\]: must be one number, or 3"):
        Machine(order=[2, 1]).take(dict.fromkeys("abc", day), "day")
    single = Machine(window=20.0)
    single.take(day, "day")
    single.save(path)
    state = json.loads(path.read_text())
    del state["axes"]
    path.write_text(json.dumps(state))
    with pytest.raises(ValueError, match="has x, the state one y"):
        Machine.load(path).take({"x": day}, "day")


def test_a_window_that_lacks_too_much_of_one_axis_is_left_out() -> None:
    """Of all: their numbers are of the same time."""
    whole = driven(1)
    y = whole.y.copy()
    y[5000:5100] = math.nan
    machine = Machine(window=20.0)
    machine.take({"x": whole, "y": whole._replace(y=y)}, "day")
    assert (machine.left_out, machine.watch.labels) == (1, [])


@pytest.mark.trial
def test_a_recording_of_axes_is_watched_as_the_running_loop_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In blocks of any size; by the command, from a recording, also without its header, and from a saved run."""
    move = ql.signals.Sinusoid(1.0, 3.0)
    found = Outcome(None, gantry(learning=True), (move, move), duration=5.0)
    sink = WatchSink(tmp_path / "watch.json", Machine(window=2.0))
    csv = CsvSink(tmp_path / "run.csv")
    for each in (sink, csv):
        each.open(found.header)
        for begin in range(0, len(found.rows), 37):
            each.write(found.rows[begin : begin + 37])
        each.close()
    kept, again = Machine.load(tmp_path / "watch.json"), Machine(window=2.0)
    again.take(signals_of(tmp_path / "run.csv"), "run.csv")
    assert kept.axes == again.axes == ("x", "y")
    assert kept.watch.features == again.watch.features
    assert {"x: b0", "y: f_rms", "y: error"} <= set(kept.watch.features)
    assert any(name.startswith("y: theta ") for name in kept.watch.features)
    for name in kept.watch.features:
        np.testing.assert_allclose(kept.watch.values(name), again.watch.values(name), rtol=1e-6)
    found.run.save(tmp_path / "run.nc")
    (tmp_path / "alone.csv").write_bytes((tmp_path / "run.csv").read_bytes())
    for name in ("run.csv", "run.nc", "alone.csv"):
        shown = in_this_process(
            ["watch", str(tmp_path / name), "--window", "2"], monkeypatch, capsys
        )
        assert shown.code == 0, shown.err
        assert f"{name}: 2 windows" in shown.out
        assert "y: b0" in shown.out
    with pytest.raises(ValueError, match="must be the same axes"):
        WatchSink(tmp_path / "watch.json").open(header_of(simulated(5.0), controller()))
