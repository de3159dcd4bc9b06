"""``.github/sbom.py``: the bill of materials of a release, and the floors of dependencies."""

from __future__ import annotations

import importlib.util
import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent


def program() -> Any:
    """Return the program as a module."""
    spec = importlib.util.spec_from_file_location("sbom", ROOT / ".github/sbom.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_bill_has_names_versions_licences_and_dependencies(tmp_path: Path) -> None:
    """Valid JSON in the form of CycloneDX; each reference is a component. xarray stands for quell."""
    target = tmp_path / "sbom.json"
    assert program().main(["xarray", str(target)]) == 0
    bill = json.loads(target.read_text())
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.5")
    own, parts = bill["metadata"]["component"], bill["components"]
    assert {"numpy", "packaging", "pandas"} <= {each["name"] for each in parts}
    references = {each["bom-ref"] for each in (own, *parts)}
    assert len(references) == len(parts) + 1
    for each in (own, *parts):
        assert each["version"]
        assert each["licenses"][0]["license"]["name"], each["name"]
        assert each["purl"] == f"pkg:pypi/{each['name']}@{each['version']}"
    assert {each["ref"] for each in bill["dependencies"]} == references
    assert all(set(each["dependsOn"]) <= references for each in bill["dependencies"])


def test_no_floor_of_a_dependency_has_a_known_advisory(capsys: pytest.CaptureFixture[str]) -> None:
    """The list is in the repository; a lower floor is named with what to do."""
    sbom = program()
    assert sbom.main(["--floors"]) == 0, capsys.readouterr().out
    floors = tomllib.loads((ROOT / ".github/floors.toml").read_text())
    low = sbom.low_floors({"dependencies": ["numpy>=1.20", "scipy", "rich>=1"]}, floors)
    assert low == [
        "numpy>=1.20: CVE-2021-34141 is fixed in 1.22.0; raise it",
        "scipy: CVE-2023-25399 and CVE-2023-29824 is fixed in 1.11.1; raise it",
    ]


def test_what_is_not_installed_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its version is not known: no file is written."""
    assert program().main(["no-such-package", str(tmp_path / "x")]) == 1
    assert "no-such-package is not installed" in capsys.readouterr().out
    assert not any(tmp_path.iterdir())
