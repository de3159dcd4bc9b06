"""Plants of the user, wherever a plant can be named: setups, rigs, twins, tuning, sweeps, export."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell import analysis
from quell.export.c_files import plant_source
from quell.plants import NonlinearPlant, labelled, signals_of
from quell.plants.nonlinear import CompiledParametric
from quell.plants.registry import IDENTIFIED_NUMBERS
from quell.realtime import open_device
from quell.setup import SetupError, made, plant_given, plant_of, varied
from quell.setup.loading import tuning_task
from quell.setup.sweeps import sweep_of
from tests.commands import Shown

DT = 0.01
MODEL = {"num": [50.0], "den": [1.0, 22.0, 40.0, 0.0], "delay": 0.02}
MODEL |= {"friction": 0.1, "friction_width": 0.05}
PYTHON = """
import math
import quell as ql

def swing(t, x, u, w, m, length=0.5):
    return x[1], (u + w[0]) / (m * length**2) - 9.81 / length * math.sin(x[0]) - 0.1 * x[1]

def turned(x, gain=2.0):
    return gain * x[0]

def motor(gain=50.0):
    return ql.plants.LinearPlant.of(([gain], [1.0, 22.0, 40.0, 0.0]))

ready = motor()

def nothing():
    return 3.0
"""
SWING = {"source": "mine.py:swing", "order": 2, "parameters": {"m": 1.0}}
SETUP: dict[str, Any] = {
    "dt": DT,
    "observer": {"kind": "model-free", "order": 2, "b0": 4.0, "omega_o": 20.0},
    "controller": {"omega_c": 4.0},
    "scenario": {"duration": 0.05, "reference": 1.0},
}


def swing(t: float, x: Any, u: float, w: Any, m: float, length: float = 0.5) -> tuple[float, float]:
    """Return the rates of a pendulum."""
    return x[1], (u + w[0]) / (m * length**2) - 9.81 / length * math.sin(x[0]) - 0.1 * x[1]


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder, with a model, Python code and a setup in it."""
    monkeypatch.chdir(tmp_path)
    Path("model.json").write_text(json.dumps(MODEL))
    Path("mine.py").write_text(PYTHON)
    Path("setup.toml").write_text(
        f"dt = {DT}\ncontroller = {{omega_c = 4.0}}\n"
        "observer = {kind = 'model-free', order = 2, b0 = 4.0, omega_o = 20.0}\n"
        "scenario = {duration = 0.05, reference = 1.0}\n"
        "[plant]\nkind = 'python'\nsource = 'mine.py:swing'\norder = 2\n"
        "[plant.parameters]\nm = 1.0\n"
    )
    return tmp_path


@pytest.mark.parametrize(
    "text",
    [
        "two-mass",
        "model.json",
        "mine.py:motor",
        "mine.py:ready",
        "setup.toml",
        "{kind = 'linear', num = [50.0], den = [1.0, 22.0, 40.0, 0.0]}",
        "{kind = 'linear', A = [[0.0]], B = [1.0], C = [1.0], E = [[1.0, 2.0]]}",
    ],
)
def test_a_plant_on_the_command_line_is_a_plant_of_a_setup_and_a_twin(
    text: str, files: Path
) -> None:
    """Name, setup, model, Python and table: all are plants, and a twin moves as the plant does."""
    plant = plant_given(text, DT, trust=True)
    twin = open_device(f"twin:{text}", DT, trust=True)
    for _ in range(3):
        twin.write(1.0)
    own = made("own", {**SETUP, "plant": _table(text)}, trust=True)
    assert own.plant is not None
    assert own.plant.order == plant.order
    x, scratch = np.zeros(plant.order), np.zeros(6 * plant.order)
    model = plant.sampled(DT, interpret=True)
    for k in range(3):
        ql.plants.base.advance(model, x, scratch, k * DT, 1.0, np.zeros(plant.disturbances))
    np.testing.assert_allclose(twin.x, x, rtol=1e-12, atol=1e-15)


def _table(text: str) -> Any:
    if text.endswith(".json"):
        return {"kind": "identified", "path": text}
    if ".py:" in text:
        return {"kind": "python", "source": text}
    if text.endswith(".toml"):
        pendulum = {"kind": "python", "source": "mine.py:swing", "order": 2}
        return {**pendulum, "parameters": {"m": 1.0}}
    if text.startswith("{"):
        import tomllib

        return tomllib.loads(f"plant = {text}")["plant"]
    return text


def test_an_identified_plant_takes_its_numbers_in_place_of_a_file(files: Path) -> None:
    """They give the same plant; both together, half a friction, and none are refused."""
    numbers = json.loads((files / "model.json").read_text())
    table = {"kind": "identified"} | {
        key: numbers[key] for key in IDENTIFIED_NUMBERS if numbers.get(key) is not None
    }
    states = []
    for each in (table, {"kind": "identified", "path": "model.json"}):
        plant = plant_of(each, DT)
        model = plant.sampled(DT, interpret=True)
        x, scratch = np.zeros(plant.order), np.zeros(6 * plant.order)
        for k in range(20):
            ql.plants.base.advance(model, x, scratch, k * DT, 0.3, np.zeros(1))
        states.append(x.tolist())
    assert states[0] == states[1]
    assert states[0][2] != 0.0
    for wrong, words in (
        ({"path": "model.json", "num": [1.0]}, "num: go without path"),
        ({"num": [1.0]}, "path: missing; give the file of results, or num and den"),
        ({"num": [1.0], "den": [1.0, 1.0], "friction": 0.1}, "give both or none"),
        (
            {"num": [1.0], "den": [1.0, 1.0], "friction": 0.1, "friction_width": 0.0},
            "friction_width = 0.0: must be finite and greater than zero",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            plant_of({"kind": "identified"} | wrong, DT)


def test_an_identified_model_has_its_delay_and_friction(files: Path) -> None:
    """``(num, den)`` behind two samples; a file without model says what it should be."""
    plant = plant_of({"kind": "identified", "path": "model.json"}, DT)
    assert plant.order == 3 + 2
    found, delay = analysis_part(plant)
    np.testing.assert_allclose(found.B[:, 0], [0.0, 0.0, 50.0])
    assert delay == pytest.approx(0.02)
    model = plant.sampled(DT, interpret=True)
    x, scratch, w = np.zeros(plant.order), np.zeros(6 * plant.order), np.zeros(1)
    for u in (0.05, 0.3):  # at rest the speed v has 40 v/50 + F tanh(v/0.05) = u
        for k in range(1000):
            ql.plants.base.advance(model, x, scratch, k * DT, u, w)
        before = x[0]
        ql.plants.base.advance(model, x, scratch, 0.0, u, w)
        speed = (x[0] - before) / DT
        assert 0.8 * speed + 0.1 * math.tanh(speed / 0.05) == pytest.approx(u, rel=1e-6)
    without = {key: value for key, value in MODEL.items() if key != "friction_width"}
    Path("older.json").write_text(json.dumps(without))
    with pytest.warns(ql.types.DesignWarning, match=r"older\.json: its friction is left out"):
        plant_of({"kind": "identified", "path": "older.json"}, DT)
    Path("zero.json").write_text(json.dumps(MODEL | {"den": [0.0, *MODEL["den"]]}))
    with pytest.raises(SetupError, match=r"den\[0\] = 0\.0: must not be zero"):
        plant_of({"kind": "identified", "path": "zero.json"}, DT)
    Path("other.json").write_text("[1, 2]")
    with pytest.raises(SetupError, match=r"plant\.path = 'other\.json': has no model"):
        plant_of({"kind": "identified", "path": "other.json"}, DT)
    with pytest.raises(SetupError, match=r"plant\.path = 'no\.json': can't be read"):
        plant_of({"kind": "identified", "path": "no.json"}, DT)


def analysis_part(plant: Any) -> tuple[Any, float]:
    """Return the linear plant and its delay."""
    from quell.plants.linearise import linear_part

    return linear_part(plant, DT)


def test_python_runs_only_with_trust(files: Path, quell: Callable[..., Shown]) -> None:
    """Without it nothing of the file is run, and one line says why; a file can't ask for it."""
    Path("mine.py").write_text("open('ran', 'w')\n" + PYTHON)
    for arguments in (
        ("run", "setup.toml"),
        ("tune", "setup.toml"),
        ("export", "setup.toml", "--out", "c"),
        ("rig", "--device", "udp://127.0.0.1:9", "--plant", "mine.py:motor"),
        ("run-rig", "setup.toml"),
    ):
        shown = quell(*arguments)
        assert shown.code == 2
        assert len(shown.err.splitlines()) == 1
        assert "would run this Python file; give --trust" in shown.err
    with pytest.raises(ValueError, match="would run this Python file"):
        open_device("twin:mine.py:motor", DT)
    with pytest.raises(SetupError, match=r"plant\.trust: unknown; a file can't ask for trust"):
        plant_of({"kind": "python", "source": "mine.py:motor", "trust": True}, DT)
    assert not Path("ran").exists()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"source": "mine.py:moter"}, "moter is not in it; did you mean motor"),
        ({"source": "mine.py"}, "must be a file and a name"),
        ({"source": "no.py:motor"}, "can't be read"),
        ({"source": "mine.py:nothing"}, "returns float, must return a plant; .* give order"),
        ({"source": "mine.py:swing"}, "fails with TypeError"),
        ({"source": "bad.py:motor"}, "bad.py fails in line 2 with ZeroDivisionError"),
        ({"source": "mine.py:swing", "order": 2}, "m is missing|fails with TypeError"),
        (
            {"source": "mine.py:swing", "order": 2, "parameters": {"mass": 1.0}},
            r"parameters\['mass'\]: is no argument of f or output; did you mean m|must be one of m",
        ),
        ({"source": "mine.py:motor", "substeps": 3}, "is for an equation, which also has order"),
        ({**SWING, "operating_point": {"x": 1.0}}, r"point\[0\] has shape \(1,\)"),
        ({**SWING, "operating_point": {"x": "none"}}, r"operating_point\[0\]: "),
        ({**SWING, "operating_point": {"x": [0.0, 0.0], "u": [1.0]}}, r"operating_point\[1\] = "),
        ({"source": "ends.py:motor"}, "ends.py fails in line 1 with SystemExit: 3"),
    ],
)
def test_mistakes_in_python_plants_are_one_line(
    table: dict[str, Any], message: str, files: Path
) -> None:
    """Each names the key of the table and what to do."""
    Path("bad.py").write_text("x = 1\ny = x / 0\n")
    Path("ends.py").write_text("raise SystemExit(3)\n")
    with pytest.raises(SetupError, match=message) as caught:
        plant_of({"kind": "python", **table}, DT, trust=True)
    assert len(caught.value.mistakes) == 1
    assert caught.value.mistakes[0].startswith("plant: plant")


def test_a_python_plant_is_varied_tuned_and_swept(files: Path) -> None:
    """Its parameters are paths like all others, and its linear part is what designs use."""
    tables = {**SETUP, "plant": _table("setup.toml")}
    setup = made("own", tables, trust=True)
    heavier = varied(setup, {"plant.parameters.m": 2.0})
    assert isinstance(heavier.plant, NonlinearPlant)
    assert heavier.plant.parameters == {"m": 2.0, "length": 0.5}
    assert isinstance(setup.plant, NonlinearPlant)
    assert heavier.plant.f is setup.plant.f  # so nothing is compiled again
    task = tuning_task(files / "setup.toml", trust=True)
    np.testing.assert_allclose(task.plant.B[:, 0], [0.0, 4.0], rtol=1e-6)
    sweep = {"parameters": {"plant.parameters.m": [1.0, 2.0]}}
    plan = sweep_of(made("own", {**tables, "sweep": sweep}, trust=True))
    swept = plan["build"](**{"plant.parameters.m": 2.0})
    assert swept.plant.parameters["m"] == 2.0
    model_based = {"kind": "model-based", "omega_o": 20.0}
    observed = made("own", {**tables, "observer": model_based}, trust=True)
    assert observed.controller.observer.degree == 2


def test_ranges_of_the_parameters_of_a_python_plant_are_tuned_for(files: Path) -> None:
    """Also of one that has its default in the file."""
    text = (
        (files / "setup.toml")
        .read_text()
        .replace("[plant.parameters]", "uncertain = RANGES\n[plant.parameters]")
    )
    ranges = '{"parameters.m" = [0.5, 2.0], "parameters.length" = [0.4, 0.6]}'
    (files / "setup.toml").write_text(text.replace("RANGES", ranges))
    task = tuning_task(files / "setup.toml", trust=True)
    made_of = task.plant(**{"parameters.m": 2.0, "parameters.length": 0.5})
    np.testing.assert_allclose(made_of.B[:, 0], [0.0, 2.0], rtol=1e-6)
    (files / "setup.toml").write_text(text.replace("RANGES", '{"parameters.mass" = [0.5, 2.0]}'))
    with pytest.raises(SetupError, match="mass"):
        tuning_task(files / "setup.toml", trust=True)


def test_parameters_reach_equation_and_output_alike_in_python_c_and_machine_code() -> None:
    """The closed form of the rates; other numbers use the same machine code."""
    plant = NonlinearPlant(
        swing, 2, lambda x, gain: gain * x[0], parameters={"m": 2.0, "gain": 3.0}
    )
    assert plant.parameters == {"m": 2.0, "length": 0.5, "gain": 3.0}
    other = plant.with_parameters(gain=4.0, length=1.0)
    code = [each.sampled(DT) for each in (plant, other)]
    assert all(isinstance(each, CompiledParametric) for each in code)
    assert code[0][:2] == code[1][:2]
    for each, model in zip((plant, other), code, strict=True):
        x, w, dx = np.array([0.3, -0.2]), np.array([0.1]), np.zeros(2)
        from quell.plants.base import measure
        from quell.plants.nonlinear import derivatives

        derivatives(model, 0.0, x, 0.5, w, dx)
        numbers = dict(each.parameters or {})
        assert measure(model, x) == pytest.approx(numbers.pop("gain") * 0.3)
        np.testing.assert_allclose(dx, swing(0.0, x, 0.5, w, **numbers), rtol=1e-14)
    source = plant_source(plant, DT)
    assert "{2.0, 0.5, 3.0}" in source.source


def test_a_nonlinear_plant_is_analysed_at_rest_or_at_its_operating_point() -> None:
    """Hanging: a spring; standing: the other sign. Without a state of rest an error says what to do."""
    pendulum = NonlinearPlant(swing, 2, parameters={"m": 1.0})
    controller = ql.ADRC(ql.ESO.model_free(2, b0=4.0, omega_o=20.0, dt=DT), omega_c=4.0)
    standing = NonlinearPlant(
        swing, 2, parameters={"m": 1.0}, operating_point=([math.pi, 0.0], 0.0)
    )
    for plant, sign in ((pendulum, -1.0), (standing, 1.0)):
        direct = ([[0.0, 1.0], [sign * 9.81 / 0.5, -0.1]], [0.0, 4.0], [1.0, 0.0])
        found, wanted = (analysis.analyse(each, controller) for each in (plant, direct))
        assert found.margins.modulus == pytest.approx(wanted.margins.modulus, rel=1e-6)
    pushed = NonlinearPlant(lambda t, x, u, w: (x[1], u - 1.0), 2)
    with pytest.raises(ValueError, match=r"zero is no state of rest: give .* operating_point"):
        analysis.analyse(pushed, controller)
    with pytest.raises(ValueError, match=r"operating_point\[0\] has shape \(3,\)"):
        NonlinearPlant(swing, 2, parameters={"m": 1.0}, operating_point=([0.0] * 3, 0.0))


def test_names_and_units_belong_to_plants_of_all_kinds(files: Path) -> None:
    """In Python and in tables, also behind a delay; too many names are an error."""
    with pytest.raises(ValueError, match="w = 3: must be a list of names"):
        labelled(ql.plants.two_mass_spring(), w=3)
    plant = labelled(ql.plants.two_mass_spring(), y="position [m]", u="force [N]", w="load [N]")
    late = ql.plants.delayed(plant, DT, DT)
    names = {"y": "position [m]", "u": "force [N]", "w": ["load [N]"]}
    table = plant_of({"kind": "two-mass", "signals": names}, DT)
    for each in (plant, late, table):
        assert signals_of(each).texts() == names
    assert signals_of(plant).unit("y-unit/s^n") == "m/s^n"
    heavier = labelled(NonlinearPlant(swing, 2, parameters={"m": 1.0}), y="angle [rad]")
    assert str(signals_of(heavier.with_parameters(m=2.0)).y) == "angle [rad]"
    with pytest.raises(SetupError, match=r"plant\.signals\.w has 3 names: the plant has 2"):
        plant_of({"kind": "two-mass", "signals": {"w": ["a", "b", "c"]}}, DT)
    with pytest.raises(SetupError, match=r"plant\.signals\.y = 'a\]': must be a name and a unit"):
        plant_of({"kind": "two-mass", "signals": {"y": "a]"}}, DT)
    assert signals_of(labelled(late, w=signals_of(late).w[0])).texts() == {"w": ["load [N]"]}
