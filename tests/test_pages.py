"""The pages: names that they mention exist, and their setups and commands are accepted."""

from __future__ import annotations

import ast
import functools
import importlib
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from quell.cli.app import app
from quell.setup.description import describe
from quell.setup.schema import PLANTS, immutable, plant_of

from .cases import cases

ROOT = Path(__file__).parents[1]
PAGES = sorted([*(ROOT / "docs").glob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"])
pytestmark = pytest.mark.skipif(
    not (ROOT / "docs").is_dir(), reason="the pages are in the repository, not in what is built"
)
_FROM_FILES = {"fmu", "identified", "python"}
# Names of files, not of modules.
_SUFFIXES = {"toml", "py", "json", "csv", "md", "mcap", "nc", "fmu", "html", "conf", "fish"}


def blocks(page: Path, *languages: str) -> list[str]:
    """Return the blocks of code of a page in some languages."""
    found = re.findall(r"^```(\S*).*?\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)
    return [code for language, code in found if language in languages]


def resolved(name: str) -> Any:
    """Return what a dotted name stands for; raise an error if there is nothing."""
    first, *rest = name.split(".")
    value: Any = importlib.import_module("quell")
    path = "quell"
    for part in rest:
        path = f"{path}.{part}"
        if hasattr(value, part) or part in getattr(value, "__annotations__", {}):
            value = getattr(value, part, None)
            continue
        value = importlib.import_module(path)
    return value, first


@cases("page", PAGES, ids=lambda page: page.stem)
def test_every_name_of_the_package_on_a_page_exists(page: Path) -> None:
    """Each ``ql.x.y`` and ``quell.x.y`` in text and code, as it is written."""
    text = page.read_text(encoding="utf-8")
    missing = []
    for name in sorted(set(re.findall(r"\b(?:ql|quell)(?:\.[A-Za-z_]\w*)+", text))):
        if name.rpartition(".")[2] in _SUFFIXES:
            continue
        try:
            resolved(name)
        except (ImportError, AttributeError):
            missing.append(name)
    assert not missing


@cases("page", PAGES, ids=lambda page: page.stem)
def test_every_import_of_the_package_in_a_block_exists(page: Path) -> None:
    """Also in blocks that are not run when the pages are built, which have to be Python."""
    for code in blocks(page, "python", "{code-cell}"):
        if code.lstrip().startswith("%%") or "\n%%" in code:  # a file that the page writes
            continue
        plain = "\n".join(
            "" if line.lstrip().startswith(("!", "%")) or line.startswith(":tags:") else line
            for line in code.splitlines()
        )
        for node in ast.walk(ast.parse(plain)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("quell"):
                module = importlib.import_module(str(node.module))
                for alias in node.names:
                    if not hasattr(module, alias.name):
                        importlib.import_module(f"{node.module}.{alias.name}")


@cases("page", PAGES, ids=lambda page: page.stem)
def test_every_setup_on_a_page_is_accepted(page: Path) -> None:
    """Each block of TOML as it is; of several plants one after the other, of a part the rest is added."""
    for code in blocks(page, "toml"):
        lines = code.splitlines()
        several = [line for line in lines if re.match(r"plant = ", line)]
        for part in several if len(several) > 1 else [code]:
            tables = tomllib.loads(part)
            tables.setdefault("dt", 0.01)
            plant = tables.setdefault("plant", {})
            plant.setdefault("kind", "two-mass")
            tables.setdefault(
                "observer", {"kind": "model-free", "order": 4, "b0": 1.0, "omega_o": 9.0}
            )
            tables.setdefault("controller", {"omega_c": 1.0})
            described = describe(page.name, immutable(tables))
            assert described.plant is None or described.plant.kind_name in PLANTS
            if described.plant is not None and plant["kind"] not in _FROM_FILES:
                plant_of(plant, float(tables["dt"]))


@functools.cache
def options_of(*names: str) -> set[str]:
    """Return the options of a command of the program; none where it only has commands."""
    command: Any = app
    for name in names:
        command = command[name]
    if not names or command.default_command is None:
        return set()
    return {"--help", "--version", "-h"}.union(
        *([*each.names, *each.negatives] for each in command.assemble_argument_collection())
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_on_a_page_has_these_options(page: Path) -> None:
    """In the text, in blocks and in cells; what a page leaves out is not looked at."""
    text = page.read_text(encoding="utf-8")
    wrong = []
    for line in re.findall(r"(?:^!|^    |`)(quell [a-z][^`\n]*)", text, re.M):
        words = line.partition("#")[0].partition("|")[0].partition(">")[0].split()[1:]
        command, names = app, []
        while words and words[0] in command:
            names.append(words.pop(0))
            command = command[names[-1]]
        known = options_of(*names)
        if not known:
            continue
        flags = [word.partition("=")[0].rstrip(",.;:)…'\"") for word in words]
        wrong += [
            f"{line}: {flag}"
            for flag in flags
            if re.fullmatch(r"--[a-z][\w-]*", flag) and flag not in known
        ]
    assert not wrong
