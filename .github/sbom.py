"""Write the bill of materials of a release, from the metadata of the packages that are installed.

    python .github/sbom.py quell-control sbom.cdx.json

The form is CycloneDX 1.5 in JSON: quell and each package that it needs, directly or not, with name,
version, licence and dependencies. Extras that are not installed are not in it. With ``--floors`` it
compares the least versions that pyproject.toml allows with ``.github/floors.toml`` instead, and
ends with 1 where one is below the first version without a known advisory.
"""

from __future__ import annotations

import json
import re
import sys
import tomllib
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parent.parent


def requirements(package: Distribution) -> list[str]:
    """Return the names of the packages that one needs here, without its extras."""
    found = [Requirement(each) for each in package.requires or []]
    return sorted({canonicalize_name(each.name) for each in found
                   if each.marker is None or each.marker.evaluate({"extra": ""})})  # fmt: skip


def licence(package: Distribution) -> str:
    """Return what the metadata says of the licence: an expression, a field, or a classifier."""
    data = package.metadata
    if data.get("License-Expression"):
        return str(data["License-Expression"])
    field = str(data.get("License") or "").strip()
    if field and "\n" not in field and len(field) < 80:
        return field
    classifiers = [each.rpartition(" :: ")[2] for each in data.get_all("Classifier") or []
                   if each.startswith("License :: ")]  # fmt: skip
    return "; ".join(classifiers)


def component(name: str, package: Distribution) -> dict[str, Any]:
    """Return a package as a component."""
    where = f"pkg:pypi/{name}@{package.version}"
    known = licence(package)
    kind = "library"
    found = {
        "type": kind,
        "bom-ref": where,
        "name": name,
        "version": package.version,
        "purl": where,
    }
    return found | ({"licenses": [{"license": {"name": known}}]} if known else {})


def bill(root: str) -> dict[str, Any]:
    """Return the bill of materials of a package."""
    found: dict[str, Distribution] = {}
    waiting = [canonicalize_name(root)]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found[name] = distribution(name)
            waiting += requirements(found[name])
    parts = {name: component(name, package) for name, package in sorted(found.items())}
    own = parts.pop(canonicalize_name(root))
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": own},
        "components": list(parts.values()),
        "dependencies": [
            {"ref": (own if name == canonicalize_name(root) else parts[name])["bom-ref"],
             "dependsOn": [parts[each]["bom-ref"] for each in requirements(package)]}
            for name, package in sorted(found.items())
        ],
    }  # fmt: skip


def low_floors(project: dict[str, Any], floors: dict[str, dict[str, str]]) -> list[str]:
    """Return the requirements whose least version has a known advisory, a sentence each."""
    lists = [project.get("dependencies", []), *project.get("optional-dependencies", {}).values()]
    found = set()
    for requirement in (Requirement(each) for part in lists for each in part):
        known = floors.get(canonicalize_name(requirement.name))
        least = re.findall(r">=([^,]+)", str(requirement.specifier))
        if known and (not least or Version(least[0]) < Version(known["first"])):
            found.add(f"{requirement}: {known['advisory']} is fixed in {known['first']}; raise it")
    return sorted(found)


def main(arguments: list[str]) -> int:
    """Run the command; return its exit code."""
    if arguments == ["--floors"]:
        project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
        floors = tomllib.loads((ROOT / ".github/floors.toml").read_text("utf-8"))
        low = low_floors(project, floors)
        print("\n".join(low) or f"{len(floors)} packages with advisories: no floor is below one")
        return bool(low)
    if len(arguments) != 2:
        print(__doc__)
        return 2
    try:
        text = json.dumps(bill(arguments[0]), indent=1)
    except PackageNotFoundError as error:
        print(f"{error.name} is not installed, so its version is not known; install it first")
        return 1
    Path(arguments[1]).write_text(f"{text}\n", "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
