"""Plants from FMU files, and the FMUs that quell writes."""

from __future__ import annotations

import copy
import pickle
import random
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell import setup
from quell.experiments.compare import compare
from quell.experiments.over_seeds import over_seeds
from quell.files import TooLargeError
from quell.realtime.devices import TwinDevice

from . import fmus
from .cases import cases
from .in_c import needs_gcc
from .mutations import mutated

pytest.importorskip("fmpy", reason="FMPy, which reads and calls FMUs, is missing")
pytestmark = [needs_gcc, pytest.mark.usefixtures("no_fmu_left")]

VERSIONS = (2, 3)
DT = 0.01
LOOP = {"u": "u", "w": ["w"]}
SCENARIO = ql.Scenario(
    ql.signals.Step(at=0.1), 1.0, disturbances=(ql.signals.Sinusoid(),), rest_at=(0.4,)
)
SHORT = ql.Scenario(1.0, 0.1)


def mass() -> ql.plants.LinearPlant:
    """The plant that the FMUs of ``fmu_plant.c`` compute."""
    return ql.plants.LinearPlant([[0, 1], [0, 0]], [0, 1], [1, 0], [[0], [1]])


def controller() -> ql.ADRC:
    """A controller for it."""
    return ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=DT), omega_c=3.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """An FMU of each version."""
    folder = tmp_path_factory.mktemp("fmus")
    return {n: fmus.packed(folder / f"mass{n}.fmu", fmus.contents(n)) for n in VERSIONS}


@pytest.mark.parametrize("version", VERSIONS)
def test_an_fmu_runs_as_the_plant_that_it_computes(version: int, files: dict[int, Path]) -> None:
    """y, u and the recorded states agree, with a start from rest in between: the reset of FMI 3.0 and the saved state of FMI 2.0."""
    plant = ql.plants.FMU(files[version], **LOOP, states=["v"])
    assert (plant.order, plant.disturbances, plant.name) == (2, 1, "mass")
    run, wanted = (ql.simulate(each, controller(), SCENARIO) for each in (plant, mass()))
    for channel in ("y", "u", "x"):
        np.testing.assert_allclose(run[channel], wanted[channel], rtol=0, atol=1e-9)


@pytest.mark.trial
@pytest.mark.compiled
def test_a_compiled_loop_calls_an_fmu_as_python_does(files: dict[int, Path]) -> None:
    """Both loops call the same instances, so only their own rounding differs."""
    plant = ql.plants.FMU(files[3], **LOOP)
    runs = [ql.simulate(plant, controller(), SCENARIO, interpret=way) for way in (False, True)]
    np.testing.assert_allclose(runs[0]["u"], runs[1]["u"], rtol=0, atol=1e-9)


def test_each_run_of_a_batch_has_an_instance_of_its_own(files: dict[int, Path]) -> None:
    """The runs of one plant do not disturb each other."""
    plant, law = ql.plants.FMU(files[2], **LOOP), controller()
    scenarios = [ql.Scenario(size, 0.5) for size in (1.0, 2.0, 3.0)]
    runs = ql.simulate(plant, law, scenarios)
    for i, scenario in enumerate(scenarios):
        np.testing.assert_array_equal(runs["y"][i], ql.simulate(plant, law, scenario)["y"])


@pytest.mark.parametrize("version", VERSIONS)
def test_start_values_and_substeps_reach_the_fmu(version: int, files: dict[int, Path]) -> None:
    """A gain of 2 doubles b0; the counter counts four communication steps in a sample."""
    plant = ql.plants.FMU(
        files[version], **LOOP, states=["count"], start={"gain": 2.0, "fail_with": 2}, substeps=4
    )
    run = ql.simulate(plant, controller(), SHORT)
    double = ql.plants.LinearPlant([[0, 1], [0, 0]], [0, 2], [1, 0], [[0], [1]])
    wanted = ql.simulate(double, controller(), SHORT)
    np.testing.assert_allclose(run["y"], wanted["y"], rtol=0, atol=1e-9)
    assert run["x"][:, 1].tolist() == [4.0 * k for k in range(11)]


def test_wrappers_and_twins_take_fmus(files: dict[int, Path]) -> None:
    """A delay around the FMU is one around the plant, and a twin advances it."""
    late = [ql.plants.delayed(p, DT, DT) for p in (ql.plants.FMU(files[3], **LOOP), mass())]
    run, wanted = (ql.simulate(each, controller(), SCENARIO)["y"] for each in late)
    np.testing.assert_allclose(run, wanted, rtol=0, atol=1e-9)
    twin = TwinDevice(ql.plants.FMU(files[2], **LOOP), DT)
    twin.write(1.0)
    assert twin.read() == pytest.approx(0.5 * DT**2)


@pytest.mark.parametrize("version", VERSIONS)
def test_errors_of_an_fmu_end_the_run_with_its_message(
    version: int, files: dict[int, Path]
) -> None:
    """Time, function, status and the FMU's own words; the wish to end is named as such."""
    name, law = f"mass{version}.fmu: in the step at 0.3 s: ", controller()

    def failing(how: int) -> ql.plants.FMU:
        return ql.plants.FMU(files[version], **LOOP, start={"fail_at": 0.305, "fail_with": how})

    words = f"{name}fmi{version}DoStep returned error: the mass is stuck"
    for plant in (failing(3), ql.plants.encoded(ql.plants.delayed(failing(3), DT, DT), 1000)):
        with pytest.raises(ValueError, match=words):
            ql.simulate(plant, law, SCENARIO)
    with pytest.raises(ValueError, match=f"{name}it asks to end the simulation"):
        ql.simulate(failing(2), law, SCENARIO)
    unfinished = "returned status 6" if version == 2 else "it returned early, at 0.3 s"
    with pytest.raises(ValueError, match=unfinished):
        ql.simulate(failing(6), law, SCENARIO)
    twin = TwinDevice(failing(3), 0.305)
    twin.write(0.0)
    with pytest.raises(ValueError, match="the mass is stuck"):
        twin.write(0.0)


def test_a_setup_file_can_name_an_fmu_if_it_is_trusted(files: dict[int, Path]) -> None:
    """The keys of the table are the arguments; without trust nothing is unpacked or run."""
    tables: dict[str, Any] = {
        "dt": DT,
        "plant": {"kind": "fmu", "path": str(files[3]), "w": ["w"], "start": {"gain": 2.0}},
        "observer": {"kind": "model-free", "order": 2, "b0": 1.0, "omega_o": 20.0},
        "controller": {"omega_c": 3.0},
        "scenario": {"reference": 1.0, "duration": 0.1},
    }
    with pytest.raises(setup.SetupError, match=r"plant: path = .*would run this program.*--trust"):
        setup.made("loop.toml", tables)
    loaded = setup.made("loop.toml", tables, trust=True)
    run = ql.simulate(loaded.needed("plant"), loaded.controller, loaded.needed("scenario"))
    assert run["y"][-1] > 0.0


def test_a_copy_and_a_pickle_of_a_plant_unpack_the_file_again(files: dict[int, Path]) -> None:
    """So batches in other processes work."""
    plant = ql.plants.FMU(files[3], **LOOP, start={"gain": 2.0})
    for other in (copy.copy(plant), pickle.loads(pickle.dumps(plant))):
        runs = [ql.simulate(p, controller(), SHORT)["y"] for p in (plant, other)]
        np.testing.assert_array_equal(*runs)


@cases(
    ("arguments", "words"),
    [
        ({"u": "force"}, "u = 'force': no variable of it; must be one of|did you mean"),
        ({"u": "y"}, "u = 'y': is output of type (Real|Float64); must be an input"),
        ({"u": 3}, r"u = 3: must be a name, or a sequence of names"),
        ({"y": "speed"}, "y = 'speed': no variable"),
        ({"w": ["u"], "u": "u"}, "u and w name one variable twice"),
        ({"w": "w"}, "w = 'w': must be a sequence of names"),
        ({"states": ["v", "vv"]}, r"states\[1\] = 'vv': no variable of it; did you mean v\?"),
        ({"start": {"v": 1.0}}, r"start\['v'\]: is continuous local; must be a parameter"),
        ({"start": {"gain": "two"}}, r"start\['gain'\] = 'two': must be a number"),
        ({"start": {"fail_with": 2.5}}, r"start\['fail_with'\] = 2.5: must be a whole number"),
        ({"start": {"fail_with": 2**31}}, "must be a whole number from -2147483648 to 2147483647"),
        ({"start": ["gain"]}, r"start = \['gain'\]: must be a mapping of names to values"),
        ({"substeps": 0}, "substeps = 0: must be a whole number of at least 1"),
    ],
)
def test_bad_arguments_are_named(
    arguments: dict[str, Any], words: str, files: dict[int, Path]
) -> None:
    """By argument, value and rule, when the plant is made."""
    for file in files.values():
        with pytest.raises(ValueError, match=words):
            ql.plants.FMU(file, **arguments)


def test_a_state_for_the_start_is_refused(files: dict[int, Path]) -> None:
    """An FMU has its own; start values replace it."""
    with pytest.raises(ValueError, match=r"x0 = \[1.0\]: must be zero for an FMU"):
        ql.simulate(ql.plants.FMU(files[3]), controller(), ql.Scenario(1.0, 0.1, x0=[1.0]))


def without(name: str) -> Callable[[dict[str, bytes]], None]:
    """Return a change of an FMU that removes files."""

    def change(files: dict[str, bytes]) -> None:
        for each in [each for each in files if each.startswith(name)]:
            del files[each]

    return change


def replaced(old: str, new: str) -> Callable[[dict[str, bytes]], None]:
    """Return a change of the description of an FMU."""

    def change(files: dict[str, bytes]) -> None:
        text = files["modelDescription.xml"].decode()
        assert old in text
        files["modelDescription.xml"] = text.replace(old, new).encode()

    return change


def added(name: str, content: bytes = b"") -> Callable[[dict[str, bytes]], None]:
    """Return a change that adds a file."""
    return lambda files: files.update({name: content})


@cases(
    ("change", "words"),
    [
        (without("modelDescription.xml"), "is no FMU: it has no modelDescription.xml"),
        (added("modelDescription.xml", b"<fmi"), "modelDescription.xml can't be read"),
        (replaced('fmiVersion="3.0"', 'fmiVersion="1.0"'), "modelDescription.xml can't be read"),
        (replaced("<fmi", "<!DOCTYPE x [<!ENTITY e 'e'>]><fmi"), "must be in UTF-8, without a doc"),
        (replaced("CoSimulation", "ModelExchange"), "is not for co-simulation"),
        (
            without("binaries/"),
            "has no binaries, but binaries/.*mass.so is missing; it has sources",
        ),
        (replaced('ier="mass"', 'ier="other"'), "has binaries for .*, but .*other.so is missing"),
        (replaced('ier="mass"', 'ier="../../mass"'), "modelIdentifier = .* must be a C name"),
        (added("../escaped.txt"), "contains '../escaped.txt', a link or a path out of its folder"),
        (added("/tmp/escaped.txt"), "contains '/tmp/escaped.txt', a link or a path out"),
        (added("resources/zeros", bytes(2_000_000)), "unpacks to more than max_size = 1 MB"),
        (
            replaced('causality="output"', 'causality="local"'),
            "has no output that is a number: y must have",
        ),
    ],
)
def test_malformed_files_give_one_clear_error(
    change: Callable[[dict[str, bytes]], None], words: str, tmp_path: Path
) -> None:
    """And nothing is unpacked outside of the temporary folder, or left in it."""
    content = fmus.contents(3)
    change(content)
    path = fmus.packed(tmp_path / "bad.fmu", content)
    with pytest.raises(ValueError, match=f"bad.fmu: .*{words}"):
        ql.plants.FMU(path, max_size=1.0)
    assert [*tmp_path.iterdir()] == [path]


def test_archives_that_lie_about_their_sizes_unpack_to_no_more(
    files: dict[int, Path], tmp_path: Path
) -> None:
    """A bomb that declares one byte is damaged; a link, twice the same name, and other files are no FMUs."""
    zeros = fmus.packed(tmp_path / "bomb.fmu", {"resources/a": bytes(10_000_000)})
    data = zeros.read_bytes().replace(struct.pack("<I", 10_000_000), struct.pack("<I", 1))
    zeros.write_bytes(data)
    with pytest.raises(ValueError, match="is no FMU, or is damaged"):
        ql.plants.FMU(zeros, max_size=1.0)
    linked = tmp_path / "linked.fmu"
    with zipfile.ZipFile(linked, "w") as archive:
        entry = zipfile.ZipInfo("resources/passwd")
        entry.external_attr = 0o120777 << 16
        archive.writestr(entry, "/etc/passwd")
    with pytest.raises(ValueError, match="contains 'resources/passwd', a link"):
        ql.plants.FMU(linked)
    with zipfile.ZipFile(linked, "w") as archive:
        archive.writestr("resources/a", "")
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("resources/a", "")
    with pytest.raises(ValueError, match="contains 'resources/a' twice"):
        ql.plants.FMU(linked)
    cut = tmp_path / "cut.fmu"
    cut.write_bytes(files[3].read_bytes()[:-100])
    with pytest.raises(ValueError, match="cut.fmu: is no FMU, or is damaged"):
        ql.plants.FMU(cut)
    with pytest.raises(FileNotFoundError, match="none.fmu: can't be read"):
        ql.plants.FMU(tmp_path / "none.fmu")
    with pytest.raises(TooLargeError):
        ql.plants.FMU(files[3], max_size=0.001)


def test_random_changes_of_an_fmu_are_read_or_refused_in_a_line(
    tmp_path: Path,
) -> None:
    """Of its description, and of the archive; no code of it runs."""
    random_, path, results = random.Random(3), tmp_path / "changed.fmu", list[str]()
    for k in range(60):
        content = fmus.contents(2 + k % 2)
        if k % 3:
            text = content["modelDescription.xml"]
            content["modelDescription.xml"] = mutated(text, "setup", b"<a>", random_)
        fmus.packed(path, content)
        if not k % 3:
            path.write_bytes(mutated(path.read_bytes(), "NetCDF", b"PK", random_))
        try:
            ql.plants.FMU(path, w=["w"], max_size=10.0).sampled(DT)
            results.append("")
        except ValueError as error:
            results.append(str(error))
    assert "" in results
    assert any(results)
    assert not any("\n" in message for message in results)
    content = fmus.packed(path, {"resources/a": b""}).read_bytes()
    path.write_bytes(content.replace(b"resources/a", b"\0esources/a"))
    with pytest.raises(ValueError, match="contains '', a link or a path"):
        ql.plants.FMU(path)


def test_binaries_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    """One that is no library, one without the functions, and one that refuses to be instantiated."""
    content, law = fmus.contents(3), controller()
    bad = content | {fmus.place(3): b"no library"}
    plant = ql.plants.FMU(fmus.packed(tmp_path / "bad.fmu", bad))
    with pytest.raises(ValueError, match="bad.fmu: its binary can't be loaded"):
        ql.simulate(plant, law, SHORT)
    other = content | {fmus.place(3): fmus.binary(2)}
    plant = ql.plants.FMU(fmus.packed(tmp_path / "other.fmu", other))
    with pytest.raises(ValueError, match="other.fmu: its binary can't be loaded .*fmi3"):
        ql.simulate(plant, law, SHORT)
    replaced("{mass}", "{other}")(content)
    plant = ql.plants.FMU(fmus.packed(tmp_path / "token.fmu", content))
    with pytest.raises(ValueError, match="token.fmu: can't be instantiated"):
        ql.simulate(plant, law, SHORT)


def test_capabilities_that_an_fmu_lacks_are_respected(tmp_path: Path) -> None:
    """Only one instance in a process, and a fixed internal step."""
    content = fmus.contents(3)
    replaced(
        'modelIdentifier="mass" ',
        'modelIdentifier="mass" canBeInstantiatedOnlyOncePerProcess="true" fixedInternalStepSize="0.004" ',
    )(content)
    plant = ql.plants.FMU(fmus.packed(tmp_path / "shy.fmu", content), substeps=5)
    with pytest.warns(ql.DesignWarning, match=r"dt/substeps = 0.002 s is no multiple .* 0.004 s"):
        ql.simulate(plant, controller(), SHORT)
    slow = ql.plants.FMU(plant.path, substeps=5)
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.02)
    law = ql.ADRC(observer, omega_c=3.0)
    for _ in range(2):
        ql.simulate(slow, law, SHORT)
    with pytest.raises(ValueError, match="can be instantiated only once in a process"):
        ql.simulate(slow, law, [SHORT, SHORT])


def test_controllers_are_compared_on_an_fmu_that_has_one_instance_in_a_process(
    files: dict[int, Path], tmp_path: Path
) -> None:
    """One run after the other, also behind an encoder; the results are those of runs side by side."""
    content = fmus.contents(3)
    replaced(
        'modelIdentifier="mass" ',
        'modelIdentifier="mass" canBeInstantiatedOnlyOncePerProcess="true" ',
    )(content)
    laws = {"one": controller(), "two": controller(), "three": controller()}
    laws["two"].retune(omega_c=5.0)
    noisy = ql.Scenario(1.0, 0.3, noise=ql.signals.BandLimitedNoise(1e-8, DT))
    path = fmus.packed(tmp_path / "shy.fmu", content)
    shy, other = (
        ql.plants.encoded(ql.plants.FMU(each, **LOOP), 20_000, 1.0) for each in (path, files[3])
    )
    found, wanted = (over_seeds(plant, laws, noisy, seeds=3).values for plant in (shy, other))
    np.testing.assert_array_equal(found["rms"], wanted["rms"])
    assert np.unique(found["rms"]).size > 3
    runs, others = (compare(plant, laws, noisy).runs for plant in (shy, other))
    for name in laws:
        np.testing.assert_array_equal(runs[name]["y"], others[name]["y"])


def test_variables_of_two_types_may_have_one_reference(tmp_path: Path) -> None:
    """In FMI 2.0 a reference counts among variables of its type only; two of one type are one variable."""
    content = fmus.contents(2)
    y = fmus._NAMES["mass"].index("y")
    replaced(
        f'name="count" valueReference="{fmus._NAMES["mass"].index("count")}"',
        f'name="count" valueReference="{y}"',
    )(content)
    path = fmus.packed(tmp_path / "shared.fmu", content)
    plant = ql.plants.FMU(path, u=["u"], y=["y", "count"], w=["w"])
    instance = plant.instance(1.0, np.zeros(2))
    assert instance.advance([5.0, 0.0]).tolist() == [2.5, 2.0]  # y, and as a whole number
    instance.free()
    replaced('name="v" valueReference="4"', f'name="v" valueReference="{y}"')(content)
    path = fmus.packed(tmp_path / "alias.fmu", content)
    with pytest.raises(ValueError, match="y names one variable twice: 'y' and 'v'"):
        ql.plants.FMU(path, u=["u"], y=["y", "v"], w=["w"])
