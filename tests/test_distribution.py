"""Name, version and dependencies are the same in all files that say them."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

import quell as ql
from quell.cli import doctor
from quell.lazy import DISTRIBUTION, install

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(
    not (ROOT / "conda").is_dir(), reason="the recipe is in the repository, not in what is built"
)
# Names that conda has for the same thing: matplotlib without a window system.
_IN_CONDA = {"matplotlib": "matplotlib-base"}


def read(name: str) -> str:
    """Return the text of a file of the repository."""
    return (ROOT / name).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def project() -> Any:
    """The table ``[project]``."""
    return tomllib.loads(read("pyproject.toml"))["project"]


@pytest.fixture(scope="module")
def recipe() -> Any:
    """The recipe of the conda package."""
    return pytest.importorskip("yaml").safe_load(read("conda/recipe.yaml"))


def test_the_distribution_has_one_name(project: Any, recipe: Any) -> None:
    """The import stays quell: the name belongs to another project on the package index."""
    assert project["name"] == recipe["package"]["name"] == DISTRIBUTION
    assert install("tuning") == f"pip install '{DISTRIBUTION}[tuning]'"
    lines = [line for extra in project["optional-dependencies"].values() for line in extra]
    own = [line for line in lines if line.startswith("quell")]
    assert own
    assert all(line.startswith(f"{DISTRIBUTION}[") for line in own)


def test_no_page_installs_the_project_of_that_name() -> None:
    """Commands to install, in pages, examples and messages."""
    files = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "examples").rglob("*.py")]
    files += (ROOT / "src").rglob("*.py")
    wrong = re.compile(r"pip install\S* (?:-U )?['\"]?quell(?!-control)\b")
    assert [file.name for file in files if wrong.search(file.read_text(encoding="utf-8"))] == []


def test_the_recipe_has_the_dependencies_of_the_project(project: Any, recipe: Any) -> None:
    """With the same lowest versions; and the same program."""
    needed = {f"python {project['requires-python']}"}
    for line in project["dependencies"]:
        name, _, least = line.partition(">=")
        needed.add(f"{_IN_CONDA.get(name, name)} >={least}")
    assert set(recipe["requirements"]["run"]) == needed
    build = tomllib.loads(read("pyproject.toml"))["build-system"]["requires"]
    assert {line.replace(">=", " >=") for line in build} <= {*recipe["requirements"]["host"]}
    points = [line.split(" = ") for line in recipe["build"]["python"]["entry_points"]]
    assert dict(points) == project["scripts"]


def test_all_files_have_the_version_of_the_package(recipe: Any) -> None:
    """The recipe, the citation, with its date, and the change log."""
    yaml = pytest.importorskip("yaml")
    assert recipe["context"]["version"] == ql.__version__
    citation = yaml.safe_load(read("CITATION.cff"))
    assert citation["version"] == ql.__version__
    assert f"## [{ql.__version__}] - {citation['date-released']}" in read("CHANGELOG.md")
    assert citation["license"] == recipe["about"]["license"] == "Apache-2.0"


def test_the_release_tries_what_it_publishes() -> None:
    """Each job needs the one before, and the lowest Python is among those that are tried."""
    workflow = pytest.importorskip("yaml").safe_load(read(".github/workflows/release.yml"))
    jobs = workflow["jobs"]
    assert (jobs["try"]["needs"], jobs["publish"]["needs"]) == ("build", "try")
    assert jobs["try"]["strategy"]["matrix"]["python"][0] == "3.11"
    text = read(".github/workflows/release.yml")
    version = re.search(r"sed -n 's/\^__version__ = .*' (\S+)\)", text)
    assert version is not None
    assert '__version__ = "' in read(version[1])


def test_doctor_asks_for_the_extras_of_users(project: Any, monkeypatch: Any) -> None:
    """All of the project, but those for who works on quell; what only adds up others adds nothing."""
    lines = [*project["dependencies"]]
    for extra, needed in project["optional-dependencies"].items():
        lines += [f"{line} ; extra == '{extra}'" for line in needed]
    monkeypatch.setattr("importlib.metadata.requires", lambda name: lines)
    found = doctor.requirements()
    assert {name for name, _ in found[""]} == {
        line.split(">=")[0] for line in project["dependencies"]
    }
    assert {"telemetry", "tuning", "envs", "studio"} <= set(found)
    assert all(name != DISTRIBUTION for parts in found.values() for name, _ in parts)
