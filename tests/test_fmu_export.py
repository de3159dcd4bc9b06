"""FMUs that quell writes: FMPy checks and runs them, and they compute what quell computes."""

from __future__ import annotations

import copy
import importlib
import math
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers import in_single_precision
from quell.controllers.axes import control_all
from quell.controllers.base import set_reference_derivatives
from quell.export import TranslationError, fmu
from quell.export.fmi.parts import bandwidths, gain_coefficients
from quell.kernels.dispatch import as_python
from quell.simulation.scenario import SampledScenario

from .cases import cases
from .commands import Shown
from .contracts.test_controllers import SEVERAL
from .fmus import Driven, DrivenOlder
from .in_c import STRICT, needs_gcc

pytest.importorskip("fmpy", reason="FMPy, which checks and runs FMUs, is missing")
pytestmark = needs_gcc

DT = 0.01
MASS = ql.plants.LinearPlant([[0, 1], [0, 0]], [0, 1], [1, 0], [[0, 0], [1, 0.5]])
X0 = (0.3, -0.1)
SCENARIO = ql.Scenario(
    ql.signals.Sinusoid(omega=3.0),
    4.0,
    disturbances=(ql.signals.Sinusoid(omega=2.0), 0.2),
    noise=ql.signals.BandLimitedNoise(power=1e-9, sample_time=DT),
    x0=X0,
)


def plain(**options: Any) -> ql.ADRC:
    """A controller whose two bandwidths can be changed."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=DT)
    return ql.ADRC(observer, omega_c=3.0, u_min=-4.0, u_max=4.0, **options)


def learning() -> ql.ADRC:
    """A controller that learns under a guard."""
    return plain(learner=ql.learners.Kalman(), guard=ql.Guard(time=0.3), feedforward=True)


Maker = Callable[[str], Driven]


@pytest.fixture(scope="module", autouse=True)
def _compile_quickly() -> Iterator[None]:
    """Compile without optimisation: the bits are the same, in a third of the time."""
    with pytest.MonkeyPatch.context() as patch:
        module = importlib.import_module("quell.export.fmi.fmu")
        quick = tuple(option for option in module._OPTIONS if option != "-O2")
        patch.setattr(module, "_OPTIONS", quick)
        yield


def test_the_headers_of_fmi_come_from_fmpy_and_nothing_else_of_it_is_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Without it, or without its headers, an export says what to install and writes nothing."""
    module = importlib.import_module("quell.export.fmi.fmu")
    assert "fmi3Instance" in module.headers()["fmi3FunctionTypes.h"]
    for stand_in in (None, SimpleNamespace(__file__=str(tmp_path / "x.py"), __version__="0")):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, "fmpy", stand_in)
            with pytest.raises(ImportError, match=r"install 'quell-control\[fmi\]'"):
                fmu(plain(), tmp_path / "servo.fmu")
    assert not (tmp_path / "servo.fmu").exists()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The FMUs that the tests share, written once."""
    folder = tmp_path_factory.mktemp("exported")
    parts: dict[str, Any] = {
        "servo": plain(),
        "learner": learning(),
        "mass": MASS,
        "loop": (MASS, learning()),
    }
    for name, part in parts.items():
        alone, has_plant = name == "mass", name in ("mass", "loop")
        fmu(part, folder / f"{name}.fmu", dt=DT if alone else None, x0=X0 if has_plant else None)
    return {name: folder / f"{name}.fmu" for name in parts}


@pytest.fixture
def made(files: dict[str, Path], tmp_path: Path) -> Iterator[Maker]:
    """Make instances; they are freed at the end."""
    instances: list[Driven] = []

    def make(name: str) -> Driven:
        path = files.get(name) or tmp_path / f"{name}.fmu"
        instances.append(Driven(path, tmp_path / f"{name}-{len(instances)}"))
        return instances[-1]

    yield make
    for each in instances:
        each.free()


def inputs(law: Any) -> Iterator[dict[str, float]]:
    """Return r, its derivatives, w and noise of the scenario, sample by sample."""
    sampled = SampledScenario.of(SCENARIO, MASS, law, None)
    segment = sampled.segment(0, sampled.samples)
    for k in range(sampled.samples):
        values = {"r": segment.r[k, 0], "noise": segment.noise[k, 0]}
        values |= {f"r_derivative[{i + 1}]": d for i, d in enumerate(segment.derivatives[k])}
        yield values | {f"w[{i + 1}]": w for i, w in enumerate(segment.w[k])}


@pytest.mark.trial
@pytest.mark.parametrize("name", ["servo", "learner", "mass", "loop"])
def test_fmpy_finds_no_fault(name: str, files: dict[str, Path]) -> None:
    """In the two descriptions: schema, names, structure, start values and units."""
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(files[name])) == []


OLDER = {"servo": plain, "loop": lambda: (MASS, learning())}


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The FMUs of FMI 2.0 that the tests share."""
    folder = tmp_path_factory.mktemp("older")
    for name, part in OLDER.items():
        x0 = X0 if name == "loop" else None
        fmu(part(), folder / f"{name}.fmu", x0=x0, version="2.0")
    return {name: folder / f"{name}.fmu" for name in OLDER}


@pytest.mark.trial
@pytest.mark.parametrize("name", OLDER)
def test_fmi_2_has_the_bits_of_fmi_3(
    name: str, files: dict[str, Path], older: dict[str, Path], tmp_path: Path
) -> None:
    """FMPy finds no fault in it; outputs, estimates and status of 200 samples are equal, through a state that is kept as bytes."""
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(older[name])) == []
    new, old = Driven(files[name], tmp_path / "new"), DrivenOlder(older[name], tmp_path / "old")
    assert new.references == old.references
    both = [each.begin(r=0.5) for each in (new, old)]
    outputs = [each.name for each in new.description.modelVariables if each.causality == "output"]
    assert {"u", "status", "f_hat"} <= {*outputs}

    def sampled(k: int) -> dict[str, float]:
        values = {"r": np.sin(0.03 * k)}
        values |= {"y": np.sin(0.03 * k - 0.2)} if name == "servo" else {"w[1]": 0.3, "noise": 1e-3}
        return values | ({"u_max": 2.0} if k == 60 else {})

    for k in range(100):
        for each in both:
            each.advance(DT, sampled(k))
        assert [new.get(one) for one in outputs] == [old.get(one) for one in outputs]
    state = old.fmu.getFMUState()
    kept = old.fmu.serializeFMUState(state)
    later = []
    for again in range(2):
        if again:
            old.fmu.setFMUState(old.fmu.deSerializeFMUstate(kept))
            old.time = 100 * DT
        for k in range(100, 200):
            old.advance(DT, sampled(k))
        later.append([old.get(one) for one in outputs])
    assert later[0] == later[1]
    old.fmu.freeFMUState(state)
    for each in both:
        each.free()


@pytest.mark.trial
def test_fmi_2_refuses_what_it_does_not_have(older: dict[str, Path], tmp_path: Path) -> None:
    """A parameter that is fixed, a step from elsewhere, model exchange; another version is a ValueError."""
    running = DrivenOlder(older["loop"], tmp_path / "loop").begin()
    for wrong in (
        lambda: running.set({"x0[1]": 1.0}),
        lambda: running.fmu.doStep(5.0, DT),
        lambda: running.fmu.getString([0]),
    ):
        with pytest.raises(Exception, match="fmi2Error|status 3"):
            wrong()
    running.free()
    with pytest.raises(ValueError, match="version = '1.0': must be one of 3.0, 2.0"):
        fmu(plain(), tmp_path / "servo.fmu", version="1.0")


def test_the_version_is_an_option_of_the_command(
    tmp_path: Path, quell: Callable[..., Shown]
) -> None:
    """Of an FMU alone."""
    setup = tmp_path / "loop.toml"
    setup.write_text(
        "dt = 0.01\nobserver = { kind = 'model-free', order = 2, b0 = 1.0, omega_o = 20.0 }\n"
        "controller = { kind = 'adrc', omega_c = 3.0 }\n"
    )
    path = tmp_path / "loop.fmu"
    assert quell("export", str(setup), "--to", "fmu", "--fmi", "2.0", "--out", str(path)).code == 0
    with zipfile.ZipFile(path) as archive:
        assert b'fmiVersion="2.0"' in archive.read("modelDescription.xml")
    wrong = quell("export", str(setup), "--fmi", "2.0", "--out", str(tmp_path / "c"))
    assert wrong.code == 2
    assert "is for --to fmu" in wrong.err


@pytest.mark.trial
def test_a_plant_of_fmi_2_is_a_plant_again(tmp_path: Path) -> None:
    """Imported, it is simulated as the plant itself."""
    fmu(MASS, tmp_path / "mass.fmu", dt=DT, version="2.0")
    again = ql.plants.FMU(tmp_path / "mass.fmu", w=["w[1]", "w[2]"])
    scenario = ql.Scenario(1.0, 0.5, disturbances=(0.1, 0.2))
    runs = [ql.simulate(plant, plain(), scenario, interpret=True) for plant in (MASS, again)]
    np.testing.assert_array_equal(runs[0]["u"], runs[1]["u"])


@pytest.mark.trial
def test_a_controller_with_a_plant_and_a_loop_are_the_simulation(made: Maker) -> None:
    """Called in turn, controller first, both FMUs give y, u and the estimates of ``simulate``; so does the loop."""
    law = learning()
    run = ql.simulate(MASS, law, SCENARIO)
    controller, plant, loop = made("learner").begin(), made("mass").begin(), made("loop").begin()
    shown = ("u", "y", "f_hat", "f_learned", "x_hat[2]", "authority", "theta[1]", "status")
    found: dict[str, list[float]] = {f"{who} {what}": [] for who in "cl" for what in shown}
    for values in inputs(law):
        y = plant.get("y")
        found["c y"].append(y)
        found["l y"].append(loop.get("y"))
        w = {key: value for key, value in values.items() if key[0] == "w"}
        noise = values["noise"]
        u = controller.step(
            DT, y=y + noise, **{key: value for key, value in values.items() if key[0] == "r"}
        )
        plant.step(DT, u=u, **w)
        loop.step(DT, **values)
        for what in shown:
            if what != "y":
                found[f"c {what}"].append(controller.get(what))
                found[f"l {what}"].append(loop.get(what))
    wanted = {what: run[what] for what in ("u", "y", "f_learned", "authority", "status")}
    wanted["f_hat"] = run["f_learned"] + run["f_residual"]
    wanted |= {"x_hat[2]": run["x_hat"][:, 1], "theta[1]": run["theta"][:, 0]}
    assert np.ptp(run["f_learned"]) > 0.0
    assert np.any(run["status"])
    for (who, what), values in ((key.split(" "), np.array(v)) for key, v in found.items()):
        np.testing.assert_allclose(values, wanted[what], rtol=0, atol=1e-9, err_msg=f"{who} {what}")


def test_an_exported_plant_can_be_imported(files: dict[str, Path]) -> None:
    """``ql.plants.FMU`` of the FMU is the plant."""
    plant = ql.plants.FMU(files["mass"], w=["w[1]", "w[2]"], states=["x[2]"])
    run = ql.simulate(plant, plain(), ql.Scenario(1.0, 2.0, disturbances=(0.5, 1.0)))
    scenario = ql.Scenario(1.0, 2.0, disturbances=(0.5, 1.0), x0=X0)
    wanted = ql.simulate(MASS, plain(), scenario)
    for channel in ("y", "u"):
        np.testing.assert_allclose(run[channel], wanted[channel], rtol=0, atol=1e-9)
    with pytest.warns(
        ql.DesignWarning, match="is no multiple of the FMU's internal step of 0.01 s"
    ):
        ql.simulate(plant, quick(), ql.Scenario(1.0, 0.02))


def quick() -> ql.ADRC:
    """A controller of a shorter sample time."""
    return ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.005), omega_c=3.0)


def test_the_initial_state_is_a_parameter(made: Maker) -> None:
    """It acts at the initialisation, and y follows it."""
    plant = made("mass")
    assert plant.begin(**{"x0[1]": 2.0, "x0[2]": 1.0}).get("y") == 2.0
    assert plant.step(DT, u=0.0) == pytest.approx(2.0 + DT)
    with pytest.raises(Exception, match="fmi3SetFloat64 failed"):
        plant.set({"x0[1]": 0.0})
    assert plant.messages == ["fmi3SetFloat64: this variable can't be set now"]


@pytest.mark.parametrize("name", ["servo", "learner"])
def test_limits_and_bandwidths_change_while_the_fmu_runs(name: str, made: Maker) -> None:
    """As ``set_limits`` and ``retune`` do in Python, without a bump; omega_o only without a learner."""
    law: Any = plain() if name == "servo" else learning()
    running = made(name).begin()
    assert ("omega_o" in running.references) == (name == "servo")
    fixed = "omega_o = 20 rad/s, fixed" in running.description.description
    assert fixed == (name == "learner")
    for k in range(300):
        if k == 60:
            law.set_limits(u_max=1.5)
            running.set({"u_max": 1.5})
        if k == 120:
            law.retune(omega_c=5.0)
            running.set({"omega_c": 5.0})
        if k == 180 and name == "servo":
            faster = ql.ESO.model_free(order=2, b0=1.0, omega_o=35.0, dt=DT)
            law.retune(observer=faster)
            running.set({"omega_o": 35.0})
        r, y = math.sin(0.05 * k), 0.8 * math.sin(0.05 * k - 0.3) + 0.01 * math.sin(7.0 * k)
        assert running.step(DT, r=r, y=y) == pytest.approx(law.step(r, y), abs=1e-9)


@pytest.mark.trial
def test_a_held_plant_is_a_boolean_input(made: Maker, tmp_path: Path) -> None:
    """As ``set_held`` in Python, behind a prefilter and under a compensator, too; a PID has none."""
    pid = ql.baselines.PID(kp=4.0, ki=2.0, kd=1.0, tf=0.05, dt=DT, u_min=-4.0, u_max=4.0)
    laws: dict[str, Any] = {
        "servo": plain(),
        "behind": ql.controllers.Prefiltered(plain(), ql.controllers.ReferenceModel(4.0)),
        "on_a_pid": ql.Compensated(pid, ql.Compensator(plain().observer)),
    }
    for name, law in laws.items():
        if name != "servo":
            fmu(law, tmp_path / f"{name}.fmu")
        running = made(name).begin()
        assert running.get("held") == 0.0
        for k in range(200):
            held = 40 <= k < 120
            law.set_held(held)
            r, y = 1.0, 0.2 * math.sin(0.05 * k)
            assert running.step(DT, r=r, y=y, held=held) == pytest.approx(law.step(r, y), abs=1e-9)
            assert bool(int(running.get("status")) & ql.Status.HELD) == held
        assert running.get("held") == 0.0
        with pytest.raises(Exception, match="fmi3GetBoolean failed"):
            running.fmu.getBoolean([running.references["u"]])
    fmu(pid, tmp_path / "pid.fmu", binary=False)
    with zipfile.ZipFile(tmp_path / "pid.fmu") as archive:
        assert b"<Boolean" not in archive.read("modelDescription.xml")


def several_signals() -> dict[str, Any]:
    """Return axes with feedforward, a learner and a guard, and state feedback."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=30.0, dt=DT)
    axes = {
        "shoulder": ql.ADRC(observer, 5.0, feedforward=True),
        "elbow": ql.ADRC(observer, 5.0, learner=ql.learners.RLS(), guard=ql.Guard()),
    }
    return {
        "axes": ql.Axes(axes, [[1.0, 0.3], [0.2, 1.0]], u_min=-4.0, u_max=4.0),
        "feedback": copy.deepcopy(SEVERAL["StateFeedback"]),
    }


@pytest.mark.trial
@pytest.mark.parametrize("name", ["axes", "feedback"])
def test_several_signals_have_a_variable_each(name: str, made: Maker, tmp_path: Path) -> None:
    """U, estimates and flags are the bits of the kernels, also with a missing y and other limits."""
    law, random = several_signals()[name], np.random.default_rng(1)
    fmu(law, tmp_path / f"{name}.fmu")
    running, (n, m) = made(name).begin(), (law.outputs, law.inputs)
    signals = [f".{each}" for each in law.names] or [f"[{i + 1}]" for i in range(n)]
    u = np.zeros(m)
    for k in range(120):
        r, y = np.sin(0.1 * k + np.arange(n)), 0.3 * random.standard_normal(n)
        y[k % n] = np.nan if k % 7 == 3 else y[k % n]
        given = {f"r{each}": r[i] for i, each in enumerate(signals)}
        given |= {f"y{each}": y[i] for i, each in enumerate(signals)}
        if k == 60:
            law.set_limits(u_max=0.5)
            given |= {f"u_max[{i + 1}]": 0.5 for i in range(m)}
        with np.errstate(all="ignore"), as_python():
            if name == "axes":
                given["r_derivative.shoulder[1]"] = 0.5 * r[0]
                half = np.array([0.5 * r[0], 0.0])
                set_reference_derivatives(law.parameters, law._state, half)
            control_all(law.parameters, law._state, r, y, u)
        running.advance(DT, given)
        assert [running.get(f"u[{i + 1}]") for i in range(m)] == u.tolist()
        assert running.get("status") == int(law.status)
    if name == "axes":
        assert running.get("elbow.x_hat[2]") == law.estimates["elbow"].x[1]
        assert running.get("elbow.f_hat") == law.estimates["elbow"].f
        assert running.get("v[2]") == law._state.v[1]
    else:
        assert running.get("d_hat[1]") == law.estimate[1][0]


@pytest.mark.trial
def test_compensators_take_u_0_of_each_actuator(made: Maker, tmp_path: Path) -> None:
    """With three actuators for two axes; u has the bits of the kernels."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=30.0, dt=DT)
    pair = {"x": ql.Compensator(observer), "y": ql.Compensator(observer)}
    law = ql.Axes(pair, [[1.0, 0.4, 0.5], [0.2, 2.0, 0.3]], u_min=-4.0, u_max=4.0)
    fmu(law, tmp_path / "adding.fmu")
    running, random, u = made("adding").begin(), np.random.default_rng(2), np.zeros(3)
    for k in range(60):
        u_0, y = np.sin(0.1 * k + np.arange(3)), 0.01 * random.standard_normal(2)
        given = {f"u_0[{i + 1}]": u_0[i] for i in range(3)} | {"y.x": y[0], "y.y": y[1]}
        with np.errstate(all="ignore"), as_python():
            control_all(law.parameters, law._state, u_0, y, u)
        running.advance(DT, given)
        assert [running.get(f"u[{i + 1}]") for i in range(3)] == u.tolist()
    with zipfile.ZipFile(tmp_path / "adding.fmu") as archive:
        text = archive.read("modelDescription.xml").decode()
    assert re.findall(r'name="(u_0\[\d\]|r\b[^"]*|held[^"]*)"', text) == [
        *(f"u_0[{i}]" for i in (1, 2, 3)), "held.x", "held.y",
    ]  # fmt: skip
    assert text.count('description="control signal of another controller"') == 3


@pytest.mark.trial
@pytest.mark.parametrize("name", ["axes", "feedback"])
def test_fmpy_finds_no_fault_in_several_signals(name: str, tmp_path: Path) -> None:
    """Names, structure and start values."""
    from fmpy.validation import validate_fmu

    fmu(several_signals()[name], tmp_path / "several.fmu")
    assert validate_fmu(str(tmp_path / "several.fmu")) == []


def test_axes_whose_variables_have_one_name_in_c_are_named(tmp_path: Path) -> None:
    """Nothing is written."""
    axis = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=30.0, dt=DT), 5.0)
    with pytest.raises(TranslationError, match=r"r\.x_hat_1 and r\.x_hat\[1\]: these variables"):
        fmu(ql.Axes({"r": axis, "x_hat_1": axis}), tmp_path / "axes.fmu")
    assert not any(tmp_path.iterdir())


def test_several_signals_with_a_plant_are_refused(tmp_path: Path) -> None:
    """The message says what to do."""
    with pytest.raises(TranslationError, match="2 axes: an FMU with a plant is of one u and one y"):
        fmu((MASS, several_signals()["axes"]), tmp_path / "loop.fmu")


def test_parameters_are_checked_when_they_act(made: Maker) -> None:
    """They are set one by one, so that a wrong pair is named at the next step; then the old ones still act."""
    running = made("servo").begin()
    running.set({"u_min": 5.0})
    with pytest.raises(Exception, match="fmi3DoStep failed"):
        running.step(DT, r=1.0, y=0.0)
    running.set({"u_min": -4.0, "omega_c": 0.0})
    with pytest.raises(Exception, match="fmi3DoStep failed"):
        running.step(DT, r=1.0, y=0.0)
    assert running.messages == [
        "fmi3DoStep: u_min must be less than u_max",
        "fmi3DoStep: omega_c must be finite and greater than zero",
    ]
    running.set({"omega_c": 3.0})
    assert running.step(DT, r=1.0, y=0.0) == plain().step(1.0, 0.0)


@cases(
    ("observer", "others"),
    [
        (lambda omega: ql.ESO.model_free(5, 2.0, omega, 0.001), (5.0, 80.0)),
        (lambda omega: ql.ESO.model_free(3, 2.0, omega, 0.01, form="predictor"), (5.0, 80.0)),
        (lambda omega: ql.ESO.model_based(ql.plants.two_mass_spring(), omega, 1e-3), (5.0, 40.0)),
        (lambda omega: ql.ESO.model_based(([1.0, 3.0], [1.0, 2.0, 5.0]), omega, 1e-3), (5.0, 40.0)),
        (lambda omega: ql.ESO.model_free(2, 2.0, omega, 0.01, disturbance_order=3), (5.0, 40.0)),
        (
            lambda omega: ql.ESO.model_based(
                ([1.0, 3.0], [1.0, 2.0, 5.0]), omega, 1e-3, disturbance_order=2
            ),
            (5.0, 40.0),
        ),
    ],
)
def test_the_observer_gain_is_a_polynomial(
    observer: Callable[[float], ql.ESO], others: tuple[float, float]
) -> None:
    """Its coefficients at one bandwidth give the designed gains at others."""
    coefficients = gain_coefficients(observer(20.0))
    assert coefficients is not None
    for omega_o in (20.0, *others):
        designed = observer(omega_o)
        omega = -math.expm1(-omega_o * designed.dt)
        gain = coefficients @ omega ** np.arange(coefficients.shape[1])
        np.testing.assert_allclose(gain, designed.model.gain, rtol=1e-10)


def test_bandwidths_without_a_closed_form_are_fixed() -> None:
    """Those of a nonlinear law, of observers with other poles, half gain or a delay, and with a learner."""

    def offered(law: Any) -> tuple[bool, bool]:
        found = bandwidths(law)
        assert found is not None
        return found.weights is not None, found.coefficients is not None

    def around(**options: Any) -> ql.ADRC:
        return ql.ADRC(ql.ESO.model_free(2, 1.0, 20.0, DT, **options), omega_c=3.0)

    assert offered(plain()) == (True, True)
    assert offered(plain(half_gain=True, law_poles=[(-1, 1), (-1, -1)][:1])) == (True, True)
    assert offered(learning()) == (True, False)
    for options in (
        {"form": "reduced"},
        {"half_gain": True},
        {"delay": DT},
        {"poles": [-1, -1, -2]},
    ):
        assert offered(around(**options)) == (True, False)
    feedback = plain(feedback=ql.controllers.NonlinearFeedback([0.5, 1.0], 0.1))
    assert offered(feedback)[0] is False
    assert bandwidths(ql.controllers.baselines.PID(kp=1.0, dt=DT)) is None


def test_a_saved_state_continues_in_any_instance(made: Maker) -> None:
    """Saved, set, and serialised to another instance; two instances do not disturb each other."""
    one, other = made("learner").begin(), made("learner").begin()

    def run(instance: Driven) -> list[float]:
        return [instance.step(DT, r=1.0, y=0.01 * k) for k in range(30)]

    run(one)
    state = one.fmu.getFMUState()
    saved = one.fmu.serializeFMUState(state)
    time = one.time
    wanted = run(one)
    run(other)
    one.fmu.setFMUState(state)
    one.time = time
    assert run(one) == wanted
    one.fmu.freeFMUState(state)
    restored = other.fmu.deserializeFMUState(saved)
    other.fmu.setFMUState(restored)
    other.time = time
    assert run(other) == wanted
    other.fmu.freeFMUState(restored)
    for wrong in (saved[:-1], b"x" * len(saved)):
        with pytest.raises(Exception, match="fmi3DeserializeFMUState failed"):
            other.fmu.deserializeFMUState(wrong)


def test_a_reset_instance_is_a_new_one(made: Maker) -> None:
    """Parameters, state and time are those of the start."""
    one = made("servo").begin(omega_c=5.0)
    first = [one.step(DT, r=0.3, y=0.2) for _ in range(5)]
    one.fmu.reset()
    one.time = 0.0
    one.begin(omega_c=5.0)
    assert [one.step(DT, r=0.3, y=0.2) for _ in range(5)] == first
    one.fmu.reset()
    one.time = 0.0
    assert one.begin().step(DT, r=0.3, y=0.2) != first[0]


def test_communication_steps_have_any_length(made: Maker) -> None:
    """A long one takes several samples with held inputs; in short ones outputs are held until the next sample."""
    one, law = made("servo").begin(), plain()
    three = [law.step(1.0, 0.2) for _ in range(3)]
    assert one.step(3 * DT, r=1.0, y=0.2) == three[-1]
    fourth, fifth = law.step(2.0, 0.3), law.step(4.0, 0.1)
    assert [one.step(DT / 4, r=2.0 if k == 0 else 4.0, y=0.3) for k in range(4)] == [fourth] * 4
    assert one.step(DT / 4, r=4.0, y=0.1) == fifth
    for time, length in ((0.5, DT), (one.time, 0.0), (one.time, math.nan), (math.nan, DT)):
        with pytest.raises(Exception, match="fmi3DoStep failed"):
            one.fmu.doStep(time, length)


def test_what_an_fmu_cannot_do_is_refused_with_a_reason(made: Maker) -> None:
    """Model exchange, events, derivatives, unknown variables, calls in the wrong state, another token."""
    one = made("servo")
    fmi = one.fmu
    for call in (
        lambda: fmi.doStep(0.0, DT),
        fmi.enterEventMode,
        lambda: fmi.fmi3EnterConfigurationMode(fmi.component),
        fmi.updateDiscreteStates,
        lambda: fmi.getDirectionalDerivative([5], [1], [1.0]),
        lambda: fmi.getFloat64([999]),
        lambda: fmi.getInt32([1]),
        lambda: fmi.setFloat64([one.references["u"]], [1.0]),
        lambda: fmi.setBoolean([1], [True]),
        fmi.exitInitializationMode,
    ):
        before = len(one.messages)
        with pytest.raises(Exception, match="status 3 .error."):
            call()
        assert len(one.messages) == before + 1
    fmi.getBoolean([])
    from fmpy import fmi3

    locks = fmi3.fmi3LockPreemptionCallback(), fmi3.fmi3UnlockPreemptionCallback()
    for make, more in (
        (fmi.fmi3InstantiateModelExchange, ()),
        (fmi.fmi3InstantiateScheduledExecution, (fmi3.fmi3ClockUpdateCallback(), *locks)),
    ):
        assert make(b"", b"", b"", False, False, None, fmi.logMessage, *more) is None
        assert one.messages[-1].endswith("is for co-simulation only")
    fmi.guid = "{another}"
    with pytest.raises(Exception, match="Failed to instantiate"):
        one.instantiate()
    fmi.guid = one.description.guid
    one.instantiate()


@cases(
    "plant",
    [
        ql.plants.arm(),
        ql.plants.encoded_outputs(ql.plants.arm(), 1e-6),
        ql.plants.delayed_inputs(ql.plants.arm(), 2 * DT, DT),
        ql.plants.LinearPlant(-np.eye(2), np.eye(2), np.eye(2)),
    ],
)
def test_a_plant_with_several_signals_is_refused_with_a_reason(plant: Any, tmp_path: Path) -> None:
    """Alone, and behind its encoders and delays; no file is left."""
    with pytest.raises(
        ql.export.TranslationError, match="is of one u and one y, and this one has 2"
    ):
        ql.export.fmu(plant, tmp_path / "plant.fmu", dt=DT)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["servo", "learner", "mass", "loop", "of FMI 2.0"])
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_the_sources_compile_without_a_warning(
    compiler: str, name: str, files: dict[str, Path], older: dict[str, Path], tmp_path: Path
) -> None:
    """Those that the FMU contains, with the strictest options; in FMI 2.0 fmi3.c is a part of fmi2.c."""
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is missing")
    with zipfile.ZipFile(older["servo"] if name == "of FMI 2.0" else files[name]) as archive:
        archive.extractall(tmp_path)
    units = sorted(each.name for each in (tmp_path / "sources").glob("*.c"))
    if name == "of FMI 2.0":
        units.remove("fmi3.c")
    subprocess.run(
        [compiler, *STRICT, "-fsyntax-only", *units], cwd=tmp_path / "sources", check=True
    )


def test_an_fmu_in_single_precision_is_the_controller_in_single_precision(
    tmp_path: Path, made: Maker
) -> None:
    """Its variables are double, its numbers float."""
    law = in_single_precision(plain())
    fmu(law, tmp_path / "small.fmu")
    running = made("small").begin()
    assert "omega_c" not in running.references
    run = ql.simulate(MASS, law, ql.Scenario(1.0, 0.5))
    found = [running.step(DT, r=1.0, y=y) for y in run["y"]]
    np.testing.assert_allclose(found, run["u"], rtol=1e-6, atol=1e-6)


@pytest.mark.trial
def test_the_same_parts_give_the_same_file(files: dict[str, Path], tmp_path: Path) -> None:
    """Bit for bit, so that a build can be repeated."""
    fmu(plain(), tmp_path / "servo.fmu")
    assert (tmp_path / "servo.fmu").read_bytes() == files["servo"].read_bytes()


def test_an_fmu_without_binary_has_its_sources(tmp_path: Path) -> None:
    """The import says how to compile them."""
    fmu(MASS, tmp_path / "bare.fmu", dt=DT, binary=False)
    with pytest.raises(ValueError, match=r"has no binaries, .* `fmpy compile`"):
        ql.plants.FMU(tmp_path / "bare.fmu", w=["w[1]"])


def pendulum(t: float, x: Any, u: float, w: Any) -> tuple[float, float]:
    """Return the derivatives of a pendulum."""
    return x[1], u + w[0] * math.cos(t) - 9.81 * math.sin(x[0])


@pytest.mark.trial
def test_a_plant_of_the_user_is_translated_and_integrated(tmp_path: Path, made: Maker) -> None:
    """With the sub-steps of ``simulate``; the time of the FMU is that of f."""
    plant = ql.plants.NonlinearPlant(pendulum, order=2, substeps=3)
    fmu(plant, tmp_path / "swing.fmu", dt=DT, x0=[0.5, 0.0])
    running = made("swing").begin()
    scenario = ql.Scenario(0.0, 0.5, disturbances=[0.3], x0=[0.5, 0.0])
    run = ql.simulate(plant, plain(), scenario)
    found = [running.get("y"), *(running.step(DT, u=u, **{"w[1]": 0.3}) for u in run["u"][:-1])]
    np.testing.assert_allclose(found, run["y"], rtol=0, atol=1e-9)


@pytest.mark.trial
def test_functions_in_c_come_along(tmp_path: Path, made: Maker) -> None:
    """A feature that the user has in C: without its file it is missing, with it the FMU is that of Python."""

    def product(x: Any, u: float) -> tuple[float]:
        return (x[0] * x[1],)

    feature = ql.features.Custom(product, ["x v"], c_function="product")
    law = plain(learner=ql.learners.RLS(features=feature))

    source = tmp_path / "product.c"
    source.write_text(
        "void product(const double *x, double u, double *out);\n"
        "void product(const double *x, double u, double *out) {\n"
        "    (void)u;\n    out[0] = x[0] * x[1];\n}\n"
    )
    with pytest.raises(ValueError, match="undefined reference to `product'"):
        fmu(law, tmp_path / "own.fmu")
    fmu(law, tmp_path / "own.fmu", sources=[source])
    running = made("own").begin()
    for k in range(50):
        r, y = 1.0, 0.01 * k
        assert running.step(DT, r=r, y=y) == pytest.approx(law.step(r, y), abs=1e-9)
    for wrong in (tmp_path / "product.o", tmp_path / "model.c", tmp_path / "none.c"):
        with pytest.raises((ValueError, FileNotFoundError), match=wrong.name):
            fmu(law, tmp_path / "other.fmu", sources=[wrong])
    with pytest.raises(ValueError, match=r"sources: '': must be a file \*.c or \*.h"):
        fmu(law, tmp_path / "other.fmu", sources=[""])
    with pytest.raises(ValueError, match=r"sources = \[3\]: must be a sequence of files"):
        fmu(law, tmp_path / "other.fmu", sources=[3])  # type: ignore[list-item]


@cases(
    ("part", "file", "options", "words"),
    [
        (plain, "servo.zip", {}, "must end in .fmu"),
        (plain, "1st.fmu", {}, "name = '1st': must be a C identifier"),
        (plain, "while.fmu", {}, "name = 'while': is a keyword of C or C++"),
        (plain, "model.fmu", {}, "name = 'model': is a file that each FMU has"),
        (plain, "none/servo.fmu", {}, "the folder .* must exist"),
        (plain, "servo.fmu", {"dt": 0.5}, "dt = 0.5 s: must be the controller's, 0.01 s"),
        (plain, "servo.fmu", {"x0": [0.0]}, "x0 is given: is the state of a plant"),
        (lambda: MASS, "mass.fmu", {}, "dt = None: must be a number"),
        (lambda: MASS, "mass.fmu", {"dt": DT, "x0": [1.0]}, "x0 has shape"),
        (lambda: "mass", "mass.fmu", {"dt": DT}, "part = 'mass': must be a plant"),
        (lambda: None, "mass.fmu", {"dt": DT}, "part = None: must be a plant"),
        (plain, "servo.fmu", {"overwrite": 3}, "overwrite = 3: must be True or False"),
    ],
)
def test_bad_arguments_leave_no_file(
    part: Callable[[], Any], file: str, options: dict[str, Any], words: str, tmp_path: Path
) -> None:
    """One clear error, and nothing written."""
    with pytest.raises(ValueError, match=words):
        fmu(part(), tmp_path / file, **options)
    assert not [*tmp_path.iterdir()]


def test_what_c_cannot_compute_is_refused(files: dict[str, Path], tmp_path: Path) -> None:
    """A plant that is itself an FMU."""
    own = ql.plants.FMU(files["mass"], w=["w[1]"])
    for plant in (own, ql.plants.delayed(own, DT, DT)):
        with pytest.raises(
            TranslationError, match="it calls an FMU at each sample, which C can not"
        ):
            fmu(plant, tmp_path / "mass.fmu", dt=DT)
    assert not [*tmp_path.iterdir()]


def test_existing_files_and_missing_compilers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files are replaced only where that is asked for; without a compiler there is an FMU of sources."""
    path = tmp_path / "mass.fmu"
    path.write_text("mine")
    with pytest.raises(ValueError, match="the file exists"):
        fmu(MASS, path, dt=DT)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ValueError, match="no C compiler was found"):
        fmu(MASS, path, dt=DT, overwrite=True)
    assert path.read_text() == "mine"
    fmu(MASS, path, dt=DT, overwrite=True, binary=False)
    assert zipfile.is_zipfile(path)
    assert [*tmp_path.iterdir()] == [path]
