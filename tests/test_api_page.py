"""The pages of all names have all names."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

import quell as ql

from .cases import cases

FOLDER = Path(__file__).parents[1] / "docs" / "api"
PAGES = sorted(FOLDER.glob("*.rst"))
ROOMS = (
    "analysis",
    "controllers",
    "controllers.baselines",
    "features",
    "learners",
    "observers",
    "plants",
    "signals",
)

pytestmark = pytest.mark.skipif(
    not PAGES, reason="the pages are in the repository, not in what is built of it"
)


def text() -> str:
    """Return the text of all pages."""
    return "\n".join(page.read_text(encoding="utf-8") for page in PAGES)


def listed() -> set[str]:
    """Return the names that the pages' directives document, and the last part of the modules."""
    page = text()
    targets = re.findall(r"^\.\. auto\w+:: (\S+)$", page, re.MULTILINE)
    members = [
        name.strip()
        for line in re.findall(r"^   :members: (.+)$", page, re.MULTILINE)
        for name in line.split(",")
    ]
    return {part for target in targets for part in target.split(".")} | set(members)


@cases("room", ROOMS)
def test_every_public_name_of_a_room_is_on_a_page(room: str) -> None:
    """By a directive of its own, or among a module's members."""
    names = set(importlib.import_module(f"quell.{room}").__all__)
    assert names
    assert sorted(names - listed()) == []


def test_every_name_of_the_package_is_on_a_page_and_every_target_exists() -> None:
    """Rooms too; and nothing is documented that is gone."""
    assert sorted(set(ql.__all__) - listed()) == []
    page = text()
    for kind, target, members in re.findall(
        r"^\.\. auto(\w+):: (\S+)$(?:\n   :members: (.+)$)?", page, re.MULTILINE
    ):
        place, _, name = target.rpartition(".")
        thing = (
            importlib.import_module(target)
            if kind == "module"
            else getattr(importlib.import_module(place), name)
        )
        for member in filter(None, members.split(", ")):
            annotated = getattr(thing, "__annotations__", {})
            assert hasattr(thing, member) or member in annotated, f"{target} has no {member}"


@cases("room", [room for room in ROOMS if "." not in room])
def test_a_room_has_a_page_with_names_of_its_own(room: str) -> None:
    """Readers find a folder's names under the folder's name, and no page is empty."""
    page = (FOLDER / f"{room}.rst").read_text(encoding="utf-8")
    assert page.startswith(f"quell.{room}\n")
    assert ".. auto" in page
    assert f":: quell.{room}" in page
