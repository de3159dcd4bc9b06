"""The folder of an exported controller, for the package managers of Arduino, PlatformIO and ESP-IDF."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import quell as ql

from .cases import cases

OBSERVER = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=0.01)
ADRC = ql.ADRC(OBSERVER, 1.5, u_min=-2.0, u_max=3.0)
AXIS = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=12.0, dt=0.01), 1.5)
LEARNING = ql.ADRC(OBSERVER, 1.5, learner=ql.learners.Kalman(), guard=ql.Guard(), u_max=3.0)
CONTROLLERS: dict[str, Any] = {
    "ADRC": ADRC,
    "PID": ql.baselines.PID(4.0, 2.0, 1.0, tf=0.05, dt=0.01, u_min=-2.0, u_max=3.0),
    "learner and guard": LEARNING,
    "axes": ql.Axes([AXIS, AXIS], u_min=-2.0, u_max=2.0),
}
PACKERS = {name: shutil.which(name) for name in ("pio", "compote")}
ROOT = Path(__file__).parents[1]


def exported(folder: Path, controller: Any = ADRC, name: str = "servo") -> Path:
    """Export a controller; return its folder."""
    return ql.export.c(controller, folder / name, name=name).folder


@pytest.fixture(scope="module")
def servo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one controller, for tests that only read it."""
    return exported(tmp_path_factory.mktemp("packages"))


# ---- Arduino ----

# The regular expressions are those of arduino-lint's schemas and rules.
_SEMVER = (
    r"(0|[1-9]\d*)\.(0|[1-9]\d*)\.(0|[1-9]\d*)(-((0|[1-9]\d*|\d*[a-zA-Z-][0-9a-zA-Z-]*)"
    r"(\.(0|[1-9]\d*|\d*[a-zA-Z-][0-9a-zA-Z-]*))*))?(\+([0-9a-zA-Z-]+(\.[0-9a-zA-Z-]+)*))?"
)
_NAME = r"(([a-zA-Z][a-zA-Z0-9 _.\-]*)|([0-9][a-zA-Z0-9 _.\-]*[a-zA-Z][a-zA-Z0-9 _.\-]*))*"
_README = r"(?i)readme\.(markdown|mdown|mkdn|md|textile|rdoc|org|creole|mediawiki|wiki|rst|txt)"
_LICENSE = r"(?i)(((un)?licen[sc]e)|(copy(ing|right))|(ofl)|(patents))(\.(md|markdown|txt|html))?"
_CATEGORIES = (
    "Display", "Communication", "Signal Input/Output", "Sensors", "Device Control", "Timing",
    "Data Storage", "Data Processing", "Other",
)  # fmt: skip
_FIELDS = (
    "name", "version", "author", "maintainer", "sentence", "paragraph", "category", "url",
    "architectures", "includes",
)  # fmt: skip


def properties_of(folder: Path) -> dict[str, str]:
    """Return the fields of ``library.properties``; each line must be one (LP005)."""
    lines = (folder / "library.properties").read_text().splitlines()
    return dict(line.split("=", 1) for line in lines if line.strip() and not line.startswith("#"))


def arduino_findings(folder: Path) -> Iterator[str]:
    """Yield the rules of ``arduino-lint --library-manager submit --compliance strict`` that are broken.

    Not tried: LP017 (the name is not taken) and LP042 (the address answers), which need a network,
    LP033 and LP035 (spelling, a warning).
    """
    given = properties_of(folder)
    names = [path.name for path in folder.iterdir()]
    everything = list(folder.rglob("*"))
    headers = {path.name for path in (folder / "src").glob("*.h")}
    name, version = given.get("name", ""), given.get("version", "")
    sketches = [path for path in everything if path.suffix in (".ino", ".pde")]
    rules = {
        "LS001": bool(headers) and "library.properties" in names,
        "LS002": len(folder.name) <= 63,
        "LS003": re.fullmatch(r"[a-zA-Z0-9_][a-zA-Z0-9_.-]*", folder.name),
        "LS004": ".gitmodules" not in names,
        "LS005": not any(path.is_symlink() for path in everything),
        "LS006": ".development" not in names,
        "LS007": not any(path.suffix == ".exe" for path in everything),
        "LS008": f"{re.sub(r'[^a-zA-Z0-9_.-]', '_', name)}.h" in headers,
        "LS009": "src" in names,
        "LS010": "utility" not in names,
        "LS011, LS012": not any(re.fullmatch("(?i)extras?", each) for each in names),
        "LP004": not (folder / "src/library.properties").exists(),
        "LP007 to LP051": all(given.get(field, "") for field in _FIELDS),
        "LP006": set(given) <= set(_FIELDS),
        "LP010": len(name) <= 32,
        "LP011": re.fullmatch(_NAME, name),
        "LP012, LP014": "arduino" not in name.lower(),
        "LP015": " " not in name,
        "LP016": "library" not in name.lower(),
        "LP021": re.fullmatch(_SEMVER, version),
        "LP057": "arduino" not in given.get("maintainer", "").lower(),
        "LP036": given.get("sentence", "") not in given.get("paragraph", ""),
        "LP038": given.get("category") in _CATEGORIES,
        "LP041": re.fullmatch(r"https?://[\w.-]+/\S*", given.get("url", "")),
        "LP045, LP046": given.get("architectures") == "*",
        "LP052": set(given.get("includes", "").split(",")) <= headers,
        "LD001": any(re.fullmatch(_README, each) for each in names),
        "LD002": any(re.fullmatch(_LICENSE, each) for each in names),
        "LD003": all(folder / "examples" in path.parents for path in sketches),
        "LD004": bool(sketches),
        "SS001": all(path.stem == path.parent.name for path in sketches),
        "SS002": all(re.fullmatch(r"[a-zA-Z0-9_][a-zA-Z0-9_.-]*", path.stem) for path in sketches),
        "SS003": all(len(path.stem) <= 63 for path in sketches),
        "SS004": not any(path.suffix == ".pde" for path in sketches),
        "LC001, SC001": not re.search(
            r"#include\s*[<\"](?!Arduino\.h)(?i:arduino\.h)",
            "".join(p.read_text() for p in sketches),
        ),
    }
    yield from (rule for rule, holds in rules.items() if not holds)


@pytest.mark.trial(cases="learner and guard|axes")
@pytest.mark.parametrize("controller", CONTROLLERS.values(), ids=CONTROLLERS)
def test_the_folder_keeps_the_rules_of_the_library_manager(tmp_path: Path, controller: Any) -> None:
    """The rules of arduino-lint that apply to a library to be submitted, with strict compliance."""
    assert list(arduino_findings(exported(tmp_path, controller))) == []


@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        ("name=servo", "name=servo drive", "LP015"),
        ("version=1.0.0", "version=1.0", "LP021"),
        ("maintainer=quell", "maintainer=", "LP007 to LP051"),
        ("category=Device Control", "category=Control", "LP038"),
        ("includes=servo.h", "includes=drive.h", "LP052"),
    ],
)
def test_a_rule_that_is_broken_is_found(
    servo: Path, tmp_path: Path, old: str, new: str, rule: str
) -> None:
    """Each change breaks one rule, so the test above can fail."""
    folder = shutil.copytree(servo, tmp_path / "servo")
    file = folder / "library.properties"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    assert rule in list(arduino_findings(folder))


@pytest.mark.parametrize(
    ("name", "why", "rule"),
    [
        ("arduino_servo", "has arduino in it", "LP012, LP014"),
        ("servoLibrary", "has library in it", "LP016"),
        ("s" * 33, "has 33 characters, 32 are allowed", "LP010"),
    ],
)
def test_a_name_that_the_library_manager_refuses_is_said_in_the_readme(
    tmp_path: Path, name: str, why: str, rule: str
) -> None:
    """The C files are of use without it, so they are written; the README has a line with NOT."""
    folder = exported(tmp_path, name=name)
    assert (
        f"NOT for Arduino's Library Manager: the name {name} {why}."
        in (folder / "README.md").read_text()
    )
    assert list(arduino_findings(folder)) == [rule]


def test_the_usual_name_has_no_line_with_not(servo: Path) -> None:
    """Nothing stands in the way of ``servo``."""
    assert "NOT for" not in (servo / "README.md").read_text()


def test_the_keywords_are_the_names_of_the_header(servo: Path) -> None:
    """A word, a tab and its kind; types, functions and constants that the header declares."""
    rows = [line.split("\t") for line in (servo / "keywords.txt").read_text().splitlines()]
    header = (servo / "src/servo.h").read_text()
    assert len({word for word, _ in rows}) == len(rows)
    assert all(re.search(rf"\b{word}\b", header) for word, _ in rows)
    kinds = dict(rows)
    assert kinds["servo_state"] == "KEYWORD1"
    assert kinds["servo_step"] == "KEYWORD2"
    assert kinds["SERVO_SATURATED"] == kinds["SERVO_SAMPLE_TIME"] == "LITERAL1"
    functions = set(re.findall(r"^\w+ \*?(servo_\w+)\(", header, re.M))
    assert functions == {word for word, kind in rows if kind == "KEYWORD2"}


def test_the_licence_is_that_of_quell(servo: Path) -> None:
    """The code is made from quell's kernels."""
    assert (servo / "LICENSE").read_text() == (ROOT / "LICENSE").read_text()


# ---- PlatformIO and ESP-IDF ----


def test_the_manifests_have_one_version_and_the_needed_fields(servo: Path) -> None:
    """Version and description of all are the same; the header and the folders of library.json exist."""
    library = json.loads((servo / "library.json").read_text())
    component = (servo / "idf_component.yml").read_text()
    assert library["version"] == properties_of(servo)["version"] == "1.0.0"
    assert 'version: "1.0.0"\n' in component
    assert f'description: "{library["description"]}"\n' in component
    assert (servo / library["build"]["srcDir"] / library["headers"]).is_file()
    assert all(re.fullmatch(r"[a-z\d\-_+. ]{1,50}", word) for word in library["keywords"])


@pytest.mark.trial
@pytest.mark.skipif(PACKERS["pio"] is None, reason="pio, of PlatformIO, is missing")
@cases("controller", CONTROLLERS.values(), ids=CONTROLLERS)
def test_platformio_packs_the_folder(tmp_path: Path, controller: Any) -> None:
    """``pio pkg pack`` checks library.json with its schema; all files are in the package."""
    folder, package = exported(tmp_path, controller), tmp_path / "servo.tar.gz"
    command = [PACKERS["pio"], "pkg", "pack", folder, "-o", package]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with tarfile.open(package) as packed:
        assert {"library.json", "src/servo.c", "src/servo.h", "LICENSE"} <= set(packed.getnames())


@pytest.mark.trial
@pytest.mark.skipif(PACKERS["compote"] is None, reason="compote, for ESP-IDF, is missing")
@cases("controller", CONTROLLERS.values(), ids=CONTROLLERS)
def test_the_component_manager_packs_the_folder(tmp_path: Path, controller: Any) -> None:
    """``compote component pack`` checks idf_component.yml with its schema."""
    folder = exported(tmp_path, controller)
    command = [PACKERS["compote"], "component", "pack", "--name", "servo"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with tarfile.open(folder / "dist/servo_1.0.0.tgz") as packed:
        names = {name.removeprefix("./") for name in packed.getnames()}
    assert {"CMakeLists.txt", "idf_component.yml", "src/servo.c", "src/servo.h"} <= names


_PROJECT = """cmake_minimum_required(VERSION 3.13)
project(stand_in LANGUAGES C)
set(ESP_PLATFORM 1)
function(idf_component_register)
  cmake_parse_arguments(given "" "" "SRCS;INCLUDE_DIRS" ${ARGN})
  if(given_UNPARSED_ARGUMENTS)
    message(FATAL_ERROR "${given_UNPARSED_ARGUMENTS}")
  endif()
  add_library(component STATIC ${given_SRCS})
  target_include_directories(component PUBLIC ${given_INCLUDE_DIRS})
  set(COMPONENT_LIB component PARENT_SCOPE)
endfunction()
add_subdirectory(servo)
"""


@pytest.mark.trial
@pytest.mark.skipif(shutil.which("cmake") is None, reason="cmake is missing")
def test_a_project_of_esp_idf_builds_the_folder_as_a_component(tmp_path: Path) -> None:
    """With a stand-in for idf_component_register, whose arguments are those of ESP-IDF."""
    exported(tmp_path)
    (tmp_path / "CMakeLists.txt").write_text(_PROJECT)
    for command in (["cmake", "-B", "build"], ["cmake", "--build", "build"]):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "build/servo/libcomponent.a").is_file()
    assert not list((tmp_path / "build").rglob("*test_servo*"))
