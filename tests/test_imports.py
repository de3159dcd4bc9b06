"""Imports between the folders of the package point one way, and never in a circle."""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Iterable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

# The order of the folders: each may import itself and whatever stands before it. "x.__init__" is
# the file that gathers the public names of folder x and its subfolders. A new folder needs an entry
# here.
ROWS = (
    ("hints", "lazy", "types", "checks", "files", "parallel", "quantities"),
    ("kernels",),
    ("lti", "signals", "observers", "plants", "features"),
    ("learners", "guard"),
    ("controllers", "controllers.baselines", "controllers.__init__"),
    ("records", "simulation", "analysis"),
    ("envs",),
    ("identification",),
    ("sweeping",),
    (
        "tuning.constraints",
        "tuning.structures",
        "tuning.optimiser",
        "tuning.simulated",
        "tuning",
    ),
    # Plants from tables, which twins and rigs are made of.
    ("setup.schema",),
    ("realtime",),
    ("export.reserved", "export.translate", "export", "setup"),
    ("commissioning",),
    ("monitoring",),
    ("experiments.common", "experiments.two_mass_spring", "experiments.torsional"),
    (
        "experiments.compare",
        "experiments.over_seeds",
        "experiments.acc",
        "experiments.stress",
        "experiments.__init__",
    ),
    ("studio",),
    ("__init__", "cli.options", "cli.output"),
    ("cli", "__main__"),
)
ORDER = [folder for row in ROWS for folder in row]

ROOT = Path(importlib.util.find_spec("quell").origin or "").parent


def module_of(file: Path) -> str:
    """Return a file's module name below ``quell``: ``plants.base``, or ``plants.__init__``."""
    return ".".join(file.relative_to(ROOT).with_suffix("").parts)


MODULES = {module_of(file): file for file in sorted(ROOT.rglob("*.py"))}


def target(name: str) -> str | None:
    """Return the module that a dotted name below ``quell`` stands for, if it is one."""
    for module in (name, f"{name}.__init__" if name else "__init__"):
        if module in MODULES:
            return module
    return None


def statements(nodes: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """Yield statements and those inside them; no expressions, which are most of a file."""
    for node in nodes:
        yield node
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            yield from statements(getattr(node, part, ()))


def imports_of(module: str) -> set[str]:
    """Return the modules that a file imports, at its top, inside functions or for types only."""
    found = set()
    for node in statements([ast.parse(MODULES[module].read_text(encoding="utf-8"))]):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, (
                f"{module} line {node.lineno}: write the whole name of the module"
            )
            package = node.module or ""
            names = [f"{package}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            parts = name.split(".")
            if parts[0] == "quell":
                inside = ".".join(parts[1:])
                where = target(inside) or target(".".join(parts[1:-1]))
                assert where is not None, f"{module}: {name} is no module"
                found.add(where)
    return found - {module}


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """What each module imports."""
    return {module: imports_of(module) for module in MODULES}


def place(module: str) -> int:
    """Return the place in the order of the folder that a module is in."""
    if module in ORDER:
        return ORDER.index(module)
    folders = [folder for folder in ORDER if module.startswith(f"{folder}.")]
    assert folders, f"{module} is in no folder of ORDER: add its folder to the table in this file"
    return ORDER.index(max(folders, key=len))


@pytest.mark.trial
def test_a_file_imports_only_what_stands_before_it(imports: dict[str, set[str]]) -> None:
    """Its own folder, and folders that come earlier in the table."""
    wrong = [
        f"{module} imports {other}"
        for module, others in imports.items()
        for other in sorted(others)
        if place(other) > place(module)
    ]
    assert not wrong, "against ORDER: " + "; ".join(wrong)


def test_no_files_import_each_other_in_a_circle(imports: dict[str, set[str]]) -> None:
    """Imports that are there for types only, or inside functions, count too."""
    try:
        tuple(TopologicalSorter(imports).static_order())
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_every_folder_says_what_it_may_import() -> None:
    """In the docstring of its ``__init__.py``, beside what belongs there."""
    folders = list(ROOT.glob("*/**/__init__.py"))
    silent = [file for file in folders if "May import" not in file.read_text(encoding="utf-8")]
    assert not silent, silent


@pytest.mark.trial
def test_one_file_imports_the_private_modules_of_numba() -> None:
    """A new version of Numba can move them: then one file has to change, with a check of versions."""
    public = {"numba", "numba.extending"}
    private = {}
    for module, file in MODULES.items():
        for node in statements([ast.parse(file.read_text(encoding="utf-8"))]):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
                if node.module == "numba":
                    hidden = (alias.name for alias in node.names if alias.name in ("core", "np"))
                    names.extend(f"numba.{name}" for name in hidden)
            numba = [n for n in names if n.partition(".")[0] in ("numba", "llvmlite")]
            if set(numba) - public:
                private.setdefault(module, []).extend(numba)
        text = file.read_text(encoding="utf-8")
        if re.search(r"\bnumba\.(core|np|typed|_\w+)\.", text.replace("numba.__version__", "")):
            private.setdefault(module, []).append("by attribute")
    assert private.keys() == {"kernels.numba_internals"}, private
