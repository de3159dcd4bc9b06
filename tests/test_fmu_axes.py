"""FMUs of several signals as plants of ``Axes``: an arm in C is the arm of quell."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell import setup
from quell.realtime.devices import TwinDevice

from . import fmus
from .in_c import needs_gcc

pytest.importorskip("fmpy", reason="FMPy, which reads and calls FMUs, is missing")
pytestmark = [needs_gcc, pytest.mark.usefixtures("no_fmu_left")]

VERSIONS = (2, 3)
DT = 1e-3
SIGNALS: dict[str, Any] = {"u": ["tau[1]", "tau[2]"], "w": ["push[1]", "push[2]"]}
SCENARIO = ql.Scenario(
    (ql.signals.Sinusoid(0.5, 2.0), ql.signals.Sinusoid(0.8, 3.0)),
    0.3,
    disturbances=(ql.signals.Step(0.5, at=0.1), ql.signals.Sinusoid(0.2, 9.0)),
    rest_at=(0.2,),
)
ARM = ql.plants.arm()


def joint() -> ql.ADRC:
    """Return the controller of a joint."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=DT)
    return ql.ADRC(observer, omega_c=8.0)


def axes(count: int = 2, **options: Any) -> ql.Axes:
    """Return the controller of the arm, or of other joints."""
    M = {"M": ARM.inertia} if count == 2 else {}
    return ql.Axes([joint() for _ in range(count)], u_min=-40.0, u_max=40.0, **M, **options)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """An FMU of the arm of each version."""
    folder = tmp_path_factory.mktemp("fmus")
    return {n: fmus.packed(folder / f"arm{n}.fmu", fmus.contents(n, "arm")) for n in VERSIONS}


@pytest.mark.trial
@pytest.mark.parametrize("version", VERSIONS)
def test_an_fmu_of_an_arm_runs_as_the_arm(version: int, files: dict[int, Path]) -> None:
    """Both take a step of Runge-Kutta in a sample, so only rounding differs; each torque and each push has its joint."""
    plant = ql.plants.FMU(files[version], **SIGNALS, states=["v[1]", "v[2]"])
    assert (plant.inputs, plant.outputs, plant.disturbances, plant.order) == (2, 2, 2, 4)
    run, wanted = (ql.simulate(each, axes(), SCENARIO) for each in (plant, ARM))
    assert np.ptp(wanted["y"], axis=0).min() > 0.01
    for channel in ("y", "u", "x", "w"):
        np.testing.assert_allclose(run[channel], wanted[channel], rtol=0, atol=1e-11)
    run.axis("axis2")


@pytest.mark.trial
def test_the_arm_is_met_to_the_tolerance_of_the_integrator(files: dict[int, Path]) -> None:
    """With other steps of Runge-Kutta they differ by its error, 16 times less for half of the step."""
    found = []
    fine = ql.simulate(ql.plants.arm(substeps=8), axes(), SCENARIO)["y"]
    for substeps in (1, 2):
        plant = ql.plants.FMU(files[3], **SIGNALS, substeps=substeps)
        found.append(np.max(np.abs(ql.simulate(plant, axes(), SCENARIO)["y"] - fine)))
    assert 1e-13 < found[0] < 1e-7
    assert found[1] < found[0] / 8.0


@pytest.mark.trial
@pytest.mark.compiled
def test_a_compiled_loop_calls_an_fmu_of_several_signals_as_python_does(
    files: dict[int, Path],
) -> None:
    """Both loops call the same instances, also behind encoders and delays; only their rounding differs."""
    plant: Any = ql.plants.FMU(files[3], **SIGNALS)
    plant = ql.plants.delayed_inputs(ql.plants.encoded_outputs(plant, 1e-4), [0.0, DT], DT)
    runs = [ql.simulate(plant, axes(), SCENARIO, interpret=way) for way in (False, True)]
    np.testing.assert_allclose(runs[0]["u"], runs[1]["u"], rtol=0, atol=1e-9)


@pytest.mark.trial
def test_encoders_and_delays_stand_at_single_channels(files: dict[int, Path]) -> None:
    """As at the arm itself: the second torque comes two samples late, the first angle is rounded."""

    def wrapped(plant: Any) -> Any:
        read = ql.plants.encoded_outputs(plant, [1e-3, 0.0])
        return ql.plants.delayed_inputs(read, [0.0, 2.0 * DT], DT)

    plant = ql.plants.FMU(files[2], **SIGNALS)
    run, wanted = (ql.simulate(wrapped(each), axes(), SCENARIO) for each in (plant, ARM))
    np.testing.assert_allclose(run["y"], wanted["y"], rtol=0, atol=1e-9)
    assert np.all(np.abs(run["y"][:, 0] / 1e-3 - np.round(run["y"][:, 0] / 1e-3)) < 1e-9)
    assert np.ptp(run["y"][:, 1]) > 0.01


def test_all_inputs_and_outputs_are_taken_by_default(files: dict[int, Path]) -> None:
    """In the order of the FMU; what w names is no control signal. A start value doubles the torques."""
    plant = ql.plants.FMU(files[3], w=SIGNALS["w"], start={"gain": 2.0})
    assert plant.channel_names == (("tau[1]", "tau[2]"), ("q[1]", "q[2]"), ("push[1]", "push[2]"))
    assert ql.plants.FMU(files[3]).inputs == 4
    half = ql.plants.FMU(files[3], **SIGNALS)
    swapped = ql.plants.FMU(files[3], u=["tau[2]", "tau[1]"], y=["q[2]", "q[1]"])
    devices = [TwinDevice(each, DT) for each in (plant, half, swapped)]
    for device, u in zip(devices, ([3.0, 1.0], [6.0, 2.0], [2.0, 6.0]), strict=True):
        device.write(u)
    one, two, other = (device.read() for device in devices)
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(one, other[::-1])
    assert one[0] != one[1]


def test_a_setup_of_axes_names_an_fmu_if_it_is_trusted(files: dict[int, Path]) -> None:
    """The keys of the table are the arguments; a twin of such a table has several signals."""
    part = {
        "observer": {"kind": "model-free", "order": 2, "omega_o": 60.0},
        "controller": {"omega_c": 8.0},
        "reference": 0.1,
    }
    table = {"kind": "fmu", "path": str(files[3]), **SIGNALS}
    tables: dict[str, Any] = {
        "dt": DT,
        "plant": table,
        "axes": {"M": [[0.6, 0.09], [0.09, 0.03]]},
        "axis": [{"name": "shoulder", **part}, {"name": "elbow", **part}],
        "scenario": {"duration": 0.05, "disturbances": [0.1]},
    }
    with pytest.raises(setup.SetupError, match=r"plant: path = .*would run this program.*--trust"):
        setup.made("arm.toml", tables)
    loaded = setup.made("arm.toml", tables, trust=True)
    run = ql.simulate(loaded.needed("plant"), loaded.controller, loaded.needed("scenario"))
    wanted = ql.simulate(ARM, loaded.controller, loaded.needed("scenario"))
    np.testing.assert_allclose(run["y"], wanted["y"], rtol=0, atol=1e-11)
    twin = setup.schema.plant_of(table, DT, trust=True, several=True)
    assert (twin.inputs, twin.outputs) == (2, 2)
    tables["axis"].append({"name": "wrist", **part})
    tables["axes"] = {"M": np.eye(3).tolist()}
    words = r"plant = 'arm' has 2 control signals \(tau\[1\], tau\[2\]\) and 2 outputs"
    with pytest.raises(setup.SetupError, match=words):
        setup.made("arm.toml", tables, trust=True)


def test_a_copy_and_a_pickle_unpack_the_file_again(files: dict[int, Path]) -> None:
    """So sweeps in other processes work."""
    plant = ql.plants.FMU(files[3], **SIGNALS, start={"gain": 2.0})
    runs = [
        ql.simulate(each, axes(), ql.Scenario(0.1, 0.05))["y"]
        for each in (plant, copy.copy(plant), pickle.loads(pickle.dumps(plant)))
    ]
    np.testing.assert_array_equal(runs[1], runs[0])
    np.testing.assert_array_equal(runs[2], runs[0])


@pytest.mark.parametrize("version", VERSIONS)
def test_errors_of_an_fmu_of_several_signals_end_the_run(
    version: int, files: dict[int, Path]
) -> None:
    """Time, function, status and the FMU's own words, also behind encoders and delays."""
    plant: Any = ql.plants.FMU(files[version], **SIGNALS, start={"fail_at": 0.0305})
    plant = ql.plants.delayed_inputs(ql.plants.encoded_outputs(plant, 1e-3), DT, DT)
    words = f"in the step at 0.03 s: fmi{version}DoStep returned error: the mass is stuck"
    with pytest.raises(ValueError, match=words):
        ql.simulate(plant, axes(), SCENARIO)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"u": ["tau[1]", "tau[3]"]}, r"u\[1\] = 'tau\[3\]': no variable of it; did you mean tau"),
        ({"u": ["tau[1]", "tau[1]"]}, r"u and w name one variable twice: 'tau\[1\]' and 'tau"),
        ({"u": ["tau[1]"], "w": ["tau[1]"]}, r"u and w name one variable twice: 'tau\[1\]'"),
        ({"y": ["q[1]", "q[1]"]}, r"y names one variable twice: 'q\[1\]' and 'q\[1\]'"),
        ({"u": []}, "u is empty: u must have at least one variable"),
        ({"y": ["q[1]", "speed"]}, r"y\[1\] = 'speed': no variable of it"),
        ({"u": ["q[1]"]}, r"u\[0\] = 'q\[1\]': is output of type (Real|Float64); must be an input"),
        ({"w": ["push[1]", "tau"]}, r"w\[1\] = 'tau': no variable of it"),
        ({"w": ["tau[1]", "tau[2]", "push[1]", "push[2]"]}, "has no input that is a real number b"),
    ],
)
def test_names_that_do_not_fit_are_errors_with_the_variable(
    arguments: dict[str, Any], words: str, files: dict[int, Path]
) -> None:
    """By argument, place, value and rule, when the plant is made."""
    for file in files.values():
        with pytest.raises(ValueError, match=words):
            ql.plants.FMU(file, **arguments)


def test_signals_that_do_not_fit_the_controller_are_named(files: dict[int, Path]) -> None:
    """The FMU's variables, also behind an encoder; one signal only; a state for the start."""
    plant = ql.plants.FMU(files[3], **SIGNALS, y=["q[1]"])
    words = r"and 1 output \(q\[1\]\), the controller 2 and 2: must be a plant with as many"
    with pytest.raises(ValueError, match=words):
        ql.simulate(ql.plants.encoded_outputs(plant, 1e-3), axes(), SCENARIO)
    plant = ql.plants.FMU(files[3], **SIGNALS)
    with pytest.raises(ValueError, match=r"2 control signals \(tau\[1\], tau\[2\]\) and 2 outputs"):
        ql.simulate(plant, axes(3), ql.Scenario(0.0, 0.1))
    with pytest.raises(ValueError, match=r"2 disturbance inputs \(push\[1\], push\[2\]\)"):
        ql.simulate(plant, axes(), ql.Scenario(0.0, 0.1, disturbances=(0.0, 0.0, 1.0)))
    with pytest.raises(ValueError, match=r"x0 = \[1.0, 0.0\]: must be zero for an FMU"):
        ql.simulate(plant, axes(), ql.Scenario(0.0, 0.1, x0=[1.0, 0.0]))
    with pytest.raises(ValueError, match="2 control signals"):
        ql.simulate(plant, joint(), ql.Scenario(0.0, 0.1))
