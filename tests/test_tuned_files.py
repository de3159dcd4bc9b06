"""Setup files of tuned controllers: what they contain, and that ``quell run`` accepts them."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import quell as ql
from quell.setup import load
from quell.tuning import STRUCTURES
from quell.tuning.structures.registry import AT_FREQUENCIES
from tests.commands import Shown, in_this_process

DRIVE = ([-2.0], [1.0, 3.0, 2.0])
DT = 0.05
NUMBERS = ("--num", "-2", "--den", "1,3,2", "--dt", "0.05")
FEW = ("--structure", "pi", "--no-figures")


@pytest.fixture
def quell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> object:
    """Return the function that runs a command in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: in_this_process(arguments, monkeypatch, capsys)


# The rule of thumb that warns of bandwidths beside a delay is more careful than M_s.
@pytest.mark.trial
@pytest.mark.filterwarnings("ignore::quell.types.DesignWarning")
@pytest.mark.parametrize("delay", [0.0, 0.12])
@pytest.mark.parametrize("structure", STRUCTURES)
def test_the_file_of_every_structure_is_the_tuned_loop(
    quell: object, tmp_path: Path, structure: str, delay: float
) -> None:
    """With and without a delay, which has a part of a sample: ``quell run`` accepts it, and plant and controller are those of the tuning."""
    bounds, order = ql.tuning.Constraints(m_ks=10.0), None if structure.startswith("pi") else 2
    how = {"constraints": bounds, "order": order, "compare": (), "u_min": -30.0}
    if structure in AT_FREQUENCIES:
        with pytest.raises(ValueError, match="give frequencies, or an objective LoadSpectrum"):
            ql.tune(DRIVE, DT, structure=structure, delay=delay, **how)
        how["frequencies"] = (0.4, 0.7, 1.0)[: int(structure[-1]) if structure[-1].isdigit() else 1]
    tuned = ql.tune(DRIVE, DT, structure=structure, delay=delay, **how)
    tuned.save(tmp_path / "tuned.toml")
    shown: Shown = quell("run", "tuned.toml", "--no-figures", "--json", "run.json")  # type: ignore[operator]
    assert shown.code == 0, shown.err
    setup = load(tmp_path / "tuned.toml")
    assert repr(setup.controller) == repr(tuned.controller)
    assert setup.controller.limits.low == -30.0
    loop = ql.analysis.analyse(setup.plant, setup.controller)
    assert loop.margins.modulus == pytest.approx(tuned.analysis.margins.modulus, rel=1e-9)
    step, load_window = json.loads((tmp_path / "run.json").read_text())["metrics"]
    assert step["overshoot"] is not None or "NOT settled" in str(tuned)
    assert load_window["start"] == step["stop"]
    assert "overshoot" not in load_window
    assert load_window["missing"]["overshoot"].endswith("no step")
    assert load_window["peak_error"] > 0.0


@pytest.mark.trial
def test_the_gain_is_printed_with_its_sign(quell: object) -> None:
    """Of ADRC and of PI, as text and in the JSON; K is positive for a positive plant."""
    for structure, name in (("bandwidths", "b0"), ("pi", "K")):
        command = ("tune", *NUMBERS, "--structure", structure, "--no-figures")
        shown: Shown = quell(*command, "--json", f"{name}.json")  # type: ignore[operator]
        assert f"{name} = -" in shown.out, shown.err
        values = json.loads(Path(f"{name}.json").read_text())["design"]["values"]
        assert values[name] < 0.0
    assert (
        ql.tune(([2.0], [1.0, 3.0, 2.0]), DT, structure="pi", compare=()).design.values["K"] > 0.0
    )


SETUP = """dt = 0.05
plant = { kind = "linear", num = [-2.0], den = [1.0, 3.0, 2.0] }
controller = { kind = "pid", kp = 1.0, u_max = 9.0 }
[tune]
compare = []
"""


def record(path: Path) -> None:
    """Write a record around an operating point: u = 3, and y = −3 with a constant force of −1 in u."""
    rng = np.random.default_rng(1)
    u = 3.0 + np.where(rng.integers(0, 2, 120).repeat(10) > 0, 0.5, -0.5)
    plant = ql.plants.LinearPlant.of(DRIVE)
    x0 = np.linalg.solve(plant.A, -plant.B[:, 0] * 2.0)
    t = np.arange(u.size) * DT
    model, x, y = plant.sampled(DT), x0.copy(), np.empty(u.size)
    for k, value in enumerate(u):
        y[k] = model.output @ x
        x = model.transition @ x + model.input * (value - 1.0)
    y += 1e-4 * rng.normal(size=y.size)
    np.savetxt(path, np.column_stack([t, u, y]), delimiter=",", header="t,u,y", comments="")


@pytest.mark.trial
@pytest.mark.parametrize("route", ["numbers", "setup", "record", "model"])
def test_limits_of_u_reach_the_file_by_every_route(
    quell: object, tmp_path: Path, route: str
) -> None:
    """Plant by numbers, by setup, by record and by the file of an identified model; those of the command go before the setup's."""
    (tmp_path / "plant.toml").write_text(SETUP, encoding="utf-8")
    source: tuple[str, ...] = NUMBERS
    if route == "setup":
        source = ("plant.toml",)
    if route in ("record", "model"):
        record(tmp_path / "record.csv")
        source = ("record.csv", "--model-order", "2")
    if route == "model":
        identify = ("identify", "record.csv", "--order", "2", "--no-figures", "--no-alternatives")
        assert quell(*identify, "--json", "model.json").code == 0  # type: ignore[operator]
        text = 'dt = 0.05\nplant = { kind = "identified", path = "model.json" }\n'
        (tmp_path / "model.toml").write_text(text + 'controller = { kind = "pid", kp = 1.0 }\n')
        source = ("model.toml",)
    limits = ("--u-min", "0.5", "--u-max", "4.5")
    shown: Shown = quell("tune", *source, *limits, *FEW, "--out", "tuned.toml")  # type: ignore[operator]
    assert shown.code == 0, shown.err
    setup = load(tmp_path / "tuned.toml")
    assert (setup.controller.limits.low, setup.controller.limits.high) == (0.5, 4.5)


@pytest.mark.trial
def test_the_noise_of_a_record_bounds_what_noise_does_to_u(quell: object, tmp_path: Path) -> None:
    """Its white part: 1e-4 of y was drawn; half the range of u is 2, of which it may use 2 %."""
    record(tmp_path / "record.csv")
    command = ("tune", "record.csv", "--model-order", "2", "--u-min", "0.5", "--u-max", "4.5", *FEW)
    shown: Shown = quell(*command, "--json", "tuned.json")  # type: ignore[operator]
    assert shown.code == 0, shown.err
    line = next(line for line in shown.out.splitlines() if line.startswith("std(u)"))
    noise = float(line.split("noise of ")[1].split()[0])
    assert noise == pytest.approx(1e-4, rel=0.05)
    assert "2 % of half the range of u, 2," in line


@pytest.mark.trial
def test_the_scenario_begins_at_the_operating_point_of_the_record(
    quell: object, tmp_path: Path
) -> None:
    """A plant that works at u = 3 is judged there, and not at zero, where its limits are."""
    record(tmp_path / "record.csv")
    command = ("tune", "record.csv", "--model-order", "2", "--u-min", "0", "--u-max", "6", *FEW)
    assert quell(*command, "--out", "tuned.toml").code == 0  # type: ignore[operator]
    setup = load(tmp_path / "tuned.toml")
    run = ql.simulate(setup.plant, setup.controller, setup.scenario)
    step, load_window = (run.metrics(**window) for window in setup.windows)
    before = run.window(0.0, setup.windows[0]["start"])
    assert run["u"][before][-1] == pytest.approx(3.0, abs=0.1)
    assert run["y"][before][-1] == pytest.approx(-2.0, abs=0.1)
    assert abs(step["overshoot"]) < 0.6
    assert math.isfinite(step["settling_time"])
    assert "overshoot" not in load_window


@pytest.mark.trial
def test_an_operating_point_that_is_given_is_where_the_scenario_begins(quell: object) -> None:
    """By numbers, with a delay and a lag whose states are at rest, too; half of one is refused, and one beside a setup."""
    at = ("--u-rest", "3", "--y-rest", "-2.5", "--delay", "0.12")
    assert quell("tune", *NUMBERS, *at, *FEW, "--out", "tuned.toml").code == 0  # type: ignore[operator]
    setup = load("tuned.toml")
    model, x = setup.plant.sampled(DT, interpret=True), np.array(setup.scenario.x0)
    from quell.plants.base import advance, measure

    w = np.array([signal(np.zeros(1))[0] for signal in setup.scenario.seeded_signals(1)[1]])
    assert measure(model, x) == pytest.approx(-2.5)
    later = x.copy()
    advance(model, later, np.zeros(6 * x.size), 0.0, 3.0, w)
    np.testing.assert_allclose(later, x, atol=1e-12)
    Path("plant.toml").write_text(SETUP, encoding="utf-8")
    for command, message in (
        ((*NUMBERS, "--u-rest", "3"), "--u-rest and --y-rest: go together"),
        (("plant.toml", "--y-rest", "3"), "--y-rest: is the operating_point of [plant]"),
    ):
        shown: Shown = quell("tune", *command, *FEW)  # type: ignore[operator]
        assert shown.code == 2
        assert message in shown.err


HEATER = ([0.7], np.polymul([142.0, 1.0], [19.0, 1.0]).tolist())
MOTOR = ([45_000.0], [1.0, 3.3, 0.0])


@pytest.mark.trial
@pytest.mark.parametrize(
    ("plant", "dt", "limits", "expected"),
    [
        (HEATER, 1.0, {"u_min": 0.0, "u_max": 100.0}, (1.0, -1.0)),
        (HEATER, 1.0, {"u_min": 0.0, "u_max": 1.0}, (0.28, -0.4)),
        (HEATER, 1.0, {"u_min": -9.0}, (1.0, 1.0)),
        (MOTOR, 1e-3, {"u_min": -0.5, "u_max": 0.5}, (None, 0.2)),
        (DRIVE, 0.05, {"u_min": 0.5, "u_max": 4.5}, (1.0, 1.0)),
    ],
)
def test_step_and_load_of_the_file_can_be_held_within_the_limits_of_u(
    tmp_path: Path,
    plant: tuple[list[float], list[float]],
    dt: float,
    limits: dict[str, float],
    expected: tuple[float | None, float],
) -> None:
    """With 40 % each of what the limits leave at rest: of a heater at zero the load is negative, and limits beside zero have their rest in the middle. A step that needs no u at rest, as a motor's, keeps within the limits on the way and overshoots by 5 % at most."""
    tuned = ql.tune(plant, dt, structure="bandwidths", order=2, compare=(), **limits)
    tuned.save(tmp_path / "tuned.toml")
    setup = load(tmp_path / "tuned.toml")
    signals = setup.scenario.reference, setup.scenario.disturbances[0]
    before, after = np.array([-1.0]), np.array([setup.scenario.duration])
    sizes = tuple(float(s(after)[0] - s(before)[0]) for s in signals)
    if "u_min" in limits and limits["u_min"] <= 0.0:
        assert sizes == (expected[0] or sizes[0], expected[1])
    run = ql.simulate(setup.plant, setup.controller, setup.scenario)
    if expected[0] is None:
        during = run.window(0.0, 0.5 * setup.scenario.duration)
        assert 0.4 * limits["u_max"] < np.max(np.abs(run["u"][during])) < limits["u_max"]
        assert np.max(run["y"][during]) <= 1.05 * sizes[0]
    assert run["y"][-1] == pytest.approx(run["r"][-1], abs=0.02 * abs(sizes[0]))
    least, most = limits["u_min"], limits.get("u_max", math.inf)
    inside = run["u"][-(run["u"].size // 10) :]
    assert np.all((least < inside) & (inside < most))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"rest": (5.0, 0.0)}, "u at rest = 5: must lie within u_min = 1 and u_max = 4"),
        ({}, "u at rest = 0: .*give u and y at rest"),
    ],
)
def test_a_rest_that_u_cannot_hold_is_refused(given: dict[str, object], message: str) -> None:
    """Whether it is given, or zero by default for a plant that integrates."""
    with pytest.raises(ValueError, match=message):
        ql.tune(MOTOR, 1e-3, structure="bandwidths", compare=(), u_min=1.0, u_max=4.0, **given)


@pytest.mark.trial
def test_a_nonlinear_plant_is_judged_at_its_operating_point(tmp_path: Path) -> None:
    """A tank: outflow with the root of its level, a tenth of a volt to a centimetre."""
    tank = ql.plants.NonlinearPlant(
        lambda t, x, u, w: (u + w[0] - math.sqrt(max(x[0], 0.0)),),
        order=1,
        operating_point=([9.0], 3.0),
    )
    tuned = ql.tune(tank, 0.1, structure="pi", compare=(), u_min=0.0, u_max=10.0)
    tuned.save(tmp_path / "tuned.toml")
    setup = load(tmp_path / "tuned.toml")
    run = ql.simulate(setup.plant, setup.controller, setup.scenario)
    start = setup.windows[0]["start"]
    assert run["y"][run.window(0.0, start)][-1] == pytest.approx(9.0, abs=0.05)
    assert run["u"][run.window(0.0, start)][-1] == pytest.approx(3.0, abs=0.05)
    assert run.metrics(**setup.windows[0])["overshoot"] < 0.5


@pytest.mark.trial
def test_a_delay_of_the_table_tune_is_in_the_plant_of_the_file(
    quell: object, tmp_path: Path
) -> None:
    """Once: the file's own [tune] has none any more; ranges of the plant keep their place."""
    text = SETUP.replace("[tune]", "[tune]\ndelay = 0.12").replace("num = [-2.0]", "num = [-2.0]")
    (tmp_path / "plant.toml").write_text(text, encoding="utf-8")
    shown: Shown = quell("tune", "plant.toml", *FEW, "--out", "tuned.toml")  # type: ignore[operator]
    assert shown.code == 0, shown.err
    setup = load(tmp_path / "tuned.toml")
    assert setup.plant.delay == pytest.approx(0.12)
    assert "delay" not in setup.tune
    again: Shown = quell("tune", "tuned.toml", *FEW, "--out", "again.toml")  # type: ignore[operator]
    assert again.code == 0, again.err
    other = load(tmp_path / "again.toml")
    assert other.controller.ki == pytest.approx(setup.controller.ki, rel=1e-6)


@pytest.mark.trial
def test_the_table_of_a_tuning_is_not_cut_in_80_columns(
    quell: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Names of structures stand in one line, beside numbers of eight digits."""
    monkeypatch.setenv("COLUMNS", "80")
    Path("plant.toml").write_text(
        SETUP.replace("num = [-2.0]", "num = [-2.0e-5]"), encoding="utf-8"
    )
    command = ("tune", "plant.toml", "--structure", "half-gain-law", "--order", "2", "--no-figures")
    shown: Shown = quell(*command)  # type: ignore[operator]
    assert "…" not in shown.out
    rows = [
        line
        for line in shown.out.splitlines()
        if line.strip().startswith("half-gain-law of order 2 ")
    ]
    assert rows, shown.out


@pytest.mark.trial
def test_what_the_record_does_not_show_stands_behind_the_margins(
    quell: object, tmp_path: Path
) -> None:
    """A pole that depends on the sign of y, which the model lacks: its line with NOT is behind the margins, in JSON and in the file."""
    u = np.repeat(np.random.default_rng(1).choice([-1.0, -0.3, 0.4, 1.0], 120), 5)
    y = np.zeros(u.size)
    for k in range(u.size - 1):
        y[k + 1] = (0.97 if y[k] > 0.0 else 0.8) * y[k] + 0.1 * u[k]
    table = np.column_stack([np.arange(u.size) * DT, u, y])
    np.savetxt(tmp_path / "rec.csv", table, delimiter=",", header="t,u,y", comments="")
    order = ("tune", "rec.csv", "--model-order", "1", "--u-min", "-1", "--u-max", "1", *FEW)
    shown: Shown = quell(*order, "--out", "rec.toml", "--json", "rec.json")  # type: ignore[operator]
    assert shown.code == 0, shown.err
    behind = shown.out[shown.out.index("Optima under these constraints") :]
    line = "NOT: the margins hold for the model only: the response to u is not of this form"
    assert line in " ".join(behind.split())
    assert f"# {line}" in (tmp_path / "rec.toml").read_text()
    (doubt,) = json.loads((tmp_path / "rec.json").read_text())["doubts"]
    assert doubt.startswith("the response to u is not of this form")
    assert load(tmp_path / "rec.toml").controller is not None
