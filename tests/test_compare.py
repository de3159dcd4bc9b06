"""Controllers side by side: in Python, and as ``quell compare``."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import quell as ql
from quell import setup as setup_room
from quell.cli.app import app
from quell.experiments import compare
from quell.experiments.compare import FORCE, FORCE_AT, Benchmark

from .cases import cases
from .commands import Shown

LAG = ql.plants.LinearPlant([[-1.0]], [1.0], [1.0])


@pytest.mark.trial
def test_any_controllers_on_any_plant_are_judged_alike() -> None:
    """Each run is that of ``simulate``; the scores are what closed forms say: PI that cancels the lag leaves a lag of 1/4 s."""
    scenario = ql.Scenario(
        reference=1.0, disturbances=(ql.signals.Step(at=5.0, height=0.5),), duration=10.0
    )
    some = {
        "PI": ql.baselines.PID(4.0, 4.0, dt=1e-3),
        "ADRC": ql.ADRC(ql.ESO.model_free(1, 1.0, 20.0, 1e-3), 4.0),
        "P": ql.baselines.PID(1.0, dt=1e-3),
    }
    result = compare.compare(LAG, some, scenario, load_at=5.0)
    np.testing.assert_array_equal(
        result.runs["ADRC"].log, ql.simulate(LAG, some["ADRC"], scenario).log
    )
    pi = result.scores["PI"]
    assert pi["overshoot"] == pytest.approx(0.0, abs=1e-9)
    assert pi["settling_time"] == pytest.approx(-math.log(0.02) / 4.0, abs=5e-3)
    # A load through s/((s + 1)(s + 4)): its peak under 0.5.
    peak_at = math.log(4.0) / 3.0
    assert pi["disturbance_peak"] == pytest.approx(
        0.5 / 3.0 * (math.exp(-peak_at) - math.exp(-4.0 * peak_at)), rel=1e-3
    )
    assert result.scores["P"]["settling_time"] is None
    assert result.scores["P"]["disturbance_peak"] == pytest.approx(0.5, abs=1e-2)
    assert set(result.to_json()["controllers"]["P"]) >= {
        "overshoot",
        "settling_time",
        "rms",
        "control_variation",
        "status",
        "diverged",
    }


def test_the_energy_that_u_puts_in_is_what_the_plant_has_in_the_end() -> None:
    """Two masses without friction keep what u put in and did not take back; half of k x² and m v² say how much."""
    plant = ql.plants.two_mass_spring(m1=2.0, m2=0.5, k=3.0)
    run = ql.simulate(
        plant, ql.baselines.LQG(plant, 1.0, 10.0, 1e-3), ql.Scenario(1.0, 4.0), interpret=True
    )
    flow = plant.flow  # type: ignore[attr-defined]
    back = flow._replace(state=tuple(-weight for weight in flow.state))
    got, returned = (compare.power_scores(each, run)["energy"] for each in (flow, back))
    x1, x2, v1, v2 = run["x"][-1]
    held = 0.5 * (2.0 * v1**2 + 0.5 * v2**2 + 3.0 * (x1 - x2) ** 2)
    assert got is not None
    assert returned is not None
    assert returned > 0.05 * got
    assert got - returned == pytest.approx(held, rel=1e-4)


@cases("inductance", [None, 2e-3])
def test_the_energy_of_a_motor_is_that_of_its_supply(inductance: float | None) -> None:
    """It becomes heat in the winding, viscous friction, motion, and the field of the inductance; a voltage beyond the limit is cut."""
    motor = ql.plants.dc_motor(inductance=inductance, coulomb=0.0, counts=4096, voltage_limit=12.0)
    dt = 1e-4
    result = compare.compare(
        motor, {"on": ql.baselines.PID(1e9, dt=dt)}, ql.Scenario(1e3, 0.03), record_every=1
    )
    run, score = result.runs["on"], result.scores["on"]
    assert result.no_power == ""
    speed = run["x"][:, 1]
    i = (12.0 - 0.05 * speed) / 0.5 if inductance is None else run["x"][:, 2]
    lost = np.trapezoid(0.5 * i**2 + 1e-4 * speed**2, run.t)
    held = 0.5 * (2e-4 * speed[-1] ** 2 + (inductance or 0.0) * i[-1] ** 2)
    assert score["energy"] == pytest.approx(lost + held, rel=2e-3)
    assert score["peak_power"] == pytest.approx(12.0 * np.max(i), rel=1e-9)


@cases(
    ("plant", "every", "said"),
    [
        (LAG, 1, "does not say how fast u moves it"),
        (ql.plants.delayed(ql.plants.two_mass_spring(), 0.02, 0.01), 1, "acts on u late"),
        (ql.plants.two_mass_spring(), 2, "each nth sample"),
    ],
)
def test_energy_that_is_not_known_has_its_reason(plant: object, every: int, said: str) -> None:
    """None and a sentence, in place of a number; the plant of a user may have weights of its states."""
    some: dict[str, ql.Controller] = {"P": ql.baselines.PID(0.1, dt=0.01)}
    scenario = ql.Scenario(reference=1.0, duration=1.0)
    result = compare.compare(plant, some, scenario, record_every=every)  # type: ignore[arg-type]
    assert said in result.no_power
    assert result.to_json()["no_power"] == result.no_power
    assert (result.scores["P"]["energy"], result.scores["P"]["peak_power"]) == (None, None)
    cart = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0])
    known = compare.compare(ql.plants.labelled(cart, flow=[0.0, 1.0]), some, scenario)
    v = known.runs["P"]["x"][:, 1]
    assert known.scores["P"]["energy"] == pytest.approx(0.5 * v[-1] ** 2)
    with pytest.raises(ValueError, match="flow"):
        ql.plants.labelled(cart, flow=[0.0, 1.0, 0.0])


def test_a_run_that_diverges_is_shown_as_one() -> None:
    """No number where there is none; the others are judged as ever, and the figure is drawn."""
    some = {
        "wrong sign": ql.baselines.PID(-40.0, dt=0.01),
        "right": ql.baselines.PID(4.0, 4.0, dt=0.01),
    }
    result = compare.compare(LAG, some, ql.Scenario(reference=1.0, duration=5.0))
    assert result.runs["wrong sign"].diverged
    assert set(result.scores["wrong sign"].values()) == {None}
    assert result.scores["right"]["control_energy"] is not None
    assert result.scores["right"]["settling_time"] is not None
    axes = compare.draw(result)
    assert "wrong sign (diverged)" in axes[0].get_legend_handles_labels()[1]
    assert axes[0].get_ylim()[1] < 1e5


@pytest.mark.trial
@pytest.mark.compiled
def test_the_benchmarks_controllers_are_stable_and_do_what_they_are_there_for() -> None:
    """At 5 ms. No model: MF-ESO rejects the load to a fiftieth of PID. LQG and MB-ESO alike. PID is slow."""
    result = compare.two_mass(Benchmark(dt=5e-3), [*compare.NAMES, "zv+lqg"])
    scores = result.scores
    assert not any(run.diverged for run in result.runs.values())
    for name in ("mf-eso", "mb-eso", "l-eso", "lqg", "resonance-ratio", "zv+lqg"):
        run = result.runs[name]
        assert np.max(np.abs(run["y"][run.window(FORCE_AT - 5.0, FORCE_AT)] - 1.0)) < 0.01
        assert np.max(np.abs(run["y"][run.window(95.0, 101.0)] - 1.0)) < 0.01
        assert np.mean(run["u"][run.window(95.0, 101.0)]) == pytest.approx(-FORCE, abs=0.01)
    assert scores["mf-eso"]["disturbance_peak"] < scores["pid"]["disturbance_peak"] / 50.0
    assert scores["zv+lqg"]["overshoot"] < 0.5 * scores["lqg"]["overshoot"]
    assert scores["pid"]["control_variation"] < 1.0
    assert "r_shaped" in result.runs["zv+lqg"].names


@cases(
    ("wrong", "message"),
    [
        (
            lambda: compare.compare(LAG, {}, ql.Scenario()),
            "controllers is empty: must have at least one",
        ),
        (
            lambda: compare.compare(LAG, {"P": 1}, ql.Scenario(), load_at=11.0),
            "load_at = 11.0: must lie within .0, duration = 10.0.",
        ),
        (
            lambda: compare.compare(LAG, {"P": 1}, ql.Scenario()),
            r"controllers\['P'\] = 1: must be a controller",
        ),
        (
            lambda: compare.compare(
                LAG, {"P": ql.baselines.PID(1.0, dt=1e-3), "Q": ql.baselines.PID(1.0, dt=0.02)}, ql.Scenario()
            ),
            "P has dt = 0.001 s, Q 0.02 s: must have one dt",
        ),
        (
            lambda: compare.controller("pdi", 0.01),
            "controllers: 'pdi' must be one of mf-eso, mb-eso",
        ),
        (lambda: compare.controller("zv+zv+pid", 0.01), "controllers: 'zv.zv.pid' must be one of"),
        (lambda: Benchmark(dt=0.2), "dt = 0.2: must be at most 0.1 s"),
        (lambda: Benchmark(u_max=0.0), "u_max = 0.0: must be greater than zero"),
        (lambda: Benchmark(k=-1.0), "k = -1.0: must be finite and greater than zero"),
        (lambda: Benchmark(seed=-1), "seed = -1: must be a whole number"),
    ],
)  # fmt: skip
def test_a_mistake_is_named(wrong: object, message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        wrong()  # type: ignore[operator]


@pytest.mark.trial
@pytest.mark.compiled
def test_an_unstable_loop_is_called_one_and_its_numbers_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On 80 columns with a spring of half the stiffness: PI + notch is far from r after 100 s, LQG is lost."""
    monkeypatch.setenv("COLUMNS", "80")
    names = ["lqg", "pid", "pi-notch", "resonance-ratio", "zvd+lqg"]
    where = ["--json", str(tmp_path / "out.json"), "--no-figures"]
    with pytest.raises(SystemExit, match="4"):
        app(["compare", "--k", "0.5", "--dt", "0.01", "--controllers", ",".join(names), *where])
    shown = capsys.readouterr().out
    assert "…" not in shown, "a column is cut"
    lines: dict[str, list[str]] = {}
    for line in shown.splitlines():
        if line.split() and line.split()[0] in names:
            lines.setdefault(line.split()[0], line.split())  # the table of gains comes second
    assert list(lines) == names
    assert "[%]" in shown
    assert "[m]" in shown, "a unit is taken for markup"
    assert all(len(line) >= 7 for line in lines.values())
    assert lines["pi-notch"][-2:] == ["ran", "away"]
    assert lines["pid"][-1] == "ok"
    assert "diverged" in lines["lqg"]
    stable = {
        name: told["stable"]
        for name, told in json.loads((tmp_path / "out.json").read_text())["controllers"].items()
    }
    assert stable == {name: name == "pid" for name in names} | {
        "resonance-ratio": lines["resonance-ratio"][-1] == "ok"
    }


@pytest.mark.trial
@pytest.mark.compiled
def test_what_is_proved_of_a_guarded_learner_is_told_for_the_real_plant(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As text and in the JSON; on a plant that is unstable without learner, where the run may end either way, it says why there is no proof."""
    where = ["--json", str(tmp_path / "out.json"), "--no-figures", "--overwrite"]
    told = []
    for k, code in (("1", "^0$"), ("2", "^[04]$")):
        with pytest.raises(SystemExit, match=code):
            app(["compare", "--k", k, "--dt", "0.005", "--controllers", "guarded-l-eso", *where])
        told.append(json.loads((tmp_path / "out.json").read_text())["controllers"]["guarded-l-eso"])
    proof = told[0]["certificate"]
    assert proof["certified"] is (proof["kappa"] * proof["gain"] < 1.0)
    assert proof["gain"] == pytest.approx(0.713, abs=0.001)
    assert told[1]["certificate"].startswith("no certificate: plant: the loop without learner is")
    shown = capsys.readouterr().out
    assert "guarded-l-eso: not certified: κΓ = 3 · 0.713 = 2.14 must be below 1" in shown
    assert "guarded-l-eso: no certificate" in shown


@pytest.mark.trial
@pytest.mark.compiled
def test_the_comparison_is_printed_written_and_drawn(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """A table a line a controller, JSON, a figure as PNG, SVG and PDF; a mistake is one line, and nothing is written."""
    where = ("--json", "out.json", "--figures", "p")
    benchmark = ("--dt", "0.01", "--k", "1.2", "--u-max", "1")
    shown = quell("compare", *benchmark, "--controllers", "lqg, pid", *where)
    assert shown.code == 0, shown.err
    assert "lqg" in shown.out
    assert "…" not in shown.out, "a column is cut"
    assert "nan" not in shown.out.lower()
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["settings"] == {
        "m1": 1.0,
        "m2": 1.0,
        "k": 1.2,
        "dt": 0.01,
        "seed": 0,
        "u_max": 1.0,
    }
    assert list(result["controllers"]) == ["lqg", "pid"]
    assert {p.name for p in (tmp_path / "p").iterdir()} == {
        "compare.png",
        "compare.svg",
        "compare.pdf",
    }
    wrong = quell("compare", "--controllers", "lqg,nonsense", "--json", "other.json")
    assert wrong.code == 2
    assert wrong.err.startswith("quell: controllers: 'nonsense' must be one of mf-eso")
    assert len(wrong.err.strip().splitlines()) == 1
    assert {p.name for p in tmp_path.iterdir()} == {"out.json", "p"}


DOUBLE_LAG = ([2.0], [1.0, 0.5, 0.0])


def test_the_gains_of_a_loop_are_the_largest_ones_of_its_responses() -> None:
    """On a dense grid; k_i is that of the PID controller, by definition."""
    pid = ql.baselines.PID(3.0, 2.0, 1.0, tf=0.02, dt=0.002)
    found = compare.sensitivities(DOUBLE_LAG, pid)
    assert found is not None
    loop = ql.analysis.analyse(DOUBLE_LAG, pid)
    omega = np.geomspace(1e-2, np.pi / 0.002 * 0.999, 40_000)
    for value, name in ((found.m_s, "S"), (found.m_t, "T"), (found.m_ks, "CS")):
        assert value == pytest.approx(np.max(np.abs(loop.response(name, omega))), rel=1e-5)
    assert found.k_i == pytest.approx(2.0, rel=1e-3)
    assert compare.sensitivities(DOUBLE_LAG, ql.baselines.PID(-1.0, dt=0.002)) is None


@pytest.mark.trial
def test_a_reference_model_takes_the_overshoot_out_of_a_step() -> None:
    """It settles sooner than with half of its bandwidth; a loop without overshoot gets none."""
    plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, -0.5]], [0.0, 2.0], [1.0, 0.0])
    pid = ql.baselines.PID(3.0, 2.0, 1.0, tf=0.02, dt=0.01)
    shaped = compare.shaped(plant, pid)
    assert isinstance(shaped, ql.controllers.Prefiltered)
    model = shaped.prefilter
    slower = ql.controllers.Prefiltered(pid, ql.controllers.ReferenceModel(0.5 * model.omega, 2))
    step = ql.Scenario(reference=1.0, duration=15.0)
    plain, best, late = (
        ql.simulate(plant, each, step).metrics(target=1.0, band=0.02)
        for each in (pid, shaped, slower)
    )
    assert plain["overshoot"] > 0.05
    assert best["overshoot"] < 0.0205
    assert best["settling_time"] < late["settling_time"]
    assert best["settling_time"] < plain["settling_time"]
    slow = ql.baselines.PID(4.0, 4.0, dt=0.002)  # cancels the lag
    assert compare.shaped(LAG, slow) is slow


SETUP = """dt = 0.005
plant = { kind = "linear", A = [[0.0, 1.0], [0.0, -0.5]], B = [0.0, 2.0], C = [1.0, 0.0] }
observer = { kind = "model-free", order = 2, b0 = 2.0, omega_o = 20.0 }
controller = { omega_c = 3.0, u_min = -50.0, u_max = 50.0 }
[scenario]
duration = 8.0
reference = { kind = "step" }
disturbances = [{ kind = "step", height = -2.0, at = 4.0 }]
"""


@pytest.mark.trial
def test_tuned_controllers_keep_to_the_gains_of_the_setups_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """PID, and ADRC by bandwidths, with an integral gain that is not below; the file and the table say so."""
    file, out = tmp_path / "drive.toml", tmp_path / "out.json"
    file.write_text(SETUP)
    names = "setup,tuned-pid,tuned-bandwidths"
    where = ["--json", str(out), "--no-figures"]
    with pytest.raises(SystemExit, match="0"):
        app(["compare", str(file), "--controllers", names, *where])
    told = json.loads(out.read_text())
    own, *others = told["controllers"].values()
    assert told["load_at"] == 4.0
    assert told["constraints"]["m_s"] == pytest.approx(own["m_s"])
    for other in others:
        for name in ("m_s", "m_t", "m_ks"):
            assert other[name] < 1.01 * own[name]
        assert other["k_i"] > 0.95 * own["k_i"]
        assert other["overshoot"] < 0.03
        assert other["settling_time"] < 4.0
        assert other["values"]
    shown = capsys.readouterr().out
    assert "M_ks" in shown
    assert "Largest k_i:" in shown
    for arguments, message in (
        ([str(file), "--k", "2"], "--k = 2.0: is in the setup itself"),
        (["--m-s", "2"], "--m-s = 2.0: is for a comparison of a setup"),
        ([str(file), "--controllers", "lqg"], "'lqg' must be one of setup, tuned-pid"),
    ):
        with pytest.raises(ValueError, match=message):
            app(["compare", *arguments])


@pytest.mark.trial
def test_all_controllers_of_a_setup_are_compared_alike(tmp_path: Path) -> None:
    """Behind the delay of [tune], under its bounds, and without feedforward, which PID does not have; a note says so."""
    text = SETUP.replace("omega_c = 3.0,", "omega_c = 3.0, feedforward = true,")
    text = text.replace("omega_o = 20.0", "omega_o = 12.0")
    (tmp_path / "drive.toml").write_text(text + "[tune]\ndelay = 0.012\nm_s = 2.5\n")
    given = setup_room.load(tmp_path / "drive.toml")
    none = (None, None, None)
    found = compare.of_setup(given, ["setup", "tuned-bandwidths"], none, None, lambda *_: None)
    assert not found.controllers["setup"].feedforward
    assert found.notes == ("setup: without its feedforward, which PID and LQG do not have",)
    assert found.constraints.m_s == 2.5
    assert found.plant.endswith("0.012 s late")
    for name, controller in found.controllers.items():
        late = ql.simulate(ql.plants.delayed(given.plant, 0.012, 0.005), controller, given.scenario)
        np.testing.assert_array_equal(found.result.runs[name]["y"], late["y"])
    alone = compare.of_setup(given, ["setup"], none, None, lambda *_: None)
    assert alone.controllers["setup"].feedforward
